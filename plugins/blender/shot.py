"""What goes from Blender into a USD file, and what comes back as objects."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import bpy

from .kept import DATA_NAME, OBJECT_NAME, give_back, lacking

COLLECTION = "PhysGraph"
CACHE = "PhysGraph"
"""Name of the modifier that plays the refined points."""
LEVEL = "physgraph:refine:level"
SUBDIVIDING = {"SUBSURF", "MULTIRES"}


class Exported(NamedTuple):
    """Prim paths of the exported meshes, and the stiffnesses of garments that nothing gives, by objects' names."""

    garments: dict[str, str]
    colliders: dict[str, str]
    lacking: dict[str, list[str]]


def coarse_of(item: bpy.types.Object) -> bpy.types.Object:
    """The object that a refined or a live one came from; any other object itself."""
    return item.physgraph_live or item.physgraph_coarse or item


def refined_of(scene: bpy.types.Scene, coarse: bpy.types.Object) -> bpy.types.Object | None:
    """The refined object of a coarse object, or None."""
    return next((item for item in scene.objects if item.physgraph_coarse == coarse), None)


def metres_in(scene: bpy.types.Scene) -> float:
    """Length of the scene's unit [m]."""
    units = scene.unit_settings
    return units.scale_length if units.system != "NONE" else 1.0


def selected_garments(context: bpy.types.Context) -> list[bpy.types.Object]:
    """The meshes that are selected; a refined one stands for its coarse one."""
    chosen = (coarse_of(item) for item in context.selected_objects if item.type == "MESH")
    return list(dict.fromkeys(chosen))


def export(
    context: bpy.types.Context,
    file: Path,
    garments: list[bpy.types.Object],
    *,
    colliders: list[bpy.types.Object],
    frames: tuple[int, int],
) -> Exported:
    """Export garments, without their subdivision, and colliders, as they are seen, over a range of frames.

    Args:
        context: Blender's context.
        file: File to write.
        garments: Objects to refine.
        colliders: Bodies.
        frames: First and last frame.

    Raises:
        RuntimeError: Blender cannot export.
        ValueError: It left an object out.
    """
    with ExitStack() as stack:
        name = stack.enter_context(_gathered(context, [*garments, *colliders]))
        stack.enter_context(_frames(context.scene, frames))
        stack.enter_context(_not_subdivided(garments))
        bpy.ops.wm.usd_export(
            filepath=str(file),
            collection=name,
            export_animation=True,
            evaluation_mode="VIEWPORT",
            export_subdivision="TESSELLATE",
            export_armatures=False,
            export_shapekeys=False,
            xform_op_mode="MAT",
            rename_uvmaps=False,
            allow_unicode=False,
            export_textures_mode="KEEP",
            convert_world_material=False,
            author_blender_name=True,
            merge_parent_xform=False,
        )
    paths, unsaid = _finish_export(file, metres_in(context.scene))
    missing = [item.name for item in (*garments, *colliders) if item.name not in paths]
    if missing:
        raise ValueError(f"Blender exported no mesh for {', '.join(missing)}; is there a face in it?")
    own = {garment.name: unsaid[garment.name] for garment in garments if unsaid[garment.name]}
    return Exported({g.name: paths[g.name] for g in garments}, {c.name: paths[c.name] for c in colliders}, own)


def bring_back(
    context: bpy.types.Context, root: Path, garments: dict[bpy.types.Object, str], *, hide: bool
) -> list[bpy.types.Object]:
    """Make or renew the refined object of each garment.

    It hangs from the coarse object, so it is where that is, whatever moves or scales it.

    Args:
        context: Blender's context.
        root: The layer over the shot.
        garments: Prim path of each coarse object.
        hide: Whether to hide the coarse objects.

    Returns:
        The refined objects.
    """
    made = []
    for coarse, path in garments.items():
        fine = _refined_object(context, coarse)
        _take_import(fine, root, path)
        _assign_materials(fine, coarse, root, path)
        if hide:
            coarse.hide_set(True)
            coarse.hide_render = True
        made.append(fine)
    return made


def author_level(file: Path, paths: Iterable[str], level: int) -> None:
    """Write a number of subdivisions onto garments of an exported file; -1 lets the command choose."""
    from pxr import Sdf, Usd

    stage = Usd.Stage.Open(str(file))
    for path in paths:
        stage.GetPrimAtPath(path).CreateAttribute(LEVEL, Sdf.ValueTypeNames.Int, False).Set(level)
    stage.GetRootLayer().Save()


def collection_for_cloth(scene: bpy.types.Scene) -> bpy.types.Collection:
    """The collection of refined and live objects; made if missing."""
    collection = bpy.data.collections.get(COLLECTION) or bpy.data.collections.new(COLLECTION)
    if collection not in scene.collection.children_recursive:
        scene.collection.children.link(collection)
    return collection


