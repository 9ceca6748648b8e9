"""Heat maps: how deep each fine vertex is in a body, and what crosses, as primvars that a host program can show."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pxr import Sdf, UsdGeom, Vt

from ...errors import LayerError
from .stream import LayerStream

PREFIX = "primvars:physgraph:"
HEAT = ("penetration", "crossing")
"""Depth in the deepest body [mm], 0 outside; and 1 at the corners of edges and faces that cross, 0 elsewhere."""


class HeatTrack:
    """Writes one garment's heat maps as they come; an attribute is authored when its first values do.

    A run of equal samples is written by its first and last only.
    """

    def __init__(self, stream: LayerStream, target: Sdf.Path, count: int, *, still: bool) -> None:
        """Author nothing yet.

        Args:
            stream: The layer.
            target: Prim to author on.
            count: Number of fine vertices.
            still: Whether the garment's input has no samples: a default is written in place of the first one.
        """
        self._stream, self._target, self._count, self._still = stream, target, count, still
        self._runs: dict[str, tuple[np.ndarray, float | None]] = {}

    def check(self, heat: Mapping[str, np.ndarray], time: float | None) -> None:
        """Refuse values that are not one finite number a vertex.

        Raises:
            LayerError: Naming the primvar and the time.
        """
        for name, values in heat.items():
            place = f"<{self._path(name)}>" + ("" if time is None else f" at time code {time:g}")
            if name not in HEAT:
                raise LayerError(f"{place}: no such heat map; known: {', '.join(HEAT)}")
            if values.shape != (self._count,) or not np.isfinite(values).all():
                raise LayerError(f"{place}: needs {self._count} finite values, got shape {values.shape}")

    def write(self, time: float | None, heat: Mapping[str, np.ndarray]) -> None:
        """Take one time code.

        Args:
            time: Time code, or None for the default of a shot without samples.
            heat: Values by name, each of shape (V,); a map that is left out has no sample here.
        """
        for name, given in heat.items():
            values = np.ascontiguousarray(given, np.float32)
            if name not in self._runs:
                path = self._path(name)
                self._stream.attribute(path, Sdf.ValueTypeNames.FloatArray, interpolation=UsdGeom.Tokens.vertex)
                self._set(name, None if self._still else time, values)
                self._runs[name] = values, time if self._still else None
                continue
            last, held = self._runs[name]
            if np.array_equal(values, last):
                self._runs[name] = last, time
                continue
            if held is not None:
                self._set(name, held, last)
            self._set(name, time, values)
            self._runs[name] = values, None

    def finish(self, *, hold: bool = False) -> None:
        """Author the ends of runs of equal samples where further samples are to follow them (``hold``)."""
        for name, (last, held) in self._runs.items() if hold else ():
            if held is not None and not self._still:
                self._set(name, held, last)

    def _path(self, name: str) -> Sdf.Path:
        return self._target.AppendProperty(PREFIX + name)

    def _set(self, name: str, time: float | None, values: np.ndarray) -> None:
        self._stream.set(self._path(name), Vt.FloatArray.FromNumpy(values), time=time)
