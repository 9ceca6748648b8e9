"""Computes the placement of a prim in the world, in metres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pxr import Gf, Usd, UsdGeom

from ...errors import GarmentError
from ..stage import Notice, timecode

_SINGULAR = 1e-9
_EXTREME = 1e30
"""Largest scale, and inverse of the smallest, for finite volumes."""
_REMEDY = "give the prim and its ancestors a scale other than zero there, or leave that time out with --frames"


def to_metres(prim: Usd.Prim, metres: float, time: float | None) -> np.ndarray:
    """Matrix for column vectors from a prim's local space to world metres, shape (4, 4), float64.

    Raises:
        GarmentError: When the matrix is not invertible.
    """
    return check_matrix(prim, UsdGeom.XformCache(timecode(time)).GetLocalToWorldTransform(prim), metres, time=time)


def check_matrix(prim: Usd.Prim, rows: Gf.Matrix4d, metres: float, *, time: float | None) -> np.ndarray:
    """Convert USD's row-vector matrix to a column-vector matrix to metres.

    Raises:
        GarmentError: When the matrix is singular, not finite, projective or of extreme scale.
    """
    matrix = np.array(rows, dtype=np.float64).T.copy()
    path = str(prim.GetPath())
    if not np.isfinite(matrix).all():
        raise GarmentError(path, "its transform to the world is NaN or infinite", time=time, remedy=_REMEDY)
    if message := flattened(matrix):
        raise GarmentError(path, message, time=time, remedy=_REMEDY)
    stretch = float(np.linalg.svd(matrix[:3, :3], compute_uv=False)[0])
    if not 1.0 / _EXTREME < stretch < _EXTREME:
        message = f"its transform to the world scales by {stretch:.3g}"
        raise GarmentError(path, message, time=time, remedy=f"give a scale of {1 / _EXTREME:g} to {_EXTREME:g}")
    if not is_affine(matrix):
        message = "its transform to the world is projective"
        raise GarmentError(path, message, time=time, remedy="author affine transforms")
    matrix[:3] *= metres
    return matrix


def is_affine(matrix: np.ndarray) -> bool:
    """Whether the last row of a matrix for column vectors, shape (4, 4), is (0, 0, 0, 1) but for rounding."""
    return matrix[3].tolist() == [0.0, 0.0, 0.0, 1.0] or np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0])


def flattened(matrix: np.ndarray) -> str:
    """The scales of a matrix for column vectors, shape (4, 4), in words if the matrix is singular; else ""."""
    if not np.isfinite(matrix).all():
        return ""
    stretches = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if stretches[2] > _SINGULAR * stretches[0]:
        return ""
    first, second, third = (f"{stretch:.3g}" for stretch in stretches)
    return f"its transform to the world is singular: it scales by {first}, {second} and {third}"


def place(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Apply a (4, 4) column-vector matrix to points, shape (V, 3); non-finite points stay non-finite."""
    with np.errstate(invalid="ignore", over="ignore"):
        return points @ matrix[:3, :3].T + matrix[:3, 3]


def is_flipped(prim: Usd.Prim, matrix: np.ndarray) -> bool:
    """Whether the authored winding is clockwise seen from outside, in world space."""
    left_handed = UsdGeom.Gprim(prim).GetOrientationAttr().Get(Usd.TimeCode.EarliestTime()) == UsdGeom.Tokens.leftHanded
    linear = matrix[:3, :3] / max(float(np.abs(matrix[:3, :3]).max()), np.finfo(float).tiny)
    return left_handed != bool(np.linalg.slogdet(linear)[0] < 0)


def check_placement(prim: Usd.Prim, metres: float, times: Sequence[float]) -> tuple[Notice, ...]:
    """A notice of a switch in mirroring; GarmentError for an invalid transform."""
    mirrored = [bool(np.linalg.slogdet(to_metres(prim, metres, time)[:3, :3])[0] < 0) for time in times]
    switches = [
        time for time, current, previous in zip(times[1:], mirrored[1:], mirrored, strict=False) if current != previous
    ]
    message = "its transform starts or stops mirroring here; the winding of its first time code is used throughout"
    return tuple(Notice(str(prim.GetPath()), time, message) for time in switches[:1])
