"""A scene for the add-on, run in a process of Blender's own Python: arguments in, what Blender then has out.

`python blender_addon_scene.py EXTENSIONS JOB`: EXTENSIONS is a folder whose `user_default` holds the add-on; JOB is a
JSON file with the list of steps, which are the functions below with their arguments. Writes `seen.json` and `seen.npz`.
"""

import json
import os
import sys
import time
from pathlib import Path
from types import MethodType, SimpleNamespace
from typing import Any

import numpy as np

os.environ["BLENDER_USER_RESOURCES"] = os.environ["BLENDER_USER_EXTENSIONS"] = sys.argv[1]
import bpy  # pyright: ignore[reportMissingImports]  the folders come first

ADDON = "bl_ext.user_default.physgraph_usd"
CELLS = 8
SEEN: dict[str, Any] = {}
ARRAYS: dict[str, np.ndarray] = {}


def scene(command, unit=1.0, saved=None):
    """A cloth of 8 x 8 cells bent by shape keys and a bone, below a turned and stretched parent, over a hidden ball."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.preferences.addon_enable(module=ADDON)
    bpy.context.preferences.addons[ADDON].preferences.command = command
    here = bpy.context.scene
    here.unit_settings.scale_length = unit
    here.frame_start, here.frame_end, here.render.fps = 1, 3, 30
    size = 1.0 / unit
    coat = linked("Coat ä.001", sheet(size))
    holder = linked("holder", None)
    holder.scale, holder.rotation_euler, holder.location = (1.0, 1.3, 1.0), (0.1, 0.0, 0.5), (3 * size, 0.0, 2 * size)
    coat.parent, coat.location, coat.rotation_euler = holder, (0.5 * size, 0.0, 0.0), (0.0, 0.2, 0.4)
    keyed(holder, "location", ((3 * size, 0.0, 2 * size), (3 * size, 0.5 * size, 2 * size)))
    bend(coat, size)
    bone(coat)
    coat.modifiers.new("smooth", "SUBSURF").levels = 1
    ball(coat, size)
    if saved:
        bpy.ops.wm.save_as_mainfile(filepath=saved)
    bpy.ops.object.select_all(action="DESELECT")
    coat.select_set(True)


def linked(name, data):
    item = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(item)
    return item


def sheet(size):
    mesh = bpy.data.meshes.new("cloth")
    side, step = CELLS + 1, size / CELLS
    points = [(x * step, y * step, 0.0) for y in range(side) for x in range(side)]
    mesh.from_pydata(
        points, [], [(i, i + 1, i + side + 1, i + side) for i in range(side * CELLS - 1) if i % side < CELLS]
    )
    uv = mesh.uv_layers.new(name="Pattern").uv
    for loop in mesh.loops:
        uv[loop.index].vector = mesh.vertices[loop.vertex_index].co[:2]
        uv[loop.index].vector /= size
    for name in ("Unused", "Denim blue", "Wool"):
        mesh.materials.append(bpy.data.materials.new(name))
    for face in mesh.polygons:
        face.material_index = 1 + (face.index % CELLS >= CELLS // 2)
    return mesh


def keyed(item, name, values):
    for frame, value in zip((1, 3), values, strict=True):
        setattr(item, name, value)
        item.keyframe_insert(name, frame=frame)


def bend(coat, size):
    coat.shape_key_add(name="Basis")
    key = coat.shape_key_add(name="bent")
    for point in key.data:
        point.co.z = 0.2 * size * np.sin(3.0 * point.co.x / size)
        point.co.x *= 0.8
    keyed(key, "value", (0.2, 1.0))


def bone(coat):
    rig = linked("rig", bpy.data.armatures.new("rig"))
    bpy.context.view_layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    made = rig.data.edit_bones.new("bone")
    made.head, made.tail = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    bpy.ops.object.mode_set(mode="OBJECT")
    coat.vertex_groups.new(name="bone").add(list(range(len(coat.data.vertices))), 1.0, "REPLACE")
    coat.modifiers.new("rig", "ARMATURE").object = rig
    pose = rig.pose.bones["bone"]
    pose.rotation_mode = "XYZ"
    keyed(pose, "rotation_euler", ((0.0, 0.0, 0.0), (0.0, 0.6, 0.0)))


def ball(coat, size):
    """A cube that its modifier makes nearly a ball."""
    bpy.context.view_layer.update()
    middle = coat.matrix_world @ coat.data.vertices[len(coat.data.vertices) // 2].co
    bpy.ops.mesh.primitive_cube_add(size=0.66 * size, location=middle)
    body = bpy.context.object
    body.name, body.location.z = "Body", middle.z - 0.25 * size
    body.modifiers.new("round", "SUBSURF").levels = 3
    bodies = bpy.data.collections.new("Bodies")
    bpy.context.scene.collection.children.link(bodies)
    bodies.objects.link(body)
    body.hide_set(True)


def choose(colliders=None, **settings):
    panel = bpy.context.scene.physgraph
    panel.colliders = bpy.data.collections[colliders] if colliders else None
    for name, value in settings.items():
        setattr(panel, name, value)


def select(*names):
    bpy.ops.object.select_all(action="DESELECT")
    for name in names:
        bpy.data.objects[name].hide_set(False)
        bpy.data.objects[name].select_set(True)


def refine(label):
    """Press the button; what it says is `SEEN[label]`."""
    try:
        SEEN[label] = sorted(bpy.ops.physgraph.refine())
    except RuntimeError as error:
        SEEN[label] = [str(error)]


def rename(name, to):
    bpy.data.objects[name].name = to


def add_modifier(name, kind):
    bpy.data.objects[name].modifiers.new(kind.lower(), kind)


class Layout:
    """A layout that draws nothing, and takes only what Blender's takes."""

    drawn: list[list[str]]

    def __init__(self, drawn):
        object.__setattr__(self, "drawn", drawn)

    def __setattr__(self, name, value):
        assert name in bpy.types.UILayout.bl_rna.properties, name

    def __getattr__(self, name):
        known = bpy.types.UILayout.bl_rna.functions[name].parameters.keys()

        def draw(*given, **options):
            assert set(options) <= set(known), (name, options)
            if name == "prop":
                assert given[1] in given[0].bl_rna.properties.keys(), given
            if name == "operator":
                group, _, operator = given[0].partition(".")
                assert getattr(getattr(bpy.ops, group), operator).get_rna_type(), given
            self.drawn.append([name, *map(str, given[-1:])])
            return SimpleNamespace() if name == "operator" else self

        return draw


