"""Point instancers, as bodies and as trims, tapered shapes, and shapes that are not read, whose values are broken."""

from __future__ import annotations

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from .damage import NAN, ODD_DOUBLES, ODD_FLOATS, ODD_INTS, VALUES, numbers, replace, resized, spoiled
from .mutant import Draft, Kind

BASES = ("instances",)
ROCKS, STONES = "/World/rocks", "/World/stones"
_ARRAYS = ("positions", "orientations", "scales", "protoIndices", "ids", "invisibleIds", "velocities")


def _either(draft: Draft, stage: Usd.Stage) -> UsdGeom.PointInstancer:
    return UsdGeom.PointInstancer(stage.GetPrimAtPath(draft.pick([ROCKS, STONES])))


def _arrays(draft: Draft) -> None:
    """Arrays of an instancer that are spoiled, of another length, empty, blocked, of another type, or animated."""
    stage = draft.open()
    prim = _either(draft, stage).GetPrim()
    for _ in range(draft.pick([1, 1, 2])):
        name = draft.pick(_ARRAYS)
        attribute = prim.GetAttribute(name)
        how = draft.pick(["spoil", "resize", "empty", "block", "retype", "animate", "remove", "ids"])
        value = attribute.Get(Usd.TimeCode.EarliestTime())
        array = np.asarray(value if value is not None else [])
        if how == "remove":
            prim.RemoveProperty(name)
        elif how == "block":
            attribute.Set(Sdf.ValueBlock(), draft.pick([Usd.TimeCode.Default(), Usd.TimeCode(1.0)]))
        elif how == "ids":
            for each in ("ids", "invisibleIds"):
                prim.GetAttribute(each).Set(Vt.Int64Array([draft.pick([0, 1, 1, 7, -1, 2**40]) for _ in range(3)]))
        elif how == "retype" or value is None or not array.ndim or not len(array) or array.dtype.kind not in "fi":
            kind = draft.pick([*VALUES])
            replace(stage, attribute.GetPath(), kind, VALUES[kind], times=draft.pick([(), (1.0, 2.0)]))
        else:
            changed = array[:0]
            if how == "spoil":
                changed = spoiled(draft, array, ODD_INTS if array.dtype.kind == "i" else ODD_FLOATS)
            elif how != "empty":
                changed = resized(draft, array)
            time = draft.pick([1.0, 1.5, 2.0, 50.0]) if how == "animate" else None
            code = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
            attribute.Set(type(value).FromNumpy(np.ascontiguousarray(changed.astype(array.dtype))), code)
        draft.said.append(f"{prim.GetPath()}.{name}: {how}")
    draft.save(stage, "saved")


def _prototypes(draft: Draft) -> None:
    """Prototypes that are missing, themselves, garments, of another kind, overs, hidden, marked or badly placed."""
    stage = draft.open()
    made = _either(draft, stage)
    own, ball = str(made.GetPath()), f"{made.GetPath()}/protos/ball"
    how = draft.pick(["targets", "targets", "type", "over", "hidden", "marked", "transform", "named", "instanceable"])
    prim = stage.GetPrimAtPath(ball)
    if how == "targets":
        other = STONES if own == ROCKS else ROCKS
        choices = ["/Nowhere", own, other, "/World/cloth", "/World", ball, f"{own}/protos", f"{own}.positions"]
        made.GetPrototypesRel().SetTargets([draft.pick(choices) for _ in range(draft.pick([0, 1, 2, 3]))])
    elif how == "type":
        kinds = ["", "Xform", "Mesh", "Plane", "BasisCurves", "NurbsPatch", "TetMesh", "Points", "Volume", "Capsule_1"]
        stage.GetRootLayer().GetPrimAtPath(ball).typeName = draft.pick(kinds)
    elif how == "over":
        stage.GetRootLayer().GetPrimAtPath(ball).specifier = draft.pick([Sdf.SpecifierOver, Sdf.SpecifierClass])
    elif how == "hidden":
        UsdGeom.Imageable(draft.pick([prim, made.GetPrim()])).MakeInvisible()
    elif how == "marked":
        prim.AddAppliedSchema(draft.pick(["PhysGraphColliderAPI", "PhysGraphGarmentAPI", "PhysicsCollisionAPI"]))
    elif how == "transform":
        matrix = np.eye(4)
        matrix[tuple(draft.rng.integers(4, size=2))] = draft.pick(ODD_DOUBLES)
        matrix *= draft.pick([1.0, 0.0, -1.0, 1e30, NAN])
        target = draft.pick([prim, made.GetPrim(), stage.GetPrimAtPath(f"{own}/protos")])
        replace(stage, target.GetPath().AppendProperty("xformOp:transform"), "matrix4d", Gf.Matrix4d(matrix))
        order = Vt.TokenArray(["xformOp:transform"])
        replace(stage, target.GetPath().AppendProperty("xformOpOrder"), "token[]", order)
    elif how == "named":
        draft.options["colliders"] = [draft.pick([ball, f"{own}/protos", own, "/World", "auto"])]
    else:
        stage.GetPrimAtPath(f"{own}/protos").SetInstanceable(True)
    draft.save(stage, f"{own}: {how}")


