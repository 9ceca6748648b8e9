"""Attributes and relationships of any prim, broken: what is authored, and what we read and nobody authored; options."""

from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade, Vt

from physgraph_usd.usd.schema import PROPERTIES

from .bases import garments_of
from .damage import INF, NAN, ODD_DOUBLES, ODD_FLOATS, ODD_INTS, VALUES, WORDS, numbers, replace, resized, spoiled
from .files import ALL
from .meshes import OWN
from .mutant import Draft, Kind

BASES = (*ALL, "instances")
_SINGLE = [row.name for row in PROPERTIES if row.type != "rel" and not row.interpolation]
_PAINTED = [row.name for row in PROPERTIES if row.interpolation]
_PHYSICS = ("surfaceStretchStiffness", "surfaceBendStiffness", "density", "youngsModulus", "poissonsRatio")
_PHYSICS += ("gravityDirection", "gravityMagnitude", "restShapePoints", "restBendAnglesDefault", "thicknesses")
_READ = (
    "subdivisionScheme",
    "orientation",
    "purpose",
    "visibility",
    "holeIndices",
    "creaseIndices",
    "creaseSharpnesses",
)
_READ += ("extent", "extentsHint", "radius", "radiusTop", "height", "size", "axis", "primvars:rest", "primvars:normals")
_READ += ("xformOpOrder", "xformOp:transform", "elementType", "familyName", "indices", "ids", "invisibleIds", "joints")
_RELATIONSHIPS = ("physgraph:colliders", "physgraph:bind:targets", "physgraph:contact:exclude", "material:binding")
_RELATIONSHIPS += ("proxyPrim", "prototypes", "skel:skeleton", "skel:animationSource")
_INTERPOLATIONS = ("constant", "uniform", "vertex", "varying", "faceVarying", "", "nonsense")
_EXTREMES = (0.0, 0.25, 10.0, 0.0, 0.25, 10.0, 1e4, 1e24, 3.4e38, NAN, INF, -1.0)


def _odd(draft: Draft) -> tuple[str, Any]:
    """A type and a value that no shot should have: a number, a word, or something else than is asked for."""
    kind = draft.pick(["float", "double", "int", "token", *draft.rng.permutation([*VALUES])[:4].tolist()])
    with np.errstate(all="ignore"):
        odd = {"float": float(np.float32(draft.pick(ODD_DOUBLES))), "double": draft.pick(ODD_DOUBLES)}
    return kind, (odd | {"int": draft.pick(ODD_INTS), "token": draft.pick(WORDS)}).get(kind, VALUES[kind])


def _authored(draft: Draft) -> None:
    """Values that are not finite, of another number, type or time, blocked, removed, or of other elements."""
    stage = draft.open()
    ways = ("spoil", "spoil", "resize", "empty", "block", "retype", "remove", "interpolation", "elementSize")
    for _ in range(draft.pick([1, 1, 2, 4])):
        prims = [prim for prim in stage.Traverse() if prim.GetAuthoredAttributes()]
        if not prims:  # The last attribute is removed.
            break
        attribute, how = draft.pick(draft.pick(prims).GetAuthoredAttributes()), draft.pick(ways)
        draft.said.append(f"{attribute.GetPath()}: {how}")
        _broken(draft, stage, attribute, how)
    draft.save(stage, "saved")


def _broken(draft: Draft, stage: Usd.Stage, attribute: Usd.Attribute, how: str) -> None:
    value = attribute.Get(Usd.TimeCode.EarliestTime())
    array = numbers(value) if hasattr(type(value), "FromNumpy") else np.zeros(0, object)
    code = draft.pick([Usd.TimeCode.Default(), *map(Usd.TimeCode, (1.0, 1.5, 2.0, 50.0))])
    if how == "remove":
        attribute.GetPrim().RemoveProperty(attribute.GetName())
    elif how == "block":
        attribute.Set(Sdf.ValueBlock(), code)
    elif how in {"interpolation", "elementSize"}:
        attribute.SetMetadata(how, draft.pick(ODD_INTS if how == "elementSize" else [*_INTERPOLATIONS, *WORDS]))
    elif how == "retype" or array.dtype.kind not in "fiu":
        replace(stage, attribute.GetPath(), *_odd(draft), times=draft.pick([(), (), (1.0,), (1.0, 2.0), (50.0,)]))
    else:
        odd = ODD_FLOATS if array.dtype.kind == "f" else ODD_INTS
        changed = {"spoil": lambda: spoiled(draft, array, odd), "resize": lambda: resized(draft, array)}
        made = changed.get(how, lambda: array[:0])()
        attribute.Set(type(value).FromNumpy(np.ascontiguousarray(made.astype(array.dtype))), code)


def _read(draft: Draft) -> None:
    """Odd values of what we read, on any prim, whether it has such an attribute or not."""
    stage = draft.open()
    names = [*_SINGLE, *_SINGLE, *_READ, *(f"physics:{name}" for name in _PHYSICS)]
    for _ in range(draft.pick([1, 2, 4])):
        path = draft.pick([*stage.Traverse()]).GetPath().AppendProperty(draft.pick(names))
        kind, value = _odd(draft)
        times = draft.pick([(), (), (1.0,), (1.0, 2.0)])
        replace(stage, path, kind, value, times=times)
        draft.said.append(f"{path} = {value!r} ({kind}) at {times or 'default'}")
    draft.save(stage, "saved")


