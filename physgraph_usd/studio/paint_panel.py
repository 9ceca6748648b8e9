"""Painting in the page: the brush, and strokes over the refined cloth."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..usd.schema import GARMENT
from .brush import PAINT, SMOOTH, Brush, Stroke, hit
from .desk import Desk, in_order
from .session import TuneSession
from .values import MAPS
from .view_panel import ViewPanel

OFF = "off"


class PaintPanel:
    """The controls of the brush."""

    def __init__(self, desk: Desk, view: ViewPanel) -> None:
        """Add the controls."""
        self._desk, self._view, gui = desk, view, desk.gui
        self._name, self._stroke = OFF, None
        self._attached: dict[int, Any] = {}  # Handles that have the callbacks.
        size = desk.picture.size
        choice = gui.add_dropdown(
            "Paint", (OFF, *MAPS), hint="Drag on the refined cloth; drag beside it to turn the view."
        )
        self._choice = desk.on(choice, self.choose)
        self._value = gui.add_number("Value", 0.0, step=0.01)
        self._radius = gui.add_slider("Radius [m]", 0.005 * size, 0.3 * size, 0.001 * size, 0.05 * size)
        self._strength = gui.add_slider("Strength", 0.05, 1.0, 0.05, 0.5)
        self._mode = gui.add_dropdown("Brush", (PAINT, SMOOTH))
        self._mirror = gui.add_checkbox("Mirror", False, hint="Paints the other side too, mirrored at rest.")
        flood = gui.add_button("Fill", hint="Gives every vertex the value.")
        desk.press(flood, self._fill)

    def choose(self, session: TuneSession, name: str) -> None:
        """Take up the brush for a map of `MAPS`, or put it down."""
        self._name, self._desk.picture.paintable = name, name != OFF
        if name != OFF:
            row = GARMENT[name]
            self._value.value = float((row.soft or (0.0, 1.0))[1])
            self._view.set(map=name)

    def attach(self) -> None:
        """Attach the brush to drags and clicks on the picture's targets."""
        for index, handle in self._desk.picture.targets.items():
            if self._attached.get(index) is not handle:
                handle.on_drag("left")(in_order(lambda event, index=index: self._dragged(index, event)))
                handle.on_click(in_order(lambda event, index=index: self._clicked(index, event)))
        self._attached = dict(self._desk.picture.targets)

    def _clicked(self, index: int, event: Any) -> None:
        origin, along = np.asarray(event.ray_origin), np.asarray(event.ray_direction)
        self._desk.ask(lambda session: self.touch(session, index, origin, along=along))
        self._desk.ask(self.lift)

    def _dragged(self, index: int, event: Any) -> None:
        origin = np.asarray(event.client.camera.position)
        along = np.asarray(event.end_position) - origin
        self._desk.ask(lambda session: self.touch(session, index, origin, along=along))
        if event.phase == "end":
            self._desk.ask(self.lift)

    def touch(self, session: TuneSession, index: int, origin: np.ndarray, *, along: np.ndarray) -> None:
        """Paint at the intersection of a ray of the picture and a garment's refined cloth."""
        garment, points = session.garments[index], session.solve().points[index]
        chain, cage = session.refinements[index], session.shot.scene.garments[index]
        if points is None or self._name == OFF:
            return
        triangles = chain[-1].mesh.triangulate(None).triangles if chain else cage.mesh.triangulate(cage.rest).triangles
        start = self._desk.picture.world(origin)
        at = hit(start, along / np.linalg.norm(along), points, triangles)
        if at is None:
            return
        stroke = self._stroke
        if stroke is None or (stroke.garment, stroke.name) != (garment, self._name):
            stroke = Stroke(garment, self._name, session.painted(garment, self._name))
        controls = self._radius, self._strength, self._mode, self._mirror
        radius, strength, mode, mirrored = (each.value for each in controls)
        brush = Brush(radius, self._limited(), strength=strength, mode=mode, mirrored=mirrored)
        where = {"mesh": cage.mesh, "rest": cage.rest, "right": self._desk.picture.right}
        stroke.touch(brush, at, points[: cage.mesh.vertex_count], **where)
        self._stroke = self._desk.picture.stroke = stroke

    def lift(self, session: TuneSession) -> None:
        """End a stroke: its map is tried."""
        stroke, self._stroke, self._desk.picture.stroke = self._stroke, None, None
        if stroke is not None:
            session.paint(stroke.garment, stroke.name, stroke.values)

    def _fill(self, session: TuneSession) -> None:
        if self._name != OFF:
            garment = self._desk.garment
            values = np.full_like(session.painted(garment, self._name), self._limited())
            session.paint(garment, self._name, values)

    def _limited(self) -> float:
        """The value to paint, within the map's limits."""
        row = GARMENT[self._name]
        return float(np.clip(self._value.value, row.minimum, row.maximum))
