"""Cloth and bodies in viser's scene: in columns side by side, or at one place with a wipe between two of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import trimesh
import viser
from trimesh.exchange.gltf import export_glb

from ..solver.colliders.pose import Pose
from ..solver.mesh.topology import PolygonMesh
from ..solver.scene import Frame
from ..usd.read.bindings import GarmentBindings
from .brush import Stroke
from .maps import PLAIN, Map, find_map
from .session import TuneSession
from .takes import Shown

CAGE, SUBDIVISION, KEPT, FINE = "cage", "subdivision", "A", "refined"
SHOWS: dict[str, tuple[str, ...]] = {
    "cage | refined": (CAGE, FINE),
    "refined": (FINE,),
    "cage | subdivision | refined": (CAGE, SUBDIVISION, FINE),
    "subdivision | refined": (SUBDIVISION, FINE),
    "A | refined": (KEPT, FINE),
}
"""Columns of each choice, from left to right."""
COLORS = {CAGE: (201, 160, 110), SUBDIVISION: (168, 160, 150), KEPT: (150, 170, 140), FINE: (122, 150, 190)}
TRIM, BODY, FLOOR, SKY, WIRE = (176, 168, 140), (150, 150, 150), (186, 188, 192), (226, 228, 231), (40, 44, 52)
"""Colours, sRGB."""
FLOOR_SIZE = 12.0
"""Half of the floor's width, in the size of what is drawn."""
GAP = 0.1
"""Space between columns, in the size of what is drawn."""
AWAY = 3.8
"""How far off the camera stands, in widths of a column: three are seen."""
SAMPLED = 6
"""Frames whose widths set the columns apart."""
WIRE_PIXELS = 0.8


