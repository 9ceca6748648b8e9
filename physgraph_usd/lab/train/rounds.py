"""Rounds with contact to train on, recorded while our own solver refines generated scenes.

A round is a level's system with the near pairs found in it (planes of bodies, pairs of cloth), tied to the last frame's
detail in a warm frame, and the positions at which its steps start. All of it is plain arrays: rounds are made
in many processes and built again, many as one system, where they are needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import reduce

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...errors import PhysGraphError
from ...solver.contact.metric import HeldMetric
from ...solver.forces.base import Force, ForceModule
from ...solver.forces.guide import Guide
from ...solver.forces.self_contact import PairConstraints, SelfContact
from ...solver.forces.tether import Tether
from ...solver.frame.group import Group
from ...solver.frame.refiner import Refiner
from ...solver.frame.settings import SolveSettings
from ...solver.integrate import METHODS, Method
from ...solver.integrate.base import Carry, Integrator, System, resumed
from ...solver.integrate.descend import solve_level
from ...solver.integrate.metric import Metric
from ...solver.integrate.quasi_newton import QuasiNewton
from ...solver.integrate.stop import Budget
from ...solver.scene import Garment, GarmentFrame
from .patches import group_of, made_of_numbers
from .scenes import KINDS, Moving, moving_scene

STEPS = 12
"""Most steps of a level while rounds are recorded."""


@dataclass(frozen=True)
class RoundConfig:
    """Values of recorded rounds.

    Attributes:
        scenes: Number of scenes.
        held_out: Number of scenes to measure on.
        share: Fraction of iterations on rounds.
        reference_steps: Quasi-Newton steps behind the least energies known.
        most_vertices: Number of fine vertices beyond which a scene has a single subdivision, not two.
    """

    scenes: int = 0
    held_out: int = 0
    share: float = 0.5
    reference_steps: int = 80
    most_vertices: int = 4000


@dataclass(frozen=True, eq=False)
class Round:
    """A round of the finest level of garments solved together, from the integrator's view.

    Attributes:
        words: Name for logs.
        garments: Cages, all with the same number of subdivisions.
        frames: Materials of the garments.
        gravity: [m/s^2], shape (3,).
        aim: The cage that the cloth follows, recentred [m], shape (C, 3).
        pairs: The fields of `PairConstraints`, of cloth and bodies; empty without contact.
        tie: Stiffness [1/s^2] of the tether; 0 without a tether.
        predicted: Positions tied to [m], shape (V, 3); the start without a tether.
        stiff: K of the metric [N/m], shape (V,).
        x: Positions at the start of the steps [m], shape (V, 3).
        start: Energy at the start [J].
        least: Least energy known [J].
    """

    words: str
    garments: tuple[Garment, ...]
    frames: tuple[GarmentFrame, ...]
    gravity: np.ndarray
    aim: np.ndarray
    pairs: tuple[np.ndarray, ...]
    tie: float
    predicted: np.ndarray
    stiff: np.ndarray
    x: np.ndarray
    start: float = 0.0
    least: float = 0.0

    @property
    def level(self) -> int:
        """Subdivisions of the cages."""
        return self.garments[0].level

    @property
    def touches(self) -> bool:
        """Whether something is near."""
        return bool(self.pairs)


class Watch:
    """An integrator that records the system and the start of each round."""

    def __init__(self, inner: Integrator) -> None:
        """Wrap the stepping integrator."""
        self.name, self._inner = inner.name, inner
        self.seen: list[tuple[System, Tensor]] = []

    def start(self, system: System, x: Float[Tensor, "vertices 3"]) -> Carry:
        """The inner integrator's start, recorded."""
        self.seen.append((system, x.clone()))
        return self._inner.start(system, x)

    def resume(self, system: System, carry: Carry) -> Carry:
        """The inner integrator's resumed carry, recorded."""
        self.seen.append((system, carry.x.clone()))
        return resumed(self._inner, system, carry)

    def step(self, system: System, carry: Carry) -> Carry:
        """The inner integrator's step."""
        return self._inner.step(system, carry)


def _rounds_of(moving: Moving, method: str) -> list[Round]:
    """The rounds of a scene's frames in order, solved by a method; only of the garments' finest levels."""
    watch = Watch(METHODS[method].build())
    refiner = Refiner(moving.scene, SolveSettings(Method(lambda: watch, nested=True), steps=STEPS))
    rounds = []
    for number, frame in enumerate(moving.frames):
        watch.seen.clear()
        refiner.solve(frame)
        for part in refiner.parts_of(frame):
            group, frames = refiner.group_of(part), [frame.garments[index] for index in part]
            finest = group.levels[-1].index, group.levels[-1].vertex_count
            finest_seen = [(s, x) for s, x in watch.seen if s.level and (s.level.index, s.level.vertex_count) == finest]
            for place, (system, x) in enumerate(finest_seen):
                rounds.append(_noted(f"{moving.words}, frame {number}, round {place}", group, frames, system, x))
    return rounds


