"""A scene as the solver has it: subdivisions, groups of garments and posed bodies, whatever the settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce

import numpy as np
import torch

from ...errors import GarmentError
from ..contact.bodies import Touching
from ..contact.broad_phase import Bodies, Parts, bounds_of, reach_of
from ..contact.heat import body_crossings, penetration_map
from ..level import refine_garments
from ..mesh.topology import edges_of
from ..scene import Frame, GarmentFrame, Scene, out_of_bounds
from .group import Group
from .settings import SolveSettings


class SceneCloth:
    """What the frames of a scene are solved with; one frame's bodies are posed at a time.

    Attributes:
        scene: The scene.
        refinements: The subdivisions of each garment, coarsest first.
        bodies: The bodies that garments may touch.
    """

    def __init__(self, scene: Scene, levels: Sequence[int], *, dtype: torch.dtype, device: str, threads: int) -> None:
        """Subdivide the garments.

        Args:
            scene: The scene.
            levels: Subdivisions of each garment.
            dtype: Scalar type of the solve.
            device: "cpu" or a CUDA device.
            threads: Most threads that a kernel uses on the CPU.

        Raises:
            GarmentError: A rest shape cannot be solved on.
        """
        for garment in scene.garments:
            if wrong := out_of_bounds(garment.rest):
                remedy = "give another frame with --rest"
                raise GarmentError(garment.path, f"the rest shape's {wrong}", remedy=remedy)
        self.scene, self.refinements = scene, refine_garments(scene.garments, levels)
        self.bodies = Bodies(scene.colliders, device=device, threads=threads)
        self._place, self._device = {"dtype": dtype, "device": device, "threads": threads}, device
        self._groups: dict[tuple[int, ...], Group] = {}
        self._parts = {together: Parts(scene.garments, together=together) for together in (False, True)}

    def group(self, part: tuple[int, ...], settings: SolveSettings) -> Group:
        """The group of garments solved together, built when first asked for; levels and metrics stay."""
        known = self._groups.get(part)
        if known is None:
            garments = [self.scene.garments[index] for index in part]
            chains = [self.refinements[index] for index in part]
            known = Group.of(garments, chains, self.scene.gravity, settings, **self._place)
        self._groups[part] = known if known.settings is settings else replace(known, settings=settings)
        return self._groups[part]

    def parts_of(self, frame: Frame, settings: SolveSettings) -> list[tuple[int, ...]]:
        """Numbers of the garments that are solved together in a frame."""
        return self._parts[settings.contact.cloth != "off"].of(frame.garments)

    def upsampled(self, index: int, points: np.ndarray) -> np.ndarray:
        """A cage's positions [m] on its mesh as it is subdivided, linearly."""
        return reduce(lambda x, step: np.asarray(step.linear @ x), self.refinements[index], points)

    def near(self, part: Sequence[int], frames: Sequence[GarmentFrame], settings: SolveSettings) -> tuple[int, ...]:
        """Numbers of the bodies that garments may touch."""
        found: set[int] = set()
        for index, frame in zip(part, frames, strict=True):
            garment = self.scene.garments[index]
            if garment.colliders and settings.contact.sees_bodies:
                found |= set(self.bodies.near(garment, bounds_of(frame.points), reach_of(garment, frame)))
        return tuple(sorted(found))

    def reached(
        self,
        part: Sequence[int],
        frames: Sequence[GarmentFrame],
        points: Sequence[np.ndarray],
        settings: SolveSettings,
    ) -> set[int]:
        """Numbers of the bodies whose bounds solved cloth meets, given its positions [m]."""
        found: set[int] = set()
        for index, frame, solved in zip(part, frames, points, strict=True):
            garment = self.scene.garments[index]
            if garment.colliders and settings.contact.form != "off":
                found |= set(self.bodies.near(garment, bounds_of(solved), frame.offset))
        return found

    def touching(
        self, part: Sequence[int], frames: Sequence[GarmentFrame], near: Sequence[int]
    ) -> tuple[Touching, ...]:
        """Surfaces of bodies, and the distance that each garment keeps from them."""
        felt = [self.scene.garments[index].colliders for index in part]
        pairs = zip(felt, frames, strict=True)
        offsets = [[frame.offset if body in bodies else None for body in near] for bodies, frame in pairs]
        return self.bodies.touching(near, offsets)

    def heat(self, index: int, points: np.ndarray, crossing: np.ndarray | None) -> dict[str, np.ndarray]:
        """Where a garment is inside bodies whose bounds it meets, pushed by them or not, and where cloth crosses.

        Args:
            index: Number of the garment.
            points: World positions [m], shape (V, 3).
            crossing: Which vertices belong to cloth that crosses cloth, shape (V,); none when None.
        """
        garment, chain = self.scene.garments[index], self.refinements[index]
        near = self.bodies.near(garment, bounds_of(points), 0.0)
        surfaces = [each.surface for each in self.bodies.touching(near, [[0.0] * len(near)])]
        finest, rest = (chain[-1].mesh, None) if chain else (garment.mesh, garment.rest)
        triangles = finest.triangulate(rest).triangles
        edges = edges_of(triangles, len(points)).vertices
        crosses = body_crossings(surfaces, points, edges, triangles=triangles, device=self._device)
        crosses = crosses if crossing is None else crosses | crossing
        depth = penetration_map(surfaces, points, edges, device=self._device)
        return {"penetration": depth, "crossing": crosses.astype(np.float32)}
