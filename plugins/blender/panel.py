"""What the artist sees: the preferences, the settings of a scene, and the panel in the 3D view's sidebar."""

# No `from __future__ import annotations` here: Blender reads the properties from the annotations themselves.
from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty, StringProperty

from .command import PRESETS, SLIDERS, Settings, usual_command
from .live_view import AHEAD, PHYSGRAPH_OT_keep, PHYSGRAPH_OT_live, last_failure, now_live, send
from .refine import PHYSGRAPH_OT_refine, command_of, now_running

AS_AUTHORED = "AS_AUTHORED"
FABRICS = [
    (AS_AUTHORED, "As Authored", "What the USD file or custom properties of the objects and materials say"),
    *((name, name.capitalize(), f"The fabric {name}; docs/fabrics.md has its values") for name in PRESETS),
]


class PhysGraphPreferences(bpy.types.AddonPreferences):
    """Where the command is."""

    bl_idname = __package__

    command: StringProperty(
        name="Command",
        description="The command physgraph-usd: its path, or its name where it is on the search path",
        default=usual_command(Path(__file__).parent),
        subtype="FILE_PATH",
    )

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the preferences."""
        self.layout.prop(self, "command")


class PhysGraphSettings(bpy.types.PropertyGroup):
    """How a scene's garments are refined."""

    preset: EnumProperty(name="Fabric", description="Fabric of the garments", items=FABRICS, update=send)
    level: IntProperty(
        name="Subdivisions",
        description="Each makes four faces of one; -1 chooses by the fabric's folds",
        default=2,
        min=-1,
        max=5,
        update=send,
    )
    scene_frames: BoolProperty(name="Scene's Frames", description="Refine the frames of the scene", default=True)
    frame_start: IntProperty(name="Start", description="First frame to refine", default=1)
    frame_end: IntProperty(name="End", description="Last frame to refine", default=250)
    colliders: PointerProperty(
        name="Colliders", description="The cloth rests on the meshes of this collection", type=bpy.types.Collection
    )
    hide_coarse: BoolProperty(name="Hide Coarse", description="Hide the coarse garments when the fine ones are there")
    report: BoolProperty(name="Report", description="Write a page about the run, with pictures and plots")
    more: StringProperty(
        name="Options", description="Further options of 'physgraph-usd refine', such as --device cuda --workers 4"
    )
    last_report: StringProperty(options={"HIDDEN"})

    def as_given(self, scene: bpy.types.Scene) -> Settings:
        """The settings as the command takes them."""
        frames = (scene.frame_start, scene.frame_end) if self.scene_frames else (self.frame_start, self.frame_end)
        return Settings(
            frames=frames,
            preset="" if self.preset == AS_AUTHORED else self.preset,
            values={
                slider.name: getattr(self, slider.key) / slider.factor
                for slider in SLIDERS
                if getattr(self, f"use_{slider.key}")
            },
            level=self.level,
            report=self.report,
            more=self.more,
        )


for slider in SLIDERS:
    PhysGraphSettings.__annotations__ |= {
        f"use_{slider.key}": BoolProperty(
            name=slider.label, description="Give this value in place of the fabric's or the authored one", update=send
        ),
        slider.key: FloatProperty(
            name=slider.label,
            description=f"{slider.doc} [{slider.unit}]",
            default=slider.default,
            min=slider.limits[0],
            max=slider.limits[1],
            soft_min=slider.ends[0],
            soft_max=slider.ends[1],
            update=send,
        ),
    }


class PHYSGRAPH_PT_panel(bpy.types.Panel):
    """The panel."""

    bl_label = "PhysGraph Cloth"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PhysGraph"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the settings, the button, and how far a run is."""
        settings, layout = context.scene.physgraph, self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        layout.prop(settings, "preset")
        for slider in SLIDERS:
            row = layout.row(heading=f"{slider.label} ({slider.unit})")
            row.prop(settings, f"use_{slider.key}", text="")
            value = row.row()
            value.active = getattr(settings, f"use_{slider.key}")
            value.prop(settings, slider.key, text="", slider=True)
        layout.prop(settings, "level")
        layout.prop(settings, "scene_frames")
        if not settings.scene_frames:
            frames = layout.column(align=True)
            frames.prop(settings, "frame_start")
            frames.prop(settings, "frame_end")
        for name in ("colliders", "hide_coarse", "report", "more"):
            layout.prop(settings, name)
        run = now_running()
        if run:
            part, text = run.progress()
            layout.progress(factor=part, text=text)
            layout.label(text="Esc cancels")
        else:
            layout.operator(PHYSGRAPH_OT_refine.bl_idname, icon="MOD_CLOTH")
        if not now_live():
            AHEAD.start(command_of(context))
        _draw_live(layout.box())
        if settings.last_report:
            layout.operator("wm.path_open", text="Open Report").filepath = settings.last_report


def _draw_live(box: bpy.types.UILayout) -> None:
    """Draw the button "Live" and, while that is on, the button "Keep" and how far the cloth is."""
    live = now_live()
    box.operator(PHYSGRAPH_OT_live.bl_idname, text="Stop" if live else "Live", icon="PAUSE" if live else "PLAY")
    if live:
        box.operator(PHYSGRAPH_OT_keep.bl_idname, icon="CHECKMARK")
    state = live.state if live else last_failure()
    if state:
        box.label(text=state)


CLASSES = (PhysGraphPreferences, PhysGraphSettings, PHYSGRAPH_PT_panel)
