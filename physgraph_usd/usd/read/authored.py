"""Finds faults of authored attributes: beyond limits, misspelt, misplaced, or connected to no value."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from pxr import Usd, UsdGeom

from ..lookup import USER_PROPERTIES, bound_materials, connected, find_value, is_within, nearest, with_ancestors
from ..schema import COLLIDER_API, GARMENT_API, MATERIAL, PROPERTIES, RETIRED, Property, nearest_property
from ..stage import Notice
from ..write.track import HEAT, PREFIX
from .materials import ON_MATERIAL

_OURS = ("physgraph", "primvars:physgraph")
_NAMES = {row.name for row in PROPERTIES}
_WRITTEN = {PREFIX + name for name in HEAT}
_BLENDERS = {name.replace("physgraph:", "physgraph_") for name in _NAMES if name.startswith(PREFIX)}
"""Blender's exporter writes no colons in the names of primvars."""


def authored_faults(garments: Sequence[Usd.Prim], colliders: Sequence[Usd.Prim]) -> list[Notice]:
    """Notices of unread or out-of-limit properties on prims, their ancestors, and materials of prims and subsets.

    A notice of an unread property suggests the most similar name.
    """
    notices: dict[Notice, None] = {}
    for prim in (*garments, *colliders):
        for ancestor in with_ancestors(prim):
            notices |= dict.fromkeys(_unread_on(ancestor, material=False))
        subsets = UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(prim))
        for part in (prim, *(subset.GetPrim() for subset in subsets)):
            for material in bound_materials(part):
                notices |= dict.fromkeys(_unread_on(material, material=True))
    for schema, prims in ((GARMENT_API, garments), (COLLIDER_API, colliders)):
        for attribute, fault, _ in (beyond for prim in prims for beyond in beyond_limits(prim, schema)):
            notices[Notice(str(attribute.GetPrim().GetPath()), None, f"{attribute.GetName()} {fault}")] = None
        for prim in prims:
            for attribute in _animated_in_vain(prim, schema):
                message = f"{attribute.GetName()} changes in time; its first sample is used throughout"
                notices[Notice(str(attribute.GetPrim().GetPath()), None, message)] = None
    return list(notices)


def _animated_in_vain(prim: Usd.Prim, schema: str) -> Iterator[Usd.Attribute]:
    """Attributes of a garment or collider read once although their samples differ."""
    for row in PROPERTIES:
        once = row.uniform or row.interpolation or schema == COLLIDER_API
        if row.schema != schema or row.type == "rel" or not once:
            continue
        attribute = _source(prim, row) if row.interpolation else nearest(prim, row.name)
        times = [] if attribute is None else attribute.GetTimeSamples()
        if attribute is not None and any(attribute.Get(time) != attribute.Get(times[0]) for time in times[1:]):
            yield attribute


def _unread_on(prim: Usd.Prim, *, material: bool) -> Iterator[Notice]:
    for authored in prim.GetAuthoredProperties():
        name = authored.GetName().removeprefix(USER_PROPERTIES)
        fault = _fault(name, material=material) if name.startswith(_OURS) else ""
        if not fault and name in {*_NAMES, *ON_MATERIAL}:
            fault = _connection_fault(prim.GetAttribute(authored.GetName()))
        if fault:
            yield Notice(str(prim.GetPath()), None, f"{authored.GetName()} {fault}")


def _fault(name: str, *, material: bool) -> str:
    """The reason for not reading a property of our namespace, or ""."""
    if name in _NAMES:
        return "is not read on a material; author it on the garment" if material and MATERIAL not in name else ""
    if name in RETIRED:
        return f"is no attribute any more: {RETIRED[name]}; it can be removed"
    near = nearest_property(name, PROPERTIES)
    hint = f"did you mean {near.name}?" if near else "docs/attributes.md lists all"
    return "" if name in _WRITTEN | _BLENDERS else f"is no attribute that refining reads; {hint}"


def _connection_fault(attribute: Usd.Attribute) -> str:
    """The reason for not following an attribute's connection, or ""."""
    painted = attribute and attribute.GetName().startswith(PREFIX)
    if not attribute or not attribute.HasAuthoredConnections() or (connected(attribute) and not painted):
        return ""
    named = ", ".join(f"<{path}>" for path in attribute.GetConnections()) or "nothing"
    return f"is connected to {named}, which gives no value in one step; the connection is not followed"


def beyond_limits(prim: Usd.Prim, schema: str = GARMENT_API) -> Iterator[tuple[Usd.Attribute, str, bool]]:
    """Out-of-limit values authored on a garment or collider, or on ancestors or materials.

    Yields:
        The attribute, the fault with value and limits, and whether the limits are hard.
    """
    for row in PROPERTIES:
        if row.schema != schema or row.soft is None:
            continue
        attribute = _source(prim, row)
        values = [] if attribute is None else _extremes(attribute)
        hard = next((value for value in values if not is_within(value, row.minimum, row.maximum)), None)
        soft = next((value for value in values if not is_within(value, *row.soft)), None)
        if attribute is not None and hard is not None:
            yield attribute, _fault_of(row, hard, "hard", (row.minimum, row.maximum)), True
        elif attribute is not None and soft is not None:
            yield attribute, _fault_of(row, soft, "soft", row.soft), False


def _source(prim: Usd.Prim, row: Property) -> Usd.Attribute | None:
    """The attribute giving a value; None if not authored."""
    if not row.interpolation:
        return find_value(prim, row).attribute
    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(row.name.removeprefix("primvars:"))
    return primvar.GetAttr() if primvar and primvar.HasAuthoredValue() else None


def _extremes(attribute: Usd.Attribute) -> list[float]:
    """Least and greatest number held by an attribute at any time; empty without numbers."""
    codes = [Usd.TimeCode(time) for time in attribute.GetTimeSamples()] or [Usd.TimeCode.Default()]
    arrays = [np.asarray(attribute.Get(code)).ravel() for code in codes]
    numbers = [array for array in arrays if array.size and array.dtype.kind in "biuf"]
    return [float(pick(values)) for pick in (np.min, np.max) for values in numbers]


def _fault_of(row: Property, value: float, kind: str, ends: tuple[float | None, float | None]) -> str:
    low, high = ("" if end is None else f"{end:g}" for end in ends)
    unit = f" {row.unit}" if row.unit else ""
    return f"is {value:.7g}{unit}, beyond its {kind} limits {low} .. {high}".rstrip()
