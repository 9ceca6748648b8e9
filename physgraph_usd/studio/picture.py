"""Cloth and bodies in viser's scene: in columns side by side, or at one place with a wipe between two of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import viser
from scipy import sparse

from ..shot.page.drawing import BODY_COLOR, CLOTH_COLOR, encode_color
from ..solver.colliders.pose import Pose
from ..solver.scene import Frame
from ..usd.read.bindings import GarmentBindings
from ..usd.read.meshes import color_of, limit_of
from .brush import Stroke, circle
from .light import add_lights, to_linear
from .maps import PLAIN, Map, find_map
from .session import TuneSession
from .skins import Placed, Skins
from .takes import Shown
from .view import BESIDE_A, CAGE, FINE, KEPT, SUBDIVISION, View

COLORS = {CAGE: (201, 160, 110), SUBDIVISION: (196, 178, 152), KEPT: (190, 205, 165), FINE: encode_color(CLOTH_COLOR)}
TRIM, BODY, WIRE, RING = (176, 168, 140), encode_color(BODY_COLOR), (40, 44, 52), (16, 18, 22)
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


class RenderedCloth:
    """Moves refined cloth to the surface that a renderer draws."""

    def __init__(self, session: TuneSession) -> None:
        """Take the session; the matrices are made with the first positions."""
        self._session = session
        self._limits: dict[tuple[int, int], sparse.csr_matrix | None] = {}

    def __call__(self, index: int, points: np.ndarray) -> np.ndarray:
        """Positions of a garment by number on the surface [m], from those of the refined cloth, shape (V, 3)."""
        levels = len(self._session.refinements[index])
        if (index, levels) not in self._limits:
            self._limits[index, levels] = limit_of(self._session.shot, index, levels)
        limit = self._limits[index, levels]
        return points if limit is None else limit @ points


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
        self._cloth, self._line = points, 0.0  # Where the wipe stands to the right [m].
        self._labels: dict[str, viser.LabelHandle] = {}
        self._bindings: dict[int, tuple[int, GarmentBindings]] = {}
        self._rendered = RenderedCloth(session)
        self._own = {path: color_of(session.shot.stage, path) for path in (*session.garments, *session.shot.colliders)}
        self._skins, self._columns = Skins(server, self.axes), list[list[str]]()
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
        """Draw a frame, or cages if no refined cloth exists; ``kept`` is the frame kept as A."""
        with self._server.atomic():  # Pictures between two states are never drawn.
            self.bar = None
            garments = range(len(shown.garments))
            is_solved = any(garment.points is not None for garment in shown.garments)
            columns = self.view.columns if is_solved else (CAGE,)
            self._scene.remove_by_name("wires")
            self._skins.touched = [f"{FINE}/{index}" for index in garments] if self.paintable else []
            self._columns = []
            across = _everything(shown.frame) @ self.axes[0]
            self._line = float(across.min() + self.view.wipe * np.ptp(across))
            for place, column in enumerate(columns):
                at = self._offset(place, len(columns))
                named: list[str] = []
                for index in garments:
                    named += self._draw_garment(shown, kept, index, column=column, at=at)
                    named += self._draw_trims(shown, index, at=at) if column == FINE else []
                if not (self.view.wiped and place):
                    named += self._draw_bodies(shown.frame, column, at=at)
                self._columns += [named] if named else []
            self._skins.keep([name for named in self._columns for name in named])
            self._cloth = np.concatenate([each.points for each in shown.frame.garments])
            places = self._places(columns) if len(columns) > 1 else {}
            for text in self._labels.keys() - places.keys():
                self._labels.pop(text).remove()
            for text in places.keys() - self._labels.keys():
                self._labels[text] = self._scene.add_label(f"label/{text}", text, anchor="bottom-center")
            for text, place in places.items():  # A label that is added anew is not seen for a moment.
                self._labels[text].position = tuple(place.tolist())

    def shade(self, cancelled: Callable[[], bool]) -> None:
        """Draw the light and the soft shadows of what is drawn, unless ``cancelled`` meanwhile."""
        self._skins.shade(self._columns, cancelled, grounds=1 if self.view.wiped else len(self._columns))

    def move(self, points: Mapping[str, np.ndarray]) -> None:
        """Draw refined garments at new positions [m], by path; maps, wires and a wipe follow in `draw`."""
        at = self._offset(len(self.view.columns) - 1, len(self.view.columns))
        for path, each in points.items():
            index = self._session.garments.index(path)
            handle = self._skins.meshes.get(name := f"{FINE}/{index}")
            if handle is not None and self.view.map == PLAIN and len(handle.vertices) == len(each):
                self._skins.move(name, self._placed(self._rendered(index, each), at))

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
        """Positions of labels [m], shape (3,), by text: above the garments of each column or side of a wipe."""
        top = ((self._cloth - self.centre) @ self.axes[1]).max() * self.axes[1]
        apart = (0.5 if self.view.wiped else 1.0) * self._across * self.axes[0]
        texts = [BESIDE_A if name == FINE and KEPT in columns else name for name in columns]
        return {text: top + (place - 0.5 * (len(columns) - 1)) * apart for place, text in enumerate(texts)}

    def _placed(self, points: np.ndarray, at: np.ndarray) -> np.ndarray:
        return (points - self.centre + at).astype(np.float32)

    def _draw_garment(self, shown: Shown, kept: Shown | None, index: int, *, column: str, at: np.ndarray) -> list[str]:
        """Draw a garment in a column; returns the names of what is drawn."""
        cage, chain = self._session.shot.scene.garments[index], self._session.refinements[index]
        mesh = cage.mesh if column == CAGE or not chain else chain[-1].mesh
        points = self._points(shown, kept, index, column)
        if points is None or len(points) != mesh.vertex_count:
            return []
        flat, color, colors = column == CAGE, self._color(cage.path, COLORS[column]), None
        if column == FINE and (found := find_map(self._session, shown, index, self.view.map, stroke=self.stroke)):
            self.bar, values = found
            colors = self.bar.colors(values)
        triangles = mesh.triangulate(cage.rest if mesh is cage.mesh else None).triangles
        name = f"{column}/{index}"
        self._place(name, points, triangles, at=at, column=column, flat=flat, color=color, colors=colors)
        if self.view.wires:
            edges = self._side(points, mesh.half_edges.edges, column)
            self._draw_lines(f"wires/{name}", self._placed(points, at)[edges], WIRE, WIRE_PIXELS)
        return [name]

    def _points(self, shown: Shown, kept: Shown | None, index: int, column: str) -> np.ndarray | None:
        """A garment's positions in a column [m], shape (V, 3), or None."""
        given = shown.frame.garments[index].points
        if column == SUBDIVISION and self._session.refinements[index]:
            return self._session.solver.refiner.group_of((index,)).levels[-1].smooth_from_coarse @ given
        solved = {FINE: shown, KEPT: kept}.get(column)
        fine = None if solved is None else solved.garments[index].points
        return given if column in (CAGE, SUBDIVISION) else None if fine is None else self._rendered(index, fine)

    def _side(self, points: np.ndarray, corners: np.ndarray, column: str) -> np.ndarray:
        """Faces or edges of a column, shape (N, k): all, or with a wipe those partly on its side."""
        if not column or not self.view.wiped or len(self.view.columns) < 2:
            return corners
        return partly_on_side(points @ self.axes[0] - self._line, corners, left=column == self.view.columns[0])

    def _color(self, path: str, usual: tuple[int, int, int]) -> np.ndarray:
        """A prim's own colour, or the usual one, sRGB: linear RGB, shape (3,)."""
        own = self._own.get(path)
        return to_linear(usual) if own is None else own

    def _draw_lines(self, name: str, segments: np.ndarray, color: tuple[int, int, int], pixels: float) -> None:
        """Draw line segments in the scene [m], shape (S, 2, 3), under a name, in place of those before."""
        self._scene.remove_by_name(name)
        if len(segments):
            self._scene.add_line_segments(name, segments, color, thickness=pixels, thickness_units="screen")

    def _draw_trims(self, shown: Shown, index: int, *, at: np.ndarray) -> list[str]:
        """Draw the meshes that hang on a refined garment; returns the names of what is drawn."""
        points, steps, named = shown.garments[index].points, self._session.refinements[index], list[str]()
        if points is None:
            return named
        if index not in self._bindings or self._bindings[index][0] != len(steps):
            self._bindings[index] = len(steps), GarmentBindings(self._session.shot, index, steps)
        for placed in self._bindings[index][1].at(shown.frame.time, points):
            if placed.target.mesh is not None:
                triangles = placed.target.mesh.triangulate(placed.target.points).triangles
                named.append(name := f"trim/{index}/{placed.target.path}")
                self._place(name, placed.points, triangles, at=at, column=FINE, color=to_linear(TRIM))
        return named

    def _draw_bodies(self, frame: Frame, column: str, *, at: np.ndarray) -> list[str]:
        drawn = {f"body/{column}/{index}": (index, pose) for index, pose in _drawn(frame).items()}
        for name, (index, pose) in drawn.items():
            color = self._color(self._session.shot.scene.colliders[index].path, BODY)
            self._place(name, pose.points, pose.triangles, at=at, color=color)
        return [*drawn]

    def _place(
        self, name: str, points: np.ndarray, whole: np.ndarray, *, at: np.ndarray, column: str = "", **look: Any
    ) -> None:
        """Draw a mesh, or its column's side of the wipe."""
        triangles = self._side(points, whole, column)
        self._skins.place(name, Placed(self._placed(points, at), triangles, whole=whole, **look))


def partly_on_side(beyond: np.ndarray, corners: np.ndarray, *, left: bool) -> np.ndarray:
    """Faces or edges with a corner on one side of a line, shape (N, k); both sides together leave no gap at the line.

    Args:
        beyond: Signed distance of each point to the right of the line [m], shape (V,).
        corners: Indices of the corners of each face or edge, shape (N, k).
        left: True for the left side.
    """
    return corners[((beyond[corners] < 0.0) == left).any(axis=1)]


def _everything(frame: Frame) -> np.ndarray:
    """Points of all cages and bodies [m], shape (N, 3)."""
    return np.concatenate([each.points for each in (*frame.garments, *_drawn(frame).values())])


def _drawn(frame: Frame) -> dict[int, Pose]:
    """Poses of the bodies by number, without planes, which have no end."""
    return {index: pose for index, pose in enumerate(frame.colliders) if pose and not pose.endless}
