"""Frames in, states out: warm starts, reuse of equal frames; knows no USD and no force by name."""

from __future__ import annotations

import time as clock
from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from dataclasses import replace
from functools import reduce
from statistics import median
from typing import Any

import numpy as np
import torch

from ...errors import GarmentError, SolveError
from ..contact.bodies import Touching
from ..contact.broad_phase import Bodies, Parts, bounds_of, reach_of
from ..contact.heat import body_crossings, penetration_map
from ..contact.passed import Passed
from ..deadline import ends_after, is_over
from ..level import refine_garments
from ..mesh.subdivide import Refinement
from ..mesh.topology import edges_of
from ..scene import Frame, GarmentFrame, Scene, State, out_of_bounds, refuse_far
from ..strain import has_collapsed, size_left, strayed
from .group import Group
from .history import Known, bodies_moved, came_back, jumped_in
from .settings import SolveSettings
from .values import FrameInput, Solved, join, split

LIMIT, LEAST_LIMIT, LIMIT_PER_VERTEX = 20.0, 120.0, 0.01
"""A frame stops where it stands after so many times the median of the shot's frames, but never before so many seconds
and so many a fine vertex: the slowest cold frames of the samples and shots take 0.6 ms a vertex on one core, and the
first frame of a machine may compile kernels, some 15 s. No ordinary frame is to end by the clock."""


