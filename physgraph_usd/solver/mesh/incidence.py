"""Which corners of elements lie at each vertex."""

from __future__ import annotations

import torch
from jaxtyping import Int
from torch import Tensor


def incidence(
    elements: Int[Tensor, "elements corners"], vertex_count: int
) -> tuple[Int[Tensor, " starts"], Int[Tensor, " slots"]]:
    """List the corners at each vertex, in compressed rows for gathers by vertex.

    Contact makes such rows in every round, so they are sorted where the elements lie.

    Args:
        elements: Vertices of each element, shape (N, K).
        vertex_count: Number of vertices V.

    Returns:
        Where each vertex's row starts, shape (V + 1,), int32; and element * K + corner of each entry, ascending within
        a row, shape (N K,), int32.
    """
    flat = elements.reshape(-1)
    starts = torch.zeros(vertex_count + 1, dtype=torch.int32, device=elements.device)
    starts[1:] = torch.bincount(flat, minlength=vertex_count).cumsum(dim=0)
    return starts, torch.argsort(flat, stable=True).to(torch.int32)
