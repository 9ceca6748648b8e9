"""Shared state of a page's panels: session, picture and notes."""

from __future__ import annotations

import html
from collections.abc import Callable
from typing import Any

from .loop import Change
from .notes import Notes
from .picture import Picture
from .session import TuneSession


class Desk:
    """Shared state of a page's panels.

    Attributes:
        gui: The page's controls, viser's.
        session: The session; it is changed through `ask` alone.
        picture: Its picture.
        notes: What is kept over a restart.
        garment: Prim path of the garment in the panels.
        ask: Has the session changed by the thread that owns it.
    """

    def __init__(self, gui: Any, session: TuneSession, picture: Picture, notes: Notes) -> None:
        """Begin with the first garment; ``ask`` is to be set before the page is used."""
        self.gui, self.session, self.picture, self.notes = gui, session, picture, notes
        self.garment = session.garments[0]
        self.ask: Callable[[Change], None] = lambda _: None

    @property
    def index(self) -> int:
        """Number of the garment in the panels."""
        return self.session.garments.index(self.garment)

    def on(self, control: Any, change: Callable[[TuneSession, Any], None]) -> Any:
        """Have the session changed when an artist, not the page, changes a control; returns the control.

        Args:
            control: A control of viser's with a value.
            change: Called with the session and the control's value.
        """

        def moved(event: Any) -> None:
            if event.client is not None:
                value = control.value
                self.ask(lambda session: change(session, value))

        control.on_update(moved)
        return control

    def press(self, button: Any, change: Change) -> Any:
        """Have the session changed when a button is pressed; returns the button."""
        button.on_click(lambda _: self.ask(change))
        return button


def put(control: Any, **properties: Any) -> None:
    """Set a control's properties if different: each assignment is sent to the browser."""
    for name, value in properties.items():
        if getattr(control, name) != value:
            setattr(control, name, value)


def small(text: str, name: str = "") -> str:
    """A line of small text as HTML; ``name`` is its id."""
    style = "margin:0.1em 1em;font-size:0.75em;color:#5b6470;overflow-wrap:anywhere"
    return f"<div id='{name}' style='{style}'>{html.escape(text)}</div>"
