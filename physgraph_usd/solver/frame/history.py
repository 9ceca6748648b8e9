"""Memory of a garment's last frames, and the choice of the start frame: values, replaced frame by frame.

A frame starts from the last frame, unless the last frame was broken: if the input leaves its place for a single frame
and comes back, the solution of the broken frame is no start. The frame before is used instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...errors import named_time
from ..colliders.pose import Pose
from ..rigid import AT_REST, Rigid, best_motion
from ..scene import SAME_TIME, Frame, GarmentFrame
from .values import FrameState, join

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
        points: Fine positions [m].
        crossing: Whether each fine vertex belongs to cloth that crosses cloth.
        first: Whether no frame was solved before.
        whole: As `SolveSettings.whole`, at the end of the solve; False too if the time limit stopped the frame.
    """

    time: float | None
    frame: GarmentFrame
    colliders: Sequence[Pose | None]
    near: tuple[int, ...]
    part: tuple[int, ...]
    points: np.ndarray
    state: FrameState
    crossing: np.ndarray
    first: bool = False
    whole: bool = True


@dataclass(frozen=True, eq=False)
class GarmentHistory:
    """Memory of one garment.

    Attributes:
        last: The last solved frame.
        before: The start frame of ``last``.
        solved: Whether the last result is a solution.
    """

    last: SolvedFrame | None = None
    before: SolvedFrame | None = None
    solved: bool = True


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
    state: FrameState | None
    motion: Rigid
    broken: float | None
    jumped: float | None
    gap: bool

    def moved(self, part: tuple[int, ...], frame: Frame, near: Sequence[int], gravity: np.ndarray) -> float:
        """Largest motion of nearby bodies since the start frame, relative to the cages [m].

        Infinite if more than poses changed. A change of the air counts as far as it moves cloth. Gravity counts as a
        body: the end of its direction at a distance of one metre.
        """
        known = [each for each in self.frames if each is not None]
        down = gravity / max(float(np.linalg.norm(gravity)), 1e-30)
        farthest = float(np.linalg.norm(self.motion.turn @ down - down)) if len(known) == len(part) else np.inf
        for index, last in zip(part, known, strict=False):
            if last.part != part or not set_alike(frame.garments[index], last.frame) or set(near) != set(last.near):
                return np.inf
            farthest = max(farthest, bodies_moved(last, frame.colliders, near, along=self.motion))
            farthest = max(farthest, air_moved(last.frame, frame.garments[index]))
        return farthest

    @property
    def colliders(self) -> Sequence[Pose | None]:
        """Poses of all bodies in the start frame; () without one frame that all garments start from."""
        known = [each for each in self.frames if each is not None]
        one = self.state is not None and len(known) == len(self.frames) and len({each.time for each in known}) == 1
        return known[0].colliders if one else ()

    def elapsed(self, time: float | None, seconds: float) -> float:
        """Longest time from a garment's start frame to a time code [s]; 0 without either, and across a jump.

        Args:
            seconds: Length of one time code [s].
        """
        starts = [each.time for each in self.frames if each is not None and each.time is not None]
        passed = 0.0 if time is None or not starts else time - min(starts)
        return seconds * passed if abs(passed) > SAME_TIME else 0.0

    def telemetry(self, walked_from: float | None) -> dict[str, object]:
        """Telemetry of the start, given the time code from which a cold frame's cage was advanced, or None."""
        found: dict[str, object] = {"start": "cold: the time between samples is too long"} if self.gap else {}
        if walked_from is not None:
            found["start"] = f"cold: the cage walked here from time code {named_time(walked_from)}"
        if self.broken is not None:
            found["broken_before"] = self.broken
        if self.jumped is not None:
            found |= {"jumped_from": self.jumped, "start": "cold: the first frame is unlike the others"}
        return found


def origin_of(
    part: tuple[int, ...],
    frame: Frame,
    memories: Sequence[GarmentHistory],
    *,
    near: Sequence[int],
    edge: float,
    gap: bool,
) -> Origin:
    """Choose the frame to start from.

    Args:
        part: Numbers of the garments.
        near: Numbers of the bodies within reach.
        edge: Mean edge of the cages [m].
        gap: Whether the time between samples is too long.
    """
    near_by = {"near": near, "edge": edge}
    broken, jumped = _broken(part, frame, memories, **near_by), jumped_from(part, frame, memories, **near_by)
    frames = tuple(each.last if broken is None else each.before for each in memories)
    frames = frames if jumped is None else (None,) * len(part)
    known = [each for each in frames if each is not None]
    state = None if gap or len(known) < len(part) else join([each.state for each in known])
    motion = _motion(known, [frame.garments[index] for index in part]) if state is not None else AT_REST
    if state is not None and any(each.part != part for each in known):
        state = replace(state, clean=False)  # Garments solved apart may cross.
    return Origin(frames, None if state is None else state.carried(motion), motion, broken, jumped, gap)


