"""The metric of cloth in contact, level by level, as P in `integrate.metric`.

Contact is far stiffer than cloth, so the metric of free cloth misjudges both a patch that is held and the rough errors
beside planes that turn from vertex to vertex. The levels represent contact at each size, and only the cage is
factorised anew. K is three times the mean contact stiffness over all directions, since a plane holds in one direction.

The network makes full steps, without a line search, and gets half of P.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ..integrate.base import Preconditioner, Solver
from ..integrate.metric import Metric

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
        self._levels = plain.by_levels(stiff)

    @staticmethod
    def of(plain: Metric, stiff: Float[Tensor, " vertices"], last: Preconditioner | None) -> Metric | HeldMetric:
        """The metric with a contact stiffness [N/m]; the last metric while its stiffness suffices."""
        if not isinstance(last, HeldMetric):
            return HeldMetric(plain, stiff) if bool((stiff > 0).any()) else plain  # Pairs are near, but no pair pushes.
        return last if last.serves(stiff) else HeldMetric(plain, torch.maximum(stiff, last.stiff))

    def serves(self, stiff: Float[Tensor, " vertices"]) -> bool:
        """True if K contains enough of the given stiffness [N/m]."""
        missing, needed = torch.stack([(stiff - self.stiff).clamp_min(0.0).sum(), stiff.sum()]).tolist()
        return missing <= MISSING * needed

    @property
    def diagonal(self) -> Float[Tensor, " vertices"]:
        """D + K [N/m]."""
        return self._plain.diagonal + self.stiff.double()

    def solve(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """P F [m]; F must be zero at fixed vertices, and P F is."""
        return self._levels.run(self._plain.coarse.recordings, force)[0]

    def stiffened(self, stiffness: Float[Tensor, " vertices"]) -> Solver:
        """P with max(K, stiffness - D) in place of K: the solve for cloth with at least the given stiffness [N/m]."""
        return HeldMetric(self._plain, torch.maximum(self.stiff, stiffness - self._plain.diagonal.to(stiffness))).solve

    def held(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """R H^-1 R F [m], R = (D / (D + K))^1/2, with `Metric.estimate` for H^-1: the measure of the remaining move."""
        diagonal = self._plain.diagonal.to(self.stiff)
        factor = (diagonal / (diagonal + self.stiff)).sqrt().unsqueeze(1)
        return self._plain.estimate(force * factor).mul_(factor)

    def short(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """Half of P F [m]."""
        return self.solve(force).mul_(SHORT)
