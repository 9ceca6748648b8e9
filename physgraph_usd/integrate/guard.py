"""The guard: keeps an integrator's step only if the energy falls (DESIGN 4.4)."""

from __future__ import annotations

import math

from jaxtyping import Float
from torch import Tensor

from .base import Carry, Integrator, System, followed, resumed
from .quasi_newton import backtrack


class Guard:
    """Wraps any integrator; with it no result is worse than the input, whatever the integrator proposes.

    A step that raises the energy is halved, then quartered, then replaced by a step along H0^-1 F with a line search.
    From a shortened step the integrator goes on with what it has learned, if it can follow another's step. From one
    that was replaced it starts anew: what it had learned misled it. ``Carry.mover`` says who moved.
    """

    def __init__(self, inner: Integrator) -> None:
        """Wrap an integrator."""
        self.name = inner.name
        self._inner = inner

    def start(self, system: System, x: Float[Tensor, "vertices 3"]) -> Carry:
        """Start the wrapped integrator."""
        return self._inner.start(system, x)

    def resume(self, system: System, carry: Carry) -> Carry:
        """Go on under forces that changed a little, as the wrapped integrator can."""
        return resumed(self._inner, system, carry)

    def step(self, system: System, carry: Carry) -> Carry:
        """One step whose energy is not above the last one's."""
        proposed = self._inner.step(system, carry)
        if math.isfinite(proposed.energy) and proposed.energy <= carry.energy:
            return proposed
        move = proposed.x - carry.x
        if bool(move.isfinite().all()):
            for fraction, mover in ((0.5, "halved"), (0.25, "quartered")):
                shorter = followed(self._inner, system, carry, carry.x + fraction * move)
                if shorter.energy <= carry.energy:
                    return shorter.moved_by(mover)
        direction = system.apply_metric_inverse(carry.force)
        found = backtrack(system, carry, direction, float((carry.force * direction).sum()))
        if found is None:
            return carry.moved_by("stayed")
        return self._inner.start(system, found[0]).moved_by("fallback")
