"""Reads colliders from meshes, primitives and point instancers: triangles posed in world metres.

A mesh is read as rendered: without holes, and subdivided by its scheme; a TetMesh is its surface. A point instancer is
the triangles of its instances; a prim below an instancer is drawn at the instances only. An unusable pose is left out
at its time, with a notice. A primitive transformed into a shape without a name, such as an ellipsoid, becomes a mesh.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from ...solver.colliders.orient import FIXED
from ...solver.colliders.pose import Collider, Pose
from ...solver.colliders.primitives import AROUND, KINDS, primitive, segments
from ...solver.mesh.subdivide import ControlMesh
from ...solver.mesh.topology import PolygonMesh
from ...solver.scene import FARTHEST, out_of_bounds
from ..instances import instanced_gprims, instancer_above, placements
from ..lookup import Override, find_token, find_value, is_on
from ..mesh.drawn import MOST_VERTICES, DrawnSurface, drawn_surface
from ..schema import COLLIDER, GARMENT
from ..stage import Notice, timecode, value_at
from ..times import is_animated
from .absence import missing_value
from .find import is_drawn
from .placement import is_affine, is_flipped, place

DRAWN_NEAR = 0.1
"""Largest error of a body's surface relative to the contact offset: a smaller error is invisible behind the offset."""
DRAWN_WITHIN = DRAWN_NEAR * float(GARMENT["contact:offset"].fallback or 0.0)
"""Largest error of a body's surface at the usual contact offset [m]."""
_LEAST_OFFSET = 1e-3
"""Least offset for choosing a body's subdivision [m]: an offset of 0 would ask for unlimited subdivision."""
MOST_INSTANCED = 1_000_000
"""Most vertices of an instancer's instances near the cloth, 40 times those of a mesh: a body's hierarchy is built once
and refitted in each frame in which an instance moves."""
_PLANE_START = ("plane", "start")

UPRIGHT = {
    "X": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "Y": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "Z": np.eye(3),
}
"""For each axis token, the matrix turning a shape about its third axis to the axis."""


@dataclass(frozen=True, eq=False)
class _Faces:
    """Authored topology arrays of a mesh, the drawn faces, their triangles as authored and reversed, and notices."""

    authored: tuple[np.ndarray, ...]
    drawn: DrawnSurface
    wound: tuple[np.ndarray, np.ndarray]
    notices: tuple[Notice, ...]

    @cached_property
    def authored_triangles(self) -> np.ndarray:
        """Triangles of the authored faces that are no holes, shape (T, 3)."""
        counts, indices, _ = self.authored
        split = PolygonMesh(counts, indices, int(indices.max()) + 1).triangulate()
        return split.triangles[np.isin(split.face, self.drawn.parents)]


@dataclass(frozen=True, eq=False)
class Polygons:
    """A subdivided body's authored polygons at one time code, without holes.

    Attributes:
        points: World positions [m], shape (V, 3).
        limit: Positions of the same points on the limit surface [m], shape (V, 3).
        triangles: Corners of the polygons' triangles, shape (T, 3).
    """

    points: np.ndarray
    limit: np.ndarray
    triangles: np.ndarray


