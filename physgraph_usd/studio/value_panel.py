"""Controls of a garment's values: number boxes, sliders, presets and reset."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..shot.findings.table import Facts, texts
from ..solver.fabric import PRESETS
from ..usd.schema import CONTACT, FABRIC, GARMENT, REFINEMENT
from .desk import Desk, in_order, put, small
from .session import TuneSession
from .values import TUNABLES, Tunable

AS_AUTHORED, OWN_VALUES, LAST, OWN = "as authored", "own values", "last session", "own: "
FINEST = 0.002
"""Step of a slider, in its length."""
CHANGED = "•"
"""Beside a value that is tried, and may differ from the shot's."""
RESET, EVERYTHING = "reset ...", "everything"
STYLE = """<style>
div:has(> .value) + div .mantine-NumberInput-root, div:has(> .value) + div .mantine-Slider-markLabel,
div:has(> .value) + div > .mantine-Flex-root > div:first-child {display: none}
div:has(> .value) {margin: -0.6em 0 -0.2em 0}
div:has(> .mantine-Text-root > label) {width: 11.5em !important; white-space: nowrap}
.mantine-Text-root > label > wbr {display: none}
</style>"""
"""Hides the sliders' own numbers, which are places on a logarithmic scale; names stand on one line."""
SWATCHES = Path(__file__).parent / "swatches"
"""A WebP of each preset, drawn by `benchmarks.swatches`."""
SWATCH_STYLE = """
div:has(> .swatches) + div div:has(> p) {display: none}
div:has(> .swatches) + div button {flex: 0 0 calc(100% / 6 - 6px) !important; min-width: 0 !important; height: 5em;
padding: 0; overflow: visible; border: 0; background-size: 100% auto; background-repeat: no-repeat}
div:has(> .swatches) + div button:hover {outline: 2px solid #228be6}
div:has(> .swatches) + div .mantine-Button-label
{align-items: flex-end; height: 100%; overflow: visible; font-size: 0.8em; letter-spacing: -0.04em; color: #1f2933}
"""
"""Draws buttons as pictures with a name below, six in a row."""


