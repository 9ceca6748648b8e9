"""PhysGraph Cloth for Blender: refines coarse animated garments by the command `physgraph-usd`."""

import bpy

from . import panel, refine

CLASSES = (*refine.CLASSES, *panel.CLASSES)


def register() -> None:
    """Tell Blender what there is."""
    for kind in CLASSES:
        bpy.utils.register_class(kind)
    bpy.types.Scene.physgraph = bpy.props.PointerProperty(type=panel.PhysGraphSettings)
    bpy.types.Object.physgraph_coarse = bpy.props.PointerProperty(
        type=bpy.types.Object, name="Coarse", description="The garment that this one was refined from"
    )


def unregister() -> None:
    """Take it back."""
    refine.stop()
    del bpy.types.Object.physgraph_coarse, bpy.types.Scene.physgraph
    for kind in reversed(CLASSES):
        bpy.utils.unregister_class(kind)
