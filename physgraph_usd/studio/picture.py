"""Cloth and bodies in viser's scene: in columns side by side, or at one place with a wipe between two of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import viser

from ..solver.colliders.pose import Pose
from ..solver.mesh.topology import PolygonMesh
from ..solver.scene import Frame
from ..usd.read.bindings import GarmentBindings
from ..usd.read.meshes import color_of
from .brush import Stroke, circle
from .light import add_lights, to_linear
from .maps import PLAIN, Map, find_map
from .session import TuneSession
from .skins import Placed, Skins
from .takes import Shown
from .view import CAGE, FINE, KEPT, SUBDIVISION, Labels, View

COLORS = {CAGE: (201, 160, 110), SUBDIVISION: (168, 160, 150), KEPT: (150, 170, 140), FINE: (122, 150, 190)}
TRIM, BODY, WIRE, RING = (176, 168, 140), (150, 150, 150), (40, 44, 52), (16, 18, 22)
"""Colours, sRGB; a garment or body with a colour of its own on the stage has that."""
GAP = 0.04
"""Space between columns, in the size of what is drawn."""
SAMPLED = 6
"""Frames whose widths set the columns apart."""
WIRE_PIXELS, RING_PIXELS = 0.8, 2.5
LIFT = 0.004
"""How far before the cloth the brush's rings are drawn, in the garments' size."""
FALLOFF = (1.0, 0.5)
"""Radii of the brush's rings over the brush's radius: full extent, and half strength."""


@dataclass(frozen=True, eq=False)
class Sheet:
    """A mesh to be drawn.

    Attributes:
        points: Positions [m], world space, shape (V, 3).
        triangles: Shape (T, 3).
        edges: Edges of its faces, shape (E, 2).
    """

    points: np.ndarray
    triangles: np.ndarray
    edges: np.ndarray

    def beside(self, line: float, right: np.ndarray, *, before: bool) -> Sheet:
        """The faces and edges whose middle lies ``before`` or after a line [m] along a direction, shape (3,)."""

        def chosen(corners: np.ndarray) -> np.ndarray:
            return corners[((self.points @ right)[corners].mean(axis=1) < line) == before]

        return replace(self, triangles=chosen(self.triangles), edges=chosen(self.edges))


class Picture:
    """The scene of a session; it is drawn by the thread that owns the session.

    Attributes:
        view: How cloth is shown.
        paintable: Whether the mouse meets the refined garments.
        bar: The map that is drawn, or None.
        stroke: The map under the brush, drawn in place of the session's; or None.
        axes: Rows are right, up and towards the viewer, shape (3, 3).
        size: Size of the first frame's garments [m].
    """

    def __init__(self, server: viser.ViserServer, session: TuneSession) -> None:
        """Set up light, and columns that the session's frames fit into."""
        self.view = View()
        self.bar: Map | None = None
        self.stroke: Stroke | None = None
        self._server, self._scene, self._session = server, server.scene, session
        scene, frame = session.shot.scene, session.shot.frame(session.time)
        points = np.concatenate([each.points for each in frame.garments])
        low, high = points.min(axis=0), points.max(axis=0)
        self.centre, self.size = 0.5 * (low + high), float(np.linalg.norm(high - low))
        up = -scene.gravity / np.linalg.norm(scene.gravity)
        right = np.array([0.0, 1.0, 0.0]) if abs(up[0]) > 0.9 else np.array([1.0, 0.0, 0.0])
        self.axes = np.stack([right, up, np.cross(right, up)])
        times = session.times[:: max(1, len(session.times) // SAMPLED)]
        drawn = [_everything(session.shot.frame(time)) for time in times]
        self._across = max(np.ptp(each @ right) for each in drawn) + GAP * self.size
        self._cloth = points
        self._lines: dict[str, Any] = {}
        self._bindings: dict[int, tuple[int, GarmentBindings]] = {}
        self._own = {path: color_of(session.shot.stage, path) for path in (*session.garments, *session.shot.colliders)}
        self._skins, self._columns = Skins(server, self.axes), list[list[str]]()
        self._labels = Labels(server.scene)
        self.paintable = False
        add_lights(server.scene, self.axes)

    @property
    def framed(self) -> np.ndarray:
        """Points of the garments in all columns, in the scene [m], shape (N, 3)."""
        count = len(self.view.columns)
        return np.concatenate([self._placed(self._cloth, self._offset(place, count)) for place in range(count)])

    @property
    def targets(self) -> dict[int, Any]:
        """Handles of the meshes that the mouse meets, by number of the garment."""
        names = {k: f"{FINE}/{k}" for k in range(len(self._session.garments))} if self.paintable else {}
        return {k: self._skins.meshes[name] for k, name in names.items() if name in self._skins.meshes}

    def draw(self, shown: Shown, *, kept: Shown | None = None) -> None:
        """Draw a frame, or its cages where it has no refined cloth yet; ``kept`` is A's."""
        with self._server.atomic():  # Pictures between two states are never drawn.
            self.bar = None
            garments = range(len(shown.points))
            columns = self.view.columns if any(each is not None for each in shown.points) else (CAGE,)
            self._skins.touched = [f"{FINE}/{index}" for index in garments] if self.paintable else []
            self._columns, lines = [], set[str]()
            for place, column in enumerate(columns):
                at = self._offset(place, len(columns))
                named: list[str] = []
                for index in garments:
                    named += self._draw_garment(shown, kept, index, column=column, at=at)
                    lines |= {f"wires/{column}/{index}"} if self.view.wires else set()
                    named += self._draw_trims(shown, index, at=at) if column == FINE else []
                if not (self.view.wiped and place):
                    named += self._draw_bodies(shown.frame, column, at=at)
                self._columns += [named] if named else []
            self._skins.keep([name for named in self._columns for name in named])
            for name in [each for each in self._lines if each.startswith("wires") and each not in lines]:
                self._lines.pop(name).remove()
            self._cloth = np.concatenate([each.points for each in shown.frame.garments])
            self._labels.draw(self._places(columns))

    def shade(self, cancelled: Callable[[], bool]) -> None:
        """Draw the light and the soft shadows of what is drawn, unless ``cancelled`` meanwhile."""
        self._skins.shade(self._columns, cancelled)

    def move(self, points: Mapping[str, np.ndarray]) -> None:
        """Draw refined garments at new positions [m], by path; maps, wires and a wipe follow in `draw`."""
        at = self._offset(len(self.view.columns) - 1, len(self.view.columns))
        for path, each in points.items():
            handle = self._skins.meshes.get(name := f"{FINE}/{self._session.garments.index(path)}")
            if handle is not None and self.view.map == PLAIN and len(handle.vertices) == len(each):
                self._skins.move(name, self._placed(each, at))

    def draw_rings(self, at: np.ndarray | None, radius: float, *, eye: np.ndarray) -> None:
        """Draw the end of a brush, and where it paints half, on the refined cloth.

        Args:
            at: The brush's middle in the scene [m], shape (3,); None draws nothing.
            radius: The brush's radius [m].
            eye: Position of the camera in the scene [m], shape (3,).
        """
        meshes = [self._skins.meshes[name] for named in self._columns for name in named if name.startswith(FINE)]
        for part in FALLOFF:
            rings = [circle(each.vertices, each.faces, at, part * radius) for each in meshes if at is not None]
            segments = np.concatenate([np.zeros((0, 2, 3)), *rings])
            to_eye = eye - segments
            lifted = segments + LIFT * self.size * to_eye / np.linalg.norm(to_eye, axis=2, keepdims=True)
            self._draw_lines(f"ring/{part}", lifted, RING, RING_PIXELS * part)

    def world(self, point: np.ndarray) -> np.ndarray:
        """The place [m] in the shot of a point on the refined cloth that is drawn."""
        count = len(self.view.columns)
        return point + self.centre - self._offset(count - 1, count)

    def _offset(self, place: int, count: int) -> np.ndarray:
        """How far a column stands from the middle [m]."""
        return np.zeros(3) if self.view.wiped else (place - 0.5 * (count - 1)) * self._across * self.axes[0]

    def _places(self, columns: Sequence[str]) -> dict[str, np.ndarray]:
        """Where the label of each column stands: over the middle of its garments, or of its side of a wipe [m]."""
        top = ((self._cloth - self.centre) @ self.axes[1]).max() * self.axes[1]
        apart = (0.5 if self.view.wiped else 1.0) * self._across * self.axes[0]
        return {column: top + (place - 0.5 * (len(columns) - 1)) * apart for place, column in enumerate(columns)}

    def _placed(self, points: np.ndarray, at: np.ndarray) -> np.ndarray:
        return (points - self.centre + at).astype(np.float32)

    def _draw_garment(self, shown: Shown, kept: Shown | None, index: int, *, column: str, at: np.ndarray) -> list[str]:
        """Draw a garment in a column; returns the names of what is drawn."""
        sheet = self._sheet(shown, kept, index, column)
        if sheet is None:
            return []
        colors = None
        if column == FINE and (found := find_map(self._session, shown, index, self.view.map, stroke=self.stroke)):
            self.bar, values = found
            colors = self.bar.colors(values)
        own = self._own[self._session.garments[index]]
        color = to_linear(COLORS[column]) if own is None else own
        whole, sheet = sheet.triangles, self._wiped(sheet, column, _everything(shown.frame))
        self._place(name := f"{column}/{index}", sheet, color, at=at, whole=whole, flat=column == CAGE, colors=colors)
        if self.view.wires:
            self._draw_lines(f"wires/{name}", self._placed(sheet.points, at)[sheet.edges], WIRE, WIRE_PIXELS)
        return [name]

    def _sheet(self, shown: Shown, kept: Shown | None, index: int, column: str) -> Sheet | None:
        """A garment's mesh in a column, or None."""
        cage, chain = self._session.shot.scene.garments[index], self._session.refinements[index]
        points = shown.points[index]
        if column == CAGE or not chain:
            found = shown.frame.garments[index].points if column == CAGE else points
            count, split = cage.mesh.vertex_count, cage.mesh.triangulate(cage.rest).triangles
            edges = _edges(cage.mesh)
        else:
            mesh = chain[-1].mesh
            count, split, edges = mesh.vertex_count, mesh.triangulate(None).triangles, _edges(mesh)
            if column == SUBDIVISION:
                finest = self._session.solver.refiner.group_of((index,)).levels[-1]
                points = finest.smooth_from_coarse @ shown.frame.garments[index].points
            elif column == KEPT:
                points = None if kept is None else kept.points[index]
            found = points
        return None if found is None or len(found) != count else Sheet(found, split, edges)

    def _wiped(self, sheet: Sheet, column: str, drawn: np.ndarray) -> Sheet:
        """The part of a mesh on one side of the wipe; ``drawn`` [m], shape (N, 3), gives the wipe's ends."""
        if not self.view.wiped or len(self.view.columns) < 2:
            return sheet
        low, high = (drawn @ self.axes[0]).min(), (drawn @ self.axes[0]).max()
        line = low + self.view.wipe * (high - low)
        return sheet.beside(line, self.axes[0], before=column == self.view.columns[0])

    def _draw_lines(self, name: str, segments: np.ndarray, color: tuple[int, int, int], pixels: float) -> None:
        """Draw line segments in the scene [m], shape (S, 2, 3), under a name; none removes them."""
        if (handle := self._lines.pop(name, None)) is not None:
            handle.remove()
        if len(segments):
            look: dict[str, Any] = {"thickness": pixels, "thickness_units": "screen"}
            self._lines[name] = self._scene.add_line_segments(name, segments, color, **look)

    def _draw_trims(self, shown: Shown, index: int, *, at: np.ndarray) -> list[str]:
        """Draw the meshes that hang on a refined garment; returns the names of what is drawn."""
        points, steps, named = shown.points[index], self._session.refinements[index], list[str]()
        if points is None:
            return named
        if index not in self._bindings or self._bindings[index][0] != len(steps):
            self._bindings[index] = len(steps), GarmentBindings(self._session.shot, index, steps)
        for placed in self._bindings[index][1].at(shown.frame.time, points):
            if placed.target.mesh is not None:
                name, mesh = f"trim/{index}/{placed.target.path}", placed.target.mesh
                sheet = Sheet(placed.points, mesh.triangulate(placed.target.points).triangles, np.empty((0, 2), int))
                whole, sheet = sheet.triangles, self._wiped(sheet, FINE, _everything(shown.frame))
                self._place(name, sheet, to_linear(TRIM), at=at, whole=whole)
                named.append(name)
        return named

    def _draw_bodies(self, frame: Frame, column: str, *, at: np.ndarray) -> list[str]:
        drawn = {f"body/{column}/{index}": (index, pose) for index, pose in _drawn(frame).items()}
        for name, (index, pose) in drawn.items():
            own = self._own.get(self._session.shot.scene.colliders[index].path)
            color = to_linear(BODY) if own is None else own
            sheet = Sheet(pose.points, pose.triangles, np.empty((0, 2), int))
            self._place(name, sheet, color, at=at, whole=pose.triangles)
        return [*drawn]

    def _place(self, name: str, sheet: Sheet, color: np.ndarray, *, at: np.ndarray, **look: Any) -> None:
        self._skins.place(name, Placed(self._placed(sheet.points, at), sheet.triangles, color=color, **look))


def _everything(frame: Frame) -> np.ndarray:
    """Points of all cages and bodies [m], shape (N, 3)."""
    return np.concatenate([each.points for each in (*frame.garments, *_drawn(frame).values())])


def _drawn(frame: Frame) -> dict[int, Pose]:
    """Poses of the bodies by number, without planes, which have no end."""
    return {index: pose for index, pose in enumerate(frame.colliders) if pose and not pose.endless}


def _edges(mesh: PolygonMesh) -> np.ndarray:
    """Each edge of a mesh's faces once, shape (E, 2)."""
    ends = np.sort(np.stack([mesh.indices, mesh.indices[mesh.next_corner]], axis=1), axis=1)
    return np.unique(ends, axis=0)
