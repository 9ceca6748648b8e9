"""Values and what rides on a garment, broken: fabrics, painted values, primvars, subsets, rest shapes, options."""

from __future__ import annotations

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

from physgraph_usd.usd.schema import PROPERTIES

from .bases import garments_of
from .damage import ODD_DOUBLES, ODD_FLOATS, ODD_INTS, VALUES, WORDS, numbers, replace, resized, spoiled
from .meshes import OWN
from .mutant import Draft, Kind

_SINGLE = [row.name for row in PROPERTIES if row.type != "rel" and not row.interpolation]
_PAINTED = [row.name for row in PROPERTIES if row.interpolation]
_PROPOSAL = ("surfaceStretchStiffness", "surfaceShearStiffness", "surfaceBendStiffness", "density", "surfaceThickness")
_PROPOSAL += ("youngsModulus", "poissonsRatio")
_INTERPOLATIONS = ("constant", "uniform", "vertex", "varying", "faceVarying", "", "nonsense")


def _place(draft: Draft, stage: Usd.Stage) -> Usd.Prim:
    """A garment, or something above it that its values may come from."""
    prim = draft.pick(garments_of(stage))
    materials = [each for each in stage.Traverse() if each.GetTypeName() == "Material"]
    return draft.pick([prim, prim, prim.GetParent(), *materials])


def _numbers(draft: Draft) -> None:
    """A fabric's value that is no number, out of its limits, or animated into nonsense."""
    stage = draft.open()
    prim, name = _place(draft, stage), draft.pick(_SINGLE)
    path = prim.GetPath().AppendProperty(name)
    times = draft.pick([(), (), (1.0,), (1.0, 2.0), (50.0,)])
    if draft.chance(0.5):
        kind, value = draft.pick(["float", "double"]), draft.pick(ODD_DOUBLES)
        with np.errstate(all="ignore"):
            value = float(np.float32(value)) if kind == "float" else value
    else:
        kind = draft.pick([*VALUES])
        value = VALUES[kind]
    replace(stage, path, kind, value, times=times)
    draft.save(stage, f"{path} = {value!r} ({kind}) at {times or 'default'}")


def _proposal(draft: Draft) -> None:
    """Values of the deformable-body proposal on a bound material, and odd units to convert them with."""
    stage = draft.open()
    for name in _PROPOSAL:
        path = Sdf.Path(f"/World/Looks/red.physics:{name}")
        with np.errstate(all="ignore"):
            replace(stage, path, "float", float(np.float32(draft.pick([*ODD_FLOATS, 1.0, 100.0]))))
    stage.RemovePrim("/World/Looks/red.physgraph:material:density")
    stage.SetMetadata("kilogramsPerUnit", draft.pick([*ODD_DOUBLES, 1.0, 1.0, 1e-3]))
    draft.save(stage, "physics values at random")


def _painted(draft: Draft) -> None:
    """Painted multipliers and pins of wrong number, sign, type or interpolation."""
    stage = draft.open()
    prim, name = draft.pick(garments_of(stage)), draft.pick(_PAINTED)
    count = len(numbers(UsdGeom.Mesh(prim).GetPointsAttr().Get(Usd.TimeCode.EarliestTime())))
    values = np.full(count, 0.5, np.float32)
    values = draft.pick([lambda: spoiled(draft, values), lambda: resized(draft, values)])()
    kind = draft.pick(["float[]", "float[]", "float[]", *VALUES])
    path = prim.GetPath().AppendProperty(name)
    value = Vt.FloatArray.FromNumpy(np.ascontiguousarray(values)) if kind == "float[]" else VALUES[kind]
    replace(stage, path, kind, value)
    primvar = UsdGeom.Primvar(prim.GetAttribute(name))
    prim.GetAttribute(name).SetMetadata("interpolation", draft.pick(_INTERPOLATIONS))
    if draft.chance(0.3):
        indices = spoiled(draft, np.arange(count, dtype=np.int32), ODD_INTS)
        replace(stage, path.GetPrimPath().AppendProperty(f"{name}:indices"), "int[]", Vt.IntArray.FromNumpy(indices))
    draft.save(stage, f"{path}: {kind}, {len(values)} values, {primvar.GetInterpolation()}")


def _primvars(draft: Draft) -> None:
    """Primvars that fit no mesh: wrong counts, indices, element sizes, interpolations and types."""
    stage = draft.open()
    prim = draft.pick(garments_of(stage))
    names = [str(each.GetName()) for each in UsdGeom.PrimvarsAPI(prim).GetAuthoredPrimvars()]
    name = draft.pick([*names, "primvars:new", "primvars:normals", "primvars:st:indices"])
    attribute = prim.GetAttribute(name)
    how = draft.pick(["retype", "size", "interpolation", "indices", "resize", "animate", "spoil"])
    if how == "retype" or not attribute:
        kind = draft.pick([*VALUES])
        replace(stage, prim.GetPath().AppendProperty(name), kind, VALUES[kind], times=draft.pick([(), (1.0, 2.0)]))
    elif how in {"size", "interpolation"}:
        key = "elementSize" if how == "size" else "interpolation"
        attribute.SetMetadata(key, draft.pick(ODD_INTS) if how == "size" else draft.pick([*_INTERPOLATIONS, *WORDS]))
    elif how == "indices":
        values = spoiled(draft, np.arange(draft.pick([0, 1, 12, 24]), dtype=np.int32), ODD_INTS)
        replace(stage, prim.GetPath().AppendProperty(f"{name}:indices"), "int[]", Vt.IntArray.FromNumpy(values))
    else:
        _change_values(draft, attribute, how)
    draft.save(stage, f"{prim.GetPath()}.{name}: {how}")


