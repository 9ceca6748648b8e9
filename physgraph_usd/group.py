"""Garments that are solved together: their levels, forces and metrics, and the solve of one frame."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float
from torch import Tensor

from .contact import ContactSettings, FrameContact, LevelContact, Touching
from .detail import Carried, MovingFrames, Reset
from .errors import SolveError
from .forces.base import ForceModule
from .forces.contact import Contact
from .forces.guide import GuideMap
from .integrate import Method
from .integrate.base import System
from .integrate.metric import Metric
from .integrate.saddle import leave_saddle
from .integrate.solve import Budget, LevelReport, solve_level
from .level import Level, build_levels
from .level_forces import LevelForces, build_forces
from .mesh.subdivide import Refinement
from .resolution import sharp_folds
from .rounds import solve_rounds
from .scene import Garment, GarmentFrame

WORTH = 2.0
"""Elastic energy of carried detail, over that of the upsampled cage, beyond which a frame starts cold: detail that is
worth carrying takes compression up and lowers it; carried by a crumpled cage it tears the cloth."""
LEAST_STRAIN = 1e-2
"""Strain of the whole garment under which that ratio is not looked at."""
UNSETTLED = 0.1
"""Remaining move, in edge lengths, above which the cloth away from the bodies is solved once more by itself: cloth
pinched between bodies cannot settle and holds up the steps of all the rest."""
COARSE_STEPS = 4
"""Steps of a coarse level for each step of the finest: coarse steps are cheap and set the folds."""
COARSE_TOLERANCE = 0.1
"""Tolerance of a coarse level over the finest's: folds grow slowly at first, and what is not there is not refined."""