@dataclass(frozen=True)
class View:
    """How cloth is shown.

    Attributes:
        show: A name of `SHOWS`.
        wiped: Whether the first and the last column stand at one place, the first left of the wipe.
        wipe: Where the wipe stands, 0 to 1 from left to right.
        wires: Whether the edges of the meshes are drawn.
        map: A name of `maps.NAMES`.
    """

    show: str = next(iter(SHOWS))
    wiped: bool = False
    wipe: float = 0.5
    wires: bool = False
    map: str = PLAIN

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns, from left to right."""
        found = SHOWS[self.show]
        return (found[0], found[-1]) if self.wiped and len(found) > 1 else found


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


class Picture:
    """The scene of a session; it is drawn by the thread that owns the session.

    Attributes:
        view: How cloth is shown.
        paintable: Whether the refined garments lie under meshes that cannot be seen, for the mouse to meet: those that
            show a map are made anew with each change of their colours, and miss it meanwhile.
        targets: Handles of those meshes, by number of the garment.
        bar: The map that is drawn, or None.
        stroke: The map under the brush, drawn in place of the session's; or None.
    """

    def __init__(self, server: viser.ViserServer, session: TuneSession) -> None:
        """Set up floor, light and camera about the session's first frame."""
        self.view = View()
        self.bar: Map | None = None
        self.stroke: Stroke | None = None
        self._server, self._scene, self._session = server, server.scene, session
        scene, frame = session.shot.scene, session.shot.frame(session.time)
        points = np.concatenate([each.points for each in frame.garments])
        low, high = points.min(axis=0), points.max(axis=0)
        self.centre, self.size = 0.5 * (low + high), float(np.linalg.norm(high - low))
        up = -scene.gravity / np.linalg.norm(scene.gravity)
        self.right = np.array([0.0, 1.0, 0.0]) if abs(up[0]) > 0.9 else np.array([1.0, 0.0, 0.0])
        times = session.times[:: max(1, len(session.times) // SAMPLED)]
        drawn = [_everything(session.shot.frame(time)) for time in times]
        self._across = max(np.ptp(each @ self.right) for each in drawn) + GAP * self.size
        self._handles: dict[str, tuple[object, Any]] = {}
        self._bindings: dict[int, tuple[int, GarmentBindings]] = {}
        self.paintable = False
        self.targets: dict[int, Any] = {}
        server.scene.set_up_direction(up)
        eye = np.cross(self.right, up) + 0.16 * up
        server.initial_camera.position = max(1.4 * self.size, AWAY * self._across) * eye / np.linalg.norm(eye)
        server.initial_camera.look_at = (0.0, 0.0, 0.0)
        server.initial_camera.fov = np.radians(38.0)
        light(server.scene, drawn[0] - self.centre, right=self.right, up=up)

    def draw(self, shown: Shown, *, kept: Shown | None = None) -> None:
        """Draw a frame; ``kept`` is A's."""
        with self._server.atomic():  # Pictures between two states are never drawn.
            self.bar = None
            columns = self.view.columns
            named = set[str]()
            for place, column in enumerate(columns):
                at = self._offset(place, len(columns))
                for index in range(len(shown.points)):
                    named |= self._draw_garment(shown, kept, index, column=column, at=at)
                    named |= self._draw_trims(shown, index, at=at) if column == FINE else set()
                if not (self.view.wiped and place):
                    named |= self._draw_bodies(shown.frame, column, at=at)
            for name in self._handles.keys() - named:
                self._handles.pop(name)[1].remove()
            found = {index: self._handles.get(f"target/{index}") for index in range(len(shown.points))}
            self.targets = {index: each[1] for index, each in found.items() if each is not None}

    def move(self, points: Mapping[str, np.ndarray]) -> None:
        """Draw refined garments at new positions [m], by path; a map's colours, wires and a wipe follow in `draw`."""
        at = self._offset(len(self.view.columns) - 1, len(self.view.columns))
        for path, each in points.items():
            name = f"{FINE}/{self._session.garments.index(path)}"
            key, handle = self._handles.get(name, (None, None))
            if handle is not None and isinstance(key, tuple) and key[0] == "plain" and key[1] == len(each):
                handle.vertices = self._placed(each, at)

    def world(self, point: np.ndarray) -> np.ndarray:
        """The place [m] in the shot of a point on the refined cloth that is drawn."""
        count = len(self.view.columns)
        return point + self.centre - self._offset(count - 1, count)

    def _offset(self, place: int, count: int) -> np.ndarray:
        """How far a column stands from the middle [m]."""
        return np.zeros(3) if self.view.wiped else (place - 0.5 * (count - 1)) * self._across * self.right

    def _placed(self, points: np.ndarray, at: np.ndarray) -> np.ndarray:
        return (points - self.centre + at).astype(np.float32)

    def _draw_garment(self, shown: Shown, kept: Shown | None, index: int, *, column: str, at: np.ndarray) -> set[str]:
        """Draw a garment in a column; returns the names of what is drawn."""
        sheet = self._sheet(shown, kept, index, column)
        if sheet is None:
            return set()
        found = None
        if column == FINE:
            found = find_map(self._session, shown, index, self.view.map, stroke=self.stroke)
        colors = None if found is None else self._colored(*found)
        sheet = self._wiped(sheet, column, _everything(shown.frame))
        name = f"{column}/{index}"
        self._place(name, sheet, COLORS[column], at=at, flat=column == CAGE, colors=colors)
        if column == FINE and self.paintable:
            self._place(f"target/{index}", sheet, COLORS[column], at=at, opacity=0.0)
            return {name, f"target/{index}"}
        return {name} | (self._draw_wires(name, sheet, at=at) if self.view.wires else set())

    def _colored(self, found: Map, values: np.ndarray) -> np.ndarray:
        self.bar = found
        return found.colors(values)

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
        low, high = (drawn @ self.right).min(), (drawn @ self.right).max()
        line = low + self.view.wipe * (high - low)
        first = column == self.view.columns[0]

        def chosen(corners: np.ndarray) -> np.ndarray:
            at = (sheet.points @ self.right)[corners].mean(axis=1)
            return corners[(at < line) == first]

        return replace(sheet, triangles=chosen(sheet.triangles), edges=chosen(sheet.edges))

    def _draw_wires(self, name: str, sheet: Sheet, *, at: np.ndarray) -> set[str]:
        name, segments = f"{name}/wires", self._placed(sheet.points, at)[sheet.edges]
        known, handle = self._handles.pop(name, (None, None))
        if handle is not None and known == len(segments):
            handle.points = segments
        elif len(segments):
            handle = self._scene.add_line_segments(
                name, segments, WIRE, thickness=WIRE_PIXELS, thickness_units="screen"
            )
        elif handle is not None:
            handle.remove()
        if len(segments):
            self._handles[name] = len(segments), handle
        return {name}

    def _draw_trims(self, shown: Shown, index: int, *, at: np.ndarray) -> set[str]:
        """Draw the meshes that hang on a refined garment; returns the names of what is drawn."""
        points, steps, named = shown.points[index], self._session.refinements[index], set[str]()
        if points is None:
            return named
        if index not in self._bindings or self._bindings[index][0] != len(steps):
            self._bindings[index] = len(steps), GarmentBindings(self._session.shot, index, steps)
        for placed in self._bindings[index][1].at(shown.frame.time, points):
            if placed.target.mesh is not None:
                name, mesh = f"trim/{index}/{placed.target.path}", placed.target.mesh
                sheet = Sheet(placed.points, mesh.triangulate(placed.target.points).triangles, np.empty((0, 2), int))
                self._place(name, self._wiped(sheet, FINE, _everything(shown.frame)), TRIM, at=at)
                named.add(name)
        return named

    def _draw_bodies(self, frame: Frame, column: str, *, at: np.ndarray) -> set[str]:
        drawn = {f"body/{column}/{index}": pose for index, pose in _drawn(frame).items()}
        for name, pose in drawn.items():
            self._place(name, Sheet(pose.points, pose.triangles, np.empty((0, 2), int)), BODY, at=at)
        return {*drawn}

    def _place(
        self,
        name: str,
        sheet: Sheet,
        color: tuple[int, int, int],
        *,
        at: np.ndarray,
        flat: bool = False,
        colors: np.ndarray | None = None,
        opacity: float | None = None,
    ) -> None:
        """Show a mesh under a name; of a known mesh only points are sent."""
        known, handle = self._handles.pop(name, (None, None))
        points = self._placed(sheet.points, at)
        kind = "plain" if colors is None else "colored"
        key = (kind, len(points), len(sheet.triangles), sheet.triangles[:1].tobytes())
        if handle is not None and known == key and colors is None:
            if not np.array_equal(handle.vertices, points):
                handle.vertices = points
        elif colors is None:
            look: dict[str, Any] = {"color": color, "flat_shading": flat, "side": "double", "opacity": opacity}
            handle = self._scene.add_mesh_simple(name, points, sheet.triangles, **look)
        elif handle is not None and known == key:
            handle.glb_data = _glb(points, sheet.triangles, colors)
        else:
            handle = self._scene.add_glb(name, _glb(points, sheet.triangles, colors))
        self._handles[name] = key, handle


def light(scene: viser.SceneApi, drawn: np.ndarray, *, right: np.ndarray, up: np.ndarray) -> None:
    """Set up floor, sky, and a key light from the left that rakes over folds; nothing that viser would fetch.

    No shadows: on cloth their bands would look like wrinkles. And no grid: without a graphics card it would take half
    of the time of a picture.

    Args:
        scene: The scene.
        drawn: Points of all that is drawn, about the middle of the cloth [m], shape (N, 3).
        right: Unit vector, shape (3,).
        up: Unit vector, shape (3,).
    """
    size, front = float(np.linalg.norm(np.ptp(drawn, axis=0))), np.cross(right, up)
    scene.configure_environment_map(None)
    scene.configure_default_lights(enabled=False)
    scene.set_background_image(np.full((2, 2, 3), SKY, np.uint8), format="png")
    scene.add_light_hemisphere("sky", sky_color=(255, 255, 255), ground_color=(200, 196, 190), intensity=1.6)
    lights = {"key": (-3.0, 2.0, 1.5, 2.6), "fill": (3.0, 0.5, 1.5, 0.5)}
    for name, (across, above, before, intensity) in lights.items():
        at = size * (across * right + above * up + before * front)
        scene.add_light_directional(name, intensity=intensity, position=tuple(at.tolist()))
    height, wide = float((drawn @ up).min()) - 0.02 * size, FLOOR_SIZE * size
    corners = [height * up + x * wide * right + y * wide * front for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    look: dict[str, Any] = {"color": FLOOR, "side": "double", "cast_shadow": False, "receive_shadow": False}
    scene.add_mesh_simple("floor", np.asarray(corners, np.float32), np.array([[0, 1, 2], [0, 2, 3]]), **look)


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


def _glb(points: np.ndarray, triangles: np.ndarray, colors: np.ndarray) -> bytes:
    """A mesh with a colour at each vertex as GLB: matt, and seen from both sides."""

    def matt(tree: dict[str, Any]) -> None:
        tree["materials"] = [
            {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.9}, "doubleSided": True}
        ]
        tree["meshes"][0]["primitives"][0]["material"] = 0

    drawn = trimesh.Scene(trimesh.Trimesh(points, triangles, vertex_colors=colors, process=False))
    return export_glb(drawn, include_normals=True, tree_postprocessor=matt)