@dataclass(eq=False)
class ColliderReader:
    """A collider with everything needed for posing.

    Attributes:
        prim: A gprim or a point instancer.
        collider: Constant data.
        within: Allowed distance of the mesh from the drawn surface [m].
        always: Whether the collider counts even while invisible.
        instancer: Outermost point instancer that draws the prim; None for a gprim in its own place.
        parts: Gprims at the instances, by path.
        near: Bounds of the cloth over the shot [m], shape (2, 3): instances beyond are left out; None keeps all.
        unit: Length of the longest unit of a part's space at any instance [m]; None for a gprim in its own place.
    """

    prim: Usd.Prim
    collider: Collider
    metres: float
    within: float = DRAWN_WITHIN
    always: bool = False
    instancer: Usd.Prim | None = None
    parts: Mapping[Sdf.Path, ColliderReader] = field(default_factory=dict)
    near: np.ndarray | None = None
    unit: float | None = None
    _faces: _Faces | None = None
    _triangles: np.ndarray | None = None
    _tets: tuple[np.ndarray, np.ndarray] | None = None

    def on_side(self, side: str) -> ColliderReader:
        """A reader of the collider on a different side, one of `schema.SIDES`."""
        parts = {path: part.on_side(side) for path, part in self.parts.items()}
        return replace(self, collider=replace(self.collider, side=side), parts=parts)

    def pose(self, time: float | None, skinned: np.ndarray | None = None) -> tuple[Pose | None, tuple[Notice, ...]]:
        """Pose at a time code, interpolated like USD; None, with a notice, without a usable pose.

        Args:
            skinned: World positions of a mesh's points [m], to replace the authored points; or None.
        """
        visibility = UsdGeom.Imageable(self.instancer or self.prim).ComputeVisibility(timecode(time))
        if not self.always and visibility == UsdGeom.Tokens.invisible:
            message = f"no collider where it is invisible, unless {COLLIDER['collider:enabled'].name} is set to true"
            return None, (Notice(self.collider.path, None, message),)
        if self.instancer is not None:
            pose, notices = self._instances(self.instancer, time)
        elif time is not None and (reason := missing_value(self.prim, time)):
            return None, (self._out(time, reason),)
        else:
            pose, notices = self._placed(self._matrix(timecode(time)), time, skinned)
        if pose is None:
            return None, notices
        pose, beyond = self._bounded(pose, time)
        return pose, (*notices, *beyond)

    def _placed(
        self, matrix: np.ndarray, time: float | None, skinned: np.ndarray | None = None
    ) -> tuple[Pose | None, tuple[Notice, ...]]:
        """A gprim placed by a matrix from its own space to world metres, shape (4, 4)."""
        if not matrix[:3, :3].any():
            return None, (self._out(time, "its transform to the world scales it to nothing"),)
        if not np.isfinite(matrix).all() or not is_affine(matrix):
            return None, (self._out(time, "its transform to the world is not an affine one"),)
        if self.collider.kind == "mesh":
            return self._mesh(matrix, time, skinned)
        return self._shape(matrix, time)

    def _instances(self, instancer: Usd.Prim, time: float | None) -> tuple[Pose | None, tuple[Notice, ...]]:
        """The triangles of all instances near the cloth; an instance of scale 0 is not drawn."""
        matrices = placements(instancer, time)
        if matrices is None:
            return None, (self._out(time, f"arrays of <{instancer.GetPath()}> do not fit together"),)
        notices: dict[Notice, None] = {}
        poses: list[Pose] = []
        count = 0
        for path, part in self.parts.items():
            for matrix in part._near(matrices.get(path, np.zeros((0, 4, 4))), time, self.near):
                pose, part_notices = part._placed(matrix, time)
                notices |= dict.fromkeys(part_notices)
                poses += [] if pose is None else [pose]
                count += 0 if pose is None else len(pose.points)
                if count > MOST_INSTANCED:
                    reason = (
                        f"its instances near the cloth have over {MOST_INSTANCED:,} vertices; hide those that no cloth"
                    )
                    return None, (self._out(time, f"{reason} touches by invisibleIds, or refine with less of them"),)
        if not poses:
            return None, tuple(notices)
        firsts = np.cumsum([0, *(len(pose.points) for pose in poses[:-1])])
        shifted = [pose.triangles + np.int32(first) for pose, first in zip(poses, firsts, strict=True)]
        triangles = np.concatenate(shifted)
        if self._triangles is None or not np.array_equal(self._triangles, triangles):
            self._triangles = triangles
        return Pose(np.concatenate([pose.points for pose in poses]), self._triangles), tuple(notices)

    def _near(self, matrices: np.ndarray, time: float | None, bounds: np.ndarray | None) -> np.ndarray:
        """Matrices to world metres, shape (N, 4, 4), of the instances with bounds that meet the given bounds [m]."""
        scaled = matrices.copy()
        scaled[:, :3] *= self.metres
        scaled = scaled[np.isfinite(scaled).all(axis=(1, 2)) & scaled[:, :3, :3].any(axis=(1, 2))]
        local = self._placed(np.eye(4), time)[0] if bounds is not None and len(scaled) else None
        if local is None or bounds is None or not len(local.points):
            return scaled
        ends = np.stack([np.nanmin(local.points, axis=0), np.nanmax(local.points, axis=0)])
        corners = np.array([[ends[i, 0], ends[j, 1], ends[k, 2]] for i, j, k in product((0, 1), repeat=3)])
        world = np.einsum("nxy,cy->ncx", scaled[:, :3, :3], corners) + scaled[:, None, :3, 3]
        return scaled[(world.min(axis=1) <= bounds[1]).all(axis=1) & (bounds[0] <= world.max(axis=1)).all(axis=1)]

    def _matrix(self, code: Usd.TimeCode) -> np.ndarray:
        matrix = np.array(UsdGeom.XformCache(code).GetLocalToWorldTransform(self.prim), dtype=np.float64).T
        matrix[:3] *= self.metres
        return matrix

    def _mesh(
        self, matrix: np.ndarray, time: float | None, skinned: np.ndarray | None
    ) -> tuple[Pose | None, tuple[Notice, ...]]:
        points = positions(self.prim, time)
        read = _surface_of_tets(self, time) if UsdGeom.TetMesh(self.prim) else _topology(self.prim, time)
        counts, indices, holes = read
        if (
            not len(indices)
            or counts.sum() != len(indices)
            or counts.min() < 0
            or indices.min() < 0
            or indices.max() >= len(points)
        ):
            return None, (self._out(time, "its points and faces do not fit together"),)
        faces = self._faces_of(points, (counts, indices, holes))
        triangles = faces.wound[self.collider.side in FIXED and is_flipped(self.prim, matrix)]
        placed = place(np.where(np.isfinite(points), points, np.nan).astype(np.float64), matrix)
        if skinned is not None and skinned.shape == placed.shape:
            placed = skinned
        return Pose(faces.drawn.place(placed), triangles), faces.notices

    def polygons(self, time: float | None) -> Polygons | None:
        """The authored polygons at a time code; None for a body that is drawn as authored, or without a pose."""
        pose, faces = self.pose(time)[0], self._faces
        if pose is None or faces is None or faces.drawn.stencil is None:
            return None
        placed = authored_points(self, time)
        return Polygons(placed, pose.points[: len(placed)], faces.authored_triangles)

    def _faces_of(self, points: np.ndarray, authored: tuple[np.ndarray, ...]) -> _Faces:
        """The drawn faces; cached while the topology stays the same.

        Subdivision uses the collider's first sample, whichever frame is read first; polygons are fans, as drawn.
        """
        if self._faces is None or not all(map(np.array_equal, self._faces.authored, authored)):
            counts, indices, holes = authored
            attribute = UsdGeom.PointBased(self.prim).GetPointsAttr()
            first = np.asarray(attribute.Get(Usd.TimeCode.EarliestTime()))
            fits = first.shape == points.shape and first.dtype.kind in "fiu"
            first = np.nan_to_num((first if fits else points).astype(np.float64))
            polygons, within = PolygonMesh(counts, indices, len(points)), self.within / self._scale()
            drawn = surface_of(self.prim, polygons, first, holes=holes, within=within)
            triangles = drawn.mesh.triangulate().triangles
            wound = triangles, np.ascontiguousarray(triangles[:, ::-1])
            self._faces = _Faces(authored, drawn, wound, self._coarse(drawn))
        return self._faces

    def _scale(self) -> float:
        """Length in metres of the longest unit of the prim's space, in the first sample."""
        if self.unit is not None:
            return self.unit
        linear = self._matrix(Usd.TimeCode.EarliestTime())[:3, :3]
        return float(np.linalg.norm(linear, 2)) if np.isfinite(linear).all() and linear.any() else self.metres

    def _coarse(self, drawn: DrawnSurface) -> tuple[Notice, ...]:
        """A notice of a too coarse mesh: its drawn surface would show through cloth at the contact offset."""
        error = drawn.error * self._scale()
        if error <= self.within / DRAWN_NEAR:
            return ()
        message = f"its faces lie up to {1e3 * error:.2g} mm off the smooth surface that is drawn: more subdivisions"
        return (Notice(self.collider.path, None, f"{message} would give it over {MOST_VERTICES:,} vertices"),)

    def _shape(self, matrix: np.ndarray, time: float | None) -> tuple[Pose | None, tuple[Notice, ...]]:
        kind, size, axes = _measures(self.prim, time)
        if axes is None or not (np.isfinite(size).all() and (size >= 0).all()):
            return None, (self._out(time, "its sizes or its axis are none that a shape can have"),)
        linear = matrix[:3, :3] @ axes
        if kind == "plane":
            linear = linear / max(float(np.abs(linear).max()), np.finfo(float).tiny)  # A scale's cube can overflow.
            normal = np.cross(linear[:, 0], linear[:, 1]) * np.sign(np.linalg.det(linear) or 1.0)
            if not np.linalg.norm(normal) > 0:
                return None, (self._out(time, "its transform flattens it"),)
            linear = _frame_about(normal)
        around = AROUND if self.unit is None else segments(float(size[:2].max()) * self.unit, self.within)
        return primitive(kind, size, turn=linear, centre=matrix[:3, 3], around=around), ()

    def _bounded(self, pose: Pose, time: float | None) -> tuple[Pose | None, tuple[Notice, ...]]:
        """The pose without out-of-bounds parts: without the faces at such points, or None for a primitive."""
        if not (message := out_of_bounds(pose.corners())):
            return pose, ()
        if self.collider.kind != "mesh":
            return None, (self._out(time, message),)
        near = np.asarray((np.abs(pose.points) <= FARTHEST).all(axis=1))
        message = f"{message}; faces with it, and with {(~near).sum() - 1} more such, are left out"
        near_pose = Pose(np.where(near[:, None], pose.points, np.nan), pose.triangles)
        return near_pose, (Notice(self.collider.path, time, message),)

    def _out(self, time: float | None, reason: str) -> Notice:
        return Notice(self.collider.path, time, f"this collider is left out here: {reason}")


