"""Memory of a garment's last frames, and the choice of the start frame: values, replaced frame by frame.

A frame starts from the last frame, unless the last frame was broken: if the input leaves its place for a single frame
and comes back, the solution of the broken frame is no start. The frame before is used instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ...errors import named_time
from ..colliders.pose import Pose
from ..rigid import AT_REST, Rigid, best_motion
from ..scene import SAME_TIME, Frame, Garment, GarmentFrame, GarmentResult, Limits
from .state import State, join

RETURNED = 0.25
"""Tolerance for the input's return after a broken frame, as a fraction of the move into the broken frame. Even motion
misses the earlier place by twice the move; a reversal misses by less only if the move is below an edge."""


@dataclass(frozen=True, eq=False)
class SolvedFrame:
    """One garment's solved frame.

    Attributes:
        colliders: Poses of all of the scene's bodies.
        near: Numbers of the bodies within reach.
        part: Numbers of the garments solved together.
        first: Whether no frame was solved before.
        is_reusable: As in `SolveSettings` at the end of the solve; False too if the time limit stopped the frame.
    """

    time: float | None
    frame: GarmentFrame
    colliders: Sequence[Pose | None]
    near: tuple[int, ...]
    part: tuple[int, ...]
    state: State
    first: bool = False
    is_reusable: bool = True


@dataclass(frozen=True, eq=False)
class GarmentHistory:
    """Memory of one garment.

    Attributes:
        last: The last solved frame.
        before: The start frame of ``last``.
        result: The last result, which may be no solution.
        solved: Whether the last result is a solution.
    """

    last: SolvedFrame | None = None
    before: SolvedFrame | None = None
    result: GarmentResult = field(default_factory=lambda: GarmentResult(None))
    solved: bool = True


@dataclass(frozen=True, eq=False)
class Member:
    """A garment in a frame.

    Attributes:
        number: Number of the garment in the scene.
        garment: Constant data.
        frame: Values in the frame.
        history: Last frames.
    """

    number: int
    garment: Garment
    frame: GarmentFrame
    history: GarmentHistory


@dataclass(frozen=True, eq=False)
class Origin:
    """Start of a frame of garments solved together.

    Attributes:
        frames: The start frame of each garment; None without one.
        state: State left by the start frames, joined and moved along with the cages; None for a cold start.
        motion: The rigid motion from the start frames' cages closest to this frame's cages.
        broken: Time code of the last frame, if only the last frame's input left its place; else None.
        jumped: Time code of the first frame, if the input jumped from the first frame to the second; else None.
        gap: Whether the time between samples is too long.
    """

    frames: tuple[SolvedFrame | None, ...]
    state: State | None
    motion: Rigid
    broken: float | None
    jumped: float | None
    gap: bool

    def moved(self, members: Sequence[Member], frame: Frame, near: Sequence[int], gravity: np.ndarray) -> float:
        """Largest motion of nearby bodies since the start frame, relative to the cages [m].

        Infinite if more than poses changed. A change of the air counts as far as it moves cloth. Gravity counts as a
        body: the end of its direction at a distance of one metre.
        """
        part = tuple(member.number for member in members)
        down = gravity / max(float(np.linalg.norm(gravity)), 1e-30)
        farthest = float(np.linalg.norm(self.motion.turn @ down - down))
        for member, start in zip(members, self.frames, strict=True):
            if start is None or start.part != part or set(near) != set(start.near):
                return np.inf
            if not set_alike(member.frame, start.frame):
                return np.inf
            farthest = max(farthest, bodies_moved(start, frame.colliders, near, along=self.motion))
            farthest = max(farthest, air_moved(start.frame, member.frame))
        return farthest

    @property
    def colliders(self) -> Sequence[Pose | None]:
        """Poses of all bodies in the start frame; () without one frame that all garments start from."""
        starts = [start for start in self.frames if start is not None]
        is_common = (
            self.state is not None and len(starts) == len(self.frames) and len({start.time for start in starts}) == 1
        )
        return starts[0].colliders if is_common else ()

    def elapsed(self, time: float | None, seconds: float) -> float:
        """Longest time from a garment's start frame to a time code [s]; 0 without either, and across a jump.

        Args:
            seconds: Length of one time code [s].
        """
        times = [start.time for start in self.frames if start is not None and start.time is not None]
        passed = 0.0 if time is None or not times else time - min(times)
        return seconds * passed if abs(passed) > SAME_TIME else 0.0

    def telemetry(self, prerolled_from: float | None) -> dict[str, object]:
        """Telemetry of the start, given the time code from which a cold frame's cage was advanced, or None."""
        entries: dict[str, object] = {"start": "cold: the time between samples is too long"} if self.gap else {}
        if prerolled_from is not None:
            entries["start"] = f"cold: the cage walked here from time code {named_time(prerolled_from)}"
        if self.broken is not None:
            entries["broken_before"] = self.broken
        if self.jumped is not None:
            entries |= {"jumped_from": self.jumped, "start": "cold: the first frame is unlike the others"}
        return entries


def origin_of(members: Sequence[Member], frame: Frame, *, near: Sequence[int], edge: float, gap: bool) -> Origin:
    """Choose the frame to start from.

    Args:
        members: The garments.
        near: Numbers of the bodies within reach.
        edge: Mean edge of the cages [m].
        gap: Whether the time between samples is too long.
    """
    broken = _broken(members, frame, near=near, edge=edge)
    jumped = jumped_from(members, frame, near=near, edge=edge)
    frames = tuple(member.history.last if broken is None else member.history.before for member in members)
    frames = frames if jumped is None else (None,) * len(members)
    starts = [start for start in frames if start is not None]
    state = None if gap or len(starts) < len(members) else join([start.state for start in starts])
    motion = _motion(starts, [member.frame for member in members]) if state is not None else AT_REST
    part = tuple(member.number for member in members)
    if state is not None and any(start.part != part for start in starts):
        state = replace(state, clean=False)  # Garments solved apart may cross.
    return Origin(frames, None if state is None else state.carried(motion), motion, broken, jumped, gap)


