"""The parts of a level's cloth that may be in contact, and sewn vertices."""

# Warp's structs are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from ..colliders.base import Solid
from ..level import Level
from ..mesh.kernels import start_warp
from ..mesh.recorded import Recordings
from ..mesh.stencil import incidence
from .boxes import arrays_of, bound_clusters, boxes_for, query_of
from .topology import topology_of

FIRST_ROOM = 2**14
"""Room of the first search."""
TASKS = 12
"""Tasks of a pair of clusters on a card, each with one of the three kinds of pairs and every fourth part."""
SIZE = {"cpu": 24, "cuda": 8}
"""Most vertices of a cluster: a thread compares two clusters, and CUDA has more threads."""


@dataclass
class Room:
    """Room of a level's searches, enlarged when a search needs more; changes no result.

    Attributes:
        of_each: Pairs of clusters for each cluster.
        clusters, candidates, pairs: Pairs of clusters, of parts whose boxes meet, and of parts.
    """

    of_each: int = 32
    clusters: int = FIRST_ROOM
    candidates: int = FIRST_ROOM
    pairs: int = FIRST_ROOM

    def lacks(self, *needed: int) -> bool:
        """Whether a search needed more, in this order; from now on there is room for twice as much."""
        before = replace(self)
        for name, count in zip(("of_each", "clusters", "candidates", "pairs"), needed, strict=True):
            if getattr(self, name) < count:
                setattr(self, name, 2 * count)
        return self != before


class Parts:
    """The vertices, edges and faces of a level that can come near one another.

    Attributes:
        topology: Warp struct of the parts by cluster.
        surface: Edges, faces, and the edge along each side of these, of the cloth and then of the bodies, int64.
        links: Connected vertices: edges and sewn pairs, shape (N, 2), int64.
        lengths: Lengths of the links at rest, 0 if sewn [m], shape (N,), float64.
        boxes: Warp struct of boxes, written by each search.
        room: Room of the searches.
        tasks: Tasks of a pair of clusters in a search.
        recordings: The searches, recorded on a card.
        faces: Number of faces, of the cloth and of bodies.
        starts: Number of the first edge and of the first face of each body, after those of the cloth and the bodies
            before.
    """

    def __init__(
        self,
        level: Level,
        meets: np.ndarray,
        label: Int[np.ndarray, " vertices"] | None = None,
        *,
        solids: Sequence[Solid] = (),
    ) -> None:
        """Gather the clusters.

        Args:
            meets: True for pairs in contact of garments, then bodies, symmetric, shape (G + B, G + B), bool.
            label: Vertices with equal labels are sewn together, or equal; None for no seams, shape (V,).
            solids: Bodies, whose vertices follow the cloth's in all positions.
        """
        start_warp()  # Views of tensors do not start Warp by themselves.
        self.level = level
        sewn = np.zeros((0, 2), np.int64) if label is None else _sewn(label)
        edges = level.edges.cpu().numpy().astype(np.int64)
        self.links = torch.as_tensor(np.concatenate([edges, sewn]), device=level.device)
        self.lengths = torch.cat([level.rest_length.double(), level.rest.new_zeros(len(sewn)).double()])
        label = np.arange(level.vertex_count) if label is None else label
        size = SIZE[torch.device(level.device).type]
        self.topology, self.surface = topology_of(level, meets, label, size=size, solids=solids)
        edges = np.cumsum([len(level.edges), *(len(solid.edges) for solid in solids)])
        faces = np.cumsum([len(level.triangles), *(len(solid.faces) for solid in solids)])
        self.faces = int(faces[-1])
        self.starts = tuple(
            torch.as_tensor(numbers[:-1].astype(np.int64), device=level.device) for numbers in (edges, faces)
        )
        self.boxes, self.recordings = boxes_for(self.topology, level.device), Recordings()
        self.room, self.tasks = Room(), 1 if level.device == "cpu" else TASKS

    @cached_property
    def tree(self) -> wp.Bvh:
        """Hierarchy of the clusters' boxes, built at rest."""
        at_rest = query_of(arrays_of(wp.to_torch(self.topology.rest)))
        inputs = [0, self.topology, at_rest, self.boxes]
        wp.launch(bound_clusters, dim=self.topology.clusters, inputs=inputs, device=self.level.device)
        return wp.Bvh(self.boxes.low, self.boxes.high)

    @cached_property
    def _rows(self) -> tuple[Tensor, Tensor, Tensor]:
        """Start of each vertex's row of links, and the other vertex and length of each entry."""
        starts, slots = incidence(self.links, len(self.topology.owner))
        slots = slots.long()
        return starts.long(), self.links.reshape(-1)[slots ^ 1], self.lengths[slots // 2]

    def links_of(
        self, vertices: Int[Tensor, " some"]
    ) -> tuple[Int[Tensor, " links"], Int[Tensor, " links"], Float[Tensor, " links"]]:
        """The links of some vertices: these vertices, the linked vertices, and lengths at rest [m]."""
        starts, neighbours, lengths = self._rows
        count = starts[vertices + 1] - starts[vertices]
        slot = torch.arange(int(count.sum()), device=count.device)
        slot += (starts[vertices] - count.cumsum(dim=0) + count).repeat_interleave(count)
        return vertices.repeat_interleave(count), neighbours[slot], lengths[slot]


def _sewn(label: np.ndarray) -> np.ndarray:
    """Each vertex with the label of an earlier vertex, and the first vertex of the label, shape (N, 2)."""
    first = np.unique(label, return_index=True)[1][np.unique(label, return_inverse=True)[1]]
    later = np.flatnonzero(first != np.arange(len(label)))
    return np.stack([later, first[later]], axis=1)