@contextmanager
def _gathered(context: bpy.types.Context, items: list[bpy.types.Object]) -> Iterator[str]:
    """Name of a collection that holds objects, all of them visible, while the context lasts."""
    collection = bpy.data.collections.new("PhysGraph export")
    context.scene.collection.children.link(collection)
    for item in dict.fromkeys(items):
        collection.objects.link(item)
    context.view_layer.update()
    hidden = [(item, item.hide_get(), item.hide_viewport) for item in items]
    try:
        for item in items:
            item.hide_viewport = False
            item.hide_set(False)
        yield collection.name
    finally:
        for item, eye, viewport in hidden:
            item.hide_set(eye)
            item.hide_viewport = viewport
        bpy.data.collections.remove(collection)


@contextmanager
def _frames(scene: bpy.types.Scene, frames: tuple[int, int]) -> Iterator[None]:
    """Give the scene a range of frames while the context lasts."""
    before, current = (scene.frame_start, scene.frame_end), scene.frame_current
    try:
        scene.frame_start, scene.frame_end = frames
        yield
    finally:
        scene.frame_start, scene.frame_end = before
        scene.frame_set(current)


@contextmanager
def _not_subdivided(garments: list[bpy.types.Object]) -> Iterator[None]:
    """Switch the garments' subdivision off while the context lasts."""
    shown = [m for item in garments for m in item.modifiers if m.type in SUBDIVIDING and m.show_viewport]
    try:
        for modifier in shown:
            modifier.show_viewport = False
        yield
    finally:
        for modifier in shown:
            modifier.show_viewport = True


def _finish_export(file: Path, metres: float) -> tuple[dict[str, str], dict[str, list[str]]]:
    """Say how long the scene's unit is, which Blender does not.

    Returns:
        The mesh's path, and which stiffnesses nothing gives it, by its object's name.
    """
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(file))
    UsdGeom.SetStageMetersPerUnit(stage, metres)
    give_back(stage)
    stage.GetRootLayer().Save()
    meshes = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    names = [mesh.GetParent().GetAttribute(OBJECT_NAME).Get() for mesh in meshes]
    paths = {name: str(mesh.GetPath()) for name, mesh in zip(names, meshes, strict=True)}
    return paths, {name: lacking(mesh) for name, mesh in zip(names, meshes, strict=True)}


def _refined_object(context: bpy.types.Context, coarse: bpy.types.Object) -> bpy.types.Object:
    """The refined object of a coarse one, in the collection for them; made where there is none."""
    there = refined_of(context.scene, coarse)
    if there:
        return there
    name = f"{coarse.name}_refined"
    fine = bpy.data.objects.new(name, bpy.data.meshes.new(name))
    collection_for_cloth(context.scene).objects.link(fine)
    fine.parent = fine.physgraph_coarse = coarse
    return fine


def _take_import(fine: bpy.types.Object, root: Path, path: str) -> None:
    """Import one mesh, and give its data and its cache to the refined object; all else of the import is removed."""
    before = set(bpy.data.objects)
    bpy.ops.wm.usd_import(
        filepath=str(root),
        prim_path_mask=path,
        import_materials=False,
        set_frame_range=False,
        **{"property_import_mode" if bpy.app.version >= (5, 0) else "attr_import_mode": "NONE"},
        create_world_material=False,
        relative_path=bpy.data.is_saved,
    )
    imported = [item for item in bpy.data.objects if item not in before]
    mesh = next((item for item in imported if item.type == "MESH"), None)
    if mesh is None:
        raise RuntimeError(f"Blender imports no mesh at {path} of {root}")
    old, fine.data = fine.data, mesh.data
    fine.data.name = fine.name
    if not old.users:
        bpy.data.meshes.remove(old)
    cache = fine.modifiers.get(CACHE)
    played = next((m for m in mesh.modifiers if m.type == "MESH_SEQUENCE_CACHE"), None)
    if played and not cache:
        cache = fine.modifiers.new(CACHE, "MESH_SEQUENCE_CACHE")
        fine.modifiers.move(len(fine.modifiers) - 1, 0)
    if played:
        cache.cache_file, cache.object_path = played.cache_file, played.object_path
        cache.read_data = played.read_data
    elif cache:
        fine.modifiers.remove(cache)
    for item in imported:
        bpy.data.objects.remove(item)


def _assign_materials(fine: bpy.types.Object, coarse: bpy.types.Object, root: Path, path: str) -> None:
    """Give the refined mesh the coarse object's material slots, each face in that of its coarse face."""
    from pxr import Usd, UsdGeom, UsdShade

    slots = [slot.material for slot in coarse.material_slots]
    fine.data.materials.clear()
    for material in slots:
        fine.data.materials.append(material)
    names = [material.name if material else "" for material in slots]
    stage = Usd.Stage.Open(str(root))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(path))
    index = [0] * len(fine.data.polygons)
    for subset in UsdShade.MaterialBindingAPI(mesh).GetMaterialBindSubsets():
        material, _ = UsdShade.MaterialBindingAPI(subset).ComputeBoundMaterial()
        name = material.GetPrim().GetAttribute(DATA_NAME).Get() if material else ""
        for face in subset.GetIndicesAttr().Get() if name in names else ():
            index[face] = names.index(name)
    fine.data.polygons.foreach_set("material_index", index)
    fine.data.update()