class ValuePanel:
    """The controls of a garment's values."""

    def __init__(self, desk: Desk) -> None:
        """Add the controls."""
        self._desk, gui = desk, desk.gui
        self._rows: dict[str, tuple[Any, Any]] = {}
        self._moved = ""  # The value under the artist's hand, whose controls are left alone.
        gui.add_html(STYLE)
        self._preset = gui.add_dropdown("Preset", self._presets(), initial_value=AS_AUTHORED)
        desk.on(self._preset, self._choose)
        gui.add_html(f"<div class='swatches'><style>{SWATCH_STYLE}{pictures(sorted(PRESETS))}</style></div>")
        swatches = gui.add_button_group("Swatches", sorted(PRESETS))
        swatches.on_click(
            in_order(lambda event: desk.ask(lambda session, name=event.target.value: self._pick(session, name)))
        )
        self._subsets = gui.add_html(self._of_subsets())
        self._reset = desk.on(gui.add_dropdown("Reset", (RESET,), hint="Takes the shot's value again."), self._put_back)
        for group in dict.fromkeys(tunable.group for tunable in TUNABLES.values()):
            with gui.add_folder(group):
                self._build_group(group)
        with gui.add_folder("Own presets"):
            self._name = gui.add_text("Name", "", hint="For the fabric's values; kept beside the layer.")
            desk.press(gui.add_button("Keep as preset"), self._keep_preset)

    def update(self) -> None:
        """Write the present values, but where the artist's hand is."""
        moved, self._moved = self._moved, ""
        session, garment = self._desk.session, self._desk.garment
        for name, (number, slider) in self._rows.items():
            if name != moved:
                self._write(TUNABLES[name], number, slider)
        tried = session.setting.values.get(garment, {})
        put(self._reset, options=(RESET, *(TUNABLES[name].label for name in tried if name in TUNABLES), EVERYTHING))
        put(self._reset, value=RESET)
        put(self._subsets, content=self._of_subsets())
        put(self._level, value=min(session.setting.levels[self._desk.index], self._level.max))
        put(self._contact, value=session.setting.contact)

    def _build_group(self, group: str) -> None:
        """A number box and a slider for each value of a display group, after the group's other controls."""
        desk, gui = self._desk, self._desk.gui
        if group == REFINEMENT:
            row, now = GARMENT["refine:level"], desk.session.setting.levels[0]
            most = int(max(row.soft or (0, now)))
            level = gui.add_slider(
                row.label, 0, most, 1, min(now, most), hint=f"Each makes four faces of one. {row.name}"
            )
            self._level = desk.on(level, lambda session, value: session.set_level(desk.garment, int(value)))
        elif group == CONTACT:
            contact = gui.add_checkbox("Contact", True, hint="With bodies and of cloth with cloth.")
            self._contact = desk.on(contact, lambda session, value: session.set_contact(value))
        for tunable in (each for each in TUNABLES.values() if each.group == group):
            number = gui.add_number(tunable.title, 0.0, hint=tunable.hint)
            gui.add_html("<div class='value'></div>")
            slider = gui.add_slider(" ", 0.0, 1.0, FINEST, 0.5, hint=tunable.hint)
            self._rows[tunable.name] = number, slider
            desk.on(number, lambda session, value, of=tunable: self._try(session, of, value / of.factor))
            desk.on(slider, lambda session, place, of=tunable: self._try(session, of, of.at(place), is_slid=True))
            self._write(tunable, number, slider)

    def _try(self, session: TuneSession, tunable: Tunable, value: float, *, is_slid: bool = False) -> None:
        """Try a value [SI]; the slider's value is copied to the number box, and the box's to the slider."""
        session.set_value(self._desk.garment, tunable.name, value)
        if tunable.group == FABRIC:
            put(self._preset, value=OWN_VALUES)
        self._moved, (number, slider) = tunable.name, self._rows[tunable.name]
        self._write(tunable, number if is_slid else None, None if is_slid else slider)

    def _write(self, tunable: Tunable, number: Any | None, slider: Any | None) -> None:
        """Write a value into a number box and a slider, unless None; marked if it is tried."""
        session, garment = self._desk.session, self._desk.garment
        value = session.value(garment, tunable.name)
        if number is not None:
            shown, decimals = tunable.shown(0.0 if value is None else value)
            mark = ", unset" if value is None else f" {CHANGED}" if session.tries(garment, tunable.name) else ""
            put(number, label=tunable.title + mark, precision=decimals, step=10.0**-decimals, value=shown)
        if slider is not None:
            put(slider, value=tunable.place(value if value is not None else tunable.ends[0]))

    def _of_subsets(self) -> str:
        """The garment's subsets of other fabrics, as HTML."""
        notes = texts("subset", Facts(sources=[self._desk.session.shot.sources[self._desk.index]]))
        return "".join(
            small(f"{note}. These values hold there, and follow the garment's in proportion.") for note in notes
        )

    def _presets(self) -> tuple[str, ...]:
        own = tuple(OWN + name for name in sorted(self._desk.notes.presets))
        last = (LAST,) if self._desk.notes.looked.get("values") else ()
        return (AS_AUTHORED, OWN_VALUES, *last, *own, *sorted(PRESETS))

    def _choose(self, session: TuneSession, chosen: str) -> None:
        garment, notes = self._desk.garment, self._desk.notes
        if chosen == AS_AUTHORED:
            session.set_as_authored(garment)
        elif chosen == LAST:
            for path, values in notes.looked["values"].items():
                for name, value in values.items():
                    if path in session.garments and name in TUNABLES:
                        session.set_value(path, name, value)
        elif chosen.startswith(OWN):
            session.set_fabric(garment, notes.presets[chosen.removeprefix(OWN)], chosen)
        elif chosen != OWN_VALUES:
            session.set_preset(garment, chosen)

    def _pick(self, session: TuneSession, name: str) -> None:
        self._choose(session, name)
        put(self._preset, value=name)

    def _keep_preset(self, session: TuneSession) -> None:
        name = self._name.value.strip() or "mine"
        rows = (each for each in TUNABLES.values() if each.group == FABRIC)
        values = {each.name: session.value(self._desk.garment, each.name) for each in rows}
        self._desk.notes.presets[name] = {each: value for each, value in values.items() if value is not None}
        self._desk.notes.save(self._desk.notes.looked)
        self._preset.options = self._presets()
        self._preset.value = OWN + name

    def _put_back(self, session: TuneSession, label: str) -> None:
        garment = self._desk.garment
        if label == EVERYTHING:
            session.set_as_authored(garment)
            self._preset.value = AS_AUTHORED
        for tunable in (each for each in TUNABLES.values() if each.label == label):
            session.reset(garment, tunable.name)


def pictures(presets: Sequence[str]) -> str:
    """Rules of style that draw each preset's picture on the button of the same number."""
    data = (b64encode((SWATCHES / f"{name}.webp").read_bytes()).decode() for name in presets)
    buttons = (f"div:has(> .swatches) + div button:nth-of-type({number})" for number in range(1, len(presets) + 1))
    urls = (f"{{background-image: url(data:image/webp;base64,{each})}}" for each in data)
    return "\n".join(map(" ".join, zip(buttons, urls, strict=True)))
