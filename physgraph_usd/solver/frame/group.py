"""Garments solved together: their levels, and all data kept from frame to frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..contact.bodies import FrameBodies, Touching
from ..contact.cloth import ClothContact
from ..contact.frame import FrameContact
from ..contact.settings import ContactSettings
from ..forces.base import ForceModule
from ..forces.guide import GuideMap
from ..forces.seam import Seam, level_seams
from ..integrate.base import Integrator, System
from ..integrate.quasi_newton import QuasiNewton
from ..level import Level, Placed, build_levels, fine_meshes, unhindered
from ..mesh.subdivide import Refinement
from ..scene import Garment, GarmentFrame, recentred
from .from_cage import Followers, MovingFrames
from .level_forces import LevelForces
from .settings import SolveSettings


@dataclass(frozen=True, eq=False)
class Cage:
    """Positions of a group's cages.

    Attributes:
        world: World positions [m], shape (C, 3), float64.
        origin: Mean of the world positions [m], shape (3,).
        points: Positions relative to the origin [m], in the scalar type of the solve.
    """

    world: np.ndarray
    origin: np.ndarray
    points: Float[Tensor, "coarse 3"]


@dataclass(frozen=True, eq=False)
class Group:
    """Garments solved together, made by `Group.of`.

    Attributes:
        gravity: [m/s^2], shape (3,).
        levels: The levels, cage first.
        guide_maps: The guide's averaging operator of each level.
        moving_frames: Frames of the cage, to carry the last frame's detail.
        followers: Vertices not moved by the solve.
    """

    garments: tuple[Garment, ...]
    gravity: np.ndarray
    settings: SolveSettings
    levels: tuple[Level, ...]
    guide_maps: list[GuideMap]
    moving_frames: MovingFrames
    followers: Followers
    cloth: ClothContact
    seams: list[Seam | None]
    # The lasting terms of the last materials only.
    _forces: dict[tuple[object, ...], list[LevelForces]] = field(default_factory=dict)
    _integrators: dict[Callable[[], Integrator], Integrator] = field(default_factory=dict)

    @staticmethod
    def of(
        garments: Sequence[Garment],
        refinements: Sequence[Sequence[Refinement]],
        gravity: np.ndarray,
        settings: SolveSettings,
        *,
        dtype: torch.dtype,
        device: str,
        threads: int = 1,
    ) -> Group:
        """Build the levels.

        Args:
            garments: Garments solved together.
            refinements: Refinements of each garment.
            gravity: [m/s^2], shape (3,).
            dtype: Scalar type of the solve.
            device: "cpu" or a CUDA device.
            threads: Most threads per kernel on the CPU.
        """
        centred = [recentred(garment) for garment in garments]
        levels = build_levels(centred, refinements, dtype=dtype, device=device, threads=threads)
        return Group(
            tuple(garments),
            gravity,
            settings,
            levels,
            guide_maps=[GuideMap(level) for level in levels],
            moving_frames=MovingFrames(levels[0], levels[-1]),
            followers=Followers(levels[-1], garments, fine_meshes(garments, refinements)),
            cloth=ClothContact(levels, tuple(garments)),
            seams=level_seams(levels, garments),
        )

    @cached_property
    def spacings(self) -> list[float]:
        """Mean of each level's local edges [m]."""
        return [float(level.spacing.mean()) for level in self.levels]

    @cached_property
    def outward(self) -> Float[Tensor, " garments"]:
        """Sign of each garment's normals: 1 for outward, -1 for inward."""
        return torch.tensor([-1.0 if g.flipped else 1.0 for g in self.garments], device=self.levels[0].device)

    def per_garment(self, points: Float[np.ndarray, "vertices 3"]) -> list[np.ndarray]:
        """The rows of each garment."""
        return [points[span] for span in self.levels[-1].spans]

    def tensor(self, array: np.ndarray) -> Tensor:
        """An array in the type and on the device of the solve."""
        return torch.as_tensor(array, dtype=self.levels[0].dtype, device=self.levels[0].device)

    def cage(self, frames: Sequence[GarmentFrame]) -> Cage:
        """Positions of the cages."""
        world = np.concatenate([frame.points for frame in frames])
        origin = world.mean(axis=0) if len(world) else np.zeros(3)
        return Cage(world, origin, self.tensor(world - origin))

    def forces_for(self, frames: Sequence[GarmentFrame]) -> list[LevelForces]:
        """The lasting terms of each level, new ones when a material changes."""
        key = tuple((frame.fabric, frame.guide) for frame in frames)
        if key not in self._forces:
            last = [forces for levels in self._forces.values() for forces in levels] if self.settings.rough else []
            lent = [forces.lends() for forces in last] or [None] * len(self.levels)
            levels, common = zip(self.levels, self.guide_maps, lent, strict=True), (tuple(frames), self.gravity)
            forces = [LevelForces(level, guide, self.garments, *common, lent=terms) for level, guide, terms in levels]
            self._forces.clear()
            self._forces[key] = forces
        return self._forces[key]

    @property
    def integrator(self) -> Integrator:
        """The settings' integrator, built on first use."""
        return self._built(self.settings.method.build)

    @property
    def untangler(self) -> Integrator:
        """Integrator to pull crossing cloth apart: forces ending at a crossing mislead the network."""
        return self._built(QuasiNewton)

    def _built(self, build: Callable[[], Integrator]) -> Integrator:
        built = self._integrators.get(build)
        return built or self._integrators.setdefault(build, build())

    def contact(
        self,
        frames: Sequence[GarmentFrame],
        cage: Cage,
        *,
        touching: Sequence[Touching] = (),
        settings: ContactSettings | None = None,
        given_up: Bool[Tensor, " coarse"] | None = None,
    ) -> FrameContact | None:
        """Contact of a frame's cloth, or None without possible contact.

        Args:
            touching: Surfaces within reach of the garments.
            settings: Contact settings; the group's own when None.
            given_up: As for `FrameContact`.
        """
        settings = settings or self.settings.contact
        touching = touching if settings.form != "off" else ()
        itself = settings.cloth != "off" and self.cloth.meets.any()
        if not len(self.levels[0].triangles) or not (itself or touching or any(self.seams)):
            return None
        points, origin, edge = cage.points, cage.origin, self.spacings[0]
        settings = settings.scaled(edge, stretch=max(garment.fabric.stretch for garment in frames))
        bodies = FrameBodies.begin(touching, points, edge=edge, origin=origin, settings=settings) if touching else None
        return FrameContact(
            self.levels,
            points,
            bodies=bodies,
            cloth=self.cloth,
            thickness=[garment.fabric.thickness for garment in frames],
            settings=settings,
            seams=self.seams,
            given_up=given_up,
        )

    def upsampled(self, frames: Sequence[GarmentFrame]) -> list[np.ndarray]:
        """World positions of each garment [m] on its cage's smooth surface, unsolved."""
        cage, finest = self.cage(frames), self.levels[-1]
        smooth = unhindered(finest.smooth_base.apply(cage.points))
        return self.per_garment(self.followers.placed(smooth, cage.origin, cage.world))

    def energies(
        self, frames: Sequence[GarmentFrame], points: Sequence[np.ndarray], touching: Sequence[Touching] = ()
    ) -> dict[str, float]:
        """Energy of each term [J] at the garments' world positions [m], with contact detected again."""
        module, contact, origin = self.potential(frames, touching)
        x = self.tensor(np.concatenate(points) - origin)
        touched = () if contact is None else contact.at(self.levels[-1]).terms(x)
        return ForceModule((*module.forces, *touched)).energies(x)

    def moved_safely(
        self,
        frames: Sequence[GarmentFrame],
        start: Sequence[np.ndarray],
        wanted: Sequence[np.ndarray],
        *,
        touching: Sequence[Touching] = (),
    ) -> tuple[list[np.ndarray], dict[str, Any]]:
        """World positions [m] as near to the wanted as possible without new crossings on the way, and out of bodies.

        Also returns contact and crossings at the result, as plain values; empty without possible contact.
        """
        _, contact, origin = self.potential(frames, touching)
        if contact is None:
            return list(wanted), {}
        x, target = (self.tensor(np.concatenate(points) - origin) for points in (start, wanted))
        moved, _ = contact.finish(contact.at(self.levels[-1]).moved(Placed(x), target))
        points = np.concatenate(wanted) + (moved - target).double().cpu().numpy()
        return self.per_garment(points), contact.measure(moved)[0]

    def systems(self, frames: Sequence[GarmentFrame]) -> tuple[list[System], Float[Tensor, "coarse 3"]]:
        """The problem of one frame without its solve, for charts and benchmarks.

        Returns:
            One system per level, coarsest first, and the recentred coarse positions [m].
        """
        lasting, (modules, coarse) = self.forces_for(frames), self.modules(frames)
        return [forces.system_in(module) for forces, module in zip(lasting, modules, strict=True)], coarse

    def potential(
        self, frames: Sequence[GarmentFrame], touching: Sequence[Touching] = ()
    ) -> tuple[ForceModule, FrameContact | None, np.ndarray]:
        """The finest level's forces in a frame, the contact, and the origin's world position [m], to judge results."""
        cage = self.cage(frames)
        contact = self.contact(frames, cage, touching=touching)
        aim = cage.points if contact is None else contact.aim
        return self.forces_for(frames)[-1].module(aim, frames), contact, cage.origin

    def modules(self, frames: Sequence[GarmentFrame]) -> tuple[list[ForceModule], Float[Tensor, "coarse 3"]]:
        """The forces of one frame, one module per level, and the recentred coarse positions [m]."""
        world = torch.as_tensor(np.concatenate([f.points for f in frames]), dtype=torch.float64)
        coarse = self.tensor((world - world.mean(dim=0)).numpy())
        return [lasting.module(coarse, frames) for lasting in self.forces_for(frames)], coarse
