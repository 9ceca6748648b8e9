"""Broad phase: bodies that a garment can touch in a frame, with surfaces posed once a frame for all garments."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial import cKDTree

from ..colliders.mesh import MeshBody, MeshSurface
from ..colliders.orient import FIXED
from ..colliders.pose import Collider, Pose, bounds_of
from ..mesh.topology import joined_by
from ..rigid import AT_REST, Rigid
from ..scene import Garment, GarmentFrame, mean_edge
from ..strain import has_collapsed
from .bodies import Touching

REACH = 2.0
"""Expected distance of the cloth beyond the bounds of its cage, in mean cage edges."""
COPIED_POINT, COPY = 1e-4, 0.5
"""Distance of coinciding points, in mean edges, and the fraction of coinciding points from which a cage is a copy of
another cage. Copies do not touch."""


class TouchingGroups:
    """Groups of garments in mutual contact in a frame."""

    def __init__(self, garments: Sequence[Garment], *, joint: bool) -> None:
        """Measure the cages.

        Args:
            joint: False solves every garment apart.
        """
        self._garments, self._joint = tuple(garments), joint
        self._edges = [mean_edge(garment) for garment in garments]

    def of(self, frames: Sequence[GarmentFrame]) -> list[tuple[int, ...]]:
        """Indices of the garments in each group that is solved together, in order.

        Two cages are near if two of their vertices are closer than the expected distance of the cloth from its cage
        plus an edge, because a vertex may be near the middle of an edge. A collapsed cage is near no cage.
        """
        pairs = zip(self._garments, frames, strict=True)
        intact = [not has_collapsed(garment, frame.points) for garment, frame in pairs]
        trees: dict[int, cKDTree] = {}
        near = [
            (a, b)
            for a, b in (self._boxes_meet(frames) if self._joint else ())
            if intact[a] and intact[b] and touch_one_another(self._garments[a], self._garments[b])
            if self._close(a, b, frames, trees)
        ]
        group = joined_by(np.array(near, np.int64).reshape(-1, 2), len(frames))
        return [tuple(np.flatnonzero(group == number).tolist()) for number in range(group.max(initial=-1) + 1)]

    def _reach(self, index: int, frame: GarmentFrame) -> float:
        """A garment's share of the distance at which two garments are near [m]."""
        return 0.5 * frame.fabric.thickness + (0.5 * REACH + 1.0) * self._edges[index]

    def _boxes_meet(self, frames: Sequence[GarmentFrame]) -> Iterator[tuple[int, int]]:
        """Pairs of cages whose bounds, grown by the reach, overlap, in order of index; sweep along an axis."""
        bounds = np.array([bounds_of(frame.points) for frame in frames]).reshape(-1, 2, 3)
        reach = np.array([self._reach(index, frame) for index, frame in enumerate(frames)])[:, None]
        low, high = bounds[:, 0] - reach, bounds[:, 1] + reach
        order = np.flatnonzero((low <= high).all(axis=1))  # Bounds of a cage without finite points are empty.
        if not len(order):
            return
        axis = int(np.ptp(low[order], axis=0).argmax())
        order = order[np.argsort(low[order, axis], kind="stable")]
        low, high = low[order], high[order]
        ends = np.searchsorted(low[:, axis], high[:, axis], side="right")
        pairs = []
        for rank, end in enumerate(ends.tolist()):
            candidates = slice(rank + 1, end)
            meets = (low[candidates] <= high[rank]).all(axis=1) & (low[rank] <= high[candidates]).all(axis=1)
            pairs += [sorted((order[rank], partner)) for partner in order[candidates][meets]]
        yield from sorted((int(a), int(b)) for a, b in pairs)

    def _close(self, a: int, b: int, frames: Sequence[GarmentFrame], trees: dict[int, cKDTree]) -> bool:
        """True if vertices of two cages are within reach and the cages are not copies."""
        reach = self._reach(a, frames[a]) + self._reach(b, frames[b])
        for index in (a, b):
            points = frames[index].points
            trees[index] = trees.get(index) or cKDTree(points[np.isfinite(points).all(axis=1)])
        distance = np.asarray(trees[a].query(trees[b].data, distance_upper_bound=reach)[0])
        copies = np.mean(distance < COPIED_POINT * (self._edges[a] + self._edges[b]))
        return bool(np.isfinite(distance).any()) and float(copies) < COPY


