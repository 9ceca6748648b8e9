"""What concerns a stage as a whole, broken: units, time, arcs between files, bodies, skeletons, relationships."""

from __future__ import annotations

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

from .bases import garments_of
from .damage import INF, NAN, ODD_DOUBLES, ODD_FLOATS, ODD_INTS, VALUES, WORDS, numbers, replace, spoiled
from .files import ALL
from .meshes import OWN
from .mutant import Draft, Kind

_UNITS = ("metersPerUnit", "kilogramsPerUnit", "timeCodesPerSecond", "framesPerSecond")
_CYCLES = ("references", "payload", "inherits", "specializes", "sublayer", "sublayer pair", "reference to below")
_MISSING = (
    "missing reference",
    "missing payload",
    "missing sublayer",
    "missing prim",
    "variants",
    "clips",
    "relocates",
)


def _units(draft: Draft) -> None:
    """Units, rates, axes, ranges and the default prim: zero, negative, not finite, huge, of another type."""
    stage = draft.open()
    root = stage.GetRootLayer().pseudoRoot
    for _ in range(draft.pick([1, 1, 2, 3])):
        how = draft.pick([*_UNITS, *_UNITS, "upAxis", "range", "defaultPrim"])
        if how == "upAxis":
            root.SetInfo("upAxis", draft.pick([*WORDS, "Y", "Z"]))
        elif how == "defaultPrim":
            root.SetInfo("defaultPrim", draft.pick([*WORDS, "World", "/World/cloth"]))
        elif how == "range":
            root.SetInfo("startTimeCode", draft.pick(ODD_DOUBLES))
            root.SetInfo("endTimeCode", draft.pick(ODD_DOUBLES))
        else:
            root.SetInfo(how, draft.pick(ODD_DOUBLES))
        draft.said.append(how)
    draft.save(stage, str({key: root.GetInfo(key) for key in root.ListInfoKeys() if key in _UNITS}))


def _physics(draft: Draft) -> None:
    """Gravity without a direction or a size."""
    stage = draft.open()
    scene = Sdf.Path("/World/physics")
    direction = Gf.Vec3f(*(draft.pick(ODD_FLOATS) for _ in range(3)))
    replace(stage, scene.AppendProperty("physics:gravityDirection"), "vector3f", direction)
    if draft.chance(0.7):
        kind = draft.pick(["float", "float", *VALUES])
        with np.errstate(all="ignore"):
            value = float(np.float32(draft.pick(ODD_FLOATS))) if kind == "float" else VALUES[kind]
        replace(stage, scene.AppendProperty("physics:gravityMagnitude"), kind, value)
    stage.DefinePrim(scene, "PhysicsScene")
    draft.save(stage, f"gravity along {direction}")


def _times(draft: Draft) -> None:
    """Samples at huge, tiny, equal or endless times, in great number, or at the default only."""
    stage = draft.open()
    layer, path = stage.GetRootLayer(), draft.pick(garments_of(stage)).GetPath().AppendProperty("points")
    points = UsdGeom.Mesh(stage.GetPrimAtPath(path.GetPrimPath())).GetPointsAttr().Get(Usd.TimeCode.EarliestTime())
    how = draft.pick(["odd", "close", "many", "gap", "blocked", "shifted"])
    times: list[float] = {
        "odd": [draft.pick(ODD_DOUBLES) for _ in range(3)],
        "close": [1.0, 1.0 + 1e-12, 1.0 + 1e-7, 1.0 + 1e-5],
        "many": [1.0 + 0.01 * index for index in range(40)],
        "gap": [-1e9, 1.0, 1e9],
        "blocked": [1.0, 1.5, 2.0],
        "shifted": [1.0 / 3.0, 2.0 / 3.0],
    }[how]
    for time in times:
        layer.SetTimeSample(path, time, Sdf.ValueBlock() if how == "blocked" else points)
    draft.save(stage, f"{path}: {how} {times}")


