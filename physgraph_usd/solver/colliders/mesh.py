"""Closest points on a moving triangle mesh, by Warp's bounding volume hierarchy, refitted for each pose.

Faces may pass through others, as in armpits and crotches of skinned bodies. A face with all corners outside the surface
and without self-intersection is wholly exposed: cloth can leave through all of it.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportIndexIssue=false
from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..mesh.kernels import KERNELS
from ..mesh.piercing import passes_through, wide
from ..mesh.stencil import add_at
from ..mesh.threads import argument, run
from ..mesh.topology import paired
from .base import Nearest, Solid
from .orient import FIXED, Pieces, pieces_of
from .pose import Pose, bounds_of, moved_rigidly

wp.set_module_options(KERNELS)

LIFT = 1e-4
"""Height above a vertex at which the surface is tested for being buried, relative to the surface's size."""
SHARES = wp.constant(256)
"""Threads that share the faces around a point."""
MOST_SUMMED = 2**28
"""Most pairs of a point and a face that a card sums; for more, each point walks the hierarchy, as on the CPU."""
ON_EDGE = 1e-4
"""Barycentric coordinate below which a point is on an edge."""


@wp.kernel
def _closest(
    first: wp.int32,
    mesh: wp.uint64,
    x: wp.array(dtype=wp.vec3f),
    reach: wp.array(dtype=wp.float32),
    distance: wp.array(dtype=wp.float32),
    point: wp.array(dtype=wp.vec3f),
    normal: wp.array(dtype=wp.vec3f),
    face: wp.array(dtype=wp.int32),
    weight: wp.array(dtype=wp.vec3f),
    side: wp.array(dtype=wp.float32),
):
    i = first + wp.tid()
    query = wp.mesh_query_point_sign_normal(mesh, x[i], reach[i])
    if query.result:
        closest = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        point[i] = closest
        distance[i] = wp.length(x[i] - closest)
        normal[i] = wp.mesh_eval_face_normal(mesh, query.face)
        face[i] = query.face
        weight[i] = wp.vec3f(query.u, query.v, 1.0 - query.u - query.v)
        side[i] = query.sign


@wp.kernel
def _winding(
    first: wp.int32,
    mesh: wp.uint64,
    x: wp.array(dtype=wp.vec3f),
    reach: wp.float32,
    number: wp.float32,
    side: wp.array(dtype=wp.float32),
):
    i = first + wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, x[i], reach, 2.0, number)
    if query.result:
        side[i] = query.sign


