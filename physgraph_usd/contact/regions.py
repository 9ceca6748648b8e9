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
from .proximity import any_of_ring, patch_areas, patches_meet, rings_turn

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
        wp.init()  # Views of tensors do not start Warp by themselves.
        self._level, self._count = level, cage.vertex_count
        device = level.device
        patch = np.asarray(level.from_coarse.argmax(axis=1)).ravel().astype(np.int64)
        self._patch = torch.as_tensor(patch, device=device)
        self._triangles = level.triangles.long()
        owner = self._patch[self._triangles[:, 0]]
        counts = torch.bincount(owner, minlength=self._count)
        first = torch.cat([counts.new_zeros(1), torch.cumsum(counts, 0)])
        members = torch.argsort(owner, stable=True)
        self._pieces = [
            *(wp.from_torch(each.to(torch.int32)) for each in (first, members)),
            wp.array(level.triangles.cpu().numpy(), dtype=wp.vec3i, device=device),
        ]
        ring, near = _rings(cage.edges.cpu().numpy(), cage.vertex_count)
        self._ring = [
            wp.array(each.astype(np.int32), dtype=wp.int32, device=device) for each in (ring.indptr, ring.indices)
        ]
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
        self._run(patches_meet, inputs)
        return (flag > 0) & ~empty

    def _turned(self, x: Tensor) -> Bool[Tensor, " patches"]:
        """Patches in a ring of patches that turns over."""
        points = wp.from_torch(x.to(torch.float32).contiguous(), dtype=wp.vec3f)
        total = wp.zeros(self._count, dtype=wp.vec3f, device=self._level.device)
        over, out = (torch.zeros(self._count, dtype=torch.int32, device=x.device) for _ in range(2))
        cosine = wp.float32(math.cos(TURNED))
        flags = [wp.from_torch(each) for each in (over, out)]
        self._run(patch_areas, [*self._pieces, points, total])
        self._run(rings_turn, [*self._ring, *self._pieces, points, total, cosine, flags[0]])
        self._run(any_of_ring, [*self._ring, *flags])
        return out > 0

    def _run(self, kernel: wp.Kernel, inputs: list[object]) -> None:
        """Launch over the patches."""
        Launch(kernel, self._count, inputs, device=self._level.device, lanes=self._level.lanes)({})


def _rings(edges: np.ndarray, count: int) -> tuple[sp.csr_matrix, sp.csr_matrix]:
    """Which cage vertices are the same or joined by an edge, and which are so by at most two."""
    both = np.concatenate([edges, edges[:, ::-1], np.repeat(np.arange(count), 2).reshape(-1, 2)])
    ring = sp.csr_matrix((np.ones(len(both), np.int32), (both[:, 0], both[:, 1])), shape=(count, count))
    return ring, sp.csr_matrix(ring @ ring)
