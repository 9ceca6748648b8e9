"""One garment, read from its mesh prim."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom
from scipy import sparse
from scipy.sparse.linalg import splu

from ...errors import GarmentError, SchemaError
from ...solver.mesh.topology import PolygonMesh, edges_of
from ...solver.scene import Garment, GarmentFrame
from ..lookup import Found, Override, bound_materials, check_limits, find_value
from ..schema import GARMENT
from ..stage import GarmentSource, Notice, Units
from ..times import garment_times, merge, transform_times, within
from .cage import PointReader, read_cage
from .grain import read_grain
from .materials import Values, find_values
from .placement import check_matrix, check_placement, is_flipped, place, to_metres
from .rest import AUTO, Rest, checked, read_rest, rests_bent
from .skinning import Bake

_SMALL, _LARGE = 0.01, 100.0
_WORD = re.compile("[A-Z]?[a-z]+|[A-Z]+(?![a-z])")
"""A word of a name such as "LeatherBelt_geo1"."""
_MEDIAN_FRAMES = 9
"""Time codes that `--rest auto` takes medians of: an edge that is odd in four of them does not count."""
_THICK = 10.0
"""Fraction (one over it) of its size beyond which cloth keeps no distance: where all of it is near all of it, there are
V^2 pairs, and cloth that is pushed out by more than it measures has no shape of the shot."""
_PER_VERTEX = {UsdGeom.Tokens.vertex, UsdGeom.Tokens.varying}


@dataclass(frozen=True, eq=False)
class Request:
    """The options of a run, and the units and skinning that the garments of a stage have in common.

    Attributes:
        units: The stage's units.
        bake: Baked skinning.
        frames: First and last time code, or None.
        level: Number of subdivisions for all, -1 for auto, or None.
        overrides: Values of ``--set``.
        rest_frame: Time code whose points are the rest shape, "auto" for one fitted to all, or None.
        assumed_units: Whether metersPerUnit is not authored.
    """

    units: Units
    bake: Bake
    frames: tuple[float, float] | None = None
    level: int | None = None
    overrides: tuple[Override, ...] = ()
    rest_frame: float | str | None = None
    assumed_units: bool = False


@dataclass(frozen=True, eq=False)
class GarmentReader:
    """A garment with everything that is needed to read its frames.

    Attributes:
        garment: Its constant data.
        source: Its place on the stage.
        values: Sources of its animated values.
        points: Its points.
        edges: Its edges, shape (E, 2).
        notices: Warnings about it.
    """

    garment: Garment
    source: GarmentSource
    values: Values
    points: PointReader
    edges: np.ndarray
    notices: list[Notice] = field(default_factory=list)

    def frame(self, matrix: np.ndarray, time: float | None) -> tuple[GarmentFrame, tuple[Notice, ...]]:
        """The garment at a time code, and notices of repairs; ``matrix`` is local to world metres, shape (4, 4)."""
        local, notices = self.points.read(time, self.edges)
        names = ("guide:stiffness", "refine:detail", "contact:offset")
        guide, detail, offset = (self.values.number(name, time) for name in names)
        fabric, most = self.values.fabric(time), float(np.linalg.norm(np.ptp(self.garment.rest, axis=0))) / _THICK
        if max(fabric.thickness, offset) > most:
            message = f"contact keeps {1e3 * most:.3g} mm, a {_THICK:g}th of the cloth's size, for a thickness of"
            message += f" {1e3 * fabric.thickness:.3g} mm and an offset of {1e3 * offset:.3g} mm; check metersPerUnit"
            notices = (*notices, Notice(self.garment.path, None, message))
        fabric, offset = replace(fabric, thickness=min(fabric.thickness, most)), min(offset, most)
        return GarmentFrame(place(local, matrix), fabric, guide, detail, offset), notices


def all_times(prim: Usd.Prim, bake: Bake) -> tuple[float, ...]:
    """Every authored time code of a garment; a skinned one has its skeleton's, samples added by baking do not count."""
    skinned = bake.skinned.get(prim.GetPath())
    return merge([*skinned.times, *transform_times(prim)]) if skinned else garment_times(prim)