def _change_values(draft: Draft, attribute: Usd.Attribute, how: str) -> None:
    """Resize or spoil an attribute's array, at its default or at a time."""
    value = attribute.Get()
    array = numbers(value) if hasattr(type(value), "FromNumpy") else None
    if array is None or array.dtype.kind not in "fiu":
        attribute.Set(Sdf.ValueBlock())
        return
    changed = resized(draft, array) if how != "spoil" else spoiled(draft, array, ODD_INTS[:6])
    code = Usd.TimeCode(draft.pick([1.0, 1.5, 2.0])) if how == "animate" else Usd.TimeCode.Default()
    attribute.Set(type(value).FromNumpy(np.ascontiguousarray(changed)), code)


def _subsets(draft: Draft) -> None:
    """Subsets that name no faces, of unknown elements or families, animated, retyped or nested."""
    stage = draft.open()
    prim = draft.pick(garments_of(stage))
    subset = UsdGeom.Subset.Define(stage, prim.GetPath().AppendChild(draft.pick(["front", "new"])))
    if draft.chance(0.6):
        subset.CreateElementTypeAttr().Set(draft.pick(["face", "point", "edge", "tetrahedron", "segment", *WORDS]))
    if draft.chance(0.5):
        subset.CreateFamilyNameAttr().Set(draft.pick(["materialBind", *WORDS]))
    values = np.arange(draft.pick([0, 1, 3, 4, 12]), dtype=np.int32)
    if draft.chance(0.5):
        values = spoiled(draft, values, ODD_INTS)
    kind = draft.pick(["int[]", "int[]", "int[]", *VALUES])
    value = Vt.IntArray.FromNumpy(values) if kind == "int[]" else VALUES[kind]
    times = draft.pick([(), (), (1.0, 2.0)])
    replace(stage, subset.GetPath().AppendProperty("indices"), kind, value, times=times)
    if draft.chance(0.4):
        family = prim.GetPath().AppendProperty(f"subsetFamily:{draft.pick(['materialBind', 'x'])}:familyType")
        replace(stage, family, "token", draft.pick(["partition", "nonOverlapping", "unrestricted", "nonsense"]))
    draft.save(stage, f"{subset.GetPath()}: {kind} {values.tolist()}")


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
        for name in draft.rng.permutation([*_SINGLE, *(f"physics:{each}" for each in _PROPOSAL)])[:4]:
            kind = "float" if draft.chance(0.8) else draft.pick([*VALUES])
            value = draft.pick([*ODD_FLOATS, 0.5, 1e-4, 100.0]) if kind == "float" else VALUES[kind]
            times = draft.pick([(), (), (1.0, 2.0)])
            replace(stage, material.GetPath().AppendProperty(str(name)), kind, value, times=times)
            draft.said.append(f"{material.GetPath()}.{name} = {value!r} ({kind}) at {times or 'default'}")
    draft.save(stage, f"{prim.GetPath()}: fabrics of subsets")


def _rest(draft: Draft) -> None:
    """Rest shapes that are none, and rest angles of unknown names."""
    stage = draft.open()
    prim = draft.pick(garments_of(stage))
    points = numbers(UsdGeom.Mesh(prim).GetPointsAttr().Get(Usd.TimeCode.EarliestTime())).astype(np.float32)
    name = draft.pick(["physics:restShapePoints", "primvars:rest", "primvars:Pref"])
    with np.errstate(all="ignore"):
        changed = draft.pick(
            [
                lambda: spoiled(draft, points),
                lambda: resized(draft, points),
                lambda: points * 0,
                lambda: points * np.float32(1e-30),
                lambda: points * np.float32(1e25),
            ]
        )()
    path = prim.GetPath().AppendProperty(name)
    kind = draft.pick(["point3f[]", "point3f[]", "point3f[]", *VALUES])
    value = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(changed, np.float32)) if kind == "point3f[]" else VALUES[kind]
    replace(stage, path, kind, value)
    if draft.chance(0.5):
        prim.GetAttribute(name).SetMetadata("interpolation", draft.pick(_INTERPOLATIONS))
    if draft.chance(0.5):
        word = draft.pick([*WORDS, "restShapeDefault", "flatDefault"])
        replace(stage, prim.GetPath().AppendProperty("physics:restBendAnglesDefault"), "token", word)
    draft.save(stage, f"{path}: {kind}")


def _hints(draft: Draft) -> None:
    """Boxes cached by hand above a garment, under placements that have no inverse."""
    stage = draft.open()
    parent = draft.pick(garments_of(stage)).GetParent()
    corner = Gf.Vec3f(draft.pick(ODD_FLOATS))
    box = Vt.Vec3fArray([corner] * draft.pick([0, 1, 2, 3, 8, 9]))
    times = draft.pick([(), (1.0, 2.0)])
    replace(stage, parent.GetPath().AppendProperty("extentsHint"), "float3[]", box, times=times)
    if draft.chance(0.3):
        kind = draft.pick([*VALUES])
        replace(stage, parent.GetPath().AppendProperty("extentsHint"), kind, VALUES[kind], times=times)
    draft.save(stage, f"{parent.GetPath()}.extentsHint")


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
    Kind("values: fabric", _numbers, OWN),
    Kind("values: physics proposal", _proposal, ("dressed",)),
    Kind("values: painted", _painted, OWN),
    Kind("values: primvars", _primvars, ("dressed", "plain", "skinned")),
    Kind("values: subsets", _subsets, ("dressed", "plain", "still")),
    Kind("values: fabrics of subsets", _fabrics, OWN),
    Kind("values: rest shape", _rest, OWN),
    Kind("values: extents hint", _hints, ("dressed", "plain")),
    Kind("values: options", _asked, ("plain", "bodies", "several", "instanced", "clips", "layered")),
)
