"""Coarse cloth on the left, fine cloth on the right, and the bodies at both, in viser's scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import trimesh
import viser
from trimesh.exchange.gltf import export_glb

from ..solver.colliders.pose import MeshPose, Pose
from ..solver.scene import Frame
from ..usd.read.bodies import tessellated
from .session import Shown, TuneSession
from .values import painted_on

COARSE, FINE, BODY, FLOOR, SKY = (201, 160, 110), (122, 150, 190), (150, 150, 150), (190, 192, 195), (226, 228, 231)
"""Colours, sRGB."""
LOW, MIDDLE, HIGH = np.array([[36, 64, 142], [222, 222, 218], [178, 24, 43]], float)
"""Colours of a painted map at its least, at the value that changes nothing, and at its most."""
LIT: dict[str, Any] = {"receive_shadow": False}
"""Shadows fall on the floor alone: on cloth their bands would look like wrinkles."""
BOTH, FINE_ONLY = "coarse beside fine", "fine alone"
SHOWS = (BOTH, FINE_ONLY)
PLAIN = "none"


class Picture:
    """The scene of a session; drawn from one thread at a time.

    Attributes:
        shows: One of `SHOWS`.
        map: Painted map shown as colours, a name of `PAINTED`, or `PLAIN`.
    """

    def __init__(self, server: viser.ViserServer, session: TuneSession) -> None:
        """Set up floor, light and camera about the session's first frame."""
        self.shows, self.map = BOTH, PLAIN
        self._scene, self._session = server.scene, session
        scene, frame = session.shot.scene, session.shot.frame(session.time)
        points = np.concatenate([each.points for each in frame.garments])
        low, high = points.min(axis=0), points.max(axis=0)
        self._centre, self._size = 0.5 * (low + high), float(np.linalg.norm(high - low))
        up = -scene.gravity / np.linalg.norm(scene.gravity)
        self._right = np.array([0.0, 1.0, 0.0]) if abs(up[0]) > 0.9 else np.array([1.0, 0.0, 0.0])
        front = np.cross(self._right, up)
        self._apart = 0.62 * (float((points @ self._right).max() - (points @ self._right).min()) + 0.1 * self._size)
        self._handles: dict[str, tuple[tuple[int, int, bool] | None, Any]] = {}
        server.scene.set_up_direction(up)
        eye = front + 0.16 * up
        away = max(1.4 * self._size, 5.6 * self._apart)
        server.initial_camera.position = away * eye / np.linalg.norm(eye)
        server.initial_camera.look_at = (0.0, 0.0, 0.0)
        server.initial_camera.fov = np.radians(38.0)
        self._light(frame, up)

    def draw(self, shown: Shown) -> None:
        """Draw a frame."""
        both = self.shows == BOTH
        parts = zip(shown.frame.garments, shown.points, strict=True)
        for index, (frame, points) in enumerate(parts):
            cage, chain = self._session.shot.scene.garments[index], self._session.refinements[index]
            split = cage.mesh.triangulate(cage.rest).triangles
            coarse = (frame.points, split) if both else None
            fine = None if points is None else (points, chain[-1].mesh.triangulate(None).triangles if chain else split)
            colors = None
            if self.map != PLAIN:
                colors = painted_colors(painted_on(cage, chain, self.map), self.map)
            self._place(f"fine/{index}", fine, FINE, side=both, colors=colors)
            self._place(f"coarse/{index}", coarse, COARSE, side=-both, flat=True)
        for index, pose in enumerate(shown.frame.colliders):
            mesh = None if pose is None else mesh_of(pose)
            self._place(f"body/fine/{index}", mesh, BODY, side=both)
            self._place(f"body/coarse/{index}", mesh if both else None, BODY, side=-both)

    def move(self, points: Mapping[str, np.ndarray]) -> None:
        """Draw garments at new positions [m], by path, unless a painted map colours them."""
        for path, each in points.items():
            index = self._session.garments.index(path)
            key, handle = self._handles.get(f"fine/{index}", (None, None))
            if handle is not None and key is not None and key[0] == len(each) and key[2]:
                handle.vertices = self._shifted(each, side=self.shows == BOTH)

    def _shifted(self, points: np.ndarray, *, side: int) -> np.ndarray:
        """Points moved to the left (-1), the middle (0) or the right (1) of the picture [m], float32."""
        return (points - self._centre + side * self._apart * self._right).astype(np.float32)

    def _place(
        self,
        name: str,
        mesh: tuple[np.ndarray, np.ndarray] | None,
        color: tuple[int, int, int],
        *,
        side: int,
        flat: bool = False,
        colors: np.ndarray | None = None,
    ) -> None:
        """Show a mesh under a name, on a side, or take it away; only points are sent where that is enough."""
        known, handle = self._handles.pop(name, (None, None))
        if mesh is None:
            if handle is not None:
                handle.remove()
            return
        points = self._shifted(mesh[0], side=side)
        key = (len(points), len(mesh[1]), colors is None)
        if handle is not None and known == key and colors is None:
            handle.vertices = points
        elif colors is None:
            look: dict[str, Any] = {"color": color, "flat_shading": flat, "side": "double"} | LIT
            handle = self._scene.add_mesh_simple(name, points, mesh[1], **look)
        else:
            handle = self._scene.add_glb(name, _colored(points, mesh[1], colors), **LIT)
        self._handles[name] = key, handle

    def _light(self, frame: Frame, up: np.ndarray) -> None:
        """Floor, light and sky; nothing that viser would fetch."""
        found = (None if pose is None else mesh_of(pose) for pose in frame.colliders)
        bodies = [mesh[0] for mesh in found if mesh is not None]
        points = np.concatenate([*(each.points for each in frame.garments), *bodies])
        floor = float((points @ up).min() - self._centre @ up) - 0.02 * self._size
        self._scene.configure_environment_map(None)
        self._scene.add_light_hemisphere("sky", sky_color=(255, 255, 255), ground_color=(200, 196, 190), intensity=1.6)
        self._scene.set_background_image(np.full((2, 2, 3), SKY, np.uint8), format="png")
        plane = "xy" if abs(up[2]) > 0.9 else "xz" if abs(up[1]) > 0.9 else "yz"
        self._scene.add_grid(
            "floor",
            plane=plane,
            width=30.0 * self._size,
            height=30.0 * self._size,
            cell_size=0.1,
            section_size=1.0,
            cell_color=(176, 178, 181),
            section_color=(160, 162, 165),
            plane_color=FLOOR,
            plane_opacity=1.0,
            shadow_opacity=0.3,
            fade_distance=12.0 * self._size,
            position=floor * up,
        )


