"""What is kept of a garment's last frames, and from which of them the next one starts.

A frame starts from the last one, unless that one was broken: where the input leaves its place for one frame and comes
back, what was solved there is no start for what follows. Then the frame before it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..colliders.pose import Pose
from ..scene import GarmentFrame
from .values import State

BACK = 0.25
"""Part of the way that the input took into a broken frame by which it may miss its place before, to have come back.
What moves on evenly misses it by twice that way, and what turns round by less only if it moves by less than an edge."""


@dataclass(frozen=True, eq=False)
class Known:
    """One garment's solved frame.

    Attributes:
        time: Time code.
        frame: What it was solved for.
        colliders: Poses of all of the scene's bodies then.
        near: Numbers of those that it could touch.
        part: Numbers of the garments that it was solved with.
        points: Fine positions [m].
        state: What it leaves to the next.
        crossing: Which fine vertices belong to cloth that crosses cloth.
        first: Whether it was solved with none before it.
    """

    time: float | None
    frame: GarmentFrame
    colliders: Sequence[Pose | None]
    near: tuple[int, ...]
    part: tuple[int, ...]
    points: np.ndarray
    state: State
    crossing: np.ndarray
    first: bool = False


def cage_moved(known: Known, now: GarmentFrame) -> float:
    """How far any point of a garment's cage has moved since a frame [m]; infinite where that is no length."""
    if now.points.shape != known.frame.points.shape:
        return np.inf
    far = float(np.linalg.norm(now.points - known.frame.points, axis=1).max(initial=0.0))
    return far if np.isfinite(far) else np.inf


def bodies_moved(known: Known, colliders: Sequence[Pose | None], near: Sequence[int]) -> float:
    """How far any of some bodies has moved since a frame [m]; infinite where one cannot be compared."""
    farthest = 0.0
    for body in near:
        before, after = known.colliders[body], colliders[body]
        farthest = max(farthest, np.inf if before is None or after is None else after.moved(before))
    return farthest


def came_back(
    last: Known, before: Known, now: GarmentFrame, colliders: Sequence[Pose | None], *, near: Sequence[int], edge: float
) -> bool:
    """Whether the input left its place in the last frame alone.

    Args:
        last: The last frame.
        before: The one that it started from.
        now: The garment in this frame.
        colliders: Poses of all bodies in this frame.
        near: Those that the garment may touch.
        edge: Mean edge of the cage [m]; what moves less is no break: the cloth follows it.
    """
    near = sorted({*near, *before.near})
    away = max(cage_moved(last, now), bodies_moved(last, colliders, near))
    return away > edge and max(cage_moved(before, now), bodies_moved(before, colliders, near)) < BACK * away


def jumped_in(
    first: Known,
    second: Known,
    now: GarmentFrame,
    colliders: Sequence[Pose | None],
    *,
    near: Sequence[int],
    edge: float,
) -> bool:
    """Whether the input left its place in the first of three frames alone.

    Args:
        first: The first frame.
        second: The one after it.
        now: The garment in this frame, the third.
        colliders: Poses of all bodies in this frame.
        near: Those that the garment may touch.
        edge: As for `came_back`.
    """
    near = sorted({*near, *first.near, *second.near})
    away = max(cage_moved(first, second.frame), bodies_moved(first, second.colliders, near))
    return away > edge and max(cage_moved(second, now), bodies_moved(second, colliders, near)) < BACK * away


def told_jumped(path: str, jumped: Mapping[float | None, float | None]) -> list[str]:
    """A warning where a garment's input jumps from the first frame to the second.

    Args:
        path: The garment.
        jumped: Time code of the first frame, by that of the third.
    """
    return [
        f"<{path}> at time code {first:g}: the garment or a body jumps from this first frame to the next; if it is "
        f"broken, leave it out with --frames and take the rest shape from another with --rest FRAME. "
        f"Time code {time:g} starts anew"
        for time, first in jumped.items()
        if time is not None and first is not None
    ]


def told_broken(path: str, broken: Mapping[float | None, float | None]) -> list[str]:
    """A warning for each frame in which a garment's input left its place.

    Args:
        path: The garment.
        broken: Time code of the broken frame, by that of the frame after it.
    """
    return [
        f"<{path}> at time code {last:g}: the garment or a body leaves its place for this frame alone; mend it. "
        f"Time code {time:g} starts from the frame before it"
        for time, last in broken.items()
        if time is not None and last is not None
    ]