def _arcs(draft: Draft) -> None:
    """Arcs that run in circles, lead nowhere, or bring time offsets that no time has."""
    stage = draft.open()
    prim = draft.pick([stage.GetPrimAtPath("/World"), *garments_of(stage)])
    how = draft.pick([*_CYCLES, *_MISSING, "offset", "reference offset"])
    layer, spec = stage.GetRootLayer(), Sdf.CreatePrimInLayer(stage.GetRootLayer(), prim.GetPath())
    offset = Sdf.LayerOffset(draft.pick([0.0, *ODD_DOUBLES]), draft.pick([1.0, *ODD_DOUBLES]))
    if how in {"offset", "sublayer", "sublayer pair", "missing sublayer"}:
        _sublayers(draft, layer, how, offset)
    elif how == "references":
        spec.referenceList.Prepend(Sdf.Reference(draft.shot.name, prim.GetPath()))
    elif how == "reference to below":
        spec.referenceList.Prepend(Sdf.Reference(primPath=Sdf.Path("/World")))
    elif how == "reference offset":
        spec.referenceList.Prepend(Sdf.Reference("", Sdf.Path("/Other"), offset))
        Sdf.CreatePrimInLayer(layer, "/Other")
    elif how == "payload":
        spec.payloadList.Prepend(Sdf.Payload(draft.shot.name, prim.GetPath()))
    elif how == "inherits":
        spec.inheritPathList.Prepend(prim.GetPath())
    elif how == "specializes":
        spec.specializesList.Prepend(prim.GetPath().GetParentPath())
    else:
        _nowhere(draft, stage, prim, how)
    layer.Save()
    draft.said.append(f"{prim.GetPath()}: {how}, offset {offset.offset:g} x {offset.scale:g}")


def _sublayers(draft: Draft, layer: Sdf.Layer, how: str, offset: Sdf.LayerOffset) -> None:
    """Sublayers: the shot itself, one that has it, one that is not there, one with an odd offset."""
    other = Sdf.Layer.CreateNew(str(draft.folder / "other.usda"))
    if how == "sublayer pair":
        other.subLayerPaths.append(draft.shot.name)
    other.Save()
    layer.subLayerPaths.append({"sublayer": draft.shot.name, "missing sublayer": "nowhere.usda"}.get(how, "other.usda"))
    layer.subLayerOffsets[len(layer.subLayerPaths) - 1] = offset


def _nowhere(draft: Draft, stage: Usd.Stage, prim: Usd.Prim, how: str) -> None:
    """Arcs to what is not there."""
    spec = stage.GetRootLayer().GetPrimAtPath(prim.GetPath())
    if how == "missing reference":
        spec.referenceList.Prepend(Sdf.Reference(draft.pick(["nowhere.usda", "../", "http://x/y", " "]), "/World"))
    elif how == "missing payload":
        spec.payloadList.Prepend(Sdf.Payload(draft.pick(["nowhere.usda", "nowhere.abc"]), "/World"))
    elif how == "missing prim":
        spec.referenceList.Prepend(Sdf.Reference(primPath="/Nowhere"))
    elif how == "variants":
        variants = prim.GetVariantSets().AddVariantSet("look")
        variants.SetVariantSelection(draft.pick(["nowhere", ""]))
    elif how == "relocates":
        stage.GetRootLayer().pseudoRoot.SetInfo("layerRelocates", [("/World", "/Other"), ("/World/cloth", "/World")])
    else:
        clips = Usd.ClipsAPI(prim)
        clips.SetClipAssetPaths([Sdf.AssetPath(draft.pick(["nowhere.usda", draft.shot.name]))])
        clips.SetClipPrimPath(draft.pick(["/World/cloth", "/Nowhere", "nonsense"]))
        clips.SetClipActive([Gf.Vec2d(draft.pick(ODD_DOUBLES), draft.pick(ODD_DOUBLES))] * 2)
        clips.SetClipTimes([Gf.Vec2d(draft.pick(ODD_DOUBLES), draft.pick(ODD_DOUBLES))] * 2)


