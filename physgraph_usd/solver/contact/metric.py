"""The preconditioner of cloth that something touches: the cage exactly, each finer level by its diagonal (BPX).

    P = c Z_0 A_0^-1 Z_0^T + sum_l Z_l diag(A_l)^-1 Z_l^T + r diag(A)^-1,   A_l = Z_l^T A Z_l,   A = H + K

| symbol | meaning |
|---|---|
| H | metric of the level that is solved, D its diagonal |
| Z_l | linear map from level l; l = 0 is the cage, the sum has the levels between |
| K | stiffness of what touches, a diagonal: three times its mean over directions, since a plane holds in one of them |
| c, r | `coarse.COARSE`, `ROUGH`: about so much that a first step needs no shortening |

What touches is far stiffer than cloth, so the metric of free cloth misjudges both a patch that is held and the rough
errors beside planes that turn from vertex to vertex. Here each level sees the contact at its own size (after Bramble,
Pasciak and Xu 1990), and only the cage is factorised anew.

The network makes its steps whole, without a line search, and gets half of P.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ..integrate.base import Preconditioner, Solver
from ..integrate.metric import Metric
from ..mesh.stencil import three_columns

ROUGH = 2.0
"""Weight of the finest level's part of P."""
SHORT = 0.5
"""Fraction of P used by steps without a line search."""
HELD_TOLERANCE = 0.1
"""Tolerance of rounds with contact, relative to the level's: `HeldMetric.held` underestimates moves."""
MISSING = 0.9
"""Fraction of the contact stiffness that a metric may lack before a new metric is made. Excess stiffness does no harm:
earlier contacts of a level's rounds recur. A new metric costs a factorization and discards the curvature learned so
far."""


class HeldMetric:
    """A level's metric with contact stiffness."""

    def __init__(self, plain: Metric, stiff: Float[Tensor, " vertices"]) -> None:
        """Add a contact stiffness.

        Args:
            stiff: K [N/m].
        """
        self.stiff, self._plain = stiff, plain
        own = plain.diagonal.to(stiff)
        self._held = plain.between((own / (own + stiff)).sqrt().unsqueeze(1))
        tiny = torch.finfo(stiff.dtype).tiny  # Where there is no cloth, there is no force.
        self._rough = ROUGH / plain.gathered(three_columns(own + stiff)).clamp_min(tiny)
        between, self._cage = plain.coarse.held(plain.gathered(three_columns(stiff))[:, 0])
        self._middle = [three_columns(1.0 / each.clamp_min(tiny)) for each in between]

    @staticmethod
    def of(plain: Metric, stiff: Float[Tensor, " vertices"], last: Preconditioner | None) -> Metric | HeldMetric:
        """The metric with a contact stiffness [N/m]; the last metric while its stiffness suffices."""
        if not isinstance(last, HeldMetric):
            return HeldMetric(plain, stiff) if bool((stiff > 0).any()) else plain  # Things are near, but none pushes.
        return last if last.serves(stiff) else HeldMetric(plain, torch.maximum(stiff, last.stiff))

    def serves(self, stiff: Float[Tensor, " vertices"]) -> bool:
        """True if K contains enough of the given stiffness [N/m]."""
        return float((stiff - self.stiff).clamp_min(0.0).sum()) <= MISSING * float(stiff.sum())

    @property
    def diagonal(self) -> Float[Tensor, " vertices"]:
        """D + K [N/m]."""
        return self._plain.diagonal + self.stiff.double()

    def solve(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """P F [m]; zero at fixed vertices, provided that the force is zero there."""
        force = self._plain.gathered(force)
        return self._plain.spread(*self._plain.coarse.recorded_move(force, self._cage, self._rough, *self._middle))

    def stiffened(self, stiffness: Float[Tensor, " vertices"]) -> Solver:
        """P with max(K, stiffness - D) in place of K: the solve for cloth with at least the given stiffness [N/m]."""
        return HeldMetric(self._plain, torch.maximum(self.stiff, stiffness - self._plain.diagonal.to(stiffness))).solve

    def held(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """R H^-1 R F [m], R = (D / (D + K))^1/2: the measure of the remaining move."""
        return self._held(force)

    def short(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """Half of P F [m]."""
        return self.solve(force).mul_(SHORT)
