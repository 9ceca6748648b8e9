"""Light in the page's scene: viser's lights, and vertex colours that hold the soft shadows of `preview`'s pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import trimesh
import viser
from trimesh.exchange.gltf import export_glb
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from ..shot.page.drawing import BACKGROUND, KEY, Surface, encode_color, ground_below, ground_shadow, soft_light

SKY, KEY_LIGHT, FILL = 1.5, 2.6, 0.3
"""Intensities of viser's lights; the soft shadows take the same parts away."""
GROUND_DROP = 0.02
"""How far the ground lies below all points, in their size: cloth does not dip into the ground."""

BLACK: dict[str, Any] = {"baseColorFactor": [0, 0, 0, 255], "metallicFactor": 1.0, "alphaMode": "BLEND"}
"""A material that reflects nothing, for the ground's shadow: the vertices' alpha."""


def add_lights(scene: viser.SceneApi, axes: np.ndarray) -> None:
    """Set up the background, a sky, a key light and a fill light; viser fetches nothing for them.

    Args:
        scene: The scene.
        axes: Rows are right, up and towards the viewer, shape (3, 3).
    """
    scene.configure_environment_map(None)
    scene.configure_default_lights(enabled=False)
    backdrop = np.full((2, 2, 3), encode_color(tuple(BACKGROUND)), np.uint8)
    scene.set_background_image(backdrop, format="png")
    scene.add_light_hemisphere("sky", sky_color=(255, 255, 255), ground_color=(190, 186, 180), intensity=SKY)
    for name, way, intensity in (("key", KEY, KEY_LIGHT), ("fill", KEY * (-1.0, 0.3, 1.0), FILL)):
        scene.add_light_directional(name, intensity=intensity, position=tuple((10.0 * way @ axes).tolist()))


def light_on(
    columns: Sequence[Sequence[tuple[np.ndarray, np.ndarray]]], axes: np.ndarray, cancelled: Callable[[], bool]
) -> list[tuple[list[np.ndarray], bytes]] | None:
    """Soft light on columns of meshes, none of which shades another column's meshes; None if ``cancelled``.

    For each column the fractions of viser's light that arrive at its meshes' vertices, each of shape (V,), and the
    GLB of the ground below them, which is seen by its shadows alone.

    Args:
        columns: For each column its meshes: positions [m], shape (V, 3), and triangles, shape (T, 3).
        axes: Rows are right, up and towards the viewer, shape (3, 3).
    """
    towards = KEY / np.linalg.norm(KEY)
    found = []
    for meshes in columns:
        points = np.concatenate([points for points, _ in meshes]) @ axes.T
        starts = np.cumsum([0] + [len(points) for points, _ in meshes])
        triangles = np.concatenate([each + start for (_, each), start in zip(meshes, starts, strict=False)])
        solid = Surface(points, triangles.astype(np.int32), np.zeros((0, 3)))
        floor = float(points[:, 1].min()) - GROUND_DROP * float(np.linalg.norm(np.ptp(points, axis=0)))
        ground = ground_below(points, floor)
        light = soft_light(solid, ground, visible=points, towards=towards, cancelled=cancelled)
        if cancelled():
            return None
        parts = [slice(*ends) for ends in pairwise(starts)]
        factors = [_fraction(light.normals[part], light.sky[:, part], light.key[:, part]) for part in parts]
        shadow = np.zeros((len(ground.points), 4))
        shadow[:, 3] = ground_shadow(ground, light)
        found.append((factors, as_glb(ground.points @ axes, ground.triangles, shadow, **BLACK)))
    return found


def _fraction(normals: np.ndarray, sky: np.ndarray, key: np.ndarray) -> np.ndarray:
    """Fraction of viser's light at a mesh's vertices, shape (V,), on its outer side: the one that sees more sky."""
    outer = int(sky[1].mean() > sky[0].mean())
    facing = normals if outer == 0 else -normals
    direct = KEY_LIGHT * (facing @ (KEY / np.linalg.norm(KEY))).clip(0, 1)
    return (SKY * sky[outer] + direct * key[outer] + FILL) / (SKY + direct + FILL)


def as_glb(
    points: np.ndarray, triangles: np.ndarray, colors: np.ndarray, *, flat: bool = False, **material: Any
) -> bytes:
    """A mesh with a colour at each vertex as GLB: matt, and seen from both sides.

    Args:
        points: Positions, shape (V, 3).
        triangles: Shape (T, 3).
        colors: Linear RGBA, 0 to 1, shape (V, 4); they multiply the material's ``baseColorFactor``.
        flat: Whether faces are shaded flat.
        material: Of trimesh's `PBRMaterial`.
    """
    matt = {"metallicFactor": 0.0, "roughnessFactor": 0.9, "doubleSided": True}
    visual = TextureVisuals(material=PBRMaterial(**matt | material))
    visual.vertex_attributes["color"] = np.round(255.0 * colors.clip(0.0, 1.0)).astype(np.uint8)
    up = np.tile(np.array([0.0, 0.0, 1.0]), (len(points), 1))  # The page computes normals itself.
    mesh = trimesh.Trimesh(points, triangles, vertex_normals=up, visual=visual, process=False, validate=False)
    return export_glb(trimesh.Scene(mesh), include_normals=not flat)


def to_linear(color: np.ndarray | tuple[int, int, int]) -> np.ndarray:
    """Linear colour, 0 to 1, of sRGB bytes."""
    value = np.asarray(color, float) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
