"""Reads a garment from a mesh prim."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from ...errors import GarmentError, SchemaError, counted
from ...solver.colliders.pose import extent
from ...solver.mesh.borders import open_edges
from ...solver.mesh.subdivide import SHARPNESS
from ...solver.mesh.topology import PolygonMesh, find_edges
from ...solver.mesh.weld import Weld, seam_reach, weld, weld_skins
from ...solver.scene import Garment, GarmentFrame, Limits, mean_edge
from ..lookup import Found, Override, bound_materials, check_limits, find_value
from ..mesh.pieces import sort_pieces
from ..schema import GARMENT
from ..stage import GarmentSource, Notice, Units, flattened
from ..times import FrameGrid, within
from .absence import Samples, absence
from .air import Air
from .bodies import sharpness_of
from .cage import PointReader, read_cage
from .grain import read_grain
from .materials import Values, find_values
from .motion import CageMotion
from .placement import check_matrix, check_placement, is_flipped, place, to_metres
from .rest import Animation, Rest, pressed_folds, read_rest, rests_bent
from .skinning import Bake
from .subsets import read_subsets

PRESSED = "physgraph:pressed"
"""Attribute of an edge subset to mark pressed folds, bool."""
RIGID = "physgraph:rigid"
"""Attribute of a face subset to mark a rigid part, bool."""
_SMALL, _LARGE = 0.01, 100.0
"""Sizes between which anything of cloth is believed [m]."""
_WORN, _USUAL = (0.02, 10.0), 0.7
"""Sizes of a garment on a body, from a doll's hat to a train, and a usual one [m]."""
_UNITS = (1.0, 0.01, 0.001)
"""Units that shots come in [m]."""
_PER_EDGE, _PER_SIZE = 5.0, 400.0
"""Inverse of the largest contact distance that is not authored, relative to the cage's mean edge and to its size; the
larger one counts. A coat with edges of 10 mm keeps the full offset, a doll's of 1:12 a quarter of it."""
_STANDS_OFF = 2.5
"""Multiple of that distance from which an authored offset or thickness is large for a garment."""
WORD = re.compile("[A-Z]?[a-z]+|[A-Z]+(?![a-z])")
"""A word of a name such as "LeatherBelt_geo1"."""
_THICK = 10.0
"""Inverse of the largest contact distance relative to the cloth's size. Beyond, all vertices are near all vertices,
with V^2 pairs, and cloth pushed out by more than its size loses the shot's shape."""
_LIMIT_SCALES = ("maxDistanceScale", "backstopScale")
_PER_VERTEX = {UsdGeom.Tokens.vertex, UsdGeom.Tokens.varying}