@wp.kernel
def _solid_angles(
    first: wp.int32,
    corners: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3f),
    x: wp.array(dtype=wp.vec3f),
    total: wp.array(dtype=wp.float32),
):
    """Each thread adds half the solid angles at a point of every `SHARES`-th face (van Oosterom and Strackee 1983)."""
    i = first + wp.tid()
    at, half = x[i // SHARES], wp.float32(0.0)
    for f in range(i % SHARES, corners.shape[0] // 3, SHARES):
        a, b, c = points[corners[3 * f]] - at, points[corners[3 * f + 1]] - at, points[corners[3 * f + 2]] - at
        la, lb, lc = wp.length(a), wp.length(b), wp.length(c)
        edges = la * lb * lc + wp.dot(a, b) * lc + wp.dot(b, c) * la + wp.dot(c, a) * lb
        half += wp.atan2(wp.dot(a, wp.cross(b, c)), edges)
    total[i] = half


@wp.kernel
def _meets(
    first: wp.int32,
    mesh: wp.uint64,
    start: wp.array(dtype=wp.vec3f),
    along: wp.array(dtype=wp.vec3f),
    reach: wp.float32,
    out: wp.array(dtype=wp.bool),
):
    i = first + wp.tid()
    query = wp.mesh_query_ray(mesh, start[i], along[i], reach)
    out[i] = query.result


class MeshSurface:
    """The closed or the open pieces of one mesh.

    Attributes:
        closed: True if the surface has an inside.
        fixed_side: Allowed side of an open surface, 1 along the normals or -1; None if the start decides.
        origin: World position of the origin of the surface's coordinates [m], shape (3,), float64.
        bounds: Least and greatest corner [m], shape (2, 3), float64.
        triangles: Corners, shape (T, 3), int32.
        solid: The triangles, numbered without unused vertices.
        world: World positions of the solid's corners [m], shape (B, 3), float64.
    """

    def __init__(
        self,
        pose: Pose,
        triangles: np.ndarray,
        rim: tuple[np.ndarray, np.ndarray] | None,
        *,
        side: str = "auto",
        device: str,
        threads: int,
    ) -> None:
        """Build the hierarchy on one pose.

        Args:
            pose: Any pose.
            triangles: The pieces' triangles, shape (T, 3).
            rim: Rim edges and rim corners of open pieces, or None for closed pieces.
            side: One of `schema.SIDES`.
            device: "cpu" or a CUDA device.
            threads: Most threads of a query on the CPU.
        """
        self.closed = rim is None
        self.fixed_side = None if self.closed else FIXED.get(side)
        self.triangles = triangles
        count = int(triangles.max(initial=-1)) + 1
        edges, edge = paired(triangles.ravel(), triangles[:, [1, 2, 0]].ravel(), count)
        self.device, self.threads = device, threads
        self._used, compact = np.unique(triangles, return_inverse=True)
        self.solid = Solid.of(pose.points[self._used], compact.reshape(-1, 3))
        self._rim = None if rim is None else [torch.as_tensor(mask, device=device) for mask in rim]
        self.corners = torch.as_tensor(triangles, device=device).long()
        # At a hole or where more than two faces meet, the other side of a face need not be inside.
        ragged = np.isin(triangles, edges[np.bincount(edge) != 2]).any(axis=1)
        self.ragged, self.has_holes = torch.as_tensor(ragged, device=device), bool(ragged.any())
        self.origin, self.bounds = np.zeros(3), np.zeros((2, 3))
        self.mesh = _hierarchy(wp.array(self._place(pose), dtype=wp.vec3f, device=device), triangles, self.closed)
        self._judged = self.world
        self._faces = Faces(self)

    @property
    def has_inside(self) -> bool:
        """True if a side is disallowed wherever cloth starts: inside a closed surface, or behind a fixed side."""
        return self.closed or self.fixed_side is not None

    @property
    def lift(self) -> float:
        """Height above a face at which the surface is tested for being buried [m]."""
        return LIFT * float(np.ptp(self.bounds, axis=0).max())

    def repose(self, pose: Pose) -> None:
        """Move the surface to a finite pose of equal topology; a rigid motion keeps cached self-intersections."""
        self.mesh.points.assign(self._place(pose))
        self.mesh.refit()
        rigid = moved_rigidly(self._judged, self.world)
        self._judged = self._judged if rigid else self.world
        self._faces = self._faces.turned() if rigid else Faces(self)

    def _place(self, pose: Pose) -> np.ndarray:
        """Recentre a pose; vertices without a face are moved to the origin."""
        used = pose.points.take(self._used, axis=0)
        used = self.world = np.where(np.isfinite(used), used, 0.0)
        low, high = bounds_of(used)
        self.origin = 0.5 * (low + high)
        local = np.zeros((len(pose.points), 3), np.float32)
        local[self._used] = used - self.origin
        self.bounds = np.stack([low, high]) - self.origin
        return local

    def placed(self, pose: Pose) -> np.ndarray | None:
        """World positions of the corners in a further pose [m]; None if the pose has a different number of points."""
        if len(pose.points) != len(self.mesh.points):
            return None
        points = pose.points.take(self._used, axis=0)
        return points if np.isfinite(points).all() else None

    def closest(self, x: Float[Tensor, "points 3"], reach: Float[Tensor, " points"] | None = None) -> Nearest:
        """The closest points within reach [m], or at any distance; the side is the pseudonormal's.

        The pseudonormal is by Baerentzen and Aanaes (2005).
        """
        return self._closest(self.mesh, x, reach)

    def _closest(self, mesh: wp.Mesh, x: Tensor, reach: Tensor | None = None) -> Nearest:
        count = len(x)
        reach = torch.full_like(x[:, 0], torch.inf) if reach is None else reach
        queries, limit = x.to(torch.float32).contiguous(), reach.to(torch.float32).contiguous()
        distance = torch.full((count,), float("inf"), dtype=torch.float32, device=x.device)
        point, normal, weight = (torch.zeros_like(queries) for _ in range(3))
        face = torch.zeros(count, dtype=torch.int32, device=x.device)
        side = torch.zeros_like(distance)
        if count:
            outputs = [argument(distance), *(_vectors(array) for array in (point, normal)), argument(face)]
            outputs += [_vectors(weight), argument(side)]
            self.run(_closest, mesh, count, [_vectors(queries), argument(limit), *outputs])
        rim = self._on_rim(face.long(), weight) & distance.isfinite()
        return Nearest(distance.to(x), point.to(x), normal.to(x), side.to(x), rim, face)

    def inside(self, x: Float[Tensor, "points 3"], *, parts: int = 1) -> Bool[Tensor, " points"]:
        """Mask of the points inside at least `parts` parts; all False for open surfaces.

        The number of parts is the generalised winding number (Barill et al. 2018), rounded. A card sums all faces for
        up to `MOST_SUMMED` pairs: one walk through the hierarchy takes a thread 2 ms.
        """
        side = torch.ones(len(x), dtype=torch.float32, device=x.device)
        if self.closed and x.is_cuda and len(x) * len(self.triangles) <= MOST_SUMMED:
            return self._turns(x) > parts - 0.5
        if self.closed and len(x):
            far = float(np.linalg.norm(np.ptp(self.bounds, axis=0))) + float(x.abs().max()) + 1.0
            queries = x.to(torch.float32).contiguous()
            inputs = [_vectors(queries), wp.float32(far), wp.float32(parts - 0.5), argument(side)]
            self.run(_winding, self.mesh, len(x), inputs)
        return side < 0

    def _turns(self, x: Float[Tensor, "points 3"]) -> Float[Tensor, " points"]:
        """Generalised winding number of the surface around each point."""
        half = torch.empty((len(x), int(SHARES)), dtype=torch.float32, device=x.device)
        queries, mesh = x.to(torch.float32).contiguous(), self.mesh
        inputs = [mesh.indices, mesh.points, _vectors(queries), argument(half.view(-1))]
        run(_solid_angles, half.numel(), inputs, device=self.device, threads=self.threads)
        return half.sum(dim=1) / (2.0 * torch.pi)

    def exit(self, x: Float[Tensor, "points 3"], nearest: Nearest) -> Nearest:
        """The closest points on exposed faces; where body parts overlap, the nearest face may be deep inside.

        A face is exposed if none of its corners is inside the surface. A part may still pierce the face's middle: a
        point with an exit inside such a part takes the closest unpierced face.
        """
        if not self.closed or not len(x):
            return nearest
        buried = bool(self._faces.is_buried(nearest.face).any())
        exits = self._closest_bare(x, nearest, unpierced=False) if buried else nearest
        doubtful = torch.nonzero(self._faces.is_unsure(exits.face)).squeeze(1)
        doubtful = doubtful[self.inside(exits.point[doubtful] + self.lift * exits.normal[doubtful])]
        if not len(doubtful):
            return exits
        return exits.with_points(doubtful, self._closest_bare(x[doubtful], exits.selected(doubtful), unpierced=True))

    def _closest_bare(self, x: Tensor, nearest: Nearest, *, unpierced: bool) -> Nearest:
        """The closest points on wholly exposed faces, or else on exposed faces; unchanged if there are none."""
        skin = self._faces.bare(unpierced)
        if skin is None:
            return nearest
        mesh, faces = skin
        bare = self._closest(mesh, x)
        return replace(bare, face=faces[bare.face.long()])

    def run(self, kernel: wp.Kernel, mesh: wp.Mesh, count: int, inputs: list[object]) -> None:
        """Launch over points in slices on several threads."""
        run(kernel, count, [mesh.id, *inputs], device=self.device, threads=self.threads)

    def _on_rim(self, face: Tensor, weight: Tensor) -> Bool[Tensor, " points"]:
        """Mask of the closest points on a rim edge or a rim vertex."""
        if self._rim is None:
            return torch.zeros(len(face), dtype=torch.bool, device=face.device)
        edges, corners = (mask[face] for mask in self._rim)
        low = weight < ON_EDGE
        at_corner = weight > 1.0 - 2.0 * ON_EDGE
        return (edges & low).any(dim=1) | (corners & at_corner).any(dim=1)


class Faces:
    """Cached properties of a surface's faces in one pose: buried, intersecting, or exposed.

    Each vertex and each face is tested once. A rigid motion of the surface keeps its self-intersections.
    """

    def __init__(self, surface: MeshSurface) -> None:
        """Start with empty caches."""
        self._surface, device = surface, surface.corners.device
        self._tested, self._buried = torch.zeros((2, len(surface.mesh.points)), dtype=torch.bool, device=device)
        self._overlaps = torch.full((len(surface.corners),), -1, dtype=torch.int8, device=device)
        self._skins: dict[bool, tuple[wp.Mesh, Tensor]] = {}

    def turned(self) -> Faces:
        """The properties that remain valid after a rigid motion."""
        faces = Faces(self._surface)
        faces._tested, faces._buried, faces._overlaps = self._tested, self._buried, self._overlaps
        return faces

    def is_buried(self, face: Tensor) -> Bool[Tensor, " points"]:
        """Mask of the faces with a corner inside the surface; each corner is tested once a pose."""
        corners = self._surface.corners[face.long()]
        new = torch.unique(corners[~self._tested[corners]])
        self._buried[new] = self._lifted_inside(new)
        self._tested[new] = True
        return self._buried[corners].any(dim=1)

    def is_unsure(self, face: Tensor) -> Bool[Tensor, " points"]:
        """Mask of the faces at a hole or with self-intersections; each face is tested once a pose."""
        face = face.long()
        new = torch.unique(face[self._overlaps[face] < 0])
        pierced = overlapping(self._surface.mesh, new, threads=self._surface.threads)
        self._overlaps[new] = (pierced | self._surface.ragged[new]).to(torch.int8)
        return self._overlaps[face] > 0

    def _lifted_inside(self, vertices: Tensor) -> Bool[Tensor, " vertices"]:
        """Mask of the vertices with an inside point just above.

        On a surface without holes, a vertex whose normal ray meets no face is outside, without a winding number.
        """
        out = torch.zeros(len(vertices), dtype=torch.bool, device=vertices.device)
        if not len(vertices):
            return out
        size, up = np.ptp(self._surface.bounds, axis=0), self._normals[vertices]
        lifted = wp.to_torch(self._surface.mesh.points)[vertices] + LIFT * float(size.max()) * up
        if self._surface.has_holes:
            return self._surface.inside(lifted)
        far = wp.float32(2.0 * float(np.linalg.norm(size)))
        self._surface.run(
            _meets, self._surface.mesh, len(vertices), [_vectors(lifted), _vectors(up), far, argument(out)]
        )
        met = torch.nonzero(out | (up == 0.0).all(dim=1)).squeeze(1)  # Flat faces have no normal to look along.
        out[met] = self._surface.inside(lifted[met])
        return out

    @cached_property
    def _normals(self) -> Float[Tensor, "vertices 3"]:
        """Unit normals of the vertices."""
        points = wp.to_torch(self._surface.mesh.points)
        a, b, c = (points[self._surface.corners[:, corner]] for corner in range(3))
        area = torch.linalg.cross(b - a, c - a)
        normal = torch.zeros_like(points)
        for corner in range(3):
            add_at(normal, self._surface.corners[:, corner], area)
        return torch.nn.functional.normalize(normal, dim=1, eps=1e-30)

    def bare(self, unpierced: bool) -> tuple[wp.Mesh, Tensor] | None:
        """Mesh and indices of the exposed faces, only of wholly exposed faces if ``unpierced``; None without any."""
        if unpierced not in self._skins:
            every = torch.arange(len(self._surface.corners), device=self._surface.device)
            hidden = self.is_buried(every)
            faces = torch.nonzero(~(hidden | self.is_unsure(every)) if unpierced else ~hidden).squeeze(1)
            if not len(faces):
                return None
            triangles = self._surface.triangles[faces.cpu().numpy()]
            self._skins[unpierced] = (_hierarchy(self._surface.mesh.points, triangles, False), faces.to(torch.int32))
        return self._skins[unpierced]


class MeshBody:
    """One mesh collider over the shot; its surfaces are kept while the topology is unchanged."""

    def __init__(self, *, side: str = "auto", device: str, threads: int) -> None:
        """Prepare a collider without a pose; ``side`` is one of `schema.SIDES`."""
        self._side, self._device, self._threads = side, device, threads
        self._triangles: np.ndarray | None = None
        self._points = np.zeros((0, 3))
        self._surfaces: tuple[MeshSurface, ...] = ()

    def pose(self, pose: Pose) -> tuple[MeshSurface, ...]:
        """The closed and the open surface at one time code, without empty surfaces."""
        same = self._triangles is not None and (
            pose.triangles is self._triangles or np.array_equal(pose.triangles, self._triangles)
        )
        finite = bool(np.isfinite(pose.points).all())
        if same and pose.points.shape == self._points.shape and finite:
            if not np.array_equal(pose.points, self._points):  # A body at rest keeps its cached properties.
                for surface in self._surfaces:
                    surface.repose(pose)
            self._points = pose.points.copy()
            return self._surfaces
        pieces = pieces_of(pose.points, pose.triangles, side=self._side)
        self._surfaces = tuple(self._build(pose, pieces))
        self._triangles, self._points = (pose.triangles if finite else None), pose.points.copy()
        return self._surfaces

    def _build(self, pose: Pose, pieces: Pieces) -> list[MeshSurface]:
        rims = (None, (pieces.rim, pieces.rim_vertex))
        return [
            MeshSurface(pose, triangles, rim, side=self._side, device=self._device, threads=self._threads)
            for triangles, rim in zip((pieces.closed, pieces.open), rims, strict=True)
            if len(triangles)
        ]


def _hierarchy(points: wp.array, triangles: np.ndarray, closed: bool) -> wp.Mesh:
    """Warp mesh, with winding numbers only if the surface has an inside."""
    indices = wp.array(triangles.ravel(), dtype=wp.int32, device=points.device)
    return wp.Mesh(points=points, indices=indices, support_winding_number=closed)


def _vectors(tensor: Tensor) -> Any:
    return argument(tensor, wp.vec3f)


@wp.func
def _pierces(x: wp.array(dtype=wp.vec3f), t: wp.vec3i, u: wp.vec3i):
    """True if a side of triangle t that shares no corner's place with triangle u passes through u."""
    pierced = bool(False)  # noqa: UP018 - a literal would be a constant to Warp
    p, q, r = wide(x[u[0]]), wide(x[u[1]]), wide(x[u[2]])
    for side in range(3):
        a, b = wide(x[t[side]]), wide(x[t[(side + 1) % 3]])
        beside = a == p or a == q or a == r or b == p or b == q or b == r  # noqa: PLR1714 - Warp has no `in`
        if not beside and passes_through(a, b, u, p, q, r):
            pierced = True
    return pierced


@wp.kernel
def _overlap(
    first: wp.int32,
    mesh: wp.uint64,
    ask: wp.array(dtype=wp.int32),
    x: wp.array(dtype=wp.vec3f),
    corners: wp.array(dtype=wp.int32),
    out: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    f = ask[i]
    t = wp.vec3i(corners[3 * f], corners[3 * f + 1], corners[3 * f + 2])
    a, b, c = x[t[0]], x[t[1]], x[t[2]]
    query = wp.mesh_query_aabb(mesh, wp.min(a, wp.min(b, c)), wp.max(a, wp.max(b, c)))
    g = wp.int32(0)
    pierced = wp.int32(0)
    while wp.mesh_query_aabb_next(query, g):
        if pierced == 0 and g != f:
            u = wp.vec3i(corners[3 * g], corners[3 * g + 1], corners[3 * g + 2])
            if _pierces(x, t, u) or _pierces(x, u, t):
                pierced = 1
    out[i] = pierced


def overlapping(mesh: wp.Mesh, faces: Int[Tensor, " faces"], *, threads: int = 1) -> Bool[Tensor, " faces"]:
    """Mask of the faces that pass through other faces of the mesh.

    Args:
        faces: Indices of the faces to test.
        threads: Most threads on the CPU.
    """
    out = torch.zeros(len(faces), dtype=torch.int32, device=faces.device)
    if len(faces):
        ask = faces.to(torch.int32).contiguous()
        inputs = [mesh.id, wp.from_torch(ask), mesh.points, mesh.indices, wp.from_torch(out)]
        run(_overlap, len(faces), inputs, device=str(faces.device), threads=threads)
    return out > 0
