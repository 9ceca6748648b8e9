"""What is authored in our names and never read: misspelt attributes, values in the wrong place, connections."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from pxr import Usd

from ..lookup import USER_PROPERTIES, bound_materials, connected, with_ancestors
from ..schema import MATERIAL, PROPERTIES, nearest_property
from ..stage import Notice
from ..write.heat import HEAT, PREFIX
from .deformable import ON_MATERIAL

_OURS = ("physgraph", "primvars:physgraph")
_NAMES = {row.name for row in PROPERTIES}
_WRITTEN = {PREFIX + name for name in HEAT}
_BLENDERS = {name.replace("physgraph:", "physgraph_") for name in _NAMES if name.startswith(PREFIX)}
"""Blender's exporter writes no colons in the names of primvars."""


def unread(prims: Iterable[Usd.Prim]) -> list[Notice]:
    """Tell of what is authored for garments and colliders, on them, above them or on their materials, and not read.

    Args:
        prims: Garments and colliders.

    Returns:
        One notice per property, with the name that is spelt most like it.
    """
    notices: dict[Notice, None] = {}
    for prim in prims:
        for each in with_ancestors(prim):
            notices |= dict.fromkeys(_unread_on(each, material=False))
        for each in bound_materials(prim):
            notices |= dict.fromkeys(_unread_on(each, material=True))
    return list(notices)


def _unread_on(prim: Usd.Prim, *, material: bool) -> Iterator[Notice]:
    for authored in prim.GetAuthoredProperties():
        name = authored.GetName().removeprefix(USER_PROPERTIES)
        fault = _fault(name, material=material) if name.startswith(_OURS) else ""
        if not fault and name in {*_NAMES, *ON_MATERIAL}:
            fault = _connection_fault(prim.GetAttribute(authored.GetName()))
        if fault:
            yield Notice(str(prim.GetPath()), None, f"{authored.GetName()} {fault}")


def _fault(name: str, *, material: bool) -> str:
    """Why a property of our namespace is not read, or ""."""
    if name in _NAMES:
        return "is not read on a material; author it on the garment" if material and MATERIAL not in name else ""
    near = nearest_property(name, PROPERTIES)
    said = f"did you mean {near.name}?" if near else "docs/attributes.md lists all"
    return "" if name in _WRITTEN | _BLENDERS else f"is no attribute that refining reads; {said}"


def _connection_fault(attribute: Usd.Attribute) -> str:
    """Why the connection of an attribute is not followed, or ""."""
    painted = attribute and attribute.GetName().startswith(PREFIX)
    if not attribute or not attribute.HasAuthoredConnections() or (connected(attribute) and not painted):
        return ""
    named = ", ".join(f"<{path}>" for path in attribute.GetConnections()) or "nothing"
    return f"is connected to {named}, which gives no value in one step; the connection is not followed"
