"""How cloth is looked at: columns, a wipe, wires, maps, and A beside the present values."""

from __future__ import annotations

from dataclasses import asdict, fields, replace
from typing import Any

from .camera import Camera
from .desk import Desk, put, small
from .maps import NAMES, Map
from .session import TuneSession
from .view import KEPT, SHOWS, View

COMPARED = "A | B keeps the present cloth as A if there is no A yet; B is what is tuned."

COLOURED = "Colours of the refined cloth. Click on the cloth for the value there."


class ViewPanel:
    """The controls of the picture."""

    def __init__(self, desk: Desk, camera: Camera) -> None:
        """Add the controls, and look as last time."""
        self._desk, self._camera, gui = desk, camera, desk.gui
        names = {each.name for each in fields(View)}
        last = {name: value for name, value in desk.notes.looked.get("view", {}).items() if name in names}
        view = View(**last)
        known = view.show in SHOWS and KEPT not in view.columns and view.map in NAMES
        desk.picture.view = view if known else View()
        view = desk.picture.view
        self._controls: dict[str, Any] = {
            "show": gui.add_dropdown("Show", tuple(SHOWS), initial_value=view.show, hint=COMPARED),
            "wiped": gui.add_checkbox("Wipe", view.wiped, hint="First and last at one place, split by the slider."),
            "wipe": gui.add_slider("Wipe at", 0.0, 1.0, 0.01, view.wipe),
            "wires": gui.add_checkbox("Wireframe", view.wires, hint="Key: G."),
            "map": gui.add_dropdown(
                "Map", NAMES, initial_value=view.map, hint="Colours of refined cloth. Click it for values."
            ),
        }
        for name, control in self._controls.items():
            desk.on(control, lambda session, value, name=name: self._choose(session, name, value))
        self._bar, self._read = gui.add_html(""), gui.add_html("")
        desk.press(gui.add_button("Keep as A", hint="Keeps values and cloth to compare with. Key: K."), self._keep)
        desk.press(gui.add_button("Exchange A and B", hint="B is what is tuned. Key: X."), TuneSession.swap)
        desk.key("Wireframe", "G", lambda session: self.set(wires=not desk.picture.view.wires))
        desk.key("Keep as A", "K", self._keep)
        desk.key("Exchange A and B", "X", TuneSession.swap)

    def set(self, **changes: Any) -> None:
        """Change how cloth is looked at, by the names of `View`; other columns are framed."""
        picture, before = self._desk.picture, self._desk.picture.view
        picture.view = replace(before, **changes)
        if (before.columns, before.wiped) != (picture.view.columns, picture.view.wiped):
            self._camera.frame()
        for name, value in changes.items():
            put(self._controls[name], value=value)
        put(self._read, content="")

    def say(self, words: str) -> None:
        """Write the value of the map at a place, until the view changes."""
        put(self._read, content=small(words, "value"))

    def update(self) -> None:
        """Write the colour bar of the map that is drawn."""
        drawn = self._desk.picture.bar
        put(self._bar, content="" if drawn is None else bar_of(drawn))

    @property
    def looked(self) -> dict[str, Any]:
        """How cloth is looked at, as plain values."""
        return asdict(self._desk.picture.view)

    def _choose(self, session: TuneSession, name: str, value: Any) -> None:
        if name == "show" and KEPT in SHOWS[value] and session.kept is None:
            session.keep()
        self.set(**{name: value})

    def _keep(self, session: TuneSession) -> None:
        session.keep()
        shows = next(name for name, columns in SHOWS.items() if KEPT in columns)
        self.set(show=shows)


def bar_of(drawn: Map) -> str:
    """The colours of a map with the values at their ends, as HTML."""
    span = [100.0 * (at - drawn.ends[0]) / (drawn.ends[1] - drawn.ends[0]) for at in drawn.stops]
    colors = ",".join(f"rgb({r}, {g}, {b}) {at:.0f}%" for (r, g, b, _), at in zip(drawn.colors(), span, strict=True))
    strip = f"<div id='bar' style='height:9px;margin:0 1em;background:linear-gradient(to right,{colors})'></div>"
    ends = "".join(f"<span>{at:g} {drawn.unit}</span>" for at in drawn.stops)
    return (
        strip + f"<div style='display:flex;justify-content:space-between;margin:0 1.4em;font-size:0.75em'>{ends}</div>"
    )
