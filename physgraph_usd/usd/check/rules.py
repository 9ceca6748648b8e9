"""The rules for a refined layer and its garments, one function each; `validate` runs the rules.

Every function yields problems. USD's own validators check none of these rules.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from ...solver.mesh.topology import PolygonMesh
from ..lookup import family_of
from ..provenance import METADATA, RANGE, mute_refined, read_record
from ..read.absence import absence
from ..read.authored import beyond_limits
from ..read.skinning import skel_root
from ..stage import TRAVERSAL, at_time, authored_topology, indices_of, paths_in, root_metadata, timecode
from ..times import FrameGrid, is_among, motion_of
from ..view import StageView
from ..write.attribute_rules import BLOCKED, EMPTIED, action_on, render_values, with_action
from ..write.normals import VertexNormals
from ..write.primvars import INFLUENCES, inherits_influences
from ..write.track import HEAT, PREFIX, extent_of

TOGETHER = ("points", "faceVertexCounts", "faceVertexIndices", "extent", "subdivisionScheme")

SHARPNESS = ("creaseIndices", "creaseLengths", "creaseSharpnesses", "cornerIndices", "cornerSharpnesses")


@dataclass(frozen=True)
class Problem:
    """A fault in a layer.

    Attributes:
        severity: ``error``: readers will fail or show wrong results; ``warning``: worth a look.
        path: Prim or property path; "/" for the layer.
        time: Time code, or None for the default or at all times.
        message: The fault, with the values found.
        rule: Name of the rule, filled in by `validate`.
    """

    severity: str
    path: str
    time: float | None
    message: str
    rule: str = ""

    def __str__(self) -> str:
        """Place, time and message in one line."""
        return f"{self.severity}: <{self.path}>{at_time(self.time)}: {self.message} [{self.rule}]"


@dataclass(frozen=True, eq=False)
class Fine:
    """One refined garment as composed.

    Attributes:
        prim: The fine mesh.
        layer: The refined layer.
        times: Times to check, the default (None) first.
    """

    prim: Usd.Prim
    layer: Sdf.Layer
    times: tuple[float | None, ...]

    def value(self, name: str, time: float | None) -> object | None:
        """An attribute's composed value."""
        return self.prim.GetAttribute(name).Get(timecode(time))

    def array(self, name: str, time: float | None) -> np.ndarray | None:
        """An attribute's composed value as numpy, or None."""
        value = self.value(name, time)
        return None if value is None else np.asarray(value)

    @cached_property
    def polygonal(self) -> bool:
        """Whether the mesh is a polygon mesh (`subdivisionScheme` none), not a subdivision surface."""
        return self.value("subdivisionScheme", None) == UsdGeom.Tokens.none

    def written(self, name: str) -> list[float]:
        """Sample times of an attribute in the refined layer itself."""
        return list(self.layer.ListTimeSamplesForPath(self.prim.GetPath().AppendProperty(name)))

    @cached_property
    def sizes(self) -> dict[str, int]:
        """Number of elements by interpolation, at the default time."""
        points, faces, corners = (len(self.entries(name, None)) for name in TOGETHER[:3])
        return {"vertex": points, "varying": points, "uniform": faces, "faceVarying": corners, "constant": 1}

    def entries(self, name: str, time: float | None) -> np.ndarray:
        """An attribute's composed array as numpy; empty if missing."""
        array = self.array(name, time)
        return np.zeros(0, np.int32) if array is None else array

    def topology_fault(self, time: float | None) -> str:
        """The fault in counts, indices and points at one time, or ""."""
        points, counts, indices = (self.value(name, time) for name in TOGETHER[:3])
        if points is None or counts is None or indices is None:
            return "there are no points or no faces"
        good, reason = UsdGeom.Mesh.ValidateTopology(indices, counts, len(points))  # type: ignore[arg-type]
        return "" if good else str(reason)

    def problem(self, name: str, message: str, time: float | None = None, *, severity: str = "error") -> Problem:
        """A problem with the prim or a property of the prim."""
        path = self.prim.GetPath().AppendProperty(name) if name else self.prim.GetPath()
        return Problem(severity, str(path), time, message)


