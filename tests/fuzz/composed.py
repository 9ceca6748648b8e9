"""What is composed into a shot: splines, levels of detail, edits of arrays, parts of skinning, twins, visibility."""

from importlib import import_module
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt
from stages import sheet_points, vec3

from .bases import SIZE, garments_of
from .damage import NAN, ODD_DOUBLES, ODD_FLOATS
from .meshes import OWN
from .mutant import Draft, Kind

_ENDS = ("Held", "Linear", "Sloped", "LoopRepeat", "LoopReset", "LoopOscillate", "ValueBlock")
"""Names of USD's extrapolations."""
_BETWEEN = ("Held", "Linear", "Curve", "ValueBlock")
_SPLINED = ("plain", "still", "bodies", "curtain", "several", "skinned")
_EDITS = (
    "edit [write (9, 9, 9) to [3]]",
    "edit [write (9, 9, 9) to [-1]]",
    "edit [write (nan, 0, 0) to [0]]",
    "edit [write (9, 9, 9) to [1000000]]",
    "edit [append (1, 2, 3)]",
    "edit [prepend (1, 2, 3)]",
    "edit [erase [0]]",
    "edit [resize to 5]",
    "edit [minsize 40]",
    "edit []",
    "AnimationBlock",
    "None",
)


def _spline(draft: Draft, kind: str, values: tuple[float, ...]) -> Any:
    """A spline of some knots, with gaps, loops and any extrapolation on either side; None with an older USD."""
    if not hasattr(Usd.Attribute, "SetSpline"):
        return None
    ts: Any = import_module("pxr.Ts")
    spline = ts.Spline(kind)
    times = draft.pick([(1.0,), (1.0, 2.0), (0.5, 1.5, 4.0), (1.0, 1.0 + 1e-7, 2.0), (-1e6, 1e6), (1.0, 3.0, 3.5, 9.0)])
    for time in times:
        knot = ts.Knot(kind)
        knot.SetTime(time)
        knot.SetValue(draft.pick(values))
        knot.SetNextInterpolation(getattr(ts, f"Interp{draft.pick(_BETWEEN)}"))
        if draft.chance(0.2):
            knot.SetPreValue(draft.pick(values))
        spline.SetKnot(knot)
    spline.SetPreExtrapolation(ts.Extrapolation(getattr(ts, f"Extrap{draft.pick(_ENDS)}")))
    spline.SetPostExtrapolation(ts.Extrapolation(getattr(ts, f"Extrap{draft.pick(_ENDS)}")))
    if draft.chance(0.3):
        loop = ts.LoopParams()
        loop.protoStart, loop.protoEnd = times[0], draft.pick([times[-1], times[0], times[0] + 0.1])
        loop.numPreLoops, loop.numPostLoops = draft.pick([0, 1, 3]), draft.pick([0, 1, 3])
        spline.SetInnerLoopParams(loop)
    return spline


def _splines(draft: Draft) -> None:
    """Places of garments, of bodies and of what is above them on splines, sizes and fabric values too."""
    stage = draft.open()
    prims = [prim for prim in stage.Traverse() if UsdGeom.Xformable(prim)]
    for _ in range(draft.pick([1, 1, 3])):
        prim, values = draft.pick(prims), draft.pick([(0.0, 1.0), (0.0, 0.1, -0.2), ODD_DOUBLES])
        size = prim.GetAttribute("radius")
        if size and draft.chance(0.5):
            attribute, kind = size, "double"
        elif prim in garments_of(stage) and draft.chance(0.3):
            attribute, kind = prim.CreateAttribute("physgraph:guide:stiffness", Sdf.ValueTypeNames.Float), "float"
        else:
            kind = draft.pick(["double", "float"])
            precise = UsdGeom.XformOp.PrecisionDouble if kind == "double" else UsdGeom.XformOp.PrecisionFloat
            suffix = f"spline{len(draft.said)}"
            make = draft.pick(["AddTranslateXOp", "AddRotateYOp", "AddScaleZOp"])
            attribute = getattr(UsdGeom.Xformable(prim), make)(precise, suffix).GetAttr()
        spline = _spline(draft, kind, values)
        if spline is not None:
            splined: Any = attribute
            splined.SetSpline(spline)
        draft.said.append(f"{attribute.GetPath()}: {values}")
    if draft.chance(0.5):
        stage.SetStartTimeCode(draft.pick([1.0, -3.0, NAN]))
        stage.SetEndTimeCode(draft.pick([1.0, 12.0, 5.5]))
    draft.save(stage, "splines")


