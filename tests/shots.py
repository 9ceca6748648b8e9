"""Small shots to refine end to end, and what can be read back from the layers."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from layers import errors, open_over, world_metres
from pxr import Sdf
from stages import add_sheet, new_stage, save, vec3

from physgraph_usd.cli import main
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.shot.report import RefineReport

SHOTS = {
    "01_newton_shirt_dab_cm.usdc": (["/shot/char/shirt_geo"], [1426], 56),
    "02_makehuman_usdskel_dm.usdc": (["/shot/char/top", "/shot/char/shorts"], [1311, 1565], 46),
    "06_torus_pull.usda": (["/shot/cloth"], [1939], 60),
    "07_flag_quads_nocollider.usda": (["/shot/flag"], [961], 60),
    "08_sphere_spin_xformcollider.usdc": (["/shot/set/cloth"], [1939], 60),
    "09_cesiumman_kilt/shot.usda": (["/shot/kilt"], [1074], 48),
    "12_variants/a_lefthanded_consistent.usdc": (["/shot/shirt"], [1426], 12),
    "12_variants/b_winding_flipped_unflagged.usdc": (["/shot/shirt"], [1426], 12),
    "12_variants/c_zup_cm.usdc": (["/shot/shirt"], [1426], 12),
    "12_variants/d_mixed_quads_tris.usdc": (["/shot/shirt"], [1426], 12),
    "12_variants/e_sparse_samples.usdc": (["/shot/shirt"], [1426], 10),
    "12_variants/f_subframe_times_tcps48.usdc": (["/shot/shirt"], [1426], 18),
    "12_variants/g_nonuniform_scaled_parent.usdc": (["/shot/rig/shirt"], [1426], 12),
    "12_variants/h_holes_creases_normals.usdc": (["/shot/shirt"], [1426], 12),
    "12_variants/j_visibility_purpose.usdc": (["/shot/shirt"], [1426], 12),
    "12_variants/k_static_garment.usda": (["/shot/shirt"], [1426], 0),
}
"""The real shots listed as valid: their garments, the numbers of their points, and of frames."""
VALID = {name: garments for name, (garments, _, _) in SHOTS.items()}
CLOTH = "/World/cloth"
EDGE = 0.05
TIMES = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
FAST: dict[str, Any] = {"level": 1, "steps": 6}


def cloth_shot(
    path: Path,
    *,
    times: Sequence[float] = TIMES,
    size: tuple[int, int] = (6, 4),
    kind: str = "quads",
    frozen: bool = False,
    broken: dict[float, float] | None = None,
) -> Path:
    """A waving sheet of 5 cm squares; ``frozen`` makes its samples equal, ``broken`` scales those of some times."""
    stage = new_stage(path, metres=EDGE)
    mesh = add_sheet(stage, CLOTH, times=times, size=size, kind=kind)
    attribute = mesh.GetPointsAttr()
    still = np.array(attribute.Get(times[0])) if frozen else None
    for time in times:
        points = np.asarray(attribute.Get(time)) if still is None else still
        attribute.Set(vec3(points * (broken or {}).get(time, 1.0)), time)
    return Path(save(stage))


def refine(shot: Path, out: Path, **options: Any) -> RefineReport:
    """Refine fast and small."""
    return refine_shot(shot, out, RefineOptions(**FAST | options))


def sample_times(layer: Path, prim: str = CLOTH) -> tuple[float, ...]:
    return tuple(Sdf.Layer.FindOrOpen(str(layer)).ListTimeSamplesForPath(f"{prim}.points"))


def fine(shot: Path, layer: Path, time: float | None, *, prim: str = CLOTH) -> np.ndarray:
    """World points [m] of a refined mesh at a time code."""
    return world_metres(open_over(shot, layer), prim, time)


faults = errors


def run(*args: object) -> Result:
    """The command, in this process."""
    return CliRunner().invoke(main, [str(arg) for arg in args])


def interrupted(shot: Path, out: Path, *, after: int, **options: Any) -> None:
    """Refine until the user interrupts, after some frames."""

    def interrupt(done: int, _: int) -> None:
        if done == after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        refine(shot, out, progress=interrupt, **options)


def only(folder: Path, *names: str) -> bool:
    """Whether a folder holds these files and no others."""
    return sorted(file.name for file in folder.iterdir()) == sorted(names)


def command(*args: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own."""
    line = [sys.executable, "-m", "physgraph_usd", *map(str, args)]
    return subprocess.run(line, capture_output=True, text=True, check=False, timeout=300, **options)
