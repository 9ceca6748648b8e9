"""The page: coarse and fine cloth at a frame, sliders, the report's figures, and a button that saves."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from time import sleep
from typing import Any

import numpy as np

from ..errors import PhysGraphError
from ..interrupts import leave_if_asked
from ..solver.fabric import PRESETS
from ..usd.schema import CONTACT, FABRIC, GARMENT, REFINEMENT
from .guard import guarded_server
from .loop import SolveLoop
from .picture import PLAIN, SHOWS, Picture
from .session import Shown, TuneSession
from .values import PAINTED, TUNABLES, Tunable

AS_AUTHORED, OWN = "as authored", "own values"
WORKING, MOVING, SETTLED, WRONG = "#b45f06", "#5b6470", "#1a7f37", "#c0392b"
"""Colours of the page's state."""
FINEST = 0.002
"""Step of a slider, in its length."""
POLL_SECONDS = 0.1
"""How often the main thread asks whether a signal came."""
STYLE = """<style>
div:has(> .value) + div .mantine-NumberInput-root, div:has(> .value) + div .mantine-Slider-markLabel,
div:has(> .value) + div > .mantine-Flex-root > div:first-child {display: none}
</style>"""
"""Under a value written out a slider fills its row: its own number is a place on a logarithmic scale."""


class TunePage:
    """A session in the browser, served to this machine alone.

    Attributes:
        url: Where the page is, with the secret that opens it.
        loop: The thread that solves.
    """

    def __init__(self, session: TuneSession, *, port: int = 8080) -> None:
        """Serve the page and solve the first frame, at this port or the next free one."""
        self._session, self._garment = session, session.garments[0]
        self._server, self.url = guarded_server(port=port, label="physgraph-usd tune")
        self._picture = Picture(self._server, session)
        self._sliders: dict[str, tuple[Any, Any]] = {}
        self._follow = False  # Whether sliders go to new values; not under the artist's hand.
        self._build()
        self.loop = SolveLoop(session, self)

    def close(self) -> None:
        """End the thread and the server."""
        self.loop.close()
        self._server.stop()

    def busy(self, what: str) -> None:
        """Say that work has begun."""
        self._state.content = _badge(f"{what} …", WORKING)

    def seen(self, points: Mapping[str, np.ndarray]) -> None:
        """Draw garments that are not settled."""
        self._picture.move(points)

    def show(self, shown: Shown) -> None:
        """Draw a solved frame and write its figures and values."""
        self._picture.draw(shown)
        state = "settled: as refine solves it" if shown.settled else "on its way"
        self._state.content = _badge(state, SETTLED if shown.settled else MOVING)
        self._command.content = _small(f"<code>{html.escape(self._session.command)}</code>")
        index = self._session.garments.index(self._garment)
        self._figures.content = _table(figures(shown, index))
        follow, self._follow = self._follow, False
        for name, (text, slider) in self._sliders.items():
            self._write_value(TUNABLES[name], text, slider if follow else None)

    def fail(self, error: PhysGraphError) -> None:
        """Write an error."""
        self._state.content = _badge(str(error), WRONG)

    def _build(self) -> None:
        gui = self._server.gui
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.set_panel_label(f"Tune {Path(self._session.shot.path).name}")
        gui.add_html(STYLE)
        self._state = gui.add_html(_badge("opening …", WORKING))
        self._build_view()
        for group in dict.fromkeys(tunable.group for tunable in TUNABLES.values()):
            with gui.add_folder(group):
                self._build_group(group)
        with gui.add_folder("Figures"):
            self._figures = gui.add_html("")
        save = gui.add_button("Save layer", hint="Writes the values as a layer, as physgraph-usd tag does.")
        save.on_click(lambda _: self.loop.ask(self._save))
        self._saved = gui.add_html(_small(f"into {html.escape(str(self._session.out))}"))
        self._command = gui.add_html("")

    def _build_view(self) -> None:
        """Controls of garment, frame and picture."""
        gui, session = self._server.gui, self._session
        if len(session.garments) > 1:
            choice = gui.add_dropdown("Garment", session.garments, initial_value=self._garment)
            choice.on_update(lambda event: self._ask(event, lambda _: self._choose(choice.value)))
        times = [time for time in session.times if time is not None]
        if len(times) > 1:
            step = min(b - a for a, b in pairwise(times))
            at = session.time or times[0]
            frame = gui.add_slider("Frame", times[0], times[-1], step, at, hint="Time code of a sample.")
            frame.on_update(lambda event: self._ask(event, lambda _: self._go(nearest(times, frame.value))))
        shows = gui.add_dropdown("Show", SHOWS, initial_value=SHOWS[0])
        shows.on_update(lambda event: self._ask(event, lambda _: setattr(self._picture, "shows", shows.value)))
        colors = gui.add_dropdown("Painted map", (PLAIN, *PAINTED), initial_value=PLAIN)
        colors.on_update(lambda event: self._ask(event, lambda _: setattr(self._picture, "map", colors.value)))

    def _build_group(self, group: str) -> None:
        """A slider for each value of a display group, after the group's other controls."""
        gui = self._server.gui
        if group == FABRIC:
            self._preset = gui.add_dropdown("Preset", (AS_AUTHORED, OWN, *sorted(PRESETS)), initial_value=AS_AUTHORED)
            self._preset.on_update(lambda event: self._ask(event, self._set_preset))
        elif group == REFINEMENT:
            self._build_level()
        elif group == CONTACT:
            contact = gui.add_checkbox("Contact", True, hint="With bodies and of cloth with cloth.")
            contact.on_update(lambda event: self._ask(event, lambda session: session.set_contact(contact.value)))
        for tunable in (each for each in TUNABLES.values() if each.group == group):
            text = gui.add_html("")
            hint = f"{GARMENT[tunable.name].name}: {GARMENT[tunable.name].doc}"
            slider = gui.add_slider(" ", 0.0, 1.0, FINEST, 0.5, hint=hint)
            slider.on_update(partial(self._moved, tunable, slider))
            self._sliders[tunable.name] = text, slider
            self._write_value(tunable, text, slider)

    def _build_level(self) -> None:
        row, level_now = GARMENT["refine:level"], self._session.levels[0]
        hint = f"{row.name}: {row.doc}"
        most = max(row.soft or (0, level_now))
        level = self._server.gui.add_slider(row.label, 0, int(most), 1, min(level_now, int(most)), hint=hint)
        level.on_update(lambda event: self._ask(event, lambda each: each.set_level(self._garment, int(level.value))))

    def _choose(self, garment: str) -> None:
        self._garment, self._follow = garment, True

    def _go(self, time: float) -> None:
        self._session.set_time(time)
        self._follow = True

    def _moved(self, tunable: Tunable, slider: Any, event: Any) -> None:
        """A slider was moved, by the artist or by the page."""
        if event.client is None:
            return
        value = tunable.at(slider.value)
        if self._preset.value != OWN:
            self._preset.value = OWN
        self.loop.ask(lambda session: session.set_value(self._garment, tunable.name, value))

    def _set_preset(self, session: TuneSession) -> None:
        self._follow = True
        if self._preset.value == AS_AUTHORED:
            session.set_as_authored(self._garment)
        elif self._preset.value != OWN:
            session.set_preset(self._garment, self._preset.value)

    def _write_value(self, tunable: Tunable, text: Any, slider: Any) -> None:
        """Write a value, and put its slider there unless that is None."""
        value = self._session.value(self._garment, tunable.name)
        text.content = _row(tunable.label, tunable.text(value))
        if slider is not None:
            slider.value = tunable.place(value if value is not None else tunable.ends[0])

    def _save(self, session: TuneSession) -> None:
        written = session.save()
        self._saved.content = _small(f"saved into {html.escape(str(written))}")

    def _ask(self, event: Any, change: Any) -> None:
        """Have the session changed, where the artist asked for it."""
        if event.client is not None:
            self.loop.ask(change)