@dataclass(frozen=True, eq=False)
class Request:
    """The options of a run, and units and skinning shared by the garments of a stage.

    Attributes:
        units: The stage's units.
        bake: Baked skinning.
        frames: First and last time code, or None.
        level: Number of subdivisions for all, -1 for auto, or None.
        rest_frame: Time code of the rest shape's points, "auto" for a shape fitted to the shot, or None.
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
    """A garment with everything needed to read its frames.

    Attributes:
        garment: Constant data.
        source: Place on the stage.
        values: Sources of the animated values.
        weld: The mesh as authored and as solved.
        notices: Warnings about the garment.
        hidden: Time codes of samples of the garment while invisible.
        motion: Acceleration of its cage; None for a still one.
        air: Pressure and wind on it.
        limit_scales: Multipliers of max distance and backstop at the solved vertices, each of shape (V,).
    """

    garment: Garment
    source: GarmentSource
    values: Values
    points: PointReader
    weld: Weld
    notices: list[Notice] = field(default_factory=list)
    hidden: frozenset[float] = frozenset()
    motion: CageMotion | None = None
    air: Air | None = None
    limit_scales: tuple[np.ndarray, ...] = ()

    def frame(self, prim: Usd.Prim, metres: float, time: float | None) -> tuple[GarmentFrame, tuple[Notice, ...]]:
        """The garment at a time code, and notices of repairs.

        All points of an absent garment are at one place, without contact: other garments may still have a frame.
        """
        notices: tuple[Notice, ...] = ()
        is_present = time is None or not (time in self.hidden or absence(prim, time))
        if not is_present:
            points = np.broadcast_to(self.garment.rest.mean(axis=0), self.garment.rest.shape)
        else:
            local, notices = self.points.read(time)
            points = self.weld.joined(place(local, to_metres(prim, metres, time)))
        guide, detail = (self.values.number(name, time) for name in ("guide:stiffness", "refine:detail"))
        offset, thickness = (self.contact_distance(name, time) for name in ("contact:offset", "thickness"))
        fabric, most = self.values.fabric(time), self._size / _THICK
        if max(thickness, offset) > most:
            message = f"contact keeps {1e3 * most:.3g} mm, a {_THICK:g}th of the cloth's size, for a thickness of"
            message += f" {1e3 * thickness:.3g} mm and an offset of {1e3 * offset:.3g} mm; check metersPerUnit"
            notices = (*notices, Notice(self.garment.path, None, message))
        half = 0.0 if self.weld.across is None else float(np.abs(self.weld.across).max())
        thickness, offset = max(min(thickness, most), 2.0 * half), min(offset, most) + half
        fabric = replace(fabric, thickness=thickness)
        acceleration = self._felt(time, points) if is_present else None
        load = self.air.load(points, time) if is_present and self.air is not None else None
        limits = self._limits(time)
        return GarmentFrame(points, fabric, guide, detail, offset, acceleration, load, limits), notices

    def _limits(self, time: float | None) -> Limits | None:
        """Limits of the distance to the subdivided cage at a time code; None without any."""
        distance, backstop = (self.values.found[name].at(time) for name in ("maxDistance", "backstop"))
        return None if distance is backstop is None else Limits(distance, backstop, *self.limit_scales)

    def _felt(self, time: float | None, points: np.ndarray) -> np.ndarray | None:
        """Acceleration of the cage felt by the cloth [m/s^2], shape (V, 3); None for slow or still cages."""
        share = self.values.number("inertia", time)
        acceleration = None if self.motion is None or not share else self.motion.felt(time, points)
        return None if acceleration is None else share * acceleration

    @cached_property
    def fitting(self) -> float:
        """Largest contact distance that suits the cage's size and edges [m]."""
        return max(mean_edge(self.garment) / _PER_EDGE, self._size / _PER_SIZE)

    @cached_property
    def _size(self) -> float:
        """Diagonal of the rest shape's bounding box [m]."""
        return float(np.linalg.norm(extent(self.garment.rest)))

    @property
    def largest_offset(self) -> float:
        """Contact distance beyond which the cloth's folds are hidden [m]."""
        return _STANDS_OFF * self.fitting

    def contact_distance(self, name: str, time: float | None) -> float:
        """Contact offset or thickness at a time code [m], by short name; unless authored, at most `fitting`."""
        value = self.values.number(name, time)
        return min(value, self.fitting) if self.values.found[name].source == "fallback" else value

    def contact_notices(self) -> list[Notice]:
        """Notices of a thickness or an offset from colliders that is large for the garment in its first frame."""
        notices, time, most = [], next(iter(self.source.times), None), 1e3 * self.fitting
        for row in (GARMENT[name] for name in ("thickness", "contact:offset")[: 2 if self.garment.colliders else 1]):
            value, limited = (
                1e3 * metres for metres in (self.values.number(row.short, time), self.contact_distance(row.short, time))
            )
            if limited < value:
                notices.append(f"{row.name} is taken as {limited:.2g} mm, not {value:g}; author it for another")
            elif value > 1e3 * self.largest_offset:
                notices.append(f"{row.name} of {value:.3g} mm hides its folds; at most {most:.2g} mm suits it")
        small = f"its edges are of {1e3 * mean_edge(self.garment):.2g} mm: {'; '.join(notices)}"
        return [Notice(self.garment.path, None, small)] if notices else []


def samples_of(prim: Usd.Prim, own_times: Sequence[float], times: Sequence[float]) -> Samples:
    """Time codes of a garment's samples and of its solve, without time codes where the garment has no shape.

    Raises:
        GarmentError: When the garment has a shape at none of its own time codes.
    """
    samples = Samples.of(prim, times, own_times)
    if own_times and not samples.times:
        time, reason = next(iter(samples.absent.items()))
        message, remedy = f"{reason}; it is there at no time code", "give it points and a scale other than zero"
        raise GarmentError(str(prim.GetPath()), message, time=time, remedy=remedy)
    return samples


