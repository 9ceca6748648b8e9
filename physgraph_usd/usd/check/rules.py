"""The rules that a refined garment must keep, one function each; `validate` runs them.

Every function yields what it finds wrong. USD's own validators check none of this.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdSkel

from ...solver.mesh.topology import PolygonMesh
from ..read.limits import beyond_limits
from ..write.heat import HEAT, PREFIX
from ..write.normals import VertexNormals
from ..write.overs import EMPTIED
from ..write.primvars import STALE

TOGETHER = ("points", "faceVertexCounts", "faceVertexIndices", "extent", "normals", "subdivisionScheme")


@dataclass(frozen=True)
class Problem:
    """Something wrong with a layer.

    Attributes:
        severity: ``error``: readers will fail or show something wrong; ``warning``: look at it.
        path: Prim or property path; "/" for the layer.
        time: Time code, or None for the default or at all times.
        message: What is wrong, with the values found.
        rule: Name of the rule that found it.
    """

    severity: str
    path: str
    time: float | None
    message: str
    rule: str

    def __str__(self) -> str:
        """Place, time and message in one line."""
        when = "" if self.time is None else f" at time code {self.time:g}"
        return f"{self.severity}: <{self.path}>{when}: {self.message} [{self.rule}]"


@dataclass(frozen=True, eq=False)
class Fine:
    """One refined garment as composed.

    Attributes:
        prim: The fine mesh.
        layer: The refined layer.
        times: Times to look at, the default (None) first.
    """

    prim: Usd.Prim
    layer: Sdf.Layer
    times: tuple[float | None, ...]

    def value(self, name: str, time: float | None) -> object | None:
        """An attribute's composed value."""
        return self.prim.GetAttribute(name).Get(code_of(time))

    def array(self, name: str, time: float | None) -> np.ndarray | None:
        """An attribute's composed value as numpy, or None."""
        value = self.value(name, time)
        return None if value is None else np.asarray(value)

    def written(self, name: str) -> list[float]:
        """Times at which the layer itself has samples of an attribute."""
        return list(self.layer.ListTimeSamplesForPath(self.prim.GetPath().AppendProperty(name)))

    @cached_property
    def sizes(self) -> dict[str, int]:
        """Number of elements by interpolation, at the default time."""
        points, counts, indices = (self.entries(name, None) for name in TOGETHER[:3])
        vertices = len(points)
        return {
            "vertex": vertices,
            "varying": vertices,
            "uniform": len(counts),
            "faceVarying": len(indices),
            "constant": 1,
        }

    def entries(self, name: str, time: float | None) -> np.ndarray:
        """An attribute's composed array as numpy; empty where there is none."""
        array = self.array(name, time)
        return np.zeros(0, np.int32) if array is None else array

    def topology_fault(self, time: float | None) -> str:
        """What is wrong with counts, indices and points at one time, or ""."""
        points, counts, indices = (self.value(name, time) for name in TOGETHER[:3])
        if points is None or counts is None or indices is None:
            return "there are no points or no faces"
        good, reason = UsdGeom.Mesh.ValidateTopology(indices, counts, len(points))  # type: ignore[arg-type]
        return "" if good else str(reason)

    def problem(self, name: str, message: str, time: float | None = None, *, severity: str = "error") -> Problem:
        """Name a problem with one of the prim's properties; ``rule`` is filled in by `validate`."""
        path = self.prim.GetPath().AppendProperty(name) if name else self.prim.GetPath()
        return Problem(severity, str(path), time, message, "")


def code_of(time: float | None) -> Usd.TimeCode:
    """USD's time code for ours."""
    return Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)


def opinions_together(fine: Fine) -> Iterator[Problem]:
    """All that depends on topology is in this layer."""
    for name in TOGETHER:
        spec = fine.layer.GetAttributeAtPath(fine.prim.GetPath().AppendProperty(name))
        if spec is None or not (spec.HasDefaultValue() or fine.written(name)):
            yield fine.problem(name, "is not authored in the refined layer, though it depends on topology")
    for name in ("faceVertexCounts", "faceVertexIndices"):
        if fine.prim.GetAttribute(name).GetNumTimeSamples():
            yield fine.problem(name, "has time samples; topology must not change in time")


def topology(fine: Fine) -> Iterator[Problem]:
    """Counts, indices and points fit one another at every time."""
    for time in fine.times:
        fault = fine.topology_fault(time)
        if fault:
            yield fine.problem("faceVertexIndices", f"topology is invalid: {fault}", time)
        if fine.entries("faceVertexCounts", time).min(initial=3) < 3:
            yield fine.problem("faceVertexCounts", "has a face with fewer than three corners", time)


def points(fine: Fine) -> Iterator[Problem]:
    """Points are finite, of one count, and float32."""
    expected = fine.sizes["vertex"]
    if fine.prim.GetAttribute("points").GetTypeName() != Sdf.ValueTypeNames.Point3fArray:
        yield fine.problem("points", f"has type {fine.prim.GetAttribute('points').GetTypeName()}, not point3f[]")
    for time in fine.times:
        array = fine.array("points", time)
        if array is None:
            continue
        if len(array) != expected:
            yield fine.problem("points", f"has {len(array)} points; the default has {expected}", time)
        bad = np.flatnonzero(~np.isfinite(array).all(axis=-1)) if len(array) else array
        if len(bad):
            yield fine.problem("points", f"point {bad[0]} is not finite: {array[bad[0]].tolist()}", time)