def _tapered(draft: Draft) -> None:
    """Radii, height and axis of tapered shapes that no shape has."""
    stage = draft.open()
    prim = stage.GetPrimAtPath(draft.pick(["/World/limb", "/World/horn"]))
    for name in draft.rng.permutation(["radiusTop", "radiusBottom", "height"])[: draft.pick([1, 2, 3])]:
        value = draft.pick([*ODD_DOUBLES, 0.0, 0.2])
        times = draft.pick([(), (), (1.0,), (1.0, 2.0)])
        replace(stage, prim.GetPath().AppendProperty(str(name)), "double", value, times=times)
        draft.said.append(f"{prim.GetPath()}.{name} = {value} at {times or 'default'}")
    if draft.chance(0.3):
        replace(stage, prim.GetPath().AppendProperty("axis"), "token", draft.pick(["X", "W", ""]))
    draft.save(stage, "saved")


def _searched(draft: Draft) -> None:
    """Bodies to be found by `auto`, with wrong extents, and shapes that are not read, with arrays that do not fit."""
    stage = draft.open()
    draft.options["colliders"] = ["auto"]
    kind = draft.pick(["NurbsPatch", "BasisCurves", "HermiteCurves", "NurbsCurves", "Points", "TetMesh", "Volume"])
    prim = stage.DefinePrim("/World/shape", draft.pick([kind, kind, "Sphere", "Cylinder_1"]))
    if UsdGeom.PointBased(prim):
        points = draft.rng.normal(size=(draft.pick([0, 1, 12, 16]), 3)).astype(np.float32)
        prim.GetAttribute("points").Set(Vt.Vec3fArray.FromNumpy(spoiled(draft, points) if len(points) else points))
    for name in ("uVertexCount", "vVertexCount"):
        if prim.HasAttribute(name):
            prim.GetAttribute(name).Set(draft.pick([4, 4, 3, *ODD_INTS]))
    target = draft.pick([prim, stage.GetPrimAtPath("/World/limb"), stage.GetPrimAtPath(ROCKS)])
    ends = Vt.Vec3fArray([Gf.Vec3f(draft.pick(ODD_FLOATS))] * draft.pick([0, 1, 2, 3]))
    replace(stage, target.GetPath().AppendProperty("extent"), "float3[]", ends, times=draft.pick([(), (1.0,)]))
    draft.save(stage, f"auto beside a {prim.GetTypeName()} of {len(numbers(prim.GetAttribute('points').Get() or []))}")


KINDS = (
    Kind("instances: arrays", _arrays, BASES),
    Kind("instances: prototypes", _prototypes, BASES),
    Kind("bodies: tapered", _tapered, BASES),
    Kind("bodies: searched", _searched, BASES),
)
