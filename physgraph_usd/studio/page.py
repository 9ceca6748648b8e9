"""The page: cloth on the left; state, history, time, picture, values, painting and figures on the right."""

from __future__ import annotations

import html
import io
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout, suppress
from pathlib import Path
from time import perf_counter, sleep
from typing import Any

import numpy as np

from ..errors import LayerError, PhysGraphError
from ..interrupts import leave_if_asked
from ..solver.scene import GarmentResult
from .camera import Camera
from .desk import Desk, in_order, put, small
from .guard import guarded_server
from .loop import SOLVING, SolveLoop, Watcher
from .notes import Notes
from .paint_panel import PaintPanel
from .picture import Picture
from .session import TuneSession
from .setting import Setting
from .takes import Shown
from .time_panel import TimePanel
from .value_panel import ValuePanel
from .view_panel import ViewPanel

WORKING, MOVING, SETTLED, WRONG = "#b45f06", "#5b6470", "#1a7f37", "#c0392b"
"""Colours of the page's state."""
FIRST = "the first cloth is being solved, as refine does; this is the cage …"
WAITS = "first cloth", "settled"
CROSSINGS = "Crossings of cloth, before and after"
BESIDE = ("Vertices", "Strain, 99th percentile", CROSSINGS)
"""Figures that are seen beside every tab."""
PANEL_PIXELS = 400
UNDO, REDO = "Undo", "Redo"
POLL_SECONDS = 0.1
"""How often the main thread asks whether a signal came."""


class TunePage(Watcher):
    """A session in the browser, for this machine only.

    Attributes:
        url: Address with the secret.
        loop: The solving thread.
    """

    def __init__(self, session: TuneSession, *, port: int = 8080) -> None:
        """Serve the page and solve the first frame, at this port or the next free one.

        Raises:
            UsageError: The file of the session's notes is another program's.
        """
        notes = Notes(session.out)
        self._session = session
        self._server, self.url = guarded_server(port=port, label="physgraph-usd tune")
        self.loop, picture = SolveLoop(session, self), Picture(self._server, session)
        self._desk = Desk(self._server.gui, session, loop=self.loop, picture=picture, notes=notes)
        if notes.looked.get("garment") in session.garments:
            self._desk.garment = notes.looked["garment"]
        if notes.looked.get("time") in session.times:
            session.set_time(notes.looked["time"])
        self._camera = Camera(self._server, picture, notes.looked.get("camera"))
        self._clock, self._waits, self._lines = perf_counter(), ["", ""], dict[str, str]()
        self._solved: tuple[Setting, float | None] | None = None
        self._build()
        frame = session.shot.frame(session.time)
        picture.draw(Shown(frame, (GarmentResult(None),) * len(session.garments), 0.0, False))
        self._say(FIRST, WORKING)
        self.loop.start()

    def close(self) -> None:
        """End the thread and the server, and write the notes."""
        self.loop.close()
        tried = {path: dict(values) for path, values in self._session.setting.values.items()}
        looked = {"time": self._session.time, "garment": self._desk.garment, "camera": self._camera.last}
        with suppress(LayerError):  # A folder that cannot be written to; saving the layer has said so.
            self._desk.notes.save(looked | {"view": self._view.looked, "values": tried})
        with redirect_stdout(io.StringIO()):  # The viewer's own words.
            self._server.stop()

    def busy(self, what: str) -> None:
        """Say that work has begun."""
        solved, self._solved = self._solved, (self._session.setting, self._session.time)
        if what == SOLVING and solved != self._solved:
            self._clock, self._waits = perf_counter(), ["", ""]
        self._say(f"{what} …" if self._lines else FIRST, WORKING)

    def seen(self, points: Mapping[str, np.ndarray]) -> None:
        """Draw garments that are not settled."""
        self._desk.picture.move(points)
        self._note_wait(0)

    def show(self, shown: Shown) -> None:
        """Draw a solved frame and write its figures and values."""
        session = self._session
        self._desk.picture.draw(shown, kept=session.kept_shown)
        self._paint.attach()
        self._lines = figures(shown, self._desk.index)
        rows = [f"| {name} | **{text}** |" for name, text in self._lines.items()]
        put(self._figures, content="\n".join(["| | |", "|:--|--:|", *rows]))
        self._values.update()
        self._paint.update(session)
        self._view.update()
        self._time.update()
        history = session.history
        put(self._history, options=(f"{UNDO} {history.undone_next}".strip(), f"{REDO} {history.redone_next}".strip()))
        put(self._command, content=f"<code>{small(session.command)}</code>")
        words = "playing" if self.loop.playing else "settled: as refine solves it" if shown.settled else "on its way"
        self._note_wait(0)
        if shown.settled:
            self._note_wait(1)
        self._say(words, SETTLED if shown.settled else MOVING)
        if shown.settled and not self.loop.playing:
            self._desk.picture.shade(self.loop.is_wanted)

    def solved(self) -> None:
        """Update the strip of frames, or draw A."""
        if self.loop.playing:
            self._time.update()
        else:
            self.show(self._session.solve())

    def fail(self, error: PhysGraphError) -> None:
        """Write an error."""
        self._say(str(error), WRONG)

    def _note_wait(self, which: int) -> None:
        """Note the time of the first cloth, 0, or of the settled cloth, 1, after a change."""
        self._waits[which] = self._waits[which] or f"{perf_counter() - self._clock:.1f} s"

    def _say(self, words: str, color: str) -> None:
        """Write the state and figures; in short in the panel's title, which stays when the sliders are scrolled."""
        waits = [f"{name} {wait}" for name, wait in zip(WAITS, self._waits, strict=True) if wait]
        lines = [f"{name.partition(',')[0].lower()} {text}" for name, text in self._lines.items() if name in BESIDE]
        put(self._state, content=_badge(words, color) + small("; ".join(waits + lines), "figures"))
        name = Path(self._session.shot.path).name
        self._server.gui.set_panel_label(f"{name}: {', '.join(waits) or words.partition(',')[0]}")

    def _build(self) -> None:
        gui, desk = self._server.gui, self._desk
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_PIXELS)
        self._state = gui.add_html("")
        self._build_history()
        if len(self._session.garments) > 1:
            choice = gui.add_dropdown("Garment", self._session.garments, initial_value=desk.garment)
            desk.on(choice, lambda session, garment: setattr(desk, "garment", garment))
        self._time = TimePanel(desk)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Values"):
            self._values = ValuePanel(desk)
        with tabs.add_tab("Picture"):
            self._view = ViewPanel(desk, self._camera)
        with tabs.add_tab("Paint"):
            self._paint = PaintPanel(desk, self._view, self._camera)
        with tabs.add_tab("Figures"):
            self._figures = gui.add_markdown("")
            self._command = gui.add_html("")

    def _build_history(self) -> None:
        gui, desk = self._server.gui, self._desk
        save = gui.add_button("Save layer", hint="Writes what is tried as a layer, as physgraph-usd tag does.")
        desk.press(save, self._save)
        self._saved = gui.add_html(small(f"into {self._session.out}", "saved"))
        self._history = gui.add_button_group("History", (UNDO, REDO), hint="Keys: Z, and shift with Z.")

        pick = {UNDO: TuneSession.undo, REDO: TuneSession.redo}
        self._history.on_click(in_order(lambda event: desk.ask(pick[event.target.value.split()[0]])))
        desk.key("Undo", "Z", TuneSession.undo)
        desk.key("Redo", "Z", TuneSession.redo, modifier="shift")

    def _save(self, session: TuneSession) -> None:
        written = session.save()
        tried = session.setting.values
        names = sorted({name for values in tried.values() for name in values})
        maps = sorted({name for maps in session.setting.painted.values() for name in maps})
        self._saved.content = small(f"saved {', '.join(names + maps) or 'no value'} into {written}", "saved")


