"""One frame of a group, ready to be solved: cage, contact, start, and levels."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..contact.bodies import Touching
from ..contact.cloth import LevelContact
from ..contact.frame import FrameContact
from ..contact.metric import HeldMetric
from ..forces.base import ForceModule
from ..forces.limit import Limit
from ..forces.seam import SewnForces
from ..forces.self_contact import SelfContact
from ..integrate.base import Integrator, System, Transporting
from ..integrate.metric import Metric
from ..integrate.stop import Budget
from ..level import Level, Placed
from ..scene import GarmentFrame
from .group import Cage, Group
from .level_forces import LevelForces
from .limits import limit_of
from .start import Start, start_of
from .state import State


@dataclass(frozen=True, eq=False)
class LevelProblem:
    """One level of a frame.

    Attributes:
        lasting: Terms that last as long as the materials.
        module: All terms without contact.
        without_contact: The system without contact, tied to the start in a warm frame.
        integrator: Makes the steps.
        untangler: Makes the steps to pull crossings apart.
        budget: Stopping criteria.
        outward: As in `leave_saddle`.
        show: Called with the positions after each round [m]; or None.
        curvature: The last frame's integrator memory, transported to this frame; or None.
        limit: Limits of the distance to the subdivided cage; None without.
    """

    lasting: LevelForces
    module: ForceModule
    without_contact: System
    view: LevelContact | None
    integrator: Integrator
    untangler: Integrator
    budget: Budget
    outward: Float[Tensor, " garments"]
    show: Callable[[Placed], None] | None = None
    curvature: Any = None
    limit: Limit | None = None

    @property
    def level(self) -> Level:
        """The level itself."""
        return self.lasting.level

    def held(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """Positions moved out to the backstop [m], x itself if none is behind."""
        return x if self.limit is None else self.limit.in_front(x)

    def system(
        self,
        view: LevelContact,
        touched: Sequence[SelfContact],
        x: Float[Tensor, "vertices 3"],
        *,
        last: System | None = None,
    ) -> System:
        """The system with contact terms.

        Args:
            view: Contact of the cloth, as detected at x.
            touched: The contact terms.
            x: Positions used to weigh the contact terms [m].
            last: The last round's system, whose metric may be reused.
        """
        if not touched and view.seam is None:
            return self.without_contact
        field, metric = self.without_contact.field, self.without_contact.metric
        assert isinstance(field, ForceModule)
        assert isinstance(metric, Metric)
        preconditioner = metric if view.seam is None else metric.merged(view.seam.label)
        if touched:
            stiff = 3.0 * torch.stack([term.diagonal(x) for term in touched]).sum(dim=0)
            last_metric = None if last is None or view.look(x).hopeful.count else last.metric
            preconditioner = HeldMetric.of(preconditioner, stiff, last_metric)
        joined = field.joined_by(touched)
        return self.lasting.system_in(joined if view.seam is None else SewnForces(joined, view.seam), preconditioner)


@dataclass(frozen=True, eq=False)
class Problem:
    """One frame, ready to be solved; all positions are relative to the cages' mean.

    Attributes:
        began: Start of the frame's computation [s].
        frames: The garments at this time code.
        at: The time code, for errors; None without one.
        touching: Surfaces within reach of the garments.
        last: The cloth after the last frame; None for a cold start.
        prerolled: Cages advanced from an earlier frame [m], for a cold start; or None.
        forces: The lasting terms of each level, coarsest first.
        tether: Stiffness of the tie to the start [1/s^2]; None without tie.
    """

    began: float
    group: Group
    frames: Sequence[GarmentFrame]
    at: float | None
    touching: Sequence[Touching]
    cage: Cage
    last: State | None
    prerolled: Float[Tensor, "coarse 3"] | None
    forces: Sequence[LevelForces]
    contact: FrameContact | None
    start: Start
    tether: float | None

    @property
    def aim(self) -> Float[Tensor, "coarse 3"]:
        """The cage followed by the fine cloth [m]."""
        return self.cage.points if self.contact is None else self.contact.aim

    @property
    def warm(self) -> bool:
        """Whether the cloth starts with the last frame's detail."""
        return self.start.detailed is not None

    @property
    def crossed(self) -> bool:
        """Whether the cage crosses itself."""
        return self.contact is not None and self.contact.crossed

    @property
    def hopeless(self) -> bool:
        """Whether all cloth is given up: it is not solved, and follows the subdivided cage."""
        given_up = None if self.contact is None else self.contact.given_up
        return given_up is not None and bool(given_up.all())

    @property
    def subdivided(self) -> Placed:
        """The subdivided cage at the finest level [m]."""
        x = self.forces[-1].level.smooth_base.apply(self.cage.points)
        view = self.view(self.finest)
        return Placed(x if view is None else view.closed(x))

    @property
    def module(self) -> ForceModule:
        """All terms of the frame at the finest level, without contact."""
        return self.forces[-1].module(self.aim, self.frames)

    @cached_property
    def carried(self) -> Float[Tensor, "vertices 3"]:
        """The finest vertices with the last frame's detail, moved from their last positions as far as allowed [m]."""
        view, warm, limit = self.view(self.finest), self.start.detailed, self.limit(self.finest)
        assert warm is not None
        warm = warm if limit is None else limit.in_front(warm)
        if view is None or self.last is None:
            return warm
        return view.carried(self.before, warm, self.last.inside if bool(self.last.inside.any()) else None)

    @cached_property
    def before(self) -> Placed:
        """Fine positions after the last frame [m], float64; always the same tensor, by which contact knows them."""
        assert self.last is not None
        return self.last.about(self.cage.origin)[1]

    @property
    def _first_cage(self) -> Float[Tensor, "coarse 3"]:
        """Start of the cage's level [m]: advanced from an earlier frame, or untangled."""
        if self.prerolled is not None:
            return self.prerolled
        return self.aim if self.contact is None else self.contact.untangled

    @property
    def finest(self) -> int:
        """Number of the finest level, equal to the number of subdivisions."""
        return len(self.forces) - 1

    def view(self, index: int) -> LevelContact | None:
        """Contact of a level's cloth."""
        return None if self.contact is None else self.contact.at(self.forces[index].level)

    def limit(self, index: int) -> Limit | None:
        """Limits of a level's cloth; None without."""
        if index not in self._limits:
            arguments = self.forces[index], self.frames, self.cage.points
            self._limits[index] = limit_of(*arguments, outward=self.group.outward, view=self.view(index))
        return self._limits[index]

    @cached_property
    def _limits(self) -> dict[int, Limit | None]:
        """Results of `limit`."""
        return {}

    @property
    def levels(self) -> range:
        """Numbers of the levels to solve: all in a cold frame if nested or with crossings to untangle."""
        from_cage = not self.warm and (self.group.settings.method.nested or self.crossed)
        return range(0 if from_cage else self.finest, self.finest + 1)

    def level(self, index: int, *, start_time: float) -> LevelProblem:
        """One level.

        Args:
            index: Number of the level.
            start_time: Time at which the frame was ready to be solved [s].
        """
        lasting, settings, limit = self.forces[index], self.group.settings, self.limit(index)
        module = lasting.module(self.aim, self.frames)
        module = module if limit is None else module.joined_by([limit])
        tie = None if self.tether is None or self.start.detailed is None else (self.tether, self.start.detailed)
        without_contact = lasting.system(module, tie, rough=settings.rough)
        budget = settings.budget(self.finest - index, start_time, warm=self.warm)
        budget = replace(budget, steps=0) if self.start.rests else budget
        return LevelProblem(
            lasting,
            module,
            without_contact,
            self.view(index),
            self.group.integrator,
            self.group.untangler,
            budget,
            self.group.outward,
            curvature=self._curvature if index == self.finest else None,
            limit=limit,
        )

    @property
    def _curvature(self) -> Any:
        """The last frame's integrator memory, transported to this frame; None for cold starts and changed garments."""
        curvature = None if self.last is None else self.last.curvature
        rotation, integrator = self.start.rotation, self.group.integrator
        if curvature is None or rotation is None or self.start.rests or curvature.vertices != len(rotation):
            return None
        if not np.array_equal(curvature.turn, np.eye(3)):
            rotation = rotation @ torch.as_tensor(curvature.turn).to(rotation)
        return integrator.transported(curvature.memory, rotation) if isinstance(integrator, Transporting) else None

    def placed(self, x: Placed) -> Float[np.ndarray, "vertices 3"]:
        """World positions [m] of the finest level's vertices, given those about the cages' mean."""
        return self.group.followers.placed(x, self.cage.origin, self.cage.world)

    def level_start(
        self, index: int, below: Float[Tensor, "below 3"] | None
    ) -> tuple[Float[Tensor, "vertices 3"], Float[Tensor, "vertices 3"] | None]:
        """Start of a level [m], and the move to remove a coarser mesh's facets; None in a warm frame.

        Args:
            index: Number of the level.
            below: Positions of the next coarser level [m]; None for the first level.
        """
        level = self.forces[index].level
        view, warm = self.view(index), self.start.detailed
        if warm is not None:
            return self.carried, None
        linear, smooth = level.from_below, level.smooth_from_below
        first = below is None
        if below is None:  # Only the cage level starts from the advanced cages.
            below = self.aim if index else self._first_cage
        if first or linear is None or smooth is None:
            linear, smooth = level.base, level.smooth_base
        x = linear.apply(below)
        smoothing = self.forces[index].without_facets(x, below, smooth)
        if view is not None and not first and level.flat_from_below is not None and view.look(x).crossings.count:
            flat = level.flat_from_below.apply(below)
            x, smoothing = flat, x + smoothing - flat
        return x, smoothing


