"""How much room a surface leaves above itself: cloth between two walls of one body cannot keep its offset from both."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false
from __future__ import annotations

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from ..colliders.base import Surface
from ..colliders.mesh import MeshSurface
from ..mesh.kernels import KERNELS
from ..mesh.threads import LEAST_QUERIES, argument, run

wp.set_module_options(KERNELS)

OFF = 1e-5
"""How far off the surface a ray starts, so that it does not meet where it starts [m]."""


@wp.kernel
def _ahead(
    first: wp.int32,
    mesh: wp.uint64,
    start: wp.array(dtype=wp.vec3f),
    direction: wp.array(dtype=wp.vec3f),
    reach: wp.array(dtype=wp.float32),
    distance: wp.array(dtype=wp.float32),
):
    i = first + wp.tid()
    query = wp.mesh_query_ray(mesh, start[i], direction[i], reach[i])
    if query.result:
        distance[i] = query.t


def room_above(
    surface: Surface,
    point: Float[Tensor, "points 3"],
    normal: Float[Tensor, "points 3"],
    *,
    reach: Float[Tensor, " points"],
    threads: int = 1,
) -> Float[Tensor, " points"]:
    """Distance from points of a surface to the next wall of the same surface above them [m], infinite beyond reach.

    Args:
        surface: The surface; primitives are convex and have no such wall.
        point: Points of it, in its coordinates [m].
        normal: Unit normals there, away from it.
        reach: How far to look [m].
        threads: Most threads on the CPU.
    """
    room = torch.full_like(reach, float("inf"))
    if not isinstance(surface, MeshSurface) or not len(point):
        return room
    found = room.to(torch.float32)
    start, along = (each.to(torch.float32).contiguous() for each in (point + OFF * normal, normal))
    limit = reach.to(torch.float32).contiguous()
    inputs = [argument(each, wp.vec3f) for each in (start, along)]
    inputs += [argument(each) for each in (limit, found)]
    run(_ahead, len(point), [surface.mesh.id, *inputs], device=str(point.device), threads=threads, least=LEAST_QUERIES)
    return found.to(room)
