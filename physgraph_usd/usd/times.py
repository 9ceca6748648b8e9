"""Time codes of garments, in composed stage time: the time codes at which a shot is solved are chosen here alone.

Time codes within `SAME_TIME` of each other are the same. A jump has two: two samples of one attribute nearer than that,
with different values, are the pose before the jump and the pose after it.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from operator import itemgetter
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from ..errors import AbsentError, named_time
from ..solver.scene import FARTHEST, SAME_TIME
from .instances import drawn_with
from .lookup import with_ancestors
from .stage import quiet

_PLACED = ("protoIndices", "ids", "invisibleIds", "positions", "orientations", "orientationsf", "scales")
_SHAPE = ("points", "radius", "radiusTop", "radiusBottom", "height", "size", *_PLACED)
"""Attributes of a mesh's or another shape's form, and of an instancer's instances."""
_TURNING = ("rotate", "orient")
_SLOWEST, _FASTEST, _FRAME_RATE = 12.0, 120.0, 24.0
"""Least and most frames a second, and how many where none of the stage's rates is between [1/s]."""
_MOST = 10_000
"""Most whole frames between two keys: a key farther away is a stray one."""
_HELD = "ExtrapHeld"
"""Name of USD's extrapolation of a spline by a constant first or last value."""
_ALIKE = 1e-6
"""Largest difference of two equal values, relative to the largest number: the rounding of single precision."""


@dataclass(frozen=True)
class FrameGrid:
    """Whole frames of a stage: whole time codes, unless these are too long or too short for frames, as seconds are.

    Where framesPerSecond is authored and a frame is a whole number of time codes, its frames are the stage's.

    Attributes:
        length: Length of a frame in time codes.
        first: Time code of a whole frame.
    """

    length: float = 1.0
    first: float = 0.0

    @staticmethod
    def of(stage: Usd.Stage) -> FrameGrid:
        """The frames of a stage."""
        rate, start, played = stage.GetTimeCodesPerSecond(), stage.GetStartTimeCode(), stage.GetFramesPerSecond()
        is_multiple = stage.HasAuthoredMetadata("framesPerSecond") and abs(rate / played % 1.0) <= _ALIKE
        rates = (played, rate) if is_multiple else (rate, played)
        frames = next((rate for rate in rates if _SLOWEST <= rate <= _FASTEST), _FRAME_RATE)
        return FrameGrid(rate / frames, float(round(start)) if abs(start) <= FARTHEST else 0.0)

    def inside(self, start: float, end: float) -> list[float]:
        """Whole frames between two time codes, if these are over a frame apart and not too many."""
        if not self.length + SAME_TIME < end - start <= _MOST * self.length:
            return []
        low, high = ((time - self.first) / self.length for time in (start + SAME_TIME, end - SAME_TIME))
        return [self.first + number * self.length for number in range(math.ceil(low), math.floor(high) + 1)]

    def has(self, time: float) -> bool:
        """Whether a time code is a whole frame."""
        number = (time - self.first) / self.length
        return abs(number - round(number)) * self.length <= SAME_TIME


@dataclass(frozen=True)
class Motion:
    """Time codes of what moves a prim.

    Attributes:
        times: Authored time codes, as by `merge`.
        arcs: Spans of time codes in which points may leave the straight line between samples.
    """

    times: tuple[float, ...] = ()
    arcs: tuple[tuple[float, float], ...] = ()

    @staticmethod
    def joined(motions: Iterable[Motion]) -> Motion:
        """The motion by several things, the most important first."""
        motions = [*motions]
        arcs = dict.fromkeys(arc for motion in motions for arc in motion.arcs)
        return Motion(merge(*(motion.times for motion in motions)), tuple(arcs))