def opinions_together(fine: Fine) -> Iterator[Problem]:
    """Everything that depends on topology is in this layer."""
    for name in (*TOGETHER, "normals") if fine.polygonal else TOGETHER:
        spec = fine.layer.GetAttributeAtPath(fine.prim.GetPath().AppendProperty(name))
        if spec is None or not (spec.HasDefaultValue() or fine.written(name)):
            yield fine.problem(name, "is not authored in the refined layer, though it depends on topology")
    for name in ("faceVertexCounts", "faceVertexIndices"):
        if fine.prim.GetAttribute(name).GetNumTimeSamples():
            yield fine.problem(name, "has time samples; topology must not change in time")


def topology(fine: Fine) -> Iterator[Problem]:
    """Counts, indices and points match at every time."""
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


def instances(fine: Fine) -> Iterator[Problem]:
    """Positions and unit orientations are finite, and as many as there are instances."""
    expected = fine.entries("protoIndices", fine.times[-1]).size
    for time in fine.times:
        for name in ("positions", "orientations", "orientationsf"):
            array = fine.array(name, time)
            if array is None or array.ndim != 2:
                continue
            if len(array) != expected:
                yield fine.problem(name, f"has {len(array)} entries for {expected} instances", time)
            bad = np.flatnonzero(~np.isfinite(array.astype(np.float64)).all(axis=-1))
            if len(bad):
                yield fine.problem(name, f"entry {bad[0]} is not finite: {array[bad[0]].tolist()}", time)


def normals(fine: Fine) -> Iterator[Problem]:
    """Normals of polygons are per vertex, unit, on the outer side, and sampled with the points; others have none."""
    if not fine.polygonal:
        if fine.prim.GetAttribute("normals").HasAuthoredValue():
            yield fine.problem("normals", "is authored on a subdivision surface, which makes its own")
        return
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
    is_left_handed = fine.value("orientation", None) == UsdGeom.Tokens.leftHanded
    expected = VertexNormals(PolygonMesh(counts, indices, len(positions)), left_handed=is_left_handed)(positions)
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
        exact = extent_of(positions).astype(np.float64)
        slack = 1e-5 * max(float(np.abs(exact).max()), 1e-30)
        if not np.all(np.abs(exact - array) <= slack):
            yield fine.problem("extent", f"is {array.tolist()}; the points span {exact.tolist()}", time)


def primvars(fine: Fine) -> Iterator[Problem]:
    """Every primvar has as many elements as its interpolation needs."""
    sizes = fine.sizes
    for primvar in UsdGeom.PrimvarsAPI(fine.prim).GetPrimvarsWithAuthoredValues():
        name, interpolation = primvar.GetAttr().GetName(), primvar.GetInterpolation()
        if action_on(primvar.GetAttr()) == BLOCKED or not primvar.GetTypeName().isArray or interpolation not in sizes:
            continue
        for time in (code for code in fine.times if code is None or code in primvar.GetTimeSamples()):
            if fault := _primvar_fault(primvar, time, sizes[interpolation]):
                # A constant array may have any length by elementSize, but not by the coarse mesh's elements.
                yield fine.problem(name, fault, time, severity="warning" if interpolation == "constant" else "error")


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
    value = primvar.Get(timecode(time))
    if value is None:
        return ""
    groups = len(np.atleast_1d(np.asarray(value))) / max(primvar.GetElementSize(), 1)
    if not primvar.IsIndexed():
        return "" if groups == expected else f"has {groups:g} elements; its interpolation needs {expected}"
    indices = indices_of(primvar, timecode(time))
    if indices is None:
        return "is indexed by no array of integers"
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
            yield Problem("error", path, None, f"is a {type(value).__name__}, not an array of integers")
            continue
        indices = array.astype(np.int64).reshape(-1)
        if len(indices) and not 0 <= indices.min() <= indices.max() < sizes[element]:
            yield Problem("error", path, None, f"names {element} {indices.max()} of {sizes[element]}")
        elif len(np.unique(indices)) != len(indices):
            yield Problem("error", path, None, f"names a {element} twice")
        families.setdefault((element, family_of(subset)), []).append(indices)
    for (element, family), parts in families.items():
        kind = UsdGeom.Subset.GetFamilyType(imageable, family)
        named = np.concatenate(parts)
        if kind != UsdGeom.Tokens.unrestricted and len(np.unique(named)) != len(named):
            yield fine.problem("", f"subset family {family!r} is {kind}, but subsets overlap")
        if kind == UsdGeom.Tokens.partition and len(np.unique(named)) != sizes[element]:
            message = f"subset family {family!r} is a partition, but names {len(named)} of {sizes[element]} {element}s"
            yield fine.problem("", message)