def _paint(draft: Draft) -> None:
    """Painted maps with extreme values, at one vertex or at many, of the mesh's number of points or another."""
    stage = draft.open()
    mesh = UsdGeom.Mesh(draft.pick([prim for prim in stage.Traverse() if UsdGeom.Mesh(prim)]))
    count = len(numbers(mesh.GetPointsAttr().Get(Usd.TimeCode.EarliestTime())))
    for _ in range(draft.pick([1, 1, 2])):
        name, how = draft.pick(_PAINTED), draft.pick(["vertex", "vertex", "vertex", *_INTERPOLATIONS])
        values = spoiled(draft, np.ones(count, np.float32), _EXTREMES)
        values = resized(draft, values) if draft.chance(0.2) else values
        path = mesh.GetPath().AppendProperty(name)
        replace(stage, path, "float[]", Vt.FloatArray.FromNumpy(np.ascontiguousarray(values)))
        mesh.GetPrim().GetAttribute(name).SetMetadata("interpolation", how)
        draft.said.append(f"{path}: {how}")
    draft.save(stage, "saved")


def _fabrics(draft: Draft) -> None:
    """Subsets bound to materials of their own, whose values are odd, animated, of another type, or of the proposal."""
    stage = draft.open()
    prim = draft.pick(garments_of(stage))
    count = len(numbers(UsdGeom.Mesh(prim).GetFaceVertexCountsAttr().Get()))
    binding = UsdShade.MaterialBindingAPI.Apply(prim)
    for index in range(draft.pick([1, 2, 3])):
        faces = draft.rng.permutation(count)[: draft.pick([0, 1, count // 2, count])].astype(np.int32)
        if draft.chance(0.2):
            faces = spoiled(draft, faces, ODD_INTS)
        subset = binding.CreateMaterialBindSubset(f"part{index}", Vt.IntArray.FromNumpy(faces))
        material = UsdShade.Material.Define(stage, f"/World/fabrics/part{index}")
        path = material.GetPath() if draft.chance(0.9) else draft.pick([prim.GetPath(), Sdf.Path("/Nowhere")])
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).GetDirectBindingRel().SetTargets([path])
        for name in draft.rng.permutation([*_SINGLE, *(f"physics:{each}" for each in _PHYSICS)])[:4]:
            kind = "float" if draft.chance(0.8) else draft.pick([*VALUES])
            value = draft.pick([*ODD_FLOATS, 0.5, 1e-4, 100.0]) if kind == "float" else VALUES[kind]
            times = draft.pick([(), (), (1.0, 2.0)])
            replace(stage, material.GetPath().AppendProperty(str(name)), kind, value, times=times)
            draft.said.append(f"{material.GetPath()}.{name} = {value!r} ({kind}) at {times or 'default'}")
    draft.save(stage, f"{prim.GetPath()}: fabrics of subsets")


def _relationships(draft: Draft) -> None:
    """Relationships to what is not there, to themselves, to their own prim, in a circle, or that are attributes."""
    stage = draft.open()
    layer, prims = stage.GetRootLayer(), [prim.GetPath() for prim in stage.Traverse()]
    owner, name = draft.pick(prims), draft.pick(_RELATIONSHIPS)
    targets = ["/Nowhere", str(owner), f"{owner}.{name}", "/World/floor.points", "/World.loop", *map(str, prims)]
    chosen = [Sdf.Path(draft.pick(targets)) for _ in range(draft.pick([0, 1, 2, 3]))]
    for path, to in (
        (owner.AppendProperty(name), list(dict.fromkeys(chosen))),
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
    draft.save(stage, f"{owner}.{name} -> {', '.join(map(str, chosen))}")


def _asked(draft: Draft) -> None:
    """Options that no shot satisfies, or barely."""
    paths = [
        "/World/cloth",
        "cloth",
        "/World/*",
        "/",
        "",
        "/World/cloth.points",
        "//",
        "/World.collection:x",
        "[",
        "**",
    ]
    number, name = draft.pick([*ODD_DOUBLES, "auto", "", "1e", "0x1", 3]), draft.pick(_SINGLE)
    choices = {
        "garments": [tuple(draft.pick(paths) for _ in range(draft.pick([1, 2])))],
        "colliders": [tuple(draft.pick([*paths, "/World/floor", "sphere"]) for _ in range(draft.pick([1, 2])))],
        "level": [*ODD_INTS[:5], 3],
        "frames": [(draft.pick(ODD_DOUBLES), draft.pick([*ODD_DOUBLES, 2.0])), (1.5, 1.5), (3.0, 9.0), (2.0, 1.0)],
        "rest_frame": [*ODD_DOUBLES, 1.0, 1.5, 99.0],
        "overrides": [
            (f"{name}={number}",),
            (f"/World/cloth.{name}={number}",),
            ("nonsense",),
            ("x=1", "level=1"),
            ("guide:stiffness=1e-30",),
        ],
        "tolerance": [*ODD_DOUBLES],
        "budget_ms": [*ODD_DOUBLES],
        "frame_limit": [*ODD_DOUBLES],
        "steps": [-1, 0, 1],
        "device": ["", "cuda", "cpu:1", "mps"],
        "mode": ["", "over"],
    }
    for option in draft.rng.permutation(sorted(choices))[: draft.pick([1, 1, 2])]:
        draft.options[str(option)] = draft.pick(choices[str(option)])
    draft.said.append(f"options {draft.options}")


KINDS = (
    Kind("attributes: authored", _authored, BASES),
    Kind("attributes: authored by garments and bodies", _authored, ("dressed", "bodies", "instances", "skinned")),
    Kind("attributes: read", _read, BASES),
    Kind("attributes: painted", _paint, ("plain", "still", "dressed", "several")),
    Kind("attributes: fabrics of subsets", _fabrics, OWN),
    Kind("relationships", _relationships, BASES),
    Kind("options", _asked, ("plain", "bodies", "several", "instanced", "clips", "layered")),
)
