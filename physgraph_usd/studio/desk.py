"""Shared state of a page's panels: session, picture and notes."""

from __future__ import annotations

import html
from collections.abc import Callable, Coroutine
from typing import Any

from .loop import Change, SolveLoop
from .notes import Notes
from .picture import Picture
from .session import TuneSession


class Desk:
    """Shared state of a page's panels.

    Attributes:
        gui: The page's controls, viser's.
        session: The session, owned by the loop's thread.
        loop: The loop; changes of the session go through `SolveLoop.ask`.
        picture: The picture.
        notes: Presets and views kept over a restart.
        garment: Prim path of the garment in the panels.
    """

    def __init__(self, gui: Any, session: TuneSession, *, loop: SolveLoop, picture: Picture, notes: Notes) -> None:
        """Begin with the first garment."""
        self.gui, self.session, self.loop, self.picture, self.notes = gui, session, loop, picture, notes
        self.garment = session.garments[0]

    @property
    def index(self) -> int:
        """Number of the garment in the panels."""
        return self.session.garments.index(self.garment)

    def ask(self, change: Change) -> None:
        """Have the session changed by the loop's thread."""
        self.loop.ask(change)

    def on(self, control: Any, change: Callable[[TuneSession, Any], None]) -> Any:
        """Have the session changed when an artist, not the page, changes a control; returns the control.

        Args:
            control: A control of viser's with a value.
            change: Called with the session and the control's value.
        """

        @in_order
        def moved(event: Any) -> None:
            if event.client is not None:
                value = control.value
                self.ask(lambda session: change(session, value))

        control.on_update(moved)
        return control

    def press(self, button: Any, change: Change) -> Any:
        """Have the session changed when a button is pressed; returns the button."""
        button.on_click(in_order(lambda _: self.ask(change)))
        return button

    def key(self, label: str, key: str, change: Change, **options: Any) -> None:
        """Have the session changed by a key; ``options`` are those of viser's commands."""
        self.gui.add_command(label, hotkey=key, **options).on_trigger(in_order(lambda _: self.ask(change)))


def in_order(call: Callable[[Any], None]) -> Callable[[Any], Coroutine[Any, Any, None]]:
    """A callback that viser calls in the order of the browser's events.

    Plain functions run in a pool of threads, which promises no order: a drag could end before its last place.

    Args:
        call: The callback; returns at once.
    """

    async def called(event: Any) -> None:
        call(event)

    return called


def put(control: Any, **properties: Any) -> None:
    """Set a control's properties if different: each assignment is sent to the browser."""
    for name, value in properties.items():
        if getattr(control, name) != value:
            setattr(control, name, value)


def small(text: str, name: str = "") -> str:
    """A line of small text as HTML; ``name`` is its id."""
    style = "margin:0.1em 1em;font-size:0.75em;color:#5b6470;overflow-wrap:anywhere"
    return f"<div id='{name}' style='{style}'>{html.escape(text)}</div>"
