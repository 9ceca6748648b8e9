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
from ..scene import Frame, GarmentResult, Scene, out_of_bounds
from ..strain import has_collapsed, size_left, strayed
from .group import Group
from .history import GarmentHistory, Member, Origin, SolvedFrame, is_same, jumped_from, origin_of
from .problem import begin
from .settings import SolveSettings
from .solve import RunawayError, solve_soundly
from .state import split


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

    def near(self, members: Sequence[Member], settings: SolveSettings) -> tuple[int, ...]:
        """Numbers of the bodies within reach of garments."""
        near: set[int] = set()
        for member in members:
            if member.garment.colliders and settings.contact.sees_bodies:
                reach = reach_of(member.garment, member.frame)
                near |= set(self.bodies.near(member.garment, bounds_of(member.frame.points), reach))
        return tuple(sorted(near))

    def reached(self, members: Sequence[Member], points: Sequence[np.ndarray], settings: SolveSettings) -> set[int]:
        """Numbers of the bodies whose bounds meet the solved cloth, given the cloth's positions [m]."""
        reached: set[int] = set()
        for member, solved in zip(members, points, strict=True):
            if member.garment.colliders and settings.contact.form != "off":
                reached |= set(self.bodies.near(member.garment, bounds_of(solved), member.frame.offset))
        return reached

    def touching(
        self, members: Sequence[Member], near: Sequence[int], *, origin: Origin | None = None
    ) -> tuple[Touching, ...]:
        """Surfaces of bodies, and the distance kept from each by each garment; with their places in the start frame."""
        offsets = [
            [member.frame.offset if body in member.garment.colliders else None for body in near] for member in members
        ]
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


def _loads(members: Sequence[Member]) -> dict[str, object]:
    """Telemetry: the largest acceleration that is felt, relative to gravity, and load of the air; empty without any."""
    accelerations = [m.frame.acceleration / GRAVITY for m in members if m.frame.acceleration is not None]
    air = [member.frame.load for member in members if member.frame.load is not None]
    largest = {
        name: max(float(np.linalg.norm(field, axis=1).max(initial=0.0)) for field in fields)
        for name, fields in (("inertia", accelerations), ("air", air))
        if fields
    }
    return {name: float(f"{value:.3g}") for name, value in largest.items()}


