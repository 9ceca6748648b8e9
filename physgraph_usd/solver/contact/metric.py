"""The preconditioner of cloth that something touches.

    P = s R H0^-1 R + w (D + K)^-1,   R = (D / (D + K))^1/2

| symbol | meaning |
|---|---|
| H0 | the level's metric |
| K | stiffness of what touches, a diagonal: three times its mean over directions, since a plane holds in one of them |
| D | the diagonal of H0 |
| R H0^-1 R | answers smooth moves; R takes from what is held the moves that it cannot make |
| s, w | `SMOOTH`, `ROUGH`: about so much that a first step needs no shortening |

H0 answers smooth moves well and rough ones as cloth at rest would. What touches leaves rough errors: planes that turn
from vertex to vertex, cloth that was pushed out. The diagonal answers those, so few steps get far.

The network makes its steps whole, without a line search, and gets half of P. Of R H0^-1 R alone the guard rejects up
to nine steps of ten (a sheet over a block), of half of P one in a hundred, and frames end lower in less time.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ..integrate.base import Solver
from ..integrate.metric import Metric
from ..mesh.stencil import three_columns

SMOOTH, ROUGH = 0.1, 2.0
"""Weights of the smooth and the rough part of P."""
SHORT = 0.5
"""Fraction of P used by steps without a line search."""
MISSING = 0.9
"""Fraction of the contact stiffness that a metric may lack before a new metric is made. Excess stiffness does no harm:
earlier contacts of a level's rounds recur. A new metric costs a factorization and discards the curvature learned so
far."""


class HeldMetric:
    """A level's metric with contact stiffness."""

    def __init__(self, plain: Metric, stiff: Float[Tensor, " vertices"]) -> None:
        """Add a contact stiffness.

        Args:
            plain: The level's metric.
            stiff: K [N/m].
        """
        self.stiff = stiff
        self._plain = plain
        own = plain.diagonal.to(stiff)
        self._held = plain.between((own / (own + stiff)).sqrt().unsqueeze(1))
        self._rough = three_columns(ROUGH / (own + stiff))
        self._last: tuple[Tensor, int, Tensor] | None = None

    def renew(self, other: HeldMetric) -> None:
        """Take the stiffness of another metric of the level, in the tensors that recorded steps read."""
        self.stiff.copy_(other.stiff)
        self._rough.copy_(other._rough)
        for name in ("before", "after"):
            getattr(self._held, name).copy_(getattr(other._held, name))

    def copied(self) -> HeldMetric:
        """A metric of equal stiffness, in other tensors."""
        return HeldMetric(self._plain, self.stiff.clone())

    def serves(self, stiff: Float[Tensor, " vertices"]) -> bool:
        """True if K contains enough of the given stiffness [N/m]."""
        return float((stiff - self.stiff).clamp_min(0.0).sum()) <= MISSING * float(stiff.sum())

    @property
    def diagonal(self) -> Float[Tensor, " vertices"]:
        """D + K [N/m]."""
        return self._plain.diagonal + self.stiff.double()

    def solve(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """P F [m]; zero at pinned vertices, provided that the force is zero there."""
        held = self._held(force)
        self._last = force, force._version, held
        return (force * self._rough).add_(held, alpha=SMOOTH)

    def stiffened(self, stiffness: Float[Tensor, " vertices"]) -> Solver:
        """P with max(K, stiffness - D) in place of K: the solve for cloth with at least the given stiffness [N/m]."""
        other = HeldMetric(self._plain, torch.maximum(self.stiff, stiffness - self._plain.diagonal.to(stiffness)))

        def solve(force: Tensor) -> Tensor:
            out = other.solve(force)
            self._last = other._last
            return out

        return solve

    def held(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """R H0^-1 R F [m], the measure of the remaining move; known for the force solved for last."""
        if self._last is None or self._last[0] is not force or self._last[1] != force._version:
            return self._held(force)
        return self._last[2]

    def short(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """Half of P F [m]."""
        return self.solve(force).mul_(SHORT)
