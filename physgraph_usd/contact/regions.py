"""Where cloth may touch cloth: patches round the cage's vertices, their boxes and their normals.

Two patches that are no near neighbours can only touch where their boxes meet. Near neighbours can only touch where the
cloth turns over: a piece whose normals all lie within a right angle of one direction does not touch itself (Volino and
Magnenat-Thalmann 1994). Everywhere else nothing is asked.
"""

# Warp's arrays are typed by values that only Warp reads.
# pyright: reportArgumentType=false
from __future__ import annotations

import math

import numpy as np
import scipy.sparse as sp
import torch
import warp as wp
from jaxtyping import Bool, Float
from torch import Tensor

from ..level import Level
from ..mesh.lanes import Launch
from .proximity import patches_meet

TURNED = math.radians(85.0)
"""Angle from a piece's mean normal beyond which it may touch itself."""


class Regions:
    """The patches of one level."""

    def __init__(self, cage: Level, level: Level, meets: np.ndarray) -> None:
        """Give each vertex to the cage vertex that weighs most in it.

        Args:
            cage: The cage.
            level: The level.
            meets: Which garments feel which, symmetric, shape (G, G), bool.
        """
        self._level, self._count = level, cage.vertex_count
        device = level.device
        patch = np.asarray(level.from_coarse.argmax(axis=1)).ravel().astype(np.int64)
        self._patch = torch.as_tensor(patch, device=device)
        self._triangles = level.triangles.long()
        self._triangle_patch = self._patch[self._triangles[:, 0]]
        self._by_patch = torch.argsort(self._triangle_patch, stable=True)
        counts = torch.bincount(self._triangle_patch, minlength=self._count)
        self._first = torch.cat([counts.new_zeros(1), torch.cumsum(counts, 0)])
        ring, near = _rings(cage.edges.cpu().numpy(), cage.vertex_count)
        self._ring = sp.coo_matrix(ring)
        self._centre, self._member = (
            torch.as_tensor(each.astype(np.int64), device=device) for each in (self._ring.row, self._ring.col)
        )
        self._within = bool(np.diag(meets).any())
        self._static = [
            wp.array(near.indptr.astype(np.int32), dtype=wp.int32, device=device),
            wp.array(near.indices.astype(np.int32), dtype=wp.int32, device=device),
            wp.from_torch(cage.vertex_garment.contiguous()),
            wp.array(np.asarray(meets).astype(np.int32).ravel(), dtype=wp.int32, device=device),
            wp.int32(len(cage.spans)),
        ]

    def busy(self, x: Float[Tensor, "vertices 3"], reach: float) -> Bool[Tensor, " vertices"]:
        """Which vertices are in patches that may touch something.

        Args:
            x: Positions [m].
            reach: Distance under which two parts count as touching [m].
        """
        flags = self._boxes_meet(x, reach)
        if self._within:
            flags = flags | self._turned(x)
        return flags[self._patch]

    def _boxes_meet(self, x: Tensor, reach: float) -> Bool[Tensor, " patches"]:
        x = x.to(torch.float32)
        index = self._patch.unsqueeze(1).expand(-1, 3)
        corner = x[self._triangles]
        grow = 0.5 * (reach + float((corner - corner.roll(1, dims=1)).norm(dim=2).max())) if len(corner) else 0.0
        low = torch.full((self._count, 3), float("inf"), dtype=torch.float32, device=x.device)
        low = low.scatter_reduce_(0, index, x, "amin") - grow
        high = torch.full_like(low, float("-inf")).scatter_reduce_(0, index, x, "amax") + grow
        flag = torch.zeros(self._count, dtype=torch.int32, device=x.device)
        empty = ~low.isfinite().all(dim=1) | ~high.isfinite().all(dim=1)
        low[empty], high[empty] = 1e30, 1e30  # A cage vertex without fine ones is nowhere.
        boxes = [wp.from_torch(each.contiguous(), dtype=wp.vec3f) for each in (low, high)]
        tree = wp.Bvh(*boxes)
        inputs = [tree.id, *boxes, *self._static, wp.from_torch(flag)]
        Launch(patches_meet, self._count, inputs, device=self._level.device, lanes=self._level.lanes)({})
        return (flag > 0) & ~empty

    def _turned(self, x: Tensor) -> Bool[Tensor, " patches"]:
        """Patches in a ring of patches that turns over."""
        corner = x.to(torch.float32)[self._triangles]
        area = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        total = torch.zeros((self._count, 3), dtype=torch.float32, device=x.device)
        total.index_put_((self._triangle_patch,), area, accumulate=True)
        axis = torch.nn.functional.normalize(total, dim=1, eps=1e-30)
        unit = torch.nn.functional.normalize(area, dim=1, eps=1e-30)
        cosine = (unit * axis[self._triangle_patch]).sum(dim=1)
        least = torch.ones(self._count, dtype=torch.float32, device=x.device)
        least.scatter_reduce_(0, self._triangle_patch, cosine, "amin")
        spread = torch.arccos(least.clamp(-1.0, 1.0))
        sums = torch.zeros_like(total).index_put_((self._centre,), total[self._member], accumulate=True)
        mean = torch.nn.functional.normalize(sums, dim=1, eps=1e-30)
        angle = torch.arccos((mean[self._centre] * axis[self._member]).sum(dim=1).clamp(-1.0, 1.0))
        over = angle + spread[self._member] > TURNED
        turned = torch.zeros(self._count, dtype=torch.bool, device=x.device)
        turned[self._centre[over]] = True
        # The sum of angles is a bound; where it is exceeded, each triangle is held against the ring's mean.
        return self._marked(turned, unit, mean)

    def _marked(self, turned: Tensor, unit: Tensor, mean: Tensor) -> Bool[Tensor, " patches"]:
        """All patches of rings in which some triangle turns away from the ring's mean normal."""
        rings = turned[self._centre]
        centre, member = self._centre[rings], self._member[rings]
        first, count = self._first[member], self._first[member + 1] - self._first[member]
        pair = torch.repeat_interleave(torch.arange(len(member), device=unit.device), count)
        start = torch.cumsum(count, 0) - count
        triangle = self._by_patch[torch.arange(len(pair), device=unit.device) - start[pair] + first[pair]]
        away = (unit[triangle] * mean[centre[pair]]).sum(dim=1) < math.cos(TURNED)
        over = torch.zeros(self._count, dtype=torch.bool, device=unit.device)
        over[centre[pair[away]]] = True
        out = torch.zeros_like(over)
        out[self._member[over[self._centre]]] = True
        return out


def _rings(edges: np.ndarray, count: int) -> tuple[sp.csr_matrix, sp.csr_matrix]:
    """Which cage vertices are the same or joined by an edge, and which are so by at most two."""
    both = np.concatenate([edges, edges[:, ::-1], np.repeat(np.arange(count), 2).reshape(-1, 2)])
    ring = sp.csr_matrix((np.ones(len(both), np.int32), (both[:, 0], both[:, 1])), shape=(count, count))
    return ring, sp.csr_matrix(ring @ ring)
