"""What one broken frame leaves behind: how far cloth is from a run without it, in the frames that follow.

    python -m benchmarks.glitches [--level 2] [--after 6] [--only NAME]

A sheet of 0.6 m lies over a ball, held or with folds that travel round it. In one frame the ball is scaled or shifted,
or the cage turned inside out, put into one point or made a hundred times its size. Prints a row a glitch: the largest
distance of a vertex from the run without it in each frame after the broken one [mm], the energy in the last of them
over that of the clean run, and how the frame after the broken one started.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import click
import numpy as np

from physgraph_usd.errors import PhysGraphError
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.colliders.pose import MeshPose
from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.scene import Frame, GarmentFrame

from .sheet_over_ball import SheetOverBall

BEFORE = 5
"""Clean frames before the broken one."""
SHEET = SheetOverBall(side=24, edge=0.025, radius=0.15)
DRIFT = np.array([1e-6, 0.0, 0.0])
"""Of a held cage, a frame [m]: equal frames would be taken over as they are."""
Glitch = Callable[[Frame], Frame]


def _cage(change: Callable[[np.ndarray], np.ndarray]) -> Glitch:
    def broken(frame: Frame) -> Frame:
        return replace(frame, garments=tuple(replace(each, points=change(each.points)) for each in frame.garments))

    return broken


def _ball(change: Callable[[np.ndarray], np.ndarray]) -> Glitch:
    def broken(frame: Frame) -> Frame:
        poses = [MeshPose(change(p.points), p.triangles) for p in frame.colliders if isinstance(p, MeshPose)]
        return replace(frame, colliders=tuple(poses))

    return broken


def _scaled(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda points: points.mean(axis=0) + factor * (points - points.mean(axis=0))


GLITCHES: dict[str, Glitch] = {
    "ball eight times its size": _ball(_scaled(8.0)),
    "ball four times its size": _ball(_scaled(4.0)),
    "ball 10 cm higher": _ball(lambda points: points + np.array([0.0, 0.1, 0.0])),
    "ball gone to one point": _ball(_scaled(0.0)),
    "cage inside out": _cage(lambda points: points * np.array([1.0, -1.0, 1.0])),
    "cage in one point": _cage(_scaled(0.0)),
    "cage a hundred times its size": _cage(_scaled(100.0)),
    "cage 10 cm aside": _cage(lambda points: points + np.array([0.1, 0.0, 0.0])),
}
"""What happens to the broken frame."""


@click.command()
@click.option("--level", default=2, show_default=True)
@click.option("--after", default=6, show_default=True, help="Frames after the broken one.")
@click.option("--only", "names", multiple=True, help="Only these glitches.")
def main(level: int, after: int, names: Sequence[str]) -> None:
    """Print the tables."""
    prepare_device("cpu")
    for travel, what in ((0.0, "held"), (0.03, "folds travel")):
        clean = [*run(level, after, travel=travel)]
        click.echo(
            f"\n{what}: {len(clean[-1][0])} fine vertices\n\n| glitch | mm after 1, 2, ... frames | energy | start |"
        )
        click.echo("|---|---|---|---|")
        for name, glitch in GLITCHES.items():
            if names and not any(each in name for each in names):
                continue
            told = [*run(level, after, travel=travel, glitch=glitch)]
            pairs = zip(told[BEFORE + 1 :], clean[BEFORE + 1 :], strict=True)
            off = [1e3 * np.linalg.norm(a[0] - b[0], axis=1).max() for a, b in pairs]
            energies = [sum(each[-1][1]["energy_joules"]["output"].values()) for each in (told, clean)]
            far = ", ".join(f"{each:.2g}" for each in off)
            click.echo(f"| {name} | {far} | {energies[0] / energies[1]:.3f} | {told[BEFORE + 1][1]['start']} |")


def run(
    level: int, after: int, *, travel: float, glitch: Glitch | None = None, at: int = BEFORE, first: int = 0
) -> list[tuple[np.ndarray, dict[str, Any]]]:
    """Refine all frames in order.

    Args:
        level: Subdivisions.
        after: Frames after the broken one.
        travel: Angle by which folds travel in a frame [rad].
        glitch: What breaks one frame, or None.
        at: Which frame that is.
        first: The first frame that is solved.

    Returns:
        Fine positions [m], shape (V, 3), and telemetry of each frame; where it failed those of the frame before.
    """
    scene, ball = SHEET.scene(subdivisions=4)
    refiner = Refiner(scene, RefineOptions().solve_settings(), levels=[level], threads=2)
    told: list[tuple[np.ndarray, dict[str, Any]]] = []
    for index in range(first, at + 1 + after):
        points = SHEET.draped(0.002, travel * index) + index * DRIFT
        frame = Frame(float(index), (GarmentFrame(points, PRESETS["jersey"]),), (ball,))
        frame = glitch(frame) if glitch is not None and index == at else frame
        try:
            state = refiner.solve(frame)
        except PhysGraphError:
            told.append(told[-1] if told else (points, {}))
            continue
        assert state.points[0] is not None
        told.append((state.points[0], dict(state.telemetry[0])))
    return told


if __name__ == "__main__":
    main()
