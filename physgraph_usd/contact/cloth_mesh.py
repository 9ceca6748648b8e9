"""One level's cloth as something that can be near itself: closest faces and edges, crossings, and where to look."""

# Warp's arrays are typed by values that only Warp reads.
# pyright: reportArgumentType=false
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..collide.cluster_kernels import clusters_beside
from ..collide.clusters import ClusteredParts
from ..collide.crossings import Crossings, crossings
from ..collide.parts import Parts
from ..level import Level
from ..mesh.lanes import Launch
from ..mesh.topology import adjacency, find_edges, joined_by, owned_sides
from .again import found_again
from .beside import add_neighbours, beside_table
from .folds import in_sharp_folds
from .nearest import Nearest, Pairs
from .proximity import edges_near, faces_near, vertex_normals


@dataclass(frozen=True, eq=False)
class _Own:
    """What makes no pairs with each vertex, as kernels read it.

    Attributes:
        rings: Where the vertices beside each begin, and those.
        faces: The faces of clusters with one of them or the vertex itself as a corner, as `beside_table` gives them.
        edges: The edges.
    """

    rings: list[wp.array]
    faces: tuple[wp.array, ...]
    edges: tuple[wp.array, ...]


_Asked = tuple[Bool[Tensor, " vertices"], _Own]
"""Vertices that are asked, and what makes no pairs with them."""


