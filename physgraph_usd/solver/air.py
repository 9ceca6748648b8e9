"""Air: the force per area of a difference in pressure, and of wind, on a cage.

    p = pressure + 1/2 rho |u . n| (u . n),    u = wind + gusts

Both act along the cage's normals n. Wind counts as on cloth that stands still: an animation of cloth that moves through
calm air already shows the drag.

Gusts are a sum of random Fourier modes without divergence (Kraichnan, 1970), carried along by the wind as frozen
turbulence (Taylor, 1938): a function of place and time, alike in every run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

DENSITY_OF_AIR = 1.2
"""[kg/m^3], at 20 degrees Celsius at sea level."""
MODES = 24
"""Number of modes of the gusts."""
LONGEST_GUST, SHORTEST_GUST = 2.0, 0.3
"""Wavelengths of the gusts [m]: shorter ones average out over a cage's edges."""


@dataclass(frozen=True, eq=False)
class Wind:
    """Wind of a constant mean.

    Attributes:
        mean: Mean velocity [m/s], shape (3,).
        turbulence: RMS of the gusts, in each direction, over the mean speed.
    """

    mean: ArrayLike
    turbulence: float = 0.0

    def at(self, points: np.ndarray, time: float) -> np.ndarray:
        """Velocity at places and a time [m/s], shape (V, 3).

        Args:
            points: Places [m], shape (V, 3).
            time: [s].
        """
        mean = np.asarray(self.mean, float)
        velocity = np.broadcast_to(mean, points.shape)
        if self.turbulence == 0.0:
            return velocity
        wave, along, phase = _modes()
        angle = (points - mean * time) @ wave.T + phase
        # A sum of M cosines along unit vectors has an RMS of sqrt(M / 2) in all, and of 1 / sqrt(3) of that each way.
        size = self.turbulence * np.linalg.norm(mean) * np.sqrt(6.0 / MODES)
        return velocity + size * np.cos(angle) @ along


def _modes() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Wave vectors [1/m] and unit directions at right angles to them, shape (M, 3), and phases, shape (M,)."""
    random = np.random.default_rng(1)
    wave, arbitrary = random.normal(size=(2, MODES, 3))
    length = np.geomspace(LONGEST_GUST, SHORTEST_GUST, MODES)
    wave *= 2.0 * np.pi / (length * np.linalg.norm(wave, axis=1))[:, None]
    along = np.cross(wave, arbitrary)
    return wave, along / np.linalg.norm(along, axis=1, keepdims=True), random.uniform(0.0, 2.0 * np.pi, MODES)


def load(normals: np.ndarray, pressure: float, velocity: np.ndarray | None = None) -> np.ndarray:
    """Force per area on a cage [N/m^2], shape (V, 3).

    Args:
        normals: Unit normals, outwards, shape (V, 3).
        pressure: Pressure inside over the pressure outside [Pa].
        velocity: Velocity of the air [m/s], shape (V, 3); None for calm air.
    """
    along = np.zeros(len(normals)) if velocity is None else (velocity * normals).sum(axis=1)
    return normals * (pressure + 0.5 * DENSITY_OF_AIR * np.abs(along) * along)[:, None]
