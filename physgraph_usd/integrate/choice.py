"""Whether a cold frame goes through its coarse levels: what ``auto``, refine's default, decides frame by frame.

Coarse levels are cheap and carry folds far, but each has a start of its own. Under one subdivision lies one coarse
level, a quarter of the finest, and more steps at the finest alone get as far in less time. Not where cloth lies near
cloth: who lies above whom is settled at the cage. `python -m benchmarks.front` measures it, and docs/chart.md has the
table. What starts from the last frame's detail starts at the finest level in any case.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

LONGER = 4
"""Steps of the finest level alone over those that it takes after coarse ones."""


@dataclass(frozen=True)
class Choice:
    """How a cold frame is solved.

    Attributes:
        nested: Coarse levels first; otherwise the finest level only.
        steps: Steps at the finest level, over those that were asked for.
        reason: Why, or "" where nothing was left to choose.
    """

    nested: bool
    steps: int = 1
    reason: str = ""


class Crowd(Protocol):
    """What is asked of contact."""

    @property
    def crowded(self) -> bool:
        """Whether cloth is near cloth in the upsampled cage."""
        ...


def choose(nested: bool | None, subdivisions: int, contact: Crowd | None, *, warm: bool = False) -> Choice:
    """Choose for one frame.

    Args:
        nested: What the method asks for; None leaves it open.
        subdivisions: Number of levels above the cage.
        contact: The frame's contact, or None when nothing can touch; asked only where it matters.
        warm: Whether the frame starts from the last one's detail.
    """
    if warm or nested is not None:
        return Choice(bool(nested) and not warm)
    if subdivisions != 1:
        return Choice(True, reason=f"level by level: {subdivisions} subdivisions")
    if contact is not None and contact.crowded:
        return Choice(True, reason="level by level: cloth lies near cloth")
    return Choice(False, LONGER, "the finest level alone: one subdivision, and no cloth lies near cloth")
