"""Systems with contact whose steps are recorded on CUDA: pairs and stiffness change from round to round in place."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import reduce

from ..contact.metric import HeldMetric
from ..forces.base import ForceModule
from ..forces.self_contact import PairConstraints, SelfContact
from ..integrate.base import System
from ..integrate.metric import Metric
from ..level import Level

ROOM = 4
"""Room for pairs is a power of this: few recordings, each used often."""


class TouchedSystems:
    """The lasting systems of one level with contact, by system without contact, room, and presence of stiffness."""

    def __init__(self, level: Level, system_in: Callable[..., System]) -> None:
        """Start without systems.

        Args:
            level: The level.
            system_in: Makes a system from a field and a metric, with options as for `System`.
        """
        self._level, self._system_in = level, system_in
        self._kept: dict[tuple[System, int, bool], tuple[System, SelfContact]] = {}

    def of(self, alone: System, touched: Sequence[SelfContact], metric: Metric | HeldMetric) -> System:
        """A system with contact terms, in the buffers of a lasting one; steps recorded for the latter serve again.

        Args:
            alone: The lasting system without contact.
            touched: The contact terms.
            metric: The metric of the level, or with contact stiffness.
        """
        field, gaps = alone.field, reduce(PairConstraints.with_more, (each.gaps for each in touched))
        assert isinstance(field, ForceModule)
        room = ROOM ** math.ceil(math.log(max(len(gaps.corners), ROOM), ROOM))
        key = alone, room, isinstance(metric, HeldMetric)
        if key not in self._kept:
            term = SelfContact(self._level, gaps.padded(room))
            own = metric.copied() if isinstance(metric, HeldMetric) else metric
            self._kept[key] = self._system_in(field.joined_by((term,)), own, lasting=True), term
        system, term = self._kept[key]
        term.renew(gaps)
        if isinstance(metric, HeldMetric) and isinstance(system.metric, HeldMetric):
            system.metric.renew(metric)
            system.renew(metric)
        return self._system_in(system.field, metric, recorded=system)
