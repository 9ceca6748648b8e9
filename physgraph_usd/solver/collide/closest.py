"""Closest points on subsets of the cloth's own faces."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportIndexIssue=false, reportCallIssue=false
from __future__ import annotations

import numpy as np
import torch
import warp as wp
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from torch import Tensor

from ..level import Level
from ..mesh.kernels import KERNELS
from ..mesh.threads import run
from .distance import weights_on_triangle

wp.set_module_options(KERNELS)

FAR = wp.constant(wp.float64(1.0e30))
"""Distance for an empty subset."""


@wp.func
def holds(members: wp.array(dtype=wp.int32), begin: wp.int32, end: wp.int32, wanted: wp.int32):
    """True if an ascending list contains a number."""
    low, high = wp.int32(0) + begin, wp.int32(0) + end
    while low < high:
        half = (low + high) // 2
        if members[half] < wanted:
            low = half + 1
        else:
            high = half
    return low < end and members[low] == wanted


@wp.kernel
def _closest_of(
    first: wp.int32,
    x: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    tree: wp.uint64,
    asked: wp.array(dtype=wp.int32),
    which: wp.array(dtype=wp.int32),
    begin: wp.array(dtype=wp.int32),
    members: wp.array(dtype=wp.int32),
    radius: wp.float64,
    out: wp.array(dtype=wp.vec3d),
):
    n = first + wp.tid()
    at, row = x[asked[n]], which[n]
    begins, ends = begin[row], begin[row + 1]
    least, within, k = wp.float64(0.0) + FAR, wp.float64(0.5) * radius, wp.int32(0)
    while begins < ends and least > within:
        within = within * wp.float64(2.0)
        reach = wp.vec3d(within)
        query = wp.bvh_query_aabb(tree, wp.vec3f(at - reach), wp.vec3f(at + reach))
        while wp.bvh_query_next(query, k):
            if holds(members, begins, ends, k):
                t = faces[k]
                weight = weights_on_triangle(at, x[t[0]], x[t[1]], x[t[2]])
                displacement = at + weight[1] * x[t[0]] + weight[2] * x[t[1]] + weight[3] * x[t[2]]
                if wp.length(displacement) < least:
                    least = wp.length(displacement)
                    out[n] = displacement


def displacements_to(
    level: Level,
    x: Float[Tensor, "vertices 3"],
    asked: Int[Tensor, " asked"],
    which: Int[Tensor, " asked"],
    sets: csr_matrix,
) -> Float[Tensor, "asked 3"]:
    """Displacements from the closest point of a set of faces to each query vertex [m], float64; 0 for empty sets.

    Args:
        level: The level.
        x: Positions [m].
        asked: Indices of the query vertices.
        which: The row of each query vertex's set.
        sets: Faces of each set, shape (sets, T).
    """
    at, device = x.double().contiguous(), level.device
    corners = at[level.triangles.long()]
    low, high = corners.amin(dim=1).float(), corners.amax(dim=1).float()
    rounding = 4.0 * torch.finfo(torch.float32).eps * corners.abs().amax()
    low, high = (low - rounding).contiguous(), (high + rounding).contiguous()
    tree = wp.Bvh(wp.from_torch(low, dtype=wp.vec3f), wp.from_torch(high, dtype=wp.vec3f))
    sets.sort_indices()
    begin, members = (
        wp.array(each.astype(np.int32), dtype=wp.int32, device=device) for each in (sets.indptr, sets.indices)
    )
    out = torch.zeros((len(asked), 3), dtype=torch.float64, device=device)
    inputs = [wp.from_torch(at, dtype=wp.vec3d), wp.from_torch(level.triangles.int().contiguous(), dtype=wp.vec3i)]
    inputs += [tree.id, *(wp.from_torch(each.int().contiguous()) for each in (asked, which)), begin, members]
    inputs += [2.0 * float(level.spacing.mean()), wp.from_torch(out, dtype=wp.vec3d)]
    run(_closest_of, len(asked), inputs, device=device, threads=level.threads)
    return out
