"""The preconditioner of cloth that something touches.

    P = s (H0 + K)^-1 + w (D + K)^-1

| symbol | meaning |
|---|---|
| H0 | the level's metric |
| K | stiffness of what touches, a diagonal: three times its mean over directions, since a plane holds in one of them |
| D | the diagonal of H0 |
| s, w | `SMOOTH`, `ROUGH`: about so much that a first step needs no shortening |

H0 answers smooth moves well and rough ones as cloth at rest would. What touches leaves rough errors: planes that turn
from vertex to vertex, cloth that was pushed out. The diagonal answers those, so few steps get far. Above `REFACTORED`
vertices K is left out of the first term: a factor would cost more than the steps that it saves. So it is while cloth
crosses cloth: what pushes changes sides after every few steps.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ..integrate.metric import Metric

SMOOTH, ROUGH = 0.1, 2.0
"""Weights of the two answers."""
MISSING = 0.9
"""Part of the stiffness of what touches that a metric may lack before it is made anew. What it has too much does no
harm: what touched once in a level's rounds touches again; and a new metric costs a factor and drops what was learned of
the curvature."""
REFACTORED = 60_000
"""Vertices up to which a level's factor takes up the stiffness of what touches."""


class HeldMetric:
    """A level's metric while something touches its cloth."""

    def __init__(self, plain: Metric, stiff: Float[Tensor, " vertices"], *, factored: bool = True) -> None:
        """Take up a stiffness.

        Args:
            plain: The level's metric.
            stiff: K [N/m].
            factored: Whether the first term takes it up, where that pays.
        """
        self.stiff = stiff
        self._smooth = plain.plus(stiff) if factored and len(stiff) <= REFACTORED else plain
        self._rough = (ROUGH / (plain.diagonal.to(stiff) + stiff)).unsqueeze(1)

    def serves(self, stiff: Float[Tensor, " vertices"]) -> bool:
        """Whether it holds enough of another stiffness [N/m]."""
        return float((stiff - self.stiff).clamp_min(0.0).sum()) <= MISSING * float(stiff.sum())

    @property
    def diagonal(self) -> Float[Tensor, " vertices"]:
        """Of what smooth moves are answered by [N/m]."""
        return self._smooth.diagonal

    def solve(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """P F [m]; zero where a vertex may not move, provided that the force is."""
        return torch.addcmul(SMOOTH * self._smooth.solve(force), self._rough, force)

    def smooth(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """(H0 + K)^-1 F [m], by which the remaining move is judged."""
        return self._smooth.solve(force)
