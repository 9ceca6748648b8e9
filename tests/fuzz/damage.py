"""Values that no shot should have, and how to author them where USD's own setters would refuse."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, Vt

from .mutant import Draft

NAN, INF = float("nan"), float("inf")
ODD_FLOATS = (NAN, INF, -INF, 0.0, -0.0, -1.0, 1e-45, 1e-30, 1e-9, 1e9, 1e19, 1e30, 3.4e38, -3.4e38)
ODD_DOUBLES = (*ODD_FLOATS, 1e300, -1e300, 5e-324)
ODD_INTS = (0, -1, -2, 1, 2, 1000, 2**16, 2**30, 2**31 - 1, -(2**31))
WORDS = ("", "none", "loop", "leftHanded", "vertex", "X", "nonsense", "../..", "é\u202e", "a b", "</World>")
VALUES: dict[str, Any] = {
    "bool": True,
    "int": 7,
    "int64": 2**40,
    "float": 0.5,
    "double": 0.5,
    "half": 0.5,
    "string": "soft",
    "token": "soft",
    "asset": Sdf.AssetPath("nowhere.usd"),
    "float3": Gf.Vec3f(1, 2, 3),
    "matrix4d": Gf.Matrix4d(1.0),
    "timecode": Sdf.TimeCode(3.0),
    "int[]": Vt.IntArray([0, 1, 2]),
    "uchar[]": Vt.UCharArray([0, 1, 2]),
    "int64[]": Vt.Int64Array([0, 1, 2]),
    "float[]": Vt.FloatArray([0.0, 1.0]),
    "double[]": Vt.DoubleArray([0.0, 1.0]),
    "string[]": Vt.StringArray(["a", "b"]),
    "token[]": Vt.TokenArray(["a", "b"]),
    "float2[]": Vt.Vec2fArray([Gf.Vec2f(0, 1)] * 3),
    "float3[]": Vt.Vec3fArray([Gf.Vec3f(0, 1, 2)] * 3),
    "double3[]": Vt.Vec3dArray([Gf.Vec3d(0, 1, 2)] * 3),
    "half3[]": Vt.Vec3hArray([Gf.Vec3h(0, 1, 2)] * 3),
    "point3h[]": Vt.Vec3hArray([Gf.Vec3h(0, 1, 2)] * 12),
    "float4[]": Vt.Vec4fArray([Gf.Vec4f(0, 1, 2, 3)] * 12),
    "quatf[]": Vt.QuatfArray([Gf.Quatf(1.0)] * 12),
    "matrix4d[]": Vt.Matrix4dArray([Gf.Matrix4d(1.0)] * 2),
}
"""A value of each type, by the type's name."""


def replace(stage: Usd.Stage, path: Sdf.Path, kind: str, value: Any, *, times: Sequence[float] = ()) -> None:
    """Author an attribute with another type and value in the root layer, whatever its schema says."""
    layer = stage.GetRootLayer()
    prim = Sdf.CreatePrimInLayer(layer, path.GetPrimPath())
    known = layer.GetAttributeAtPath(path)
    if known is not None:
        prim.RemoveProperty(known)
    type_name = Sdf.ValueTypeNames.Find(kind)  # pyright: ignore[reportCallIssue]  the stubs know no argument
    spec = Sdf.AttributeSpec(prim, path.name, type_name, Sdf.VariabilityVarying)
    for time in times:
        layer.SetTimeSample(spec.path, time, value)
    if not times:
        spec.default = value


def spoiled(draft: Draft, values: np.ndarray, odd: Sequence[float] = ODD_FLOATS) -> np.ndarray:
    """A few, many or all entries of an array replaced by odd values."""
    out = np.array(values, copy=True)
    flat = out.reshape(-1)
    if flat.size:
        count = int(draft.pick([1, 1, 3, max(flat.size // 4, 1), flat.size]))
        where = draft.rng.choice(flat.size, min(count, flat.size), replace=False)
        with np.errstate(all="ignore"):
            flat[where] = np.array(draft.pick(odd)).astype(out.dtype)
    return out


def resized(draft: Draft, values: np.ndarray) -> np.ndarray:
    """An array of another length: empty, one short, one long, half, twice."""
    how = draft.pick(["empty", "short", "long", "half", "twice"])
    if how == "empty":
        return values[:0]
    if how == "short":
        return values[:-1]
    if how == "half":
        return values[: len(values) // 2]
    return np.concatenate([values, values[-1:] if how == "long" else values])


def numbers(values: object) -> np.ndarray:
    """A ``Vt`` array as numpy, empty where there is none."""
    return np.zeros(0) if values is None else np.array(values)