def read_garment(prim: Usd.Prim, roots: Sequence[Sdf.Path], samples: Samples, request: Request) -> GarmentReader:
    """Read a garment from its mesh prim; ``roots`` are the instances containing the garment on the stage as opened.

    Raises:
        GarmentError: When the garment is broken.
        SchemaError: When a value of the garment is invalid.
    """
    every, times = samples.times, within(samples.times, request.frames)
    points = PointReader(prim, times[0] if times else None)
    cage = read_cage(prim, points.count, times)
    points.edges, placement = cage.mesh.half_edges.edges, check_placement(prim, request.units.metres, times)
    matrix = to_metres(prim, request.units.metres, every[0] if every else None)
    animation = _animation(prim, points, request, every=samples.own, times=times)
    rest, weld = _rest_and_weld(prim, cage.mesh, animation, request, matrix=matrix)
    (bent, bent_notices), absent = rests_bent(prim), within(samples.absent, request.frames)
    notices = [*samples.notices(str(prim.GetPath()), absent), *cage.notices, *bent_notices, *placement]
    values = find_values(prim, request.units, request.overrides)
    constants, of_constants = _constants(prim, request)
    painted, cut, scales = _painted(prim, weld, notices, values=values, overrides=request.overrides)
    subsets = read_subsets(prim, cage.kept_faces[weld.faces], units=request.units, time=times[0] if times else None)
    pieces = _pieces(prim, weld, rest.points, subsets.faces, notices)
    grain, lies = read_grain(prim, weld, rest.points, kept=cage.kept_faces, up=request.units.up, painted=cut)
    garment = Garment(
        *(str(prim.GetPath()), weld.mesh, weld.joined(rest.points)),
        flipped=is_flipped(prim, matrix),
        bent_rest=bent,
        grain=grain,
        fabric_scale=subsets.scale,
        **constants | pieces | painted | _folds(prim, weld, animation),
    )
    notices += [*rest.notices, *_size_notices(prim, animation.first, matrix, request), *values.notices]
    source = GarmentSource(
        *(prim.GetPath(), cage.kept_faces, weld, prim.GetPath() in request.bake.skinned, tuple(roots), times),
        {"rest": rest.source, "grain": lies} | values.sources | subsets.sources | of_constants,
        values.animated,
        still=not samples.own,
        left_out=tuple(time for time in every if time not in times) if times else (),
        absent=absent,
        velocities=_has_velocities(prim, points.count),
        **{"subsets": subsets.faces, "fabrics": subsets.words},
        words=_words(prim, [name for name, faces in subsets.faces.items() if 2 * len(faces) > len(weld.faces)]),
        shell=float(find_value(prim, GARMENT["shell:thickness"], request.overrides).at(None) or 0.0),
    )
    motion = _motion(prim, points, weld, times=every, metres=request.units.metres)
    air = Air(values, garment, request.units.up, 1.0 / prim.GetStage().GetTimeCodesPerSecond())
    return GarmentReader(garment, source, values, points, weld, notices, samples.hidden, motion, air, scales)


def _motion(
    prim: Usd.Prim, points: PointReader, weld: Weld, *, times: Sequence[float], metres: float
) -> CageMotion | None:
    """The acceleration of a garment's solved vertices; None for a still garment."""
    stage = prim.GetStage()

    def read(time: float) -> np.ndarray:
        return weld.joined(place(points.read(time)[0], to_metres(prim, metres, time)))

    edges, frame, seconds = weld.mesh.half_edges.edges, FrameGrid.of(stage).length, 1.0 / stage.GetTimeCodesPerSecond()
    return CageMotion(times, read, edges=edges, frame=frame, seconds=seconds) if times else None


def _animation(
    prim: Usd.Prim,
    points: PointReader,
    request: Request,
    *,
    every: Sequence[float],
    times: Sequence[float],
) -> Animation:
    """A garment's points over the shot, given its own time codes and the refined time codes; each is read once."""

    @cache
    def read(time: float | None) -> tuple[np.ndarray, tuple[Notice, ...]]:
        local, notices = points.read(time)
        return place(local, to_metres(prim, request.units.metres, time)), notices

    return Animation(every, read(times[0] if times else None)[0], read)


def _constants(prim: Usd.Prim, request: Request) -> tuple[dict[str, Any], dict[str, str]]:
    """Constant values of a garment, by field name, and their sources by schema name."""
    names = ("contact:selfCollision", "refine:raiseBending", "refine:level")
    self_contact, raises, level = (find_value(prim, GARMENT[name], request.overrides) for name in names)
    if request.level is not None and level.source != "--set":
        level = Found(level.row, "--level", None, request.level)
    values = {
        "self_contact": bool(self_contact.at(None)),
        "raises_bending": bool(raises.at(None)),
        "level": round(level.at(None) or 0.0),
    }
    entries = zip(names, (self_contact, raises, level), strict=True)
    return values, {name: value.source for name, value in entries}


