"""Measurements on patches and rounds that a training does not see."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from ...solver.integrate.base import Integrator, System
from ...solver.integrate.guard import Guard
from ...solver.integrate.quasi_newton import QuasiNewton
from .bundle import unrolled
from .patches import Patch
from .rounds import Round, system_of

SCHEDULES = ((5, 5, 5), (10, 10, 5))
"""Steps a level at which held-out patches are measured."""
EVALUATIONS = (4, 12)
"""Force evaluations after which held-out rounds are measured: a round has four steps."""


class HeldOut:
    """Patches and rounds to measure on, and the gaps of quasi-Newton there."""

    def __init__(self, patches: Sequence[Patch], rounds: Sequence[Round]) -> None:
        """Build the systems of the rounds; quasi-Newton is measured when it is first needed."""
        self._patches, self._rounds = patches, [(round_, system_of([round_], device="cpu")) for round_ in rounds]
        self._known: dict[str, list[float]] = {}

    def ratios(self, integrator: Integrator) -> dict[str, float]:
        """Gap over that of quasi-Newton at as many evaluations, geometric mean over patches and over rounds."""
        table = {}
        for schedule in SCHEDULES if self._patches else ():
            table[str(schedule)] = self._ratio(str(schedule), integrator, self._patches, schedule)
        for most in EVALUATIONS:
            for name, touches in (("contact", True), ("warm", False)):
                matching = [case for case in self._rounds if case[0].touches == touches]
                if matching:
                    table[f"{name}, {most}"] = self._ratio(f"{name}, {most}", Guard(integrator), matching, most)
        return table

    def _ratio(self, name: str, ours: Integrator, cases: Sequence[Any], steps: Any) -> float:
        if name not in self._known:
            self._known[name] = self._gaps(QuasiNewton(), cases, steps)
        pairs = zip(self._gaps(ours, cases, steps), self._known[name], strict=True)
        logs = [math.log(max(mine, 1e-3) / max(theirs, 1e-3)) for mine, theirs in pairs]
        return round(math.exp(float(np.mean(logs))), 4)

    def _gaps(self, integrator: Integrator, cases: Sequence[Any], steps: Any) -> list[float]:
        if cases is self._patches:
            return [nested_gap(case, integrator, steps) for case in cases]
        return [_round_gap(round_, system, integrator, steps) for round_, system in cases]


def nested_gap(patch: Patch, integrator: Integrator, steps: Sequence[int]) -> float:
    """Gap at the finest level after so many steps a level, the last entries for the finest levels."""
    x = torch.as_tensor(patch.raw[0])
    energy = math.inf
    counts = steps[-len(patch.systems) :] if len(patch.systems) <= len(steps) else (steps[0], *steps)
    with torch.no_grad():
        for index, count in enumerate(counts):
            level, system = patch.group.levels[index], patch.systems[index]
            x = x if level.from_below is None else level.from_below.apply(x)
            carry = unrolled(integrator, system, integrator.start(system, x), count)
            x, energy = carry.x, carry.energy
    gap = (energy - patch.least[-1]) / (patch.start[-1] - patch.least[-1])
    return gap if math.isfinite(gap) else 1e6


def _round_gap(each: Round, system: System, integrator: Integrator, evaluations: int) -> float:
    """Gap of a round after a number of force evaluations; the evaluation at the start is not counted."""
    before = system.evaluations
    carry = integrator.start(system, torch.as_tensor(each.x))
    while system.evaluations - before <= evaluations and carry.mover != "stayed":
        carry = integrator.step(system, carry)
    gap = (carry.energy - each.least) / (each.start - each.least)
    return gap if math.isfinite(gap) else 1e6
