"""A frame of a whole scene: groups of garments are solved, reused, or left on their cages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
import torch

from ...errors import At, GarmentError, SolveError, named_time
from ..colliders.pose import bounds_of
from ..contact.bodies import Touching
from ..contact.broad_phase import Bodies, TouchingGroups, reach_of
from ..contact.report import body_crossings, penetration_map
from ..deadline import is_over
from ..inertia import GRAVITY
from ..level import refine_garments
from ..rigid import AT_REST
from ..scene import Frame, GarmentFrame, Scene, out_of_bounds
from ..strain import has_collapsed, size_left, strayed
from .group import Group
from .history import GarmentHistory, Origin, SolvedFrame, is_same, jumped_from, origin_of
from .settings import SolveSettings
from .solve import RunawayError, solve_soundly
from .values import FrameInput, split


class SceneCloth:
    """Levels, groups and bodies for the frames of a scene; bodies are posed for one frame at a time.

    Attributes:
        refinements: The subdivisions of each garment, coarsest first.
    """

    def __init__(self, scene: Scene, levels: Sequence[int], *, dtype: torch.dtype, device: str, threads: int) -> None:
        """Subdivide the garments.

        Args:
            levels: Subdivisions of each garment.
            dtype: Scalar type of the solve.
            device: "cpu" or a CUDA device.
            threads: Most threads per kernel on the CPU.

        Raises:
            GarmentError: A rest shape is invalid.
        """
        for garment in scene.garments:
            if wrong := out_of_bounds(garment.rest):
                remedy = "give another frame with --rest"
                raise GarmentError(garment.path, f"the rest shape's {wrong}", remedy=remedy)
        self.scene, self.refinements = scene, refine_garments(scene.garments, levels)
        self.bodies = Bodies(scene.colliders, device=device, threads=threads)
        self._dtype, self._device, self._threads = dtype, device, threads
        self._groups: dict[tuple[int, ...], Group] = {}
        self._parts = {joint: TouchingGroups(scene.garments, joint=joint) for joint in (False, True)}

    def group(self, part: tuple[int, ...], settings: SolveSettings) -> Group:
        """The group of garments solved together, built on first use; levels and metrics are kept."""
        group = self._groups.get(part)
        if group is None:
            garments = [self.scene.garments[index] for index in part]
            chains = [self.refinements[index] for index in part]
            gravity, dtype, device, threads = self.scene.gravity, self._dtype, self._device, self._threads
            group = Group.of(garments, chains, gravity, settings, dtype=dtype, device=device, threads=threads)
        self._groups[part] = group if group.settings is settings else replace(group, settings=settings)
        return self._groups[part]

    def parts_of(self, frame: Frame, settings: SolveSettings) -> list[tuple[int, ...]]:
        """Numbers of the garments solved together in a frame."""
        return self._parts[settings.contact.cloth != "off"].of(frame.garments)

    def upsampled(self, index: int, points: np.ndarray) -> np.ndarray:
        """A cage's positions [m] on its subdivided mesh, linearly."""
        return reduce(lambda x, step: np.asarray(step.linear @ x), self.refinements[index], points)

    def near(self, part: Sequence[int], frames: Sequence[GarmentFrame], settings: SolveSettings) -> tuple[int, ...]:
        """Numbers of the bodies within reach of garments."""
        near: set[int] = set()
        for index, frame in zip(part, frames, strict=True):
            garment = self.scene.garments[index]
            if garment.colliders and settings.contact.sees_bodies:
                near |= set(self.bodies.near(garment, bounds_of(frame.points), reach_of(garment, frame)))
        return tuple(sorted(near))

    def reached(
        self,
        part: Sequence[int],
        frames: Sequence[GarmentFrame],
        points: Sequence[np.ndarray],
        settings: SolveSettings,
    ) -> set[int]:
        """Numbers of the bodies whose bounds meet the solved cloth, given the cloth's positions [m]."""
        reached: set[int] = set()
        for index, frame, solved in zip(part, frames, points, strict=True):
            garment = self.scene.garments[index]
            if garment.colliders and settings.contact.form != "off":
                reached |= set(self.bodies.near(garment, bounds_of(solved), frame.offset))
        return reached

    def touching(
        self,
        part: Sequence[int],
        frames: Sequence[GarmentFrame],
        near: Sequence[int],
        *,
        origin: Origin | None = None,
    ) -> tuple[Touching, ...]:
        """Surfaces of bodies, and the distance kept from each by each garment; with their places in the start frame."""
        colliders = [self.scene.garments[index].colliders for index in part]
        pairs = zip(colliders, frames, strict=True)
        offsets = [[frame.offset if body in bodies else None for body in near] for bodies, frame in pairs]
        before = () if origin is None else origin.colliders
        motion = AT_REST if origin is None else origin.motion
        return self.bodies.touching(near, offsets, before=before, motion=motion)

    def heat(
        self, index: int, points: np.ndarray, crossing: np.ndarray | None, settings: SolveSettings
    ) -> dict[str, np.ndarray]:
        """Depth of a garment inside bodies with overlapping bounds, pushing or not, and crossings of cloth.

        Args:
            index: Number of the garment.
            points: World positions [m], shape (V, 3).
            crossing: Whether each vertex belongs to cloth that crosses cloth, shape (V,); None for no vertex.
        """
        near = self.bodies.near(self.scene.garments[index], bounds_of(points), 0.0)
        surfaces = [body.surface for body in self.bodies.touching(near, [[0.0] * len(near)])]
        crosses = body_crossings(self.group((index,), settings).levels[-1], surfaces, points)
        crosses = crosses if crossing is None else crosses | crossing
        depth = penetration_map(surfaces, points, device=self._device)
        return {"penetration": depth, "crossing": crosses.astype(np.float32)}


