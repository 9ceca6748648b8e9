"""Self-intersecting faces of a surface, as in armpits and crotches of skinned bodies.

A face with all corners outside the surface and without self-intersection is wholly exposed: cloth can leave through
all of it.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportIndexIssue=false
from __future__ import annotations

import torch
import warp as wp
from jaxtyping import Bool, Int
from torch import Tensor

from ..mesh.kernels import KERNELS
from ..mesh.piercing import passes_through, wide
from ..mesh.threads import run

wp.set_module_options(KERNELS)


@wp.func
def _pierces(x: wp.array(dtype=wp.vec3f), t: wp.vec3i, u: wp.vec3i):
    """True if a side of triangle t that shares no corner's place with triangle u passes through u."""
    found = bool(False)  # noqa: UP018 - a literal would be a constant to Warp
    p, q, r = wide(x[u[0]]), wide(x[u[1]]), wide(x[u[2]])
    for side in range(3):
        a, b = wide(x[t[side]]), wide(x[t[(side + 1) % 3]])
        beside = a == p or a == q or a == r or b == p or b == q or b == r  # noqa: PLR1714 - Warp has no `in`
        if not beside and passes_through(a, b, u, p, q, r):
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
        run(_overlap, len(faces), inputs, device=str(faces.device), threads=threads)
    return out > 0
