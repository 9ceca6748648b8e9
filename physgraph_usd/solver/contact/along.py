"""Least-squares correction of blocked displacements: the closest displacements that keep all blocking pairs apart."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportIndexIssue=false
from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..collide.distance import weights
from ..collide.pairs import Pairs
from ..collide.separation import TIGHT
from ..mesh.kernels import KERNELS
from ..mesh.stencil import incidence
from ..mesh.threads import Launch, argument

wp.set_module_options(KERNELS)

COMES = 0.8
"""Fraction of the approach allowed by the promise that a pair may use; the rest absorbs the residual of the passes."""
JACOBI_PASSES = 16
"""Jacobi passes over the pairs. `safe_move` shortens displacements that still violate a plane afterwards."""


@wp.kernel
def _push_apart(
    first: wp.int32,
    corners: wp.array(dtype=wp.vec4i),
    weight: wp.array(dtype=wp.vec4d),
    normal: wp.array(dtype=wp.vec3d),
    may: wp.array(dtype=wp.float64),
    stiffness: wp.array(dtype=wp.float64),
    displacement: wp.array(dtype=wp.vec3d),
    push: wp.array(dtype=wp.float64),
):
    """Update the multiplier of a pair from the approach of both parts."""
    n = first + wp.tid()
    nearer = wp.float64(0.0)
    for k in range(4):
        along_it = wp.cw_mul(normal[n], displacement[corners[n][k]])
        nearer += weight[n][k] * (along_it[0] + along_it[1] + along_it[2])
    push[n] = wp.max(push[n] - (nearer + may[n]) / stiffness[n], wp.float64(0.0))


@wp.kernel
def _add_pushes(
    first: wp.int32,
    starts: wp.array(dtype=wp.int32),
    slots: wp.array(dtype=wp.int32),
    gives: wp.array(dtype=wp.vec4d),
    normal: wp.array(dtype=wp.vec3d),
    push: wp.array(dtype=wp.float64),
    wanted: wp.array(dtype=wp.vec3d),
    displacement: wp.array(dtype=wp.vec3d),
):
    """Add to each vertex's wanted displacement the pushes of the vertex's pairs."""
    v = first + wp.tid()
    total = wanted[v]
    for k in range(starts[v], starts[v + 1]):
        n = slots[k] // 4
        total += push[n] * gives[n][slots[k] - 4 * n] * normal[n]
    displacement[v] = total


@dataclass(frozen=True, eq=False)
class ApproachLimits:
    """One linear inequality on the displacements for each pair: the parts may approach by at most `may` along `normal`.

    Attributes:
        corners: Vertices of each pair, shape (N, 4), int32.
        weight: Weights of the vertices in the vector between the parts, shape (N, 4).
        normal: Unit vectors between the parts, shape (N, 3).
        may: Largest approach of the parts along the normal [m], shape (N,).
    """

    corners: Int[Tensor, "pairs 4"]
    weight: Float[Tensor, "pairs 4"]
    normal: Float[Tensor, "pairs 3"]
    may: Float[Tensor, " pairs"]

    @staticmethod
    def of(x: Tensor, ends: Tensor, met: Pairs, floor: float, *, corners: bool = False) -> ApproachLimits:
        """Limits along the shortest vectors between the parts of pairs, as far on the move as a plane keeps them apart.

        Args:
            x: Positions [m], float64, shape (V, 3).
            ends: Positions after the move [m], float64, shape (V, 3).
            met: Pairs that come too near on the move.
            floor: Gap that pairs keep [m]; a pair that is already closer keeps most of its distance.
            corners: True limits the two corners that are nearest at the ends, False the closest points.
        """
        met = met.where(_distinct(met, len(x)))
        vertices, face = met.corners.long(), met.face.bool()
        at, to = x[vertices], ends[vertices]
        distance = _between(at, face)[1].norm(dim=1)
        weight, vector = _between(at + met.value.reshape(-1, 1, 1) * (to - at), face)
        normal = vector / vector.norm(dim=1, keepdim=True).clamp_min(1e-300)
        if corners:
            weight = _nearest(to @ normal.unsqueeze(2), face)
        gap = (weight * (at @ normal.unsqueeze(2)).squeeze(2)).sum(dim=1)
        may = COMES * (distance - (TIGHT * distance).clamp_max(floor))
        return ApproachLimits(met.corners, weight, normal, gap - distance + may)

    def joined(self, limits: ApproachLimits) -> ApproachLimits:
        """These limits, followed by further limits."""
        pairs = ((getattr(self, field.name), getattr(limits, field.name)) for field in fields(self))
        return ApproachLimits(*(torch.cat(pair) for pair in pairs))


def along(
    displacements: Float[Tensor, "vertices 3"],
    planes: ApproachLimits,
    *,
    free: Bool[Tensor, "vertices 1"],
    threads: int = 1,
) -> Float[Tensor, "vertices 3"]:
    """Displacements closest to the wanted displacements [m] that violate no plane.

    Only the relative motion of a pair's two parts counts: layers that move together are not stopped. The least-squares
    problem with one linear inequality per pair is solved by Jacobi's method on the multipliers, with each vertex split
    among its pairs (Tonge et al. 2012).

    Args:
        displacements: Wanted displacement of each vertex [m], float64.
        planes: ApproachLimits of the blocking pairs.
        free: Vertices whose displacement may be changed.
        threads: Most threads on the CPU.
    """
    if not len(planes.may):
        return displacements
    used, rows = torch.unique(planes.corners.long(), return_inverse=True)
    weight, wanted = planes.weight.contiguous(), displacements[used]
    starts, slots = incidence(rows, len(used))
    gives = (weight * free[used][rows].squeeze(2)).contiguous()
    count = starts.diff().to(displacements)
    stiffness = (gives.square() * count[rows]).sum(dim=1).clamp_min(1e-300)
    pairs = [argument(rows.to(torch.int32), wp.vec4i), *(argument(table, wp.vec4d) for table in (weight, gives))]
    pairs += [_vectors(planes.normal)]
    moved = wanted.clone()
    push, out = argument(torch.zeros_like(planes.may)), _vectors(moved)
    push_apart = [*pairs[:2], pairs[3], argument(planes.may), argument(stiffness), out, push]
    add_pushes = [argument(starts), argument(slots), pairs[2], pairs[3], push, _vectors(wanted), out]
    device = str(displacements.device)
    launches = [
        Launch(_push_apart, len(rows), push_apart, device=device, threads=threads),
        Launch(_add_pushes, len(used), add_pushes, device=device, threads=threads),
    ]
    for launch in launches * JACOBI_PASSES:
        launch({})
    return displacements.index_copy(0, used, moved)


def _between(at: Float[Tensor, "pairs 4 3"], face: Tensor) -> tuple[Float[Tensor, "pairs 4"], Float[Tensor, "pairs 3"]]:
    """Weights of each pair's corners in the shortest vector between its parts, and the vector, from positions [m]."""
    corners = torch.arange(4 * len(at), dtype=torch.int32, device=at.device).reshape(-1, 4)
    weight = weights(at.reshape(-1, 3), corners, face)
    return weight, (weight.unsqueeze(2) * at).sum(dim=1)


