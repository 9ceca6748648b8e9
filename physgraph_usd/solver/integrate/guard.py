"""The guard: keeps an integrator's step only if the energy falls."""

from __future__ import annotations

import math
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from .base import Carry, Integrator, System, followed, resumed
from .quasi_newton import backtrack, truncated

PATIENCE = 4
"""Corrections in a row after which an integrator is replaced by its spare."""


class Guard:
    """Wraps any integrator; with it no descent ends above its start, whatever the integrator proposes.

    The start is the upsampled cage in a cold frame, and the last frame's detail in a warm one.

    A step that raises the energy is truncated where it turns triangles (`truncated`), then halved, quartered, and
    replaced by a step along H0^-1 F with a line search.
    From a shortened step the integrator continues with its memory, if it can take over another's step. From one that
    was replaced it starts anew: its memory misled it. After `PATIENCE` corrections in a row the spare
    integrator, where there is one, makes the level's other steps. ``Carry.mover`` names the mover.
    """

    def __init__(self, inner: Integrator, *, spare: Integrator | None = None) -> None:
        """Wrap an integrator.

        Args:
            inner: It proposes the steps.
            spare: One that needs no guard, for levels at which the other fails, or None.
        """
        self.name = inner.name
        self._inner, self._spare = inner, spare

    def start(self, system: System, x: Float[Tensor, "vertices 3"]) -> Carry:
        """Start the wrapped integrator."""
        return self._inner.start(system, x)

    def resume(self, system: System, carry: Carry) -> Carry:
        """Go on under forces that changed a little, as who made the last step can."""
        spare = self._spare_of(carry)
        if spare is not None:
            return replace(resumed(spare, system, carry), setbacks=carry.setbacks)
        return resumed(self._inner, system, carry)

    def step(self, system: System, carry: Carry) -> Carry:
        """One step whose energy is not above the last one's."""
        spare = self._spare_of(carry)
        if spare is not None:
            return replace(spare.step(system, carry), setbacks=carry.setbacks)
        proposed = self._inner.step(system, carry)
        if math.isfinite(proposed.energy) and proposed.energy <= carry.energy:
            return proposed
        corrected = replace(self._corrected(system, carry, proposed), setbacks=carry.setbacks + 1)
        if corrected.mover == "stayed" and self._spare is not None:  # It may lower the energy where H0^-1 F does not.
            return replace(self._spare.step(system, self._spare.start(system, carry.x)), setbacks=PATIENCE)
        spare = self._spare_of(corrected)
        if spare is None:
            return corrected
        handed = spare.start(system, corrected.x)
        return replace(handed, mover=corrected.mover, setbacks=corrected.setbacks)

    def _corrected(self, system: System, carry: Carry, proposed: Carry) -> Carry:
        """Where a step that raised the energy is cut back or replaced."""
        move = proposed.x - carry.x
        if bool(move.isfinite().all()):
            cut = truncated(system, carry.x, move)
            tries = [(0.5, "halved"), (0.25, "quartered")] if cut is None else [(1.0, "truncated"), (0.25, "quartered")]
            for fraction, mover in tries:
                shorter = followed(self._inner, system, carry, carry.x + fraction * (move if cut is None else cut))
                if shorter.energy <= carry.energy:
                    return shorter.moved_by(mover)
        direction = system.apply_metric_inverse(carry.force)
        found = backtrack(system, carry, direction, float((carry.force * direction).sum()))
        if found is None:
            return carry.moved_by("stayed")
        return self._inner.start(system, found[0]).moved_by("fallback")

    def _spare_of(self, carry: Carry) -> Integrator | None:
        """Who makes the steps after a carry in the wrapped integrator's place, or None."""
        return self._spare if carry.setbacks >= PATIENCE else None
