"""All edges that pass through faces, searched by pairs of clusters."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportIndexIssue=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false
from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from ..mesh.kernels import KERNELS
from ..mesh.piercing import volume
from .boxes import ROUNDING, Boxes, Motion, outside, overlap
from .detector import Detector
from .narrow_phase import Found, has, is_one, write
from .parts import Parts
from .topology import Topology

wp.set_module_options(KERNELS)


@dataclass(frozen=True, eq=False)
class Crossings:
    """Edges that pass through faces.

    Attributes:
        edge: Indices of the edges, shape (N,).
        face: Indices of the faces, shape (N,).
    """

    edge: Int[Tensor, " crossings"]
    face: Int[Tensor, " crossings"]

    @property
    def count(self) -> int:
        """Number of crossings."""
        return len(self.edge)

    @staticmethod
    def none(device: torch.device) -> Crossings:
        """No crossings."""
        empty = torch.zeros(0, dtype=torch.int64, device=device)
        return Crossings(empty, empty)


@wp.func
def turns_left(x: wp.array(dtype=wp.vec3d), e: wp.vec2i, p: wp.int32, q: wp.int32):
    """True if the line from p to q passes an edge on the edge's left; true for exactly one of two faces at a side."""
    low, high = wp.min(p, q), wp.max(p, q)
    left = volume(x[e[0]], x[e[1]], x[low], x[high]) >= wp.float64(0.0)
    return left == (p < q)


@wp.func
def is_through(x: wp.array(dtype=wp.vec3d), e: wp.vec2i, t: wp.vec3i):
    """True if an edge passes through a triangle. An end in the plane does not; a side belongs to one of its faces.

    Points within single-precision rounding of the plane count as in the plane: parts of one flat face do not cross.
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


@wp.func
def touches(parts: Topology, e: wp.vec2i, t: wp.vec3i):
    """True if an edge is sewn to a face."""
    for end in range(2):
        for corner in range(3):
            if is_one(parts, e[end], t[corner]):
                return True
    return False


@wp.func
def edges_through(
    parts: Topology,
    motion: Motion,
    boxes: Boxes,
    found: Found,
    owner: wp.int32,
    i: wp.int32,
    j: wp.int32,
    count: wp.int32,
):
    """Write the edges of a cluster that pass through faces of another cluster; returns the number of pairs so far."""
    for k in range(parts.first_edge[i], parts.first_edge[i + 1]):
        e = parts.edges[k]
        near, far = motion.start[e[0]], motion.start[e[1]]
        if outside(wp.min(near, far), wp.max(near, far), boxes.low[j], boxes.high[j], wp.float64(0.0)):
            continue
        for m in range(parts.first_face[j], parts.first_face[j + 1]):
            if not overlap(boxes.edge_low[k], boxes.edge_high[k], boxes.face_low[m], boxes.face_high[m]):
                continue
            t = parts.faces[m]
            if has(t, e[0]) or has(t, e[1]) or touches(parts, e, t):
                continue
            if is_through(motion.start, e, t):
                numbers = wp.vec4i(parts.edge_number[k], parts.face_number[m], 0, 0)
                write(found, owner, count, numbers, wp.float64(0.0), False)
                count += 1
    return count


@wp.kernel
def find_crossings(
    first: wp.int32, parts: Topology, clusters: wp.array(dtype=wp.vec2i), motion: Motion, boxes: Boxes, found: Found
):
    """Edges of either of two clusters that pass through faces of the other cluster, up to the room."""
    n = first + wp.tid()
    i, j = clusters[n][0], clusters[n][1]
    if found.begin[n + 1] == found.begin[n]:
        return
    count = edges_through(parts, motion, boxes, found, n, i, j, 0)
    if i != j:
        count = edges_through(parts, motion, boxes, found, n, j, i, count)
    found.count[n] = count


def crossings(parts: Parts, x: Float[Tensor, "vertices 3"], *, detector: Detector | None = None) -> Crossings:
    """All edges that pass through a face to which they are neither connected nor sewn.

    Args:
        parts: The parts.
        x: Positions [m].
        detector: Collision detector of the same parts for reuse, or None.
    """
    numbers = (detector or Detector.once(parts)).still(find_crossings, x)
    edge, face = numbers.corners.long()[:, 0], numbers.corners.long()[:, 1]
    order = torch.argsort(edge * max(len(parts.level.triangles), 1) + face)
    return Crossings(edge[order], face[order])