@dataclass(frozen=True, eq=False)
class SceneFrame:
    """One frame of a scene, to be solved part by part.

    Attributes:
        cloth: Levels, groups and bodies of the scene; the bodies are posed.
        members: The garments in this frame, in the scene's order.
        gap: Whether the time since the last frame is too long for a warm start.
        prerolled: World positions of each cage [m] advanced here by another refiner, and the start time code; or None.
        limit: Time limit of the frame [s], for the report.
    """

    cloth: SceneCloth
    settings: SolveSettings
    frame: Frame
    members: Sequence[Member]
    gap: bool
    prerolled: tuple[Sequence[np.ndarray | None], float] | None
    limit: float

    def solve(self, requested: Sequence[bool]) -> list[GarmentHistory]:
        """The history of each garment, with its result; parts without a requested garment are not solved.

        Raises:
            SolveError: No garment could be solved.
        """
        solved, skipped = dict[int, GarmentHistory](), dict[int, GarmentHistory]()
        unsolved = list[tuple[list[Member], SolveError]]()
        for part in self.cloth.parts_of(self.frame, self.settings):
            members = [self.members[number] for number in part]
            near = self.cloth.near(members, self.settings)
            same = is_same(members, self.frame, near) and not self._jumped(members, near)
            if not any(requested[number] for number in part):
                skipped |= {m.number: _left_out(m.history, reused=same and m.history.solved) for m in members}
                continue
            try:
                with At(prims=tuple(member.garment.path for member in members)):
                    solved |= self._solve_part(members, near, same=same)
            except SolveError as error:
                unsolved.append((members, error))
        if unsolved and not solved:
            raise unsolved[0][1]
        for members, error in unsolved:
            solved |= self._on_cages(members, error)
        for number, history in solved.items():
            if not requested[number]:
                solved[number] = _left_out(history, reused=history.result.reused)
        return [history for _, history in sorted((solved | skipped).items())]

    def _solve_part(self, members: Sequence[Member], near: tuple[int, ...], *, same: bool) -> dict[int, GarmentHistory]:
        """Histories by number of garments upsampled, reused, or solved together."""
        first = members[0]
        if has_collapsed(first.garment, first.frame.points):  # The next frame starts from the last solved frame.
            entry = {
                "start": "not solved: the cage has collapsed",
                "collapsed": size_left(first.garment, first.frame.points),
            }
            points = self.cloth.upsampled(first.number, first.frame.points)
            return {first.number: replace(first.history, result=GarmentResult(points, entry), solved=False)}
        if not same:
            return self._solve_together(members, near)
        entry: dict[str, object] = {"start": "reused: the input equals the last frame's"}
        histories = dict[int, GarmentHistory]()
        for number, history in ((member.number, member.history) for member in members):
            if history.last is not None:
                result = GarmentResult(history.last.state.points, entry, history.solved)
                histories[number] = replace(history, result=result, solved=True)
        return histories

    def _on_cages(self, members: Sequence[Member], error: SolveError) -> dict[int, GarmentHistory]:
        """Unsolvable garments, on their cages' smooth surface; the next frame starts from an earlier frame."""
        entry: dict[str, object] = {"start": "not solved: it follows its cage", "not_solved": str(error)}
        points = self._group(members).upsampled([member.frame for member in members])
        return {
            member.number: replace(member.history, result=GarmentResult(positions, entry), solved=False)
            for member, positions in zip(members, points, strict=True)
        }

    def _solve_together(self, members: Sequence[Member], near: tuple[int, ...]) -> dict[int, GarmentHistory]:
        """Solve garments together; bodies reached only by the solved cloth are added, and the solve is repeated."""
        group, frames = self._group(members), [member.frame for member in members]
        scene, frame = self.cloth.scene, self.frame
        origin = origin_of(members, frame, near=near, edge=group.spacings[0], gap=self.gap)
        cage = None if origin.state is not None else self._prerolled_cage(members)
        while True:
            problem = begin(
                group,
                frames,
                origin.state,
                at=None if frame.time is None else float(frame.time),
                touching=self.cloth.touching(members, near, origin=origin),
                moved=origin.moved(members, frame, near, scene.gravity),
                elapsed=origin.elapsed(frame.time, scene.seconds),
                prerolled=None if cage is None else cage[0],
            )
            try:
                solved, telemetry = solve_soundly(problem)
            except RunawayError as error:
                return self._on_cages(members, error)
            states = split(solved, group.levels[0].spans, group.levels[-1].spans)
            reached = self.cloth.reached(members, [state.points for state in states], self.settings)
            if reached <= set(near):
                break
            near = tuple(sorted({*near, *reached}))
        start = origin.telemetry(None if cage is None else cage[1])
        entry = telemetry | self._surroundings(members, near) | start
        entry |= {"start": telemetry["start"]} if telemetry["start"] != "cold" else {}
        entry |= ({"time_limit": float(f"{self.limit:.3g}")} if is_over() else {}) | _loads(members)
        part = tuple(member.number for member in members)
        is_reusable = self.settings.is_reusable and "time_limit" not in entry
        histories = dict[int, GarmentHistory]()
        for member, state, begun in zip(members, states, origin.frames, strict=True):
            self._refuse_strayed(member, state.points)
            last, at = member.history.last, (frame.time, member.frame, frame.colliders)
            solved_frame = SolvedFrame(*at, near, part, state, last is None, is_reusable)
            before = last if origin.broken is None else begun
            histories[member.number] = GarmentHistory(solved_frame, before, GarmentResult(state.points, entry))
        return histories

    def _group(self, members: Sequence[Member]) -> Group:
        """The group of garments solved together."""
        return self.cloth.group(tuple(member.number for member in members), self.settings)

    def _jumped(self, members: Sequence[Member], near: tuple[int, ...]) -> bool:
        """Whether the last frame, a candidate for reuse, started from a first frame at a different place."""
        return jumped_from(members, self.frame, near=near, edge=self._group(members).spacings[0]) is not None

    def _surroundings(self, members: Sequence[Member], near: Sequence[int]) -> dict[str, object]:
        """Telemetry: paths of the bodies near garments, and of garments solved together."""
        entries: dict[str, object] = {}
        if any(member.garment.colliders for member in members):
            entries["near"] = [self.cloth.scene.colliders[body].path for body in near]
        if len(members) > 1:
            entries["together"] = [member.garment.path for member in members]
        return entries

    def _prerolled_cage(self, members: Sequence[Member]) -> tuple[np.ndarray, float] | None:
        """World positions of cages advanced to this frame by another refiner [m], and the start time code."""
        if self.prerolled is None:
            return None
        cages = [cage for cage in (self.prerolled[0][member.number] for member in members) if cage is not None]
        return (np.concatenate(cages), self.prerolled[1]) if len(cages) == len(members) else None

    def _refuse_strayed(self, member: Member, points: np.ndarray) -> None:
        before = None if member.history.last is None else member.history.last.frame.points
        if wrong := strayed(member.frame.points, points, before=before):
            when = "" if self.frame.time is None else f" at time code {named_time(self.frame.time)}"
            raise SolveError(f"<{member.garment.path}>{when}: {wrong}")


def _left_out(history: GarmentHistory, *, reused: bool) -> GarmentHistory:
    """The history of a garment whose result was not requested."""
    return replace(history, result=GarmentResult(None, {"start": "left out: the garment has no sample here"}, reused))