class Refiner:
    """Refines the frames of one scene in order.

    Garments that cannot touch in a frame are solved apart, the others together.

    Attributes:
        refinements: The subdivisions of each garment, coarsest first.
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
            scene: The scene.
            settings: How to solve.
            levels: Subdivisions of each garment; the garments' own when None.
            dtype: Scalar type of the solve.
            device: "cpu" or a CUDA device.
            threads: Most threads that a kernel uses on the CPU; the result does not depend on it.
            heat_map: Whether states hold a heat map.

        Raises:
            GarmentError: A rest shape cannot be solved on.
        """
        for garment in scene.garments:
            _require_solvable(garment.path, garment.rest)
        chosen = levels if levels is not None else [garment.level for garment in scene.garments]
        self.refinements = self.subdivide(scene, chosen)
        self._settings = settings
        self._spacing = median(np.diff(scene.times).tolist()) if len(scene.times) > 1 else 0.0
        self._place = {"dtype": dtype, "device": device, "threads": threads}
        self._groups: dict[tuple[int, ...], Group] = {}
        self._scene, self._device, self._heat_map = scene, device, heat_map
        self._bodies = Bodies(scene.colliders, device=device, threads=threads)
        self._passed = Passed(scene.garments, scene.colliders, device=device, threads=threads)
        self._parts = Parts(scene.garments, together=settings.contact.cloth != "off")
        self._last: list[Known | None] = [None] * len(scene.garments)
        self._before: list[Known | None] = [None] * len(scene.garments)
        self._seconds: list[float] = []  # What frames took that came to their end.
        self._unsolved = set[int]()  # Garments whose last result is no solution.
        self._time: float | None = None
        self._walked: tuple[list[np.ndarray | None], float] | None = None

    @staticmethod
    def subdivide(scene: Scene, levels: Sequence[int]) -> list[tuple[Refinement, ...]]:
        """The refinements of each garment, without the solver."""
        return refine_garments(scene.garments, levels)

    @property
    def groups(self) -> list[Group]:
        """A group for each garment alone, in the order of the garments."""
        return [self.group_of((index,)) for index in range(len(self._scene.garments))]

    def group_of(self, part: tuple[int, ...]) -> Group:
        """The group of garments solved together, built when first asked for."""
        if part not in self._groups:
            garments = [self._scene.garments[index] for index in part]
            chains = [self.refinements[index] for index in part]
            self._groups[part] = Group(garments, chains, self._scene.gravity, self._settings, **self._place)
        return self._groups[part]

    def forget(self) -> None:
        """Start the next frame cold, as if it were the first."""
        self._passed.forget()
        self._bodies.forget()
        self._last, self._before = [None] * len(self._last), [None] * len(self._last)
        self._time = self._walked = None

    def begin_at(self, cages: Refiner, *, since: float) -> None:
        """Start the first frame, where it is cold, with the cage that another refiner walked to it.

        Args:
            cages: A refiner of the same scene that does not subdivide, and has solved that frame.
            since: The time code from which it walked, for the report.
        """
        self._walked = [None if each is None else each.points for each in cages._last], since

    def crosses(self, frame: Frame) -> bool:
        """Whether a cage that is to keep its sides crosses itself, or another one, in a frame."""
        refuse_far(self._scene, frame)
        for part in self._parts.of(frame.garments):
            contact = self.group_of(part).potential([frame.garments[index] for index in part])[1]
            if contact is not None and contact.crossed:
                return True
        return False

    def use(self, settings: SolveSettings) -> None:
        """Solve the frames that follow in another way, the next one cold; levels and metrics are kept."""
        self._settings = settings
        self._parts = Parts(self._scene.garments, together=settings.contact.cloth != "off")
        self._groups = {part: group.with_settings(settings) for part, group in self._groups.items()}
        self.forget()

    def beside(self, settings: SolveSettings) -> Refiner:
        """A refiner that goes on from this one's last frame in another way; levels, metrics and bodies are shared."""
        other = copy(self)
        other._settings, other._unsolved = settings, set(self._unsolved)
        other._last, other._before = list(self._last), list(self._before)
        other._parts = Parts(self._scene.garments, together=settings.contact.cloth != "off")
        other._groups = {part: group.with_settings(settings) for part, group in self._groups.items()}
        return other

    def parts_of(self, frame: Frame) -> list[tuple[int, ...]]:
        """Numbers of the garments that are solved together in a frame."""
        return self._parts.of(frame.garments)

    def touching(self, part: tuple[int, ...], frame: Frame) -> tuple[Touching, ...]:
        """The surfaces that garments solved together may touch in a frame."""
        self._bodies.pose(frame.colliders)
        frames = [frame.garments[index] for index in part]
        return self._touching(part, frames, self._near(part, frames))

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

        Garments that could not be solved follow their cages, where others could.

        Raises:
            GarmentError: A position is out of bounds.
            SolveError: No garment could be solved: a term of the potential is not finite, or cloth left its cage.
        """
        began = clock.perf_counter()
        with ends_after(self._limit):
            state = self._solve(frame, wanted)
        if not any("time_limit" in entry for entry in state.telemetry):
            self._seconds.append(clock.perf_counter() - began)
        return state

    @property
    def _limit(self) -> float:
        """Seconds after which a frame stops where it stands."""
        if self._settings.frame_limit is not None:
            return self._settings.frame_limit
        count = sum(chain[-1].mesh.vertex_count for chain in self.refinements if chain)
        return max(LEAST_LIMIT + LIMIT_PER_VERTEX * count, LIMIT * median(self._seconds or [0.0]))

    def _solve(self, frame: Frame, wanted: Sequence[bool] | None) -> State:
        refuse_far(self._scene, frame)
        gap = self._is_gap(frame.time)
        if gap:
            self._passed.forget()
        if self._settings.temporal == "off":  # A frame by itself is a function of that frame alone, to the bit.
            self._bodies.forget()
        self._bodies.pose(frame.colliders)
        count = len(frame.garments)
        asked = [True] * count if wanted is None else list(wanted)
        points: list[np.ndarray | None] = [None] * count
        telemetry: list[dict[str, object]] = [{"start": "left out: the garment has no sample here"}] * count
        answers, reused = self._answers(frame, asked, gap=gap)
        for index, (each, entry) in answers.items():
            points[index], telemetry[index] = each, entry
        self._time, self._walked = frame.time, None
        for index, passed in enumerate(self._passed.look(frame)):
            telemetry[index] = telemetry[index] | ({"passed_through": passed} if passed else {})
        heat = [self._heat(index, each) for index, each in enumerate(points)] if self._heat_map else []
        return State(frame.time, tuple(points), tuple(telemetry), tuple(reused), tuple(heat))

    def _answers(
        self, frame: Frame, asked: Sequence[bool], *, gap: bool
    ) -> tuple[dict[int, tuple[np.ndarray, dict[str, object]]], list[bool]]:
        """Positions and telemetry of the garments asked for, by number; and for all whether they equal the last ones.

        Raises:
            SolveError: No garment could be solved.
        """
        found, reused = dict[int, tuple[np.ndarray, dict[str, object]]](), [False] * len(asked)
        unsolved = dict[tuple[int, ...], SolveError]()
        for part in self._parts.of(frame.garments):
            same = self._same(part, frame, [self._last[index] for index in part])
            for index in part:
                reused[index] = same and index not in self._unsolved
            if not any(asked[index] for index in part):
                continue
            self._unsolved -= {index for index in part if asked[index]}
            try:
                found |= zip(part, zip(*self._answer(part, frame, same=same, gap=gap), strict=True), strict=True)
            except SolveError as error:
                unsolved[part] = error
        if unsolved and not found:
            raise next(iter(unsolved.values()))
        for part, error in unsolved.items():
            found |= zip(part, zip(*self._upsampled(part, frame, error), strict=True), strict=True)
        return {index: each for index, each in found.items() if asked[index]}, reused

    def energy(self, frame: Frame, points: Sequence[np.ndarray]) -> float:
        """Energy [J] of all garments at given world positions [m], what touches there found anew."""
        refuse_far(self._scene, frame)
        self._bodies.pose(frame.colliders)
        total = 0.0
        for part in self._parts.of(frame.garments):
            frames = [frame.garments[index] for index in part]
            touching = self._touching(part, frames, self._near(part, frames))
            total += sum(self.group_of(part).energies(frames, [points[index] for index in part], touching).values())
        return total

    def moved_safely(
        self, frame: Frame, start: Sequence[np.ndarray | None], wanted: Sequence[np.ndarray | None]
    ) -> list[tuple[np.ndarray | None, dict[str, Any]]]:
        """Move cloth as near to wanted positions as nothing newly crosses on the way, and out of bodies; no solve.

        Args:
            frame: The frame.
            start: Where each garment is, world positions [m], shape (V_fine, 3).
            wanted: Where it is to go, the same; those that are solved together with one of None are taken as they are.

        Returns:
            For each garment its positions, and what touches and crosses there as telemetry has it: empty where nothing
            may.
        """
        refuse_far(self._scene, frame)
        self._bodies.pose(frame.colliders)
        found: list[tuple[np.ndarray | None, dict[str, Any]]] = [(each, {}) for each in wanted]
        for part in self._parts.of(frame.garments):
            sides = [[each for each in (side[index] for index in part) if each is not None] for side in (start, wanted)]
            if all(len(side) == len(part) for side in sides):
                frames = [frame.garments[index] for index in part]
                touching = self._touching(part, frames, self._near(part, frames))
                moved, told = self.group_of(part).moved_safely(frames, *sides, touching=touching)
                for index, each in zip(part, moved, strict=True):
                    found[index] = each, told
        return found

    def _touching(
        self, part: Sequence[int], frames: Sequence[GarmentFrame], near: Sequence[int]
    ) -> tuple[Touching, ...]:
        """Surfaces of bodies, and the distance that each garment keeps from them."""
        felt = [self._scene.garments[index].colliders for index in part]
        offsets = [[f.offset if body in own else None for body in near] for own, f in zip(felt, frames, strict=True)]
        return self._bodies.touching(near, offsets)

    def _answer(
        self, part: tuple[int, ...], frame: Frame, *, same: bool, gap: bool
    ) -> tuple[list[np.ndarray], list[dict[str, object]]]:
        """Fine positions of garments and their telemetry: upsampled, taken over, or solved."""
        first, points = self._scene.garments[part[0]], frame.garments[part[0]].points
        if has_collapsed(first, points):  # It is alone, and the next frame starts from the last one solved.
            self._unsolved.add(part[0])
            told = {"start": "not solved: the cage has collapsed", "collapsed": size_left(first, points)}
            return [reduce(lambda x, step: np.asarray(step.linear @ x), self.refinements[part[0]], points)], [told]
        if not same:
            return self._solve_part(part, frame, gap=gap)
        entries: list[dict[str, object]] = [{"start": "reused: the input equals the last frame's"}] * len(part)
        return [each.points for each in (self._last[index] for index in part) if each is not None], entries

    def _upsampled(
        self, part: tuple[int, ...], frame: Frame, error: SolveError
    ) -> tuple[list[np.ndarray], list[dict[str, object]]]:
        """Garments that could not be solved, on their cages' smooth surface; the next frame starts from one before."""
        self._unsolved.update(part)
        points = self.group_of(part).upsampled([frame.garments[index] for index in part])
        return points, [{"start": "not solved: it follows its cage", "not_solved": str(error)}] * len(part)

    def _solve_part(
        self, part: tuple[int, ...], frame: Frame, *, gap: bool
    ) -> tuple[list[np.ndarray], list[dict[str, object]]]:
        """Solve garments together and keep what their next frame needs; returns their positions and telemetry."""
        frames = [frame.garments[index] for index in part]
        group, near = self.group_of(part), self._near(part, frames)
        last = [self._last[index] for index in part]
        broken, jumped = self._broken(part, frame, near), self._jumped(part, frame, near)
        if broken is not None:
            last = [self._before[index] for index in part]
        if jumped is not None:
            last = [None] * len(part)
        known = [each for each in last if each is not None]
        state = None if gap or len(known) < len(part) else join([each.state for each in known])
        if state is not None and any(each.part != part for each in known):
            state = replace(state, clean=False)  # What was solved apart may cross.
        cage = None if state is not None else self._cage_walked(part)
        while True:
            touching, moved = self._touching(part, frames, near), self._moved(part, frame, near, known)
            given = FrameInput(frames, frame.time, touching, moved, walked=None if cage is None else cage[0])
            solved = group.solve(given, state)
            more = self._reached(part, frames, solved.points)
            if more <= set(near):
                break
            near = tuple(sorted({*near, *more}))
        self._refuse_strayed(part, frame, solved.points)
        entry = solved.telemetry
        if any(self._scene.garments[index].colliders for index in part):
            entry["near"] = [self._scene.colliders[each].path for each in near]
        if len(part) > 1:
            entry["together"] = [self._scene.garments[index].path for index in part]
        entry |= {"start": "cold: the time between samples is too long"} if gap else {}
        entry |= {} if cage is None else {"start": f"cold: the cage walked here from time code {cage[1]:g}"}
        entry |= {} if broken is None else {"broken_before": broken}
        entry |= (
            {} if jumped is None else {"jumped_from": jumped, "start": "cold: the first frame is unlike the others"}
        )
        entry |= {"time_limit": float(f"{self._limit:.3g}")} if is_over() else {}
        self._keep(part, frame, near, solved, before=last if broken is not None else None)
        return solved.points, [entry] * len(part)

    def _keep(
        self,
        part: tuple[int, ...],
        frame: Frame,
        near: tuple[int, ...],
        solved: Solved,
        *,
        before: Sequence[Known | None] | None,
    ) -> None:
        """Keep what the next frame of garments needs, and the frame before this: the last one, or what is given."""
        group = self.group_of(part)
        own = split(solved.state, group.levels[0].spans, group.levels[-1].spans)
        last = [self._last[index] for index in part]
        kept = zip(part, last, last if before is None else before, solved.points, own, solved.crossing, strict=True)
        for index, known, earlier, points, state, crossing in kept:
            at = frame.time, frame.garments[index], frame.colliders, near, part
            self._before[index] = earlier
            self._last[index] = Known(*at, points, state, crossing, first=known is None)

    def _cage_walked(self, part: tuple[int, ...]) -> tuple[np.ndarray, float] | None:
        """World positions of cages that another refiner walked to this frame [m], and from which time code."""
        if self._walked is None:
            return None
        found = [each for each in (self._walked[0][index] for index in part) if each is not None]
        return (np.concatenate(found), self._walked[1]) if len(found) == len(part) else None

    def _broken(self, part: tuple[int, ...], frame: Frame, near: Sequence[int]) -> float | None:
        """Time code of the last frame, if garments' input left its place in it alone."""
        pairs = [(self._last[index], self._before[index]) for index in part]
        edge = float(self.group_of(part).levels[0].spacing.mean())
        for index, (last, before) in zip(part, pairs, strict=True):
            if last is None or before is None or any(each is None for pair in pairs for each in pair):
                return None
            if came_back(last, before, frame.garments[index], frame.colliders, near=near, edge=edge):
                return last.time
        return None

    def _jumped(self, part: tuple[int, ...], frame: Frame, near: Sequence[int]) -> float | None:
        """Time code of the first frame, if garments' input jumped from there to the second and stays there."""
        edge = float(self.group_of(part).levels[0].spacing.mean())
        for index in part:
            first, second = self._before[index], self._last[index]
            if first is None or second is None or not first.first:
                return None
            if jumped_in(first, second, frame.garments[index], frame.colliders, near=near, edge=edge):
                return first.time
        return None

    def _refuse_strayed(self, part: tuple[int, ...], frame: Frame, points: Sequence[np.ndarray]) -> None:
        """Refuse cloth that is no more where its cage is."""
        for index, fine in zip(part, points, strict=True):
            last = self._last[index]
            before = None if last is None else last.frame.points
            if said := strayed(frame.garments[index].points, fine, before=before):
                when = "" if frame.time is None else f" at time code {frame.time:g}"
                raise SolveError(f"<{self._scene.garments[index].path}>{when}: {said}")

    def _heat(self, index: int, points: np.ndarray | None) -> dict[str, np.ndarray] | None:
        """Where a garment is inside bodies whose bounds it meets, pushed by them or not, and where cloth crosses."""
        if points is None:
            return None
        garment, chain = self._scene.garments[index], self.refinements[index]
        met = self._bodies.near(garment, bounds_of(points), 0.0)
        surfaces = [each.surface for each in self._bodies.touching(met, [[0.0] * len(met)])]
        finest, rest = (chain[-1].mesh, None) if chain else (garment.mesh, garment.rest)
        triangles = finest.triangulate(rest).triangles
        edges = edges_of(triangles, len(points)).vertices
        known = None if index in self._unsolved else self._last[index]
        crossing = np.zeros(len(points), bool) if known is None else known.crossing
        crossing = crossing | body_crossings(surfaces, points, edges, triangles=triangles, device=self._device)
        depth = penetration_map(surfaces, points, edges, device=self._device)
        return {"penetration": depth, "crossing": crossing.astype(np.float32)}

    def _near(self, part: Sequence[int], frames: Sequence[GarmentFrame]) -> tuple[int, ...]:
        """Numbers of the bodies that garments may touch."""
        found: set[int] = set()
        for index, frame in zip(part, frames, strict=True):
            garment = self._scene.garments[index]
            if garment.colliders and self._settings.contact.sees_bodies:
                found |= set(self._bodies.near(garment, bounds_of(frame.points), reach_of(garment, frame)))
        return tuple(sorted(found))

    def _reached(self, part: Sequence[int], frames: Sequence[GarmentFrame], points: Sequence[np.ndarray]) -> set[int]:
        """Numbers of the bodies whose bounds the solved cloth meets."""
        found: set[int] = set()
        for index, frame, solved in zip(part, frames, points, strict=True):
            garment = self._scene.garments[index]
            if garment.colliders and self._settings.contact.form != "off":
                found |= set(self._bodies.near(garment, bounds_of(solved), frame.offset))
        return found

    def _same(self, part: tuple[int, ...], frame: Frame, known: Sequence[Known | None]) -> bool:
        """Whether garments and the bodies that they may touch are what they were, and solved together."""
        near = self._near(part, [frame.garments[index] for index in part])
        for index, each in zip(part, known, strict=True):
            if each is None or each.part != part or near != each.near or not _same(frame.garments[index], each.frame):
                return False
            poses = [(each.colliders[body], frame.colliders[body]) for body in near]
            if not all(a is not None and b is not None and a.equals(b) for a, b in poses):
                return False
        return True

    def _moved(self, part: tuple[int, ...], frame: Frame, near: Sequence[int], known: Sequence[Known]) -> float:
        """How far any body that garments may touch has moved since known frames [m]; infinite if more changed."""
        farthest = 0.0 if len(known) == len(part) else np.inf
        for index, last in zip(part, known, strict=False):
            if last.part != part or not _set_alike(frame.garments[index], last.frame) or set(near) != set(last.near):
                return np.inf
            farthest = max(farthest, bodies_moved(last, frame.colliders, near))
        return farthest

    def _is_gap(self, time: float | None) -> bool:
        if time is None or self._time is None or not self._spacing:
            return False
        return time - self._time > self._settings.reset.gap * self._spacing


def _same(a: GarmentFrame, b: GarmentFrame) -> bool:
    """Whether two frames would give the same answer, to the bit."""
    return _set_alike(a, b) and a.points.shape == b.points.shape and bool(np.array_equal(a.points, b.points))


def _set_alike(a: GarmentFrame, b: GarmentFrame) -> bool:
    """Whether an artist's settings are the same in two frames."""
    return (a.fabric, a.guide, a.detail, a.offset) == (b.fabric, b.guide, b.detail, b.offset)


def _require_solvable(path: str, rest: np.ndarray) -> None:
    """Refuse rest shapes that no length can be measured on."""
    if said := out_of_bounds(rest):
        raise GarmentError(path, f"the rest shape's {said}", remedy="give another frame with --rest")
