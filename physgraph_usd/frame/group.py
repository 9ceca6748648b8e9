"""Garments that are solved together: their levels, forces and metrics, and the solve of one frame."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float
from torch import Tensor

from ..contact.bodies import FrameBodies, Touching
from ..contact.cloth import ClothContact
from ..contact.frame import FrameContact, LevelContact, Touch
from ..contact.seams import Seams
from ..contact.settings import ContactSettings
from ..contact.solve import solve_touching
from ..errors import SolveError
from ..forces.base import ForceModule
from ..forces.guide import GuideMap
from ..forces.seam import SewnForces
from ..integrate.base import Integrator, System
from ..integrate.choice import Choice, choose
from ..integrate.metric import Metric
from ..integrate.saddle import leave_saddle
from ..integrate.solve import Budget, LevelReport, solve_level
from ..level import Level, build_levels
from ..mesh.subdivide import Refinement
from ..resolution import edge_strain, sharp_folds
from ..scene import FARTHEST, Garment, GarmentFrame, recentred
from ..solve_settings import SolveSettings
from .detail import Carried, Followers, MovingFrames, Solved
from .level_forces import LevelForces, blame, build_forces, named
from .start import Start, start_of


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
        lanes: int = 1,
    ) -> None:
        """Build the levels.

        Args:
            garments: Garments solved together.
            refinements: Their refinements.
            gravity: [m/s^2], shape (3,).
            settings: How to solve.
            dtype: Scalar type of the solve.
            device: "cpu" or a CUDA device.
            lanes: Most threads that a kernel uses on the CPU.
        """
        self.garments = tuple(garments)
        self._gravity, self._settings = gravity, settings
        self.levels = build_levels(
            [recentred(g) for g in garments], refinements, dtype=dtype, device=device, lanes=lanes
        )
        self._guide_maps = [GuideMap(level) for level in self.levels]
        cage, finest = self.levels[0], self.levels[-1]
        triangles = cage.triangles.cpu().numpy()
        self._frames = MovingFrames(finest, triangles, cage.rest.double().cpu().numpy())
        self._outward = torch.tensor([-1.0 if garment.flipped else 1.0 for garment in garments], device=device)
        self._fixed = np.flatnonzero(~finest.free.cpu().numpy().ravel())
        self._place_fixed = sp.csr_matrix(finest.from_coarse[self._fixed])
        meshes = [chain[-1].mesh if chain else g.mesh for g, chain in zip(garments, refinements, strict=True)]
        self._followers = Followers(finest, meshes)
        self._cloth = ClothContact(self.levels, self.garments)
        self._material: tuple[object, ...] = ()
        self._forces: list[LevelForces] = []
        # What an integrator records on CUDA lasts as long as the systems and itself.
        self._systems_last, self._integrators = device != "cpu", dict[object, Integrator]()

    def solve(
        self,
        frames: Sequence[GarmentFrame],
        kept: Carried | None,
        *,
        at: float | None,
        touching: Sequence[Touching] = (),
        moved: float = np.inf,
    ) -> Solved:
        """Solve one frame.

        Args:
            frames: The garments at this time code.
            kept: The previous frame's result, or None for a cold start.
            at: The time code, for errors.
            touching: Surfaces that the garments may touch.
            moved: As `start_of` takes it.

        Raises:
            SolveError: A term of the potential is not finite.
        """
        clock = time.perf_counter()
        forces = self._forces_for(frames)
        world, origin, coarse = self._placed(frames)
        start = self._start(kept, coarse, world, moved=moved)
        contact = self._contact(touching, coarse, origin, frames, target=start.detailed)
        aim = coarse if contact is None else contact.aim
        prepared = time.perf_counter()
        try:
            before = None if kept is None else kept.about(origin)
            if contact is not None and before is not None and kept is not None and kept.clean:
                contact.at(self.levels[-1]).remember(before)
            x, reports, module, told = self._descend(forces, aim, start, clock, contact=contact, before=before)
        except SolveError as error:
            raise SolveError(blame(self.garments, forces[-1], coarse, error=error, at=at)) from error
        result = self._scaled(aim, x, frames, at=at)
        finished: dict[str, object] = {}
        clean = contact is not None and not contact.at(self.levels[-1]).crosses(x)
        if contact is not None:
            result, finished = contact.finish(result)
        solved = time.perf_counter()
        carried = self._carried(coarse, x, world, origin=origin, held=start.held, clean=clean)
        strain = edge_strain(self.levels[-1], result)
        telemetry = self._telemetry(module, result, coarse, reports) | {"strain": strain, "start": start.why} | told
        judge = self._judge(contact, touching, coarse, origin=origin, frames=frames)
        measured, crossing = ({}, None) if judge is None else judge.measure(result)
        if measured:
            telemetry["contact"] = measured | finished
        telemetry["milliseconds"] = {
            "prepare": round(1e3 * (prepared - clock), 3),
            "solve": round(1e3 * (solved - prepared), 3),
            "measure": round(1e3 * (time.perf_counter() - solved), 3),
        }
        points = result.double().cpu().numpy() + origin
        points[self._fixed] = self._place_fixed @ world
        points = self._followers.placed(points, world)
        crosses = np.zeros(len(points), bool) if crossing is None else crossing.cpu().numpy()
        own = [[each[span] for span in self.levels[-1].spans] for each in (points, crosses)]
        return Solved(own[0], carried, telemetry, own[1])

    def _carried(
        self, coarse: Tensor, x: Tensor, world: np.ndarray, *, origin: np.ndarray, held: int, clean: bool
    ) -> Carried:
        """What the next frame needs."""
        fine = x.double() + torch.as_tensor(origin).to(x.device)
        own = {"coarse": torch.as_tensor(world), "held": held, "fine": fine, "clean": clean}
        return replace(self._frames.store(coarse, x), **own)

    def energies(
        self, frames: Sequence[GarmentFrame], points: Sequence[np.ndarray], touching: Sequence[Touching] = ()
    ) -> dict[str, float]:
        """Energy of each term [J] at the garments' world positions [m], what touches there found anew."""
        module, contact, origin = self.potential(frames, touching)
        x = self._tensor(np.concatenate(points) - origin)
        touched = () if contact is None else contact.at(self.levels[-1]).terms(x)
        return ForceModule((*module.forces, *touched)).energies(x)

    def systems(self, frames: Sequence[GarmentFrame]) -> tuple[list[System], Float[Tensor, "coarse 3"]]:
        """The problem of one frame without its solve, for charts and benchmarks.

        Args:
            frames: The garments at one time code.

        Returns:
            One system per level, coarsest first, and the recentred coarse positions [m].
        """
        modules, coarse = self.modules(frames)
        parts = zip(self.levels, self._forces_for(frames), modules, strict=True)
        systems = [
            System(module, own.metric, free=level.free, spacing=level.spacing, level=level, lasting=True)
            for level, own, module in parts
        ]
        return systems, coarse

    def use(self, settings: SolveSettings) -> None:
        """Solve the frames that follow in another way; levels and metrics are kept."""
        if settings.potential != self._settings.potential:
            self._material = ()
        self._settings = settings

    def potential(
        self, frames: Sequence[GarmentFrame], touching: Sequence[Touching] = ()
    ) -> tuple[ForceModule, FrameContact | None, np.ndarray]:
        """The finest level's forces in a frame, what the cloth may touch, and where its origin is [m], to judge by."""
        _, origin, coarse = self._placed(frames)
        contact = self._contact(touching, coarse, origin, frames)
        aim = coarse if contact is None else contact.aim
        return self._forces_for(frames)[-1].module(aim), contact, origin

    def modules(self, frames: Sequence[GarmentFrame]) -> tuple[list[ForceModule], Float[Tensor, "coarse 3"]]:
        """The forces of one frame, one module per level, and the recentred coarse positions [m]."""
        world = torch.as_tensor(np.concatenate([f.points for f in frames]), dtype=torch.float64)
        coarse = self._tensor((world - world.mean(dim=0)).numpy())
        return [lasting.module(coarse) for lasting in self._forces_for(frames)], coarse

    def _placed(self, frames: Sequence[GarmentFrame]) -> tuple[np.ndarray, np.ndarray, Tensor]:
        """The cages' world positions, their mean [m], and the cages about it."""
        world = np.concatenate([frame.points for frame in frames])
        origin = world.mean(axis=0) if len(world) else np.zeros(3)
        return world, origin, self._tensor(world - origin)

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.as_tensor(array, dtype=self.levels[0].dtype, device=self.levels[0].device)

    def _forces_for(self, frames: Sequence[GarmentFrame]) -> list[LevelForces]:
        """The lasting terms, rebuilt with their metrics when a material changes."""
        material = tuple((frame.fabric, frame.guide) for frame in frames)
        if material != self._material:
            given = {"frames": frames, "gravity": self._gravity, "potential": self._settings.potential}
            pairs = zip(self.levels, self._guide_maps, strict=True)
            self._forces = [build_forces(level, guide_map, self.garments, **given) for level, guide_map in pairs]
            self._material = material
        return self._forces

    def _scaled(self, aim: Tensor, x: Tensor, frames: Sequence[GarmentFrame], *, at: float | None) -> Tensor:
        """The result with its detail scaled as asked for, within bounds."""
        gain = np.concatenate([f.detail * g.detail_scale for f, g in zip(frames, self.garments, strict=True)])
        result = self._frames.scaled(aim, x, gain)
        if not bool((result.abs() <= FARTHEST).all()):
            said = f"the refined cloth is not finite or beyond {FARTHEST:g} m; lower physgraph:refine:detail"
            raise SolveError(f"{named(self.garments, at)}: {said} or detailScale")
        return result

    def _start(self, kept: Carried | None, coarse: Tensor, world: np.ndarray, *, moved: float = np.inf) -> Start:
        """Where a frame starts."""
        kept = None if self._settings.temporal == "off" else kept
        moved = moved if self._settings.temporal == "tether" else np.inf  # Nothing else slows it down.
        given = {"frames": self._frames, "finest": self.levels[-1], "reset": self._settings.reset}
        return start_of(kept, coarse, torch.as_tensor(world), **given, moved=moved)

    def _contact(
        self,
        touching: Sequence[Touching],
        coarse: Tensor,
        origin: np.ndarray,
        frames: Sequence[GarmentFrame],
        *,
        settings: ContactSettings | None = None,
        target: Tensor | None = None,
    ) -> FrameContact | None:
        """What a frame's cloth may touch, or None when there is nothing; as the group is set unless told otherwise."""
        settings = settings or self._settings.contact
        touching = touching if settings.form != "off" else ()
        cloth = self._cloth if settings.cloth != "off" and self._cloth.meets.any() else None
        if not len(self.levels[0].triangles):
            return None
        seams = Seams.find(self.levels[0], coarse)
        if cloth is None and not touching and seams is None:
            return None
        stretch, density = (max(getattr(each.fabric, name) for each in frames) for name in ("stretch", "density"))
        weight = float(np.linalg.norm(self._gravity)) * density
        settings = settings.scaled(self.levels[0], stretch=stretch, weight=weight)
        bodies = None
        if touching:
            bodies = FrameBodies.begin(self.levels, touching, coarse, origin=origin, settings=settings)
        own = {"thickness": [frame.fabric.thickness for frame in frames], "settings": settings, "seams": seams}
        return FrameContact(self.levels, coarse, bodies=bodies, cloth=cloth, **own, target=target)

    def _judge(
        self,
        contact: FrameContact | None,
        touching: Sequence[Touching],
        coarse: Tensor,
        *,
        origin: np.ndarray,
        frames: Sequence[GarmentFrame],
    ) -> FrameContact | None:
        """What a frame is measured by: what it may touch, and what is off but to be measured."""
        settings = self._settings.contact.to_measure()
        return contact if settings is None else self._contact(touching, coarse, origin, frames, settings=settings)

    def _descend(
        self,
        forces: list[LevelForces],
        coarse: Tensor,
        start: Start,
        clock: float,
        *,
        contact: FrameContact | None,
        before: Tensor | None = None,
    ) -> tuple[Tensor, list[LevelReport], ForceModule, dict[str, object]]:
        """Walk the levels; a warm start goes to the finest. Also says why."""
        predicted, last = start.detailed, len(self.levels) - 1
        choice = self._choose(forces[0], coarse, contact, warm=predicted is not None)
        # What crosses in a cold frame is drawn apart at the cage.
        first = 0 if choice.nested or (predicted is None and contact is not None and contact.crossed) else last
        x = predicted if predicted is not None else self.levels[first].base.apply(coarse)
        below, smooth = coarse, self.levels[first].smooth_base
        reports: list[LevelReport] = []
        module = ForceModule(())
        for index in range(first, last + 1):
            level, lasting = self.levels[index], forces[index]
            if index > first and level.from_below is not None and level.smooth_from_below is not None:
                below, x, smooth = x, level.from_below.apply(x), level.smooth_from_below
            view = None if contact is None else contact.at(level)
            module = lasting.module(coarse)
            warm = predicted if index == last else None
            pull = start.slowed * self._settings.tether
            tie = None if warm is None or self._settings.temporal != "tether" else (pull, warm)
            budget = self._settings.budget(last - index, clock, more=choice.steps, warm=warm is not None)
            smoothing = None if warm is not None else lasting.without_facets(x, below, smooth)
            if view is not None and smoothing is not None and level.flat_from_below is not None and view.crosses(x):
                flat = level.flat_from_below.apply(below)
                x, smoothing = flat, x + smoothing - flat
            if view is not None and warm is not None and before is not None:
                x = view.moved(before, warm)
            alone = lasting.lasting_system(coarse, tie) if self._systems_last else lasting.system(module, tie)
            x, made, touched = self._solve_level(
                alone,
                level,
                x=x,
                smoothing=smoothing,
                start=start,
                view=view,
                budget=budget,
            )
            if index < last:
                made[-1].energies = module.energies(x)
            reports += made
            module = ForceModule((*module.forces, *touched))
        return x, reports, module, {"chosen": choice.reason} if choice.reason else {}

    def _choose(self, cage: LevelForces, coarse: Tensor, contact: FrameContact | None, *, warm: bool) -> Choice:
        """Which levels a frame is solved at, and the integrator, which is made ready."""
        choice = choose(
            self._settings.method.nested,
            len(self.levels) - 1,
            contact,
            remaining=lambda: self._remaining(cage, coarse),
            warm=warm,
            device=self.levels[0].device,
        )
        build = self._settings.method.build
        who = None if choice.learned else build
        if who not in self._integrators:
            self._integrators[who] = choice.integrator(build)
        self._integrator = self._integrators[who]
        return choice

    def _remaining(self, forces: LevelForces, coarse: Tensor) -> float:
        """The cage's remaining move, in its edge lengths."""
        level = self.levels[0]
        system = System(forces.module(coarse), forces.metric, free=level.free, spacing=level.spacing, level=level)
        force = system.energy_and_force(level.base.apply(coarse))[1]
        return system.remaining_move(system.apply_metric_inverse(force))

    def _solve_level(
        self,
        alone: System,
        level: Level,
        *,
        x: Tensor,
        smoothing: Tensor | None,
        start: Start,
        view: LevelContact | None,
        budget: Budget,
    ) -> tuple[Tensor, list[LevelReport], tuple[Touch, ...]]:
        """Solve one level, in rounds where something is near; returns the contact terms too.

        The smoothing is the move that takes a coarser mesh's facets out of x (`facets`), and None in a warm frame.
        """
        integrator = self._integrator
        budget = replace(budget, steps=0) if start.rests else budget
        if view is None:
            if smoothing is not None:
                x = leave_saddle(alone, level, x + smoothing, outward=self._outward)
            x, report = solve_level(alone, integrator, x, level=level.index, budget=budget)
            return x, [report], ()

        def system(touched: Sequence[Touch], at: Tensor, known: System | None) -> System:
            if not touched and view.seam is None:
                return alone
            assert isinstance(alone.field, ForceModule)
            assert isinstance(alone.metric, Metric)
            field = alone.field.joined_by(touched)
            field = field if view.seam is None else SewnForces(field, view.seam)
            held = view.metric(alone.metric, touched, at, known=None if known is None else known.metric)
            return System(field, held, free=level.free, spacing=level.spacing, level=level)

        own = {"smoothing": smoothing, "outward": self._outward, "budget": budget}
        return solve_touching(system, integrator, x, view=view, level=level, **own)

    def _telemetry(
        self, module: ForceModule, x: Tensor, coarse: Tensor, reports: list[LevelReport]
    ) -> dict[str, object]:
        finest = self.levels[-1]
        return {
            "levels": [asdict(report) for report in reports],
            "energy_joules": {"input": module.energies(finest.base.apply(coarse)), "output": module.energies(x)},
            "sharp_folds": sharp_folds(finest, x),
        }
