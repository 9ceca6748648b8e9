"""What a USD file says of cloth and Blender's importer drops: kept with the objects, given back on export.

Blender imports custom attributes only. Those of a schema, applied schemas, relationships and materials of the purpose
`physics` would be lost. Here they are kept as the text of a small layer, one per object and material; single numbers
and words are custom properties besides, which the artist may edit or delete.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Mapping

import bpy

OBJECT_NAME, DATA_NAME = "userProperties:blender:object_name", "userProperties:blender:data_name"
KEPT = "/kept"
"""Prim of the small layer that holds an object's or a material's properties."""
PATHS = "paths"
DIMENSIONS = {
    "physics:surfaceStretchStiffness": (1, 0),
    "physics:surfaceShearStiffness": (1, 0),
    "physics:surfaceBendStiffness": (1, 2),
    "physics:youngsModulus": (1, -1),
    "physics:poissonsRatio": (0, 0),
    "physics:density": (1, -3),
    "physics:surfaceThickness": (0, 1),
    "physics:thicknesses": (0, 1),
    "physics:thicknesses:elementType": (0, 0),
    "physics:restShapePoints": (0, 0),
    "physics:restBendAnglesDefault": (0, 0),
}
"""Powers of mass and length in the values of UsdPhysics that are kept: they are in stage units, which Blender changes.
Rest points are in the mesh's own space, which it does not."""


def keep(stage, imported: Mapping[str, Iterable[bpy.types.ID]]) -> None:
    """Keep with what was imported from a stage what it says of cloth.

    Args:
        stage: The imported `Usd.Stage`.
        imported: Blender's data by prim path.
    """
    paths = {str(path): list(found) for path, found in imported.items()}
    objects = {path for path, found in paths.items() if any(isinstance(item, bpy.types.Object) for item in found)}
    for path, found in paths.items():
        prim = stage.GetPrimAtPath(path)
        for item in found:
            if isinstance(item, bpy.types.Material):
                _keep_with(item, stage, [prim], paths)
            elif isinstance(item, bpy.types.Object):
                _keep_with(item, stage, [*_data_prims(prim, paths, objects), prim, *_above(prim, objects)], paths)


def _data_prims(prim, paths: Mapping[str, list], objects: set[str]) -> list:
    """The prims of an object's data: a mesh below a transform becomes one object with it."""
    children = (child for child in prim.GetChildren() if str(child.GetPath()) not in objects)
    return [child for child in children if str(child.GetPath()) in paths]


def _above(prim, objects: set[str]) -> Iterator:
    """The ancestors of a prim that became no objects of their own, up to one that did."""
    parent = prim.GetParent()
    while parent and not parent.IsPseudoRoot() and str(parent.GetPath()) not in objects:
        yield parent
        parent = parent.GetParent()


def _keep_with(item: bpy.types.ID, stage, prims: list, paths: Mapping[str, list]) -> None:
    """Keep what prims say, the first one's word before the others', as text and as custom properties."""
    from pxr import Usd, UsdGeom, UsdPhysics, Vt

    small = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(small, UsdGeom.GetStageMetersPerUnit(stage))
    UsdPhysics.SetStageKilogramsPerUnit(small, UsdPhysics.GetStageKilogramsPerUnit(stage))
    kept = small.OverridePrim(KEPT)
    for prim in prims:
        _copy(prim, kept)
    _copy_materials(prims[0], kept, paths)
    if not kept.GetAuthoredProperties() and not kept.GetAppliedSchemas():
        return
    small.GetRootLayer().customLayerData = {PATHS: Vt.StringArray([str(prim.GetPath()) for prim in prims])}
    item.physgraph_authored = small.GetRootLayer().ExportToString()
    for attribute in filter(_is_editable, kept.GetAttributes()):
        for other in (item, getattr(item, "data", None)):  # Blender puts custom attributes of a mesh with its data.
            if other is not None and attribute.GetName() in other:
                del other[attribute.GetName()]
        item[attribute.GetName()] = attribute.Get()