def leftovers(fine: Fine) -> Iterator[Problem]:
    """Nothing that belonged to the coarse topology shows through."""
    for attribute in with_action(fine.prim, EMPTIED):
        for time in (None, *attribute.GetTimeSamples()):
            if len(fine.entries(attribute.GetName(), time)):
                yield fine.problem(attribute.GetName(), "still holds the coarse mesh's entries", time)
    for attribute, value in render_values(fine.prim, None if fine.polygonal else 0):
        authored = attribute.Get()
        if fine.polygonal and authored != value:
            yield fine.problem(attribute.GetName(), f"is {authored!r}, not {value!r}: a render subdivides again")
        if not fine.polygonal and not fine.layer.GetAttributeAtPath(
            fine.prim.GetPath().AppendProperty(attribute.GetName())
        ):
            yield fine.problem(
                attribute.GetName(), "is not lowered by the layer: a render subdivides as often as the cage"
            )
    if fine.prim.GetAttribute("accelerations").HasAuthoredValue():
        yield fine.problem("accelerations", "still holds the coarse mesh's values")
    if fine.prim.GetAttribute("primvars:normals").HasAuthoredValue():
        yield fine.problem("primvars:normals", "hides the normals written here")
    orientation = fine.layer.GetAttributeAtPath(fine.prim.GetPath().AppendProperty("orientation"))
    if orientation is not None:
        yield fine.problem("orientation", "is authored in the refined layer; winding and orientation are kept")


def subdivision(fine: Fine) -> Iterator[Problem]:
    """The scheme suits the faces, and creases and corners are those of the fine mesh."""
    scheme = fine.value("subdivisionScheme", None)
    if scheme == UsdGeom.Tokens.loop and (fine.entries("faceVertexCounts", None) != 3).any():
        yield fine.problem("subdivisionScheme", "is 'loop', which is for triangles only")
    edges, lengths, sharp, corners, sharp_corners = (len(fine.entries(name, None)) for name in SHARPNESS)
    if fine.polygonal and edges + lengths + sharp + corners + sharp_corners:
        yield fine.problem(SHARPNESS[0], "creases or corners sharpen a mesh that is drawn by its polygons")
    if fine.entries("creaseLengths", None).sum() != edges or sharp != lengths:
        yield fine.problem("creaseIndices", f"has {edges} entries; the {lengths} lengths and {sharp} values do not fit")
    if corners != sharp_corners:
        yield fine.problem("cornerIndices", f"has {corners} entries and {sharp_corners} sharpnesses")
    for name in (SHARPNESS[0], SHARPNESS[3]):
        indices = fine.entries(name, None)
        spec = fine.layer.GetAttributeAtPath(fine.prim.GetPath().AppendProperty(name))
        if len(indices) and not 0 <= indices.min() <= indices.max() < fine.sizes["vertex"]:
            yield fine.problem(name, f"names point {indices.max()} of {fine.sizes['vertex']}")
        if len(indices) and spec is None:
            yield fine.problem(name, "still holds the coarse mesh's entries")


