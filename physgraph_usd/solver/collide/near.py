"""All pairs of parts within a distance, and the shortest vector between the two parts."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportIndexIssue=false
from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..mesh.kernels import KERNELS
from ..mesh.threads import argument, run
from .distance import weights_of
from .pairs import Reach
from .parts import Parts
from .search import near_parts

wp.set_module_options(KERNELS)


@dataclass(frozen=True, eq=False)
class NearPairs:
    """Pairs of parts near one another.

    Attributes:
        corners: A vertex and the corners of a face, or the ends of two edges, shape (N, 4), int32.
        weight: Weights of the corners in the shortest vector from the second part to the first; rows sum to 0, shape
            (N, 4).
        way: Shortest vector [m], shape (N, 3).
        face: True for a vertex and a face, shape (N,).
    """

    corners: Int[Tensor, "pairs 4"]
    weight: Float[Tensor, "pairs 4"]
    way: Float[Tensor, "pairs 3"]
    face: Bool[Tensor, " pairs"]

    def where(self, kept: Int[Tensor, " kept"]) -> NearPairs:
        """The selected pairs."""
        return NearPairs(self.corners[kept], self.weight[kept], self.way[kept], self.face[kept])


@wp.kernel
def _closest(
    first: wp.int32,
    x: wp.array(dtype=wp.vec3d),
    corners: wp.array(dtype=wp.vec4i),
    face: wp.array(dtype=wp.bool),
    weight: wp.array(dtype=wp.vec4d),
):
    i = first + wp.tid()
    c = corners[i]
    weight[i] = weights_of(face[i], x[c[0]], x[c[1]], x[c[2]], x[c[3]])


def weights(
    x: Float[Tensor, "vertices 3"], corners: Int[Tensor, "pairs 4"], face: Bool[Tensor, " pairs"], *, threads: int = 1
) -> Float[Tensor, "pairs 4"]:
    """Weights of corners in the shortest vector from each pair's second part to its first, as in `NearPairs`.

    Args:
        x: Positions [m], float64.
        corners: A vertex and the corners of a face, or the ends of two edges, int32.
        face: True for a vertex and a face.
        threads: Most threads on the CPU.
    """
    out = torch.zeros((len(face), 4), dtype=torch.float64, device=x.device)
    inputs = [argument(x.contiguous(), wp.vec3d), argument(corners, wp.vec4i)]
    inputs += [argument(face), argument(out, wp.vec4d)]
    run(_closest, len(out), inputs, device=str(x.device), threads=threads)
    return out


def near_pairs(parts: Parts, x: Float[Tensor, "vertices 3"], near: Reach) -> NearPairs:
    """All vertex-face and edge-edge pairs without a common vertex within the search distance.

    Args:
        parts: The parts.
        x: Positions [m].
        near: Search radii; pairs near at rest may be included beyond the radii.
    """
    at = x.double()
    pairs = near_parts(parts, x, near)
    weight, corners = weights(at, pairs.corners, pairs.face, threads=parts.level.threads), pairs.corners.long()
    way = (weight.unsqueeze(2) * at[corners]).sum(dim=1)
    radius = near.radius[corners]
    of_face = radius[:, 0] + radius[:, 1:].amax(dim=1)
    of_edges = radius[:, :2].amax(dim=1) + radius[:, 2:].amax(dim=1)
    kept = torch.nonzero(way.norm(dim=1) < torch.where(pairs.face, of_face, of_edges)).squeeze(1)
    return NearPairs(pairs.corners[kept], weight[kept].to(x), way[kept].to(x), pairs.face[kept])
