"""Where a descent from a coarser mesh starts: without its facets, and off the saddle.

A linear map from a coarser mesh leaves its triangles flat and its edges sharp. Bending is weak beside stretch at the
size of an edge, so the metric hardly sees such facets and a descent ends before they are gone. A smooth map takes them
out; only across the surface, for in its plane the linear one is right.

Flat compressed cloth has no force out of its plane, and no integrator would ever buckle it.

Where edges are shorter than at rest and the cloth is still flat, vertices start a little off the surface, up and down
by a fixed pattern. The amplitude is a part of what takes the compression up: an edge of strain s does so with a slope
of sqrt(2 s), so what slope there is already counts against it. The start is kept only if it has less energy.
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
"""Part of the slope that is lacking, in edge lengths: from 0.3 to 1 the answers are equally good."""
LEAST_COMPRESSION = 1e-3
"""Compression that cloth takes in its plane."""
TRIES = 4


def facets(
    level: Level,
    x: Float[Tensor, "vertices 3"],
    coarse: Float[Tensor, "coarse 3"],
    smooth: Callable[[Tensor], Tensor],
) -> Float[Tensor, "vertices 3"]:
    """The move across the surface that takes a coarser mesh's facets out [m]; 0 where a vertex may not move.

    Args:
        level: The level.
        x: Where a linear map put its vertices [m].
        coarse: Vertices of that mesh [m].
        smooth: The smooth map from there.
    """
    normal = _normals(level, x)
    return ((smooth(coarse) - x) * normal).sum(dim=1, keepdim=True) * normal * level.free


def leave_saddle(
    system: System, level: Level, x: Float[Tensor, "vertices 3"], *, outward: Float[Tensor, " garments"]
) -> Float[Tensor, "vertices 3"]:
    """Positions from which compressed cloth can buckle.

    Args:
        system: The level in this frame.
        level: The same level's topology and rest shape.
        x: Start positions [m].
        outward: 1 for garments whose winding is counter-clockwise seen from outside, else -1.

    Returns:
        Positions [m] of no more energy than x; x itself where nothing is compressed and flat.
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
    """How much steeper each vertex's edges would have to be, over sqrt(2), and the normals."""
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
    """Unit normals of the vertices, by the areas round them; 0 where there are none."""
    places = level.triangles.long().T.reshape(-1)
    normal = add_at(torch.zeros_like(x), places, level.normals(x).repeat(3, 1))
    return torch.nn.functional.normalize(normal, dim=1, eps=1e-30)


def _pattern(count: int) -> Float[Tensor, " vertices"]:
    """Numbers between -1 and 1 that depend on the vertex alone (the finaliser of SplitMix64)."""
    bits = (np.arange(count, dtype=np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    bits = bits ^ (bits >> np.uint64(31))
    return torch.as_tensor((bits >> np.uint64(11)).astype(np.float64) / 2.0**52 - 1.0)