def read_garment(prim: Usd.Prim, roots: Sequence[Sdf.Path], request: Request) -> GarmentReader:
    """Read a garment from its mesh prim; ``roots`` are the instances that hold it on the stage as opened.

    Raises:
        GarmentError: When the garment is broken.
        SchemaError: When one of its values cannot be used.
    """
    every = all_times(prim, request.bake)
    times, first = within(every, request.frames), every[0] if every else None
    points = PointReader(prim, times[0] if times else None)
    cage = read_cage(prim, points.count, times)
    edges = cage.mesh.half_edges.edges
    placement = check_placement(prim, request.units.metres, times)
    matrix = to_metres(prim, request.units.metres, first)
    start = place(points.read(first, edges)[0], matrix)
    if request.rest_frame is None:
        rest = _rest_on_stage(prim, matrix, request, edges=edges, start=start, first=first)
    else:
        rest = _rest_asked(prim, points, request, mesh=cage.mesh, every=every)
    rest, (bent, odd) = checked(prim, edges, rest, first=start), rests_bent(prim)
    notices = [*cage.notices, *odd, *placement]
    values = find_values(prim, request.units, request.overrides)
    self_contact, layer, raises, level = _constants(prim, request)
    painted, cut = _painted(prim, points.count, notices, values=values)
    grain, lies = read_grain(prim, cage.mesh, rest.points, kept=cage.kept_faces, up=request.units.up, painted=cut)
    garment = Garment(
        *(str(prim.GetPath()), cage.mesh, rest.points, round(level.at(None) or 0.0), is_flipped(prim, matrix), bent),
        self_contact=bool(self_contact.at(None)),
        layer=None if (order := layer.at(None)) is None else round(order),
        grain=grain,
        raises_bending=bool(raises.at(None)),
        **painted,
    )
    notices += [*rest.notices, *_size_notices(garment.path, start, request), *_unit_notices(prim, matrix, request)]
    sources = {"contact:selfCollision": self_contact.source, "contact:layer": layer.source, "rest": rest.source}
    sources |= {"grain": lies, "refine:raiseBending": raises.source}
    source = GarmentSource(
        *(prim.GetPath(), cage.kept_faces, prim.GetPath() in request.bake.skinned, tuple(roots), times),
        sources | values.sources | {"refine:level": level.source},
        values.animated,
        left_out=tuple(time for time in every if time not in times),
        velocities=bool(UsdGeom.Mesh(prim).GetVelocitiesAttr().Get(Usd.TimeCode.EarliestTime())),
        subsets=(subsets := _subsets(prim, cage.kept_faces)),
        words=_words(prim, [name for name, faces in subsets.items() if 2 * len(faces) > len(cage.kept_faces)]),
    )
    return GarmentReader(garment, source, values, points, edges, [*notices, *values.notices])


def _constants(prim: Usd.Prim, request: Request) -> list[Found]:
    """Self-collision, layer, whether bending is raised, and level, which never change over a shot."""
    names = ("contact:selfCollision", "contact:layer", "refine:raiseBending", "refine:level")
    *others, level = (find_value(prim, GARMENT[name], request.overrides) for name in names)
    if request.level is not None and level.source != "--set":
        level = Found(level.row, "--level", None, request.level)
    return [*others, level]


def _rest_asked(
    prim: Usd.Prim, points: PointReader, request: Request, *, mesh: PolygonMesh, every: Sequence[float]
) -> Rest:
    """Rest shape of ``--rest``: the points at a time code, or one fitted to all."""
    if request.rest_frame == AUTO:
        return _rest_auto(prim, points, request, mesh=mesh, every=every)
    time = float(request.rest_frame or 0.0)
    local, notices = points.read(time, mesh.half_edges.edges)
    placed = place(local, to_metres(prim, request.units.metres, time))
    return Rest(placed, f"points at time code {time:g} (--rest)", notices)


def _rest_auto(
    prim: Usd.Prim, points: PointReader, request: Request, *, mesh: PolygonMesh, every: Sequence[float]
) -> Rest:
    """Rest shape fitted to the median lengths of the edges over the whole shot, whatever part is refined."""
    poses: dict[float | None, np.ndarray] = {}
    picks = np.linspace(0, len(every) - 1, min(_MEDIAN_FRAMES, len(every))).round().astype(int)
    for time in [every[pick] for pick in picks] or [None]:
        with contextlib.suppress(GarmentError):  # Refining a broken frame names its fault.
            local = points.read(time, mesh.half_edges.edges)[0]
            poses[time] = place(local, to_metres(prim, request.units.metres, time))
    found = list(poses.values())
    shape, nearest = median_shape(edges_of(mesh.triangulate(found[0]).triangles, mesh.vertex_count).vertices, found)
    at = [*poses][nearest]
    message = f"median edge lengths of {len(poses)} time codes" + ("" if at is None else f", from the points at {at:g}")
    return Rest(shape, f"auto: {message} (--rest)")


