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

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from ..errors import named_time
from ..interrupts import leave_if_asked
from ..solver.scene import Result
from .findings.table import FINDINGS, Text

Both = Sequence[tuple[Result, Result]]
"""The frames before a seam, each with the solution of the process behind the seam."""
Positions = Sequence[np.ndarray | None]
"""Points of each garment, shape (V, 3), None for a garment without a sample."""
Mover = Callable[[float | None, Positions, Positions, Positions], tuple[Positions, str]]
"""Moves cloth safely at a time code from the nearer solution towards wanted positions; the farther solution is the
third argument. Also returns a description of new intersections, "" for none. One mover moves the frames of a seam in
order, without a history of earlier frames."""
Movers = Callable[[], Mover]
"""Returns a new mover, for the frames of one seam."""


@dataclass(frozen=True, eq=False)
class Joint:
    """The frames of one seam.

    Attributes:
        frames: The joined frames; the frames before the seam unchanged if the cloth jumps.
        why: Reason for a jump, or "".
    """

    frames: Sequence[Result]
    why: str

    @property
    def warnings(self) -> list[Text]:
        """A warning if the cloth jumps."""
        last = named_time(self.frames[-1].time)
        return [FINDINGS["seam_jump"](last=last, why=self.why)] if self.why else []


def join(solutions: Both, movers: Movers) -> Joint:
    """Join the frames of one seam.

    Args:
        solutions: The frames before the seam, each with the solution of the process behind the seam.
        movers: Asked for a mover if any frame differs.
    """
    frames, mover = list[Result](), cache(movers)
    for k, (earlier, after) in enumerate(solutions, start=1):
        garments, weight = zip(earlier.garments, after.garments, strict=False), k / (len(solutions) + 1)
        pairs = [(a.points, b.points) for a, b in garments]
        if all(a is None or b is None or np.array_equal(a, b) for a, b in pairs):
            frames.append(earlier)
            continue
        wanted = [a if a is None or b is None else between(a, b, weight) for a, b in pairs]
        near, far = [a for a, _ in pairs], [b for _, b in pairs]
        points, reason = mover()(earlier.time, *((near, far) if weight < 0.5 else (far, near)), wanted)
        leave_if_asked()  # A signal may have cut the move short.
        if reason:
            return Joint([earlier for earlier, _ in solutions], reason)
        moved = zip(earlier.garments, points, strict=True)
        frames.append(replace(earlier, garments=tuple(replace(g, points=x, reused=False) for g, x in moved)))
    return Joint(frames, "")


def between(before: np.ndarray, after: np.ndarray, weight: float) -> np.ndarray:
    """Points between two solutions, float64; equal points are unchanged to the bit."""
    start = before.astype(np.float64)
    return start + weight * (after.astype(np.float64) - start)


def worse(paths: Sequence[str], contacts: Sequence[Mapping[str, Any]], *sides: Sequence[Mapping[str, Any]]) -> str:
    """The first garment with more crossings than in all compared solutions, in words, or "".

    Args:
        paths: Paths of the garments.
        contacts: Contact telemetry of each garment.
        sides: The same of each compared solution.
    """
    for path, contact, *contacts_beside in zip(paths, contacts, *sides, strict=True):
        before = [counts(side) for side in contacts_beside]
        for name, count in counts(contact).items():
            if count > max((side_counts.get(name, 0) for side_counts in before), default=0):
                return f"joined, <{path}> would have {count:,} {name}"
    return ""


def counts(contact: Mapping[str, Any]) -> dict[str, int]:
    """Numbers of crossing edges and of vertices in bodies, from contact telemetry."""
    bodies = {f"vertices inside <{path}>": body["after"]["inside"] for path, body in contact.get("bodies", {}).items()}
    return {"edges through cloth": contact.get("cloth", {}).get("after", {}).get("crossings", 0)} | bodies