def _has_velocities(prim: Usd.Prim, count: int) -> bool:
    """Whether a mesh has velocities matching its point count, by default or at any sample."""
    attribute = UsdGeom.Mesh(prim).GetVelocitiesAttr()
    codes = (Usd.TimeCode.Default(), *map(Usd.TimeCode, attribute.GetTimeSamples()))
    return any(len(attribute.Get(code) or ()) == count for code in codes)


def _pieces(
    prim: Usd.Prim, weld: Weld, rest: np.ndarray, subsets: dict[str, np.ndarray], notices: list[Notice]
) -> dict[str, Any]:
    """Closed pieces and rigid parts by field name; adds to the notices."""
    rigid_faces = np.zeros(weld.mesh.face_count, bool)
    for name, faces in subsets.items():
        attribute = prim.GetChild(name).GetAttribute(RIGID)
        rigid_faces[faces] |= bool(attribute and attribute.Get())
    pieces, path = sort_pieces(weld.mesh, weld.joined(rest), rigid_faces), str(prim.GetPath())
    if count := int(pieces.rigid.max(initial=-1)) + 1:
        message = f"{counted(count, 'piece')} of it moved rigidly with the cloth under, as buttons are"
        notices.append(Notice(path, None, message))
    if weld.across is not None:
        thick = 2e3 * float(np.median(np.abs(weld.across)))
        message = (
            f"a closed shell, {thick:.2g} mm thick: the sheet in its middle is refined, and given its thickness again"
        )
        notices.append(Notice(path, None, message))
    if pieces.closed.any():
        message = "a closed shell: both skins are refined, and its sharp edges stay sharp; a sheet makes better folds"
        notices.append(Notice(path, None, message))
    if pieces.joined:
        message = f"{RIGID} is for pieces that share no vertices with cloth; paint bendScale to stiffen the others"
        notices.append(Notice(path, None, message))
    return {"closed": pieces.closed if pieces.closed.any() else None, "rigid": pieces.rigid if count else None}


def _folds(prim: Usd.Prim, weld: Weld, animation: Animation) -> dict[str, Any]:
    """Creases, corners, pressed vertices and the pose with the pressed folds, by field name.

    Creases are pressed folds unless marked otherwise by the artist.
    """
    poses = [weld.joined(pose) for pose in animation.poses.values()]
    creases, fields = np.zeros((0, 2), np.int64), dict[str, Any]()
    if UsdGeom.Mesh(prim).GetSubdivisionSchemeAttr().Get() in (UsdGeom.Tokens.catmullClark, UsdGeom.Tokens.loop):
        ends, sharpness, corners = sharpness_of(UsdGeom.Mesh(prim), len(weld.number))
        creases = np.sort(weld.number[ends], axis=1)[sharpness >= SHARPNESS]
        if len(ends):
            fields["creases"] = weld.number[ends], sharpness
        if corners.any():
            fields["corners"] = weld.largest(corners)
    pressed, flat = (_marked_edges(prim, weld, pressed=value) for value in (True, False))
    pressed = np.concatenate([pressed, creases[find_edges(flat, creases) < 0]])
    folds = pressed_folds(weld.mesh, poses, np.unique(pressed, axis=0), flat)
    return fields if folds is None else fields | {"pressed": folds[0], "folded": folds[1]}