def motion_of(prim: Usd.Prim, *, skinned: Mapping[Sdf.Path, Motion] | None = None) -> Motion:
    """Motion of a prim's shape and transforms; for an instancer also of its prototypes and nested instancers.

    Args:
        prim: A mesh, shape, instancer or transform.
        skinned: Motion of skinned prims by path, used instead of the motion of the prims' authored points.
    """
    motions = skinned or {}
    return Motion.joined(
        motions.get(drawn_prim.GetPath()) or motion_alone(drawn_prim) for drawn_prim in drawn_with(prim)
    )


def motion_alone(prim: Usd.Prim, *, shape: bool = True) -> Motion:
    """Motion of a prim's transforms and, if ``shape``, of its shape, whose time codes come first in `merge`."""
    form = [prim.GetAttribute(name) for name in _SHAPE if shape and prim.HasAttribute(name)]
    ops = [op for transform in transform_chain(prim) for op in transform.GetOrderedXformOps()]
    turning = [op.GetOpTypeToken(op.GetOpType()).startswith(_TURNING) for op in ops]
    placed = [motion_by(op.GetAttr(), turns=turns) for op, turns in zip(ops, turning, strict=True)]
    return Motion.joined([*map(motion_by, form), *placed])


def motion_by(attribute: Usd.Attribute, *, turns: bool = False) -> Motion:
    """Motion by an attribute: its time samples or spline; arcs between samples of a rotation and along splines."""
    spline = spline_of(attribute)
    if spline is not None:
        times = _spline_times(spline, attribute.GetStage())
        return Motion(times, tuple(pairwise(times)))
    # Below a layer offset of negative scale, USD before 26 gives samples in falling order.
    times = sorted(attribute.GetTimeSamples())
    double = {a for a, b in pairwise(times) if b - a <= SAME_TIME and _alike(attribute.Get(a), attribute.Get(b))}
    inside = FrameGrid.of(attribute.GetStage()).inside if turns and len(times) > 1 else None
    spans = [span for span in pairwise(times) if inside and inside(*span)]
    arcs = [(a, b) for a, b in spans if not _alike(attribute.Get(a), attribute.Get(b))]
    return Motion(tuple(time for time in times if time not in double), tuple(arcs))


def spline_of(attribute: Usd.Attribute) -> Any | None:
    """The spline that an attribute's value comes from; None without one, and with a USD older than splines."""
    has_spline, get_spline = (getattr(attribute, name, None) for name in ("HasSpline", "GetSpline"))
    return get_spline() if has_spline is not None and get_spline is not None and has_spline() else None


def is_animated(attribute: Usd.Attribute) -> bool:
    """Whether an attribute's value comes from time samples or a spline."""
    return attribute.GetNumTimeSamples() > 0 or spline_of(attribute) is not None


def _spline_times(spline: Any, stage: Usd.Stage) -> tuple[float, ...]:
    """Time codes of a spline's knots and ends of loops; the stage's start and end too, unless it holds there."""
    knots = sorted(float(time) for time in spline.GetKnots().keys())
    with quiet():  # USD 26 calls inner loops deprecated.
        looped = spline.GetInnerLoopParams().GetLoopedInterval() if spline.HasInnerLoops() else None
    knots += [looped.min, looped.max] if looped is not None else []
    if not knots or not stage.HasAuthoredTimeCodeRange():
        return tuple(sorted({*knots}))
    start, end = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    moves = [
        extrapolation.mode.name != _HELD
        for extrapolation in (spline.GetPreExtrapolation(), spline.GetPostExtrapolation())
    ]
    knots += [start] * (moves[0] and start < min(knots)) + [end] * (moves[1] and max(knots) < end)
    return tuple(sorted({*knots}))


