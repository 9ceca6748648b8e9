"""Self-intersecting faces of a surface, as in armpits and crotches of skinned bodies.

A face with all corners outside the surface and without self-intersection is wholly exposed: its pseudonormal tells
inside from outside for certain.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportIndexIssue=false
from __future__ import annotations

import torch
import warp as wp
from jaxtyping import Bool, Int
from torch import Tensor

from ..mesh.kernels import KERNELS
from ..mesh.piercing import passes_through
from ..mesh.threads import LEAST_QUERIES, Launch

wp.set_module_options(KERNELS)


@wp.func
def _pierces(x: wp.array(dtype=wp.vec3f), t: wp.vec3i, u: wp.vec3i):
    """True if a side of triangle t that shares no corner with triangle u passes through u."""
    found = bool(False)  # noqa: UP018 - a literal would be a constant to Warp
    for side in range(3):
        a, b = t[side], t[(side + 1) % 3]
        beside = a == u[0] or a == u[1] or a == u[2] or b == u[0] or b == u[1] or b == u[2]
        if not beside and passes_through(x, wp.vec2i(a, b), u):
            found = True
    return found


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
    found = wp.int32(0)
    while wp.mesh_query_aabb_next(query, g):
        if found == 0 and g != f:
            u = wp.vec3i(corners[3 * g], corners[3 * g + 1], corners[3 * g + 2])
            if _pierces(x, t, u) or _pierces(x, u, t):
                found = 1
    out[i] = found


def overlapping(mesh: wp.Mesh, faces: Int[Tensor, " faces"], *, threads: int = 1) -> Bool[Tensor, " faces"]:
    """Mask of the faces that pass through other faces of the mesh.

    Args:
        mesh: The mesh.
        faces: Indices of the faces to test.
        threads: Most threads on the CPU.
    """
    out = torch.zeros(len(faces), dtype=torch.int32, device=faces.device)
    if len(faces):
        ask = faces.to(torch.int32).contiguous()
        inputs = [mesh.id, wp.from_torch(ask), mesh.points, mesh.indices, wp.from_torch(out)]
        Launch(_overlap, len(faces), inputs, device=str(faces.device), threads=threads, least=LEAST_QUERIES)({})
    return out > 0