def _subsets(prim: Usd.Prim, cage_faces: np.ndarray) -> dict[str, np.ndarray]:
    """Faces of the cage in each of the mesh's subsets of faces, by name."""
    subsets = {}
    for subset in UsdGeom.Subset.GetGeomSubsets(UsdGeom.Imageable(prim), UsdGeom.Tokens.face):
        faces = subset.GetIndicesAttr().Get(Usd.TimeCode.EarliestTime())
        members = np.isin(cage_faces, [] if faces is None else np.asarray(faces))
        subsets[subset.GetPrim().GetName()] = np.flatnonzero(members)
    return subsets


def _words(prim: Usd.Prim, subsets: Sequence[str]) -> tuple[str, ...]:
    """Words, in lower case, in the names of a mesh, the prim above it, their materials, and subsets of the mesh."""
    prims = [prim, prim.GetParent(), *bound_materials(prim)]
    for subset in (prim.GetChild(name) for name in subsets):
        prims += [subset, *bound_materials(subset)]
    return tuple(word.lower() for each in prims for word in _WORD.findall(each.GetName()))


def _rest_on_stage(
    prim: Usd.Prim, matrix: np.ndarray, request: Request, *, edges: np.ndarray, start: np.ndarray, first: float | None
) -> Rest:
    """Rest shape on the stage; a skinned one is placed by its bind transform in place of the mesh's."""
    bound = matrix
    if prim.GetPath() in request.bake.skinned:
        rows = request.bake.rest_transform(prim.GetPath(), first)
        bound = check_matrix(prim, rows, request.units.metres, time=first)
    return read_rest(prim, edges, start, place=lambda local: place(local, bound), baked=request.bake.layer)