def solve_times(cloth: Motion, bodies: Iterable[Motion], frames: FrameGrid) -> tuple[float, ...]:
    """Time codes at which a garment is solved, ascending: the garment's samples, and whole frames between two samples.

    Whole frames are solved on arcs of the garment or of touching bodies, and at samples of touching bodies. A still
    garment takes the samples of touching bodies.
    """
    moves = len(cloth.times) > 1
    if moves and not any(frames.inside(*span) for span in pairwise(cloth.times)):
        return cloth.times
    moving = [body for body in bodies if len(body.times) > 1]
    solve_times = cloth.times if moves else merge(cloth.times, *(body.times for body in moving))
    between = [time for span in pairwise(solve_times) for time in frames.inside(*span)]
    arcs = [arc for motion in (cloth, *moving) for arc in motion.arcs]
    sampled = merge(*(body.times for body in moving))
    wanted = [time for time in between if is_among(time, sampled) or any(a < time < b for a, b in arcs)]
    return merge(solve_times, wanted)


def found_among(time: float, times: Sequence[float]) -> float | None:
    """The nearest of several ascending time codes to a time code, within `SAME_TIME`; None if all are farther."""
    same = times[bisect_left(times, time - SAME_TIME) : bisect_right(times, time + SAME_TIME)]
    return min(same, key=lambda candidate: abs(candidate - time), default=None)


def is_among(time: float, times: Sequence[float]) -> bool:
    """Whether a time code equals one of several ascending time codes, within `SAME_TIME`."""
    return found_among(time, times) is not None


def transform_chain(prim: Usd.Prim) -> list[UsdGeom.Xformable]:
    """The transforms placing a prim, nearest first, up to a reset of the transform stack."""
    chain = []
    for ancestor in with_ancestors(prim):
        transform = UsdGeom.Xformable(ancestor)
        if transform:
            chain.append(transform)
            if transform.GetResetXformStack():
                break
    return chain


def merge(*sources: Iterable[float]) -> tuple[float, ...]:
    """Sort the time codes of several sources; the same time code is kept as the earliest source has it.

    Of a source with two, which are the sides of a jump, both are kept.
    """
    ranked = sorted({(time, rank) for rank, source in enumerate(sources) for time in source})
    merged, start = list[float](), 0
    while start < len(ranked):
        end = bisect_right(ranked, ranked[start][0] + SAME_TIME, key=itemgetter(0))
        same = sorted(ranked[start:end], key=itemgetter(1))
        group_times = [[time for time, _ in group] for _, group in groupby(same, key=itemgetter(1))]
        merged += next((times for times in group_times if len(times) > 1), group_times[0])
        start = end
    return tuple(merged)


def none_within(every: Sequence[float], frames: tuple[float, float]) -> AbsentError:
    """The error of a frame range without a sample.

    Args:
        every: All time codes of the shot, ascending.
        frames: First and last time code.
    """
    message = f"no sample of the shot lies in frames {':'.join(map(named_time, frames))}"
    if not every:
        return AbsentError(f"{message}; it has none: leave out --frames")
    first, last = named_time(every[0]), named_time(every[-1])
    span = f"its {len(every)} samples run from {first} to {last}"
    return AbsentError(f"{message}; {span}; give a range that holds one, such as --frames {first}:{last}")


def snap(times: Iterable[float], merged: Sequence[float]) -> tuple[float, ...]:
    """Replace each time code by the nearest time code kept by ``merge``, once each."""
    codes = np.asarray(merged)
    return tuple(dict.fromkeys(float(codes[np.abs(codes - time).argmin()]) for time in times))


def within(times: Iterable[float], frames: tuple[float, float] | None) -> tuple[float, ...]:
    """Time codes inside a closed range; all time codes without a range."""
    if frames is None:
        return tuple(times)
    return tuple(time for time in times if frames[0] - SAME_TIME <= time <= frames[1] + SAME_TIME)


def _alike(a: object, b: object) -> bool:
    """Whether two values of an attribute are equal up to rounding."""
    try:
        first, second = (np.asarray(value, dtype=np.float64) for value in (a, b))
    except (TypeError, ValueError):  # A quaternion, or a value that is blocked.
        return a == b
    most = _ALIKE * float(np.abs(first[np.isfinite(first)]).max(initial=0.0))
    return first.shape == second.shape and np.allclose(first, second, rtol=0.0, atol=most, equal_nan=True)