def _copy(prim, kept) -> None:
    """Copy what concerns cloth from a prim, where nothing nearer has given it yet."""
    for name in prim.GetPrimTypeInfo().GetAppliedAPISchemas():
        if name.startswith(("PhysGraph", "Physics")):
            kept.AddAppliedSchema(name)
    for found in prim.GetAuthoredProperties():
        name = found.GetName()
        if (name.startswith("physgraph:") or name in DIMENSIONS or _is_constant(found)) and not kept.HasProperty(name):
            found.FlattenTo(kept)


def _is_constant(found) -> bool:
    """Whether a property is a primvar of ours with one value; Blender itself keeps what is painted on vertices."""
    ours = found.GetName().startswith("primvars:physgraph:")
    return ours and found.GetMetadata("interpolation") in {None, "constant"}


def _copy_materials(prim, kept, paths: Mapping[str, list]) -> None:
    """Copy what bound materials say that Blender did not import, such as those of the purpose physics."""
    from pxr import UsdShade

    binding = UsdShade.MaterialBindingAPI(prim)
    bound = [binding.ComputeBoundMaterial(purpose)[0] for purpose in ("physics", UsdShade.Tokens.allPurpose)]
    lost = [material.GetPrim() for material in bound if material and str(material.GetPath()) not in paths]
    if not lost or not prim.IsA("Mesh"):
        return
    copy = UsdShade.Material.Define(kept.GetStage(), f"/{lost[0].GetName()}")
    for material in lost:
        _copy(material, copy.GetPrim())
    UsdShade.MaterialBindingAPI.Apply(kept).Bind(copy, materialPurpose="physics")


def _is_editable(attribute) -> bool:
    """Whether an attribute is a single value of ours, which a custom property can hold."""
    single = isinstance(attribute.Get(), bool | int | float | str)
    alone = not attribute.GetNumTimeSamples() and not attribute.HasAuthoredConnections()
    return attribute.GetName().startswith("physgraph:") and single and alone


def give_back(stage) -> None:
    """Write what was kept with objects and materials onto the prims that Blender exported for them.

    Writing twice is writing once: after a change of the stage's units it may be called again.

    Args:
        stage: The exported `Usd.Stage`, with the names of Blender's objects.
    """
    owners = [(*_owner(prim), prim) for prim in stage.Traverse()]
    given = [(item, _opened(item), target, prim) for item, target, prim in owners if item and item.physgraph_authored]
    paths = {
        path: str(target.GetPath())
        for _, small, target, _ in given
        for path in small.GetRootLayer().customLayerData[PATHS]
    }
    for item, small, target, prim in given:
        _give(item, small.GetPrimAtPath(KEPT), target, paths)
        for name in (*(found.GetName() for found in small.GetPrimAtPath(KEPT).GetProperties()), "physgraph_authored"):
            for double in (name, f"userProperties:{name}"):
                if prim != target or double != name:
                    prim.RemoveProperty(double)


def _owner(prim) -> tuple:
    """The object or material that a prim was exported for, and the prim that says what its cloth is like."""
    name = prim.GetAttribute(OBJECT_NAME).Get()
    if name:
        meshes = (child for child in prim.GetChildren() if child.IsA("Mesh") and child.GetAttribute(DATA_NAME))
        return bpy.data.objects.get(name), next(meshes, prim)
    name = prim.GetAttribute(DATA_NAME).Get() if prim.IsA("Material") else None
    return (bpy.data.materials.get(name) if name else None), prim


def _opened(item: bpy.types.ID):
    """The small layer that is kept with an object or a material, as a stage."""
    from pxr import Sdf, Usd

    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.ImportFromString(item.physgraph_authored)
    return Usd.Stage.Open(layer)


def _give(item: bpy.types.ID, kept, target, paths: Mapping[str, str]) -> None:
    """Write kept properties onto a prim, single values as the artist left them."""
    for name in kept.GetPrimTypeInfo().GetAppliedAPISchemas():
        if name.startswith(("PhysGraph", "Physics")):
            target.AddAppliedSchema(name)
    for attribute in kept.GetAuthoredAttributes():
        if _is_editable(attribute) and attribute.GetName() not in item:
            target.RemoveProperty(attribute.GetName())
            continue
        written = _write(attribute, target)
        if _is_editable(attribute):
            written.Set(type(attribute.Get())(item[attribute.GetName()]))
    for relationship in kept.GetAuthoredRelationships():
        if relationship.GetName() == "material:binding:physics":
            _bind(relationship, target)
            continue
        there = [paths[str(path)] for path in relationship.GetTargets() if str(path) in paths]
        if there:
            target.CreateRelationship(relationship.GetName(), custom=False).SetTargets(there)


