"""Every public question of the solver, asked twice, gives the same answer: at once, in any order, around a solve."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import pytest
import torch
from bodies import ball
from cloth import DOWN, FABRIC, settings_of
from folds import crumpled, frame_with, named, square

from physgraph_usd.lab.chart.problem import judge
from physgraph_usd.solver.colliders.pose import Collider
from physgraph_usd.solver.contact.bodies import Touching
from physgraph_usd.solver.contact.frame import FrameContact, LevelContact
from physgraph_usd.solver.forces.base import ForceModule
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.frame.solve import solve_frame
from physgraph_usd.solver.frame.values import FrameInput
from physgraph_usd.solver.integrate.base import System
from physgraph_usd.solver.integrate.metric import Metric
from physgraph_usd.solver.level import Placed
from physgraph_usd.solver.scene import GarmentFrame, Scene

Cages = tuple[np.ndarray, ...]
STIFF = replace(FABRIC, stretch=3.0 * FABRIC.stretch, bend=5.0 * FABRIC.bend, density=2.0 * FABRIC.density)
SETTINGS = settings_of(steps=2)
OVER = np.array([0.0, 0.19, 0.0])


def tilted(points: np.ndarray) -> np.ndarray:
    """Through a level sheet from rim to rim."""
    return 0.9 * points + np.outer(0.6 * points[:, 0] + 0.2 * points[:, 2] + 0.01, [0.0, 1.0, 0.0]) + 0.0037


def beside(points: np.ndarray) -> np.ndarray:
    """Moved until it shares an edge with where it was."""
    return points + np.array([np.ptp(points[:, 0]), 0.0, 0.0])


SHEET = square(5)
SMOOTH, CRUMPLED, CROSSED, SEWN = "on a ball", "crumpled on a ball", "one through the other", "sewn on a ball"
SCENES: dict[str, tuple[Sequence[tuple[Any, np.ndarray]], Cages]] = {
    SMOOTH: ([(SHEET, SHEET[1])], (SHEET[1] + OVER,)),
    CRUMPLED: ([(SHEET, SHEET[1])], (crumpled(SHEET[1]) + OVER,)),
    CROSSED: ([(SHEET, SHEET[1])] * 2, (SHEET[1], tilted(SHEET[1]))),
    SEWN: ([(SHEET, SHEET[1])] * 2, (SHEET[1] + OVER, beside(SHEET[1]) + OVER)),
}
"""Rest shapes and cages [m]."""


class Asked:
    """A fresh solver, and what it is asked about: a frame, positions in it, and another frame."""

    def __init__(self, name: str) -> None:
        cloths, cages = SCENES[name]
        garments = tuple(replace(named(c, f"Sheet{i}"), colliders=(0,)) for i, (c, _) in enumerate(cloths))
        scene = Scene(garments, DOWN, (1.0, 2.0), (Collider("/World/Ball", "mesh"),))
        self.refiner = Refiner(scene, SETTINGS, levels=[1] * len(garments), dtype=torch.float64)
        self.frame = frame_with(cages, ball(), time=1.0)
        away = [1.02 * cage + 0.004 + 0.0006 * i for i, cage in enumerate(cages)]
        self.other = frame_with(away, ball(0.21), time=2.0, fabric=STIFF)
        upsampled = [chain[-1].linear @ cage for chain, cage in zip(self.refiner.refinements, cages, strict=True)]
        self.points = [each + 0.002 * np.sin(90.0 * each[:, [2, 0, 1]]) for each in upsampled]

        part = self.refiner.parts_of(self.frame)[0]
        self.group, self.frames = self.refiner.group_of(part), [self.frame.garments[i] for i in part]
        self.own = [self.points[i] for i in part]
        cage = np.concatenate([each.points for each in self.frames])
        self.x = torch.as_tensor(np.concatenate(self.own) - cage.mean(axis=0))
        self.y = self.x + 0.0015 * torch.cos(70.0 * self.x[:, [1, 2, 0]])

    @property
    def touching(self) -> tuple[Touching, ...]:
        """What the first group may touch."""
        return self.refiner.touching(self.refiner.parts_of(self.frame)[0], self.frame)

    @cached_property
    def contact(self) -> FrameContact:
        """The first group's contact, found once."""
        found = self.group.potential(self.frames, self.touching)[1]
        assert found is not None
        return found

    @property
    def view(self) -> LevelContact:
        """The same, of the finest level."""
        return self.contact.at(self.group.levels[-1])

    @cached_property
    def systems(self) -> list[System]:
        """The first group's systems, made once."""
        return self.group.systems(self.frames)[0]


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


def potential(a: Asked) -> Any:
    """The finest level's potential, contact included, and where its origin is."""
    module, contact, origin = a.group.potential(a.frames, a.touching)
    touched = () if contact is None else contact.at(a.group.levels[-1]).terms(a.x)[1]
    return ForceModule((*module.forces, *touched)).energies(a.x), origin


def solved(a: Asked) -> Any:
    """A cold frame."""
    a.refiner.forget()
    return a.refiner.solve(a.frame)


def forces(a: Asked) -> Any:
    """Energies of every level, at some positions."""
    pairs = zip(a.group.modules(a.frames)[0], a.group.levels, strict=True)
    return [module.energies(a.x[: level.vertex_count]) for module, level in pairs]


