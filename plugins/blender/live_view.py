"""The operators "Live" and "Keep": cloth that follows the panel's values at the present frame."""

from __future__ import annotations

from contextlib import suppress

import bpy
import numpy as np
from bpy.app.handlers import persistent

from .command import Settings, live_line, unsaid_warnings
from .live import Ahead, Faces, faces_in, request_for
from .refine import FAILURES, now_running, objects_of, prepare
from .shot import author_level, collection_for_cloth, metres_in, refined_of, selected_garments

POLL_SECONDS = 0.05
HIDDEN = {"coarse": "physgraph_hides_coarse", "refined": "physgraph_hides_refined"}
"""Custom properties of a live object: whether it has hidden another object, and whether that was selected."""
AHEAD = Ahead()
"""The process that waits for the next shot while the panel is shown."""
LIVE = "physgraph_is_live"
"""Custom property of every live object, also after the coarse object was deleted."""


class Live:
    """The cloth of some garments at the present frame, from the export until it is stopped.

    Attributes:
        paths: Prim path of each garment by its object's number.
        scene: Number of the scene.
        state: How far the cloth is, in words.
        unsaid: Warnings.
    """

    def __init__(self, context: bpy.types.Context) -> None:
        """Export the selected garments and start the process.

        Raises:
            CommandError: The command cannot be started.
            OSError: The files cannot be written.
            RuntimeError: Blender cannot export.
            ValueError: A setting cannot be used.
        """
        settings, self._files, written, self.paths, command = prepare(context)
        author_level(self._files.coarse, written.garments.values(), settings.level)
        garments, colliders = list(written.garments.values()), list(written.colliders.values())
        line = live_line(command, settings, self._files.coarse, garments=garments, colliders=colliders)
        self.unsaid = [] if settings.preset else unsaid_warnings(settings, written.lacking)
        self.scene, self.state = context.scene.session_uid, "reading the shot"
        self._known: Settings | None = None
        self._times: list[float | None] = []
        self._points: dict[str, np.ndarray] = {}
        self._faces: dict[str, Faces] = {}
        self._process = AHEAD.take(line, self._files.log)

    def send(self) -> None:
        """Send the changes of the panel, once the process has read the shot."""
        if self._known is not None and (scene := self._scene()) is not None:
            settings = scene.physgraph.as_given(scene)
            request = request_for(settings, self._known, list(self.paths.values()))
            self._known = settings
            if request:
                self._process.send(request)

    def go(self) -> None:
        """Send the present frame, if it was exported."""
        scene = self._scene()
        if scene is None or self._known is None or self._times == [None]:
            return
        if float(scene.frame_current) in self._times:
            self._process.send({"time": float(scene.frame_current)})
        else:
            self.state = f"frame {scene.frame_current} was not exported"

    def poll(self) -> str | None:
        """Draw the process's answers; returns the reason if the process has ended, else None."""
        news = self._process.news()
        if news.shot:
            self._begin(news.shot)
        if news.settled is not None:
            with suppress(OSError):  # The folder goes when the process ends.
                self._points |= {path: np.load(file) for path, file in news.points.items()}
                for path, file in news.faces.items():
                    if path not in self._faces or self._faces[path].file != file:
                        self._faces[path] = faces_in(file)
                self.state = "settled" if news.settled else "solving"
                self.draw()
        if news.errors:
            self.state = news.errors[-1]
        return (self._process.last_words() or "physgraph-usd ended and said nothing") if news.ended else None

    def draw(self) -> None:
        """Show the newest positions; missing objects are made."""
        scene = self._scene()
        for coarse, path in objects_of(self.paths).items() if scene else ():
            if path in self._points:
                _show(scene, coarse, self._points[path], faces=self._faces[path])

    def stop(self) -> None:
        """End the process and remove its files and objects."""
        self._process.stop()
        remove_objects()
        with suppress(OSError):
            self._files.coarse.unlink(missing_ok=True)

    def _begin(self, shot: dict) -> None:
        """Have the present frame solved with the panel's values; show the command's choice of level on the panel."""
        scene, levels = self._scene(), set(shot["levels"].values())
        self._times = shot["times"]
        if scene is None:
            return
        known = Settings((0, 0), level=levels.pop() if len(levels) == 1 else -1)
        if scene.physgraph.level < 0:
            scene.physgraph.level = max(shot["levels"].values())
        self._known = settings = scene.physgraph.as_given(scene)
        request = request_for(settings, known, list(self.paths.values()))
        if float(scene.frame_current) in self._times:
            request["time"] = float(scene.frame_current)
        self._process.send(request)

    def _scene(self) -> bpy.types.Scene | None:
        return next((scene for scene in bpy.data.scenes if scene.session_uid == self.scene), None)


