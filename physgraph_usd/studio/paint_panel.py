"""Painting in the page: the brush, and strokes over the refined cloth."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..usd.schema import GARMENT
from .brush import ERASE, PAINT, READ, SMOOTH, Brush, Stroke, gradient, hit
from .camera import Camera
from .desk import Desk, in_order, put, small
from .maps import PLAIN, find_map
from .session import TuneSession
from .values import MAPS, TUNABLES, on_fine
from .view_panel import ViewPanel

OFF = "off"
MODES = {None: None, "shift": SMOOTH, "cmd/ctrl": ERASE}
"""The brush of a drag by the keys that are held; None is the brush chosen on the page."""

MULTIPLIED = {
    "stretchScale": ("stretchStiffness",),
    "bendScale": ("bendStiffness",),
    "detailScale": ("refine:detail",),
    "guideScale": ("guide:stiffness",),
    "maxDistanceScale": ("maxDistance",),
    "backstopScale": ("backstop",),
    "easeScale": ("rest:weftEase", "rest:warpEase"),
}
"""Values that each map multiplies, by the schema's short names."""


class PaintPanel:
    """The controls of the brush."""

    def __init__(self, desk: Desk, view: ViewPanel, camera: Camera) -> None:
        """Add the controls."""
        self._desk, self._view, self._camera, gui = desk, view, camera, desk.gui
        self._name, self._stroke = OFF, None
        self._attached: dict[int, Any] = {}  # Handles that have the callbacks.
        self._at: np.ndarray | None = None  # The middle of the rings, in the scene [m].
        size = desk.picture.size
        choice = gui.add_dropdown(
            "Paint", (OFF, *MAPS), hint="Drag on the refined cloth; drag beside it to turn the view."
        )
        self._choice = desk.on(choice, self.choose)
        self._remark, self._read = gui.add_html(""), gui.add_html("")
        self._value = gui.add_number("Value", 0.0, step=0.01)
        least, first, most = (_short(1e3 * part * size) for part in (0.005, 0.05, 0.3))
        radius = gui.add_slider("Radius [mm]", least, most, 10.0 ** np.floor(np.log10(least)), first)
        self._radius = desk.on(radius, lambda session, value: self._draw_rings())
        self._strength = gui.add_slider("Strength", 0.05, 1.0, 0.05, 0.5)
        hint = "Erase paints the value that changes nothing. While dragging, shift smooths, and ctrl erases."
        self._mode = desk.on(gui.add_dropdown("Brush", (PAINT, ERASE, SMOOTH, READ), hint=hint), lambda *_: None)
        self._mirror = gui.add_checkbox("Mirror", False, hint="Paints the other side too, mirrored at rest.")
        flood = gui.add_button("Fill", hint="Gives every vertex the value.")
        desk.press(flood, self._fill)
        hint = "From the value at the highest vertex to the value that changes nothing at the lowest."
        desk.press(gui.add_button("Gradient", hint=hint), self._gradient)
        hint = "Exchanges the value and the value that changes nothing, and those between."
        desk.press(gui.add_button("Invert", hint=hint), self._invert)
        camera.on_click(self._clicked)

    def choose(self, session: TuneSession, name: str) -> None:
        """Take up the brush for a map of `MAPS`, or put it down."""
        self._name, self._desk.picture.paintable = name, name != OFF
        if name != OFF:
            row = GARMENT[name]
            self._value.value = float((row.soft or (0.0, 1.0))[1])
            self._value.label = f"Value [{row.unit}]" if row.unit else "Value"
            self._view.set(map=name)
            eye, middle = self._camera.eye, self._desk.picture.framed.mean(axis=0)
            hits = (self._hit(session, k, eye, middle - eye) for k in range(len(session.garments)))
            self._at = next((at for at in hits if at is not None), None)
        put(self._read, content="")
        self.update(session)
        self._draw_rings()

    def update(self, session: TuneSession) -> None:
        """Give the reason if the painted map has no effect."""
        names = MULTIPLIED.get(self._name, ())
        labels = " and ".join(TUNABLES[name].label for name in names)
        idle = names and not any(session.value(self._desk.garment, name) for name in names)
        verb = "which are 0: raise one of them" if len(names) > 1 else "which is 0: raise it"
        if names and all(session.value(self._desk.garment, name) is None for name in names):
            verb = "which is unset: set it"
        remark = f"No effect yet: the map multiplies {labels}, {verb} under Values." if idle else ""
        put(self._remark, content=small(remark, "remark") if remark else "")

    def attach(self) -> None:
        """Attach the brush to drags on the picture's targets, and only to them."""
        targets = self._desk.picture.targets
        for index, handle in self._attached.items():
            if targets.get(index) is not handle:
                handle.remove_drag_callback()
        for index, handle in targets.items():
            if self._attached.get(index) is not handle:
                for modifier, mode in MODES.items():
                    dragged = in_order(lambda event, index=index, mode=mode: self._dragged(index, event, mode))
                    handle.on_drag("left", modifier=modifier)(dragged)
        self._attached = targets

    def _clicked(self, event: Any) -> None:
        origin, along = np.asarray(event.ray_origin), np.asarray(event.ray_direction)

        def touch(session: TuneSession) -> None:
            for index in range(len(session.garments)):
                self.touch(session, index, origin, along=along)
            self.lift(session)

        if self._name != OFF:
            self._desk.ask(touch)
        elif self._desk.picture.view.map != PLAIN:
            self._desk.ask(lambda session: self._read_map(session, origin, along))

    def _dragged(self, index: int, event: Any, mode: str | None) -> None:
        origin = np.asarray(event.client.camera.position)
        along = np.asarray(event.end_position) - origin
        self._desk.ask(lambda session: self.touch(session, index, origin, along=along, mode=mode))
        if event.phase == "end":
            self._desk.ask(self.lift)

    def touch(
        self, session: TuneSession, index: int, origin: np.ndarray, *, along: np.ndarray, mode: str | None = None
    ) -> None:
        """Paint at the intersection of a ray of the picture and a garment's refined cloth; ``mode`` is the brush's."""
        at = self._hit(session, index, origin, along)
        if at is None or self._name == OFF:
            return
        garment, cage = session.garments[index], session.shot.scene.garments[index]
        points = np.asarray(session.solve().garments[index].points)
        stroke = self._stroke
        if stroke is None or (stroke.garment, stroke.name) != (garment, self._name):
            stroke = Stroke(garment, self._name, session.painted(garment, self._name))
        mode = str(mode or self._mode.value)
        if mode == READ:
            self._stroke = None
            self._say_value(session, index, at, stroke.values)
            return
        value = float(GARMENT[self._name].fallback or 0.0) if mode == ERASE else self._limited()
        brush = Brush(1e-3 * self._radius.value, value, self._strength.value, mode=mode, mirrored=self._mirror.value)
        points, right = points[: cage.mesh.vertex_count], self._desk.picture.axes[0]
        stroke.touch(brush, self._desk.picture.world(at), points, mesh=cage.mesh, rest=cage.rest, right=right)
        self._stroke = self._desk.picture.stroke = stroke
        self._say_value(session, index, at, stroke.values)

    def _say_value(self, session: TuneSession, index: int, at: np.ndarray, values: np.ndarray) -> None:
        """Draw the rings at a place in the scene [m], and write a map's value there."""
        found = on_fine(values, session.refinements[index])[self._nearest(session, index, at)]
        unit = GARMENT[self._name].unit
        put(self._read, content=small(f"{self._name} under the brush: {found:.3g} {unit}".strip(), "read"))
        self._at = at
        self._draw_rings()

    def _read_map(self, session: TuneSession, origin: np.ndarray, along: np.ndarray) -> None:
        """Write the value of the map that is drawn, where a ray of the picture meets refined cloth first."""
        hits = {index: self._hit(session, index, origin, along) for index in range(len(session.garments))}
        far = {index: float(np.linalg.norm(at - origin)) for index, at in hits.items() if at is not None}
        if not far:
            return
        index = min(far, key=far.__getitem__)
        found = find_map(session, session.solve(), index, self._desk.picture.view.map)
        if found is not None:
            drawn, values = found
            value = values[self._nearest(session, index, np.asarray(hits[index]))]
            self._view.say(f"{drawn.name} at the click: {value:.3g} {drawn.unit}".strip())

    def _nearest(self, session: TuneSession, index: int, at: np.ndarray) -> int:
        """The vertex of a garment's refined cloth that is nearest to a place in the scene [m], shape (3,)."""
        points = np.asarray(session.solve().garments[index].points)
        return int(np.linalg.norm(points - self._desk.picture.world(at), axis=1).argmin())

    def lift(self, session: TuneSession) -> None:
        """End a stroke: its map is tried."""
        stroke, self._stroke, self._desk.picture.stroke = self._stroke, None, None
        if stroke is not None:
            session.paint(stroke.garment, stroke.name, stroke.values)

    def _hit(self, session: TuneSession, index: int, origin: np.ndarray, along: np.ndarray) -> np.ndarray | None:
        """The first intersection of a ray of the scene and a garment's refined cloth, in the scene [m]; or None."""
        points, picture = session.solve().garments[index].points, self._desk.picture
        if points is None:
            return None
        chain, cage = session.refinements[index], session.shot.scene.garments[index]
        triangles = chain[-1].mesh.triangulate(None).triangles if chain else cage.mesh.triangulate(cage.rest).triangles
        at = hit(picture.world(origin), along / np.linalg.norm(along), points, triangles)
        return None if at is None else at - picture.world(np.zeros(3))

    def _draw_rings(self) -> None:
        at = None if self._name == OFF else self._at
        self._desk.picture.draw_rings(at, 1e-3 * self._radius.value, eye=self._camera.eye)

    def _fill(self, session: TuneSession) -> None:
        if self._name != OFF:
            garment = self._desk.garment
            values = np.full_like(session.painted(garment, self._name), self._limited())
            session.paint(garment, self._name, values)

    def _gradient(self, session: TuneSession) -> None:
        if self._name != OFF:
            garment, idle = self._desk.garment, float(GARMENT[self._name].fallback or 0.0)
            points = session.shot.frame(session.time).garments[self._desk.index].points
            rise = gradient(points, self._desk.picture.axes[1])
            session.paint(garment, self._name, idle + rise * (self._limited() - idle))

    def _invert(self, session: TuneSession) -> None:
        if self._name != OFF:
            row, values = GARMENT[self._name], session.painted(self._desk.garment, self._name)
            mirrored = float(row.fallback or 0.0) + self._limited() - values
            session.paint(self._desk.garment, self._name, np.clip(mirrored, row.minimum, row.maximum))

    def _limited(self) -> float:
        """The value to paint, within the map's limits."""
        row = GARMENT[self._name]
        return float(np.clip(self._value.value, row.minimum, row.maximum))


def _short(number: float) -> float:
    """A number rounded to two figures."""
    return float(f"{number:.2g}")
