"""Blends two solutions of the same frames, by two processes, into one motion.

Cloth with several possible folds settles differently after each history. Over the L frames solved by both processes,
the positions move from one solution to the other in equal parts,

    x_k = (1 - s_k) a_k + s_k b_k,   s_k = k / (L + 1),   k = 1 .. L,

and the seam adds |b - a| / (L + 1) to a frame's move instead of |b - a| at once. The cloth moves from the nearer
solution towards the blend as far as no new intersection appears, and is pushed out of bodies. If the input itself
intersects, the safe move guarantees less: if the blend has more crossings, or more vertices in bodies, than both
solutions, nothing is joined and the cloth jumps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from ..interrupts import leave_if_asked
from .frames import Lead, Outcome

Both = Sequence[tuple[Outcome, Lead]]
"""The frames before a seam, each with the solution of the process behind the seam."""
Positions = Sequence[np.ndarray | None]
"""Points of each garment, shape (V, 3), None for a garment without a sample."""
Mover = Callable[[float | None, Positions, Positions, Positions], tuple[Positions, str]]
"""Moves cloth safely at a time code from the nearer solution towards wanted positions; the farther solution is the
third argument. Also returns a description of new intersections, "" for none."""


@dataclass(frozen=True, eq=False)
class Joint:
    """The frames of one seam.

    Attributes:
        frames: The joined frames; the frames before the seam unchanged if the cloth jumps.
        why: Reason for a jump, or "".
    """

    frames: tuple[Outcome, ...]
    why: str


def join(both: Both, move: Mover) -> Joint:
    """Join the frames of one seam.

    Args:
        both: The frames before the seam, each with the solution of the process behind the seam.
        move: Moves cloth safely.
    """
    frames, why = [], ""
    for outcome, lead in both:
        pairs = list(zip(outcome.points, lead.outcome.points, strict=False))
        if why or all(a is None or b is None or np.array_equal(a, b) for a, b in pairs):
            frames.append(outcome)
            continue
        wanted = [a if a is None or b is None else _between(a, b, lead.weight) for a, b in pairs]
        near, far = [a for a, _ in pairs], [b for _, b in pairs]
        points, why = move(outcome.time, *((near, far) if lead.weight < 0.5 else (far, near)), wanted)
        leave_if_asked()  # A signal may have cut the move short.
        frames.append(replace(outcome, points=tuple(points), reused=(False,) * len(points)))
    return Joint(tuple(replace(each, lead=None) for each in ([own for own, _ in both] if why else frames)), why)


def _between(before: np.ndarray, after: np.ndarray, weight: float) -> np.ndarray:
    """Points between two solutions, float64; equal points are unchanged to the bit."""
    start = before.astype(np.float64)
    return start + weight * (after.astype(np.float64) - start)


def joined(
    outcomes: Iterable[Outcome],
    move: Mover,
    warn: Callable[[str], object],
    *,
    seen: Callable[[Both, Joint], object] | None = None,
) -> Iterator[Outcome]:
    """Frames in order, joined if two processes solved them.

    Args:
        outcomes: The frames; a frame solved twice has the second solution as ``lead``.
        move: Moves cloth safely.
        warn: Called with a warning for each seam left as a jump.
        seen: Called with the frames of each seam, before and after joining.
    """
    both: list[tuple[Outcome, Lead]] = []
    for outcome in outcomes:
        ends = bool(both) and (outcome.lead is None or outcome.lead.seam != both[0][1].seam)
        if ends:
            yield from _and_warn(both, _known(both) or join(both, move), warn, seen)
            both = []
        # "Reused" refers to the last pre-roll frame, which was not written.
        first = replace(outcome, reused=(False,) * len(outcome.reused)) if ends else outcome
        if outcome.lead is None:
            yield first
        else:
            both.append((first, outcome.lead))
    yield from _and_warn(both, _known(both) or join(both, move), warn, seen)


def _known(both: Both) -> Joint | None:
    """The frames of a seam as the process before it has joined them, or None."""
    found = [
        replace(lead.joined, reused=tuple(a and b for a, b in zip(own.reused, lead.joined.reused, strict=True)))
        for own, lead in both
        if lead.joined is not None
    ]
    return Joint(tuple(found), "") if len(found) == len(both) else None


def _and_warn(
    both: Both, joint: Joint, warn: Callable[[str], object], seen: Callable[[Both, Joint], object] | None
) -> tuple[Outcome, ...]:
    if both and seen is not None:
        seen(both, joint)
    if joint.why:
        after = f"after time code {both[-1][0].time:g}"
        warn(f"the cloth jumps {after}, where the work of two processes meets: {joint.why}")
    return joint.frames


class Movable(Protocol):
    """A shot's cloth, moved without a solve."""

    def moved_safely(
        self, time: float | None, start: Positions, wanted: Positions
    ) -> list[tuple[np.ndarray | None, dict[str, Any]]]:
        """Like `Refiner.moved_safely`, at a time code."""
        ...


@dataclass(frozen=True, eq=False)
class SafeMover:
    """Moves the cloth of a shot without new intersections or vertices in bodies, as `Mover` requires."""

    cloth: Movable
    paths: Sequence[str]

    def __call__(
        self, time: float | None, near: Positions, far: Positions, wanted: Positions
    ) -> tuple[list[np.ndarray | None], str]:
        """Move cloth; the two solutions are measured only if the result crosses something."""
        found = self.cloth.moved_safely(time, near, wanted)
        sides: list[list[dict[str, Any]]] = []
        if any(count for _, contact in found for count in _counts(contact).values()):
            sides = [[contact for _, contact in self.cloth.moved_safely(time, side, side)] for side in (near, far)]
        worse = (
            f"joined, <{path}> would have {more}"
            for path, (_, contact), *others in zip(self.paths, found, *sides, strict=True)
            if (more := _worse(contact, others))
        )
        return [points for points, _ in found], next(worse, "")


def _worse(contact: Mapping[str, Any], others: Sequence[Mapping[str, Any]]) -> str:
    """The first contact count larger than in all compared solutions, in words."""
    before = [_counts(each) for each in others]
    for name, count in _counts(contact).items():
        if count > max((each.get(name, 0) for each in before), default=0):
            return f"{count:,} {name}"
    return ""


def _counts(contact: Mapping[str, Any]) -> dict[str, int]:
    """Numbers of crossing edges and of vertices in bodies, from contact telemetry."""
    bodies = {f"vertices inside <{path}>": each["after"]["inside"] for path, each in contact.get("bodies", {}).items()}
    return {"edges through cloth": contact.get("cloth", {}).get("after", {}).get("crossings", 0)} | bodies