class PHYSGRAPH_OT_live(bpy.types.Operator):
    """Show the selected garments' fine cloth at the present frame, with the values on the panel; Esc ends it"""

    bl_idname = "physgraph.live"
    bl_label = "Live"

    _current: Live | None = None
    """The live cloth of the window."""
    _failure = ""
    """Reason why the last live cloth ended, or ""."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether a garment is selected or Live is on; the reason is shown on the button if not."""
        reasons = {
            "A garment is being refined; Esc cancels": now_running() is not None,
            "Leave this mode for object mode": context.mode != "OBJECT",
            "Select the garments to refine: mesh objects": not selected_garments(context),
        }
        reason = None if now_live() else next((text for text, holds in reasons.items() if holds), None)
        if reason:
            cls.poll_message_set(reason)
        return reason is None

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Start, or stop."""
        PHYSGRAPH_OT_live._failure = ""
        if now_live():
            stop()
            return {"FINISHED"}
        try:
            PHYSGRAPH_OT_live._current = Live(context)
        except FAILURES as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for text in now_live().unsaid:
            self.report({"WARNING"}, text)
        if not bpy.app.timers.is_registered(tick):
            bpy.app.timers.register(tick, first_interval=POLL_SECONDS)
        return {"FINISHED"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Start and wait for Esc, or stop."""
        answer = self.execute(context)
        if answer == {"CANCELLED"} or not now_live():
            return answer
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Let every event pass but Esc."""
        if not now_live():
            return {"FINISHED", "PASS_THROUGH"}
        if event.type == "ESC" and event.value == "PRESS":
            stop()
            return {"CANCELLED"}
        return {"PASS_THROUGH"}


class PHYSGRAPH_OT_keep(bpy.types.Operator):
    """Refine the range of frames with the values that are shown, and end the live cloth"""

    bl_idname = "physgraph.keep"
    bl_label = "Keep"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the live cloth is there."""
        return now_live() is not None and context.mode == "OBJECT"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Refine and wait for it."""
        return self._refine(context, "EXEC_DEFAULT")

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Refine while Blender stays usable."""
        return self._refine(context, "INVOKE_DEFAULT")

    def _refine(self, context: bpy.types.Context, how: str) -> set[str]:
        coarse = list(objects_of(now_live().paths))
        stop()
        for item in context.selected_objects:
            item.select_set(False)
        for item in coarse:
            chosen = next(filter(_is_seen, (item, refined_of(context.scene, item))), item)
            chosen.hide_set(False)
            chosen.select_set(True)
        try:
            bpy.ops.physgraph.refine(how, True)
        except RuntimeError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


def now_live() -> Live | None:
    """The live cloth, or None."""
    return PHYSGRAPH_OT_live._current


def last_failure() -> str:
    """Reason why the last live cloth ended, or ""."""
    return PHYSGRAPH_OT_live._failure


def stop() -> None:
    """End the live cloth, if there is any."""
    live = now_live()
    PHYSGRAPH_OT_live._current = None
    if live:
        live.stop()