def _motion(starts: Sequence[SolvedFrame], garments: Sequence[GarmentFrame]) -> Rigid:
    """The rigid motion closest to the cages' motion; identity if garments start from different frames."""
    before, after = ([frame.points for frame in frames] for frames in ([start.frame for start in starts], garments))
    if len({start.time for start in starts}) > 1 or any(a.shape != b.shape for a, b in zip(before, after, strict=True)):
        return AT_REST
    return best_motion(np.concatenate(before), np.concatenate(after))


def _broken(members: Sequence[Member], frame: Frame, *, near: Sequence[int], edge: float) -> float | None:
    """Time code of the last frame, if only the last frame's input left its place."""
    moves = [(last, before, garment) for before, last, garment in _moves(members)]
    return _elsewhere(moves, frame, near=near, edge=edge) if len(moves) == len(members) else None


def jumped_from(members: Sequence[Member], frame: Frame, *, near: Sequence[int], edge: float) -> float | None:
    """Time code of the first frame, if garments' input jumped from the first frame to the second and stays there."""
    moves = _moves(members)
    is_second = len(moves) == len(members) and all(first.first for first, *_ in moves)
    return _elsewhere(moves, frame, near=near, edge=edge) if is_second else None


def _moves(members: Sequence[Member]) -> list[tuple[SolvedFrame, SolvedFrame, GarmentFrame]]:
    """The start frame of the last frame, the last frame and this frame of each garment with both."""
    histories = [(member.history.before, member.history.last, member.frame) for member in members]
    return [(before, last, frame) for before, last, frame in histories if before is not None and last is not None]


def _elsewhere(
    moves: Sequence[tuple[SolvedFrame, SolvedFrame, GarmentFrame]], frame: Frame, *, near: Sequence[int], edge: float
) -> float | None:
    """Time code of the first of two earlier frames, if the input was in another place in that frame only.

    Args:
        moves: The two frames of each garment, and its values in this frame.
        near: Numbers of the bodies within reach.
        edge: Mean edge of the cages [m]; a smaller move is no break: the cloth follows the move.
    """

    def moved(start: SolvedFrame, garment: GarmentFrame, bodies: Sequence[int]) -> float:
        return max(cage_moved(start, garment), bodies_moved(start, frame.colliders, bodies))

    for first, second, garment in moves:
        bodies = sorted({*near, *first.near, *second.near})
        away = moved(first, garment, bodies)
        if away > edge and moved(second, garment, bodies) < RETURNED * away:
            return first.time
    return None


def is_same(members: Sequence[Member], frame: Frame, near: Sequence[int]) -> bool:
    """Whether garments and nearby bodies are unchanged and were solved together."""
    part = tuple(member.number for member in members)
    for member in members:
        garment, last = member.frame, member.history.last
        if last is None or last.part != part or near != last.near or not last.is_reusable:
            return False
        earlier = last.frame
        if not (set_alike(garment, earlier) and np.array_equal(garment.points, earlier.points)):
            return False
        if not (
            _pushed_alike(garment.acceleration, earlier.acceleration) and _pushed_alike(garment.load, earlier.load)
        ):
            return False
        poses = [(last.colliders[body], frame.colliders[body]) for body in near]
        if not all(a is not None and b is not None and a.equals(b) for a, b in poses):
            return False
    return True


def _pushed_alike(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    """Whether the cloth feels equal accelerations, or equal loads."""
    return a is b or (a is not None and b is not None and np.array_equal(a, b))


def air_moved(before: GarmentFrame, after: GarmentFrame) -> float:
    """Largest distance by which a change of the air's load moves the cloth against its guide [m]."""
    if before.load is after.load:
        return 0.0
    calm = np.zeros_like(after.points)
    start, end = (calm if frame.load is None else frame.load for frame in (before, after))
    return float(np.linalg.norm(end - start, axis=1).max(initial=0.0)) / max(after.guide, 1e-30)


def set_alike(a: GarmentFrame, b: GarmentFrame) -> bool:
    """Whether the artist's settings are equal in two frames."""
    if not Limits.are_equal(a.limits, b.limits):
        return False
    return (a.fabric, a.guide, a.detail, a.offset) == (b.fabric, b.guide, b.detail, b.offset)


def cage_moved(start: SolvedFrame, garment: GarmentFrame) -> float:
    """Largest move of a garment's cage points since a frame [m]; infinite if not a length."""
    if garment.points.shape != start.frame.points.shape:
        return np.inf
    far = float(np.linalg.norm(garment.points - start.frame.points, axis=1).max(initial=0.0))
    return far if np.isfinite(far) else np.inf


def bodies_moved(
    start: SolvedFrame, colliders: Sequence[Pose | None], near: Sequence[int], *, along: Rigid = AT_REST
) -> float:
    """Largest deviation of bodies from a rigid motion since a frame [m]; infinite if not comparable."""
    farthest = 0.0
    for body in near:
        before, after = start.colliders[body], colliders[body]
        farthest = max(farthest, np.inf if before is None or after is None else after.moved(before, along))
    return farthest
