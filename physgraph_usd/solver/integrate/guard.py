"""The guard: accepts an integrator's step only if the energy falls."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from jaxtyping import Float
from torch import Tensor

from .ahead import Ahead
from .base import Carry, Integrator, System, Transporting, followed, resumed
from .quasi_newton import backtrack, truncated

PATIENCE = 4
"""Consecutive corrections before an integrator is replaced by its spare."""


class Guard:
    """Wraps any integrator; no guarded descent ends above its start, for any proposed steps.

    The start is the upsampled cage in a cold frame, and the last frame's detail in a warm frame.

    A step that raises the energy is truncated at turned triangles (`truncated`), then halved, quartered, and replaced
    by a step along H0^-1 F with a line search. After a shortened step the integrator continues with its memory, if able
    to follow an external step. After a replaced step the integrator restarts, because its memory was misleading. After
    `PATIENCE` consecutive corrections the spare integrator, if given, makes the level's remaining steps.
    ``Carry.mover`` names the mover.

    The steps of an integrator that can make them `ahead` are checked several at a time, with the same result.
    """

    def __init__(self, inner: Integrator, *, spare: Integrator | None = None) -> None:
        """Wrap an integrator.

        Args:
            inner: Integrator proposing the steps.
            spare: Integrator without need of a guard, for levels at which ``inner`` fails, or None.
        """
        self.name = inner.name
        self._inner, self._spare = inner, spare
        self._ahead = inner if isinstance(inner, Ahead) else None  # The test costs as much as a launch.

    def start(self, system: System, x: Float[Tensor, "vertices 3"]) -> Carry:
        """Start the wrapped integrator."""
        return self._inner.start(system, x)

    def resume(self, system: System, carry: Carry) -> Carry:
        """Continue after a small change of the forces, with the integrator of the last step."""
        spare = self._spare_of(carry)
        if spare is not None:
            return replace(resumed(spare, system, carry), setbacks=carry.setbacks)
        return resumed(self._inner, system, carry)

    def step(self, system: System, carry: Carry) -> Carry:
        """Make a step without raising the energy."""
        spare = self._spare_of(carry)
        if spare is not None:
            return replace(spare.step(system, carry), setbacks=carry.setbacks)
        return self.checked(system, carry, self._inner.step(system, carry))

    def most_ahead(self, carry: Carry) -> int:
        """Most steps of the wrapped integrator; 1 for the spare."""
        return 1 if self._ahead is None or self._spare_of(carry) is not None else self._ahead.most_ahead(carry)

    def ahead(self, system: System, carry: Carry) -> Carry:
        """A step of the wrapped integrator, unread."""
        assert self._ahead is not None
        return self._ahead.ahead(system, carry)

    def checked(self, system: System, carry: Carry, proposed: Carry) -> Carry:
        """The wrapped integrator's step; a corrected step if the energy rises."""
        if math.isfinite(proposed.energy) and proposed.energy <= carry.energy:
            return proposed
        corrected = replace(self._corrected(system, carry, proposed), setbacks=carry.setbacks + 1)
        if corrected.mover == "stayed" and self._spare is not None:  # The spare may succeed where H0^-1 F fails.
            return replace(self._spare.step(system, self._spare.start(system, carry.x)), setbacks=PATIENCE)
        spare = self._spare_of(corrected)
        if spare is None:
            return corrected
        handed = spare.start(system, corrected.x)
        return replace(handed, mover=corrected.mover, setbacks=corrected.setbacks)

    def curvature(self, carry: Carry) -> Any:
        """Curvature information of the wrapped integrator; None if the spare made the last steps."""
        if self._spare_of(carry) is not None or not isinstance(self._inner, Transporting):
            return None
        return self._inner.curvature(carry)

    def transported(self, memory: Any, rotation: Float[Tensor, "vertices 3 3"]) -> Any:
        """The wrapped integrator's memory with its fields rotated at each vertex."""
        return self._inner.transported(memory, rotation) if isinstance(self._inner, Transporting) else None

    def _corrected(self, system: System, carry: Carry, proposed: Carry) -> Carry:
        """The carry after shortening or replacing a step that raised the energy."""
        move = proposed.x - carry.x
        if bool(move.isfinite().all()):
            cut = truncated(system, carry.x, move)
            tries = [(0.5, "halved"), (0.25, "quartered")] if cut is None else [(1.0, "truncated"), (0.25, "quartered")]
            for fraction, mover in tries:
                shorter = followed(self._inner, system, carry, carry.x + fraction * (move if cut is None else cut))
                if shorter.energy <= carry.energy:
                    return shorter.moved_by(mover)
        direction = system.apply_metric_inverse(carry.force)
        reached = backtrack(system, carry, direction, float((carry.force * direction).sum()))
        if reached is None:
            return carry.moved_by("stayed")
        return self._inner.start(system, reached[0]).moved_by("fallback")

    def _spare_of(self, carry: Carry) -> Integrator | None:
        """The spare integrator if responsible after this carry, or None."""
        return self._spare if carry.setbacks >= PATIENCE else None