def authored_points(body: ColliderReader, time: float | None) -> np.ndarray:
    """World positions of a mesh's authored points [m], shape (V, 3); for other bodies points of the pose, if any."""
    if body.collider.kind != "mesh" or body.instancer is not None:
        pose = body.pose(time)[0]
        return np.zeros((0, 3)) if pose is None else pose.points
    return place(positions(body.prim, time).astype(np.float64), body._matrix(timecode(time)))


def positions(prim: Usd.Prim, time: float | None) -> np.ndarray:
    """A prim's authored points at a time code in stage units, shape (V, 3); V is 0 if they are no positions."""
    points = _array(UsdGeom.PointBased(prim).GetPointsAttr(), time)
    return points if points.ndim == 2 and points.shape[1] == 3 else np.zeros((0, 3))


def read_collider(
    prim: Usd.Prim,
    metres: float,
    *,
    overrides: Sequence[Override],
    offset: float,
    beside: Usd.Prim | None = None,
    near: np.ndarray | None = None,
) -> tuple[ColliderReader | None, tuple[Notice, ...]]:
    """Reader of a gprim or a point instancer as a collider, or None for an unsupported kind of prim, and notices.

    Args:
        offset: Least distance kept from colliders by a garment [m].
        beside: A garment; drawn by the same point instancer as the collider, it meets the collider in its own place.
        near: Bounds of the cloth over the shot [m], shape (2, 3): instances beyond are left out; None keeps all.

    Raises:
        SchemaError: When the collider's offset or side is invalid.
    """
    path, kind = str(prim.GetPath()), kind_of(prim)
    instancer = instancer_above(prim, beside) or (prim if kind == "instancer" else None)
    if kind is None:
        return None, (Notice(path, None, f"{unread(prim)}; left out"),)
    own_offset = find_value(prim, COLLIDER["collider:offset"], overrides).at(None) or 0.0
    side, _ = find_token(prim, COLLIDER["collider:side"], overrides)
    notices = (
        (Notice(path, None, "a plane has no start side; its front is used"),) if (kind, side) == _PLANE_START else ()
    )
    within = DRAWN_NEAR * max(offset + own_offset, _LEAST_OFFSET)
    always = find_value(prim, COLLIDER["collider:enabled"], overrides).source != "fallback"
    collider = Collider(path, kind if instancer is None else "mesh", own_offset, side)
    reader = ColliderReader(prim, collider, metres, within, always, instancer, near=near)
    if instancer is None:
        return reader, notices
    reader.parts, unread_parts = parts_of(reader, instancer, overrides)
    return (reader if reader.parts else None), (*notices, *unread_parts)


