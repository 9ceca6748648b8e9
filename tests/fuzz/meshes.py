"""Meshes, garments and bodies alike, whose arrays are broken."""

from __future__ import annotations

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from .damage import INF, NAN, ODD_DOUBLES, ODD_FLOATS, ODD_INTS, VALUES, WORDS, numbers, replace, resized, spoiled
from .mutant import Draft, Kind

OWN = ("plain", "still", "dressed", "bodies", "skinned", "several")
"""Shots whose garments are in the root layer."""
_ARRAYS = ("points", "faceVertexCounts", "faceVertexIndices")


def a_mesh(draft: Draft, stage: Usd.Stage) -> UsdGeom.Mesh:
    """One of the stage's meshes, garments and bodies alike."""
    return UsdGeom.Mesh(draft.pick([prim for prim in stage.Traverse() if UsdGeom.Mesh(prim)]))


def _points(draft: Draft) -> None:
    """Points that are not finite, huge, tiny, all in one place, or of another number, at one time or all."""
    stage = draft.open()
    attribute = a_mesh(draft, stage).GetPointsAttr()
    times = [*attribute.GetTimeSamples(), None]
    chosen = times if draft.chance(0.3) else [draft.pick(times)]
    how = draft.pick(["spoil", "resize", "scale", "collapse", "flatten", "clear", "block", "far"])
    for time in chosen:
        code = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
        points = numbers(attribute.Get(code)).astype(np.float32).reshape(-1, 3)
        if how == "clear" and time is not None:
            attribute.ClearAtTime(code)
        elif how in {"clear", "block"}:
            attribute.Set(Sdf.ValueBlock(), code)
        else:
            attribute.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(_moved(draft, points, how))), code)
    draft.save(stage, f"{attribute.GetPath()}: {how} at {chosen}")


def _moved(draft: Draft, points: np.ndarray, how: str) -> np.ndarray:
    if how == "resize":
        return resized(draft, points)
    if how == "spoil":
        return spoiled(draft, points)
    with np.errstate(all="ignore"):
        scale = {"scale": draft.pick([1e-30, 1e-12, -1.0, 1e12, 1e25, 1e38]), "collapse": 0.0}.get(how, 1.0)
        points = (points * scale).astype(np.float32)
    if how == "flatten":
        points[:, draft.pick([0, 1, 2])] = 0.0
    return points + np.float32(draft.pick([1e6, 1e12, 1e30]) if how == "far" else 0.0)


def _topology(draft: Draft) -> None:
    """Counts or indices of wrong numbers, of wrong length, animated or without a default."""
    stage = draft.open()
    mesh = a_mesh(draft, stage)
    attribute = draft.pick([mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr()])
    values = numbers(attribute.Get())
    how = draft.pick(["spoil", "resize", "shuffle", "repeat", "animate", "block", "equal"])
    changed = {
        "spoil": lambda: spoiled(draft, values, ODD_INTS),
        "resize": lambda: resized(draft, values),
        "shuffle": lambda: draft.rng.permutation(values),
        "equal": lambda: np.full_like(values, draft.pick([0, 1, 3])),
    }.get(how, lambda: draft.rng.choice(values, len(values)))()
    array = Vt.IntArray.FromNumpy(np.ascontiguousarray(changed, np.int32))
    if how == "animate":
        attribute.Set(Vt.IntArray.FromNumpy(values), 1.0)
        attribute.Set(array, draft.pick([1.5, 2.0, 50.0]))
    else:
        attribute.Set(Sdf.ValueBlock() if how == "block" else array)
    draft.save(stage, f"{attribute.GetPath()}: {how}")


def _soup(draft: Draft) -> None:
    """Faces at random: edges with many faces, repeated corners, isolated points, windings that disagree."""
    stage = draft.open()
    mesh = a_mesh(draft, stage)
    count = len(numbers(mesh.GetPointsAttr().Get(Usd.TimeCode.EarliestTime())))
    counts = draft.rng.integers(draft.pick([0, 3]), draft.pick([4, 5, 9]), size=int(draft.rng.integers(1, 40)))
    indices = draft.rng.integers(max(count, 1), size=int(counts.sum()))
    mesh.GetFaceVertexCountsAttr().Set(Vt.IntArray.FromNumpy(counts.astype(np.int32)))
    mesh.GetFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(indices.astype(np.int32)))
    draft.save(stage, f"{mesh.GetPath()}: {len(counts)} faces at random")


def _missing(draft: Draft) -> None:
    """An array that is not authored at all."""
    stage = draft.open()
    mesh = a_mesh(draft, stage)
    for name in draft.rng.permutation(_ARRAYS)[: draft.pick([1, 1, 2, 3])]:
        mesh.GetPrim().RemoveProperty(str(name))
        draft.said.append(f"{mesh.GetPath()}.{name} removed")
    draft.save(stage, "saved")


def _retyped(draft: Draft) -> None:
    """An attribute of a mesh with the type of something else."""
    stage = draft.open()
    prim = a_mesh(draft, stage).GetPrim()
    names = [name for name in prim.GetAuthoredPropertyNames() if prim.GetAttribute(name)]
    name, kind = (
        draft.pick([*names, "subdivisionScheme", "orientation", "purpose", "visibility"]),
        draft.pick([*VALUES]),
    )
    times = draft.pick([(), (), (1.0,), (1.0, 2.0)])
    replace(stage, prim.GetPath().AppendProperty(name), kind, VALUES[kind], times=times)
    draft.save(stage, f"{prim.GetPath()}.{name} is {kind} at {times or 'default'}")