def touch_one_another(a: Garment, b: Garment) -> bool:
    """True if two different garments may be in contact."""
    return b.path not in a.apart_from and a.path not in b.apart_from


class Bodies:
    """The colliders of a scene, posed lazily.

    Attributes:
        colliders: Identities of the colliders.
    """

    def __init__(self, colliders: Sequence[Collider], *, device: str, threads: int) -> None:
        """Prepare a body for each collider; a body is built when a garment first comes near."""
        self.colliders = tuple(colliders)
        self._device, self._threads = device, threads
        self.forget()
        self._poses: Sequence[Pose | None] = ()
        self._surfaces: dict[int, tuple[MeshSurface, ...]] = {}
        self._bounds: dict[int, np.ndarray] = {}

    def forget(self) -> None:
        """Build every body anew: a refitted hierarchy breaks ties by the pose of its first build."""
        self._meshes = []
        for collider in self.colliders:
            side = "front" if collider.kind == "plane" and collider.side not in FIXED else collider.side
            self._meshes.append(MeshBody(side=side, device=self._device, threads=self._threads))

    def pose(self, poses: Sequence[Pose | None]) -> None:
        """Set the pose of each collider for a frame."""
        self._poses, self._surfaces, self._bounds = poses, {}, {}

    def pose_of(self, index: int) -> Pose | None:
        """The pose of a collider in this frame."""
        return self._poses[index] if index < len(self._poses) else None

    def near(self, garment: Garment, bounds: np.ndarray, margin: float) -> tuple[int, ...]:
        """Indices of the garment's colliders with bounds that meet the given bounds.

        Args:
            bounds: Least and greatest corner [m], world space, shape (2, 3).
            margin: Largest distance between the bounds beyond the collider's own offset [m].
        """
        return tuple(index for index in garment.colliders if self._meets(index, bounds, margin))

    def _meets(self, index: int, bounds: np.ndarray, margin: float) -> bool:
        pose = self.pose_of(index)
        if pose is None:
            return False
        if index not in self._bounds:
            finite = np.isfinite(pose.points)
            points = pose.points if finite.all() else pose.points[finite.all(axis=1)]
            if pose.endless:  # Cloth at any depth behind a plane is near the plane.
                a, b, c = pose.points[:3]
                away = FIXED.get(self.colliders[index].side, 1.0) * np.cross(b - a, c - a)
                points = np.concatenate([points, points - float(np.ptp(points, axis=0).max()) * away])
            self._bounds[index] = bounds_of(points)
        grow = margin + self.colliders[index].offset
        low, high = self._bounds[index]
        return bool((bounds[0] - grow <= high).all() and (low <= bounds[1] + grow).all())

    def touching(
        self,
        indices: Sequence[int],
        offsets: Sequence[Sequence[float | None]],
        *,
        before: Sequence[Pose | None] = (),
        motion: Rigid = AT_REST,
    ) -> tuple[Touching, ...]:
        """Posed surfaces of colliders.

        Args:
            before: Poses of all colliders in the start frame; () if unknown.
            motion: Motion from the start frame to this frame.
            offsets: For each garment, the distance kept from each collider [m]; None if the garment ignores the
                collider.
        """
        touched = []
        for column, index in enumerate(indices):
            collider = self.colliders[index]
            distances = (row[column] for row in offsets)
            offset = tuple(-math.inf if distance is None else distance + collider.offset for distance in distances)
            pose_before = before[index] if before else None
            for surface in self._posed(index):
                placed = None if pose_before is None else surface.placed(pose_before)
                placed = None if placed is None else motion(placed)
                touched.append(Touching(collider.path, surface, offset, placed))
        return tuple(touched)

    def _posed(self, index: int) -> tuple[MeshSurface, ...]:
        if index not in self._surfaces:
            pose = self._poses[index]
            self._surfaces[index] = () if pose is None else self._meshes[index].pose(pose)
        return self._surfaces[index]


def reach_of(garment: Garment, frame: GarmentFrame) -> float:
    """Distance from the cage's bounds within which a body is near [m]: offset plus expected move of the cloth."""
    return frame.offset + REACH * mean_edge(garment)
