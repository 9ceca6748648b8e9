"""What lies between two solutions of the same frame, and how far cloth moves where one goes over into the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from ...errors import counted

Points = Mapping[str, np.ndarray]
"""Local points by the path of the fine mesh, each of shape (V, 3), float32."""

Look = Callable[[float, Points, Points, Points], tuple[Points, str]]
"""Looks at a joined frame: of its time code, the nearer and the other side's cloth and that between, it gives the last
moved so that nothing newly crosses or is in bodies, and what still does more than on both sides; "" for nothing."""


@dataclass(frozen=True)
class Seam:
    """How far a garment moves between two chunks because they were solved apart.

    Attributes:
        after: Time code of the first frame after it.
        path: The fine mesh.
        rms: What it adds to a frame's move at most, RMS over the vertices, in mean fine edge lengths.
        largest: The same of the vertex that it moves most.
        frames: Over how many frames both are joined; 0 where cloth jumps.
        why: Why it jumps, or "".
    """

    after: float
    path: str
    rms: float
    largest: float
    frames: int
    why: str = ""

    def __str__(self) -> str:
        """Place and distance in one line."""
        how = f"a frame, over {counted(self.frames, 'frame')}" if self.frames else "at once"
        said = f"seam at {self.after:g}: <{self.path}> moves {self.rms:.3g} fine edges RMS, {self.largest:.3g} at most"
        return f"{said}, {how}" + (f" ({self.why})" if self.why else "")


def between(before: np.ndarray, after: np.ndarray, weight: float) -> np.ndarray:
    """Part of the way from one solution to another, float64; equal ones are kept to the bit.

    Args:
        before: Shape (V, 3).
        after: Shape (V, 3).
        weight: 0 before, 1 after.
    """
    start = before.astype(np.float64)
    return start + weight * (after.astype(np.float64) - start)