def _controls(draft: Draft) -> None:
    """Tokens of the mesh that USD does not know, and animated ones."""
    stage = draft.open()
    prim = a_mesh(draft, stage).GetPrim()
    name = draft.pick(["subdivisionScheme", "orientation", "interpolateBoundary", "purpose", "visibility"])
    times = draft.pick([(), (), (1.0, 2.0)])
    word = draft.pick(WORDS)
    replace(stage, prim.GetPath().AppendProperty(name), "token", word, times=times)
    draft.save(stage, f"{prim.GetPath()}.{name} = {word!r} at {times or 'default'}")


def _sharpness(draft: Draft) -> None:
    """Holes, creases and corners that name nothing or do not fit one another; extents that are none."""
    stage = draft.open()
    prim = a_mesh(draft, stage).GetPrim()
    for name in draft.rng.permutation(["holeIndices", "creaseIndices", "creaseLengths", "cornerIndices"])[:2]:
        values = spoiled(draft, np.arange(draft.pick([0, 1, 5, 6]), dtype=np.int64), ODD_INTS).astype(np.int32)
        replace(stage, prim.GetPath().AppendProperty(str(name)), "int[]", Vt.IntArray.FromNumpy(values))
    sharp = Vt.FloatArray([draft.pick(ODD_FLOATS) for _ in range(3)])
    replace(stage, prim.GetPath().AppendProperty("creaseSharpnesses"), "float[]", sharp)
    extent = Vt.Vec3fArray([Gf.Vec3f(draft.pick(ODD_FLOATS))] * draft.pick([0, 1, 2, 3]))
    replace(stage, prim.GetPath().AppendProperty("extent"), "float3[]", extent)
    draft.save(stage, f"{prim.GetPath()}: holes, creases, extent")


def _transform(draft: Draft) -> None:
    """A placement that is singular, not finite, huge, projective, or made of operations that are not there."""
    stage = draft.open()
    prim = a_mesh(draft, stage).GetPrim()
    prim = draft.pick([prim, prim.GetParent()])
    times = draft.pick([(), (1.0,), (1.0, 2.0), (1.5,), (50.0,)])
    if draft.chance(0.3):
        order = Vt.TokenArray(draft.pick([["xformOp:nowhere"], ["!resetXformStack!"], ["nonsense", ""], []]))
        replace(stage, prim.GetPath().AppendProperty("xformOpOrder"), "token[]", order)
    else:
        matrix = np.eye(4)
        matrix[tuple(draft.rng.integers(4, size=2))] = draft.pick(ODD_DOUBLES)
        if draft.chance(0.3):
            matrix *= draft.pick([0.0, 1e-200, 1e30, 1e160, NAN, INF])
        replace(stage, prim.GetPath().AppendProperty("xformOp:transform"), "matrix4d", Gf.Matrix4d(matrix), times=times)
        order = Vt.TokenArray(["xformOp:transform"] * draft.pick([1, 1, 1, 2]))
        replace(stage, prim.GetPath().AppendProperty("xformOpOrder"), "token[]", order)
    draft.save(stage, f"{prim.GetPath()}: transform at {times or 'default'}")


def _replaced_prim(draft: Draft) -> None:
    """A mesh, or its parent, that is of another type, inactive, abstract, only an over, or gone."""
    stage = draft.open()
    prim = a_mesh(draft, stage).GetPrim()
    prim = draft.pick([prim, prim, prim.GetParent()])
    how = draft.pick(["type", "inactive", "over", "class", "gone", "invisible", "child", "instanceable", "kind"])
    spec = stage.GetRootLayer().GetPrimAtPath(prim.GetPath())
    if how == "type":
        spec.typeName = draft.pick(["", "Xform", "Points", "BasisCurves", "Sphere", "Nonsense", "PointInstancer"])
    elif how == "inactive":
        prim.SetActive(False)
    elif how in {"over", "class"}:
        spec.specifier = Sdf.SpecifierOver if how == "over" else Sdf.SpecifierClass
    elif how == "gone":
        stage.RemovePrim(prim.GetPath())
    elif how == "invisible":
        UsdGeom.Imageable(prim).MakeInvisible(draft.pick([Usd.TimeCode.Default(), Usd.TimeCode(1.0)]))
    elif how == "instanceable":
        prim.SetInstanceable(True)
    elif how == "kind":
        prim.SetMetadata("kind", draft.pick(["component", "assembly", "nonsense"]))
    else:
        UsdGeom.Mesh.Define(stage, prim.GetPath().AppendChild("inner")).GetPrim().AddAppliedSchema(
            "PhysGraphGarmentAPI"
        )
    draft.save(stage, f"{prim.GetPath()}: {how}")


KINDS = (
    Kind("mesh: points", _points, OWN),
    Kind("mesh: topology", _topology, OWN),
    Kind("mesh: random faces", _soup, OWN),
    Kind("mesh: array missing", _missing, OWN),
    Kind("mesh: wrong type", _retyped, OWN),
    Kind("mesh: unknown token", _controls, OWN),
    Kind("mesh: holes and creases", _sharpness, OWN),
    Kind("mesh: transform", _transform, OWN),
    Kind("mesh: other prim", _replaced_prim, OWN),
)