class ClothMesh:
    """The faces and edges of a level in a hierarchy that moves with them.

    Attributes:
        level: The level.
        beside: Adjacency of its vertices, also across seams, shape (V, V).
        sewn: Pairs of vertices taken for one, shape (N, 2).
        opposite: Vertices opposite each edge in the first two of its faces, -1 where there is none, shape (E, 2).
    """

    def __init__(self, level: Level, meets: np.ndarray) -> None:
        """Build the hierarchy at the rest shape.

        Args:
            level: The level.
            meets: Which garments feel which, symmetric, shape (G, G), bool.
        """
        self.level = level
        wp.init()
        edges, triangles = (each.cpu().numpy() for each in (level.edges, level.triangles))
        self.beside = adjacency(edges, level.vertex_count)
        self._garments = len(level.spans)
        self._position = level.rest.to(torch.float32).contiguous().clone()
        self._normal = torch.zeros_like(self._position)
        self.triangles = level.triangles.long()
        self._clusters = ClusteredParts(level, self.beside, owned_sides(edges, triangles), meets=meets)
        self.opposite = torch.as_tensor(_opposite(edges, triangles), device=level.device)
        self._rest = level.rest.to(torch.float32).contiguous()
        self._apart, self.sewn = self.beside, np.zeros((0, 2), np.int64)
        self._take_neighbours(sp.identity(level.vertex_count, dtype=np.float32, format="csr"))
        corner = np.argsort(triangles.ravel(), kind="stable")
        starts = np.concatenate([[0], np.cumsum(np.bincount(triangles.ravel(), minlength=level.vertex_count))])
        about = [wp.array(each.astype(np.int32), dtype=wp.int32, device=level.device) for each in (starts, corner // 3)]
        self._triangles = wp.array(triangles, dtype=wp.vec3i, device=level.device)
        self._edges = wp.array(edges, dtype=wp.vec2i, device=level.device)
        about.append(self._triangles)
        points = [_vectors(each) for each in (self._position, self._normal)]
        given = {"device": level.device, "lanes": level.lanes}
        self._find_normals = Launch(vertex_normals, level.vertex_count, [*about, *points], **given)
        self._has_normals = False
        self._meets, self._parts = meets, None
        self._at: tuple[Tensor, int] | None = None

    @cached_property
    def within_two(self) -> sp.csr_matrix:
        """Which vertices are at most two edges apart."""
        return sp.csr_matrix(self.beside @ self.beside + self.beside)

    @cached_property
    def whole(self) -> np.ndarray:
        """What each vertex hangs together with: a number of each piece, shape (V,)."""
        return joined_by(np.concatenate([self.level.edges.cpu().numpy(), self.sewn]), self.level.vertex_count)

    def sew(self, pairs: Int[np.ndarray, "pairs 2"]) -> None:
        """From now on take pairs of vertices for one: what is beside either is beside both, and no pair with it."""
        if np.array_equal(pairs, self.sewn):
            return
        self.sewn, count, self._parts = pairs, self.level.vertex_count, None
        for name in ("whole", "within_two", "_itself"):
            self.__dict__.pop(name, None)
        same = sp.identity(count, dtype=np.float32, format="csr")
        if len(pairs):
            group = joined_by(pairs, count)
            member = sp.csr_matrix((np.ones(count, np.float32), (np.arange(count), group)))
            same = sp.csr_matrix(member @ member.T)
        beside = sp.csr_matrix(same @ self._apart @ same + same)
        beside.setdiag(0.0)
        beside.eliminate_zeros()
        beside.data[:] = 1.0
        self.beside = beside
        self._take_neighbours(same)

    def _take_neighbours(self, same: sp.csr_matrix) -> None:
        """Make the tables of what makes no pairs with each vertex: its neighbours; and keep what is the same."""
        self._neighbours, self._same = self._own(self.beside), same

    @cached_property
    def _itself(self) -> _Own:
        """The tables of what is the same alone, made where a sharp fold first asks."""
        return self._own(self._same)

    def _own(self, beside: sp.csr_matrix) -> _Own:
        """What lies beside each vertex, as kernels read it."""
        parts = [self._clusters.faces[:2], self._clusters.edges[:2]]
        device = self.level.device
        tables = [beside_table(beside, corners.numpy(), first.numpy(), device=device) for first, corners in parts]
        rings = [
            wp.array(each.astype(np.int32), dtype=wp.int32, device=device) for each in (beside.indptr, beside.indices)
        ]
        return _Own(rings, *tables)

    def move(self, x: Float[Tensor, "vertices 3"]) -> None:
        """Take positions [m]; what is asked afterwards is asked of them.

        Nothing is done for the tensor taken last, unless it was written to since.
        """
        if self._at is not None and self._at[0] is x and self._at[1] == x._version:
            return
        self._at = x, x._version
        self._position.copy_(x)
        self._has_normals = False

    @property
    def _moved(self) -> ClusteredParts:
        """The clusters where the cloth is: only queries move them."""
        self._clusters.move(self._position)
        return self._clusters

    def normals(self) -> Float[Tensor, "vertices 3"]:
        """Unit vertex normals of the authored winding."""
        if not self._has_normals:
            self._find_normals({})
            self._has_normals = True
        return self._normal

    def pairs(self, busy: Bool[Tensor, " vertices"], reach: Float[Tensor, " vertices"]) -> Pairs:
        """The closest parts above and below what is busy, as pairs; arguments are those of `nearest`."""
        return self.nearest(busy, reach).pairs(self.level)

    def nearest(
        self,
        busy: Bool[Tensor, " vertices"],
        reach: Float[Tensor, " vertices"],
        *,
        known: Nearest | None = None,
        moved: Bool[Tensor, " vertices"] | None = None,
        folds: bool = False,
    ) -> Nearest:
        """The closest parts above and below what is busy.

        Args:
            busy: Which vertices to ask; edges near what they find are asked too.
            reach: Distance beyond which nothing is near [m].
            known: What was closest before some vertices moved: what is not within reach of those is not asked again,
                and only the closest points on it are found anew.
            moved: Those vertices.
            folds: Whether in sharp folds parts one edge apart may be near each other, too.
        """
        assert self._at is not None
        self.normals()
        limit, x, level = reach.to(torch.float32).contiguous(), self._at[0], self.level
        if known is None or moved is None:
            again, found = torch.ones_like(busy), Nearest.none(x, len(level.edges))
            beside = again
        else:
            found = known.copy()
            again = self._beside(moved, float(limit.max())) | known.beside_moved(level, moved) | self._slid(found)
            found, beside = found.without(again, x=x), self.grown(again, 1)
        sharp = self._sharp() if folds else None
        self._ask_faces(self._parted(busy & again, sharp), limit, found)
        # An edge near another has a vertex near a face, or next to one that is.
        close = self.grown(found.close(level), 1) & beside
        if known is not None:
            unknown, (first, second) = close | again, self._ends
            found.edge[unknown[first] | unknown[second]] = -1
        self._ask_edges(self._parted(close, sharp), limit, found)
        return found

    def slid(self, known: Nearest) -> Nearest:
        """What was closest, at its closest points of now, without edges whose closest points are past an end."""
        found = known.copy()
        self._slid(found)
        found.edge[found.place[..., 0].T < 0.0] = -1
        return found

    def crossings(self, busy: Bool[Tensor, " vertices"]) -> Crossings:
        """Edges that pass through faces."""
        assert self._at is not None
        label = joined_by(self.sewn, self.level.vertex_count) if len(self.sewn) else None
        if self._parts is None:
            self._parts = Parts(self.level, self._meets, label)
        return crossings(self._parts, self._at[0])

    def crossings_since(self, known: Crossings, moved: Bool[Tensor, " vertices"]) -> Crossings:
        """What crosses now, by what crossed before some vertices moved: only what lies beside those is asked.

        Args:
            known: What crossed, all of it listed.
            moved: Vertices that have moved since.
        """
        return self.crossings(moved)

    def grown(self, vertices: Bool[Tensor, " vertices"], rings: int) -> Bool[Tensor, " vertices"]:
        """Vertices at most some edges away from given ones."""
        for _ in range(rings):
            given, vertices = vertices, vertices.clone()
            inputs = [*self._neighbours.rings, _flags(given), _flags(vertices)]
            Launch(add_neighbours, len(given), inputs, device=self.level.device, lanes=self.level.lanes)({})
        return vertices

    def corners_of(self, crossings: Crossings) -> Int[Tensor, "crossings 5"]:
        """Vertices of the edge and of the face of each crossing."""
        return torch.cat([self.level.edges[crossings.edge].long(), self.triangles[crossings.face]], dim=1)

    def crossed(self, crossings: Crossings) -> Bool[Tensor, " vertices"]:
        """Vertices of what crosses."""
        out = torch.zeros_like(self.level.free[:, 0])
        out[self.corners_of(crossings).reshape(-1)] = True
        return out

    def strain(self, x: Float[Tensor, "vertices 3"]) -> float:
        """What all but the hundredth part of the edges are strained by at most, at x [m]."""
        return float(self._strains(x).kthvalue(self._most_edges).values)

    def is_strained(self, x: Float[Tensor, "vertices 3"], most: float) -> bool:
        """Whether that is more than so much at x [m]."""
        return int((self._strains(x) <= most).sum()) < self._most_edges

    def _strains(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " edges"]:
        """What each edge is strained by."""
        return (self.level.lengths(x) / self.level.rest_length - 1.0).abs()

    @cached_property
    def _ends(self) -> tuple[Tensor, Tensor]:
        """The edges' first and second vertices."""
        first, second = self.level.edges.long().T.contiguous()
        return first, second

    @property
    def _most_edges(self) -> int:
        """Number of edges but the hundredth part."""
        return 1 + int(0.99 * (len(self.level.rest_length) - 1))

    def between(self, crossings: Crossings) -> np.ndarray:
        """Number of listed crossings between garments, the lower number first, shape (G, G)."""
        ends = self.level.vertex_garment[self.corners_of(crossings)[:, [0, 2]]].cpu().numpy()
        table = np.zeros((self._garments, self._garments), np.int64)
        np.add.at(table, (ends.min(axis=1), ends.max(axis=1)), 1)
        return table

    def _beside(self, moved: Bool[Tensor, " vertices"], reach: float) -> Bool[Tensor, " vertices"]:
        """Given vertices, and those of all clusters that may be nearer to a cluster of one than a reach [m]."""
        near, clusters = moved.clone(), self._moved
        clusters.run(clusters_beside, [wp.float32(reach), _flags(moved), *clusters.faces[:2], _flags(near)])
        return near

    def _slid(self, found: Nearest) -> Bool[Tensor, " vertices"]:
        """Move what is closest to the closest points of now; the ends of edges whose points slide off an end."""
        slid = found_again(found, _vectors(self._position), self._triangles, self._edges, level=self.level)
        ends = torch.zeros_like(found.face[:, 0], dtype=torch.bool)
        ends[self.level.edges[slid].long().reshape(-1)] = True
        return ends

    def _ask_faces(self, asked: Sequence[_Asked], reach: Tensor, found: Nearest) -> None:
        """Write the closest faces of the vertices that are asked."""
        best = torch.empty((len(self.level.rest), 2), dtype=torch.float32, device=reach.device)
        clusters = self._moved
        outputs = [wp.from_torch(best, dtype=wp.vec2f), wp.from_torch(found.face, dtype=wp.vec2i)]
        outputs += [_vectors(each) for each in found.weight]
        for which, own in asked:
            inputs = [*own.rings, *self._moving(which, reach), *own.faces]
            clusters.run(faces_near, [*inputs, *clusters.vertices, *clusters.faces, *clusters.face_boxes, *outputs])

    def _ask_edges(self, asked: Sequence[_Asked], reach: Tensor, found: Nearest) -> None:
        """Write the closest edges of those that have an end that is asked."""
        best = torch.empty((len(found.edge), 2), dtype=torch.float32, device=reach.device)
        clusters = self._moved
        outputs = [wp.from_torch(best, dtype=wp.vec2f), wp.from_torch(found.edge, dtype=wp.vec2i)]
        outputs += [wp.from_torch(each, dtype=wp.vec2f) for each in found.place]
        for which, own in asked:
            inputs = [*own.rings, *self._moving(which, reach), *own.edges]
            clusters.run_shared(edges_near, [*inputs, *clusters.edges, *clusters.edge_boxes, *outputs])

    def _sharp(self) -> Bool[Tensor, " vertices"]:
        """Vertices in sharp folds."""
        sharp = torch.zeros_like(self.level.free[:, 0])
        inputs = [self._triangles, _vectors(self._position), _vectors(self._normal), _flags(sharp)]
        Launch(in_sharp_folds, len(self.triangles), inputs, device=self.level.device, lanes=self.level.lanes)({})
        return sharp

    def _parted(self, asked: Bool[Tensor, " vertices"], sharp: Tensor | None) -> list[_Asked]:
        """What is asked, with what makes no pairs with it: its neighbours; in sharp folds, last, only what it is."""
        sharp = None if sharp is None else sharp & asked
        if sharp is None or not bool(sharp.any()):
            return [(asked, self._neighbours)]
        return [(asked & ~sharp, self._neighbours), (sharp, self._itself)]

    def _moving(self, asked: Tensor, reach: Tensor) -> list[object]:
        """What both proximity kernels are told of the positions."""
        moving = [_vectors(self._position), _flags(asked), wp.from_torch(reach), _vectors(self._normal)]
        return [*moving, _vectors(self._rest)]


def _opposite(edges: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Vertices opposite each edge in the first two of its faces, shape (E, 2), -1 where there is none."""
    edge = find_edges(edges, triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2))
    third = triangles[:, [2, 0, 1]].reshape(-1).astype(np.int64)
    out = np.full((len(edges), 2), -1, np.int64)
    for place in (1, 0):  # The first face is written last: an edge of one face has it in the first place.
        kept = np.unique(edge[:: 1 - 2 * place], return_index=True)
        out[kept[0], place] = third[:: 1 - 2 * place][kept[1]]
    out[out[:, 0] == out[:, 1], 1] = -1
    return out


def _vectors(tensor: Tensor) -> wp.array:
    return wp.from_torch(tensor, dtype=wp.vec3f, requires_grad=False)


def _flags(mask: Tensor) -> wp.array:
    return wp.from_torch(mask.contiguous())
