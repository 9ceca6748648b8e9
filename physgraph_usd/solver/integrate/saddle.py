"""Start of a descent from a coarser mesh: removes the coarser mesh's facets, and leaves the saddle.

A linear map from a coarser mesh leaves flat triangles and sharp edges. Bending is weak compared with stretch at the
size of an edge, so the metric hardly sees the facets and a descent ends before the facets are gone. A smooth map
removes them; it is used across the surface only, because in the plane the linear map is right.

Flat compressed cloth has no force out of its plane, and no integrator would ever buckle it.

If edges are shorter than at rest and the cloth is still flat, vertices start a little off the surface, up and down by a
fixed pattern. The amplitude is a fraction of the full relief: an edge of strain s is relieved by a slope of sqrt(2 s),
less any existing slope. The new start is kept only if its energy is lower.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..level import Level
from ..mesh.stencil import add_at
from .base import System

AMPLITUDE = 0.3
"""Fraction of the missing slope, in edge lengths: values from 0.3 to 1 give equally good results."""
LEAST_COMPRESSION = 1e-3
"""Compression tolerated in the cloth's plane."""
TRIES = 4


def facets(
    level: Level, x: Float[Tensor, "vertices 3"], coarse: Float[Tensor, "coarse 3"], smooth: Callable[[Tensor], Tensor]
) -> Float[Tensor, "vertices 3"]:
    """The move across the surface to remove a coarser mesh's facets [m]; 0 at fixed vertices.

    Args:
        x: Vertices placed by a linear map [m].
        coarse: Vertices of the coarser mesh [m].
        smooth: The smooth map from the coarser mesh.
    """
    normal = _normals(level, x)
    return ((smooth(coarse) - x) * normal).sum(dim=1, keepdim=True) * normal * level.free


def leave_saddle(
    system: System, level: Level, x: Float[Tensor, "vertices 3"], *, outward: Float[Tensor, " garments"]
) -> Float[Tensor, "vertices 3"]:
    """Start positions for compressed cloth to buckle.

    Args:
        system: The level in this frame.
        level: The same level's topology and rest shape.
        x: Start positions [m].
        outward: 1 for garments wound counter-clockwise seen from outside, else -1.

    Returns:
        Positions [m] with no more energy than x; x itself if nothing is compressed and flat.
    """
    missing, normal = _missing_slope(level, x)
    if not bool((missing > 0).any()):
        return x
    sign = _pattern(level.vertex_count).to(x) * outward.to(x)[level.vertex_garment.long()]
    offset = (AMPLITUDE * level.spacing * missing * sign).unsqueeze(1) * normal * level.free
    energy = system.energy_and_force(x)[0]
    for halving in range(TRIES):
        trial = x + 0.5**halving * offset
        if system.energy_and_force(trial)[0] < energy:
            return trial
    return x


def _missing_slope(
    level: Level, x: Float[Tensor, "vertices 3"]
) -> tuple[Float[Tensor, " vertices"], Float[Tensor, "vertices 3"]]:
    """Missing slope of each vertex's edges, over sqrt(2), and the normals."""
    normal = _normals(level, x)
    ends = level.edges.long()
    span = x[ends[:, 1]] - x[ends[:, 0]]
    length = span.norm(dim=1)
    compression = (1.0 - LEAST_COMPRESSION - length / level.rest_length).clamp_min(0.0)
    along = span / length.clamp_min(1e-30).unsqueeze(1)
    strain, slope, degree = (torch.zeros_like(level.spacing) for _ in range(3))
    for side in (ends[:, 0], ends[:, 1]):
        add_at(strain, side, compression)
        add_at(slope, side, (along * normal[side]).sum(dim=1).square())
        add_at(degree, side, torch.ones_like(length))
    degree = degree.clamp_min(1.0)
    return ((strain / degree).sqrt() - (slope / degree).sqrt()).clamp_min(0.0), normal


def _normals(level: Level, x: Tensor) -> Float[Tensor, "vertices 3"]:
    """Unit normals of the vertices, weighted by area; 0 without area."""
    vertices = level.triangles.long().T.reshape(-1)
    normal = add_at(torch.zeros_like(x), vertices, level.normals(x).repeat(3, 1))
    return torch.nn.functional.normalize(normal, dim=1, eps=1e-30)


def _pattern(count: int) -> Float[Tensor, " vertices"]:
    """Numbers between -1 and 1 depending only on the vertex number (the finaliser of SplitMix64)."""
    bits = (np.arange(count, dtype=np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    bits = bits ^ (bits >> np.uint64(31))
    return torch.as_tensor((bits >> np.uint64(11)).astype(np.float64) / 2.0**52 - 1.0)
