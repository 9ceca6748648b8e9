"""One frame of a group, ready to be solved: cage, contact, start, and levels."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

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
from .group import Group
from .level_forces import LevelForces
from .limits import limit_of
from .start import Start, start_of
from .values import Cage, Curvature, FrameInput, FrameState


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
        aim: The cage followed by the fine cloth [m].
        forces: The lasting terms of each level, coarsest first.
        prerolled: Cages advanced from an earlier frame [m], for a cold start; or None.
        before: Fine positions in the last frame [m], float64; None without a last frame.
        inside: Mask of the vertices inside a body in the last frame; None if none was.
        tether: Stiffness of the tie to the start [1/s^2]; None without tie.
        last_curvature: Curvature learned in the last frame, or None.
        following: As in `FrameState`, after the last frame, shape (C,).
    """

    began: float
    group: Group
    frame: FrameInput
    cage: Cage
    aim: Float[Tensor, "coarse 3"]
    forces: Sequence[LevelForces]
    contact: FrameContact | None
    start: Start
    prerolled: Float[Tensor, "coarse 3"] | None
    before: Placed | None
    inside: Bool[Tensor, " vertices"] | None
    tether: float | None
    last_curvature: Curvature | None
    following: Int[Tensor, " coarse"]

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
        return self.forces[-1].module(self.aim, self.frame.garments)

    @cached_property
    def carried(self) -> Float[Tensor, "vertices 3"]:
        """The finest vertices with the last frame's detail, moved from their last positions as far as allowed [m]."""
        view, warm, limit = self.view(self.finest), self.start.detailed, self.limit(self.finest)
        assert warm is not None
        warm = warm if limit is None else limit.in_front(warm)
        if view is None or self.before is None:
            return warm
        return view.carried(self.before, warm, self.inside)

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
            arguments = self.forces[index], self.frame.garments, self.cage.points
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
        module = lasting.module(self.aim, self.frame.garments)
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
        curvature, rotation, integrator = self.last_curvature, self.start.rotation, self.group.integrator
        if curvature is None or rotation is None or self.start.rests or curvature.vertices != len(rotation):
            return None
        if not np.array_equal(curvature.turn, np.eye(3)):
            rotation = rotation @ torch.as_tensor(curvature.turn).to(rotation)
        return integrator.transported(curvature.memory, rotation) if isinstance(integrator, Transporting) else None

    def placed(self, x: Placed) -> list[np.ndarray]:
        """World positions of each garment [m], given those of the finest level."""
        group = self.group
        points = group.followers.placed(x, self.cage.origin, self.cage.world)
        return [points[span] for span in group.levels[-1].spans]

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


def begin(group: Group, frame: FrameInput, last: FrameState | None) -> Problem:
    """Prepare a frame for solving.

    Args:
        last: State left by the last frame, or None for a cold start.
    """
    began = time.perf_counter()
    forces, cage, settings = group.forces_for(frame.garments), group.cage(frame.garments), group.settings
    history = None if settings.temporal == "off" else last
    last_positions = None if last is None else last.about(cage.origin)
    before = None if last_positions is None else last_positions[1]
    moved = frame.moved if settings.temporal == "tether" else np.inf  # Only the tether slows the cloth down.
    start = Start("cold")
    if history is not None and last_positions is not None:
        frames, reset = group.moving_frames, settings.reset
        start = start_of(last_positions, history.still_frames, cage, frames=frames, reset=reset, moved=moved)
    contact = group.contact(frame, cage, given_up=frame.given_up if history is None else history.given_up)
    if contact is not None and last is not None and last.clean and before is not None:
        contact.at(group.levels[-1]).remember(before)
    return Problem(
        began,
        group,
        frame,
        cage,
        aim=cage.points if contact is None else contact.aim,
        forces=forces,
        contact=contact,
        start=start,
        prerolled=None if frame.prerolled is None else group.tensor(frame.prerolled - cage.origin),
        before=before,
        inside=last.inside if last is not None and bool(last.inside.any()) else None,
        tether=start.slowed * settings.tether * frame.rate**2 if settings.temporal == "tether" else None,
        last_curvature=None if history is None else history.curvature,
        following=torch.zeros_like(cage.points[:, 0], dtype=torch.int64) if history is None else history.following,
    )
