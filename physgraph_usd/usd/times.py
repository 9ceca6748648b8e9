"""Time codes of garments, in composed stage time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from pxr import Usd, UsdGeom

from ..errors import AbsentError
from .lookup import with_ancestors

SAME_TIME = 1e-6
"""Time codes closer than this count as equal: layer offsets leave rounding errors."""


def transform_chain(prim: Usd.Prim) -> list[UsdGeom.Xformable]:
    """The transforms placing a prim, nearest first, up to a reset of the transform stack."""
    chain = []
    for each in with_ancestors(prim):
        transform = UsdGeom.Xformable(each)
        if transform:
            chain.append(transform)
            if transform.GetResetXformStack():
                break
    return chain


def garment_times(prim: Usd.Prim) -> tuple[float, ...]:
    """All authored time codes of the points and of the prim's transforms, ascending."""
    return merge([*UsdGeom.Mesh(prim).GetPointsAttr().GetTimeSamples(), *transform_times(prim)])


def transform_times(prim: Usd.Prim) -> list[float]:
    """All authored time codes of a prim's transforms, unordered.

    A transform animated by a spline contributes the knots and the whole time codes between the knots.
    """
    chain = transform_chain(prim)
    sampled = [time for transform in chain for time in transform.GetTimeSamples()]
    return sampled + [
        time for transform in chain for op in transform.GetOrderedXformOps() for time in _spline_times(op.GetAttr())
    ]


def _spline_times(attribute: Usd.Attribute) -> list[float]:
    has_spline, get_spline = (getattr(attribute, name, None) for name in ("HasSpline", "GetSpline"))
    if has_spline is None or get_spline is None or not has_spline():
        return []
    knots = [float(time) for time in get_spline().GetKnots().keys()]
    return [*knots, *map(float, range(math.ceil(min(knots)), math.floor(max(knots)) + 1))] if knots else []


def none_within(every: Sequence[float], frames: tuple[float, float]) -> AbsentError:
    """The error of a frame range without a sample.

    Args:
        every: All time codes of the shot, ascending.
        frames: First and last time code.
    """
    message = "no sample of the shot lies in frames {:g}:{:g}".format(*frames)
    if not every:
        return AbsentError(f"{message}; it has none: leave out --frames")
    span = f"its {len(every)} samples run from {every[0]:g} to {every[-1]:g}"
    return AbsentError(f"{message}; {span}; give a range that holds one, such as --frames {every[0]:g}:{every[-1]:g}")


def merge(times: Iterable[float]) -> tuple[float, ...]:
    """Sort time codes and drop near duplicates of earlier input entries."""
    merged: list[tuple[float, int]] = []
    for time, rank in sorted((time, rank) for rank, time in enumerate(times)):
        if merged and time - merged[-1][0] <= SAME_TIME:
            merged[-1] = min(merged[-1], (time, rank), key=lambda pair: pair[1])
        else:
            merged.append((time, rank))
    return tuple(time for time, _ in merged)


def snap(times: Iterable[float], merged: Sequence[float]) -> tuple[float, ...]:
    """Replace each time code by the nearest time code kept by ``merge``."""
    known = np.asarray(merged)
    return tuple(float(known[np.abs(known - time).argmin()]) for time in times)


def within(times: Iterable[float], frames: tuple[float, float] | None) -> tuple[float, ...]:
    """Time codes inside a closed range, up to rounding; all time codes without a range."""
    if frames is None:
        return tuple(times)
    return tuple(time for time in times if frames[0] - SAME_TIME <= time <= frames[1] + SAME_TIME)