def _noted(words: str, group: Group, frames: Sequence[GarmentFrame], system: System, x: Tensor) -> Round:
    field = system.field
    assert isinstance(field, ForceModule)
    gaps, tie, predicted, aim = list[PairConstraints](), 0.0, x, None
    for term in field.forces:
        if isinstance(term, SelfContact):
            gaps.append(term.gaps)
        elif isinstance(term, Tether):
            tie, predicted = term.stiffness, term.predicted
        elif isinstance(term, Guide):
            aim = term.coarse
    assert aim is not None
    stiff = system.metric.stiff if isinstance(system.metric, HeldMetric) else torch.zeros_like(x[:, 0])
    plain = [replace(garment, level=len(group.levels) - 1) for garment in group.garments]
    predicted, stiff, x = (tensor.clone() for tensor in (predicted, stiff, x))
    gap_pairs = reduce(PairConstraints.with_more, gaps) if gaps else None
    pairs = () if gap_pairs is None else tuple(getattr(gap_pairs, each.name).numpy() for each in fields(gap_pairs))
    description = (words, tuple(plain), tuple(frames), group.gravity, aim.clone().numpy())
    return Round(*description, pairs, float(tie), predicted.numpy(), stiff.numpy(), x.numpy())


def system_of(rounds: Sequence[Round], *, device: str) -> System:
    """One system of rounds of equally many levels under the same gravity."""
    garments = [garment for round_ in rounds for garment in round_.garments]
    frames = [frame for round_ in rounds for frame in round_.frames]
    group = group_of(garments, rounds[0].gravity, rounds[0].level, device=device)
    lasting, level = group.forces_for(frames)[-1], group.levels[-1]

    def joined(arrays: Sequence[np.ndarray]) -> Tensor:
        return torch.as_tensor(np.concatenate(arrays), device=device)

    starts = np.cumsum([0, *(len(round_.x) for round_ in rounds)])[:-1].astype(np.int32)
    forces: list[Force] = [*lasting.terms, lasting.guide.retarget(joined([round_.aim for round_ in rounds]))]
    if any(round_.tie for round_ in rounds):
        ties = torch.tensor([round_.tie for round_ in rounds for _ in round_.garments], device=device)
        forces.append(Tether(level, lasting.density * ties, 1.0, joined([round_.predicted for round_ in rounds])))
    paired = [(round_, start) for round_, start in zip(rounds, starts, strict=True) if round_.pairs]
    if paired:
        shifted = [(round_.pairs[0] + start, *round_.pairs[1:]) for round_, start in paired]
        forces.append(SelfContact(level, PairConstraints(*map(joined, zip(*shifted, strict=True)))))
    stiff, metric = joined([round_.stiff for round_ in rounds]), lasting.metric
    assert isinstance(metric, Metric)
    held = HeldMetric(metric, stiff) if bool((stiff > 0).any()) else metric
    return System(ForceModule(forces), held, free=level.free, spacing=level.spacing, level=level)


def _measured(each: Round, steps: int) -> Round | None:
    """The round with its energies [J] at the start and after ``steps`` quasi-Newton steps; None at rest."""
    system, x = system_of([each], device="cpu"), torch.as_tensor(each.x)
    _, report = solve_level(system, QuasiNewton(), x, level=0, budget=Budget(steps))
    drop = report.energy_before - report.energy_after
    if not (np.isfinite(drop) and drop > 1e-4 * abs(report.energy_after) + 1e-12):
        return None
    return replace(each, start=report.energy_before, least=report.energy_after)


def make_rounds(config: RoundConfig, *, seed: int, workers: int = 1) -> list[Round]:
    """Rounds of scenes out of `scenes`, a few of each; the same for a seed with any number of processes."""
    made = made_of_numbers(_scene_rounds, config, seed, config.scenes, workers=workers)
    return [round_ for rounds in made for round_ in rounds]


def _scene_rounds(config: RoundConfig, seed: int, number: int) -> list[Round]:
    """Rounds of the scene of a number: of the first frame and of warm frames."""
    rng = np.random.default_rng([seed, number])
    kind = KINDS[number % len(KINDS)]
    moving = moving_scene(rng, kind=kind, frames=3, most_vertices=config.most_vertices)
    method = "quasi-newton" if rng.random() < 0.5 else "physgraph"
    try:
        rounds = _rounds_of(moving, method)
    except PhysGraphError:  # Cloth that starts wholly in a body.
        return []
    chosen = sorted(rng.permutation(len(rounds))[:4]) if len(rounds) > 4 else range(len(rounds))
    return [
        measured for number in chosen if (measured := _measured(rounds[number], config.reference_steps)) is not None
    ]