def _loads(frames: Sequence[GarmentFrame]) -> dict[str, object]:
    """Telemetry: the largest acceleration that is felt, relative to gravity, and load of the air; empty without any."""
    accelerations = [frame.acceleration / GRAVITY for frame in frames if frame.acceleration is not None]
    air = [frame.load for frame in frames if frame.load is not None]
    largest = {
        name: max(float(np.linalg.norm(field, axis=1).max(initial=0.0)) for field in fields)
        for name, fields in (("inertia", accelerations), ("air", air))
        if fields
    }
    return {name: float(f"{value:.3g}") for name, value in largest.items()}


@dataclass(frozen=True, eq=False)
class Answer:
    """One garment's frame.

    Attributes:
        points: Fine positions [m], world space.
        telemetry: Entries for the report.
        memory: GarmentHistory for the next frame.
    """

    points: np.ndarray
    telemetry: dict[str, object]
    memory: GarmentHistory


@dataclass(frozen=True, eq=False)
class SceneFrame:
    """One frame of a scene, to be solved part by part.

    Attributes:
        cloth: Levels, groups and bodies of the scene; the bodies are posed.
        memories: GarmentHistory of each garment's last frames.
        gap: Whether the time since the last frame is too long for a warm start.
        prerolled: World positions of each cage [m] advanced here by another refiner, and the start time code; or None.
        limit: Time limit of the frame [s], for the report.
    """

    cloth: SceneCloth
    settings: SolveSettings
    frame: Frame
    memories: Sequence[GarmentHistory]
    gap: bool
    prerolled: tuple[Sequence[np.ndarray | None], float] | None
    limit: float

    def solve(self, requested: Sequence[bool]) -> tuple[dict[int, Answer], list[bool]]:
        """Answers by garment, of the requested parts; and for all garments whether the answers equal the last frame's.

        Raises:
            SolveError: No garment could be solved.
        """
        answers, reused = dict[int, Answer](), [False] * len(requested)
        unsolved = dict[tuple[int, ...], SolveError]()
        for part in self.cloth.parts_of(self.frame, self.settings):
            near = self.cloth.near(part, [self.frame.garments[index] for index in part], self.settings)
            memories = [self.memories[index] for index in part]
            same = is_same(part, self.frame, memories, near) and not self._jumped(part, near)
            for index in part:
                reused[index] = same and self.memories[index].solved
            if not any(requested[index] for index in part):
                continue
            try:
                with At(prims=tuple(self.cloth.scene.garments[index].path for index in part)):
                    answers |= zip(part, self._answer(part, near, same=same), strict=True)
            except SolveError as error:
                unsolved[part] = error
        if unsolved and not answers:
            raise next(iter(unsolved.values()))
        for part, error in unsolved.items():
            answers |= zip(part, self._on_cages(part, error), strict=True)
        return answers, reused

    def _answer(self, part: tuple[int, ...], near: tuple[int, ...], *, same: bool) -> list[Answer]:
        """Garments upsampled, reused, or solved."""
        first, points = self.cloth.scene.garments[part[0]], self.frame.garments[part[0]].points
        if has_collapsed(first, points):  # Solved alone; the next frame starts from the last solved frame.
            entry = {"start": "not solved: the cage has collapsed", "collapsed": size_left(first, points)}
            return [Answer(self.cloth.upsampled(part[0], points), entry, replace(self.memories[part[0]], solved=False))]
        if not same:
            return self._solve_part(part, near)
        memories = [self.memories[index] for index in part]
        entry: dict[str, object] = {"start": "reused: the input equals the last frame's"}
        return [
            Answer(memory.last.points, entry, replace(memory, solved=True))
            for memory in memories
            if memory.last is not None
        ]

    def _on_cages(self, part: tuple[int, ...], error: SolveError) -> list[Answer]:
        """Unsolvable garments, on their cages' smooth surface; the next frame starts from an earlier frame."""
        entry: dict[str, object] = {"start": "not solved: it follows its cage", "not_solved": str(error)}
        points = self.cloth.group(part, self.settings).upsampled([self.frame.garments[index] for index in part])
        memories = [replace(self.memories[index], solved=False) for index in part]
        return [Answer(x, entry, memory) for x, memory in zip(points, memories, strict=True)]

    def _solve_part(self, part: tuple[int, ...], near: tuple[int, ...]) -> list[Answer]:
        """Solve garments together; bodies reached only by the solved cloth are added, and the solve is repeated."""
        frames, memories = [self.frame.garments[index] for index in part], [self.memories[index] for index in part]
        group = self.cloth.group(part, self.settings)
        origin = origin_of(part, self.frame, memories, near=near, edge=group.spacings[0], gap=self.gap)
        cage = None if origin.state is not None else self._prerolled_cage(part)
        elapsed = origin.elapsed(self.frame.time, self.cloth.scene.seconds)
        at = None if self.frame.time is None else float(self.frame.time)
        while True:
            touching = self.cloth.touching(part, frames, near, origin=origin)
            moved = origin.moved(part, self.frame, near, self.cloth.scene.gravity)
            prerolled = None if cage is None else cage[0]
            frame_input = FrameInput(frames, at, touching, moved, prerolled=prerolled, elapsed=elapsed)
            try:
                solved = solve_soundly(group, frame_input, origin.state)
            except RunawayError as error:
                return self._on_cages(part, error)
            reached = self.cloth.reached(part, frames, solved.points, self.settings)
            if reached <= set(near):
                break
            near = tuple(sorted({*near, *reached}))
        self._refuse_strayed(part, solved.points)
        entry = solved.telemetry | self._surroundings(part, near)
        start = origin.telemetry(None if cage is None else cage[1])
        entry |= start | ({"start": solved.telemetry["start"]} if solved.telemetry["start"] != "cold" else {})
        cut = is_over()
        entry |= {"time_limit": float(f"{self.limit:.3g}")} if cut else {}
        entry |= _loads(frames)
        states = split(solved.state, group.levels[0].spans, group.levels[-1].spans)
        answers = list[Answer]()
        for number, (index, memory) in enumerate(zip(part, memories, strict=True)):
            at = self.frame.time, self.frame.garments[index], self.frame.colliders, near, part
            points, crossing = solved.points[number], solved.crossing[number]
            first, is_reusable = memory.last is None, self.settings.is_reusable and not cut
            solved_frame = SolvedFrame(*at, points, states[number], crossing, first, is_reusable)
            before = memory.last if origin.broken is None else origin.frames[number]
            answers.append(Answer(points, entry, GarmentHistory(solved_frame, before)))
        return answers

    def _jumped(self, part: tuple[int, ...], near: tuple[int, ...]) -> bool:
        """Whether the last frame, a candidate for reuse, started from a first frame at a different place."""
        memories, edge = [self.memories[index] for index in part], self.cloth.group(part, self.settings).spacings[0]
        return jumped_from(part, self.frame, memories, near=near, edge=edge) is not None

    def _surroundings(self, part: tuple[int, ...], near: Sequence[int]) -> dict[str, object]:
        """Telemetry: paths of the bodies near garments, and of garments solved together."""
        entries: dict[str, object] = {}
        if any(self.cloth.scene.garments[index].colliders for index in part):
            entries["near"] = [self.cloth.scene.colliders[body].path for body in near]
        if len(part) > 1:
            entries["together"] = [self.cloth.scene.garments[index].path for index in part]
        return entries

    def _prerolled_cage(self, part: tuple[int, ...]) -> tuple[np.ndarray, float] | None:
        """World positions of cages advanced to this frame by another refiner [m], and the start time code."""
        if self.prerolled is None:
            return None
        cages = [cage for cage in (self.prerolled[0][index] for index in part) if cage is not None]
        return (np.concatenate(cages), self.prerolled[1]) if len(cages) == len(part) else None

    def _refuse_strayed(self, part: tuple[int, ...], points: Sequence[np.ndarray]) -> None:
        for index, fine in zip(part, points, strict=True):
            last = self.memories[index].last
            before = None if last is None else last.frame.points
            if wrong := strayed(self.frame.garments[index].points, fine, before=before):
                when = "" if self.frame.time is None else f" at time code {named_time(self.frame.time)}"
                raise SolveError(f"<{self.cloth.scene.garments[index].path}>{when}: {wrong}")
