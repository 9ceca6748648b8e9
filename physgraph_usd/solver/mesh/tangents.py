"""Frames that turn with a surface: a vertex's tangent is a fixed linear combination of its triangles' edges."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float
from torch import Tensor


def orthonormal(
    normal: Float[Tensor, "vertices 3"], tangent: Float[Tensor, "vertices 3"]
) -> Float[Tensor, "vertices 3 3"]:
    """Frames from normals and rough tangents, columns are tangent, bitangent, normal; any where both vanish."""
    normal = torch.nn.functional.normalize(normal, dim=1, eps=1e-30)
    tangent = tangent - (tangent * normal).sum(dim=1, keepdim=True) * normal
    tangent = torch.nn.functional.normalize(tangent, dim=1, eps=1e-30)
    return torch.stack([tangent, torch.linalg.cross(normal, tangent), normal], dim=2)


def tangent_operator(triangles: np.ndarray, rest: np.ndarray) -> sp.csr_matrix:
    """Sparse map from cage positions to one tangent a vertex.

    A vertex's reference direction at rest is projected into each incident triangle and written as a combination of that
    triangle's two edges; the same combination of the deformed edges is that triangle's vote.

    Args:
        triangles: Corner vertices, shape (T, 3).
        rest: Rest positions [m], shape (C, 3), float64.
    """
    count = len(rest)
    reference = _reference_directions(triangles, rest)
    rows, columns, values = [], [], []
    first, second = rest[triangles[:, 1]] - rest[triangles[:, 0]], rest[triangles[:, 2]] - rest[triangles[:, 0]]
    a, b, c = (np.einsum("tc,tc->t", u, v) for u, v in ((first, first), (first, second), (second, second)))
    determinant = a * c - b * b
    sound = determinant > 1e-12 * a * c
    inverse = np.where(sound, 1.0 / np.where(sound, determinant, 1.0), 0.0)
    area = np.sqrt(np.maximum(determinant, 0.0))
    for corner in range(3):
        vertex = triangles[:, corner]
        p = np.einsum("tc,tc->t", first, reference[vertex])
        q = np.einsum("tc,tc->t", second, reference[vertex])
        along_first, along_second = area * inverse * (c * p - b * q), area * inverse * (a * q - b * p)
        rows += [vertex] * 3
        columns += [triangles[:, 0], triangles[:, 1], triangles[:, 2]]
        values += [-along_first - along_second, along_first, along_second]
    triplets = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sp.csr_matrix(triplets, shape=(count, count))


def _reference_directions(triangles: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """One tangent direction per cage vertex in the rest shape: its first edge, projected."""
    normal = np.zeros_like(rest)
    area = np.cross(rest[triangles[:, 1]] - rest[triangles[:, 0]], rest[triangles[:, 2]] - rest[triangles[:, 0]])
    for corner in range(3):
        np.add.at(normal, triangles[:, corner], area)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    direction = np.zeros_like(rest)
    for corner in (2, 1, 0):
        direction[triangles[:, corner]] = rest[triangles[:, (corner + 1) % 3]] - rest[triangles[:, corner]]
    return direction - np.einsum("vc,vc->v", direction, normal)[:, None] * normal


def mean_edge(triangles: np.ndarray, rest: np.ndarray) -> float:
    """Mean edge of triangles [m]; 1 where there are none."""
    if not len(triangles):
        return 1.0
    sides = rest[triangles] - rest[np.roll(triangles, 1, axis=1)]
    return max(float(np.linalg.norm(sides, axis=2).mean()), 1e-12)
