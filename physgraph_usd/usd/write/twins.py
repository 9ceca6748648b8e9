"""Keeps meshes that reference or inherit a garment, but author some arrays themselves, as the shot has them.

Such a mesh gets the garment's fine faces, which do not fit its points. The layer therefore authors the shot's value of
every attribute that the mesh takes from the garment.
"""

from __future__ import annotations

from collections.abc import Iterator

from pxr import Sdf, Usd

from ..read.find import has_schema, instance_roots
from ..read.reader import Shot
from ..schema import GARMENT_API
from ..stage import Notice, timecode
from .overs import edit_schemas, open_instances
from .stream import LayerStream

_SHAPE = ("points", "faceVertexCounts", "faceVertexIndices")


def keep_twins(stream: LayerStream, shot: Shot, path: Sdf.Path) -> list[Notice]:
    """Author the shot's values on the meshes that take some of a refined mesh's arrays; a note for each.

    Args:
        path: The mesh whose refined arrays are in the layer already.
    """
    notices, source = [], shot.stage.GetPrimAtPath(path)
    for twin in shot.composed_from(path):
        names = [name for name in _SHAPE if not _is_taken(twin.GetAttribute(name), source.GetAttribute(name))]
        if not names:  # All arrays are the garment's, and are refined with it.
            continue
        notices += open_instances(stream, twin.GetPath(), instance_roots(twin))
        for spec in _attributes(stream.layer, path):
            _keep(stream, shot.stage, spec, spec.path.ReplacePrefix(path, twin.GetPath()))
        if not has_schema(twin, GARMENT_API):
            edit_schemas(stream, twin.GetPath(), deleted=[GARMENT_API])
        _leave_sibling_out(stream, source, twin)
        message = f"is composed from <{path}> and has {', '.join(names)} of its own; it stays as it is in the shot"
        notices.append(Notice(str(twin.GetPath()), None, message))
    return notices


def _is_taken(attribute: Usd.Attribute, source: Usd.Attribute) -> bool:
    """Whether an attribute is unauthored, or its strongest opinion is an opinion of the source attribute."""
    stack, taken = attribute.GetPropertyStack(), source.GetPropertyStack()
    return not stack or stack[0] in taken


def _takes_any(attribute: Usd.Attribute, source: Usd.Attribute) -> bool:
    """Whether an attribute's default or samples come from another attribute."""
    stack, taken = attribute.GetPropertyStack(), source.GetPropertyStack()
    defaults = [spec for spec in stack if spec.HasDefaultValue()]
    sampled = [spec for spec in stack if spec.layer.GetNumTimeSamplesForPath(spec.path)]
    return not stack or any(specs[0] in taken for specs in (defaults, sampled) if specs)


def _attributes(layer: Sdf.Layer, path: Sdf.Path) -> Iterator[Sdf.AttributeSpec]:
    """Attributes of a layer at and below a prim."""
    twins: list[Sdf.Path | str] = []
    layer.Traverse(path, twins.append)
    specs = (layer.GetAttributeAtPath(path) for path in twins if Sdf.Path(path).IsPropertyPath())
    return (spec for spec in specs if spec is not None)


def _keep(stream: LayerStream, stage: Usd.Stage, spec: Sdf.AttributeSpec, path: Sdf.Path) -> None:
    """Author the shot's value of an attribute that an attribute of the layer hides; a block without a value."""
    attribute, uniform = stage.GetAttributeAtPath(path), spec.variability == Sdf.VariabilityUniform
    if attribute and not _takes_any(attribute, stage.GetAttributeAtPath(spec.path)):
        return
    authored = attribute and attribute.HasAuthoredValue()
    interpolation = (attribute.GetMetadata("interpolation") or "") if authored else ""
    stream.attribute(
        path, attribute.GetTypeName() if attribute else spec.typeName, uniform=uniform, interpolation=interpolation
    )
    times = attribute.GetTimeSamples() if authored else []
    for time in (None, *times):
        value = attribute.Get(timecode(time)) if attribute else None  # Unauthored: the schema's.
        if value is not None or not times:
            stream.set(path, Sdf.ValueBlock() if value is None else value, time=time)


def _leave_sibling_out(stream: LayerStream, source: Usd.Prim, twin: Usd.Prim) -> None:
    """Deactivate the refined sibling where a prim above a mesh is composed from the one above the garment."""
    above = source.GetParent().GetPath()
    composed = any(spec.path == above for spec in twin.GetParent().GetPrimStack())
    sibling = source.GetPath().ReplaceName(f"{source.GetName()}_refined")
    if composed and twin.GetParent() != source.GetParent() and stream.layer.GetPrimAtPath(sibling):
        stream.prim(twin.GetParent().GetPath().AppendChild(sibling.name)).SetInfo("active", False)
