"""Controls of time: frame, range and playback."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from ..usd.times import snap
from .desk import Desk, put
from .session import TuneSession
from .takes import FRESH, MISSING, STALE

COLORS = {FRESH: "#1a7f37", STALE: "#d9a441", MISSING: "#d5d9de"}
PLAY, PAUSE = "Play", "Pause"


class TimePanel:
    """Controls of time, for a shot of several frames."""

    def __init__(self, desk: Desk) -> None:
        """Add the controls."""
        self._desk, gui = desk, desk.gui
        self._times = desk.session.codes
        if len(self._times) < 2:
            return
        first, last = self._times[0], self._times[-1]
        step = min(b - a for a, b in pairwise(self._times))
        self._frame = gui.add_slider(
            "Frame", first, last, step, desk.session.time or first, hint="A sample's time code."
        )
        desk.on(self._frame, lambda session, value: session.set_time(*snap([value], self._times)))
        self._bar = gui.add_html("")
        self._range = gui.add_multi_slider("Range", first, last, step, (first, last), hint="What is solved and played.")
        desk.on(self._range, lambda session, value: self._set_span())
        solving = "The range is solved in the background, in order, as refine solves it."
        self._solving = desk.on(
            gui.add_checkbox("Solve range", False, hint=solving), lambda session, value: self._set_span()
        )
        self._play = gui.add_button(PLAY, hint="Each frame of the range once it is solved. Key: space.")
        desk.press(self._play, self.play)
        desk.key("Frame before", "J", lambda session: self._step(session, -1))
        desk.key("Next frame", "L", lambda session: self._step(session, 1))
        desk.key("Play or pause", "space", self.play)
        self.update()

    def update(self) -> None:
        """Write the frame, and which frames of the range are solved with the present values."""
        if len(self._times) < 2:
            return
        session, playing = self._desk.session, self._desk.loop.playing
        put(self._frame, value=session.time)
        put(self._play, label=PAUSE if playing else PLAY)
        states = session.takes.states(self._times, session.setting)
        put(self._bar, content=bar_of(self._times, states, at=session.time))

    def play(self, session: TuneSession) -> None:
        """Play the range, or pause."""
        self._desk.loop.playing = not self._desk.loop.playing
        self._set_span()

    def _step(self, session: TuneSession, way: int) -> None:
        self._desk.loop.playing = False
        at = self._times.index(self._times[0] if session.time is None else session.time) + way
        session.set_time(self._times[at % len(self._times)])

    def _set_span(self) -> None:
        loop, (first, last) = self._desk.loop, self._range.value
        loop.span = (first, last) if self._solving.value or loop.playing else None


def bar_of(times: Sequence[float], states: Sequence[str], *, at: float | None) -> str:
    """A strip of the shot's frames as HTML: green is solved, amber solved with other values, grey not solved."""
    parts = "".join(
        f"<i style='flex:1;background:{COLORS[state]};{'border-top:3px solid #1f2933' if time == at else ''}'></i>"
        for time, state in zip(times, states, strict=True)
    )
    fresh, stale = states.count(FRESH), states.count(STALE)
    words = f"{fresh} of {len(times)} frames solved" + (f", {stale} with other values" if stale else "")
    strip = f"<div style='display:flex;height:9px;margin:0 1em;gap:1px'>{parts}</div>"
    text = f"<div id='takes' style='margin:0.1em 1.4em;font-size:0.75em;color:#5b6470'>{words}</div>"
    return strip + text
