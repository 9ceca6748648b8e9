"""Whether cloth comes to rest in a pose that is held: how far it still moves from frame to frame.

    python -m benchmarks.held_pose [--level 1] [--frames 15] [--lead 3] [--shot tshirt] [FOLDER]

Refines a few frames of a shot in a row, up to the first one of `contact_shots`, then holds that one's bodies and
cage, but for a drift of a micrometre a frame: equal frames would be taken over as they are. Prints a row a shot: the
farthest move of a vertex, and how many move by more than a millimetre, as means over the last six frames.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import click
import numpy as np

from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.scene import Frame

from .contact_shots import REAL, SAMPLES, THREADS, open_one

DRIFT = np.array([1e-6, 0.0, 0.0])
"""Of the cage, a frame [m]."""
LAST = 6
"""Held frames at the end whose moves are told: the first ones may still settle."""


@click.command()
@click.argument("folder", required=False, type=click.Path(path_type=Path))
@click.option("--level", default=1, show_default=True)
@click.option("--frames", default=15, show_default=True, help="Held frames.")
@click.option("--lead", default=3, show_default=True, help="Frames before them.")
@click.option("--shot", "shots", multiple=True, help="Only these.")
def main(folder: Path | None, level: int, frames: int, lead: int, shots: Sequence[str]) -> None:
    """Print the table."""
    prepare_device("cpu")
    click.echo(f"level {level}, {frames} held frames, means of the last {LAST}")
    click.echo("| shot | vertices | farthest move mm | over 1 mm |")
    click.echo("|---|---|---|---|")
    with tempfile.TemporaryDirectory() as place:
        for name in [*SAMPLES, *(REAL if folder else ())]:
            if shots and not any(each in name for each in shots):
                continue
            moves = held(name, Path(place), folder, level=level, frames=frames, lead=lead)
            said = f"{moves.vertices} | {1e3 * moves.farthest:.2g} | {moves.many:.0f}"
            click.echo(f"| {Path(name).parts[0].split('.')[0]} | {said} |")


@dataclass(frozen=True)
class Moves:
    """How cloth moves from frame to frame at the end.

    Attributes:
        vertices: Fine vertices.
        farthest: Move of the vertex that moves farthest [m], mean over frames.
        many: Vertices that move by more than a millimetre, mean over frames.
    """

    vertices: int
    farthest: float
    many: float


def held(name: str, place: Path, folder: Path | None = None, *, level: int, frames: int = 15, lead: int = 3) -> Moves:
    """Hold one shot's pose.

    Args:
        name: A sample, or a real shot.
        place: Where a sample is written.
        folder: Where real shots lie.
        level: Subdivisions.
        frames: Held frames.
        lead: Frames before them.
    """
    shot, at = open_one(name, place, folder)
    times = shot.scene.times[max(at - lead, 0) : at + 1]
    settings = RefineOptions().solve_settings()
    refiner = Refiner(shot.scene, settings, levels=[level] * len(shot.scene.garments), device="cpu", threads=THREADS)
    given = [shot.frame(time) for time in times]
    given += [_held(given[-1], count) for count in range(1, frames + 1)]
    solved = [refiner.solve(frame).points for frame in given][-LAST - 1 :]
    points = [np.concatenate([each for each in garments if each is not None]) for garments in solved]
    moves = [np.linalg.norm(after - before, axis=1) for before, after in pairwise(points)]
    farthest = float(np.mean([each.max() for each in moves]))
    return Moves(len(points[0]), farthest, float(np.mean([np.count_nonzero(each > 1e-3) for each in moves])))


def _held(frame: Frame, count: int) -> Frame:
    """A frame again, some frames later."""
    garments = tuple(replace(each, points=each.points + count * DRIFT) for each in frame.garments)
    return replace(frame, time=None if frame.time is None else frame.time + count, garments=garments)


if __name__ == "__main__":
    main()