def _levels(draft: Draft) -> None:
    """Levels of detail in any order below a root, of cloth or of a body, with an index that may not fit."""
    stage = draft.open()
    root = UsdGeom.Xform.Define(stage, "/World/levels").GetPrim()
    for name in ("high", "low", "none")[: draft.pick([1, 2, 3])]:
        shape = stage.DefinePrim(f"/World/levels/{name}/shape")
        shape.GetReferences().AddInternalReference(draft.pick(garments_of(stage)).GetPath())
        UsdGeom.XformCommonAPI(shape).SetTranslate((0.0, 0.0, draft.pick([-0.2, 3.0])))
        if draft.chance(0.5):
            shape.AddAppliedSchema("PhysGraphColliderAPI")
    for prim in (root, draft.pick([root, root.GetParent(), draft.pick(garments_of(stage))])):
        prim.AddAppliedSchema("LODRootAPI")
        index = draft.pick([0, 1, 2, -1, 1000])
        prim.CreateAttribute("lod:default:index", Sdf.ValueTypeNames.Int).Set(index)
        if draft.chance(0.4):
            override = prim.CreateAttribute("lod:override:index", Sdf.ValueTypeNames.Double)
            override.Set(draft.pick([*ODD_FLOATS, 0.0, 1.0]))
            prim.CreateAttribute("lod:override:mode", Sdf.ValueTypeNames.Token).Set(
                draft.pick(["indexedLOD", "nonsense", ""])
            )
        draft.said.append(f"{prim.GetPath()}: level {index}")
    draft.options["colliders"] = draft.pick([(), ("auto",), ("/World/levels",)])
    draft.save(stage, "levels of detail")


def _edits(draft: Draft) -> None:
    """A stronger layer that edits arrays of the shot, or blocks their animation."""
    stage = draft.open()
    garment = draft.pick(garments_of(stage))
    stage.GetRootLayer().Export(str(draft.folder / "weaker.usda"))
    name = draft.pick(["points", "points", "faceVertexIndices", "faceVertexCounts", "normals"])
    value = draft.pick(_EDITS)
    if name.startswith("face"):
        value = (
            value.replace("(9, 9, 9)", draft.pick(["0", "3", "-1"])).replace("(1, 2, 3)", "2").replace("(nan", "((1")
        )
    kind = {"points": "point3f[]", "normals": "normal3f[]"}.get(name, "int[]")
    body = f"{kind} {name} = {value}\n"
    for prim in reversed([*garment.GetPath().GetPrefixes()]):
        body = f'over "{prim.name}"\n{{\n{body}}}\n'
    head = 'subLayers = [@./weaker.usda@]\nmetersPerUnit = 0.05\nupAxis = "Y"\n'
    draft.shot.write_text(f"#usda 1.0\n(\n{head})\n{body}")
    draft.said.append(f"{garment.GetPath()}.{name} = {value}")


def _skinning(draft: Draft) -> None:
    """Skinning from which parts are missing, or in which they do not fit one another."""
    stage = draft.open()
    skinned = [prim for prim in stage.Traverse() if UsdGeom.Mesh(prim)]
    for how in draft.pick([1, 1, 2, 4]) * [draft.pick([_break_mesh, _break_mesh, _break_skeleton, _break_animation])]:
        prim = draft.pick(skinned)
        skeleton = next((each for each in stage.Traverse() if each.GetName() == "skel"), None)
        if skeleton is not None:
            draft.said.append(f"{prim.GetPath()}: {how(draft, prim, skeleton)}")
    draft.save(stage, "skinning")


def _break_mesh(draft: Draft, prim: Usd.Prim, skeleton: Usd.Prim) -> str:
    """Break a mesh's binding to a skeleton; returns what was done."""
    binding = UsdSkel.BindingAPI(prim)
    indices, weights = binding.GetJointIndicesPrimvar(), binding.GetJointWeightsPrimvar()
    ways = {
        "unbound": lambda: draft.pick([prim, skeleton]).RemoveAppliedSchema("SkelBindingAPI"),
        "no skeleton": lambda: binding.GetSkeletonRel().SetTargets(draft.pick([[], ["/Nowhere"], [prim.GetPath()]])),
        "elements": lambda: indices.SetElementSize(draft.pick([0, 2, 3])),
        "weights": lambda: weights.Set(Vt.FloatArray(draft.pick([[], [1.0], [0.0] * 12, [NAN] * 12]))),
        "far joint": lambda: indices.Set(Vt.IntArray([draft.pick([2, -1, 10**6])] * 12)),
        "folder": lambda: prim.GetParent().SetTypeName(draft.pick(["", "Scope", "Xform"])),
        "bind": lambda: binding.CreateGeomBindTransformAttr(Gf.Matrix4d(draft.pick([0.0, NAN, 1e300, -1.0]))),
    }
    how = draft.pick([*ways])
    ways[how]()
    return how