def parts_of(
    reader: ColliderReader, instancer: Usd.Prim, overrides: Sequence[Override] = ()
) -> tuple[dict[Sdf.Path, ColliderReader], tuple[Notice, ...]]:
    """Readers of the gprims at an instancer's instances, and a notice for each that is not read."""
    gprims = instanced_gprims(reader.prim) if UsdGeom.PointInstancer(reader.prim) else [reader.prim]
    gprims = [prim for prim in gprims if is_on(prim, COLLIDER["collider:enabled"], overrides)]
    parts, notices = {}, []
    for prim in [gprim for gprim in gprims if is_drawn(gprim)] or gprims:
        kind = kind_of(prim)
        if kind is None or kind == "plane":
            reason = "a Plane is endless; put a Mesh in its place" if kind else unread(prim)
            notices.append(
                Notice(reader.collider.path, None, f"instances of <{prim.GetPath()}> are left out: {reason}")
            )
            continue
        collider = replace(reader.collider, kind=kind)
        parts[prim.GetPath()] = ColliderReader(prim, collider, reader.metres, reader.within, unit=reader.metres)
    if not gprims:
        message = f"the prototypes of <{instancer.GetPath()}> have no shapes; left out"
        notices.append(Notice(reader.collider.path, None, message))
    for path, matrices in (placements(instancer, None) or {}).items():
        if path in parts and np.isfinite(matrices).all() and matrices[:, :3, :3].any():
            parts[path].unit = reader.metres * float(np.linalg.norm(matrices[:, :3, :3], 2, axis=(1, 2)).max())
    return parts, tuple(notices)