def mesh_of(pose: Pose) -> tuple[np.ndarray, np.ndarray] | None:
    """Points [m], world space, and triangles of a body; None of a plane, which has no end."""
    if isinstance(pose, MeshPose):
        return pose.points, pose.triangles
    if pose.kind == "plane":
        return None
    points, triangles = tessellated(pose.kind, pose.size)
    return points @ pose.turn.T + pose.centre, triangles


def _colored(points: np.ndarray, triangles: np.ndarray, colors: np.ndarray) -> bytes:
    """A mesh with a colour at each vertex as GLB: matt, and seen from both sides."""

    def matt(tree: dict[str, Any]) -> None:
        tree["materials"] = [
            {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.9}, "doubleSided": True}
        ]
        tree["meshes"][0]["primitives"][0]["material"] = 0

    drawn = trimesh.Scene(trimesh.Trimesh(points, triangles, vertex_colors=colors, process=False))
    return export_glb(drawn, include_normals=True, tree_postprocessor=matt)


def painted_colors(values: np.ndarray, name: str) -> np.ndarray:
    """Colours of a map of `PAINTED` from its values, shape (V,): grey where it changes nothing, blue below, red above.

    They are bytes, shape (V, 4).
    """
    neutral = 0.0 if name == "pin" else 1.0
    away = values - neutral
    amount = np.clip(away / max(float(np.abs(away).max()), 1e-6), -1.0, 1.0)[:, None]
    colors = MIDDLE + np.where(amount > 0, amount * (HIGH - MIDDLE), -amount * (LOW - MIDDLE))
    return np.concatenate([colors, np.full_like(amount, 255.0)], axis=1).round().astype(np.uint8)
