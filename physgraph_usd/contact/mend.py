"""How the move of mended cloth changes round what crosses: it is smoothed, or taken back."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .cloth_mesh import ClothMesh


def smoothed(
    mesh: ClothMesh, shift: Float[Tensor, "vertices 3"], where: Bool[Tensor, " vertices"], *, passes: int
) -> Float[Tensor, "vertices 3"]:
    """Displacements averaged over neighbours again and again within a region; held outside [m]."""
    which = np.flatnonzero((where & mesh.level.free[:, 0]).cpu().numpy())
    rows = mesh.beside[which]
    share = 1.0 / np.maximum(np.asarray(rows.sum(axis=1)), 1.0)
    values = shift.cpu().numpy().copy()
    for _ in range(passes):
        values[which] = share * (rows @ values)
    return torch.as_tensor(values).to(shift)


def falling_off(mesh: ClothMesh, back: Bool[Tensor, " vertices"], rings: int) -> Float[Tensor, "vertices 1"]:
    """0 within some rings of given vertices, rising to 1 over as many rings more."""
    inner = mesh.grown(back, rings - 1)
    kept = 1.0 - inner.to(mesh.level.rest)
    for step in range(rings):
        inner_next = mesh.grown(inner, 1)
        kept = torch.where(inner_next & ~inner, torch.full_like(kept, (step + 1) / (rings + 1)), kept)
        inner = inner_next
    return kept.unsqueeze(1)