def _break_skeleton(draft: Draft, _: Usd.Prim, skeleton: Usd.Prim) -> str:
    """Break a skeleton; returns what was done."""
    joints, source = UsdSkel.Skeleton(skeleton), UsdSkel.BindingAPI(skeleton).GetAnimationSourceRel()
    none, flat = Vt.Matrix4dArray(), Vt.Matrix4dArray([Gf.Matrix4d(0.0)] * 2)
    names = draft.pick([["hip"], [], ["hip", "hip"], ["hip", "nowhere/knee"]])
    ways = {
        "joints": lambda: joints.GetJointsAttr().Set(names),
        "bind transforms": lambda: joints.GetBindTransformsAttr().Set(draft.pick([none, flat])),
        "rest transforms": lambda: joints.GetRestTransformsAttr().Set(draft.pick([none, flat])),
        "animation": lambda: source.SetTargets(draft.pick([[], ["/Nowhere"], ["/World"]])),
        "inactive": lambda: skeleton.SetActive(False),
        "untyped": lambda: skeleton.SetTypeName(draft.pick(["", "Xform"])),
    }
    how = draft.pick([*ways])
    ways[how]()
    return f"skeleton, {how}"


def _break_animation(draft: Draft, _: Usd.Prim, skeleton: Usd.Prim) -> str:
    """Break a skeleton's animation; returns what was done."""
    animation = skeleton.GetChild("anim")
    if not animation:
        return "no animation"
    attribute = draft.pick(animation.GetAuthoredAttributes())
    how = draft.pick(["empty", "cleared", "one less", "inactive"])
    value = attribute.Get(Usd.TimeCode.EarliestTime())
    if value is None:
        return f"{attribute.GetName()} without a value"
    if how == "inactive":
        animation.SetActive(False)
    else:
        attribute.Clear()
    if how == "empty":
        attribute.Set(type(value)())
    elif how == "one less":
        attribute.Set(type(value)(list(value)[:-1]), draft.pick([1.0, 2.0]))
    return f"{attribute.GetName()}, {how}"


def _twins(draft: Draft) -> None:
    """A second mesh that takes the garment's opinions by an arc, with points or faces of its own, or none."""
    stage = draft.open()
    garment = draft.pick(garments_of(stage))
    place = draft.pick(["/World/twin", "/World/extra/twin", "/Twin", f"{garment.GetPath()}/twin"])
    twin = stage.DefinePrim(place)
    how = draft.pick(["reference", "inherit", "specialize", "payload"])
    if how == "reference":
        twin.GetReferences().AddInternalReference(garment.GetPath())
    elif how == "payload":
        twin.GetPayloads().AddInternalPayload(garment.GetPath())
    elif how == "inherit":
        twin.GetInherits().AddInherit(garment.GetPath())
    else:
        twin.GetSpecializes().AddSpecialize(garment.GetPath())
    mesh, points = UsdGeom.Mesh(twin), sheet_points(None, SIZE) + np.array([0.0, 0.0, 2.0], np.float32)
    for own in {draft.pick(["points", "samples", "faces", "nothing", "instance", "typed"]) for _ in range(2)}:
        if own == "points":
            mesh.CreatePointsAttr(vec3(points[: draft.pick([len(points), 3])]))
        elif own == "samples":
            mesh.CreatePointsAttr().Set(vec3(points), draft.pick([1.0, 7.0]))
        elif own == "faces":
            mesh.CreateFaceVertexCountsAttr([3])
            mesh.CreateFaceVertexIndicesAttr([0, 1, draft.pick([2, 900])])
        elif own == "instance":
            twin.SetInstanceable(True)
        elif own == "typed":
            twin.SetTypeName(draft.pick(["Mesh", "Xform", "Sphere"]))
        draft.said.append(own)
    draft.options["garments"] = draft.pick([(), (str(garment.GetPath()),)])
    draft.save(stage, f"{place} by {how} of {garment.GetPath()}")


def _visibility(draft: Draft) -> None:
    """Cloth, bodies and what is above them that come and go."""
    stage = draft.open()
    prims = [prim for prim in stage.Traverse() if UsdGeom.Imageable(prim)]
    for _ in range(draft.pick([1, 2, 4])):
        prim = draft.pick(prims)
        attribute = UsdGeom.Imageable(prim).CreateVisibilityAttr()
        for time in draft.pick([(0.0, 2.0), (1.0, 2.0), (1.5,), (-1e9, 1.0, 1e9), (1.25, 1.75)]):
            attribute.Set(draft.pick(["inherited", "invisible", "nonsense"]), time)
        draft.said.append(f"{prim.GetPath()}: {attribute.GetTimeSamples()}")
    draft.save(stage, "visibility")


KINDS = (
    Kind("composed: splines", _splines, _SPLINED),
    Kind("composed: levels of detail", _levels, ("plain", "several", "bodies")),
    Kind("composed: edits of arrays", _edits, ("plain", "still", "several")),
    Kind("composed: parts of skinning", _skinning, ("skinned", "sparse")),
    Kind("composed: twins", _twins, ("plain", "dressed", "several", "skinned")),
    Kind("composed: visibility", _visibility, OWN),
)