def _painted(
    prim: Usd.Prim, count: int, notices: list[Notice], *, values: Values
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The painted arrays of a garment by field name, times the relative thickness, and the grain's by schema name.

    Adds to the notices.
    """
    names = {"stretch_scale": "stretchScale", "bend_scale": "bendScale", "guide_scale": "guideScale"}
    names |= {"detail_scale": "detailScale", "pin": "pin"}
    cut = ("easeScale", "gather", "grain")
    arrays = {}
    for name, short in (names | dict(zip(cut, cut, strict=True))).items():
        arrays[name], odd = read_painted(prim, short, count)
        notices.extend(odd)
    arrays["stretch_scale"] = arrays["stretch_scale"] * values.thickness_scale("stretchStiffness")
    arrays["bend_scale"] = arrays["bend_scale"] * values.thickness_scale("bendStiffness")
    return {name: arrays[name] for name in names}, {name: arrays[name] for name in cut}


def _size_notices(path: str, points: np.ndarray, request: Request) -> list[Notice]:
    """A notice of the size in metres when units were assumed or it is no garment's."""
    size = np.ptp(points, axis=0)
    largest = float(size.max())
    if not request.assumed_units and _SMALL <= largest <= _LARGE:
        return []
    message = " x ".join(f"{length:.3g}" for length in size)
    return [Notice(path, None, f"measures {message} m with {request.units.metres:g} m per unit; check metersPerUnit")]


def _unit_notices(prim: Usd.Prim, matrix: np.ndarray, request: Request) -> list[Notice]:
    """A notice of each layer in other units whose points no scale corrects; USD never converts."""
    scale, metres = float(np.cbrt(abs(np.linalg.det(matrix[:3, :3])))), request.units.metres
    notices = []
    for layer in dict.fromkeys(spec.layer for spec in UsdGeom.Mesh(prim).GetPointsAttr().GetPropertyStack()):
        unit = layer.pseudoRoot.GetInfo("metersPerUnit") if layer.pseudoRoot.HasInfo("metersPerUnit") else None
        if isinstance(unit, int | float) and not np.isclose(unit, metres) and not np.isclose(unit, scale, rtol=0.01):
            message = f"its layer @{layer.GetDisplayName()}@ has {unit:g} m per unit, the stage has {metres:g}"
            notices.append(Notice(str(prim.GetPath()), None, f"{message}; USD does not convert, check its size"))
    return notices


def is_visible(prim: Usd.Prim, times: Sequence[float]) -> bool:
    """Whether a prim is visible at any of the time codes, or by default when there are none."""
    imageable = UsdGeom.Imageable(prim)
    codes = [Usd.TimeCode(time) for time in times] or [Usd.TimeCode.Default()]
    return any(imageable.ComputeVisibility(code) != UsdGeom.Tokens.invisible for code in codes)


def read_painted(prim: Usd.Prim, short: str, count: int) -> tuple[np.ndarray, tuple[Notice, ...]]:
    """A painted multiplier or pin of a mesh at each point, shape (count,), float64, and notices.

    Constant ones are inherited from ancestors as USD does.

    Args:
        prim: Mesh prim.
        short: Short name of the schema's row, such as ``bendScale``.
        count: Number of points.

    Raises:
        SchemaError: When the interpolation, type, number or limits of the values are wrong.
    """
    row = GARMENT[short]
    primvar = _primvar(prim, row.name.removeprefix("primvars:"))
    flat = primvar.ComputeFlattened(Usd.TimeCode.EarliestTime()) if primvar else None
    if primvar is None or flat is None:
        return np.full(count, float(row.fallback or 0.0)), ()
    values = np.atleast_1d(np.asarray(flat))
    where = f"<{prim.GetPath()}>.{primvar.GetAttr().GetName()}"
    if values.ndim != 1 or not (np.issubdtype(values.dtype, np.number) or values.dtype == bool):
        raise SchemaError(f"{where} is {type(flat).__name__}; author float[]")
    values = values.astype(np.float64)
    interpolation = primvar.GetInterpolation()
    if len(values) == 1 and (interpolation not in _PER_VERTEX or count == 1):
        values = np.full(count, values[0])
    elif interpolation not in _PER_VERTEX or len(values) != count:
        message = f"{len(values)} values with {interpolation} interpolation on {count} points"
        raise SchemaError(f"{where} has {message}; author one value per point (vertex) or one for all (constant)")
    notices: tuple[Notice, ...] = ()
    if row is GARMENT["pin"] and (values > 1.0).any():  # Weights that other programs paint are over 1 by rounding.
        message = f"{row.name} goes up to {values.max():g}; values over 1 are taken as 1"
        values, notices = np.minimum(values, 1.0), (Notice(str(prim.GetPath()), None, message),)
    for index in (int(values.argmin()), int(values.argmax())) if count else ():  # NaN is either's first.
        check_limits(row, float(values[index]), f"{where}[{index}]")
    return values, notices


def _primvar(prim: Usd.Prim, name: str) -> UsdGeom.Primvar | None:
    """The authored primvar of a name, or of the name that Blender's exporter makes of it: no colons."""
    for spelled in (name, name.replace(":", "_")):
        primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(spelled)
        if primvar and primvar.HasAuthoredValue():
            return primvar
    return None


STEPS = 40
"""After these the edges of no shot tried came nearer to their medians by more than a thousandth of their length."""
HOLD = 1e-6
"""Stiffness that ties the shape to its place, in mean stiffnesses: enough for a factor, nothing to a length."""
SHORTEST = 1e-3
"""In mean edges; shorter ones pull no harder."""


def median_shape(edges: np.ndarray, poses: Sequence[np.ndarray]) -> tuple[np.ndarray, int]:
    """Fit a shape to the median length of each edge: sum of (l - m)^2 / m over the edges, least by majorization.

    A single pose has its own stretch; medians belong to none, yet cloth comes near them nearly everywhere.
    The method is SMACOF (de Leeuw 1977): each step solves a Laplace equation with the edges' present directions.

    Args:
        edges: End vertices, shape (E, 2).
        poses: Positions of the same vertices, each of shape (V, 3), at least one.

    Returns:
        The shape, (V, 3), and which pose was nearest to the medians; the fit starts there.
    """
    lengths = np.array([np.linalg.norm(np.subtract(*pose[edges.T]), axis=1) for pose in poses])
    median = np.median(lengths, axis=0)
    nearest = int(np.abs(lengths - median).sum(axis=1).argmin())
    shape = np.array(poses[nearest], np.float64)
    if not median.any():
        return shape, nearest
    weight = 1.0 / np.maximum(median, max(SHORTEST * float(median.mean()), np.finfo(float).tiny))
    rows = np.arange(len(edges))
    ends = np.concatenate([edges[:, 0], edges[:, 1]])
    signs = np.repeat([1.0, -1.0], len(edges))
    spans = sparse.csr_matrix((signs, (np.tile(rows, 2), ends)), shape=(len(edges), len(shape)))
    pull = sparse.csr_matrix(spans.T @ sparse.diags(weight))
    stiffness = pull @ spans
    hold = HOLD * float(stiffness.diagonal().mean())
    solve = splu(sparse.csc_matrix(stiffness + hold * sparse.identity(len(shape)))).solve
    for _ in range(STEPS):
        span = spans @ shape
        length = np.linalg.norm(span, axis=1)
        wanted = span * (median / np.maximum(length, np.finfo(float).tiny))[:, None]
        shape = solve(pull @ wanted + hold * shape)
    return shape, nearest
