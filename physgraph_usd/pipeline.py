"""Frames in, states out: warm starts, reuse of equal frames; knows no USD and no force by name."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np
import torch

from .colliders.pose import Pose
from .contact.bodies import Touching
from .contact.broad_phase import Bodies, bounds_of, reach_of
from .detail import Carried
from .errors import GarmentError
from .group import Group, SolveSettings
from .level import refine_garments
from .mesh.subdivide import Refinement
from .scene import Frame, GarmentFrame, Scene, State


@dataclass(frozen=True, eq=False)
class _Known:
    """One garment's last solved frame, and the bodies that it could touch there."""

    frame: GarmentFrame
    points: np.ndarray
    carried: Carried
    near: dict[int, Pose | None]


class Refiner:
    """Refines the frames of one scene in order.

    Garments that cannot touch are solved apart, each in a group of its own.

    Attributes:
        refinements: The subdivisions of each garment, coarsest first.
        groups: Garments solved together, in the order of the garments.
    """

    def __init__(
        self,
        scene: Scene,
        settings: SolveSettings,
        *,
        levels: Sequence[int] | None = None,
        dtype: torch.dtype = torch.float32,
        device: str = "cpu",
        lanes: int = 1,
    ) -> None:
        """Subdivide the garments and prepare their levels.

        Args:
            scene: The scene.
            settings: How to solve.
            levels: Subdivisions of each garment; the garments' own when None.
            dtype: Scalar type of the solve.
            device: "cpu" or a CUDA device.
            lanes: Most threads that a kernel uses on the CPU; the result does not depend on it.

        Raises:
            GarmentError: A rest shape cannot be solved on.
        """
        for garment in scene.garments:
            _require_solvable(garment.path, garment.mesh.indices, garment.mesh.counts, garment.rest)
        chosen = levels if levels is not None else [garment.level for garment in scene.garments]
        self.refinements = self.subdivide(scene, chosen)
        self._settings = settings
        self._spacing = median(np.diff(scene.times).tolist()) if len(scene.times) > 1 else 0.0
        self.groups = [
            Group([garment], [chain], scene.gravity, settings, dtype=dtype, device=device, lanes=lanes)
            for garment, chain in zip(scene.garments, self.refinements, strict=True)
        ]
        self._scene = scene
        self._bodies = Bodies(scene.colliders, device=device, lanes=lanes)
        self._last: list[_Known | None] = [None] * len(self.groups)
        self._time: float | None = None

    @staticmethod
    def subdivide(scene: Scene, levels: Sequence[int]) -> list[tuple[Refinement, ...]]:
        """The refinements of each garment, without the solver."""
        return refine_garments(scene.garments, levels)

    def forget(self) -> None:
        """Start the next frame cold."""
        self._last = [None] * len(self.groups)
        self._time = None

    def use(self, settings: SolveSettings) -> None:
        """Solve the frames that follow in another way, the next one cold; levels and metrics are kept."""
        self._settings = settings
        for group in self.groups:
            group.use(settings)
        self.forget()

    def touching(self, index: int, frame: Frame) -> tuple[Touching, ...]:
        """The surfaces that a garment may touch in a frame."""
        self._bodies.pose(frame.colliders)
        garment = frame.garments[index]
        return self._bodies.touching(self._near(index, garment), [garment.offset])

    def refine(self, frames: Iterable[Frame]) -> Iterator[State]:
        """Solve frames in order, one state a frame.

        Raises:
            SolveError: A term of the potential is not finite.
        """
        for frame in frames:
            yield self.solve(frame)

    def solve(self, frame: Frame, wanted: Sequence[bool] | None = None) -> State:
        """Solve one frame, starting from the last one solved where that helps.

        Args:
            frame: The frame.
            wanted: For each garment, whether it is asked for; all when None.
        """
        gap = self._is_gap(frame.time)
        self._bodies.pose(frame.colliders)
        points: list[np.ndarray | None] = []
        telemetry: list[dict[str, object]] = []
        reused: list[bool] = []
        for index, garment in enumerate(frame.garments):
            known = self._last[index]
            same = known is not None and _same(garment, known.frame) and self._same_bodies(index, garment, known)
            reused.append(same)
            if wanted is not None and not wanted[index]:
                points.append(None)
                telemetry.append({"start": "left out: the garment has no sample here"})
            elif known is not None and same:
                points.append(known.points)
                telemetry.append({"start": "reused: the input equals the last frame's"})
            else:
                solved, entry = self._solve_group(index, garment, frame.time, gap=gap)
                points.append(solved)
                telemetry.append(entry)
        self._time = frame.time
        return State(frame.time, tuple(points), tuple(telemetry), tuple(reused))

    def _solve_group(
        self, index: int, frame: GarmentFrame, time: float | None, *, gap: bool
    ) -> tuple[np.ndarray, dict[str, object]]:
        """Solve one garment apart and keep what its next frame needs; returns its points and telemetry."""
        known = self._last[index]
        kept = None if gap or known is None else known.carried
        near = self._near(index, frame)
        while True:
            touching = self._bodies.touching(near, [frame.offset])
            solved, carried, entry = self.groups[index].solve([frame], kept, at=time, touching=touching)
            more = self._reached(index, frame, solved[0])
            if more <= set(near):
                break
            near = tuple(sorted({*near, *more}))
        self._last[index] = _Known(frame, solved[0], carried, {each: self._bodies.pose_of(each) for each in near})
        if self._scene.garments[index].colliders:
            entry["near"] = [self._scene.colliders[each].path for each in near]
        if gap:
            entry["start"] = "cold: the time between samples is too long"
        return solved[0], entry

    def _near(self, index: int, frame: GarmentFrame) -> tuple[int, ...]:
        """Numbers of the bodies that a garment may touch."""
        garment = self._scene.garments[index]
        if not garment.colliders or self._settings.contact.form == "off":
            return ()
        return self._bodies.near(garment, bounds_of(frame.points), reach_of(garment, frame))

    def _reached(self, index: int, frame: GarmentFrame, points: np.ndarray) -> set[int]:
        """Numbers of the bodies whose bounds the solved cloth meets."""
        garment = self._scene.garments[index]
        if not garment.colliders or self._settings.contact.form == "off":
            return set()
        return set(self._bodies.near(garment, bounds_of(points), frame.offset))

    def _same_bodies(self, index: int, frame: GarmentFrame, known: _Known) -> bool:
        """Whether the bodies that a garment may touch are where they were."""
        near = self._near(index, frame)
        poses = [(known.near.get(each), self._bodies.pose_of(each)) for each in near]
        return set(near) == set(known.near) and all(a is not None and b is not None and a.equals(b) for a, b in poses)

    def _is_gap(self, time: float | None) -> bool:
        if time is None or self._time is None or not self._spacing:
            return False
        return time - self._time > self._settings.reset.gap * self._spacing


