"""Values that are authored beyond the limits of their attributes, wherever a prim takes them from."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pxr import Usd, UsdGeom

from ..lookup import find_value
from ..schema import COLLIDER_API, GARMENT_API, PROPERTIES, Property


def beyond_limits(prim: Usd.Prim, schema: str = GARMENT_API) -> Iterator[tuple[Usd.Attribute, str, bool]]:
    """Iterate over what a prim, its ancestors or its material author for it beyond limits.

    Args:
        prim: A garment or a collider.
        schema: `GARMENT_API` or `COLLIDER_API`.

    Yields:
        The attribute, what is wrong with value and limits, and whether the limits are hard.
    """
    for row in PROPERTIES:
        if row.schema != schema or row.soft is None:
            continue
        attribute = _giver(prim, row)
        values = [] if attribute is None else _extremes(attribute)
        hard = next((value for value in values if not _inside(value, row.minimum, row.maximum)), None)
        soft = next((value for value in values if not _inside(value, *row.soft)), None)
        if attribute is not None and hard is not None:
            yield attribute, _said(row, hard, "hard", (row.minimum, row.maximum)), True
        elif attribute is not None and soft is not None:
            yield attribute, _said(row, soft, "soft", row.soft), False


def beyond_limits_of_all(garments: list[Usd.Prim], colliders: list[Usd.Prim]) -> Iterator[tuple[str, str]]:
    """Iterate over paths and faults of what is authored beyond limits for garments and colliders."""
    for schema, prims in ((GARMENT_API, garments), (COLLIDER_API, colliders)):
        for prim in prims:
            for attribute, said, _ in beyond_limits(prim, schema):
                yield str(attribute.GetPrim().GetPath()), f"{attribute.GetName()} {said}"


def _giver(prim: Usd.Prim, row: Property) -> Usd.Attribute | None:
    """The attribute that gives a value; None where none is authored."""
    if not row.interpolation:
        return find_value(prim, row).attribute
    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(row.name.removeprefix("primvars:"))
    return primvar.GetAttr() if primvar and primvar.HasAuthoredValue() else None


def _extremes(attribute: Usd.Attribute) -> list[float]:
    """Least and greatest number that an attribute holds at any time; empty where it holds none."""
    codes = [Usd.TimeCode(time) for time in attribute.GetTimeSamples()] or [Usd.TimeCode.Default()]
    arrays = [np.asarray(attribute.Get(code)).ravel() for code in codes]
    numbers = [array for array in arrays if array.size and array.dtype.kind in "biuf"]
    return [float(pick(each)) for pick in (np.min, np.max) for each in numbers]


def _inside(value: float, low: float | None, high: float | None) -> bool:
    """Whether a value is inside limits, compared in float32, as a layer holds both."""
    held = np.float32(value)
    return bool(np.float32(-np.inf if low is None else low) <= held <= np.float32(np.inf if high is None else high))


def _said(row: Property, value: float, kind: str, ends: tuple[float | None, float | None]) -> str:
    low, high = ("" if end is None else f"{end:g}" for end in ends)
    unit = f" {row.unit}" if row.unit else ""
    return f"is {value:.7g}{unit}, beyond its {kind} limits {low} .. {high}".rstrip()