@dataclass(frozen=True)
class SolveSettings:
    """How each frame is solved.

    Attributes:
        method: The integrator and whether it is nested.
        steps: Most steps at the finest level; each level below it may take four times as many.
        tolerance: Stop when the RMS of H0^-1 F is under this many local edge lengths.
        budget_ms: Milliseconds a frame, or None.
        temporal: "tether", "warm" or "off".
        tether: Tether stiffness [1/s^2].
        potential: "continuum" or "paper".
        reset: When a frame starts cold.
        contact: How contact is solved.
    """

    method: Method
    steps: int = 12
    tolerance: float = 2e-3
    budget_ms: float | None = None
    temporal: str = "tether"
    tether: float = 2000.0
    potential: str = "continuum"
    reset: Reset = field(default_factory=Reset)
    contact: ContactSettings = field(default_factory=ContactSettings)


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
            [_recentred(g) for g in garments], refinements, dtype=dtype, device=device, lanes=lanes
        )
        self._guide_maps = [GuideMap(level) for level in self.levels]
        cage, finest = self.levels[0], self.levels[-1]
        triangles = cage.triangles.cpu().numpy()
        self._frames = MovingFrames(finest, triangles, cage.rest.double().cpu().numpy())
        self._outward = torch.tensor([-1.0 if garment.flipped else 1.0 for garment in garments], device=device)
        self._fixed = np.flatnonzero(~finest.free.cpu().numpy().ravel())
        self._place_fixed = sp.csr_matrix(finest.from_coarse[self._fixed])
        self._material: tuple[object, ...] = ()
        self._forces: list[LevelForces] = []
        self._stretch = 0.0

    def solve(
        self,
        frames: Sequence[GarmentFrame],
        kept: Carried | None,
        *,
        at: float | None,
        touching: Sequence[Touching] = (),
    ) -> tuple[list[np.ndarray], Carried, dict[str, object]]:
        """Solve one frame.

        Args:
            frames: The garments at this time code.
            kept: The previous frame's result, or None for a cold start.
            at: The time code, for errors.
            touching: Surfaces that the garments may touch.

        Returns:
            World positions [m] of each garment, what the next frame needs, and telemetry.

        Raises:
            SolveError: A term of the potential is not finite.
        """
        clock = time.perf_counter()
        forces = self._forces_for(frames)
        world = np.concatenate([frame.points for frame in frames])
        origin = world.mean(axis=0) if len(world) else np.zeros(3)
        coarse = self._tensor(world - origin)
        predicted, start = self._predict(kept, coarse, torch.as_tensor(world))
        contact = self._contact(touching, coarse, origin, frames)
        prepared = time.perf_counter()
        try:
            x, reports, module = self._descend(forces, coarse, predicted, clock, contact=contact)
        except SolveError as error:
            raise SolveError(self._blame(forces[-1], coarse, error, at)) from error
        result = self._finish(x, coarse, frames)
        pushed = None
        if contact is not None:
            scaled = result is not x
            result, pushed = contact.at(self.levels[-1], self.levels[-1]).project(result)
            x = x if scaled else result
        solved = time.perf_counter()
        carried = self._frames.store(coarse, x)
        carried = Carried(torch.as_tensor(world), carried.detail, carried.frames)
        telemetry = self._telemetry(module, x, coarse, reports)
        telemetry["start"] = start
        if contact is not None:
            upsampled = self.levels[-1].base.apply(coarse)
            telemetry["contact"] = contact.measure(self.levels[-1], upsampled, result) | {"projected": pushed}
        telemetry["milliseconds"] = {
            "prepare": round(1e3 * (prepared - clock), 3),
            "solve": round(1e3 * (solved - prepared), 3),
            "measure": round(1e3 * (time.perf_counter() - solved), 3),
        }
        points = result.double().cpu().numpy() + origin
        points[self._fixed] = self._place_fixed @ world
        return [points[span] for span in self.levels[-1].spans], carried, telemetry

    def systems(self, frames: Sequence[GarmentFrame]) -> tuple[list[System], Float[Tensor, "coarse 3"]]:
        """The problem of one frame without its solve, for charts and benchmarks.

        Args:
            frames: The garments at one time code.

        Returns:
            One system per level, coarsest first, and the recentred coarse positions [m].
        """
        modules, coarse = self.modules(frames)
        parts = zip(self.levels, self._forces_for(frames), modules, strict=True)
        return [
            System(m, lasting.metric, free=level.free, spacing=level.spacing, level=level)
            for level, lasting, m in parts
        ], coarse

    def modules(self, frames: Sequence[GarmentFrame]) -> tuple[list[ForceModule], Float[Tensor, "coarse 3"]]:
        """The forces of one frame, one module per level, and the recentred coarse positions [m]."""
        world = torch.as_tensor(np.concatenate([f.points for f in frames]), dtype=torch.float64)
        coarse = self._tensor((world - world.mean(dim=0)).numpy())
        forces = self._forces_for(frames)
        return [lasting.module(coarse) for lasting in forces], coarse

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.as_tensor(array, dtype=self.levels[0].dtype, device=self.levels[0].device)

    def _forces_for(self, frames: Sequence[GarmentFrame]) -> list[LevelForces]:
        """The lasting terms, rebuilt with their metrics when a material changes."""
        material = tuple((frame.fabric, frame.guide) for frame in frames)
        if material != self._material:
            self._forces = [
                build_forces(
                    level,
                    guide_map,
                    self.garments,
                    frames=frames,
                    gravity=self._gravity,
                    potential=self._settings.potential,
                )
                for level, guide_map in zip(self.levels, self._guide_maps, strict=True)
            ]
            self._material = material
            self._stretch = max(frame.fabric.stretch for frame in frames)
        return self._forces

    def _predict(self, kept: Carried | None, coarse: Tensor, world: Tensor) -> tuple[Tensor | None, str]:
        """Where the last frame's detail would be now, unless the cage jumped."""
        if kept is None or self._settings.temporal == "off":
            return None, "cold"
        shifted = Carried(self._tensor((kept.coarse - world.mean(dim=0)).numpy()), kept.detail, kept.frames)
        predicted, motion, turn = self._frames.predict(shifted, coarse)
        reset = self._settings.reset
        if motion > reset.move or turn > reset.turn:
            return None, f"cold: the cage moved {motion:.3g} edges and turned {np.degrees(turn):.3g} degrees"
        finest = self.levels[-1]
        base = finest.base.apply(coarse)
        predicted = torch.where(finest.free, predicted, base)
        carried, plain = (self._forces[-1].elastic_energy(x) for x in (predicted, base))
        least = LEAST_STRAIN**2 * self._stretch * float(finest.vertex_area.sum())
        if carried > WORTH * max(plain, least):
            return None, f"cold: carried detail has {carried / max(plain, least):.3g} times the upsampled cage's energy"
        return predicted, "warm"

    def _contact(
        self, touching: Sequence[Touching], coarse: Tensor, origin: np.ndarray, frames: Sequence[GarmentFrame]
    ) -> FrameContact | None:
        """The bodies of a frame, or None when there are none."""
        if not touching or not len(coarse):
            return None
        weight = float(np.linalg.norm(self._gravity)) * max(frame.fabric.density for frame in frames)
        settings = self._settings.contact.scaled(self.levels[0], stretch=self._stretch, weight=weight)
        return FrameContact.begin(self.levels, touching, coarse, origin=origin, settings=settings)

    def _descend(
        self,
        forces: list[LevelForces],
        coarse: Tensor,
        predicted: Tensor | None,
        clock: float,
        *,
        contact: FrameContact | None,
    ) -> tuple[Tensor, list[LevelReport], ForceModule]:
        """Walk the levels; a warm start goes straight to the finest."""
        first = 0 if predicted is None and self._settings.method.nested else len(self.levels) - 1
        x = predicted if predicted is not None else self.levels[first].base.apply(coarse)
        reports: list[LevelReport] = []
        module = ForceModule(())
        for index in range(first, len(self.levels)):
            level, lasting = self.levels[index], forces[index]
            if index > first and level.from_below is not None:
                x = level.from_below.apply(x)
            module = lasting.module(coarse)
            terms = module
            if predicted is not None and self._settings.temporal == "tether":
                terms = ForceModule((*module.forces, lasting.tether(self._settings.tether, predicted)))
            budget = self._budget(index, len(self.levels), clock)
            view = None if contact is None else contact.at(level, self.levels[-1])
            cold = predicted is None
            x, made, touched = self._solve_level(terms, lasting.metric, level, x=x, cold=cold, view=view, budget=budget)
            if index < len(self.levels) - 1:
                made[-1].energies = module.energies(x)
            reports += made
            module = module if touched is None else ForceModule((*module.forces, touched))
        return x, reports, module

    def _solve_level(
        self,
        terms: ForceModule,
        metric: Metric,
        level: Level,
        *,
        x: Tensor,
        cold: bool,
        view: LevelContact | None,
        budget: Budget,
    ) -> tuple[Tensor, list[LevelReport], Contact | None]:
        """Solve one level, in rounds where bodies are near; returns the contact term too, where there is one."""

        def system(touched: Contact | None) -> System:
            module = terms if touched is None else ForceModule((*terms.forces, touched))
            return System(module, metric, free=level.free, spacing=level.spacing, level=level)

        integrator = self._settings.method.build()
        touched = None if view is None else view.term(x)
        if cold:
            x = leave_saddle(system(touched), level, x, outward=self._outward)
        if view is None:
            x, report = solve_level(system(None), integrator, x, level=level.index, budget=budget)
            return x, [report], None
        x, made, touched = solve_rounds(
            system, integrator, x, touched=touched, view=view, level=level.index, budget=budget
        )
        if touched is not None and level is self.levels[-1] and made[-1].remaining_move > UNSETTLED:
            free = level.free & ~touched.near(level)
            apart = System(terms, metric, free=free, spacing=level.spacing, level=level)
            x, report = solve_level(apart, integrator, x, level=level.index, budget=budget)
            made.append(report)
        return x, made, touched

    def _budget(self, index: int, count: int, clock: float) -> Budget:
        """Steps and deadline of one level."""
        settings = self._settings
        below = count - 1 - index
        deadline = None
        if settings.budget_ms is not None:
            deadline = clock + 1e-3 * settings.budget_ms * (1.0 - 0.7 * (below > 0)) ** min(below, 2)
        if not below:
            return Budget(settings.steps, settings.tolerance, deadline)
        return Budget(COARSE_STEPS * settings.steps, COARSE_TOLERANCE * settings.tolerance, deadline)

    def _finish(self, x: Tensor, coarse: Tensor, frames: Sequence[GarmentFrame]) -> Tensor:
        """Scale the detail where an artist asked for more or less of it."""
        finest = self.levels[-1]
        gain = np.concatenate([f.detail * g.detail_scale for f, g in zip(frames, self.garments, strict=True)])
        if np.all(gain == 1.0):
            return x
        fine_gain = self._tensor(finest.from_coarse @ gain).unsqueeze(1)
        smooth = finest.smooth_base.apply(coarse)
        return torch.where(finest.free, smooth + fine_gain * (x - smooth), x)

    def _telemetry(
        self, module: ForceModule, x: Tensor, coarse: Tensor, reports: list[LevelReport]
    ) -> dict[str, object]:
        finest = self.levels[-1]
        return {
            "levels": [asdict(report) for report in reports],
            "energy_joules": {
                "input": module.energies(finest.base.apply(coarse)),
                "output": module.energies(x),
            },
            "strain": edge_strain(finest, x),
            "sharp_folds": sharp_folds(finest, x),
        }

    def _blame(self, lasting: LevelForces, coarse: Tensor, error: SolveError, at: float | None) -> str:
        """Name prim, time and the term that is not finite."""
        x = self.levels[-1].base.apply(coarse)
        energies = lasting.module(coarse).energies(x)
        broken = [name for name, value in energies.items() if not np.isfinite(value)] or ["none at the input"]
        where = ", ".join(f"<{garment.path}>" for garment in self.garments)
        when = "" if at is None else f" at time code {at:g}"
        return f"{where}{when}: {error}; terms that are not finite: {', '.join(broken)}"


def _recentred(garment: Garment) -> Garment:
    """The garment with its rest shape about the origin: far away, float32 would lose its edges."""
    if not len(garment.rest):
        return garment
    return replace(garment, rest=garment.rest - garment.rest.mean(axis=0))


def edge_strain(level: Level, x: Float[Tensor, "vertices 3"]) -> dict[str, float]:
    """Size of the edges' relative extension: median, 99th percentile and largest."""
    if not len(level.edges):
        return {"p50": 0.0, "p99": 0.0, "max": 0.0}
    ends = level.edges.long()
    strain = ((x[ends[:, 1]] - x[ends[:, 0]]).norm(dim=1) / level.rest_length - 1.0).abs().cpu().numpy()
    p50, p99 = np.percentile(strain, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "max": float(strain.max())}
