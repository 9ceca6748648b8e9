"""How far a chunk that begins in the middle of a sample is from the run of all frames, and what a joined seam moves.

    python -m benchmarks.seams [--short]

For each sample and level: how far the fine cloth moves from frame to frame, and how far the frames of the chunk are
from the same ones of the whole run: in its first frame and six frames later, RMS and at most, in mean fine edges.
Then what the seam adds to a frame's move at most, once both are joined over the run-up as `stitch` does.
A run-up that reaches the first frame of the shot leaves nothing and is not shown. ``temporal off`` needs none.
"""

from __future__ import annotations

import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf

from physgraph_usd.options import RefineOptions
from physgraph_usd.samples import write_sample
from physgraph_usd.shot import refine_shot
from physgraph_usd.usd.chunk import read_chunk
from physgraph_usd.usd.reader import open_shot
from physgraph_usd.usd.stitch import mean_edge, points_at

CASES: tuple[tuple[str, int, dict[str, Any]], ...] = (("sleeve", 1, {}), ("swatch", 1, {}), ("flag", 1, {}))
MORE = (
    ("skirt", 1, {}),
    ("sleeve", 2, {}),
    ("flag", 1, {"temporal": "warm"}),
    ("flag", 1, {"steps": 80, "tolerance": 1e-4}),
    ("flag", 1, {"temporal": "off"}),
)
RUN_UPS = (2, 6, 12, 20)
FRAMES = 6


def main() -> None:
    """Print the table."""
    sys.stdout.write(
        "sample level  options       a frame moves  run-up  first frame  sixth frame  joined adds  seconds of run-up\n"
    )
    with tempfile.TemporaryDirectory() as folder:
        for index, case in enumerate(CASES if "--short" in sys.argv else CASES + MORE):
            for line in rows(*case, Path(folder) / str(index)):
                sys.stdout.write(line + "\n")
                sys.stdout.flush()


def rows(name: str, level: int, options: dict[str, Any], folder: Path) -> list[str]:
    """One case, a row for each run-up."""
    shot = write_sample(name, folder)
    times = open_shot(str(shot)).scene.times
    first = len(times) // 2
    own = times[first : first + FRAMES]
    whole, path = _refine(shot, folder / "whole.usdc", level=level, **options)
    moves = np.mean([_apart(whole, whole, path, a, b)[0] for a, b in pairwise(times)])
    lines, alone = [], 0.0
    for run_up in (0, *(each for each in RUN_UPS if each < first)):
        began = time.process_time()
        span = {"frames": (own[0], own[-1]), "run_up": run_up}
        chunk, _ = _refine(shot, folder / f"{run_up}.usdc", level=level, **options | span)
        spent = time.process_time() - began
        alone = spent if run_up == 0 else alone
        adds = _adds(whole, chunk, path)
        ends = "  ".join("{:5.3f}/{:5.2f}".format(*_apart(whole, chunk, path, t, t)) for t in (own[0], own[-1]))
        said = ",".join(f"{key}={value}" for key, value in options.items())
        lines.append(f"{name:7}{level:5}  {said:26}{moves:6.2f}{run_up:7}   {ends}  {adds:11}  {spent - alone:5.1f}")
    return lines


def _refine(shot: Path, out: Path, **options: Any) -> tuple[Sdf.Layer, str]:
    refine_shot(shot, out, RefineOptions(**options))
    layer = Sdf.Layer.FindOrOpen(str(out))
    return layer, str(layer.customLayerData["physgraph"]["garments"][0])


def _adds(whole: Sdf.Layer, chunk: Sdf.Layer, path: str) -> str:
    """What a joined seam adds to a frame's move, RMS and at most over its frames, in mean fine edges."""
    told = read_chunk(chunk)
    found = []
    for at, points in told.run_up.items() if told else ():
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
