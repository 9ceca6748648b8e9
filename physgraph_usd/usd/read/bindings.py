"""Places targets on refined cloth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from pxr import Sdf
from scipy import sparse

from ...errors import GarmentError
from ...solver.mesh.subdivide import ControlMesh, Refinement
from ..mesh.bind import Binding, Follower
from .reader import Shot
from .targets import Target, points_at


@dataclass(frozen=True, eq=False)
class PlacedTarget:
    """A target at a time code.

    Attributes:
        points: Points [m], world space, shape (N, 3).
        follower: The binding at the refined surface, to turn normals.
    """

    target: Target
    points: np.ndarray
    follower: Follower


class GarmentBindings:
    """The bound targets of one garment.

    Attributes:
        targets: The targets, each after its parent target.
    """

    def __init__(self, shot: Shot, index: int, steps: Sequence[Refinement]) -> None:
        """Bind the targets of a garment, by number, to its smoothly subdivided cage; refinements coarse to fine."""
        garment = shot.scene.garments[index]
        self.targets = [target for target in shot.targets if target.garment == index]
        self._shot, self._index = shot, index
        self._smooth = _smooth_map(garment.control, steps) if self.targets else None
        self._fine = steps[-1].mesh if steps else garment.mesh
        self._bindings: dict[Sdf.Path, Binding] = {}
        bound = {target.path: target for target in self.targets}
        for target in self.targets:
            surface, mesh = self._smoothed(target.time), self._fine
            if target.on is not None:
                parent = bound[target.on]
                surface, mesh = parent.points, parent.mesh or mesh
            triangles = mesh.triangulate(surface).triangles
            self._bindings[target.path] = Binding.of(target.points, surface, triangles, rigid=target.rigid)

    def _smoothed(self, time: float | None) -> np.ndarray:
        """The smoothly subdivided cage [m] at a time code, shape (V, 3)."""
        cage = self._shot.cage(self._index, time)
        return cage if self._smooth is None else self._smooth @ cage

    def at(self, time: float | None, cloth: np.ndarray) -> Iterator[PlacedTarget]:
        """Place the targets by the refined cloth [m] at a time code, shape (V, 3).

        Raises:
            GarmentError: A target that adds to its own motion has no points there.
        """
        placed: dict[Sdf.Path, np.ndarray] = {}
        for target in self.targets:
            binding = self._bindings[target.path]
            follower = binding.at(cloth if target.on is None else placed[target.on])
            points = follower.points
            if target.detail and target.on is None:
                points = self._own(target, time) + points - binding.at(self._smoothed(time)).points
            placed[target.path] = points
            yield PlacedTarget(target, points, follower)

    def _own(self, target: Target, time: float | None) -> np.ndarray:
        """A target's own points [m] at a time code."""
        points = points_at(self._shot.stage.GetPrimAtPath(target.path), self._shot.metres_per_unit, time)
        if points is None or len(points) != len(target.points):
            remedy = "author its points there, or take the mode follow"
            raise GarmentError(str(target.path), "has no points of its own", time=time, remedy=remedy)
        return points


def _smooth_map(cage: ControlMesh, steps: Sequence[Refinement]) -> sparse.csr_matrix | None:
    """The smooth map from a cage to its fine mesh, shape (V, C); None at level 0."""
    smooth = None
    for step in steps:
        once, cage = cage.subdivided(step)
        smooth = once if smooth is None else sparse.csr_matrix(once @ smooth)
    return smooth