def kind_of(prim: Usd.Prim) -> str | None:
    """Kind of a body: "mesh", "instancer" or one of `KINDS`; None for a shape that is not read."""
    if UsdGeom.PointInstancer(prim):
        return "instancer"
    kind = str(prim.GetTypeName()).removesuffix("_1").lower()
    return "mesh" if UsdGeom.Mesh(prim) or UsdGeom.TetMesh(prim) else kind if kind in KINDS else None


def unread(prim: Usd.Prim) -> str:
    """The message of a shape that is not read, with the remedy."""
    return f"a {prim.GetTypeName()} is no collider that cloth can rest on: convert it to a Mesh"


def surface_of(
    prim: Usd.Prim,
    polygons: PolygonMesh,
    points: np.ndarray,
    *,
    holes: np.ndarray,
    within: float,
    levels: int | None = None,
) -> DrawnSurface:
    """A mesh's faces as drawn.

    Args:
        prim: The mesh, with scheme, creases and corners; a TetMesh has none of these.
        polygons: Its faces.
        points: Its points in any pose, shape (V, 3).
        holes: Numbers of the faces that are holes.
        within: Allowed distance from the limit surface, in the points' unit.
        levels: Number of subdivisions; None chooses by ``within``.
    """
    mesh = UsdGeom.Mesh(prim)
    if not mesh:
        return DrawnSurface(polygons, np.arange(polygons.face_count))
    scheme = str(mesh.GetSubdivisionSchemeAttr().Get())
    cage = ControlMesh(polygons, *sharpness_of(mesh, polygons.vertex_count))
    return drawn_surface(cage, points, holes=holes, scheme=scheme, within=within, levels=levels)


