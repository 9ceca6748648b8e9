"""Primvars and subsets of a garment, authored for its fine mesh."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt
from scipy import sparse

from ...solver.mesh.subdivide import Refinement, compose
from ...solver.mesh.topology import PolygonMesh, find_edges
from ..lookup import family_of
from ..mesh.attributes import (
    corner_values,
    edge_subset,
    face_subset,
    interpolated,
    kept_corners,
    uniform_values,
    vertex_subset,
    vertex_values,
)
from ..mesh.shell import Shell
from ..stage import Notice, flattened, indices_of, timecode
from .attribute_rules import BLOCKED, action_on
from .stream import LayerStream

INFINITE = UsdGeom.Mesh.SHARPNESS_INFINITE
"""Sharpness from which a crease or a corner is sharp after any number of subdivisions."""
INFLUENCES = ("primvars:skel:jointIndices", "primvars:skel:jointWeights")
"""Primvars that would skin the mesh twice."""


def carry_primvars(
    stream: LayerStream, target: Sdf.Path, prim: Usd.Prim, fine: FineMap, *, span: tuple[float, float] | None
) -> list[Notice]:
    """Author all topology-dependent primvars of a coarse mesh, refined, with their time samples.

    A primvar not matching its own mesh is hidden, because the values would match the fine mesh even less.

    Args:
        span: First and last relevant time code, or None for all.

    Returns:
        Notices of hidden primvars, with the reason.
    """
    notices = []
    for primvar in UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithAuthoredValues():
        attribute = primvar.GetAttr()
        if action_on(attribute) == BLOCKED:
            _hide(stream, target, primvar)
        elif fine.stencil is not None and _numbers_points(primvar):
            _hide(stream, target, primvar)
            message = f"{attribute.GetName()} has another whole number for each point of the coarse mesh"
            notices.append(Notice(str(prim.GetPath()), None, f"{message}; hidden, since points would share them"))
        elif primvar.GetInterpolation() != UsdGeom.Tokens.constant and attribute.GetTypeName().isArray:
            try:
                _carry(stream, target, primvar, fine, span)
            except ValueError as error:
                _hide(stream, target, primvar)
                notices.append(Notice(str(prim.GetPath()), None, f"{attribute.GetName()} {error}; hidden"))
    return notices


def hide_influences(stream: LayerStream, target: Sdf.Path, prim: Usd.Prim) -> None:
    """Block joint influences of a prim whose points are skinned already."""
    for name in INFLUENCES:
        primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(name)
        if primvar and primvar.HasAuthoredValue():
            _hide(stream, target, primvar)


def inherits_influences(prim: Usd.Prim) -> bool:
    """Whether joint influences of an ancestor reach a prim without influences."""
    above = UsdGeom.PrimvarsAPI(prim.GetParent()).FindInheritablePrimvars()
    return any(primvar.GetAttr().GetName() in INFLUENCES for primvar in above)


def _numbers_points(primvar: UsdGeom.Primvar) -> bool:
    """Whether a primvar holds a unique whole number per point, such as ids."""
    if primvar.GetInterpolation() not in (UsdGeom.Tokens.vertex, UsdGeom.Tokens.varying):
        return False
    values = np.asarray(flattened(primvar, Usd.TimeCode.EarliestTime()))
    return values.ndim == 1 and values.dtype.kind in "iu" and 1 < len(values) == len(np.unique(values))


def _hide(stream: LayerStream, target: Sdf.Path, primvar: UsdGeom.Primvar) -> None:
    stream.block(target.AppendProperty(primvar.GetAttr().GetName()), primvar.GetTypeName())
    indices = primvar.GetIndicesAttr()
    if primvar.IsIndexed() and indices.GetTypeName():
        stream.block(target.AppendProperty(indices.GetName()), indices.GetTypeName())


def _carry(
    stream: LayerStream, target: Sdf.Path, primvar: UsdGeom.Primvar, fine: FineMap, span: tuple[float, float] | None
) -> None:
    """Author one primvar at the default and at each time sample."""
    path = target.AppendProperty(primvar.GetAttr().GetName())
    indices_path = target.AppendProperty(f"{path.name}:indices")
    was_indexed, is_indexed = primvar.IsIndexed(), False
    for time in (None, *_times(primvar.GetTimeSamples(), span)):
        code = timecode(time)
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
        stream.block(indices_path, primvar.GetIndicesAttr().GetTypeName())


def _refined(
    primvar: UsdGeom.Primvar, value: object, code: Usd.TimeCode, fine: FineMap
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Fine values and indices at one time, as numpy; either may be None."""
    array, smooth = to_numpy(value)
    size = primvar.GetElementSize()
    if size > 1 and len(array) % size:
        raise ValueError(f"has {len(array)} values, no multiple of its elementSize {size}")
    grouped = array.reshape(-1, size, *array.shape[1:]) if size > 1 else array
    indices = indices_of(primvar, code)
    if primvar.IsIndexed() and indices is None:
        raise ValueError("is indexed by no array of integers")
    if indices is not None and indices.dtype != np.int32:  # USD reads no other indices.
        grouped, indices = grouped[_checked(indices, len(grouped))], None
    values, indices = fine.primvar(primvar.GetInterpolation(), grouped, indices=indices, smooth=smooth)
    return (None if values is None else values.reshape(-1, *array.shape[1:])), indices


