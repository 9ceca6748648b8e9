"""Refines the frames of a scene in order; each frame starts from the last frame if useful."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from dataclasses import replace
from statistics import median
from typing import Any

import numpy as np
import torch

from ..contact.bodies import Touching
from ..deadline import clock_of, ends_after
from ..mesh.subdivide import Refinement
from ..scene import Frame, Result, Scene, refuse_far
from .group import Group
from .history import GarmentHistory, Member
from .scene_frame import SceneCloth, SceneFrame
from .settings import SolveSettings

LIMIT, LEAST_LIMIT, LIMIT_PER_VERTEX = 20.0, 120.0, 0.01
"""Time limit of a frame by `deadline.clock_of`, processor time on the CPU: a multiple of the median over the shot's
frames, but at least a number of seconds plus seconds per fine vertex. The slowest cold frames of the samples and shots
take 0.6 ms per vertex on one core, and the first frame on a machine may compile kernels, some 15 s. No ordinary frame
should reach the limit."""


class Refiner:
    """Refines the frames of one scene in order.

    Garments unable to touch in a frame are solved separately, the others together.
    """

    def __init__(
        self,
        scene: Scene,
        settings: SolveSettings,
        *,
        levels: Sequence[int] | None = None,
        dtype: torch.dtype = torch.float32,
        device: str = "cpu",
        threads: int = 1,
        heat_map: bool = False,
    ) -> None:
        """Subdivide the garments.

        Args:
            levels: Subdivisions of each garment; the garments' own when None.
            dtype: Scalar type of the solve.
            device: "cpu" or a CUDA device.
            threads: Most threads per kernel on the CPU; the result does not depend on the number.
            heat_map: Whether results hold a heat map.

        Raises:
            GarmentError: A rest shape is invalid.
        """
        chosen = levels if levels is not None else [garment.level for garment in scene.garments]
        self._cloth = SceneCloth(scene, chosen, dtype=dtype, device=device, threads=threads)
        self.scene, self._settings, self._heat_map = scene, settings, heat_map
        self._memories = (GarmentHistory(),) * len(scene.garments)
        self._time: float | None = None
        self._prerolled: tuple[Sequence[np.ndarray | None], float] | None = None
        self._clock = clock_of(device)
        self._seconds: list[float] = []  # Durations of completed frames.

    @property
    def refinements(self) -> list[tuple[Refinement, ...]]:
        """The subdivisions of each garment, coarsest first."""
        return self._cloth.refinements

    @property
    def groups(self) -> list[Group]:
        """A single-garment group for each garment, in the order of the garments."""
        return [self.group_of((index,)) for index in range(len(self.scene.garments))]

    def group_of(self, part: tuple[int, ...]) -> Group:
        """The group of garments solved together, built on first use."""
        return self._cloth.group(part, self._settings)

    def forget(self) -> None:
        """Start the next frame cold, like the first."""
        self._cloth.bodies.forget()
        self._memories, self._time, self._prerolled = (GarmentHistory(),) * len(self._memories), None, None

    def start_from_cages(self, cages: Refiner, *, time_code: float) -> None:
        """Start the first frame, if cold, with the cage advanced by another refiner.

        Args:
            cages: A refiner of the same scene without subdivision, after solving the first frame.
            time_code: The start time code of the advance, for the report.
        """
        self._prerolled = (
            [None if memory.last is None else memory.last.state.points for memory in cages._memories],
            time_code,
        )

    def use(self, settings: SolveSettings) -> None:
        """Solve all following frames with new settings, the next frame cold; levels and metrics are kept."""
        self._settings = settings
        self.forget()

    def fork(self, settings: SolveSettings) -> Refiner:
        """A refiner continuing from this one's last frame with new settings; levels, metrics and bodies are shared."""
        forked = copy(self)
        forked._settings = settings
        return forked

    def continue_from(self, refiner: Refiner) -> None:
        """Start the next frame from the last frame of a refiner of the same meshes; its result is not reused."""
        self._memories = tuple(
            memory if memory.last is None else replace(memory, last=replace(memory.last, is_reusable=False))
            for memory in refiner._memories
        )
        self._time = refiner._time

    def parts_of(self, frame: Frame) -> list[tuple[int, ...]]:
        """Numbers of the garments solved together in a frame."""
        return self._cloth.parts_of(frame, self._settings)

    def touching(self, part: tuple[int, ...], frame: Frame) -> tuple[Touching, ...]:
        """The surfaces within reach of garments solved together in a frame."""
        self._cloth.bodies.pose(frame.colliders)
        every = self._members(frame)
        members = [every[index] for index in part]
        return self._cloth.touching(members, self._cloth.near(members, self._settings))

    def _members(self, frame: Frame) -> list[Member]:
        """Each garment with its values in a frame and its history, in the scene's order."""
        return list(map(Member, range(len(frame.garments)), self.scene.garments, frame.garments, self._memories))

    def refine(self, frames: Iterable[Frame]) -> Iterator[Result]:
        """Solve frames in order, one result per frame.

        Raises:
            SolveError: A term of the potential is not finite.
        """
        for frame in frames:
            yield self.solve(frame)

    def solve(self, frame: Frame, wanted: Sequence[bool] | None = None) -> Result:
        """Solve one frame, starting from the last solved frame if useful.

        Unsolvable garments follow their cages, if at least one garment was solved.

        Args:
            wanted: For each garment, whether a result is wanted; all when None.

        Raises:
            GarmentError: A position is out of bounds.
            SolveError: No garment could be solved: a term of the potential is not finite, or cloth left its cage.
        """
        began = self._clock()
        with ends_after(self._limit, self._clock):
            result = self._solve(frame, wanted)
        if not any("time_limit" in garment.telemetry for garment in result.garments):
            self._seconds.append(self._clock() - began)
        return result

    @property
    def _limit(self) -> float:
        """Time limit of a frame [s], by `clock_of` the device."""
        if self._settings.frame_limit is not None:
            return self._settings.frame_limit
        count = sum(chain[-1].mesh.vertex_count for chain in self.refinements if chain)
        return max(LEAST_LIMIT + LIMIT_PER_VERTEX * count, LIMIT * median(self._seconds or [0.0]))

    def _solve(self, frame: Frame, wanted: Sequence[bool] | None) -> Result:
        refuse_far(self.scene, frame)
        gap = self._is_gap(frame.time)
        if self._settings.temporal == "off" or not any(memory.last for memory in self._memories):
            self._cloth.bodies.forget()  # Without history the result depends on this frame only, to the bit.
        self._cloth.bodies.pose(frame.colliders)
        members = self._members(frame)
        scene_frame = SceneFrame(self._cloth, self._settings, frame, members, gap, self._prerolled, self._limit)
        self._memories = tuple(scene_frame.solve([True] * len(members) if wanted is None else wanted))
        self._time, self._prerolled = frame.time, None
        results = [memory.result for memory in self._memories]
        if self._heat_map:
            results = [replace(result, heat=self.heat(index, result.points)) for index, result in enumerate(results)]
        return Result(frame.time, tuple(results))

    def energy(self, frame: Frame, points: Sequence[np.ndarray]) -> float:
        """Energy [J] of all garments at given world positions [m], with contact detected again."""
        refuse_far(self.scene, frame)
        total = 0.0
        for part in self.parts_of(frame):
            frames, x = [frame.garments[index] for index in part], [points[index] for index in part]
            total += sum(self.group_of(part).energies(frames, x, self.touching(part, frame)).values())
        return total

    def moved_safely(
        self, frame: Frame, start: Sequence[np.ndarray | None], wanted: Sequence[np.ndarray | None]
    ) -> list[tuple[np.ndarray | None, dict[str, Any]]]:
        """Move cloth towards wanted positions as far as possible without new crossings, and out of bodies; no solve.

        Args:
            start: Positions of each garment, world space [m], shape (V_fine, 3).
            wanted: Target positions, of the same form; a part with a garment of None is used unchanged.

        Returns:
            For each garment its positions, and contact and crossings as in telemetry: empty without possible contact.
        """
        refuse_far(self.scene, frame)
        results: list[tuple[np.ndarray | None, dict[str, Any]]] = [(positions, {}) for positions in wanted]
        for part in self.parts_of(frame):
            sides = [
                [positions for positions in (side[index] for index in part) if positions is not None]
                for side in (start, wanted)
            ]
            if all(len(side) == len(part) for side in sides):
                frames = [frame.garments[index] for index in part]
                touching = self.touching(part, frame)
                moved, contact = self.group_of(part).moved_safely(frames, *sides, touching=touching)
                for index, positions in zip(part, moved, strict=True):
                    results[index] = positions, contact
        return results

    def heat(self, index: int, points: np.ndarray | None) -> dict[str, np.ndarray]:
        """A garment's depth in bodies and its crossings in the last frame; {} without positions [m]."""
        memory = self._memories[index]
        crossing = memory.last.state.crossing if memory.solved and memory.last is not None else None
        return {} if points is None else self._cloth.heat(index, points, crossing, self._settings)

    def _is_gap(self, time: float | None) -> bool:
        """Whether the time since the last frame is too long to start from it."""
        times = self.scene.times
        if time is None or self._time is None or len(times) < 2:
            return False
        return time - self._time > self._settings.reset.gap * median(np.diff(times).tolist())