def velocities(fine: Fine) -> Iterator[Problem]:
    """Authored velocities come from this layer and fit the points."""
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
    if inherits_influences(fine.prim) and not cut_off:
        yield fine.problem("", "inherits joint influences; the mesh would be skinned twice")
    for name in (*INFLUENCES, "skel:blendShapes"):
        if len(fine.entries(name, None)):
            yield fine.problem(name, "still holds influences; the mesh would be skinned twice")


def limits(fine: Fine) -> Iterator[Problem]:
    """The garment's values are inside their limits; a warning only, for the cloth is solved already."""
    for attribute, message, _ in beyond_limits(fine.prim):
        yield Problem("warning", str(attribute.GetPath()), None, message, "")


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
    subdivision,
    velocities,
    skinning,
    limits,
)


BOUND_RULES = (points, skinning)
"""Rules for curves and points that follow a garment."""
BOUND_INSTANCER_RULES = (instances,)
"""Rules for point instancers whose instances follow a garment."""
BOUND_MESH_RULES = (topology, *BOUND_RULES, extent)
"""Rules for meshes that follow a garment; samples must fit the shot's topology."""


def _error(message: str, path: str = "/", time: float | None = None) -> Problem:
    return Problem("error", path, time, message)


def record(layer: Sdf.Layer) -> Iterator[Problem]:
    """The record names garments and shot."""
    record = read_record(layer)
    if record is None:
        yield _error('has no customLayerData["physgraph"]; is it a refined layer?')
    elif not record.get("garments") or not (record.get("shot") or record.get("unsaved")):
        yield _error("its record names no garments or no shot")


def time_scale(layer: Sdf.Layer) -> Iterator[Problem]:
    """Time codes per second are authored: a layer without them counts as 24 and its samples are rescaled."""
    if not layer.HasTimeCodesPerSecond():
        yield _error("timeCodesPerSecond is not authored; USD would take 24 and rescale the samples")


def whole_range(layer: Sdf.Layer) -> Iterator[Problem]:
    """All samples of the shot were refined: outside those that were, the cloth stands still."""
    for path, message in (read_record(layer) or {}).get("left_out", {}).items():
        yield Problem("warning", path, None, f"was refined without {message}, where it stands still (--frames)")


def times_with_values(layer: Sdf.Layer, name: str) -> list[float]:
    """Time codes at which a layer has an unblocked value of an attribute."""
    every = layer.ListTimeSamplesForPath(name)
    return [time for time in every if not isinstance(layer.QueryTimeSample(name, time), Sdf.ValueBlock)]


def self_contained(layer: Sdf.Layer) -> Iterator[Problem]:
    """The layer brings no other layer and authors in no variant."""
    if len(layer.subLayerPaths):
        yield _error(f"has sublayers {layer.subLayerPaths}; a refined layer stands over the shot, not on it")
    for path in paths_in(layer):
        if path.IsPrimVariantSelectionPath():
            yield _error("authors inside a variant of an asset", str(path))


LAYER_RULES: tuple[Callable[[Sdf.Layer], Iterator[Problem]], ...] = (record, time_scale, whole_range, self_contained)
"""Rules for a refined layer by itself."""


def same_metadata(layer: Sdf.Layer, shot: Usd.Stage) -> Iterator[Problem]:
    """Units, axes and rate are the shot's, and so is the range unless samples are left out."""
    if layer.timeCodesPerSecond != shot.GetTimeCodesPerSecond():
        rate = f"{layer.timeCodesPerSecond:g}; the shot has {shot.GetTimeCodesPerSecond():g}"
        yield _error(f"timeCodesPerSecond is {rate}")
    part = (read_record(layer) or {}).get("left_out")
    for key in (key for key in METADATA if not (part and key in RANGE)):
        expected = root_metadata(shot, key)
        value = layer.pseudoRoot.GetInfo(key) if layer.pseudoRoot.HasInfo(key) else None
        if expected is not None and value != expected:
            yield _error(f"{key} is {value!r}; the shot has {expected!r}")


