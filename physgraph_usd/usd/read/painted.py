"""Painted multipliers and pins: one float per vertex, or one for all."""

from __future__ import annotations

import numpy as np
from pxr import Usd, UsdGeom

from ...errors import SchemaError
from ..lookup import check_limits
from ..schema import GARMENT
from ..stage import Notice

_PER_VERTEX = {UsdGeom.Tokens.vertex, UsdGeom.Tokens.varying}


def read_painted(prim: Usd.Prim, short: str, count: int) -> tuple[np.ndarray, tuple[Notice, ...]]:
    """Read one of the ``primvars:physgraph:*`` values; constant ones are inherited from ancestors as USD does.

    Args:
        prim: Mesh prim.
        short: Short name of the row, such as ``bendScale``.
        count: Number of points.

    Returns:
        Values, shape (count,), float64, and what was odd about them.

    Raises:
        SchemaError: When the interpolation, type, number or limits of the values do not let them be used.
    """
    row = GARMENT[short]
    primvar = _find(prim, row.name.removeprefix("primvars:"))
    flat = primvar.ComputeFlattened(Usd.TimeCode.EarliestTime()) if primvar else None
    if primvar is None or flat is None:
        return np.full(count, float(row.fallback or 0.0)), ()
    values = np.atleast_1d(np.asarray(flat))
    where = f"<{prim.GetPath()}>.{primvar.GetAttr().GetName()}"
    if values.ndim != 1 or not (np.issubdtype(values.dtype, np.number) or values.dtype == bool):
        raise SchemaError(f"{where} is {type(flat).__name__}; author float[]")
    values = values.astype(np.float64)
    interpolation = primvar.GetInterpolation()
    if len(values) == 1 and (interpolation not in _PER_VERTEX or count == 1):
        values = np.full(count, values[0])
    elif interpolation not in _PER_VERTEX or len(values) != count:
        said = f"{len(values)} values with {interpolation} interpolation on {count} points"
        raise SchemaError(f"{where} has {said}; author one value per point (vertex) or one for all (constant)")
    notices: tuple[Notice, ...] = ()
    if row is GARMENT["pin"] and (values > 1.0).any():  # Weights that other programs paint are over 1 by rounding.
        said = f"{row.name} goes up to {values.max():g}; values over 1 are taken as 1"
        values, notices = np.minimum(values, 1.0), (Notice(str(prim.GetPath()), None, said),)
    for index in (int(values.argmin()), int(values.argmax())) if count else ():  # NaN is either's first.
        check_limits(row, float(values[index]), f"{where}[{index}]")
    return values, notices


def _find(prim: Usd.Prim, name: str) -> UsdGeom.Primvar | None:
    """The authored primvar of a name, or of the name that Blender's exporter makes of it: no colons."""
    for spelled in (name, name.replace(":", "_")):
        primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(spelled)
        if primvar and primvar.HasAuthoredValue():
            return primvar
    return None