def serve(session: TuneSession, *, port: int = 8080, say: Callable[[str], None]) -> None:
    """Serve a session's page until interrupted; ``say`` is called with the address."""
    page = TunePage(session, port=port)
    say(page.url)
    try:
        while True:
            leave_if_asked()
            sleep(POLL_SECONDS)
    finally:
        page.close()


def figures(shown: Shown, index: int) -> dict[str, str]:
    """Figures of a solved garment in words, by name, as in a report."""
    points, entry = shown.garments[index].points, shown.garments[index].telemetry
    lines = {"Vertices": f"{0 if points is None else len(points):,}"}
    if "energy_joules" in entry:
        lines["Energy"] = f"{1e3 * sum(entry['energy_joules']['output'].values()):.4g} mJ"
    if "strain" in entry:
        lines["Strain, 99th percentile"] = f"{100.0 * entry['strain']['p99']:.2g} %"
    contact = entry.get("contact", {})
    if "cloth" in contact:
        lines[CROSSINGS] = _both(contact["cloth"], "crossings")
    if "bodies" in contact:
        for path, body in contact["bodies"].items():
            lines[f"Inside {path.rpartition('/')[2]}, before and after"] = _both(body, "inside")
    if "levels" in entry:
        lines["Evaluations"] = str(sum(level["evaluations"] for level in entry["levels"]))
    return lines | {"Seconds": f"{shown.seconds:.2f}", "Start": str(entry.get("start", ""))}


def _both(entry: Mapping[str, Any], name: str) -> str:
    return f"{entry['before'][name]} → {entry['after'][name]}"


def _badge(text: str, color: str) -> str:
    style = (
        f"margin:0.4em 0.8em;padding:0.35em 0.7em;border-radius:0.4em;color:white;background:{color};font-size:0.85em"
    )
    return f"<div id='state' style='{style}'>{html.escape(text)}</div>"