def prim_fault(path: str, composed: Usd.Stage, kinds: Sequence[type] = (UsdGeom.Mesh,)) -> str:
    """The reason for a path without an editable prim of some kinds, or ""."""
    prim = composed.GetPrimAtPath(path)
    if not prim:
        return "is not on the stage: the layer is not over the shot that it was made from"
    if prim.IsInstanceProxy():
        return "lies in an instance, where overs are ignored; its instance root must be instanceable = false"
    names = " or ".join(kind.__name__ for kind in kinds)
    return "" if any(kind(prim) for kind in kinds) else f"is of type {prim.GetTypeName() or 'none'}, not {names}"


def other_meshes(
    layer: Sdf.Layer, composed: Usd.Stage, shot: Usd.Stage, *, refined: Sequence[str]
) -> Iterator[Problem]:
    """Other meshes with opinions of the layer, by references or inherits, fit themselves as they do in the shot."""
    for prim in Usd.PrimRange.Stage(composed, TRAVERSAL):
        path = str(prim.GetPath())
        if path in refined or not UsdGeom.Mesh(prim) or all(spec.layer != layer for spec in prim.GetPrimStack()):
            continue
        samples = prim.GetAttribute("points").GetTimeSamples()
        times = (samples[0], samples[-1]) if samples else (None,)
        fine, coarse = (Fine(side, layer, times) for side in (prim, shot.GetPrimAtPath(path)))
        for time in times:
            fault = fine.topology_fault(time)
            if fault and not (coarse.prim and coarse.topology_fault(time)):
                yield fine.problem("faceVertexIndices", f"is composed from a refined mesh and invalid: {fault}", time)
                break


def against_shot(layer: Sdf.Layer, coarse: Usd.Prim, target: Sdf.Path) -> Iterator[Problem]:
    """Samples lie at the shot's own times, and the fine mesh matches the coarse mesh in position and size."""
    name = str(target.AppendProperty("points"))
    written = times_with_values(layer, name)
    for time in written:
        if reason := absence(coarse, time):
            yield _error(f"is a sample at a time at which the garment is not there: {reason}", name, time)
            return
    if skel_root(coarse) is not None:  # The points of a skinned mesh are a bind pose.
        return
    authored, frames = motion_of(coarse).times, FrameGrid.of(coarse.GetStage())
    for time in written:
        between = len(authored) > 1 and authored[0] < time < authored[-1] and frames.has(time)
        if len(authored) > 1 and not (between or is_among(time, authored)):  # Else the bodies' samples count.
            yield _error("is a sample neither at a time that the shot authors nor at a whole frame between", name, time)
            break
    spec, clouds = layer.GetAttributeAtPath(name), []
    for time in written[:1] + written[-1:] if written else [None]:
        value = layer.QueryTimeSample(name, time) if time is not None else (spec.default if spec else None)
        below = UsdGeom.Mesh(coarse).GetPointsAttr().Get(timecode(time))
        if value is not None and below is not None and len(value) and len(below):
            to_world = np.array(UsdGeom.XformCache(timecode(time)).GetLocalToWorldTransform(coarse))
            with np.errstate(invalid="ignore", over="ignore"):
                used = np.unique(authored_topology(coarse)[1])
                cage = np.asarray(below, np.float64)[used[(used >= 0) & (used < len(below))]]
                fine, cage = (np.asarray(cloud, np.float64) @ to_world[:3, :3] for cloud in (value, cage))
            clouds.append((fine, cage, time))
    yield from _compare(clouds, name)


