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

    def at(self, way: int = 0) -> Setting:
        """The present setting, or the one as many steps forward as there are; backward if negative."""
        return self._steps[self._place(way)][0]

    @property
    def undone_next(self) -> str:
        """The change that led to the present setting, or ""."""
        return self._steps[self._at][1]

    @property
    def redone_next(self) -> str:
        """The change that leads to the next setting, or ""."""
        return self._steps[self._at + 1][1] if self._at + 1 < len(self._steps) else ""

    def put(self, setting: Setting, change: str, *, joins: bool = False) -> None:
        """Go on to a setting by a change, in words; one that ``joins`` is a step with an equal change just before."""
        now = self._seconds()
        joined = joins and self._at > 0 and change == self.undone_next and now - self._last < JOINED_SECONDS
        self._at += 0 if joined else 1
        self._steps[self._at :] = [(setting, change)]
        self._last = now

    def go(self, way: int) -> None:
        """Go to the setting of `at`."""
        self._at, self._last = self._place(way), -np.inf

    def _place(self, way: int) -> int:
        return min(max(self._at + way, 0), len(self._steps) - 1)
