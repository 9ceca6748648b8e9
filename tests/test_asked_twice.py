"""Every public question of the solver, asked twice, gives the same answer: at once, in any order, around a solve."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from bodies import ball
from cloth import DOWN, FABRIC, settings_of
from folds import Cloth, frame_with, named, square

from physgraph_usd.lab.chart.problem import judge
from physgraph_usd.solver.colliders.pose import Collider
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.scene import Scene

STIFF = replace(FABRIC, stretch=3.0 * FABRIC.stretch, bend=5.0 * FABRIC.bend, density=2.0 * FABRIC.density)
SETTINGS = settings_of(steps=2)
OVER = np.array([0.0, 0.19, 0.0])


def tilted(points: np.ndarray) -> np.ndarray:
    """Through a level sheet from rim to rim."""
    return 0.9 * points + np.outer(0.6 * points[:, 0] + 0.2 * points[:, 2] + 0.01, [0.0, 1.0, 0.0]) + 0.0037


def beside(points: np.ndarray) -> np.ndarray:
    """Moved until it shares an edge with where it was."""
    return points + np.array([np.ptp(points[:, 0]), 0.0, 0.0])


SHEET = square(3)
SCENES: dict[str, tuple[Sequence[Cloth], Sequence[np.ndarray]]] = {
    "one through the other": ([SHEET] * 2, [SHEET[1], tilted(SHEET[1])]),
    "sewn on a ball": ([SHEET] * 2, [SHEET[1] + OVER, beside(SHEET[1]) + OVER]),
}
"""Garments at rest and their cages [m]."""


class Asked:
    """A fresh solver, and what it is asked about: a frame, positions in it, and another frame."""

    def __init__(self, name: str) -> None:
        cloths, cages = SCENES[name]
        garments = tuple(replace(named(c, f"Sheet{i}"), colliders=(0,)) for i, c in enumerate(cloths))
        scene = Scene(garments, DOWN, (1.0, 2.0), (Collider("/World/Ball", "mesh"),))
        self.refiner = Refiner(scene, SETTINGS, levels=[1] * len(garments), dtype=torch.float64)
        self.frame = frame_with(cages, ball(), time=1.0)
        away = [1.02 * cage + 0.004 + 0.0006 * i for i, cage in enumerate(cages)]
        self.other = frame_with(away, ball(0.21), time=2.0, fabric=STIFF)
        upsampled = [chain[-1].linear @ cage for chain, cage in zip(self.refiner.refinements, cages, strict=True)]
        self.points = [each + 0.002 * np.sin(90.0 * each[:, [2, 0, 1]]) for each in upsampled]
        self.wanted = [each + 0.0015 * np.cos(70.0 * each[:, [1, 2, 0]]) for each in self.points]


def plain(answer: Any) -> Any:
    """An answer as values that compare to the bit, without what it took."""
    if isinstance(answer, torch.Tensor):
        return plain(answer.detach().cpu().numpy())
    if isinstance(answer, np.ndarray):
        return answer.shape, answer.tobytes()
    if isinstance(answer, Mapping):
        return {name: plain(value) for name, value in answer.items() if name != "milliseconds"}
    if isinstance(answer, (list, tuple)):
        return [plain(each) for each in answer]
    if is_dataclass(answer):
        return {each.name: plain(getattr(answer, each.name)) for each in fields(answer)}
    return answer


def solved(a: Asked) -> Any:
    a.refiner.forget()
    return a.refiner.solve(a.frame)


QUESTIONS: dict[str, Callable[[Asked], Any]] = {
    "parts_of": lambda a: a.refiner.parts_of(a.frame),
    "touching": lambda a: [(each.path, each.offset) for each in a.refiner.touching((0,), a.frame)],
    "energy": lambda a: a.refiner.energy(a.frame, a.points),
    "energy elsewhere": lambda a: a.refiner.energy(a.frame, a.wanted),
    "solve": solved,
    "judge": lambda a: judge(a.refiner, a.frame, a.points),
    "moved_safely": lambda a: a.refiner.moved_safely(a.frame, a.points, a.wanted),
}


@cache
def alone(scene: str, name: str) -> tuple[Any, Any]:
    """What a fresh solver answers that is asked nothing else, and what it answers then."""
    asked = Asked(scene)
    return plain(QUESTIONS[name](asked)), plain(QUESTIONS[name](asked))


def differing(asked: Asked, scene: str, names: Sequence[str]) -> list[str]:
    """Questions, asked one after another, whose answer is not what a fresh solver gives."""
    return [name for name in names if plain(QUESTIONS[name](asked)) != alone(scene, name)[0]]


@pytest.mark.parametrize("scene", SCENES)
class TestAnswers:
    def test_twice_in_a_row(self, scene: str):
        for name in QUESTIONS:
            first, again = alone(scene, name)
            assert first == again, name

    def test_after_another_frame(self, scene: str):
        """Of other positions, materials and bodies; and after one solved by other settings."""
        asked = Asked(scene)
        asked.refiner.solve(asked.other)
        assert not differing(asked, scene, list(QUESTIONS))
        asked.refiner.use(settings_of(temporal="off", steps=2))
        asked.refiner.energy(asked.frame, asked.points)
        asked.refiner.use(SETTINGS)
        assert not differing(asked, scene, list(QUESTIONS))
