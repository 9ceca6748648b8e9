"""Contact per vertex for heat maps, measured from positions alone, like `measure`."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import warp as wp

from ..colliders.base import Surface
from ..colliders.mesh import MeshSurface
from ..mesh.kernels import KERNELS
from ..mesh.threads import Launch
from .measure import depths

wp.set_module_options(KERNELS)

LAYERS = wp.constant(8)
"""Most faces found along an edge."""


@wp.kernel
def _mark(
    first: wp.int32,
    mesh: wp.uint64,
    start: wp.array(dtype=wp.vec3f),
    end: wp.array(dtype=wp.vec3f),
    edge: wp.array(dtype=wp.int32),
    face: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    length = wp.length(end[i] - start[i])
    if length > 0.0:
        along = (end[i] - start[i]) / length
        gone = wp.float32(0.0)
        for _ in range(LAYERS):
            query = wp.mesh_query_ray(mesh, start[i] + gone * along, along, length - gone)
            if query.result and gone < length:
                edge[i] = 1
                face[query.face] = 1
                gone += query.t + 1.0e-6 * length


def penetration_map(surfaces: Sequence[Surface], points: np.ndarray, *, device: str = "cpu") -> np.ndarray:
    """Depth of each vertex in the deepest of some bodies [mm].

    In a closed body the depth is the length of the way out; behind an open surface with a fixed side, the distance.
    Open surfaces whose side comes from the cage have no inside.

    Args:
        surfaces: The posed bodies.
        points: World positions [m], shape (V, 3), float64.
        device: "cpu" or a CUDA device.

    Returns:
        Shape (V,), float32, 0 outside.
    """
    deepest = torch.zeros(len(points), dtype=torch.float64, device=device)
    for surface in surfaces:
        x = torch.as_tensor(points - surface.origin, dtype=torch.float64, device=device)
        if surface.closed:
            depth = depths(surface, x, surface.inside(x), float("inf"))[0]
        else:
            found = surface.closest(x, torch.full_like(deepest, float("inf")))
            depth = torch.where(found.is_behind(surface.fixed_side or 0.0), found.distance, 0.0)
        deepest = torch.maximum(deepest, depth)
    return (1e3 * deepest).to(torch.float32).cpu().numpy()


def body_crossings(
    surfaces: Sequence[Surface], points: np.ndarray, edges: np.ndarray, *, triangles: np.ndarray, device: str = "cpu"
) -> np.ndarray:
    """Mask of the corners of cloth edges and faces that cross a body.

    A primitive marks the ends of edges with one end inside.

    Args:
        surfaces: The posed bodies.
        points: World positions [m], shape (V, 3), float64.
        edges: Edges of the cloth, shape (E, 2).
        triangles: Faces of the cloth, shape (T, 3).
        device: "cpu" or a CUDA device.

    Returns:
        Shape (V,), bool.
    """
    marks = np.zeros(len(points), bool)
    for surface in surfaces if len(edges) and len(triangles) else ():
        x = points - surface.origin
        if not isinstance(surface, MeshSurface):
            inside = surface.inside(torch.as_tensor(x, device=device)).cpu().numpy()[edges]
            marks[edges[inside[:, 0] != inside[:, 1]].ravel()] = True
            continue
        pierced, _ = _marked(surface.mesh, x[edges[:, 0]], x[edges[:, 1]], device=device)
        marks[edges[pierced].ravel()] = True
        cloth = wp.Mesh(
            points=wp.array(x.astype(np.float32), dtype=wp.vec3f, device=device),
            indices=wp.array(np.ascontiguousarray(triangles, np.int32).ravel(), dtype=wp.int32, device=device),
        )
        start, end = (surface.mesh.points.numpy()[surface.edges[:, side]] for side in (0, 1))
        meets = ((np.maximum(start, end) >= x.min(axis=0)) & (np.minimum(start, end) <= x.max(axis=0))).all(axis=1)
        _, faces = _marked(cloth, start[meets], end[meets], device=device)
        marks[triangles[faces].ravel()] = True
    return marks


def _marked(mesh: wp.Mesh, start: np.ndarray, end: np.ndarray, *, device: str) -> tuple[np.ndarray, np.ndarray]:
    """Masks of the segments that meet a mesh, shape (S,), and of the faces met, shape (F,)."""
    segments = [
        wp.array(np.ascontiguousarray(each, np.float32), dtype=wp.vec3f, device=device) for each in (start, end)
    ]
    marks = [wp.zeros(count, dtype=wp.int32, device=device) for count in (len(start), len(mesh.indices) // 3)]
    if len(start):
        Launch(_mark, len(start), [mesh.id, *segments, *marks], device=device)({})
    edge, face = (each.numpy() > 0 for each in marks)
    return edge, face