def serve(session: TuneSession, *, port: int = 8080, say: Callable[[str], None]) -> None:
    """Serve a session's page until it is interrupted; ``say`` is called with its address."""
    page = TunePage(session, port=port)
    say(page.url)
    try:
        while True:
            leave_if_asked()
            sleep(POLL_SECONDS)
    finally:
        page.close()


def nearest(times: Sequence[float], time: float) -> float:
    """The sample that is nearest to a time code."""
    return min(times, key=lambda each: abs(each - time))


def figures(shown: Shown, index: int) -> dict[str, str]:
    """Figures of a solved garment in words, by name, as in a report."""
    points, entry = shown.points[index], shown.telemetry[index]
    lines = {"Vertices": f"{0 if points is None else len(points):,}"}
    if "energy_joules" in entry:
        lines["Energy"] = f"{1e3 * sum(entry['energy_joules']['output'].values()):.4g} mJ"
    if "strain" in entry:
        lines["Strain, 99th percentile"] = f"{100.0 * entry['strain']['p99']:.2g} %"
    contact = entry.get("contact", {})
    if "cloth" in contact:
        lines["Crossings of cloth"] = str(contact["cloth"]["after"]["crossings"])
    if "bodies" in contact:
        lines["Vertices inside bodies"] = str(sum(body["after"]["inside"] for body in contact["bodies"].values()))
    if "levels" in entry:
        lines["Evaluations"] = str(sum(level["evaluations"] for level in entry["levels"]))
    return lines | {"Seconds": f"{shown.seconds:.2f}", "Start": str(entry.get("start", ""))}


def _badge(text: str, color: str) -> str:
    style = (
        f"margin:0.4em 0.8em;padding:0.35em 0.7em;border-radius:0.4em;color:white;background:{color};font-size:0.85em"
    )
    return f"<div id='state' style='{style}'>{html.escape(text)}</div>"


def _row(label: str, value: str) -> str:
    style = "display:flex;justify-content:space-between;margin:0 0.8em -0.35em 0.8em;font-size:0.85em"
    return f"<div class='value' style='{style}'><span>{html.escape(label)}</span><b>{html.escape(value)}</b></div>"


def _small(content: str) -> str:
    return f"<div style='margin:0.1em 1em;font-size:0.75em;color:#5b6470;overflow-wrap:anywhere'>{content}</div>"


def _table(lines: dict[str, str]) -> str:
    cell = "padding:0.1em 0.2em"
    rows = (
        f"<tr><td style='{cell}'>{html.escape(name)}</td>"
        f"<td style='{cell};text-align:right'><b>{html.escape(value)}</b></td></tr>"
        for name, value in lines.items()
    )
    return f"<table style='width:calc(100% - 1.6em);margin:0 0.8em;font-size:0.8em'>{''.join(rows)}</table>"
