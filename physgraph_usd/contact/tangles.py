"""Tangles: what crosses at the start of a move, each with what lies round it, to which less is promised."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from ..collide.crossings import Crossings
from ..mesh.topology import joined_by
from .cloth_mesh import ClothMesh


@dataclass(frozen=True, eq=False)
class Tangles:
    """The tangles of one level's cloth.

    Attributes:
        label: The tangle that each vertex is in, -1 where in none, shape (V,), int32.
        number: How many there are.
    """

    label: Int[Tensor, " vertices"]
    number: int
    _mesh: ClothMesh

    @staticmethod
    def find(mesh: ClothMesh, crossings: Crossings, *, rings: int) -> Tangles:
        """What crosses, and what is within some rings of it; what hangs together there, or crosses, is one.

        Args:
            mesh: The cloth.
            crossings: What crosses.
            rings: How far round that.
        """
        region = mesh.grown(mesh.crossed(crossings), rings)
        edges, corners = mesh.level.edges.long(), mesh.corners_of(crossings)
        inside = edges[region[edges].all(dim=1)]
        across = torch.cat([corners[:, [0, place]] for place in range(1, 5)])
        piece = joined_by(torch.cat([inside, across]).cpu().numpy(), mesh.level.vertex_count)
        which = region.cpu().numpy()
        label = np.full(len(which), -1, np.int32)
        numbers, label[which] = np.unique(piece[which], return_inverse=True)
        return Tangles(torch.as_tensor(label, device=region.device), len(numbers), mesh)

    def counts(self, crossings: Crossings) -> Int[Tensor, " tangles"]:
        """How much crosses in each."""
        of = self.label[self._mesh.corners_of(crossings)].amax(dim=1).long()
        return torch.bincount(of.clamp_min(0), minlength=self.number)
