"""The values that a refinement used, left on the prim so that an artist can change one and refine again."""

from __future__ import annotations

from pxr import Sdf

from ...solver.scene import Garment, GarmentFrame
from ..schema import GARMENT_API
from ..stage import GarmentSource
from .overs import edit_schemas
from .stream import LayerStream


def author_used_values(stream: LayerStream, source: GarmentSource, garment: Garment, values: GarmentFrame) -> None:
    """Author the fabric, guide and level that were used, except where they are animated.

    Args:
        stream: The layer.
        source: Where the garment is; values whose source is animated are left alone.
        garment: Its constant data.
        values: Its data at the first time code.
    """
    edit_schemas(stream, source.path, added=[GARMENT_API])
    level = source.path.AppendProperty("physgraph:refine:level")
    stream.attribute(level, Sdf.ValueTypeNames.Int, uniform=True)
    stream.set(level, garment.level)
    for short, value in _used(values).items():
        if value is None or short in source.animated:
            continue
        prefix = "physgraph:" if ":" in short else "physgraph:material:"
        path = source.path.AppendProperty(prefix + short)
        stream.attribute(path, Sdf.ValueTypeNames.Float)
        stream.set(path, float(value))


def _used(values: GarmentFrame) -> dict[str, float | None]:
    """Values by short name, as in `GarmentSource.sources`."""
    fabric = values.fabric
    return {
        "stretchStiffness": fabric.stretch,
        "shearStiffness": fabric.shear,
        "bendStiffness": fabric.bend,
        "density": fabric.density,
        "thickness": fabric.thickness,
        "guide:stiffness": values.guide,
        "refine:detail": values.detail,
    }
