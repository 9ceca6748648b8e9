"""The load of the air on a garment's cage, from the garment's pressure and wind."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...solver.air import Wind, load
from ...solver.scene import Garment
from ...solver.seen import vertex_normals
from .materials import Values


@dataclass(frozen=True, eq=False)
class Air:
    """Pressure and wind on one garment.

    Attributes:
        values: The garment's values.
        garment: Its constant data.
        up: Upward unit vector of the stage, shape (3,).
        seconds: Length of a time code [s].
    """

    values: Values
    garment: Garment
    up: np.ndarray
    seconds: float

    def load(self, points: np.ndarray, time: float | None) -> np.ndarray | None:
        """Force of the air per area at a time code [N/m^2], shape (V, 3); None for calm air without pressure.

        Args:
            points: The cage's positions [m], shape (V, 3).
        """
        pressure, speed, heading, turbulence = (
            self.values.number(name, time) for name in ("pressure", "wind:speed", "wind:heading", "wind:turbulence")
        )
        if pressure == 0.0 and speed == 0.0:
            return None
        outwards = -1.0 if self.garment.flipped else 1.0
        normals = outwards * vertex_normals(points, self._triangles)
        wind = Wind(speed * self._direction(heading), turbulence)
        velocity = wind.at(points, self.seconds * (time or 0.0)) if speed else None
        return load(normals, pressure, velocity)

    @cached_property
    def _triangles(self) -> np.ndarray:
        return self.garment.mesh.triangulate().triangles

    def _direction(self, heading: float) -> np.ndarray:
        """Unit vector at an angle [degrees] about the up axis from +X, or from +Y where X is up, shape (3,)."""
        along = np.eye(3)[int(abs(self.up[0]) > 0.9)]
        along = along - (along @ self.up) * self.up
        along /= np.linalg.norm(along)
        angle = np.radians(heading)
        return np.cos(angle) * along + np.sin(angle) * np.cross(self.up, along)