def draw(label):
    from bl_ext.user_default.physgraph_usd import panel  # pyright: ignore[reportMissingImports]

    SEEN[label] = []
    for kind in (panel.PhysGraphPreferences, panel.PHYSGRAPH_PT_panel):
        stand_in = SimpleNamespace(layout=Layout(SEEN[label]), bl_rna=kind.bl_rna)
        kind.__dict__["draw"](stand_in, bpy.context)


class Button:
    """An operator without a window: its own methods, called as Blender's event loop does."""

    def __init__(self, kind):
        self.kind, self.said, self._timer = kind, [], None

    def __getattr__(self, name):
        return MethodType(self.kind.__dict__[name], self)

    def report(self, kinds, text):
        self.said.append([*kinds, text])


def tick(label, escape_after=None, edit_mode=False):
    """Refine as in a window: an event at a time until the operator ends, which Esc does after some of them."""
    from bl_ext.user_default.physgraph_usd import refine as module  # pyright: ignore[reportMissingImports]

    button = Button(module.PHYSGRAPH_OT_refine)
    answers, first = [sorted(button.start(bpy.context))], module.now_running()
    can_press, modes = bpy.ops.physgraph.refine.poll(), set()
    if edit_mode:
        bpy.ops.object.mode_set(mode="EDIT")
    while answers[-1] in (["RUNNING_MODAL"], ["PASS_THROUGH"]):
        time.sleep(0.05)
        escape = escape_after is not None and len(answers) > escape_after
        event = SimpleNamespace(type="ESC" if escape else "TIMER", value="PRESS")
        answers.append(sorted(button.modal(bpy.context, event)))
        run = module.now_running()
        if len(answers) == 3:
            draw(f"{label} drawn")
        modes.add(bpy.context.mode)
        if edit_mode and run and run.poll():
            bpy.ops.object.mode_set(mode="OBJECT")
    folder = Path(bpy.data.filepath).parent / "physgraph"
    left = sorted(file.name for file in folder.iterdir() if "refined" in file.name)
    SEEN[label] = {"answer": answers[-1], "progress": first.progress(), "code": first._process.returncode, "left": left}
    SEEN[label] |= {"said": button.said, "could press": can_press, "modes": sorted(modes)}
    SEEN[label]["free"] = bpy.ops.physgraph.refine.poll()


def live():
    """Press "Live", and keep the process in mind."""
    bpy.ops.physgraph.live()
    shown = live_view().now_live()
    globals()["process"] = shown and shown._process._process


def live_view():
    from bl_ext.user_default.physgraph_usd import live_view as module  # pyright: ignore[reportMissingImports]

    return module


