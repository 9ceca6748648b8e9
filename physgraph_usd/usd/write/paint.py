"""Painted maps as primvars of an over."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pxr import Sdf, Usd, Vt

from ..schema import GARMENT


def author_painted(spec: Sdf.PrimSpec, prim: Usd.Prim, maps: Mapping[str, np.ndarray]) -> None:
    """Author maps over a mesh's own opinions, one value a point.

    Args:
        spec: The over.
        prim: The mesh below it.
        maps: Values of each authored point, shape (V,), by the schema's short names.
    """
    for short, values in maps.items():
        row = GARMENT[short]
        attribute = Sdf.AttributeSpec(spec, row.name, Sdf.ValueTypeNames.FloatArray)
        attribute.default = Vt.FloatArray.FromNumpy(np.asarray(values, np.float32))
        attribute.SetInfo("interpolation", "vertex")
        indices = prim.GetAttribute(f"{row.name}:indices")
        if indices and indices.HasAuthoredValue():  # Each point has a value of its own from here on.
            hidden = Sdf.AttributeSpec(spec, indices.GetName(), Sdf.ValueTypeNames.IntArray)
            hidden.default = Sdf.ValueBlock()


def painted_layer(stage: Usd.Stage, painted: Mapping[str, Mapping[str, np.ndarray]]) -> Sdf.Layer:
    """A layer in memory with maps of each mesh, by prim path and the schema's short names; for a stage's session."""
    layer = Sdf.Layer.CreateAnonymous(".usda")
    for path, maps in painted.items():
        author_painted(Sdf.CreatePrimInLayer(layer, path), stage.GetPrimAtPath(path), maps)
    return layer