def begin(
    group: Group,
    frames: Sequence[GarmentFrame],
    last: State | None = None,
    *,
    at: float | None = None,
    touching: Sequence[Touching] = (),
    moved: float = np.inf,
    elapsed: float = 0.0,
    prerolled: Float[np.ndarray, "coarse 3"] | None = None,
    given_up: Bool[Tensor, " coarse"] | None = None,
) -> Problem:
    """Prepare a frame for solving.

    Args:
        group: Garments solved together.
        frames: The garments at this time code.
        last: The cloth after the last frame; None for a cold start.
        at: The time code, for errors.
        touching: Surfaces within reach of the garments.
        moved: Largest motion of the surfaces since the last frame [m]; infinite if more than poses changed.
        elapsed: Time since the last frame [s]; 0 for 1/24 s.
        prerolled: World positions of cages advanced from an earlier frame [m], for a cold start; or None.
        given_up: As in `State`, for a start from the cage.
    """
    began, settings = time.perf_counter(), group.settings
    last = None if settings.temporal == "off" else last
    forces, cage = group.forces_for(frames), group.cage(frames)
    contact = group.contact(frames, cage, touching=touching, given_up=given_up if last is None else last.given_up)
    start = Start("cold")
    if last is not None:
        if settings.temporal != "tether":  # Only the tether slows the cloth down.
            moved = np.inf
        start = start_of(last, cage, group.moving_frames, reset=settings.reset, moved=moved)
    problem = Problem(
        began,
        group,
        frames,
        at,
        touching,
        cage,
        last,
        None if prerolled is None else group.tensor(prerolled - cage.origin),
        forces,
        contact,
        start,
        tether=start.slowed * settings.tether / (elapsed or 1.0 / 24.0) ** 2 if settings.temporal == "tether" else None,
    )
    if contact is not None and last is not None and last.clean:
        contact.at(group.levels[-1]).remember(problem.before)
    return problem
