"""Edges that pass through faces: all of them, asked cluster by cluster."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportIndexIssue=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false
from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from ..mesh.piercing import volume
from .parts import Parts, Topology
from .sweep import IMPACTS, ROUNDING, Found, Motion, Pairs, Sweep, Swept, has, is_one, overlap, write

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True, eq=False)
class Crossings:
    """Edges that pass through faces.

    Attributes:
        edge: Shape (N,).
        face: Shape (N,).
    """

    edge: Int[Tensor, " crossings"]
    face: Int[Tensor, " crossings"]

    @property
    def count(self) -> int:
        """Number of such pairs."""
        return len(self.edge)

    @staticmethod
    def none(device: torch.device) -> Crossings:
        """No crossings."""
        empty = torch.zeros(0, dtype=torch.int64, device=device)
        return Crossings(empty, empty)


@wp.func
def turns_left(x: wp.array(dtype=wp.vec3d), e: wp.vec2i, p: wp.int32, q: wp.int32):
    """Whether the line from p to q passes an edge on its left; of two faces at a side just one has it on its left."""
    low, high = wp.min(p, q), wp.max(p, q)
    left = volume(x[e[0]], x[e[1]], x[low], x[high]) >= wp.float64(0.0)
    return left == (p < q)


@wp.func
def is_through(x: wp.array(dtype=wp.vec3d), e: wp.vec2i, t: wp.vec3i):
    """Whether an edge passes through a triangle; an end in its plane does not, a side belongs to one of its faces.

    What is in the plane but for the rounding of single precision is in it: parts of one flat face do not cross.
    """
    p, q, r, a, b = x[t[0]], x[t[1]], x[t[2]], x[e[0]], x[e[1]]
    near, far = volume(p, q, r, a), volume(p, q, r, b)
    if near * far >= wp.float64(0.0):
        return False
    size = wp.max(wp.max(wp.abs(p), wp.abs(q)), wp.max(wp.abs(a), wp.abs(b)))
    rounding = ROUNDING * wp.max(size[0], wp.max(size[1], size[2])) * wp.length(wp.cross(q - p, r - p))
    if wp.abs(near) <= rounding and wp.abs(far) <= rounding:
        return False
    first = turns_left(x, e, t[0], t[1])
    return turns_left(x, e, t[1], t[2]) == first and turns_left(x, e, t[2], t[0]) == first


@wp.kernel
def edges_through(
    first: wp.int32,
    parts: Topology,
    motion: Motion,
    sweep: Sweep,
    tree: wp.uint64,
    low: wp.array(dtype=wp.vec3f),
    high: wp.array(dtype=wp.vec3f),
    found: Found,
):
    """Count the faces that edges of a cluster pass through, and write them from where the cluster's begin."""
    i = first + wp.tid()
    if low[i][0] > high[i][0] or found.begin[i + 1] == found.begin[i]:
        return
    count, j = wp.int32(0), wp.int32(0)
    query = wp.bvh_query_aabb(tree, low[i], high[i])
    while wp.bvh_query_next(query, j):
        if parts.meets[parts.garment[i] * parts.garments + parts.garment[j]] == 0:
            continue
        for k in range(parts.first_edge[i], parts.first_edge[i + 1]):
            e = parts.edges[k]
            if not overlap(sweep.edge_low[k], sweep.edge_high[k], low[j], high[j]):
                continue
            for m in range(parts.first_face[j], parts.first_face[j + 1]):
                if not overlap(sweep.edge_low[k], sweep.edge_high[k], sweep.face_low[m], sweep.face_high[m]):
                    continue
                t = parts.faces[m]
                if has(t, e[0]) or has(t, e[1]) or touches(parts, e, t):
                    continue
                if is_through(motion.start, e, t):
                    numbers = wp.vec4i(parts.edge_number[k], parts.face_number[m], 0, 0)
                    write(found, i, count, numbers, wp.float64(0.0), False)
                    count += 1
    found.count[i] = count


@wp.func
def touches(parts: Topology, e: wp.vec2i, t: wp.vec3i):
    """Whether an edge is sewn to a face."""
    for end in range(2):
        for corner in range(3):
            if is_one(parts, e[end], t[corner]):
                return True
    return False


def crossings(parts: Parts, x: Float[Tensor, "vertices 3"]) -> Crossings:
    """Every edge that passes through a face which it shares no vertex with, nor is sewn to.

    Args:
        parts: The parts.
        x: Positions [m].
    """
    at = x.double()
    numbers: Pairs = Swept(parts, at, torch.zeros_like(at)).found(edges_through, IMPACTS)
    edge, face = numbers.corners.long()[:, 0], numbers.corners.long()[:, 1]
    order = torch.argsort(edge * max(len(parts.level.triangles), 1) + face)
    return Crossings(edge[order], face[order])