def _write(attribute, target):
    """Write a kept attribute onto a prim, in the units of its stage; returns what was written."""
    target.RemoveProperty(attribute.GetName())
    written = attribute.FlattenTo(target)
    factor = _factor(attribute, target)
    if factor != 1.0:
        for time in attribute.GetTimeSamples():
            written.Set(_scaled(attribute.Get(time), factor), time)
        if attribute.HasAuthoredValue() and attribute.Get() is not None:
            written.Set(_scaled(attribute.Get(), factor))
    return written


def _factor(attribute, target) -> float:
    """What a number of a kept stage is multiplied by on another one."""
    from pxr import UsdGeom, UsdPhysics

    mass, length = DIMENSIONS.get(attribute.GetName(), (0, 0))
    before, after = attribute.GetStage(), target.GetStage()
    kilograms = UsdPhysics.GetStageKilogramsPerUnit(before) / UsdPhysics.GetStageKilogramsPerUnit(after)
    return kilograms**mass * (UsdGeom.GetStageMetersPerUnit(before) / UsdGeom.GetStageMetersPerUnit(after)) ** length


def _scaled(value, factor: float):
    return value * factor if isinstance(value, int | float) else type(value)([each * factor for each in value])


def _bind(relationship, target) -> None:
    """Define the kept material of the purpose physics beside Blender's own, and bind it.

    Materials of one name may come from several places or files: each has its own values in its name, as a checksum.
    """
    from pxr import UsdShade

    stage, material = target.GetStage(), relationship.GetStage().GetPrimAtPath(relationship.GetTargets()[0])
    root = stage.GetDefaultPrim().GetPath() if stage.GetDefaultPrim() else "/"
    said = sorted(f"{found.GetName()} {found.Get()}" for found in material.GetAuthoredAttributes())
    name = f"{material.GetName()}_{zlib.crc32(' '.join(said).encode()):08x}"
    copy = UsdShade.Material.Define(stage, f"{str(root).rstrip('/')}/_physics_materials/{name}")
    for name in material.GetPrimTypeInfo().GetAppliedAPISchemas():
        copy.GetPrim().AddAppliedSchema(name)
    for attribute in material.GetAuthoredAttributes():
        _write(attribute, copy.GetPrim())
    UsdShade.MaterialBindingAPI.Apply(target).Bind(copy, materialPurpose="physics")


def lacking(mesh) -> list[str]:
    """Which of a garment's stiffnesses neither it, nor what is above it, nor a bound material gives."""
    from pxr import UsdShade

    binding = UsdShade.MaterialBindingAPI(mesh)
    bound = [binding.ComputeBoundMaterial(purpose)[0] for purpose in ("physics", UsdShade.Tokens.allPurpose)]
    prims = [material.GetPrim() for material in bound if material]
    while mesh and not mesh.IsPseudoRoot():
        prims.append(mesh)
        mesh = mesh.GetParent()
    given = {found.GetName() for prim in prims for found in prim.GetAuthoredAttributes()}
    given = {name.removeprefix("userProperties:") for name in given}
    both = {"stretchStiffness": "Stretch", "bendStiffness": "Bend"}
    return [
        name
        for name, short in both.items()
        if not given & {f"physgraph:material:{name}", f"physics:surface{short}Stiffness", "physics:youngsModulus"}
    ]


class PhysGraphKeeper(bpy.types.USDHook):
    """Keeps what USD files say of cloth through every import and export, of the add-on and of Blender."""

    bl_idname = "physgraph_keeper"
    bl_label = "PhysGraph Cloth"

    @staticmethod
    def on_import(context) -> bool:
        """Keep what the stage says."""
        keep(context.get_stage(), context.get_prim_map())
        return True

    @staticmethod
    def on_export(context) -> bool:
        """Give it back."""
        give_back(context.get_stage())
        return True


CLASSES = (PhysGraphKeeper,)
