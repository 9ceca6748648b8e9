"""Garments that are solved together: their levels, forces and metrics, and the solve of one frame."""

from __future__ import annotations

import time
from collections.abc import Sequence
from copy import copy
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ...errors import SolveError
from ..contact.bodies import FrameBodies, Touching
from ..contact.cloth import ClothContact
from ..contact.frame import FrameContact, LevelContact
from ..contact.seams import Seams
from ..contact.settings import ContactSettings
from ..forces.base import ForceModule
from ..forces.guide import GuideMap
from ..integrate.base import Integrator, System
from ..integrate.choice import Choice, choose
from ..integrate.solve import LevelReport
from ..level import Placed, build_levels, unhindered
from ..mesh.subdivide import Refinement
from ..resolution import edge_strain, sharp_folds
from ..scene import FARTHEST, Garment, GarmentFrame, recentred
from .descent import Problem
from .detail import MovingFrames
from .followers import Followers
from .level_forces import LevelForces, blame, build_forces, named
from .settings import SolveSettings
from .start import Start, start_of
from .values import Cage, FrameInput, Solved, State


class Group:
    """Garments solved together.

    Attributes:
        garments: The garments.
        levels: Their levels, cage first.
    """

    def __init__(
        self,
        garments: Sequence[Garment],
        refinements: Sequence[Sequence[Refinement]],
        gravity: np.ndarray,
        settings: SolveSettings,
        *,
        dtype: torch.dtype,
        device: str,
        threads: int = 1,
    ) -> None:
        """Build the levels.

        Args:
            garments: Garments solved together.
            refinements: Their refinements.
            gravity: [m/s^2], shape (3,).
            settings: How to solve.
            dtype: Scalar type of the solve.
            device: "cpu" or a CUDA device.
            threads: Most threads that a kernel uses on the CPU.
        """
        self.garments = tuple(garments)
        self._gravity, self._settings = gravity, settings
        self.levels = build_levels(
            [recentred(g) for g in garments], refinements, dtype=dtype, device=device, threads=threads
        )
        self._guide_maps = [GuideMap(level) for level in self.levels]
        cage, finest = self.levels[0], self.levels[-1]
        self._frames = MovingFrames(cage, finest)
        self._outward = torch.tensor([-1.0 if garment.flipped else 1.0 for garment in garments], device=device)
        meshes = [chain[-1].mesh if chain else g.mesh for g, chain in zip(garments, refinements, strict=True)]
        self._followers = Followers(finest, meshes)
        self._cloth = ClothContact(self.levels, self.garments)
        # The lasting terms by potential and materials; of the last ones alone.
        self._forces = dict[tuple[object, ...], list[LevelForces]]()
        # What an integrator records on CUDA lasts as long as the systems and itself.
        self._systems_last, self._integrators = device != "cpu", dict[object, Integrator]()

    def with_settings(self, settings: SolveSettings) -> Group:
        """The same garments solved in another way; levels and metrics are shared."""
        other = copy(self)
        other._settings = settings
        return other

    def solve(self, given: FrameInput, state: State | None) -> Solved:
        """Solve one frame.

        Args:
            given: The frame.
            state: What the last frame left, or None for a cold start.

        Raises:
            SolveError: A term of the potential is not finite.
        """
        problem = self._problem(given, state)
        self._refuse_swallowed(given, problem)
        prepared = time.perf_counter()
        try:
            x, reports, module, chosen = self._descend(problem)
        except SolveError as error:
            coarse = problem.cage.points
            raise SolveError(blame(self.garments, problem.forces[-1], coarse, error=error, at=given.at)) from error
        view = problem.view(self.levels[-1])
        result = self._scaled(given, problem.aim, x, view=view)
        clean = view is not None and not view.crosses(x)
        finished: dict[str, object] = {}
        if problem.contact is not None:
            result, finished = problem.contact.finish(result)
        solved = time.perf_counter()
        left = self._left(problem, x, clean=clean)
        telemetry = {"levels": [asdict(report) for report in reports], **self._told(problem, module, result)}
        if chosen:
            telemetry["chosen"] = chosen
        measured, crossing = self._measured(given, problem, result)
        if measured:
            telemetry["contact"] = measured | finished
        spent = (1e3 * np.diff([problem.began, prepared, solved, time.perf_counter()])).round(3).tolist()
        telemetry["milliseconds"] = dict(zip(("prepare", "solve", "measure"), spent, strict=True))
        world, origin = problem.cage.world, problem.cage.origin
        points = self._followers.placed(result, origin, world)
        crosses = np.zeros(len(points), bool) if crossing is None else crossing.cpu().numpy()
        own = [[each[span] for span in self.levels[-1].spans] for each in (points, crosses)]
        return Solved(own[0], left, telemetry, own[1])

    def upsampled(self, frames: Sequence[GarmentFrame]) -> list[np.ndarray]:
        """World positions of each garment [m] on its cage's smooth surface, not solved."""
        cage, finest = self._cage(frames), self.levels[-1]
        smooth = unhindered(finest.smooth_base.apply(cage.points))
        points = self._followers.placed(smooth, cage.origin, cage.world)
        return [points[span] for span in finest.spans]

    def energies(
        self, frames: Sequence[GarmentFrame], points: Sequence[np.ndarray], touching: Sequence[Touching] = ()
    ) -> dict[str, float]:
        """Energy of each term [J] at the garments' world positions [m], what touches there found anew."""
        module, contact, origin = self.potential(frames, touching)
        x = self._tensor(np.concatenate(points) - origin)
        touched = () if contact is None else contact.at(self.levels[-1]).terms(x)[1]
        return ForceModule((*module.forces, *touched)).energies(x)

    def moved_safely(
        self,
        frames: Sequence[GarmentFrame],
        start: Sequence[np.ndarray],
        wanted: Sequence[np.ndarray],
        *,
        touching: Sequence[Touching] = (),
    ) -> tuple[list[np.ndarray], dict[str, Any]]:
        """World positions [m] as near to wanted ones as nothing newly crosses on the way, and out of bodies.

        Also what touches and crosses there, as plain values; none where nothing may touch.
        """
        _, contact, origin = self.potential(frames, touching)
        if contact is None:
            return list(wanted), {}
        begun, given = (self._tensor(np.concatenate(each) - origin) for each in (start, wanted))
        moved, _ = contact.finish(contact.at(self.levels[-1]).moved(Placed(begun), given))
        apart = (moved - given).double().cpu().numpy()
        pairs = zip(wanted, self.levels[-1].spans, strict=True)
        return [each + apart[span] for each, span in pairs], contact.measure(moved)[0]

    def systems(self, frames: Sequence[GarmentFrame]) -> tuple[list[System], Float[Tensor, "coarse 3"]]:
        """The problem of one frame without its solve, for charts and benchmarks.

        Args:
            frames: The garments at one time code.

        Returns:
            One system per level, coarsest first, and the recentred coarse positions [m].
        """
        modules, coarse = self.modules(frames)
        pairs = zip(self._forces_for(frames), modules, strict=True)
        return [own.system_in(module, lasting=True) for own, module in pairs], coarse

    def potential(
        self, frames: Sequence[GarmentFrame], touching: Sequence[Touching] = ()
    ) -> tuple[ForceModule, FrameContact | None, np.ndarray]:
        """The finest level's forces in a frame, what the cloth may touch, and where its origin is [m], to judge by."""
        cage = self._cage(frames)
        contact = self._contact(FrameInput(frames, touching=touching), cage)
        aim = cage.points if contact is None else contact.aim
        return self._forces_for(frames)[-1].module(aim), contact, cage.origin

    def modules(self, frames: Sequence[GarmentFrame]) -> tuple[list[ForceModule], Float[Tensor, "coarse 3"]]:
        """The forces of one frame, one module per level, and the recentred coarse positions [m]."""
        world = torch.as_tensor(np.concatenate([f.points for f in frames]), dtype=torch.float64)
        coarse = self._tensor((world - world.mean(dim=0)).numpy())
        return [lasting.module(coarse) for lasting in self._forces_for(frames)], coarse

    def _cage(self, frames: Sequence[GarmentFrame]) -> Cage:
        """Where the cages are."""
        world = np.concatenate([frame.points for frame in frames])
        origin = world.mean(axis=0) if len(world) else np.zeros(3)
        return Cage(world, origin, self._tensor(world - origin))

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.as_tensor(array, dtype=self.levels[0].dtype, device=self.levels[0].device)

    def _forces_for(self, frames: Sequence[GarmentFrame]) -> list[LevelForces]:
        """The lasting terms, rebuilt with their metrics when a material changes."""
        potential = self._settings.potential
        key = (potential, *((frame.fabric, frame.guide) for frame in frames))
        if key not in self._forces:
            given = {"frames": frames, "gravity": self._gravity, "potential": potential}
            pairs = zip(self.levels, self._guide_maps, strict=True)
            made = [build_forces(level, guide_map, self.garments, **given) for level, guide_map in pairs]
            self._forces.clear()
            self._forces[key] = made
        return self._forces[key]

    def _problem(self, given: FrameInput, state: State | None) -> Problem:
        """A frame, ready to be solved."""
        began = time.perf_counter()
        forces, cage = self._forces_for(given.garments), self._cage(given.garments)
        start = self._start(state, cage, moved=given.moved)
        contact = self._contact(given, cage, target=start.detailed)
        return Problem(
            began,
            cage,
            aim=cage.points if contact is None else contact.aim,
            forces=forces,
            contact=contact,
            start=start,
            walked=None if given.walked is None else self._tensor(given.walked - cage.origin),
            before=None if state is None else state.about(cage.origin),
            clean=state is not None and state.clean,
            tether=start.slowed * self._settings.tether if self._settings.temporal == "tether" else None,
            outward=self._outward,
            lasting=self._systems_last,
        )

    def _start(self, state: State | None, cage: Cage, *, moved: float = np.inf) -> Start:
        """Where a frame starts."""
        state = None if self._settings.temporal == "off" else state
        moved = moved if self._settings.temporal == "tether" else np.inf  # Nothing else slows it down.
        given = {"frames": self._frames, "finest": self.levels[-1], "reset": self._settings.reset}
        return start_of(state, cage, **given, moved=moved)

    def _contact(
        self,
        given: FrameInput,
        cage: Cage,
        *,
        settings: ContactSettings | None = None,
        target: Tensor | None = None,
    ) -> FrameContact | None:
        """What a frame's cloth may touch, or None when there is nothing; as the group is set unless told otherwise."""
        settings = settings or self._settings.contact
        touching = given.touching if settings.form != "off" else ()
        cloth = self._cloth if settings.cloth != "off" and self._cloth.meets.any() else None
        if not len(self.levels[0].triangles):
            return None
        seams = Seams.find(self.levels[0], cage.points)
        if cloth is None and not touching and seams is None:
            return None
        fabrics = [frame.fabric for frame in given.garments]
        weight = float(np.linalg.norm(self._gravity)) * max(each.density for each in fabrics)
        settings = settings.scaled(self.levels[0], stretch=max(each.stretch for each in fabrics), weight=weight)
        bodies = None
        if touching:
            bodies = FrameBodies.begin(self.levels, touching, cage.points, origin=cage.origin, settings=settings)
        own = {"thickness": [each.thickness for each in fabrics], "settings": settings, "seams": seams}
        return FrameContact(self.levels, cage.points, bodies=bodies, cloth=cloth, **own, target=target)

    def _descend(self, problem: Problem) -> tuple[Placed, list[LevelReport], ForceModule, str]:
        """Solve level by level from the cage, or at the finest level alone, as warm frames are; also says why."""
        last = len(self.levels) - 1
        if problem.contact is not None and problem.before is not None and problem.clean:
            problem.contact.at(self.levels[last]).remember(problem.before)
        choice = self._choose(problem)
        integrator = self._integrator(choice)
        # What crosses in a cold frame is drawn apart at the cage.
        first = 0 if choice.nested or (not problem.warm and problem.crossed) else last
        below, module = problem.aim if first or problem.walked is None else problem.walked, ForceModule(())
        reports, placed = list[LevelReport](), None
        for index in range(first, last + 1):
            x, smoothing = problem.begun(index, below if placed is None else placed, from_cage=placed is None)
            budget = self._settings.budget(last - index, problem.began, more=choice.steps, warm=problem.warm)
            budget = replace(budget, steps=0) if problem.start.rests else budget
            placed, made, module = problem.solved(index, x, smoothing, integrator=integrator, budget=budget)
            reports += made
        assert placed is not None
        return placed, reports, module, choice.reason

    def _choose(self, problem: Problem) -> Choice:
        """Which levels a frame is solved at, and by what."""
        return choose(
            self._settings.method.nested,
            len(self.levels) - 1,
            problem.contact,
            remaining=lambda: problem.forces[0].remaining(problem.aim),
            warm=problem.warm,
            device=self.levels[0].device,
        )

    def _integrator(self, choice: Choice) -> Integrator:
        """The integrator that was chosen, built when first asked for."""
        build = self._settings.method.build
        who = None if choice.learned else build
        if who not in self._integrators:
            self._integrators[who] = choice.integrator(build)
        return self._integrators[who]

    def _refuse_swallowed(self, given: FrameInput, problem: Problem) -> None:
        """Refuse cloth wholly in a body, deeper than it is large: pushed out, it would be nowhere near its cage."""
        depths = [] if problem.contact is None else problem.contact.depths
        for garment, frame, (deep, body) in zip(self.garments, given.garments, depths, strict=False):
            size = float(np.linalg.norm(np.ptp(frame.points, axis=0))) if len(frame.points) else 0.0
            if deep > size:
                said = f"it is {1e3 * deep:.4g} mm deep in <{body}>, and only {1e3 * size:.4g} mm large"
                raise SolveError(f"{named([garment], given.at)}: {said}; mend the one or the other there")

    def _scaled(self, given: FrameInput, aim: Tensor, x: Placed, *, view: LevelContact | None) -> Placed:
        """The result with its detail scaled as asked for, within bounds, as far as nothing newly crosses."""
        gain = np.concatenate([f.detail * g.detail_scale for f, g in zip(given.garments, self.garments, strict=True)])
        result = self._frames.scaled(aim, x, gain)
        if not bool((result.abs() <= FARTHEST).all()):
            said = f"the refined cloth is not finite or beyond {FARTHEST:g} m; lower physgraph:refine:detail"
            raise SolveError(f"{named(self.garments, given.at)}: {said} or detailScale")
        return x if result is x else unhindered(result) if view is None else view.moved(x, result)

    def _left(self, problem: Problem, x: Tensor, *, clean: bool) -> State:
        """What the next frame starts from."""
        stored, cage = self._frames.store(problem.cage.points, x), problem.cage
        fine = x.double() + torch.as_tensor(cage.origin).to(x.device)
        return replace(stored, coarse=torch.as_tensor(cage.world), held=problem.start.held, fine=fine, clean=clean)

    def _told(self, problem: Problem, module: ForceModule, x: Tensor) -> dict[str, Any]:
        """Where a frame started and how its result lies, as plain values."""
        finest = self.levels[-1]
        base = finest.base.apply(problem.cage.points)
        return {
            "energy_joules": {"input": module.energies(base), "output": module.energies(x)},
            "sharp_folds": sharp_folds(finest, x),
            "strain": edge_strain(finest, x),
            "start": problem.start.why,
        }

    def _measured(
        self, given: FrameInput, problem: Problem, x: Tensor
    ) -> tuple[dict[str, object], Bool[Tensor, " vertices"] | None]:
        """What is near and what crosses, of what the cloth may touch and of what is off but to be measured."""
        settings = self._settings.contact.to_measure()
        judge = problem.contact if settings is None else self._contact(given, problem.cage, settings=settings)
        return ({}, None) if judge is None else judge.measure(x)