def _checked(indices: np.ndarray, count: int) -> np.ndarray:
    """Indices of any integer type; ValueError for an index without a value."""
    outside = indices[(indices < 0) | (indices >= count)]
    if len(outside):
        raise ValueError(f"has the index {outside[0]} into {count} values")
    return indices


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
    """Author the indices of all subsets of a mesh, refined; a partition stays a partition.

    Arguments are as for `carry_primvars`. Returns notices of subsets not refinable and emptied.
    """
    notices = []
    imageable = UsdGeom.Imageable(prim)
    for subset in UsdGeom.Subset.GetAllGeomSubsets(imageable):
        attribute = subset.GetIndicesAttr()
        path = target.AppendChild(subset.GetPrim().GetName()).AppendProperty("indices")
        element = subset.GetElementTypeAttr().Get()
        family = UsdGeom.Subset.GetFamilyType(imageable, family_of(subset))
        stream.attribute(path, Sdf.ValueTypeNames.IntArray)
        try:
            for time in (None, *_times(attribute.GetTimeSamples(), span)):
                value = attribute.Get(timecode(time))
                if value is not None:
                    exclusive = family != UsdGeom.Tokens.unrestricted
                    indices = fine.subset(element, np.asarray(value), exclusive=exclusive)
                    stream.set(path, Vt.IntArray.FromNumpy(indices), time=time)
        except ValueError as error:
            stream.set(path, Vt.IntArray())
            notices.append(Notice(str(subset.GetPrim().GetPath()), None, f"{error}; emptied"))
    return notices