def follow(label, state="settled", patience=100.0):
    """Let Blender's timer tick until the live cloth is in a state; keep it, and the seconds until it first moved."""
    began, first, seen = time.perf_counter(), None, live_points()
    shown = live_view().now_live()
    while time.perf_counter() - began < patience:
        time.sleep(live_view().POLL_SECONDS / 10)
        goes_on, now = live_view().tick(), live_points()
        if (
            first is None
            and now.keys() == seen.keys()
            and not all(np.array_equal(now[name], seen[name]) for name in now)
        ):
            first = time.perf_counter() - began
        if not goes_on or (shown.state.startswith(state) and (first is not None or not seen)):
            break
    SEEN[label] = {"first": first, "seconds": time.perf_counter() - began, "state": shown.state}
    SEEN[label] |= {"sent": dict(shown._known.values) if shown._known else {}}
    SEEN[label] |= {"failure": live_view().last_failure(), "level": bpy.context.scene.physgraph.level}
    for item in [item for item in bpy.data.objects if item.type == "MESH"]:
        measure(item, f"{label}:{item.name}:{bpy.context.scene.frame_current}")


def live_points():
    found = {}
    for item in bpy.data.objects:
        if item.name.endswith("_live"):
            found[item.name] = np.empty(3 * len(item.data.vertices), np.float32)
            item.data.vertices.foreach_get("co", found[item.name])
    return found


def go(frame):
    bpy.context.scene.frame_set(frame)


def push():
    """Set a point that undo goes back to."""
    bpy.ops.ed.undo_push(message="step")


def undo():
    bpy.ops.ed.undo()


def keep(label):
    SEEN[label] = sorted(bpy.ops.physgraph.keep())


def kill():
    globals()["process"].kill()


def press_escape():
    button, event = Button(live_view().PHYSGRAPH_OT_live), SimpleNamespace(type="ESC", value="PRESS")
    assert button.modal(bpy.context, event) == {"CANCELLED"}


def ended(label):
    """The exit code of the process in mind."""
    SEEN[label] = globals()["process"].wait(10.0)


def unregister():
    bpy.ops.preferences.addon_disable(module=ADDON)
    SEEN["unregistered"] = [hasattr(bpy.context.scene, "physgraph"), hasattr(bpy.types.Object, "physgraph_coarse")]


def reopen(path):
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)


def look(label, *frames):
    """Keep what there is: objects, and the meshes at some frames, the coarse one without its subdivision."""
    items = {}
    for item in bpy.data.objects:
        items[item.name] = {
            "type": item.type,
            "points": len(item.data.vertices) if item.type == "MESH" else 0,
            "hidden": item.hide_get(),
            "modifiers": [[m.type, m.show_viewport] for m in item.modifiers],
            "collections": [c.name for c in item.users_collection],
            "slots": [slot.material.name if slot.material else None for slot in item.material_slots],
            "selected": item.select_get(),
            "matrix": [list(row) for row in item.matrix_basis],
        }
    here = bpy.context.scene
    SEEN[label] = {
        "objects": items,
        "materials": sorted(m.name for m in bpy.data.materials),
        "collections": sorted(c.name for c in bpy.data.collections),
        "caches": [c.filepath for c in bpy.data.cache_files if c.users],
        "range": [here.frame_start, here.frame_end, here.frame_current],
        "report": here.physgraph.last_report,
    }
    for frame in frames:
        here.frame_set(frame)
        for item in [item for item in bpy.data.objects if item.type == "MESH"]:
            measure(item, f"{label}:{item.name}:{frame}")


def measure(item, key):
    smooth = item.modifiers.get("smooth")
    if smooth:
        smooth.show_viewport = False
    evaluated = item.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = evaluated.to_mesh()
    world = np.array(evaluated.matrix_world)
    points = np.array([v.co for v in mesh.vertices])
    ARRAYS[f"{key}:points"] = points @ world[:3, :3].T + world[:3, 3]
    ARRAYS[f"{key}:faces"] = np.array([list(p.vertices) for p in mesh.polygons])
    ARRAYS[f"{key}:material"] = np.array([p.material_index for p in mesh.polygons])
    for layer in mesh.uv_layers:
        ARRAYS[f"{key}:uv:{layer.name}"] = np.array([uv.vector for uv in layer.uv]).reshape(-1, 4, 2)
    if smooth:
        smooth.show_viewport = True


for name, given in json.loads(Path(sys.argv[2]).read_text()):
    globals()[name](*given.get("", ()), **{key: value for key, value in given.items() if key})
np.savez("seen.npz", **ARRAYS)  # pyright: ignore[reportArgumentType]
Path("seen.json").write_text(json.dumps(SEEN))
