"""Inertia: the acceleration of a cage that its cloth feels.

A frame is solved at rest, as in a room that moves along with the cage. In such a room cloth of areal density rho is
pushed by -rho a per area, a being the cage's acceleration there (d'Alembert): a spinning skirt is drawn outwards, and
a hem lags behind a step. Gravity outweighs slow motion, which is therefore left out: only what exceeds `GRAVITY` is
felt. So slow shots are solved as if nothing moved.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

GRAVITY = 9.81
"""Acceleration below which cloth feels nothing, and which is subtracted from larger accelerations [m/s^2]."""
FASTEST = 10.0 * GRAVITY
"""Largest acceleration felt at a point [m/s^2]: a spin in a dance has 5 to 8 times gravity."""
CUT = 2.0 * FASTEST
"""Median acceleration of a cage's points from which on it has jumped, as at a cut [m/s^2]: nothing is felt then."""


def acceleration_of(points: Sequence[np.ndarray], times: Sequence[float]) -> np.ndarray:
    """Mean acceleration over three times [m/s^2], shape (V, 3): the second difference of positions.

    Args:
        points: Positions at the times [m], three arrays of shape (V, 3).
        times: Three times, ascending [s].
    """
    (x0, x1, x2), (t0, t1, t2) = points, times
    change = (x2 - x1) / (t2 - t1) - (x1 - x0) / (t1 - t0)
    return 2.0 * change / (t2 - t0)


def felt(acceleration: np.ndarray) -> np.ndarray | None:
    """The excess of a cage's acceleration over gravity, which cloth feels [m/s^2], shape (V, 3).

    Args:
        acceleration: Acceleration of the cage's points [m/s^2], shape (V, 3).

    Returns:
        The excess, at most `FASTEST`; None if no point exceeds gravity, or the cage jumps (`CUT`).
    """
    size = np.linalg.norm(acceleration, axis=1, keepdims=True)
    if not np.isfinite(size).all() or not (size > GRAVITY).any() or np.median(size) > CUT:
        return None
    return acceleration * np.clip(size - GRAVITY, 0.0, FASTEST) / np.maximum(size, GRAVITY)
