"""Meshes in viser's scene that follow moves at once, and get their light, shadows and maps when they rest.

viser moves a plain mesh in place but gives it one colour only. A mesh with colours at its vertices is loaded anew with
each change, and misses a few pictures meanwhile. So each mesh is drawn plain while it moves; at rest a coloured one,
its skin, is loaded over it, and the plain one is hidden once the skin must be there.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection
from dataclasses import dataclass
from itertools import count

import numpy as np
import viser

from ..shot.page.drawing import encode_color
from .light import as_glb, light_on, to_linear

LOADED_SECONDS, SURE_SECONDS = 0.25, 3.0
"""How long a browser takes to load a skin, and how long at most: until then the skin before, and the plain mesh, are
drawn under it. Where both are as deep the skin is seen, which is drawn last."""


@dataclass(frozen=True, eq=False)
class Placed:
    """A mesh as drawn.

    Attributes:
        points: Positions in the scene [m], shape (V, 3) float32.
        triangles: Drawn triangles, shape (T, 3).
        whole: Triangles that occlude light, shape (W, 3).
        color: Linear RGB, shape (3,).
        colors: sRGB bytes of a map at the vertices, shape (V, 4); or None.
        flat: Whether faces are shaded flat.
    """

    points: np.ndarray
    triangles: np.ndarray
    whole: np.ndarray
    color: np.ndarray
    colors: np.ndarray | None = None
    flat: bool = False


Skin = tuple[viser.GlbHandle, tuple[np.ndarray, ...]]
"""viser's handle of a coloured mesh over a plain one, and its positions, triangles and linear colours, shape (V, 4)."""


class Skins:
    """The meshes of a scene by name, plain and with skins.

    Attributes:
        meshes: Handles of the plain meshes.
        touched: Names of the meshes that the mouse must meet, though their skins hide them.
    """

    def __init__(self, server: viser.ViserServer, axes: np.ndarray) -> None:
        """Draw nothing; the rows of ``axes`` are right, up and towards the viewer, shape (3, 3)."""
        self.meshes: dict[str, viser.MeshHandle] = {}
        self.touched: Collection[str] = ()
        self._server, self._scene, self._axes = server, server.scene, axes
        self._placed: dict[str, Placed] = {}
        self._skins: dict[str, Skin] = {}
        self._light: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self._grounds: list[viser.GlbHandle] = []
        self._serial, self._lock = count(), threading.RLock()

    def place(self, name: str, mesh: Placed) -> None:
        """Draw a mesh under a name; of a known one only what changed is sent."""
        before = self._placed.get(name)
        if before is None or not np.array_equal(before.triangles, mesh.triangles):
            self.remove(name)
            self.meshes[name] = self._scene.add_mesh_simple(
                name,
                mesh.points,
                mesh.triangles,
                side="double",
                color=encode_color(tuple(mesh.color)),
                flat_shading=mesh.flat,
            )
        elif not np.array_equal(self.meshes[name].vertices, mesh.points):
            self.move(name, mesh.points)
        self._placed[name] = mesh
        self._dress(name)

    def move(self, name: str, points: np.ndarray) -> None:
        """Draw a mesh at other positions [m], shape (V, 3), without skin."""
        self._undress(name)
        self.meshes[name].vertices = points

    def keep(self, names: Collection[str]) -> None:
        """Draw meshes of other names no more."""
        for name in self.meshes.keys() - {*names}:
            self.remove(name)

    def remove(self, name: str) -> None:
        """Draw a mesh no more."""
        self._undress(name)
        self._placed.pop(name, None)
        if (handle := self.meshes.pop(name, None)) is not None:
            handle.remove()

    def shade(self, columns: Collection[Collection[str]], cancelled: Callable[[], bool], *, grounds: int) -> None:
        """Light the named meshes of each column and the ground below; without effect if ``cancelled`` meanwhile.

        Args:
            columns: Names of the meshes of each column.
            cancelled: Asked before each map of light.
            grounds: Number of columns whose ground is drawn, from the first; grounds at one place darken one another.
        """
        if all(self._is_lit(name) for column in columns for name in column):
            return
        meshes = [[(self._placed[name].points, self._placed[name].whole) for name in column] for column in columns]
        found = light_on(meshes, self._axes, cancelled)
        if found is None:
            return
        with self._server.atomic():
            for column, (factors, _) in zip(columns, found, strict=True):
                for name, factor in zip(column, factors, strict=True):
                    self._light[name] = self._placed[name].points, factor
                    self._dress(name)
                    self.meshes[name].color = encode_color(tuple(self._placed[name].color * factor.mean()))
            for ground in self._grounds:
                self._later(ground.remove, LOADED_SECONDS)
            self._grounds = [
                self._scene.add_glb(f"ground-{next(self._serial)}", ground) for _, ground in found[:grounds]
            ]

    def _is_lit(self, name: str) -> bool:
        lit = self._light.get(name)
        return lit is not None and np.array_equal(lit[0], self._placed[name].points)

    def _dress(self, name: str) -> None:
        """Load a mesh's skin, if it has a map or is lit."""
        mesh, (_, factor) = self._placed[name], self._light.get(name, (None, np.zeros(0)))
        if mesh.colors is None and not self._is_lit(name):
            return self._undress(name)
        colors = np.ones((len(mesh.points), 4))
        colors[:, :3] *= factor[:, None] if len(factor) == len(mesh.points) else 1.0
        colors[:, :3] *= 1.0 if mesh.colors is None else to_linear(mesh.colors[:, :3])
        before, drawn = self._skins.get(name), (mesh.points, mesh.triangles, colors)
        if before is not None and all(map(np.array_equal, before[1], drawn)):
            return self._later(lambda: self._conceal(name, before), SURE_SECONDS)
        base = [*(mesh.color if mesh.colors is None else np.ones(3)), 1.0]
        data = as_glb(mesh.points, mesh.triangles, colors, flat=mesh.flat, baseColorFactor=base)
        skin = self._scene.add_glb(f"skin-{next(self._serial)}", data), drawn
        with self._lock:
            self._skins[name] = skin
            self._show(name, opacity=None, visible=True)
        if before is not None:
            self._later(before[0].remove, LOADED_SECONDS)
        self._later(lambda: self._conceal(name, skin), SURE_SECONDS)

    def _undress(self, name: str) -> None:
        """Draw a mesh plain."""
        with self._lock:
            if (skin := self._skins.pop(name, None)) is not None:
                skin[0].remove()
            if name in self.meshes:
                self._show(name, opacity=None, visible=True)

    def _conceal(self, name: str, skin: Skin) -> None:
        """Hide a plain mesh; meshes in `touched` become transparent instead, and the mouse still hits them."""
        with self._lock:
            if self._skins.get(name) is skin:
                touched = name in self.touched
                self._show(name, opacity=0.0 if touched else None, visible=touched)

    def _show(self, name: str, *, opacity: float | None, visible: bool) -> None:
        mesh = self.meshes[name]
        if (mesh.opacity, mesh.visible) != (opacity, visible):
            mesh.opacity, mesh.visible = opacity, visible

    def _later(self, call: Callable[[], None], seconds: float) -> None:
        """Have a function called once browsers have loaded what was sent."""
        loop = self._server.get_event_loop()
        loop.call_soon_threadsafe(loop.call_later, seconds, call)
