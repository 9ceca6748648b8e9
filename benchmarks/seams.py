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
from itertools import pairwise
from pathlib import Path
from typing import Any

import click
import numpy as np
from pxr import Sdf

from benchmarks.contact_shots import REAL
from benchmarks.rows import say
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.write.chunk import mean_edge, points_at, read_chunk

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
    times = open_shot(str(shot), **named).scene.times
    first = len(times) // 2
    own = times[first : first + FRAMES]
    whole, path = _refine(shot, folder / "whole.usdc", level=level, **options)
    moves = np.mean([_apart(whole, whole, path, a, b)[0] for a, b in pairwise(times)])
    alone = 0.0
    for preroll in (0, *(each for each in prerolls if 0 < each < first)):
        began = time.process_time()
        span = {"frames": (own[0], own[-1]), "preroll": preroll}
        chunk, _ = _refine(shot, folder / f"{preroll}.usdc", level=level, **options | span)
        spent = time.process_time() - began
        alone = spent if preroll == 0 else alone
        adds = _adds(whole, chunk, path)
        ends = "  ".join("{:5.3f}/{:5.2f}".format(*_apart(whole, chunk, path, t, t)) for t in (own[0], own[-1]))
        yield f"{moves:6.2f}{preroll:7}   {ends}  {adds:11}  {spent - alone:5.1f}"


def _refine(shot: Path, out: Path, **options: Any) -> tuple[Sdf.Layer, str]:
    refine_shot(shot, out, RefineOptions(**options))
    layer = Sdf.Layer.FindOrOpen(str(out))
    return layer, str(layer.customLayerData["physgraph"]["garments"][0])


def _adds(whole: Sdf.Layer, chunk: Sdf.Layer, path: str) -> str:
    """What a joined seam adds to a frame's move, RMS and at most over its frames, in mean fine edges."""
    told = read_chunk(chunk)
    found = []
    for at, points in told.preroll.items() if told else ():
        there = points_at(whole, path, at)
        assert there is not None
        distances = np.linalg.norm(there.astype(np.float64) - points[path], axis=1) / mean_edge(whole, path, there)
        found.append((np.sqrt((distances**2).mean()), distances.max()))
    return "{:5.3f}/{:5.2f}".format(*(np.max(found, axis=0) / (len(found) + 1))) if found else "jumps"


def _apart(one: Sdf.Layer, other: Sdf.Layer, path: str, time: float, later: float) -> tuple[float, float]:
    """Distance between two frames in mean fine edges, RMS and at most."""
    a, b = points_at(one, path, time), points_at(other, path, later)
    assert a is not None
    assert b is not None
    distances = np.linalg.norm(a.astype(np.float64) - b, axis=1) / mean_edge(one, path, a)
    return float(np.sqrt((distances**2).mean())), float(distances.max())


if __name__ == "__main__":
    main()
