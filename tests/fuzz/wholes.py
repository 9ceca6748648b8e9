"""What concerns a stage as a whole, broken: units, time, arcs between files, bodies, skeletons, relationships."""

from pxr import Gf, Sdf, Usd, UsdGeom

from .bases import garments_of
from .damage import INF, NAN, ODD_DOUBLES, ODD_INTS, WORDS
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


KINDS = (
    Kind("stage: units", _units, ALL),
    Kind("stage: time samples", _times, OWN),
    Kind("stage: arcs", _arcs, ("plain", "dressed", "bodies", "skinned", "several")),
    Kind("stage: value clips", _clips, ("clips",)),
)
