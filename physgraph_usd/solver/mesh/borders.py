"""Open borders of meshes: their edges, and the border edge nearest to a border vertex."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from .topology import PolygonMesh

SPACING = 0.25
"""Distance between the sample points of an edge, in median border edges."""
MOST_SAMPLES = 64
"""Most sample points of one edge."""
BORDER_SAMPLES = 16
"""Most sample points examined for each vertex, including the vertex's own two edges."""


def open_edges(mesh: PolygonMesh) -> Int[np.ndarray, "edges 2"]:
    """End vertices of the edges with a single face."""
    half = mesh.half_edges
    return half.edges[(half.count == 1) & (half.edges[:, 0] != half.edges[:, 1])].astype(np.int64)


@dataclass(frozen=True, eq=False)
class OnEdge:
    """Vertices, each with the nearest point on an edge.

    Attributes:
        vertex: Numbers of the vertices, shape (N,).
        edge: End vertices of each vertex's edge, shape (N, 2).
        part: Position of the nearest point on the edge, from 0 to 1, shape (N,).
        distance: Distance to the nearest point [m], shape (N,).
    """

    vertex: Int[np.ndarray, " near"]
    edge: Int[np.ndarray, "near 2"]
    part: Float[np.ndarray, " near"]
    distance: Float[np.ndarray, " near"]

    def where(self, selected: np.ndarray) -> OnEdge:
        """The selected rows."""
        return OnEdge(self.vertex[selected], self.edge[selected], self.part[selected], self.distance[selected])

    def at(self, points: Float[np.ndarray, "vertices 3"]) -> OnEdge:
        """Nearest points and distances of the vertices in a new pose."""
        return _on_edges(points, self.vertex, self.edge)

    def place(self, points: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "near 3"]:
        """The nearest points, in a pose."""
        start, end = points[self.edge[:, 0]], points[self.edge[:, 1]]
        return start + self.part[:, None] * (end - start)


def nearest_edges(
    points: Float[np.ndarray, "vertices 3"],
    vertices: Int[np.ndarray, " some"],
    edges: Int[np.ndarray, "edges 2"],
    within: Float[np.ndarray, " some"],
) -> OnEdge:
    """The nearest edge of each vertex, excluding edges at the vertex or at a neighbour.

    Args:
        points: Positions [m].
        edges: Open edges of all borders.
        within: Search radius of each vertex [m].
    """
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1) if len(edges) else np.zeros(0)
    spacing = SPACING * float(np.median(length)) if len(edges) else 0.0
    if not len(vertices) or spacing == 0.0:
        none = np.zeros(0)
        return OnEdge(none.astype(np.int64), np.zeros((0, 2), np.int64), none, none)
    count = np.clip(np.ceil(length / spacing), 1, MOST_SAMPLES).astype(np.int64)
    owner = np.repeat(np.arange(len(edges)), count)
    part = (np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[owner]
    start, end = points[edges[owner, 0]], points[edges[owner, 1]]
    reach = within.max() + 0.5 * float((length / count).max())
    tree = cKDTree(start + part[:, None] * (end - start))
    samples = tree.query(points[vertices], k=min(BORDER_SAMPLES, len(owner)), distance_upper_bound=reach)[1]
    samples = samples.reshape(len(vertices), -1)
    row, column = np.nonzero(samples < len(owner))
    vertex, edge = vertices[row], edges[owner[samples[row, column]]]
    beside = _neighbours(edges, vertex, edge)
    near = _on_edges(points, vertex[~beside], edge[~beside])
    order = np.lexsort((near.distance, near.vertex))
    near = near.where(order)
    near = near.where(np.unique(near.vertex, return_index=True)[1])
    limit = np.zeros(len(points))
    limit[vertices] = within
    return near.where(near.distance <= limit[near.vertex])


def finer_side(points: Float[np.ndarray, "vertices 3"], borders: np.ndarray, near: OnEdge) -> OnEdge:
    """Select, among vertices on edges of different borders, the followers: the finer border follows the coarser.

    No followed edge ends in a following vertex.

    Args:
        points: Positions [m].
        borders: Open edges, shape (E, 2).
        near: Vertices of the borders and the edges below.
    """
    length = np.linalg.norm(points[borders[:, 0]] - points[borders[:, 1]], axis=1)
    shortest = np.full(len(points), np.inf)
    np.minimum.at(shortest, borders, length[:, None])
    length_below = np.linalg.norm(points[near.edge[:, 0]] - points[near.edge[:, 1]], axis=1)
    follows, followed, selected = set[int](), set[int](), np.zeros(len(near.vertex), bool)
    for row in np.argsort(-length_below / shortest[near.vertex], kind="stable").tolist():
        vertex, ends = int(near.vertex[row]), near.edge[row].tolist()
        if vertex not in followed and follows.isdisjoint(ends):
            follows.add(vertex)
            followed.update(ends)
            selected[row] = True
    return near.where(selected)


def _neighbours(edges: np.ndarray, vertex: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """Whether an edge ends in a vertex or in a neighbour of the vertex along open edges, shape (N,)."""
    size = int(max(edges.max(), vertex.max(initial=0))) + 1
    keys = np.sort(np.concatenate([edges[:, 0] * size + edges[:, 1], edges[:, 1] * size + edges[:, 0]]))
    beside = (edge == vertex[:, None]).any(axis=1)
    for end in edge.T:
        wanted = vertex * size + end
        beside |= keys[np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)] == wanted
    return beside


def _on_edges(points: np.ndarray, vertex: np.ndarray, edge: np.ndarray) -> OnEdge:
    start, span = points[edge[:, 0]], points[edge[:, 1]] - points[edge[:, 0]]
    squared = np.maximum((span**2).sum(axis=1), np.finfo(float).tiny)
    part = np.clip(((points[vertex] - start) * span).sum(axis=1) / squared, 0.0, 1.0)
    distance = np.linalg.norm(points[vertex] - start - part[:, None] * span, axis=1)
    return OnEdge(vertex, edge, part, distance)