def descents(systems: Sequence[System], a: Asked) -> Any:
    """What an integrator sees of every level, at some positions."""
    found = []
    for level, system in zip(a.group.levels, systems, strict=True):
        x = a.x[: level.vertex_count]
        energy, force = system.energy_and_force(x)
        found.append((energy, force, system.diagonal(x), system.apply_metric_inverse(force)))
    return found


def metric(a: Asked, x: torch.Tensor) -> Any:
    """How what touches at x holds the cloth."""
    plain_metric = a.systems[-1].metric
    assert isinstance(plain_metric, Metric)
    return a.view.metric(plain_metric, a.view.terms(x)[1], x).solve(x)


QUESTIONS: dict[str, Callable[[Asked], Any]] = {
    "Refiner.parts_of": lambda a: a.refiner.parts_of(a.frame),
    "Refiner.touching": lambda a: [(each.path, each.offset) for each in a.touching],
    "Refiner.energy": lambda a: a.refiner.energy(a.frame, a.points),
    "Refiner.solve": solved,
    "judge": lambda a: judge(a.refiner, a.frame, a.points),
    "Group.energies": lambda a: a.group.energies(a.frames, a.own, a.touching),
    "Group.potential": potential,
    "Group.modules": forces,
    "Group.systems": lambda a: descents(a.group.systems(a.frames)[0], a),
    "Group.solve": lambda a: solve_frame(a.group, FrameInput(a.frames, touching=a.touching), None),
    "System": lambda a: descents(a.systems, a),
    "FrameContact.aim": lambda a: a.contact.aim,
    "FrameContact.crossed": lambda a: a.contact.crossed,
    "FrameContact.crowding": lambda a: a.contact.crowding,
    "FrameContact.finish": lambda a: a.contact.finish(Placed(a.x)),
    "FrameContact.measure": lambda a: a.contact.measure(a.x),
    "LevelContact.terms": lambda a: ForceModule(a.view.terms(a.x)[1]).energies(a.x),
    "LevelContact.terms elsewhere": lambda a: ForceModule(a.view.terms(a.y)[1]).energies(a.y),
    "LevelContact.crosses": lambda a: a.view.crosses(a.x),
    "LevelContact.closed": lambda a: a.view.closed(a.x),
    "LevelContact.comes_apart": lambda a: a.view.comes_apart(a.x, order=True),
    "LevelContact.moved": lambda a: a.view.moved(Placed(a.x), a.y),
    "LevelContact.drawn": lambda a: a.view.drawn(Placed(a.x), a.y),
    "LevelContact.out_of_bodies": lambda a: a.view.out_of_bodies(Placed(a.x)),
    "LevelContact.metric": lambda a: metric(a, a.x),
    "LevelContact.metric elsewhere": lambda a: metric(a, a.y),
}
ANY_ORDER = np.random.default_rng(1).permutation(list(QUESTIONS)).tolist()


@cache
def alone(scene: str, name: str) -> tuple[Any, Any]:
    """What a fresh solver answers that is asked nothing else, and what it answers then."""
    asked = Asked(scene)
    return plain(QUESTIONS[name](asked)), plain(QUESTIONS[name](asked))


def differing(asked: Asked, scene: str, names: Sequence[str]) -> list[str]:
    """Questions, asked one after another, whose answer is not what a fresh solver gives."""
    return [name for name in names if plain(QUESTIONS[name](asked)) != alone(scene, name)[0]]


@pytest.mark.parametrize("scene", SCENES)
def test_twice_in_a_row(scene: str):
    for name in QUESTIONS:
        first, again = alone(scene, name)
        assert first == again, name


@pytest.mark.parametrize("scene", SCENES)
def test_in_another_order(scene: str):
    assert not differing(Asked(scene), scene, ANY_ORDER)


@pytest.mark.parametrize("scene", SCENES)
def test_after_another_frame(scene: str):
    """Of other positions, materials and bodies; and after a frame that was solved by the paper's potential."""
    asked = Asked(scene)
    asked.refiner.solve(asked.other)
    assert not differing(asked, scene, list(QUESTIONS))
    asked.refiner.use(settings_of(potential="paper"))
    asked.refiner.energy(asked.frame, asked.points)
    asked.refiner.use(SETTINGS)
    assert not differing(asked, scene, list(QUESTIONS))


def test_contact_of_a_frame_while_another_is_looked_at():
    """A hierarchy serves all frames: here one in which two garments are sewn, and one in which they lie apart."""

    def view_of(asked: Asked, frames: Sequence[GarmentFrame]) -> tuple[LevelContact, torch.Tensor]:
        """Contact in a frame, and the upsampled cages moved together [m]."""
        finest, contact = asked.group.levels[-1], asked.group.potential(frames)[1]
        assert contact is not None
        x = finest.base.apply(asked.group.systems(frames)[1])
        x[len(x) // 2 :, 0] -= 0.0004
        return contact.at(finest), x

    def energies(view: LevelContact, x: torch.Tensor) -> dict[str, float]:
        return ForceModule(view.terms(x)[1]).energies(x)

    first, second, both = Asked(SEWN), Asked(SEWN), Asked(SEWN)
    alone = energies(*view_of(first, first.frames)), energies(*view_of(second, second.other.garments))
    views = view_of(both, both.frames), view_of(both, both.other.garments)
    assert tuple(energies(*view) for view in views) == alone
    assert tuple(energies(*view) for view in views) == alone
    assert alone[0] != alone[1]
