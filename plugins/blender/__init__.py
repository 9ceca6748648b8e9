"""PhysGraph Cloth for Blender: refines coarse animated garments by the command `physgraph-usd`."""

import bpy

from . import kept, live_view, panel, refine

CLASSES = (*kept.CLASSES, *refine.CLASSES, *live_view.CLASSES, *panel.CLASSES)
KEEPERS = (bpy.types.Object, bpy.types.Material)
"""Kinds of data that keep what a USD file said."""


def register() -> None:
    """Tell Blender what there is."""
    bpy.utils.expose_bundled_modules()  # Blender hands stages to hooks by its pxr, and ends where that is not there.
    for kind in CLASSES:
        bpy.utils.register_class(kind)
    bpy.types.Scene.physgraph = bpy.props.PointerProperty(type=panel.PhysGraphSettings)
    bpy.types.Object.physgraph_coarse = bpy.props.PointerProperty(
        type=bpy.types.Object, name="Coarse", description="The garment that this one was refined from"
    )
    bpy.types.Object.physgraph_live = bpy.props.PointerProperty(
        type=bpy.types.Object, name="Live Of", description="The garment that this one shows while Live is on"
    )
    live_view.register()
    for kind in KEEPERS:
        kind.physgraph_authored = bpy.props.StringProperty(
            name="Authored", description="What a USD file said of the cloth", options={"HIDDEN"}
        )


def unregister() -> None:
    """Take it back."""
    refine.stop()
    live_view.unregister()
    del bpy.types.Object.physgraph_coarse, bpy.types.Object.physgraph_live, bpy.types.Scene.physgraph
    for kind in KEEPERS:
        del kind.physgraph_authored
    for kind in reversed(CLASSES):
        bpy.utils.unregister_class(kind)
