"""The operator: exports, runs the command while Blender goes on, and brings the cloth back."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import bpy

from .command import CommandError, Files, Run, Settings, command_lines, files_of_run, unsaid_warnings
from .shot import Exported, bring_back, export, selected_garments

FOLDER = "physgraph"
"""Name of the folder beside the .blend file."""
POLL_SECONDS = 0.2
FAILURES = (CommandError, OSError, RuntimeError, ValueError)
"""What exporting, running and importing may end with."""


class Prepared(NamedTuple):
    """An exported shot, ready for the command.

    Attributes:
        settings: What the panel says.
        files: The files of the run.
        written: Prim paths.
        paths: Prim path of each garment by its object's number: undo makes new objects of the same numbers, and the
            artist may rename them meanwhile.
        command: The command.
    """

    settings: Settings
    files: Files
    written: Exported
    paths: dict[int, str]
    command: str


def prepare(context: bpy.types.Context) -> Prepared:
    """Export the selected garments and the colliders over the range of frames.

    Raises:
        OSError: The files cannot be written.
        RuntimeError: Blender cannot export.
        ValueError: A setting cannot be used.
    """
    panel = context.scene.physgraph
    settings, bodies = panel.as_given(context.scene), _bodies(panel.colliders)
    garments = [item for item in selected_garments(context) if item not in bodies]
    if not garments:
        raise ValueError("every selected mesh is in the collection of colliders; select a garment")
    if settings.frames[0] > settings.frames[1]:
        raise ValueError("frames {} to {}: the range ends before it starts".format(*settings.frames))
    blend = Path(bpy.data.filepath)
    folder = (blend.parent if bpy.data.is_saved else Path(bpy.app.tempdir)) / FOLDER
    folder.mkdir(exist_ok=True)
    files = files_of_run(folder, blend.stem or "untitled", [item.name for item in garments])
    written = export(context, files.coarse, garments, colliders=bodies, frames=settings.frames)
    paths = {item.session_uid: written.garments[item.name] for item in garments}
    return Prepared(settings, files, written, paths, command_of(context))


def command_of(context: bpy.types.Context) -> str:
    """The command of the preferences."""
    command = context.preferences.addons[__package__].preferences.command
    return bpy.path.abspath(command) if command.startswith("//") else command


def objects_of(paths: dict[int, str]) -> dict[bpy.types.Object, str]:
    """Coarse objects that still exist, and their prim paths.

    Args:
        paths: Prim paths by the objects' numbers.
    """
    return {item: paths[item.session_uid] for item in bpy.data.objects if item.session_uid in paths}


class Refinement:
    """One press of the button, from the export to the import."""

    def __init__(self, context: bpy.types.Context) -> None:
        """Export the selected garments and start the command.

        Raises:
            CommandError: The command cannot be started.
            OSError: The files cannot be written.
            RuntimeError: Blender cannot export.
            ValueError: A setting cannot be used.
        """
        settings, self.files, written, self._paths, command = prepare(context)
        if settings.report:
            self.files.report.mkdir()  # Where it is not there, the command takes ".report" for a kind of file.
        self._reported = settings.report
        self.unsaid = [] if settings.preset else unsaid_warnings(settings, written.lacking)
        garments, colliders = list(written.garments.values()), list(written.colliders.values())
        lines = command_lines(command, settings, self.files, garments=garments, colliders=colliders)
        self.run = Run(lines, self.files.log)

    def finish(self, context: bpy.types.Context) -> tuple[str, str]:
        """Import what the command wrote; returns what was done, and warnings.

        Raises:
            RuntimeError: Blender cannot import.
            ValueError: The coarse objects are gone.
        """
        panel = context.scene.physgraph
        found = objects_of(self._paths)
        if not found:
            raise ValueError(f"the coarse objects are gone; the cloth is in {self.files.root}")
        made = bring_back(context, self.files.root, found, hide=panel.hide_coarse)
        for item in context.selected_objects:
            item.select_set(False)
        for item in made:
            item.select_set(True)
        context.view_layer.objects.active = made[0]
        panel.last_report = str(self.files.report / "report.html") if self._reported else ""
        warnings = [*self.unsaid, *self.run.warnings()]
        if not bpy.data.is_saved:
            warnings.append(f"the .blend file is not saved; the cloth is in {self.files.layer} until Blender ends")
        return f"refined {', '.join(item.name for item in made)}", "\n".join(warnings)


class PHYSGRAPH_OT_refine(bpy.types.Operator):
    """Make fine cloth of the selected garments, over the range of frames"""

    bl_idname = "physgraph.refine"
    bl_label = "Refine"
    bl_options = {"UNDO"}  # noqa: RUF012  Blender's way to say it

    _current: Refinement | None = None
    """The run that is going on in the window."""
    _timer: bpy.types.Timer | None = None

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there is something to refine; says what is missing."""
        reasons = {
            "A garment is being refined; Esc cancels": PHYSGRAPH_OT_refine._current is not None,
            "Leave this mode for object mode": context.mode != "OBJECT",
            "Select the garments to refine: mesh objects": not selected_garments(context),
        }
        reason = next((text for text, holds in reasons.items() if holds), None)
        if reason:
            cls.poll_message_set(reason)
        return reason is None

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Refine and wait for it."""
        try:
            refinement = Refinement(context)
            refinement.run.wait()
            return self._finish(context, refinement)
        except FAILURES as error:
            return self._fail(error)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Refine while Blender stays usable."""
        if bpy.app.background:
            return self.execute(context)
        answer = self.start(context)
        if answer == {"RUNNING_MODAL"}:
            context.window_manager.modal_handler_add(self)
        return answer

    def start(self, context: bpy.types.Context) -> set[str]:
        """Start the command, and a timer that looks after it."""
        try:
            PHYSGRAPH_OT_refine._current = Refinement(context)
        except FAILURES as error:
            return self._fail(error)
        for said in PHYSGRAPH_OT_refine._current.unsaid:
            self.report({"WARNING"}, said)
        self._timer = context.window_manager.event_timer_add(POLL_SECONDS, window=context.window)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Look after the command at each tick of the timer; Esc ends it."""
        refinement = PHYSGRAPH_OT_refine._current
        if event.type == "ESC" and event.value == "PRESS":
            self.cancel(context)
            self.report({"INFO"}, "Refining was cancelled")
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        try:
            done = refinement.run.poll()
            self._show(context, refinement)
            if not done or context.mode != "OBJECT":  # an import would throw the artist out of another mode
                return {"PASS_THROUGH"}
            self._let_go(context)
            return self._finish(context, refinement)
        except FAILURES as error:
            self._let_go(context)
            return self._fail(error)

    def cancel(self, context: bpy.types.Context) -> None:
        """End the command; Blender calls this too, when it quits or opens another file."""
        refinement = PHYSGRAPH_OT_refine._current
        if refinement:
            refinement.run.cancel()
        self._let_go(context)

    def _finish(self, context: bpy.types.Context, refinement: Refinement) -> set[str]:
        done, warnings = refinement.finish(context)
        if warnings:
            self.report({"WARNING"}, warnings)
        self.report({"INFO"}, done)
        return {"FINISHED"}

    def _fail(self, error: Exception) -> set[str]:
        self.report({"ERROR"}, str(error))
        return {"CANCELLED"}

    def _let_go(self, context: bpy.types.Context) -> None:
        """Give back the timer and the status bar."""
        PHYSGRAPH_OT_refine._current = None
        if self._timer:
            context.window_manager.event_timer_remove(self._timer)
            self._timer = None
        if context.workspace:
            context.workspace.status_text_set(None)

    def _show(self, context: bpy.types.Context, refinement: Refinement) -> None:
        part, text = refinement.run.progress()
        context.workspace.status_text_set(f"PhysGraph: {part:.0%}, {text}. Esc cancels")
        for area in context.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


def now_running() -> Run | None:
    """The command that is running for the window, or None."""
    current = PHYSGRAPH_OT_refine._current
    return current.run if current else None


def stop() -> None:
    """End the command that is running for the window, if any."""
    run = now_running()
    if run:
        run.cancel()
    PHYSGRAPH_OT_refine._current = None


def _bodies(collection: bpy.types.Collection | None) -> list[bpy.types.Object]:
    """The meshes of a collection.

    Raises:
        ValueError: It has none.
    """
    if collection is None:
        return []
    found = [item for item in collection.all_objects if item.type == "MESH"]
    if not found:
        raise ValueError(f"the collection of colliders '{collection.name}' has no mesh")
    return found


CLASSES = (PHYSGRAPH_OT_refine,)