def _compare(clouds: Sequence[tuple[np.ndarray, np.ndarray, float | None]], name: str) -> Iterator[Problem]:
    """Compare fine and coarse clouds by size and position, at some times; in world axes, without translation.

    Local space is not used: a sheared transform distorts local lengths, and cloth sags along the world's axis.

    A sample may be broken, for example with all points at the same place: a size between the coarse mesh's smallest and
    largest, within a factor of 4, is accepted.
    """
    finite = [(fine, below[np.isfinite(below).all(axis=1)], time) for fine, below, time in clouds]
    finite = [entry for entry in finite if len(entry[1]) and np.isfinite(entry[0]).all()]
    sizes = [_size(below) for _, below, _ in finite]
    for fine, below, time in finite if max(sizes, default=0.0) > 0 else ():
        least, most = min(sizes), max(sizes)
        away = float(np.linalg.norm(fine.mean(axis=0) - below.mean(axis=0)))
        if not least / 4 <= _size(fine) <= 4 * most:
            message = f"is {_size(fine):g} units large; the coarse mesh is {_size(below):g}"
            yield _error(f"{message}: units or transforms are wrong", name, time)
        elif away > most:
            yield _error(f"lies {away:g} units from the coarse mesh, which is {most:g} large", name, time)


def _size(cloud: np.ndarray) -> float:
    return float(np.linalg.norm(np.ptp(cloud, axis=0)))


def same_variants(layer: Sdf.Layer, shot: StageView, garments: Sequence[str]) -> Iterator[Problem]:
    """The shot selects the variants of the layer; an error if a coarse mesh differs now, else a warning.

    Opinions at a garment's path are stronger than variants: the layer shows the garment of the selections in force at
    refinement, whatever is selected now.
    """
    recorded = [Sdf.Path(text) for text in (read_record(layer) or {}).get("variants", ())]
    mask = Usd.StagePopulationMask([*garments, *dict.fromkeys(path.GetPrimPath() for path in recorded)])
    present = _coarse(shot, mask, ()) if recorded else None
    changed = {path: _selected(present, path) for path in recorded if present and _selected(present, path) != path}
    recorded_cage = _coarse(shot, mask, tuple(changed)) if changed else None
    differing = [
        path for path in garments if recorded_cage and present and _cloth(present, path) != _cloth(recorded_cage, path)
    ]
    for path, selected in changed.items():
        message = f"was refined with {_words(path)} and shows that; the shot has {_words(selected)} now"
        if differing:
            meshes = ", ".join(f"<{path}>" for path in differing)
            message += f", where {meshes} is another mesh; refine it into its own layer"
            yield Problem("error", str(path.GetPrimPath()), None, message, "")
        else:
            yield Problem("warning", str(path.GetPrimPath()), None, f"{message}; the garments' meshes are the same", "")


def _coarse(shot: StageView, mask: Usd.StagePopulationMask, selections: Sequence[Sdf.Path]) -> Usd.Stage:
    selected = Sdf.Layer.CreateAnonymous("selections.usda")
    for path in selections:
        name, selection = path.GetVariantSelection()
        Sdf.CreatePrimInLayer(selected, path.GetPrimPath()).variantSelections[name] = selection
    stage = shot.open(over=[selected], mask=mask)
    mute_refined(stage)
    return stage


def _selected(stage: Usd.Stage, path: Sdf.Path) -> Sdf.Path:
    name, _ = path.GetVariantSelection()
    prim = stage.GetPrimAtPath(path.GetPrimPath())
    selection = prim.GetVariantSet(name).GetVariantSelection() if prim else ""
    return path.GetPrimPath().AppendVariantSelection(name, selection)


def _words(path: Sdf.Path) -> str:
    """A selection in words, such as ``fit=loose``."""
    name, selection = path.GetVariantSelection()
    return f"{name}={selection or 'nothing'}"


def _cloth(stage: Usd.Stage, path: str) -> list[bytes | None]:
    """Topology and points of a mesh, at the default and at the first, middle and last sample, for comparison."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(path))
    if not mesh:
        return []
    samples = mesh.GetPointsAttr().GetTimeSamples()
    times = [None, *sorted({*samples[:1], *samples[len(samples) // 2 :][:1], *samples[-1:]})]
    values = [mesh.GetPrim().GetAttribute(name).Get(timecode(time)) for name in TOGETHER[:3] for time in times]
    return [None if value is None else np.asarray(value).tobytes() for value in values]