class FineMap:
    """Map from a garment's authored arrays to its fine mesh, made once for each garment.

    Attributes:
        cage: The coarse mesh.
        sheet: The refined coarse mesh.
        fine: The fine mesh: the sheet, or its shell.
        levels: Number of subdivisions between the coarse and the fine mesh.
    """

    def __init__(
        self,
        cage: PolygonMesh,
        refinements: Sequence[Refinement],
        counts: np.ndarray,
        kept: np.ndarray,
        *,
        indices: np.ndarray,
        shell: Shell | None = None,
    ) -> None:
        """Prepare the map.

        Args:
            refinements: Coarse to fine; empty if the fine mesh is the cage.
            counts: Authored corners per face, shape (F,), including dropped faces.
            kept: Numbers of the authored faces in the cage, shape (F_cage,).
            indices: Authored vertices of all corners, shape (C,).
            shell: Shell of the refined sheet that is the fine mesh; None if the sheet is.
        """
        self.cage, self._shell, self.levels = cage, shell, len(refinements)
        self.sheet = refinements[-1].mesh if refinements else cage
        self.fine = self.sheet if shell is None else shell.mesh
        self._refinements = tuple(refinements)
        self._kept = np.asarray(kept, np.int64)
        self._counts, self._indices = counts, indices

    @cached_property
    def stencil(self) -> sparse.csr_matrix | None:
        """Stencil from coarse to fine vertices; None if these are the same."""
        composed = compose(self._refinements) if self._refinements else None
        if self._shell is None:
            return composed
        vertex_matrix = sparse.identity(self.cage.vertex_count, format="csr") if composed is None else composed
        return vertex_matrix[self._shell.vertex]

    def _on_shell(self, element: str, values: np.ndarray) -> np.ndarray:
        """Values on the vertices, faces or corners of the fine mesh, from values on the refined sheet's."""
        return values if self._shell is None else values[getattr(self._shell, element)]

    @cached_property
    def nearest_vertex(self) -> np.ndarray:
        """Coarse vertex of each fine vertex, shape (V_fine,)."""
        fine_values = vertex_values(self._refinements, np.arange(self.cage.vertex_count))
        return self._on_shell("vertex", fine_values)

    @cached_property
    def parent_face(self) -> np.ndarray:
        """Authored face of each fine face, shape (F_fine,)."""
        fine_values = self._kept[uniform_values(self._refinements, np.arange(self.cage.face_count))]
        return self._on_shell("face", fine_values)

    @cached_property
    def kept_corners(self) -> np.ndarray:
        """Authored corner of each corner of the cage, shape (C,)."""
        return kept_corners(self._counts, self._indices, self._kept)

    @cached_property
    def nearest_corner(self) -> np.ndarray:
        """Authored corner of each fine corner, shape (C_fine,)."""
        corners = np.arange(len(self.kept_corners))
        indices, values = corner_values(self._refinements, self.cage.counts, corners, corners)
        fine_values = self.kept_corners[values[indices]]
        return self._on_shell("corner", fine_values)

    def count(self, interpolation: str) -> int:
        """Number of authored elements of an interpolation; ValueError for an interpolation independent of topology."""
        counts = dict.fromkeys(("vertex", "varying"), self.cage.vertex_count)
        counts |= {"uniform": len(self._counts), "faceVarying": int(np.sum(self._counts))}
        if interpolation not in counts:
            raise ValueError(f"has interpolation {interpolation!r}; known: constant, {', '.join(counts)}")
        return counts[interpolation]

    def primvar(
        self, interpolation: str, values: np.ndarray, *, indices: np.ndarray | None = None, smooth: bool = True
    ) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Refine the values of one primvar.

        Args:
            interpolation: ``vertex``, ``varying``, ``uniform`` or ``faceVarying``.
            values: Shape (N, ...).
            indices: Value of each element of an indexed primvar, shape (elements,).
            smooth: Whether values can be interpolated; otherwise the nearest parent's value is used.

        Returns:
            Fine values, or None if the authored values stay; and fine indices, or None without indices.

        Raises:
            ValueError: The number of elements differs from the mesh's, or an index is out of range.
        """
        elements = len(values) if indices is None else len(indices)
        if elements != self.count(interpolation):
            raise ValueError(f"has {elements} elements; {interpolation} needs {self.count(interpolation)}")
        if indices is not None and len(indices) and not 0 <= indices.min() <= indices.max() < len(values):
            raise ValueError(f"has indices from {indices.min()} to {indices.max()} into {len(values)} values")
        if not smooth or interpolation == "uniform":
            return self._picked(interpolation, values, indices)
        if interpolation == "faceVarying":
            return self._corners(values, indices)
        flat = values if indices is None else values[indices]
        return self.interpolate(flat), None

    def interpolate(self, values: np.ndarray) -> np.ndarray:
        """Refine floating-point values on vertices linearly, shape (V, ...) to (V_fine, ...), type kept."""
        return values if self.stencil is None else interpolated(self.stencil, values)

    def vectors(self, value: Any) -> np.ndarray | None:
        """Refine vectors authored on vertices, shape (V_fine, 3), float32; None unless there is a finite one each."""
        if value is None or len(value) != self.cage.vertex_count:
            return None
        fine = self.interpolate(np.asarray(value, np.float32))
        return fine if np.isfinite(fine).all() else None

    def _picked(
        self, interpolation: str, values: np.ndarray, indices: np.ndarray | None
    ) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Copy each fine element's value from a single coarse element; words and paths by index only."""
        picks = {"uniform": "parent_face", "faceVarying": "nearest_corner"}.get(interpolation, "nearest_vertex")
        chosen: np.ndarray = getattr(self, picks)
        if indices is None and values.dtype != object:
            return values[chosen], None
        return None, (chosen if indices is None else indices[chosen]).astype(np.int32)

    def _corners(self, values: np.ndarray, indices: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
        """Refine values on corners along their own topology, preserving seams."""
        coarse = self.kept_corners if indices is None else np.asarray(indices)[self.kept_corners]
        fine, refined = corner_values(self._refinements, self.cage.counts, coarse.astype(np.int32), values)
        fine = self._on_shell("corner", fine)
        return (refined[fine], None) if indices is None else (refined, fine.astype(np.int32))

    def creases(self, ends: np.ndarray, sharpness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Refine crease edges of the coarse mesh, shape (K, 2), with their sharpness, shape (K,).

        A subdivision lowers a finite sharpness by 1. Sharpness 0 is left out.

        Returns:
            Fine edges, shape (N, 2), int32, and the sharpness of each, float32; edges of a rim are infinitely sharp.
        """
        reduced = lowered(sharpness, self.levels)
        sharp = (reduced > 0) & (find_edges(self.cage.half_edges.edges, ends) >= 0)
        fine, reduced = edge_subset(self._refinements, ends[sharp]), np.repeat(reduced[sharp], 2**self.levels)
        if self._shell is None:
            return fine, reduced
        rims = self._shell.rims
        fine = np.concatenate([fine, fine + self.sheet.vertex_count, rims]).astype(np.int32)
        return fine, np.concatenate([reduced, reduced, np.full(len(rims), INFINITE, np.float32)])

    def corners(self, sharpness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sharp fine vertices, shape (N,), int32, and their sharpness, from that of each coarse vertex, shape (V,)."""
        reduced = lowered(sharpness, self.levels)
        sharp = np.flatnonzero(reduced > 0)
        if self._shell is not None:
            both_sides = np.concatenate([sharp, sharp + self.sheet.vertex_count]).astype(np.int32)
            return both_sides, np.tile(reduced[sharp], 2)
        return sharp.astype(np.int32), reduced[sharp]

    def subset(self, element: str, indices: np.ndarray, *, exclusive: bool = False) -> np.ndarray:
        """Fine indices of a subset, ascending, int32.

        Args:
            element: ``face``, ``point`` or ``edge``.
            indices: Authored indices; pairs of vertices for edges.
            exclusive: Whether each vertex must stay in exactly one subset of the family.

        Raises:
            ValueError: The element type is unknown or an index is out of range.
        """
        indices = np.asarray(indices)
        if indices.dtype.kind not in "iu" and indices.size:
            raise ValueError(f"has indices that are no whole numbers but {indices.dtype}")
        indices = indices.astype(np.int64).reshape(-1)
        if element == "edge" and len(indices) % 2:
            raise ValueError(f"has {len(indices)} indices for edges, which need pairs")
        limit = len(self._counts) if element == "face" else self.cage.vertex_count
        if len(indices) and not 0 <= indices.min() <= indices.max() < limit:
            raise ValueError(f"has {element} indices from {indices.min()} to {indices.max()}; the mesh has {limit}")
        if element == "face":
            fine = face_subset(self._refinements, np.flatnonzero(np.isin(self._kept, indices)))
            return fine if self._shell is None else _behind(self._shell.face, fine)
        if element == "point" and exclusive:
            return np.flatnonzero(np.isin(self.nearest_vertex, indices)).astype(np.int32)
        if element == "point":
            fine = vertex_subset(self._refinements, indices)
            return fine if self._shell is None else _behind(self._shell.vertex, fine)
        if element == "edge":
            fine = edge_subset(self._refinements, indices.reshape(-1, 2)).reshape(-1)
            return fine if self._shell is None else np.concatenate([fine, fine + self.sheet.vertex_count])
        raise ValueError(f"has elements of type {element!r}; known: edge, face, point")


def lowered(sharpness: np.ndarray, levels: int) -> np.ndarray:
    """Sharpness after some subdivisions, at least 0, float32; an infinite one stays."""
    sharpness = np.asarray(sharpness, np.float32)
    return np.where(sharpness >= INFINITE, sharpness, np.maximum(sharpness - levels, 0.0)).astype(np.float32)


def _behind(parents: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Numbers of the elements whose parent is chosen, int32."""
    return np.flatnonzero(np.isin(parents, chosen)).astype(np.int32)


def to_numpy(value: Any) -> tuple[np.ndarray, bool]:
    """A ``Vt`` array as numpy, shape (N, ...), and whether the values can be interpolated.

    Quaternions are not interpolated: q and -q are the same rotation. Strings, tokens and asset paths become objects.

    Raises:
        ValueError: The value is no array.
    """
    if not hasattr(type(value), "__len__") or not type(value).__name__.endswith("Array"):
        raise ValueError(f"is a {type(value).__name__}, no array")
    if hasattr(type(value), "FromNumpy"):
        array = np.asarray(value)
        return array, array.dtype.kind == "f" and "Quat" not in type(value).__name__
    array = np.empty(len(value), object)
    array[:] = list(value)
    return array, False


def to_vt(array: np.ndarray, like: Any) -> Any:
    """An array, shape (N, ...), converted to the ``Vt`` type of ``like``."""
    kind = type(like)
    if array.dtype == object:
        return kind(array.tolist())
    return kind.FromNumpy(np.ascontiguousarray(array))