def normals(fine: Fine) -> Iterator[Problem]:
    """Normals are per vertex, unit, on the outer side, and sampled with the points."""
    if fine.prim.GetAttribute("normals").GetMetadata("interpolation") != UsdGeom.Tokens.vertex:
        yield fine.problem("normals", "has interpolation other than vertex")
    if fine.written("normals") != fine.written("points"):
        yield fine.problem("normals", "is not sampled at the times of points")
    expected = fine.sizes["vertex"]
    for time in fine.times:
        array = fine.array("normals", time)
        if array is None or len(array) != expected:
            yield fine.problem("normals", f"has {0 if array is None else len(array)} normals for {expected}", time)
            continue
        lengths = np.linalg.norm(array.astype(np.float64), axis=1)
        wrong = np.flatnonzero(~(np.abs(lengths - 1.0) < 1e-3))
        if len(wrong):
            yield fine.problem("normals", f"normal {wrong[0]} has length {lengths[wrong[0]]:g}, not 1", time)
        elif time == fine.times[-1]:
            yield from _normals_outward(fine, array, time)


def _normals_outward(fine: Fine, array: np.ndarray, time: float | None) -> Iterator[Problem]:
    """Normals agree with winding and orientation."""
    positions, counts, indices = (fine.entries(name, time) for name in TOGETHER[:3])
    if len(positions) != len(array) or fine.topology_fault(time):
        return
    left = fine.value("orientation", None) == UsdGeom.Tokens.leftHanded
    expected = VertexNormals(PolygonMesh(counts, indices, len(positions)), left_handed=left)(positions)
    agreement = np.einsum("ij,ij->i", expected, array)
    if len(agreement) and np.median(agreement) < 0.5:
        yield fine.problem("normals", "point away from the side that winding and orientation call outside", time)


def extent(fine: Fine) -> Iterator[Problem]:
    """The extent holds the points at every time, and is no larger than it must be."""
    if fine.written("extent") != fine.written("points"):
        yield fine.problem("extent", "is not sampled at the times of points")
    for time in fine.times:
        array, positions = fine.array("extent", time), fine.array("points", time)
        if array is None or len(array) != 2 or positions is None or not len(positions):
            yield fine.problem("extent", "has no lower and upper corner", time)
            continue
        exact = np.stack([positions.min(axis=0), positions.max(axis=0)]).astype(np.float64)
        slack = 1e-5 * max(float(np.abs(exact).max()), 1e-30)
        if not np.all(np.abs(exact - array) <= slack):
            yield fine.problem("extent", f"is {array.tolist()}; the points span {exact.tolist()}", time)


def primvars(fine: Fine) -> Iterator[Problem]:
    """Every primvar has as many elements as its interpolation needs."""
    sizes = fine.sizes
    for primvar in UsdGeom.PrimvarsAPI(fine.prim).GetPrimvarsWithAuthoredValues():
        name, interpolation = primvar.GetAttr().GetName(), primvar.GetInterpolation()
        if name in STALE:
            continue
        if not primvar.GetTypeName().isArray or interpolation not in sizes:
            continue
        own = [time for time in fine.times if time is None or time in primvar.GetTimeSamples()]
        for time in own:
            message = _primvar_fault(primvar, time, sizes[interpolation])
            if message:
                # A constant array may have any length by elementSize, but not by the coarse mesh's elements.
                yield fine.problem(name, message, time, severity="warning" if interpolation == "constant" else "error")


def heat_maps(fine: Fine) -> Iterator[Problem]:
    """Heat maps are finite floats per vertex, depths not negative and crossings 0 to 1; `primvars` counts them."""
    for name in HEAT:
        spec = fine.layer.GetAttributeAtPath(fine.prim.GetPath().AppendProperty(PREFIX + name))
        if spec is None:
            continue
        if (spec.typeName, spec.GetInfo("interpolation")) != (Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex):
            yield fine.problem(PREFIX + name, "is not a float[] with interpolation vertex")
        for time in fine.times:
            values = fine.entries(PREFIX + name, time)
            low, high = (float(pick(values, initial=0.0)) for pick in (np.min, np.max))
            if not (low >= 0.0 and high <= (1.0 if name == "crossing" else np.finfo(np.float32).max)):
                yield fine.problem(PREFIX + name, f"has values from {low:g} to {high:g}", time)


