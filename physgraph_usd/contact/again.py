"""Closest points on parts that are known to be closest, after all of the cloth has crept a little."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportIndexIssue=false, reportCallIssue=false
from __future__ import annotations

import torch
import warp as wp
from jaxtyping import Bool
from torch import Tensor

from ..level import Level
from ..mesh.lanes import Launch
from .nearest import Nearest
from .proximity import closest_on_triangle, places_inside

wp.set_module_options({"enable_backward": False})


@wp.kernel
def faces_again(
    first: wp.int32,
    x: wp.array(dtype=wp.vec3f),
    triangles: wp.array(dtype=wp.vec3i),
    face: wp.array(dtype=wp.vec2i),
    above: wp.array(dtype=wp.vec3f),
    below: wp.array(dtype=wp.vec3f),
):
    """The closest points of faces that are known to be closest."""
    v = first + wp.tid()
    if face[v][0] >= 0:
        t = triangles[face[v][0]]
        above[v] = closest_on_triangle(x[v], x[t[0]], x[t[1]], x[t[2]])
    if face[v][1] >= 0:
        t = triangles[face[v][1]]
        below[v] = closest_on_triangle(x[v], x[t[0]], x[t[1]], x[t[2]])


@wp.kernel
def edges_again(
    first: wp.int32,
    x: wp.array(dtype=wp.vec3f),
    edges: wp.array(dtype=wp.vec2i),
    other: wp.array(dtype=wp.vec2i),
    above: wp.array(dtype=wp.vec2f),
    below: wp.array(dtype=wp.vec2f),
    slid: wp.array(dtype=wp.bool),
):
    """The closest points of edges that are known to be closest; which of them have slid off an end."""
    e = first + wp.tid()
    a, b = x[edges[e][0]], x[edges[e][1]]
    if other[e][0] >= 0:
        g = edges[other[e][0]]
        above[e] = places_inside(a, b, x[g[0]], x[g[1]])
        slid[e] = slid[e] or above[e][0] < 0.0
    if other[e][1] >= 0:
        g = edges[other[e][1]]
        below[e] = places_inside(a, b, x[g[0]], x[g[1]])
        slid[e] = slid[e] or below[e][0] < 0.0


def found_again(
    found: Nearest, x: wp.array, triangles: wp.array, edges: wp.array, *, level: Level
) -> Bool[Tensor, " edges"]:
    """Write the closest points of now on what is closest; tells which edges' points have slid off an end.

    Args:
        found: What is closest, whose ``weight`` and ``place`` are written to.
        x: Positions [m].
        triangles: Corners of the faces.
        edges: Ends of the edges.
        level: The level.
    """
    slid, given = torch.zeros_like(found.edge[:, 0], dtype=torch.bool), {"device": level.device, "lanes": level.lanes}
    faces = [wp.from_torch(found.face, dtype=wp.vec2i), *[wp.from_torch(each, dtype=wp.vec3f) for each in found.weight]]
    Launch(faces_again, len(found.face), [x, triangles, *faces], **given)({})
    others = [wp.from_torch(found.edge, dtype=wp.vec2i)]
    others += [wp.from_torch(each, dtype=wp.vec2f) for each in found.place]
    Launch(edges_again, len(found.edge), [x, edges, *others, wp.from_torch(slid)], **given)({})
    return slid
