"""Cloth that no round untangles: it is given up."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..collide.crossings import crossings
from .cloth import LevelContact

STUCK, DENSE = 0.8, 0.45
"""A tangle is given up if it keeps over `STUCK` of its crossings, and has more than `DENSE` crossings per vertex. Two
sheets that cross along a line have 0.33; arms in a chest of a posed suit 0.5 to 0.8."""


def stuck(
    view: LevelContact, start: Float[Tensor, "vertices 3"], x: Float[Tensor, "vertices 3"]
) -> Bool[Tensor, " vertices"] | None:
    """Mask of the cloth in dense tangles at x that lost few crossings since the start; None for none.

    Connected pieces with most of their vertices in tangles are stuck as a whole.

    Args:
        view: The cage's contact.
        start: Positions before the rounds that untangle [m].
        x: Positions after them [m].
    """
    tangles, mesh = view.look(x).tangles, view.mesh
    if tangles is None:
        return None
    label = tangles.label[mesh.corners_of(crossings(mesh.parts, view.corners(start)))].amax(dim=1).long()
    tangle_count = len(tangles.before)
    were = torch.bincount(label[label >= 0], minlength=tangle_count)
    size = torch.bincount(tangles.label[tangles.label >= 0], minlength=tangle_count)
    part = tangles.of((tangles.before > STUCK * were) & (tangles.before > DENSE * size))[: len(x)]
    whole = mesh.pieces_with(tangles.label >= 0, over=0.5)
    part = part if whole is None else part | whole
    return part if bool(part.any()) else None
