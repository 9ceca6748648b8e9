"""Primvars and subsets of a garment, authored for its fine mesh."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt

from ..stage import Notice
from .carry import FineMap, to_numpy, to_vt
from .stream import LayerStream

STALE = ("primvars:normals", "primvars:skel:jointIndices", "primvars:skel:jointWeights")
"""Primvars that are hidden, not refined: our normals replace the first, the others would skin a second time."""


def carry_primvars(
    stream: LayerStream, target: Sdf.Path, prim: Usd.Prim, fine: FineMap, *, span: tuple[float, float] | None
) -> list[Notice]:
    """Author every primvar of a mesh that depends on topology, refined.

    Those with time samples keep them. One that does not fit its own mesh is hidden, since its values would fit the
    fine mesh even less.

    Args:
        stream: The layer.
        target: Prim to author on.
        prim: Coarse mesh as composed.
        fine: Map to the fine mesh.
        span: First and last time code that matter, or None for all.

    Returns:
        What was hidden, and why.
    """
    notices = []
    for primvar in UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithAuthoredValues():
        attribute = primvar.GetAttr()
        if attribute.GetName() in STALE:
            _hide(stream, target, primvar)
        elif primvar.GetInterpolation() != UsdGeom.Tokens.constant and attribute.GetTypeName().isArray:
            try:
                _carry(stream, target, primvar, fine, span)
            except ValueError as error:
                _hide(stream, target, primvar)
                notices.append(Notice(str(prim.GetPath()), None, f"{attribute.GetName()} {error}; hidden"))
    return notices


def _hide(stream: LayerStream, target: Sdf.Path, primvar: UsdGeom.Primvar) -> None:
    """Block a primvar's values and indices."""
    stream.block(target.AppendProperty(primvar.GetAttr().GetName()), primvar.GetTypeName())
    indices = primvar.GetIndicesAttr()
    if primvar.IsIndexed() and indices.GetTypeName():
        stream.block(target.AppendProperty(indices.GetName()), indices.GetTypeName())


def _carry(
    stream: LayerStream,
    target: Sdf.Path,
    primvar: UsdGeom.Primvar,
    fine: FineMap,
    span: tuple[float, float] | None,
) -> None:
    """Author one primvar at its default and each of its times."""
    path = target.AppendProperty(primvar.GetAttr().GetName())
    indices_path = target.AppendProperty(f"{path.name}:indices")
    was_indexed, is_indexed = primvar.IsIndexed(), False
    for time in (None, *_times(primvar.GetTimeSamples(), span)):
        code = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
        value = primvar.Get(code)
        if value is None:
            continue
        values, indices = _refined(primvar, value, code, fine)
        if values is not None:
            stream.attribute(path, primvar.GetTypeName(), interpolation=primvar.GetInterpolation())
            stream.set(path, to_vt(values, value), time=time)
        if indices is not None:
            is_indexed = True
            stream.attribute(indices_path, Sdf.ValueTypeNames.IntArray)
            stream.set(indices_path, Vt.IntArray.FromNumpy(indices), time=time)
    if was_indexed and not is_indexed:
        stream.block(indices_path, Sdf.ValueTypeNames.IntArray)


def _refined(
    primvar: UsdGeom.Primvar, value: object, code: Usd.TimeCode, fine: FineMap
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Fine values and indices at one time, as numpy; either may be None."""
    array, smooth = to_numpy(value)
    size = primvar.GetElementSize()
    grouped = array
    if size > 1:
        if len(array) % size:
            raise ValueError(f"has {len(array)} values, no multiple of its elementSize {size}")
        grouped = array.reshape(-1, size, *array.shape[1:])
    indices = np.asarray(primvar.GetIndices(code), np.int32) if primvar.IsIndexed() else None
    values, indices = fine.primvar(primvar.GetInterpolation(), grouped, indices=indices, smooth=smooth)
    return (None if values is None else values.reshape(-1, *array.shape[1:])), indices


def _times(times: Sequence[float], span: tuple[float, float] | None) -> Iterable[float]:
    """The times inside a span and the nearest on either side."""
    if span is None or not len(times):
        return times
    array = np.asarray(times)
    first = max(int(np.searchsorted(array, span[0], side="right")) - 1, 0)
    last = min(int(np.searchsorted(array, span[1], side="left")), len(array) - 1)
    return array[first : last + 1].tolist()


def carry_subsets(
    stream: LayerStream, target: Sdf.Path, prim: Usd.Prim, fine: FineMap, *, span: tuple[float, float] | None
) -> list[Notice]:
    """Author the indices of every subset of a mesh, refined; a partition stays a partition.

    Args:
        stream: The layer.
        target: Mesh prim to author below.
        prim: Coarse mesh as composed.
        fine: Map to the fine mesh.
        span: First and last time code that matter, or None for all.

    Returns:
        Subsets that could not be refined, and why; they are emptied.
    """
    notices = []
    imageable = UsdGeom.Imageable(prim)
    for subset in UsdGeom.Subset.GetAllGeomSubsets(imageable):
        attribute = subset.GetIndicesAttr()
        path = target.AppendChild(subset.GetPrim().GetName()).AppendProperty("indices")
        element = subset.GetElementTypeAttr().Get()
        family = UsdGeom.Subset.GetFamilyType(imageable, subset.GetFamilyNameAttr().Get() or "")
        stream.attribute(path, Sdf.ValueTypeNames.IntArray)
        try:
            for time in (None, *_times(attribute.GetTimeSamples(), span)):
                value = attribute.Get(Usd.TimeCode.Default() if time is None else Usd.TimeCode(time))
                if value is not None:
                    exclusive = family != UsdGeom.Tokens.unrestricted
                    indices = fine.subset(element, np.asarray(value), exclusive=exclusive)
                    stream.set(path, Vt.IntArray.FromNumpy(indices), time=time)
        except ValueError as error:
            stream.set(path, Vt.IntArray())
            notices.append(Notice(str(subset.GetPrim().GetPath()), None, f"{error}; emptied"))
    return notices