def send(settings: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    """Send the panel's values to the live cloth; called by Blender after each change."""
    live = now_live()
    if live and settings.id_data.session_uid == live.scene:
        live.send()


def tick() -> float | None:
    """Draw new answers; returns the seconds until the next call, None for no call."""
    live = now_live()
    if live is None:
        return None
    state = live.state
    failure = live.poll()
    if failure is not None:
        stop()
        PHYSGRAPH_OT_live._failure = failure
    if failure is not None or live.state != state:
        for window in bpy.context.window_manager.windows:
            for area in window.screen.areas:
                if area.type == "VIEW_3D":
                    area.tag_redraw()
    return None if failure is not None else POLL_SECONDS


def remove_objects() -> None:
    """Remove all live objects, also from a saved file, and show the objects hidden by them."""
    for item in [item for item in bpy.data.objects if LIVE in item]:
        coarse = item.physgraph_live
        for name, other in _others(coarse).items() if coarse else ():
            if other and HIDDEN[name] in item:
                with suppress(RuntimeError):  # It lies in another view layer.
                    other.hide_set(False)
                    other.select_set(item[HIDDEN[name]])
        mesh = item.data
        bpy.data.objects.remove(item)
        if not mesh.users:
            bpy.data.meshes.remove(mesh)


def register() -> None:
    """Follow Blender's frames, undo and files."""
    for handlers, function in _handlers():
        handlers.append(function)


def unregister() -> None:
    """End the live cloth, and follow no more."""
    stop()
    AHEAD.stop()
    for handlers, function in _handlers():
        if function in handlers:
            handlers.remove(function)


def _handlers() -> list[tuple]:
    known = bpy.app.handlers
    return [
        (known.frame_change_post, _frame_changed),
        (known.undo_post, _undone),
        (known.redo_post, _undone),
        (known.load_pre, _file_closes),
        (known.load_post, _file_opened),
    ]


@persistent
def _frame_changed(scene: bpy.types.Scene, *_: object) -> None:
    live = now_live()
    if live and scene.session_uid == live.scene:
        live.go()


@persistent
def _undone(*_: object) -> None:
    """Send values and restore objects: undo changes both without calling `send`."""
    live = now_live()
    if live:
        live.send()
        live.draw()


@persistent
def _file_closes(*_: object) -> None:
    stop()


@persistent
def _file_opened(*_: object) -> None:
    remove_objects()


def _is_seen(item: bpy.types.Object | None) -> bool:
    return item is not None and item.visible_get()


def _others(coarse: bpy.types.Object) -> dict[str, bpy.types.Object | None]:
    """Objects hidden by a live object, by the keys of `HIDDEN`."""
    return {"coarse": coarse, "refined": next((refined_of(scene, coarse) for scene in coarse.users_scene), None)}


def _show(scene: bpy.types.Scene, coarse: bpy.types.Object, points: np.ndarray, *, faces: Faces) -> None:
    """Move the live object of a garment to positions [m], world space; make or rebuild it if needed."""
    item = next((item for item in scene.objects if item.physgraph_live == coarse), None)
    if item is None:
        name = f"{coarse.name}_live"
        item = bpy.data.objects.new(name, bpy.data.meshes.new(name))
        collection_for_cloth(scene).objects.link(item)
        item.physgraph_live, item[LIVE] = coarse, True
        hides = {"coarse": scene.physgraph.hide_coarse, "refined": True}
        for key, other in _others(coarse).items():
            if hides[key] and _is_seen(other):
                item[HIDDEN[key]] = other.select_get()
                other.hide_set(True)
    mesh = item.data
    if len(mesh.vertices) != len(points) or mesh.get("faces") != faces.file:
        _build(mesh, len(points), faces)
    mesh.vertices.foreach_set("co", (points / metres_in(scene)).astype(np.float32).ravel())
    mesh.update()


def _build(mesh: bpy.types.Mesh, count: int, faces: Faces) -> None:
    """Give a mesh a number of vertices, and faces."""
    mesh.clear_geometry()
    mesh.vertices.add(count)
    mesh.loops.add(len(faces.corners))
    mesh.polygons.add(len(faces.starts))
    mesh.loops.foreach_set("vertex_index", faces.corners)
    mesh.polygons.foreach_set("loop_start", faces.starts)
    mesh.update(calc_edges=True)
    mesh.shade_smooth()
    mesh["faces"] = faces.file


CLASSES = (PHYSGRAPH_OT_live, PHYSGRAPH_OT_keep)
