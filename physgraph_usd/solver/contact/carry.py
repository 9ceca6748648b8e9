"""What all cloth in a place has in common of its ways: layers that move together are carried together."""

from __future__ import annotations

import itertools

import torch
from jaxtyping import Float
from torch import Tensor

from ..mesh.stencil import add_at


def carried(
    x: Float[Tensor, "vertices 3"], way: Float[Tensor, "vertices 3"], *, width: float
) -> Float[Tensor, "vertices 3"]:
    """The part of each vertex's way that cloth round it shares, as a smooth field of space (Harlow 1964).

    Ways are averaged in the cells of a grid and read back linearly between their centres, so that two layers which are
    near each other go nearly the same way: such a move brings nothing together, however far it goes.

    Args:
        x: Positions [m], float64.
        way: How far each vertex is to go [m], float64.
        width: Width of the cells [m].
    """
    place = (x - x.amin(dim=0)) / width
    cell = place.floor()
    part, size = place - cell, cell.amax(dim=0).long() + 2
    weights, nodes = [], []
    for corner in itertools.product((0.0, 1.0), repeat=3):
        at = torch.tensor(corner, dtype=torch.float64, device=x.device)
        weights.append((at * part + (1.0 - at) * (1.0 - part)).prod(dim=1))
        index = (cell + at).long()
        nodes.append((index[:, 0] * size[1] + index[:, 1]) * size[2] + index[:, 2])
    weight, node = torch.stack(weights), torch.unique(torch.stack(nodes), return_inverse=True)[1]
    total = way.new_zeros((int(node.max()) + 1, 4))
    share = torch.cat([weight.unsqueeze(2) * way, weight.unsqueeze(2)], dim=2)
    total = add_at(total, node.reshape(-1), share.reshape(-1, 4))
    mean = total[:, :3] / total[:, 3:].clamp_min(1e-300)
    return (weight.unsqueeze(2) * mean[node]).sum(dim=0)