def _motion(known: Sequence[SolvedFrame], now: Sequence[GarmentFrame]) -> Rigid:
    """The rigid motion closest to the cages' motion; identity if garments start from different frames."""
    before, after = ([each.points for each in frames] for frames in ([each.frame for each in known], now))
    if len({each.time for each in known}) > 1 or any(a.shape != b.shape for a, b in zip(before, after, strict=True)):
        return AT_REST
    return best_motion(np.concatenate(before), np.concatenate(after))


def _broken(
    part: tuple[int, ...], frame: Frame, memories: Sequence[GarmentHistory], *, near: Sequence[int], edge: float
) -> float | None:
    """Time code of the last frame, if only the last frame's input left its place."""
    pairs = [(each.last, each.before) for each in memories if each.last is not None and each.before is not None]
    return _elsewhere(part, frame, pairs, near=near, edge=edge) if len(pairs) == len(part) else None


def jumped_from(
    part: tuple[int, ...], frame: Frame, memories: Sequence[GarmentHistory], *, near: Sequence[int], edge: float
) -> float | None:
    """Time code of the first frame, if garments' input jumped from the first frame to the second and stays there."""
    pairs = [(each.before, each.last) for each in memories if each.last is not None and each.before is not None]
    begun = len(pairs) == len(part) and all(first.first for first, _ in pairs)
    return _elsewhere(part, frame, pairs, near=near, edge=edge) if begun else None


def _elsewhere(
    part: tuple[int, ...],
    frame: Frame,
    pairs: Sequence[tuple[SolvedFrame, SolvedFrame]],
    *,
    near: Sequence[int],
    edge: float,
) -> float | None:
    """Time code of the first of two earlier frames, if the input was in another place in that frame only.

    Args:
        pairs: The two frames of each garment.
        near: Numbers of the bodies within reach.
        edge: Mean edge of the cages [m]; a smaller move is no break: the cloth follows the move.
    """

    def moved(known: SolvedFrame, now: GarmentFrame, some: Sequence[int]) -> float:
        return max(cage_moved(known, now), bodies_moved(known, frame.colliders, some))

    for index, (odd, other) in zip(part, pairs, strict=True):
        now, some = frame.garments[index], sorted({*near, *odd.near, *other.near})
        away = moved(odd, now, some)
        if away > edge and moved(other, now, some) < RETURNED * away:
            return odd.time
    return None


def is_same(part: tuple[int, ...], frame: Frame, memories: Sequence[GarmentHistory], near: Sequence[int]) -> bool:
    """Whether garments and nearby bodies are unchanged and were solved together."""
    for index, each in zip(part, (each.last for each in memories), strict=True):
        if each is None or each.part != part or near != each.near or not each.whole:
            return False
        now, then = frame.garments[index], each.frame
        if not (set_alike(now, then) and np.array_equal(now.points, then.points)):
            return False
        if not (_pushed_alike(now.acceleration, then.acceleration) and _pushed_alike(now.load, then.load)):
            return False
        poses = [(each.colliders[body], frame.colliders[body]) for body in near]
        if not all(a is not None and b is not None and a.equals(b) for a, b in poses):
            return False
    return True


def _pushed_alike(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    """Whether the cloth feels equal accelerations, or equal loads."""
    return a is b or (a is not None and b is not None and np.array_equal(a, b))


def air_moved(before: GarmentFrame, now: GarmentFrame) -> float:
    """Largest distance by which a change of the air's load moves the cloth against its guide [m]."""
    if before.load is now.load:
        return 0.0
    calm = np.zeros_like(now.points)
    start, end = (calm if frame.load is None else frame.load for frame in (before, now))
    return float(np.linalg.norm(end - start, axis=1).max(initial=0.0)) / max(now.guide, 1e-30)


def set_alike(a: GarmentFrame, b: GarmentFrame) -> bool:
    """Whether the artist's settings are equal in two frames."""
    return (a.fabric, a.guide, a.detail, a.offset) == (b.fabric, b.guide, b.detail, b.offset)


def cage_moved(known: SolvedFrame, now: GarmentFrame) -> float:
    """Largest move of a garment's cage points since a frame [m]; infinite if not a length."""
    if now.points.shape != known.frame.points.shape:
        return np.inf
    far = float(np.linalg.norm(now.points - known.frame.points, axis=1).max(initial=0.0))
    return far if np.isfinite(far) else np.inf


def bodies_moved(
    known: SolvedFrame, colliders: Sequence[Pose | None], near: Sequence[int], *, along: Rigid = AT_REST
) -> float:
    """Largest deviation of bodies from a rigid motion since a frame [m]; infinite if not comparable."""
    farthest = 0.0
    for body in near:
        before, after = known.colliders[body], colliders[body]
        farthest = max(farthest, np.inf if before is None or after is None else after.moved(before, along))
    return farthest
