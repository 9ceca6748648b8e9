"""Reads back what a refined layer holds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import Sdf

from ...errors import LayerError
from ..provenance import read_record
from ..read.reader import Shot


class RefinedLayer:
    """A refined layer, for looking at what was written.

    Attributes:
        targets: Path of each garment's fine mesh, in the scene's order.
    """

    def __init__(self, path: Path) -> None:
        """Open the layer.

        Raises:
            LayerError: It is no refined layer.
        """
        layer = Sdf.Layer.FindOrOpen(str(path))
        record = None if layer is None else read_record(layer)
        if layer is None or record is None:
            raise LayerError(f"{path} is no refined layer")
        self._layer = layer
        self.targets = tuple(str(each) for each in record.get("garments", ()))

    def points(self, shot: Shot, index: int, time: float | None) -> np.ndarray | None:
        """World positions [m] of a garment's fine mesh, shape (V, 3), or None where it has no sample.

        Args:
            shot: The shot that was refined.
            index: Which garment.
            time: Time code, or None for the default.
        """
        coarse = str(shot.sources[index].path)
        target = next((each for each in self.targets if each in (coarse, f"{coarse}_refined")), None)
        if target is None:  # a chunk without a sample of it
            return None
        path = Sdf.Path(target).AppendProperty("points")
        if time is None:
            attribute = self._layer.GetAttributeAtPath(path)
            local = None if attribute is None else attribute.default
        else:
            local = self._layer.QueryTimeSample(path, time)
        if local is None or isinstance(local, Sdf.ValueBlock):
            return None
        matrix = shot.to_metres(index, time)
        return np.asarray(local, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