def _clips(draft: Draft) -> None:
    """Value clips whose times, activity and manifest do not fit one another."""
    stage = draft.open()
    clips = Usd.ClipsAPI(stage.GetPrimAtPath("/World/cloth"))
    pairs = [Gf.Vec2d(draft.pick([*ODD_DOUBLES, 1.0]), draft.pick([*ODD_INTS, 1.0])) for _ in range(3)]
    how = draft.pick(["active", "times", "paths", "manifest", "prim", "template"])
    if how == "active":
        clips.SetClipActive(pairs)
    elif how == "times":
        clips.SetClipTimes(pairs)
    elif how == "paths":
        clips.SetClipAssetPaths([Sdf.AssetPath(draft.pick(["nowhere.usda", draft.shot.name, ""]))] * 2)
    elif how == "manifest":
        clips.SetClipManifestAssetPath(Sdf.AssetPath(draft.pick(["nowhere.usda", draft.shot.name, ""])))
    elif how == "prim":
        clips.SetClipPrimPath(draft.pick(["/Nowhere", "nonsense", "/"]))
    else:
        clips.SetClipTemplateAssetPath(draft.pick(["./clip.#.usda", "nonsense", "./x.###.usda"]))
        clips.SetClipTemplateStartTime(draft.pick([1.0, NAN, -INF]))
        clips.SetClipTemplateEndTime(draft.pick([2.0, 1e6, NAN]))
        clips.SetClipTemplateStride(draft.pick([1.0, 1e-3, 1e-9]))
    draft.save(stage, f"clips: {how}")


def _bodies(draft: Draft) -> None:
    """Colliders whose sizes, axes, offsets, switches and placements are none."""
    stage = draft.open()
    names = [prim for prim in stage.Traverse() if UsdGeom.Gprim(prim) and not UsdGeom.Mesh(prim)]
    for _ in range(draft.pick([1, 2, 4])):
        path = draft.pick(names).GetPath()
        name = draft.pick(["radius", "height", "size", "axis", "width", "length", "extent", "radiusTop"])
        name = draft.pick([name, name, "physgraph:collider:offset", "physgraph:collider:enabled"])
        kind = draft.pick(["double", "double", "token", *VALUES])
        odd = {"double": draft.pick(ODD_DOUBLES), "token": draft.pick([*WORDS, "Y", "Z"])}
        value = odd.get(kind, VALUES[kind])
        replace(stage, path.AppendProperty(name), kind, value, times=draft.pick([(), (), (1.0, 2.0)]))
        draft.said.append(f"{path}.{name} = {value!r}")
    prim = draft.pick(names)
    if draft.chance(0.5):
        scale = Gf.Vec3f(*(draft.pick([1.0, *ODD_FLOATS]) for _ in range(3)))
        UsdGeom.XformCommonAPI(prim).SetScale(scale)
        draft.said.append(f"{prim.GetPath()} scaled by {scale}")
    draft.save(stage, "saved")


def _skin(draft: Draft) -> None:
    """Skinning that does not fit: influences, joints, bind poses, animations and blend shapes."""
    stage = draft.open()
    mesh = stage.GetPrimAtPath("/World/rig/cloth")
    prims = [mesh, mesh, *(stage.GetPrimAtPath(f"/World/rig/{name}") for name in ("skel", "skel/anim", "cloth/bulge"))]
    for _ in range(draft.pick([1, 1, 2])):
        prim = draft.pick(prims)
        if not (attributes := prim.GetAuthoredAttributes()):
            continue
        attribute = draft.pick(attributes)
        path, value = attribute.GetPath(), attribute.Get(Usd.TimeCode.EarliestTime())
        how = draft.pick(["retype", "empty", "spoil", "remove", "size"])
        if how == "remove":
            prim.RemoveProperty(attribute.GetName())
        elif how == "size":
            attribute.SetMetadata("elementSize", draft.pick(ODD_INTS))
        elif how == "empty" and value is not None:
            attribute.Set(type(value)(), draft.pick([Usd.TimeCode.Default(), Usd.TimeCode(1.0)]))
        elif how == "spoil" and getattr(numbers(value), "dtype", np.dtype(object)).kind in "fi" and value is not None:
            array = numbers(value)
            odd = ODD_INTS if array.dtype.kind == "i" else ODD_FLOATS
            attribute.Set(type(value).FromNumpy(np.ascontiguousarray(spoiled(draft, array, odd))))
        else:
            kind = draft.pick([*VALUES])
            replace(stage, path, kind, VALUES[kind], times=draft.pick([(), (1.0, 2.0)]))
        draft.said.append(f"{path}: {how}")
    draft.save(stage, "saved")


