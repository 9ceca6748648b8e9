"""``extentsHint`` of the models above a garment: a box cached by hand, which finer cloth may leave."""

from __future__ import annotations

from itertools import product

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt

from .stream import LayerStream

ATTRIBUTE = "extentsHint"
_FIRST = Usd.TimeCode.EarliestTime()
_PURPOSES = ("default", "render", "proxy", "guide")


class ModelHints:
    """Grows the authored hints of one garment's ancestors so that they hold the fine cloth."""

    def __init__(self, stream: LayerStream, stage: Usd.Stage, path: Sdf.Path, *, purpose: str) -> None:
        """Find the ancestors with a hint.

        Args:
            stream: The layer.
            stage: The shot.
            path: The coarse garment.
            purpose: Purpose of the fine mesh, which chooses the box to grow.
        """
        self._stream, self._stage = stream, stage
        self._prim = stage.GetPrimAtPath(path)
        self._row = 2 * _PURPOSES.index(purpose if purpose in _PURPOSES else "default")
        self._models = []
        prim = self._prim
        while prim and not prim.IsPseudoRoot():
            attribute = prim.GetAttribute(ATTRIBUTE)
            if attribute and attribute.HasAuthoredValue() and isinstance(attribute.Get(_FIRST), Vt.Vec3fArray):
                self._models.append(prim)
            prim = prim.GetParent()

    def write(self, time: float | None, box: np.ndarray) -> None:
        """Grow the hints by one box.

        Args:
            time: Time code, or None.
            box: Local extent of the fine mesh, shape (2, 3).
        """
        if not self._models:
            return
        code = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
        cache = UsdGeom.XformCache(code)
        corners = np.array([[box[i][0], box[j][1], box[k][2], 1.0] for i, j, k in product((0, 1), repeat=3)])
        local = np.array(cache.GetLocalToWorldTransform(self._prim))
        for model in self._models:
            inverse = np.linalg.pinv(np.array(cache.GetLocalToWorldTransform(model)))
            grown = (corners @ local @ inverse)[:, :3]
            if np.isfinite(grown).all():
                self._grow(model, time, grown)

    def _grow(self, model: Usd.Prim, time: float | None, corners: np.ndarray) -> None:
        """Author the union of a hint and eight corners, at a time where the hint is animated, else as default."""
        attribute = model.GetAttribute(ATTRIBUTE)
        time = time if attribute.GetNumTimeSamples() > 0 else None
        path = model.GetPath().AppendProperty(ATTRIBUTE)
        code = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
        spec = self._stream.attribute(path, Sdf.ValueTypeNames.Float3Array)
        ours = self._stream.layer.QueryTimeSample(path, time) if time is not None else spec.default
        value = attribute.Get(code) if ours is None else ours
        rows = np.array(value if value is not None else [], np.float32).reshape(-1, 3)
        empty = np.tile(np.array([[np.finfo(np.float32).max], [-np.finfo(np.float32).max]], np.float32), (1, 3))
        while len(rows) < self._row + 2:
            rows = np.concatenate([rows, empty])
        low, high = rows[self._row], rows[self._row + 1]
        grown = rows.copy()
        grown[self._row] = np.minimum(low, corners.min(axis=0))
        grown[self._row + 1] = np.maximum(high, corners.max(axis=0))
        self._stream.set(path, Vt.Vec3fArray.FromNumpy(grown), time=time)
