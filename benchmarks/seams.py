"""How far a chunk that begins in the middle of a sample is from the run of all frames, and what a joined seam moves.

    python -m benchmarks.seams [--short] [--preroll 6] [--shot NAME] [FOLDER]

For each sample and level, and each real shot in FOLDER: how far the fine cloth moves from frame to frame, and how
far the frames of the chunk are from the same ones of the whole run: in its first frame and six frames later, RMS and
at most, in mean fine edges. Then what the seam adds to a frame's move once both are joined over the pre-roll as
`stitch` does, but for frames that would cross.
A pre-roll that reaches the first frame of the shot leaves nothing and is not shown. ``temporal off`` needs none.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks.contact_shots import REAL
from benchmarks.rows import say
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.frames import Finished
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.solver.level import fine_meshes, refine_garments
from physgraph_usd.usd.read.reader import open_shot

CASES: tuple[tuple[str, int, dict[str, Any]], ...] = (("sleeve", 1, {}), ("swatch", 1, {}), ("flag", 1, {}))
MORE = (
    ("skirt", 1, {}),
    ("sleeve", 2, {}),
    ("flag", 1, {"temporal": "warm"}),
    ("flag", 1, {"steps": 80, "tolerance": 1e-4}),
    ("flag", 1, {"temporal": "off"}),
)
SHOTS = ("06_torus_pull.usda", "08_sphere_spin_xformcollider.usdc", "09_cesiumman_kilt/shot.usda")
SHOTS += ("10_style3d_skirt_twist.usdc",)
PREROLLS = (2, 6, 12, 20)
FRAMES = 6


@click.command()
@click.argument("folder", required=False, type=click.Path(path_type=Path, exists=True))
@click.option("--shot", "shots", multiple=True, help="Only these.")
@click.option("--preroll", "prerolls", multiple=True, type=int, default=PREROLLS, help="Only these; 0 stands for none.")
@click.option("--short", is_flag=True, help="Only three samples.")
def main(folder: Path | None, shots: Sequence[str], prerolls: Sequence[int], *, short: bool) -> None:
    """Print the table."""
    say("sample level  options       a frame moves  pre-roll  first frame  sixth frame  joined adds  pre-roll [s]")
    real: tuple[tuple[str, int, dict[str, Any]], ...] = tuple((name, 1, {}) for name in (SHOTS if folder else ()))
    with tempfile.TemporaryDirectory() as place:
        for index, (name, level, options) in enumerate((CASES if short else CASES + MORE) + real):
            if shots and not any(each in name for each in shots):
                continue
            out, given = Path(place) / str(index), dict(options)
            if name in REAL and folder is not None:
                out.mkdir()
                shot, given["garments"], given["colliders"] = folder.resolve() / name, *REAL[name][:2]
            else:
                shot = write_sample(name, out)
            for row in rows(shot, level, given, out, prerolls):
                said = ",".join(f"{key}={value}" for key, value in options.items())
                say(f"{name[:6]:7}{level:5}  {said:26}{row}")


def rows(shot: Path, level: int, options: dict[str, Any], folder: Path, prerolls: Sequence[int]) -> Iterator[str]:
    """One case, a row for each pre-roll."""
    named = {name: options.get(name, ()) for name in ("garments", "colliders")}
    scene = open_shot(str(shot), **named).scene
    (mesh, *_) = fine_meshes(scene.garments, refine_garments(scene.garments, [level] * len(scene.garments)))
    edges, times = mesh.half_edges.edges, scene.times
    first = len(times) // 2
    last = min(first + FRAMES, len(times)) - 1
    whole = _refine(shot, folder / "whole", level=level, preroll=0, **options)
    moves = np.mean([_apart(_points(whole, k), _points(whole, k + 1), edges)[0] for k in range(len(times) - 1)])
    alone = 0.0
    for preroll in (0, *(each for each in prerolls if 0 < each < first)):
        began = time.process_time()
        span = {"frames": (times[first], times[last]), "preroll": preroll}
        chunk = _refine(shot, folder / str(preroll), level=level, **options | span)
        spent = time.process_time() - began
        alone = spent if preroll == 0 else alone
        before = range(first - preroll, first) if options.get("temporal") != "off" else ()
        found = [_apart(_points(whole, k), _points(chunk, k, seam=first), edges) for k in before]
        adds = "{:5.3f}/{:5.2f}".format(*(np.max(found, axis=0) / (len(found) + 1))) if found else "jumps"
        both = [_apart(_points(whole, k), _points(chunk, k), edges) for k in (first, last)]
        ends = "  ".join("{:5.3f}/{:5.2f}".format(*each) for each in both)
        yield f"{moves:6.2f}{preroll:7}   {ends}  {adds:11}  {spent - alone:5.1f}"


def _refine(shot: Path, out: Path, **options: Any) -> Finished:
    refine_shot(shot, out, RefineOptions(**options))
    return Finished(out)


def _points(frames: Finished, index: int, *, seam: int | None = None) -> np.ndarray:
    """World positions [m] of the first garment in a frame by number, shape (V, 3)."""
    result = frames.read(index, None, seam=seam)
    assert result is not None
    assert result.garments[0].points is not None
    return result.garments[0].points.astype(np.float64)


def _apart(one: np.ndarray, other: np.ndarray, edges: np.ndarray) -> tuple[float, float]:
    """Distance between two frames in mean fine edges, RMS and at most."""
    edge = np.linalg.norm(one[edges[:, 0]] - one[edges[:, 1]], axis=1).mean()
    distances = np.linalg.norm(one - other, axis=1) / edge
    return float(np.sqrt((distances**2).mean())), float(distances.max())


if __name__ == "__main__":
    main()