def _primvar_fault(primvar: UsdGeom.Primvar, time: float | None, expected: int) -> str:
    """What is wrong with a primvar at one time, or ""."""
    value = primvar.Get(code_of(time))
    if value is None:
        return ""
    groups = len(np.atleast_1d(np.asarray(value))) / max(primvar.GetElementSize(), 1)
    if not primvar.IsIndexed():
        return "" if groups == expected else f"has {groups:g} elements; its interpolation needs {expected}"
    indices = np.asarray(primvar.GetIndices(code_of(time)))
    if len(indices) != expected:
        return f"has {len(indices)} indices; its interpolation needs {expected}"
    if len(indices) and not 0 <= indices.min() <= indices.max() < groups:
        return f"has indices from {indices.min()} to {indices.max()} into {groups:g} values"
    return ""


def subsets(fine: Fine) -> Iterator[Problem]:
    """Subset indices are in range and distinct, and a partition is one."""
    sizes = {"face": fine.sizes["uniform"], "point": fine.sizes["vertex"]}
    imageable = UsdGeom.Imageable(fine.prim)
    families: dict[tuple[str, str], list[np.ndarray]] = {}
    for subset in UsdGeom.Subset.GetAllGeomSubsets(imageable):
        element = subset.GetElementTypeAttr().Get()
        path, value = str(subset.GetIndicesAttr().GetPath()), subset.GetIndicesAttr().Get()
        array = np.asarray(value if value is not None else [])
        if element not in sizes:
            continue
        if array.size and array.dtype.kind not in "iu":
            yield Problem("error", path, None, f"is a {type(value).__name__}, not an array of integers", "")
            continue
        indices = array.astype(np.int64).reshape(-1)
        if len(indices) and not 0 <= indices.min() <= indices.max() < sizes[element]:
            yield Problem("error", path, None, f"names {element} {indices.max()} of {sizes[element]}", "")
        elif len(np.unique(indices)) != len(indices):
            yield Problem("error", path, None, f"names a {element} twice", "")
        families.setdefault((element, subset.GetFamilyNameAttr().Get() or ""), []).append(indices)
    for (element, family), parts in families.items():
        kind = UsdGeom.Subset.GetFamilyType(imageable, family)
        named = np.concatenate(parts)
        if kind != UsdGeom.Tokens.unrestricted and len(np.unique(named)) != len(named):
            yield fine.problem("", f"subset family {family!r} is {kind}, but subsets overlap")
        if kind == UsdGeom.Tokens.partition and len(np.unique(named)) != sizes[element]:
            said = f"subset family {family!r} is a partition, but names {len(named)} of {sizes[element]} {element}s"
            yield fine.problem("", said)


def leftovers(fine: Fine) -> Iterator[Problem]:
    """Nothing that belonged to the coarse topology shows through."""
    if fine.value("subdivisionScheme", None) != "none":
        yield fine.problem("subdivisionScheme", f"is {fine.value('subdivisionScheme', None)!r}, not 'none'")
    for name in EMPTIED:
        for time in (None, *fine.prim.GetAttribute(name).GetTimeSamples()):
            if len(fine.entries(name, time)):
                yield fine.problem(name, "still holds the coarse mesh's entries", time)
    if fine.prim.GetAttribute("accelerations").HasAuthoredValue():
        yield fine.problem("accelerations", "still holds the coarse mesh's values")
    if fine.prim.GetAttribute("primvars:normals").HasAuthoredValue():
        yield fine.problem("primvars:normals", "hides the normals written here")
    orientation = fine.layer.GetAttributeAtPath(fine.prim.GetPath().AppendProperty("orientation"))
    if orientation is not None:
        yield fine.problem("orientation", "is authored in the refined layer; winding and orientation are kept")


def velocities(fine: Fine) -> Iterator[Problem]:
    """Velocities, where there are any, are this layer's and fit the points."""
    if not fine.prim.GetAttribute("velocities").HasAuthoredValue():
        return
    if fine.written("velocities") != fine.written("points"):
        yield fine.problem("velocities", "is not sampled at the times of points in the refined layer")
    for time in fine.times:
        array = fine.array("velocities", time)
        if array is not None and len(array) != fine.sizes["vertex"]:
            yield fine.problem("velocities", f"has {len(array)} entries for {fine.sizes['vertex']} points", time)


def skinning(fine: Fine) -> Iterator[Problem]:
    """The mesh is not skinned a second time."""
    skeleton = fine.prim.GetRelationship("skel:skeleton")
    cut_off = skeleton and skeleton.HasAuthoredTargets() and not skeleton.GetTargets()
    if UsdSkel.BindingAPI(fine.prim) and not cut_off:
        yield fine.problem("", "SkelBindingAPI is still applied; the mesh would be skinned twice")
    for name in STALE[1:]:
        if len(fine.entries(name, None)):
            yield fine.problem(name, "still holds influences; the mesh would be skinned twice")


def limits(fine: Fine) -> Iterator[Problem]:
    """The garment's values are inside their limits; told only, for the cloth is solved already."""
    for attribute, said, _ in beyond_limits(fine.prim):
        yield Problem("warning", str(attribute.GetPath()), None, said, "")


RULES: tuple[Callable[[Fine], Iterator[Problem]], ...] = (
    opinions_together,
    topology,
    points,
    normals,
    extent,
    primvars,
    heat_maps,
    subsets,
    leftovers,
    velocities,
    skinning,
    limits,
)
