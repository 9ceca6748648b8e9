"""Folds that a level's edges are too long for: curvature by fabric and level, with bending raised there and without.

    python -m benchmarks.unresolved SAMPLE|SHOT [--garment PATH] [--collider PATH] [--first 20] [--frames 3]

Prints for each fabric and level, off and raised: total absolute mean curvature of the cloth, part of the edges that
fold by more than 45 degrees, energy in the last frame, time of the cold frame and the median of the others, and how
level 1 previews level 2: the part of both, less Loop subdivision, that is longer than ten edges of level 1, by the RMS
of their difference over that of level 2.
"""

from __future__ import annotations

import argparse
import time
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.rows import say
from benchmarks.shots import opened
from benchmarks.waves import lowpass, vertex_area
from physgraph_usd.lab.samples import SAMPLES
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.fabric import PRESETS, Fabric
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.level import Level, hinge_geometry
from physgraph_usd.solver.mesh.elements import hinges_of
from physgraph_usd.solver.scene import Frame
from physgraph_usd.usd.read.reader import Shot, open_shot

LONG = 10.0
"""Wavelength from which level 1 is to preview level 2, in its edges."""


@dataclass(frozen=True, eq=False)
class Solved:
    """A few frames of one garment.

    Attributes:
        points: Positions [m], each of shape (V, 3).
        loop: The cage subdivided, the same.
        level: The finest level.
        row: What is printed of them.
    """

    points: list[np.ndarray]
    loop: list[np.ndarray]
    level: Level
    row: str


def solved(shot: Shot, fabric: Fabric, times: list[float], *, raised: bool) -> Solved:
    """Solve a few frames with a fabric, the first one cold."""
    garments = tuple(replace(each, raises_bending=raised) for each in shot.scene.garments)
    refiner = Refiner(replace(shot.scene, garments=garments), RefineOptions().solve_settings())
    points, loop, seconds, sharp = list[np.ndarray](), list[np.ndarray](), list[float](), list[float]()
    energy = 0.0
    for code in times:
        frame = dressed(shot.frame(code), fabric)
        began = time.process_time()
        state = refiner.solve(frame)
        seconds.append(time.process_time() - began)
        assert state.points[0] is not None
        points.append(state.points[0])
        loop += refiner.group_of((0,)).upsampled(frame.garments[:1])
        told = state.telemetry[0]
        sharp.append(float(str(told.get("sharp_folds", 0.0))))
        terms = told.get("energy_joules")
        energy = sum(terms["output"].values()) if isinstance(terms, dict) else 0.0
    level = refiner.group_of((0,)).levels[-1]
    cells = [f"{np.mean([curvature(level, x) for x in points]):.2f}", f"{100 * np.mean(sharp):.2f}%"]
    cells += [f"{1e3 * energy:.2f}", f"{seconds[0]:.2f}", f"{np.median(seconds[1:] or seconds):.2f}"]
    return Solved(points, loop, level, " | ".join(cells))


def dressed(frame: Frame, fabric: Fabric) -> Frame:
    """A frame whose garments are of a fabric, as thick as they are."""
    worn = (replace(each, fabric=replace(fabric, thickness=each.fabric.thickness)) for each in frame.garments)
    return replace(frame, garments=tuple(worn))


def curvature(level: Level, x: np.ndarray) -> float:
    """Total absolute mean curvature [m]."""
    angle, _, _, length = hinge_geometry(x, hinges_of(level.triangles.numpy()))
    return float(0.5 * (np.abs(angle) * length).sum())


def preview(coarse: Solved, fine: Solved) -> float:
    """RMS difference between what two levels add to Loop subdivision in long waves, over that of the finer one."""
    wave = LONG * float(coarse.level.spacing.mean())
    [smooth], area = lowpass(fine.level, [wave]), vertex_area(fine.level)[:, None]
    up, found = fine.level.smooth_from_below, []
    assert up is not None
    for x, y, loop in zip(coarse.points, fine.points, fine.loop, strict=True):
        about = x.mean(axis=0)
        raised = up.apply(torch.as_tensor(x - about).to(fine.level.rest)).double().numpy() + about
        found.append(np.sqrt((area * smooth(raised - y) ** 2).sum() / (area * smooth(y - loop) ** 2).sum()))
    return float(np.mean(found))


def main() -> None:
    """Solve and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shot")
    parser.add_argument("--garment", action="append", default=[])
    parser.add_argument("--collider", action="append", default=[])
    parser.add_argument("--fabrics", nargs="+", choices=sorted(PRESETS), default=["jersey", "silk", "denim"])
    parser.add_argument("--levels", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--first", type=int, default=20, help="Number of the first sample.")
    parser.add_argument("--frames", type=int, default=3)
    given = parser.parse_args()
    prepare_device("cpu")
    say("| fabric | level | bending | curvature, m | sharp | mJ | s, cold | s, warm | preview |\n" + "|---" * 9 + "|")
    for name in given.fabrics:
        for raised in (False, True):
            below = None
            for level in given.levels:
                reading = {"garments": given.garment, "colliders": given.collider, "level": level}
                sample = given.shot in SAMPLES
                with closing(opened(given.shot, level) if sample else open_shot(Path(given.shot), **reading)) as shot:
                    times = [float(each) for each in shot.scene.times[given.first :][: given.frames]]
                    now = solved(shot, PRESETS[name], times, raised=raised)
                seen = "" if below is None else f"{preview(below, now):.2f}"
                say(f"| {name} | {level} | {'raised' if raised else 'own'} | {now.row} | {seen} |")
                below = now


if __name__ == "__main__":
    main()