def _marked_edges(prim: Usd.Prim, weld: Weld, *, pressed: bool) -> np.ndarray:
    """Welded vertices of the edges in subsets whose `PRESSED` has a value, lower first, ascending, shape (E, 2)."""
    marked = [np.zeros((0, 2), np.int64)]
    for subset in UsdGeom.Subset.GetGeomSubsets(UsdGeom.Imageable(prim), UsdGeom.Tokens.edge):
        attribute = subset.GetPrim().GetAttribute(PRESSED)
        value = attribute.Get() if attribute else None
        ends = subset.GetIndicesAttr().Get(Usd.TimeCode.EarliestTime())
        if value is not None and bool(value) == pressed and ends is not None:
            ends = np.asarray(ends)[: len(ends) // 2 * 2].reshape(-1, 2)
            ends = ends[((ends >= 0) & (ends < len(weld.number))).all(axis=1)]
            marked.append(np.sort(weld.number[ends], axis=1))
    return np.unique(np.concatenate(marked), axis=0)


def _words(prim: Usd.Prim, subsets: Sequence[str]) -> tuple[str, ...]:
    """Words, in lower case, in the names of a mesh, the prim above it, their materials, and subsets of the mesh."""
    prims = [prim, prim.GetParent(), *bound_materials(prim)]
    for subset in (prim.GetChild(name) for name in subsets):
        prims += [subset, *bound_materials(subset)]
    return tuple(word.lower() for named_prim in prims for word in WORD.findall(named_prim.GetName()))


def _rest_and_weld(
    prim: Usd.Prim, mesh: PolygonMesh, animation: Animation, request: Request, *, matrix: np.ndarray
) -> tuple[Rest, Weld]:
    """Rest shape as authored or fitted, and the weld of the borders coincident in the rest shape and over the shot."""
    poses = [*animation.poses.values()] or [animation.first]
    if (welded := weld_skins(mesh, poses)) is not None:
        return _rest(prim, welded.without_rims, animation, request, matrix=matrix), welded
    within = seam_reach(mesh, poses[0], seam_tolerance(prim, request.overrides))
    welded = weld(mesh, poses, within)
    rest = _rest(prim, welded, animation, request, matrix=matrix)
    return rest, welded if welded.is_none else weld(mesh, [*poses, rest.points], within)


def seam_tolerance(prim: Usd.Prim, overrides: Sequence[Override]) -> float:
    """Distance within which a garment's open borders are sewn [m]."""
    return float(find_value(prim, GARMENT["seam:tolerance"], overrides).at(None) or 0.0)


def _rest(prim: Usd.Prim, weld: Weld, animation: Animation, request: Request, *, matrix: np.ndarray) -> Rest:
    """Rest shape; authored points of a skinned mesh are placed by the bind transform instead of the mesh's matrix."""
    bound, first = matrix, animation.times[0] if animation.times else None
    if prim.GetPath() in request.bake.skinned:
        rows = request.bake.rest_transform(prim.GetPath(), first)
        bound = check_matrix(prim, rows, request.units.metres, time=first)
    placed = partial(place, matrix=bound)
    return read_rest(prim, weld, request.rest_frame, animation, place=placed, baked=request.bake.layer)


def _painted(
    prim: Usd.Prim, weld: Weld, notices: list[Notice], *, values: Values, overrides: Sequence[Override]
) -> tuple[dict[str, Any], dict[str, np.ndarray], tuple[np.ndarray, ...]]:
    """The painted arrays of a garment by field name, times the relative thickness, the grain's by schema name, and the
    limits' at the solved vertices.

    Adds to the notices.
    """
    names = {"stretch_scale": "stretchScale", "bend_scale": "bendScale", "guide_scale": "guideScale"}
    names |= {"detail_scale": "detailScale", "pin": "pin"}
    cut = ("easeScale", "gather", "grain", *_LIMIT_SCALES)
    arrays = {}
    for name, short in (names | dict(zip(cut, cut, strict=True))).items():
        arrays[name], new_notices = read_painted(prim, short, weld.apart.vertex_count, overrides=overrides)
        notices.extend(new_notices)
    if find_value(prim, GARMENT["gather"], overrides).source == "--set":
        arrays["gather"] *= _at_open_borders(prim, weld)
    arrays["stretch_scale"] = arrays["stretch_scale"] * values.thickness_scale("stretchStiffness")
    arrays["bend_scale"] = arrays["bend_scale"] * values.thickness_scale("bendStiffness")
    joined = {name: weld.largest(arrays[name]) if name == "pin" else weld.joined(arrays[name]) for name in names}
    least = tuple(-weld.largest(-arrays[name]) for name in _LIMIT_SCALES)  # Of what is joined.
    return joined, {name: arrays[name] for name in cut if name not in _LIMIT_SCALES}, least


def _at_open_borders(prim: Usd.Prim, weld: Weld) -> np.ndarray:
    """True at the authored vertices on borders that are open when sewn; GarmentError without such a border."""
    ends = open_edges(weld.mesh)
    if not len(ends):
        remedy = f"paint {GARMENT['gather'].name}, or set weftEase for all of the cloth"
        raise GarmentError(str(prim.GetPath()), "--set gather acts at open borders, and it has none", remedy=remedy)
    return np.isin(weld.number, ends)


def _size_notices(prim: Usd.Prim, points: np.ndarray, matrix: np.ndarray, request: Request) -> list[Notice]:
    """Notices of units: assumed units, a size implausible for cloth, and layers with different units."""
    notices, path = _unit_notices(prim, matrix, request), str(prim.GetPath())
    if request.assumed_units or not _SMALL <= float(np.ptp(points, axis=0).max()) <= _LARGE:
        notices.insert(0, Notice(path, None, f"{_measures(points, request.units.metres)}; check metersPerUnit"))
    return notices


def worn_notices(garment: Garment, metres: float) -> list[Notice]:
    """A notice of a garment that feels bodies and is too small or too large to be worn, with the likely units.

    Args:
        garment: The garment, with its colliders.
        metres: Metres per unit of the stage.
    """
    largest = float(np.ptp(garment.rest, axis=0).max())
    if not garment.colliders or not _SMALL <= largest <= _LARGE or _WORN[0] <= largest <= _WORN[1]:
        return []
    likely = min(_UNITS, key=lambda unit: abs(math.log(largest * unit / metres / _USUAL)))
    message = f"{_measures(garment.rest, metres)}; garments on bodies are believed from {_WORN[0]:g} to {_WORN[1]:g} m:"
    message += f" set metersPerUnit to {likely:g}, with which its longest side is {largest * likely / metres:.3g} m"
    return [Notice(garment.path, None, message)]


def _measures(points: np.ndarray, metres: float) -> str:
    """Size of points [m] in words."""
    return f"measures {' x '.join(f'{length:.3g}' for length in np.ptp(points, axis=0))} m with {metres:g} m per unit"


def _unit_notices(prim: Usd.Prim, matrix: np.ndarray, request: Request) -> list[Notice]:
    """A notice of each layer with different units and no scale to correct its points; USD never converts."""
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


def read_painted(
    prim: Usd.Prim, short: str, count: int, *, overrides: Sequence[Override] = ()
) -> tuple[np.ndarray, tuple[Notice, ...]]:
    """A painted multiplier or pin of a mesh at each point, shape (count,), float64, and notices.

    Constant primvars are inherited from ancestors, as in USD. A value of ``--set`` holds at every point.

    Args:
        short: Short name of the schema's row, such as ``bendScale``.
        count: Number of points.

    Raises:
        SchemaError: When the interpolation, type, number or limits of the values are wrong.
    """
    row = GARMENT[short]
    value = find_value(prim, row, overrides)
    if value.source == "--set":
        return np.full(count, value.constant), ()
    primvar = _primvar(prim, row.name.removeprefix("primvars:"))
    flat = flattened(primvar, Usd.TimeCode.EarliestTime()) if primvar else None
    if primvar is None or flat is None:
        return np.full(count, float(row.fallback or 0.0)), ()
    values = np.atleast_1d(np.asarray(flat))
    location = f"<{prim.GetPath()}>.{primvar.GetAttr().GetName()}"
    if values.ndim != 1 or not (np.issubdtype(values.dtype, np.number) or values.dtype == bool):
        raise SchemaError(f"{location} is {type(flat).__name__}; author float[]")
    values = values.astype(np.float64)
    interpolation = primvar.GetInterpolation()
    if len(values) == 1 and (interpolation not in _PER_VERTEX or count == 1):
        values = np.full(count, values[0])
    elif interpolation not in _PER_VERTEX or len(values) != count:
        message = f"{len(values)} values with {interpolation} interpolation on {count} points"
        raise SchemaError(f"{location} has {message}; author one value per point (vertex) or one for all (constant)")
    notices: tuple[Notice, ...] = ()
    if row is GARMENT["pin"] and (values > 1.0).any():  # Painted weights may exceed 1 by rounding.
        message = f"{row.name} goes up to {values.max():g}; values over 1 are taken as 1"
        values, notices = np.minimum(values, 1.0), (Notice(str(prim.GetPath()), None, message),)
    for index in (int(values.argmin()), int(values.argmax())) if count else ():  # Both find NaN first.
        check_limits(row, float(values[index]), f"{location}[{index}]")
    return values, notices


def _primvar(prim: Usd.Prim, name: str) -> UsdGeom.Primvar | None:
    """The authored primvar of a name, or of the name in Blender's export, without colons."""
    for spelled in (name, name.replace(":", "_")):
        primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(spelled)
        if primvar and primvar.HasAuthoredValue():
            return primvar
    return None