def _nearest(height: Float[Tensor, "pairs 4 1"], face: Bool[Tensor, " pairs"]) -> Float[Tensor, "pairs 4"]:
    """1 for the lowest corner of each pair's first part, -1 for the highest of its second, by heights [m]."""
    heights = height.squeeze(2)
    is_first = torch.arange(4, device=heights.device) < torch.where(face, 1, 2).unsqueeze(1)
    low = torch.where(is_first, heights, torch.inf).argmin(dim=1, keepdim=True)
    high = torch.where(is_first, -torch.inf, heights).argmax(dim=1, keepdim=True)
    return torch.zeros_like(heights).scatter(1, low, 1.0).scatter(1, high, -1.0)


def _distinct(met: Pairs, count: int) -> Int[Tensor, " pairs"]:
    """Indices of distinct pairs, in the order of their corners.

    Two integer sorts, about ten times as fast as `torch.unique` of rows.

    Args:
        met: Pairs, possibly repeated.
        count: Number of vertices.
    """
    a, b, c, d = met.corners.long().T
    first, second = a * count + b, 2 * (c * count + d) + met.face
    order = torch.argsort(second, stable=True)
    order = order[torch.argsort(first[order], stable=True)]
    first, second = first[order], second[order]
    is_first = torch.ones_like(first, dtype=torch.bool)
    is_first[1:] = (first[1:] != first[:-1]) | (second[1:] != second[:-1])
    return order[torch.nonzero(is_first).squeeze(1)]


def _vectors(x: Tensor) -> Any:
    return argument(x.contiguous(), wp.vec3d)
