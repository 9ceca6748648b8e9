"""An artist's changes to a shot, and their history: undo and redo."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

JOINED_SECONDS = 1.0
"""Longest pause between the changes of a drag, in one step of undo [s]."""


@dataclass(frozen=True, eq=False)
class Setting:
    """Everything restored by undo; compared by identity.

    Attributes:
        levels: Subdivisions of each garment.
        contact: Whether cloth feels bodies and cloth.
        values: Values tried, by prim path and the schema's short names.
        painted: Painted maps on the vertices of the cage, each of shape (V,), by prim path and the schema's short
            names.
    """

    levels: tuple[int, ...]
    contact: bool = True
    values: Mapping[str, Mapping[str, float]] = field(default_factory=dict[str, Mapping[str, float]])
    painted: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict[str, Mapping[str, np.ndarray]])

    def map_of(self, garment: str, name: str) -> np.ndarray | None:
        """A map painted in this session, or None."""
        return self.painted.get(garment, {}).get(name)


class History:
    """The settings of a session, in order."""

    def __init__(self, first: Setting, *, seconds: Callable[[], float] = clock.monotonic) -> None:
        """Begin with a setting; ``seconds`` is the clock."""
        self._steps = [(first, "")]  # Each setting with the change that led to it.
        self._at, self._seconds, self._last = 0, seconds, -np.inf

    @property
    def now(self) -> Setting:
        """The present setting."""
        return self._steps[self._at][0]

    @property
    def undone_next(self) -> str:
        """The change that `undo` takes back, or ""."""
        return self._steps[self._at][1]

    @property
    def redone_next(self) -> str:
        """The change that `redo` makes again, or ""."""
        return self._steps[self._at + 1][1] if self._at + 1 < len(self._steps) else ""

    def put(self, setting: Setting, change: str, *, joins: bool = False) -> None:
        """Go on to a setting by a change, in words; one that ``joins`` is a step with an equal change just before."""
        now = self._seconds()
        joined = joins and self._at > 0 and change == self.undone_next and now - self._last < JOINED_SECONDS
        self._at += 0 if joined else 1
        self._steps[self._at :] = [(setting, change)]
        self._last = now

    def after_undo(self) -> Setting:
        """The setting after `undo`; the present one without an earlier step."""
        return self._steps[max(self._at - 1, 0)][0]

    def after_redo(self) -> Setting:
        """The setting after `redo`; the present one without a next step."""
        return self._steps[min(self._at + 1, len(self._steps) - 1)][0]

    def undo(self) -> None:
        """Go back by a step."""
        self._at, self._last = max(self._at - 1, 0), -np.inf

    def redo(self) -> None:
        """Go forward by a step."""
        self._at, self._last = min(self._at + 1, len(self._steps) - 1), -np.inf