def _same(a: GarmentFrame, b: GarmentFrame) -> bool:
    """Whether two frames would give the same answer, to the bit."""
    settings = (a.fabric, a.guide, a.detail, a.offset) == (b.fabric, b.guide, b.detail, b.offset)
    return settings and a.points.shape == b.points.shape and bool(np.array_equal(a.points, b.points))


def _require_solvable(path: str, indices: np.ndarray, counts: np.ndarray, rest: np.ndarray) -> None:
    """Refuse rest shapes that no length can be measured on."""
    if not np.isfinite(rest).all():
        vertex = int(np.flatnonzero(~np.isfinite(rest).all(axis=1))[0])
        raise GarmentError(path, f"rest position {vertex} is not finite", remedy="give another frame with --rest")
    if not len(indices):
        return
    ends = np.concatenate([[0], np.cumsum(counts)])
    following = np.arange(len(indices)) + 1
    following[ends[1:] - 1] = ends[:-1]
    other = indices[following]
    zero = np.flatnonzero((np.linalg.norm(rest[indices] - rest[other], axis=1) == 0.0) & (indices != other))
    if len(zero):
        a, b = int(indices[zero[0]]), int(other[zero[0]])
        remedy = "merge the two points, or give another rest shape with --rest"
        raise GarmentError(path, f"the rest edge between points {a} and {b} has no length", remedy=remedy)