def sharpness_of(mesh: UsdGeom.Mesh, vertex_count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ends of the crease edges, shape (C, 2), their sharpness, shape (C,), and that of each vertex, shape (V,).

    Creases or corners with inconsistent arrays are dropped.
    """
    ends, sharpness = np.zeros((0, 2), np.int32), np.zeros(0)
    attributes = (mesh.GetCreaseIndicesAttr(), mesh.GetCreaseLengthsAttr(), mesh.GetCreaseSharpnessesAttr())
    indices, lengths, sharpnesses = map(_numbers, attributes, ("iu", "iu", "iuf"))
    if len(lengths) and lengths.min() >= 2 and lengths.sum() == len(indices):
        chain = np.repeat(np.arange(len(lengths)), lengths)
        along = np.flatnonzero(chain[1:] == chain[:-1])
        sharpnesses = (
            sharpnesses[chain[along]] if len(sharpnesses) == len(lengths) else sharpnesses
        )  # One value per crease, or one per edge.
        if len(sharpnesses) == len(along):
            ends = np.stack([indices[along], indices[along + 1]], axis=1)
            inside = ((ends >= 0) & (ends < vertex_count)).all(axis=1)
            ends, sharpness = ends[inside], sharpnesses[inside]
    corners = np.zeros(vertex_count)
    vertices, sharpnesses = map(_numbers, (mesh.GetCornerIndicesAttr(), mesh.GetCornerSharpnessesAttr()), ("iu", "iuf"))
    if len(vertices) == len(sharpnesses):
        inside = (vertices >= 0) & (vertices < len(corners))
        corners[vertices[inside]] = sharpnesses[inside]
    return ends, sharpness, corners


def _surface_of_tets(body: ColliderReader, time: float | None) -> tuple[np.ndarray, ...]:
    """Counts, corners and holes of a TetMesh's surface, as authored or from the tetrahedra.

    A surface from tetrahedra is cached while they stay the same: USD takes a second for 150,000.
    """
    mesh = UsdGeom.TetMesh(body.prim)
    surface, tets = (
        _array(mesh.GetSurfaceFaceVertexIndicesAttr(), time, "iu"),
        _array(mesh.GetTetVertexIndicesAttr(), time, "iu"),
    )
    if not len(surface) and len(tets):
        if body._tets is None or not np.array_equal(body._tets[0], tets):
            codes = timecode(time), Usd.TimeCode.EarliestTime()
            faces = next(filter(len, (UsdGeom.TetMesh.ComputeSurfaceFaces(mesh, code) for code in codes)), ())
            body._tets = tets, np.asarray(faces, np.int32)
        surface = body._tets[1]
    return np.full(len(surface), 3), surface.reshape(-1), np.zeros(0, np.int32)


def _topology(prim: Usd.Prim, time: float | None) -> tuple[np.ndarray, ...]:
    """Counts, corners and holes of a Mesh's faces at a time code."""
    mesh = UsdGeom.Mesh(prim)
    attributes = (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr(), mesh.GetHoleIndicesAttr())
    return tuple(_numbers(attribute, "iu", time) for attribute in attributes)


def _numbers(attribute: Usd.Attribute, kinds: str, time: float | None = None) -> np.ndarray:
    """An attribute's list of numbers of some of numpy's kinds; empty for anything else."""
    array = _array(attribute, time, kinds)
    return array if array.ndim == 1 else np.zeros(0, np.int32)


def _array(attribute: Usd.Attribute, time: float | None, kinds: str = "fiu") -> np.ndarray:
    """An attribute's array of numbers of some of numpy's kinds at a time code; empty for anything else."""
    value = value_at(attribute, time)
    array = np.zeros(0, np.int32) if np.ndim(value) == 0 else np.asarray(value)
    return array if array.dtype.kind in kinds else np.zeros(0, np.int32)


def _measures(prim: Usd.Prim, time: float | None) -> tuple[str, np.ndarray, np.ndarray | None]:
    """Kind, half sizes in stage units, and the matrix with the shape's axes in the prim's space as columns.

    A non-numeric size is NaN, and an unknown axis token gives None instead of the matrix.
    """

    def number(name: str, fallback: float) -> float:
        attribute = prim.GetAttribute(name)
        value = value_at(attribute, time) if attribute else None
        if value is None and not (attribute and is_animated(attribute)):
            return fallback
        return float(value) if isinstance(value, int | float) else np.nan

    kind = str(prim.GetTypeName()).removesuffix("_1").lower()
    half_height = 0.5 * number("height", 1.0 if kind == "capsule" else 2.0)
    radius = 0.5 if kind == "capsule" else 1.0
    tapered = str(prim.GetTypeName()).endswith("_1")
    radii = [number(name, radius) for name in (("radiusBottom", "radiusTop") if tapered else ("radius", "radius"))]
    half = 0.5 * number("size", 2.0)
    size = {"sphere": [*radii, radii[0]], "cube": [half] * 3}.get(kind, [*radii, half_height])
    axis = prim.GetAttribute("axis").Get() if prim.GetAttribute("axis") else "Z"
    return kind, np.array(size, dtype=np.float64), UPRIGHT.get(str(axis or "Z"))


def _frame_about(normal: np.ndarray) -> np.ndarray:
    """A rotation with a given direction as third column."""
    third = normal / np.linalg.norm(normal)
    first = np.cross(np.eye(3)[np.abs(third).argmin()], third)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(third, first), third], axis=1)
