"""Rays against triangles on the CPU, on all cores."""

# Warp reads a kernel's annotations itself; to a type checker they are calls, and vectors have no operators.
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportIndexIssue=false

from __future__ import annotations

import os
from typing import NamedTuple

import numpy as np
import warp as wp

from ...solver.mesh.threads import LEAST_QUERIES, Launch, start_warp

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(wp.float32(1e30))


class Hits(NamedTuple):
    """The first hit of each ray.

    Attributes:
        face: The triangle, -1 for none, shape (N,) int32.
        weights: Barycentric coordinates there, shape (N, 3) float32; anything where there is none.
        distance: From the ray's origin in lengths of its direction, shape (N,) float32.
    """

    face: np.ndarray
    weights: np.ndarray
    distance: np.ndarray


class Rays:
    """Triangles that rays can be cast at."""

    def __init__(self, points: np.ndarray, triangles: np.ndarray) -> None:
        """Build the index.

        Args:
            points: Positions, shape (V, 3).
            triangles: Corners, shape (T, 3), at least one.
        """
        start_warp()
        self._mesh = wp.Mesh(_vectors(points), wp.array(triangles.ravel(), dtype=wp.int32, device="cpu"))

    def free(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Whether each ray meets nothing, shape (N,) bool.

        Args:
            origins: Shape (N, 3).
            directions: Shape (N, 3), not zero.
        """
        hit = wp.zeros(len(origins), dtype=wp.int32, device="cpu")
        self._cast(_is_hit, origins, directions, hit)
        return np.asarray(hit.numpy() == 0)

    def first(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """The first hit of each ray, whichever side the triangle shows.

        Args:
            origins: Shape (N, 3).
            directions: Shape (N, 3), not zero.
        """
        made = [wp.zeros(len(origins), dtype=kind, device="cpu") for kind in (wp.int32, wp.vec3, wp.float32)]
        self._cast(_first, origins, directions, *made)
        return Hits(*(array.numpy() for array in made))

    def _cast(self, kernel: wp.Kernel, origins: np.ndarray, directions: np.ndarray, *made: wp.array) -> None:
        inputs = [self._mesh.id, _vectors(origins), _vectors(directions), *made]
        threads = os.cpu_count() or 1
        Launch(kernel, len(origins), inputs, device="cpu", threads=threads, least=LEAST_QUERIES)({})


def _vectors(values: np.ndarray) -> wp.array:
    return wp.array(np.ascontiguousarray(values, np.float32), dtype=wp.vec3, device="cpu", copy=False)


@wp.kernel
def _is_hit(
    first: int,
    mesh: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    hit: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    if wp.mesh_query_ray_anyhit(mesh, origins[i], directions[i], FAR):
        hit[i] = 1


@wp.kernel
def _first(
    first: int,
    mesh: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    face: wp.array(dtype=wp.int32),
    weights: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=wp.float32),
):
    i = first + wp.tid()
    hit = wp.mesh_query_ray(mesh, origins[i], directions[i], FAR)
    face[i] = -1
    if hit.result:
        face[i] = hit.face
        weights[i] = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
        distance[i] = hit.t