def _skeleton(draft: Draft) -> None:
    """Skeletons that are not there, are someone else, or whose joints are not a tree."""
    stage = draft.open()
    mesh, skel = stage.GetPrimAtPath("/World/rig/cloth"), stage.GetPrimAtPath("/World/rig/skel")
    targets = draft.pick(
        [[], ["/Nowhere"], ["/World/rig/cloth"], ["/World/rig/skel/anim"], ["/World", "/World/rig/skel"]]
    )
    how = draft.pick(["skeleton", "animation", "joints", "root", "own", "nested", "anim joints", "rate"])
    if how == "skeleton":
        mesh.GetRelationship("skel:skeleton").SetTargets([Sdf.Path(each) for each in targets])
    elif how == "animation":
        skel.GetRelationship("skel:animationSource").SetTargets([Sdf.Path(each) for each in targets])
    elif how in {"joints", "anim joints"}:
        prim = skel if how == "joints" else stage.GetPrimAtPath("/World/rig/skel/anim")
        joints = draft.pick([["a", "a"], ["a/b", "a"], ["", ""], ["hip"], ["hip", "hip/knee", "hip/knee/x"], []])
        prim.GetAttribute("joints").Set(Vt.TokenArray(joints))
    elif how == "root":
        stage.GetRootLayer().GetPrimAtPath("/World/rig").typeName = draft.pick(["Xform", "Scope", "Mesh", "Skeleton"])
    elif how == "own":
        order = Vt.TokenArray(draft.pick([["x", "y"], ["hip"], ["hip/knee", "hip"], []]))
        replace(stage, mesh.GetPath().AppendProperty("skel:joints"), "token[]", order)
    elif how == "rate":
        stage.GetRootLayer().pseudoRoot.SetInfo("timeCodesPerSecond", draft.pick(ODD_DOUBLES))
    else:
        UsdSkel.Root.Define(stage, "/World")
    draft.save(stage, f"skeleton: {how} {targets}")


def _relationships(draft: Draft) -> None:
    """Colliders, materials and proxies that are not there, are themselves, or name each other in a circle."""
    stage = draft.open()
    prim = draft.pick(garments_of(stage))
    name = draft.pick(["physgraph:colliders", "physgraph:colliders", "material:binding", "proxyPrim", "skel:skeleton"])
    own = str(prim.GetPath())
    targets = ["/Nowhere", own, f"{own}.{name}", "/World/floor.points", "/World.loop", "/World/physics", "/World"]
    chosen = [Sdf.Path(draft.pick(targets)) for _ in range(draft.pick([1, 2]))]
    layer = stage.GetRootLayer()
    for path, to in (
        (prim.GetPath().AppendProperty(name), list(dict.fromkeys(chosen))),
        (Sdf.Path("/World.loop"), [Sdf.Path("/World.loop")]),
    ):
        spec = Sdf.CreatePrimInLayer(layer, path.GetPrimPath())
        known = spec.properties.get(path.name)
        if known is not None:
            spec.RemoveProperty(known)
        if draft.chance(0.1):
            Sdf.AttributeSpec(spec, path.name, Sdf.ValueTypeNames.Float, Sdf.VariabilityVarying)
        else:
            Sdf.RelationshipSpec(spec, path.name, False).targetPathList.explicitItems = to
    draft.save(stage, f"{prim.GetPath()}.{name} -> {', '.join(map(str, chosen))}")


KINDS = (
    Kind("stage: units", _units, ALL),
    Kind("stage: gravity", _physics, ("bodies", "plain")),
    Kind("stage: time samples", _times, OWN),
    Kind("stage: arcs", _arcs, ("plain", "dressed", "bodies", "skinned", "several")),
    Kind("stage: value clips", _clips, ("clips",)),
    Kind("bodies: shapes", _bodies, ("bodies",)),
    Kind("skin: influences", _skin, ("skinned",)),
    Kind("skin: skeleton", _skeleton, ("skinned",)),
    Kind("relationships", _relationships, OWN),
)
