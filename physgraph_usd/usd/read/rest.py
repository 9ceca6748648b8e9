"""A garment's rest shape in metres, and its source.

The first of these: ``--rest`` (a frame, or "auto": the shape fitted to the median length that each edge has over the
shot), ``physics:restShapePoints``, ``primvars:rest``, ``primvars:Pref``, the points' default value, the points' first
sample. It is placed in the world as the garment at its first time code, or by a skinned garment's bind transform.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from ...errors import GarmentError
from ...solver.scene import out_of_bounds
from ..lookup import nearest, source_name
from ..stage import Notice
from .cage import as_points, repair

AUTO = "auto"
"""A rest shape fitted to the animation, in place of a time code."""
_AUTHORED = ("physics:restShapePoints", "primvars:rest", "primvars:Pref")
_BENT = ("restShape", "restShapeDefault")
_TINY = 1e-9
_MOST_SCALED = 2.0


@dataclass(frozen=True, eq=False)
class Rest:
    """A rest shape.

    Attributes:
        points: Rest positions [m], shape (V, 3), float64.
        source: Their source in words, for the report.
        notices: Warnings about them.
    """

    points: np.ndarray
    source: str
    notices: tuple[Notice, ...] = ()


def read_rest(
    prim: Usd.Prim,
    edges: np.ndarray,
    first: np.ndarray,
    *,
    place: Callable[[np.ndarray], np.ndarray],
    baked: Sdf.Layer,
) -> Rest:
    """Find the rest shape on the stage, still to be `checked`.

    Args:
        prim: Mesh prim.
        edges: Edges of the cage, shape (E, 2).
        first: Positions at the points' first sample, or the default [m], shape (V, 3).
        place: From local rest points to metres, (V, 3) to (V, 3).
        baked: Layer of baked skinning, whose points are no rest shape.

    Raises:
        GarmentError: When an authored rest shape does not fit the mesh.
    """
    path, count = str(prim.GetPath()), len(first)
    authored = _authored(prim, count)
    if authored is not None:
        return Rest(place(authored[0]), authored[1])
    default = _default_points(prim, baked)
    if default is None:
        return Rest(first, "first sample of points")
    if len(default) != count:
        message = f"the default points are {len(default)}, the mesh has {count}; the first sample is the rest shape"
        return Rest(first, "first sample of points", (Notice(path, None, message),))
    points = place(default)
    notices: tuple[Notice, ...] = ()
    if not np.isfinite(points).all():
        points = repair(points, edges, first)
        notices = (Notice(path, None, "the default points have NaN or infinite values, repaired for the rest shape"),)
    return Rest(points, "default points", notices)


def checked(prim: Usd.Prim, edges: np.ndarray, rest: Rest, *, first: np.ndarray) -> Rest:
    """A rest shape with notices of edges without length, and of a size that differs from the animation's.

    Points at one place are sewn together where the animation has them at one place, too; the faces between them are no
    cloth.

    Raises:
        GarmentError: When all of its points are at one place, or one is out of bounds.
    """
    path = str(prim.GetPath())
    if message := out_of_bounds(rest.points):
        raise GarmentError(path, f"the rest shape's ({rest.source}) {message}", remedy="check units and transforms")
    edges = edges[edges[:, 0] != edges[:, 1]]
    lengths = np.linalg.norm(rest.points[edges[:, 0]] - rest.points[edges[:, 1]], axis=1)
    mean = float(lengths.mean()) if len(lengths) else 0.0
    if len(lengths) and mean == 0.0:
        message, remedy = (
            f"all points of the rest shape ({rest.source}) are at one place",
            "choose another --rest FRAME",
        )
        raise GarmentError(path, message, remedy=remedy)
    short = np.flatnonzero(lengths <= _TINY * mean)
    notices = rest.notices
    if len(short):
        low, high = edges[short[0]]
        edge = "edge has" if len(short) == 1 else "edges have"
        message = f"{len(short)} {edge} no length in the rest shape ({rest.source}), the first between points[{low}]"
        notices = (*notices, Notice(path, None, f"{message} and points[{high}]: points at one place are taken for one"))
    now = float(np.linalg.norm(first[edges[:, 0]] - first[edges[:, 1]], axis=1).mean()) if len(edges) else 0.0
    ratio = mean / now if now > 0 else 1.0
    if 1 / _MOST_SCALED <= ratio <= _MOST_SCALED:
        return Rest(rest.points, rest.source, notices)
    message = f"the rest shape ({rest.source}) has edges {ratio:.3g} times as long as the animation's; check its units"
    return Rest(rest.points, rest.source, (*notices, Notice(path, None, message)))


def rests_bent(prim: Usd.Prim) -> tuple[bool, list[Notice]]:
    """Whether hinges rest at the rest shape's angles (``physics:restBendAnglesDefault``); a notice of an older word."""
    attribute = nearest(prim, "physics:restBendAnglesDefault")
    if attribute is None:
        return False, []
    value = str(attribute.Get())
    new = {"restShapeDefault": "restShape", "flatDefault": "flat"}.get(value)
    message = f"physics:restBendAnglesDefault is {value!r}, the proposal's older name; author {new!r}"
    return value in _BENT, [Notice(str(attribute.GetPrim().GetPath()), None, message)] if new else []


def _authored(prim: Usd.Prim, count: int) -> tuple[np.ndarray, str] | None:
    """Local rest points of an attribute other than ``points``."""
    for name in _AUTHORED:
        attribute = prim.GetAttribute(name)
        if not attribute or not attribute.HasAuthoredValue():
            continue
        source = UsdGeom.Primvar(attribute).ComputeFlattened if name.startswith("primvars:") else attribute.Get
        value = source(Usd.TimeCode.EarliestTime())
        if value is None or np.size(value) == 0:
            continue
        points = as_points(value, str(prim.GetPath()), name)
        if len(points) != count:
            message = f"{name} has {len(points)} values, the mesh has {count} points"
            remedy = "author one value per point (vertex interpolation), or remove it"
            raise GarmentError(str(prim.GetPath()), message, remedy=remedy)
        broken = ~np.isfinite(points).all(axis=1)
        if broken.any():
            message = f"{source_name(attribute)}[{broken.argmax()}] is NaN or infinite"
            remedy = "author finite rest positions, or remove them"
            raise GarmentError(str(prim.GetPath()), message, remedy=remedy)
        return points, source_name(attribute)
    return None


def _default_points(prim: Usd.Prim, baked: Sdf.Layer) -> np.ndarray | None:
    """The points' default value from the stage's own layers."""
    for spec in UsdGeom.Mesh(prim).GetPointsAttr().GetPropertyStack(Usd.TimeCode.Default()):
        if spec.layer != baked and spec.HasDefaultValue():
            value = spec.default
            return None if isinstance(value, Sdf.ValueBlock) else as_points(value, str(prim.GetPath()), "points")
    return None
