"""Steps made ahead of their check.

Whether a step is kept depends on its energy, and whether another follows on its remaining move. On a card the host
waits for these numbers until all its work is done, and meanwhile launches nothing. A network's step needs the tensors
of the steps before, but not their numbers. So several steps are made, the numbers of all are read at once, and the
steps are checked in order; the steps after one that fails or is the last are discarded. The result, and the report, is
that of steps made one at a time.

    ahead, ahead, ahead, ahead      steps whose numbers stay on the card
    read                            a single wait
    checked, checked, ...           each step kept, or replaced and the later ones discarded
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Protocol, runtime_checkable

import torch

from .base import Carry, Integrator, System
from .stop import SEEN_STEPS, Budget

STEPS_AHEAD = {"cpu": 1, "cuda": SEEN_STEPS}
"""Most steps made before the first is checked, by device type: on the CPU nothing waits, and discarded steps cost."""


@runtime_checkable
class Ahead(Protocol):
    """An integrator able to step on without reading the energy or the remaining move."""

    def most_ahead(self, carry: Carry) -> int:
        """Most steps from a carry before the first is checked, at least 1; later ones would lose the carry's memory."""
        ...

    def ahead(self, system: System, carry: Carry) -> Carry:
        """A step from a carry, read or not; its energy and remaining move are ``Carry.unread``."""
        ...


@runtime_checkable
class Checked(Ahead, Protocol):
    """An integrator with a check for its steps."""

    def checked(self, system: System, carry: Carry, proposed: Carry) -> Carry:
        """The proposed carry if its energy [J] does not exceed the carry's; a corrected step otherwise."""
        ...


def read(carries: Sequence[Carry]) -> list[Carry]:
    """The carries with energy [J] and remaining move [local edges], copied from the device in a single wait."""
    numbers = torch.stack([carry.unread for carry in carries if carry.unread is not None]).tolist()
    return [
        replace(carry, energy=energy, remaining=remaining, unread=None)
        for carry, (energy, remaining) in zip(carries, numbers, strict=True)
    ]


class Steps:
    """The steps of a descent, made ahead of their check if the integrator can."""

    def __init__(self, system: System, integrator: Integrator, budget: Budget) -> None:
        """Begin without steps."""
        self._system, self._integrator, self._budget = system, integrator, budget
        self._checked = integrator if isinstance(integrator, Checked) else None
        self._made: deque[tuple[Carry, tuple[int, int, int]]] = deque()

    @property
    def next_is_made(self) -> bool:
        """Whether the next step is made already, and only to be checked."""
        return bool(self._made)

    def after(self, carry: Carry, steps: int) -> Carry:
        """The next step.

        Args:
            carry: The last step, returned by this method, or the start.
            steps: Number of steps made to the carry.
        """
        if self._checked is None:
            return self._integrator.step(self._system, carry)
        if not self._made:
            # At a multiple of `SEEN_STEPS` the descent may end.
            most = min(self._checked.most_ahead(carry), SEEN_STEPS - steps % SEEN_STEPS, self._budget.steps - steps)
            if most < 2:
                return self._integrator.step(self._system, carry)
            made, counts = zip(*self._ahead(self._checked, carry, steps, most), strict=True)
            self._made.extend(zip(read(made), counts, strict=True))
        proposed, self._system.counted = self._made.popleft()
        checked = self._checked.checked(self._system, carry, proposed)
        if checked is not proposed:
            self._made.clear()
        return checked

    def _ahead(
        self, integrator: Ahead, carry: Carry, steps: int, most: int
    ) -> Iterator[tuple[Carry, tuple[int, int, int]]]:
        """Up to so many steps after a carry while the time lasts, each with what the system has counted."""
        for made in range(most):
            if made and self._budget.is_spent(steps + made):
                return
            carry = integrator.ahead(self._system, carry)
            yield carry, self._system.counted
