"""Poses that are held: cloth comes to rest."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from benchmarks.contact_shots import THREADS, open_one
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.scene import Frame

REST = 1e-4
"""Move of the farthest vertex from frame to frame that nobody sees [m]."""
DRIFT = np.array([1e-6, 0.0, 0.0])
"""Motion of the held cage a frame [m]: an equal frame would repeat the last result."""
LEAD, LAST = 3, 6
"""Frames before the held ones, and held frames at the end that are judged: the first ones may still settle."""


@dataclass(frozen=True)
class Moves:
    """Fine vertices; how far the farthest one moves in a frame [m], and how many by over 1 mm: means at the end."""

    vertices: int
    farthest: float
    many: float


def held(name: str, place: Path, *, level: int, frames: int = 15) -> Moves:
    """Refine a few frames of a sample in a row, then hold the pose of the last one but for a drift of its cage."""
    shot, at = open_one(name, place, None)
    times = shot.scene.times[max(at - LEAD, 0) : at + 1]
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
    garments = tuple(replace(each, points=each.points + count * DRIFT) for each in frame.garments)
    return replace(frame, time=None if frame.time is None else frame.time + count, garments=garments)


@pytest.mark.parametrize("name", ["hood", pytest.param("armpit", marks=pytest.mark.slow)])
def test_it_rests(name: str, tmp_path: Path):
    moves = held(name, tmp_path, level=1)
    assert moves.vertices > 1000
    assert moves.farthest < REST, moves


@pytest.mark.slow
@pytest.mark.parametrize("level", [1, 2])
def test_in_layers_it_rests(level: int, tmp_path: Path):
    """In sharp folds what passed through itself was mended, and did so again, for ever."""
    assert held("layers", tmp_path, level=level).farthest < REST


@pytest.mark.slow
def test_between_overlapping_parts_it_rests(tmp_path: Path):
    """A T-shirt whose arm has come down onto a torso that it overlaps; what crosses starts anew in the first frames."""
    moves = held("tshirt", tmp_path, level=2, frames=18)
    assert moves.many == 0, moves
    assert moves.farthest < REST, moves
