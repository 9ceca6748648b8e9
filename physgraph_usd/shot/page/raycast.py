"""Draws triangle meshes on the CPU: one ray per sample, a soft key light and ambient occlusion.

Light is gathered at the vertices and interpolated, which costs the same at every picture size and has no
noise between them. No GPU and no display.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .rays import Rays

KEY = np.array([-0.62, 0.62, 0.48])
"""Direction to the key light in the camera's frame (right, up, towards the viewer)."""

BACKGROUND = np.array([0.80, 0.80, 0.79])
"""Linear colour of the studio."""

AMBIENT_RAYS, KEY_RAYS, RAY_BUDGET = 72, 20, 5_000_000
"""Rays per vertex for each light, and how many to spend on a picture at most."""

GROUND_CELLS = 84
"""The ground gathers light at a square grid with this many cells a side."""


@dataclass(frozen=True, eq=False)
class Surface:
    """One thing to draw.

    Attributes:
        points: Positions, Y up, shape (V, 3).
        triangles: Corners, counter-clockwise seen from outside, shape (T, 3) int32.
        colors: Linear RGB per triangle, shape (T, 3).
        edges: Whether the edge opposite each corner is drawn, shape (T, 3), or None for none.
    """

    points: np.ndarray
    triangles: np.ndarray
    colors: np.ndarray
    edges: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class View:
    """A perspective camera.

    Attributes:
        eye: Position, shape (3,).
        axes: Rows are right, up and backward, shape (3, 3).
        tangent: Half height of the picture at distance 1.
    """

    eye: np.ndarray
    axes: np.ndarray
    tangent: float


class _Light(NamedTuple):
    """Light that reaches each vertex: ambient 0..1 and key 0..1."""

    ambient: np.ndarray
    key: np.ndarray


def fit_view(points: np.ndarray, aspect: float, *, azimuth: float = 25.0, elevation: float = 10.0) -> View:
    """Place a camera so that all points fit.

    Args:
        points: Everything that must be seen, Y up, shape (N, 3).
        aspect: Width over height of the picture.
        azimuth: Camera's angle about Y from +Z towards +X [degrees].
        elevation: Camera's angle above the ground [degrees].

    Returns:
        A long-lens view that looks at the middle of the points.
    """
    a, e = np.radians([azimuth, elevation])
    back = np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])
    right = np.array([np.cos(a), 0.0, -np.sin(a)])
    axes = np.stack([right, np.cross(back, right), back])
    tangent = np.tan(np.radians(11.0))
    room = 0.86 * tangent
    seen = points @ axes.T
    middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
    seen = seen - middle
    reach = np.maximum(np.abs(seen[:, 0]) / (room * aspect), np.abs(seen[:, 1]) / room) + seen[:, 2]
    distance = max(float(reach.max()), 1e-6)
    return View(middle @ axes + distance * back, axes, float(tangent))


def draw(surfaces: list[Surface], view: View, *, size: tuple[int, int], floor: float, samples: int = 2) -> np.ndarray:
    """Draw surfaces on a seamless studio ground.

    Args:
        surfaces: What to draw; may be empty.
        view: The camera.
        size: Width and height [pixels].
        floor: Height of the ground.
        samples: Samples per pixel along each axis.

    Returns:
        sRGB picture, shape (height, width, 3) uint8.
    """
    picture = np.broadcast_to(BACKGROUND.astype(np.float32), (size[1], size[0], 3)).copy()
    surfaces = [each for each in surfaces if _has_area(each.points, each.triangles).any()]
    if surfaces:
        world = _World(surfaces, view)
        if view.eye[1] > floor:
            _draw_ground(picture, view, world, floor)
        _draw_surfaces(picture, view, world, samples)
    return _encode(picture)


def encode_color(color: tuple[float, float, float]) -> tuple[int, int, int]:
    """Convert one linear colour to the 8-bit colour that ``draw`` shows for it."""
    red, green, blue = _encode(np.array(color))
    return int(red), int(green), int(blue)


class _World:
    """All surfaces joined, with smooth normals, gathered light and a ray index."""

    def __init__(self, surfaces: list[Surface], view: View) -> None:
        counts = np.cumsum([0] + [len(s.points) for s in surfaces])
        self.points = np.concatenate([s.points for s in surfaces]).astype(np.float32)
        shifted = [s.triangles + start for s, start in zip(surfaces, counts, strict=False)]
        triangles = np.concatenate(shifted).astype(np.int32)
        seen = _has_area(self.points, triangles)
        self.triangles = triangles[seen]
        self.colors = np.concatenate([s.colors for s in surfaces]).astype(np.float32)[seen]
        blank = [np.zeros(s.triangles.shape, bool) if s.edges is None else s.edges for s in surfaces]
        self.edges = np.concatenate(blank)[seen]
        self.normals = _vertex_normals(self.points, self.triangles)
        self.size = float(np.linalg.norm(np.ptp(self.points, axis=0)))
        self.key = _unit(KEY) @ view.axes
        self.rays = Rays(self.points, self.triangles)
        towards = np.einsum("vk,vk->v", self.normals, view.eye - self.points)
        self.light = self.gather(self.points, np.where(towards[:, None] < 0, -self.normals, self.normals))

    def gather(self, points: np.ndarray, normals: np.ndarray) -> _Light:
        """Light that reaches points with the given normals."""
        share = min(1.0, RAY_BUDGET / (max(len(points), 1) * (AMBIENT_RAYS + KEY_RAYS)))
        origins = points + 4e-4 * self.size * normals
        first, second = _frames(normals)
        ambient = np.zeros(len(points), np.float32)
        count = max(6, int(AMBIENT_RAYS * share))
        for x, y, z in _hemisphere(count):
            ambient += self.rays.free(origins, x * first + y * second + z * normals)
        key = np.zeros(len(points), np.float32)
        total = max(4, int(KEY_RAYS * share))
        side, up = _frames(self.key[None])
        for x, y in _disk(total):
            direction = _unit(self.key + 0.16 * (x * side[0] + y * up[0]))
            key += self.rays.free(origins, np.broadcast_to(direction, points.shape))
        return _Light(ambient / count, key / total)


def _draw_ground(picture: np.ndarray, view: View, world: _World, floor: float) -> None:
    """Darken the studio where the ground is shadowed."""
    height, width = picture.shape[:2]
    directions = _directions(view, (width, height), (0, 0, width, height), 1)
    down = np.flatnonzero(directions[:, 1] < -1e-4)
    travel = (floor - view.eye[1]) / directions[down, 1]
    spot = view.eye[[0, 2]] + travel[:, None] * directions[down][:, [0, 2]]
    low, high = world.points.min(axis=0)[[0, 2]], world.points.max(axis=0)[[0, 2]]
    centre, half = 0.5 * (low + high), 1.1 * max(float(np.max(high - low)), 0.6 * world.size)
    side = np.linspace(-half, half, GROUND_CELLS + 1)
    x, z = np.meshgrid(side, side, indexing="ij")
    nodes = np.stack([centre[0] + x.ravel(), np.full(x.size, floor), centre[1] + z.ravel()], axis=1)
    light = world.gather(nodes.astype(np.float32), np.broadcast_to(np.array([0, 1, 0], np.float32), nodes.shape))
    shade = (0.62 * light.ambient + 0.38 * light.key).reshape(x.shape)
    fade = np.clip(2.6 * (1.0 - np.sqrt(x * x + z * z) / half), 0.0, 1.0)
    shade = 1.0 + fade * fade * (3 - 2 * fade) * (0.30 + 0.70 * shade - 1.0)
    at = (spot - centre + half) / (2 * half) * GROUND_CELLS
    picture.reshape(-1, 3)[down] *= _bilinear(shade, at)[:, None]


def _draw_surfaces(picture: np.ndarray, view: View, world: _World, samples: int) -> None:
    """Shade the samples whose rays meet a surface, over what is already drawn."""
    height, width = picture.shape[:2]
    box = _covered(view, world.points, (width, height))
    left, top, right, bottom = box
    if right <= left or bottom <= top:
        return
    directions = _directions(view, (width, height), box, samples)
    found = world.rays.first(np.broadcast_to(view.eye, directions.shape), directions)
    hit = np.flatnonzero(found.face >= 0)
    area = picture[top:bottom, left:right]
    fine = np.repeat(np.repeat(area, samples, axis=0), samples, axis=1).reshape(-1, 3)
    pixel = 2.0 * view.tangent / height * found.distance[hit]
    fine[hit] = _color(world, found.face[hit], found.weights[hit], -directions[hit], pixel)
    area[:] = fine.reshape(bottom - top, samples, right - left, samples, 3).mean(axis=(1, 3))


def _color(world: _World, face: np.ndarray, weights: np.ndarray, to_eye: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """Colour of points on faces; ``pixel`` is the size of a pixel there."""
    corners = world.triangles[face]
    normal = _unit(np.einsum("hc,hck->hk", weights, world.normals[corners]))
    inside = np.einsum("hk,hk->h", normal, to_eye) < 0
    normal[inside] *= -1
    ambient = np.einsum("hc,hc->h", weights, world.light.ambient[corners])
    key = np.einsum("hc,hc->h", weights, world.light.key[corners])
    color = _shade(world, normal, to_eye, ambient, key) * world.colors[face]
    color[inside] *= 0.72
    sheen = 0.05 * ambient * (1.0 - np.einsum("hk,hk->h", normal, to_eye)).clip(0, 1) ** 3
    color += sheen[:, None]
    return color * (1.0 - 0.38 * _line(world, face, weights, pixel)[:, None])


def _shade(world: _World, normal: np.ndarray, to_eye: np.ndarray, ambient: np.ndarray, key: np.ndarray) -> np.ndarray:
    """Key, sky and a weak light from the viewer, as a factor of the colour, shape (H, 3)."""
    lambert = np.einsum("hk,k->h", normal, world.key).clip(0, 1) * key
    sky = ambient * (0.75 + 0.25 * normal[:, 1])
    front = ambient * np.einsum("hk,hk->h", normal, to_eye).clip(0, 1)
    warm, cool = np.array([1.04, 1.0, 0.95], np.float32), np.array([0.95, 1.0, 1.06], np.float32)
    return 0.98 * lambert[:, None] * warm + (0.36 * sky + 0.10 * front)[:, None] * cool


def _line(world: _World, face: np.ndarray, weights: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """1 on drawn edges, 0 a pixel away from them, shape (H,)."""
    line = np.zeros(len(face), np.float32)
    lined = np.flatnonzero(np.any(world.edges[face], axis=1))
    face = face[lined]
    corners = world.points[world.triangles[face]]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    opposite = np.linalg.norm(np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1), axis=2)
    heights = area[:, None] / np.maximum(opposite, 1e-20)
    distance = weights[lined] * heights / pixel[lined, None]
    line[lined] = np.clip(1.1 - np.where(world.edges[face], distance, np.inf).min(axis=1), 0.0, 1.0)
    return line


def _covered(view: View, points: np.ndarray, size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Left, top, right and bottom pixel of the box that the points cover; everything when some are behind the eye."""
    seen = (points - view.eye) @ view.axes.T
    if np.any(seen[:, 2] > -1e-9):
        return 0, 0, size[0], size[1]
    scale = 0.5 * size[1] / view.tangent
    across, down = -scale * seen[:, 0] / seen[:, 2], scale * seen[:, 1] / seen[:, 2]
    low = np.floor([0.5 * size[0] + across.min(), 0.5 * size[1] + down.min()]).astype(int)
    high = np.ceil([0.5 * size[0] + across.max(), 0.5 * size[1] + down.max()]).astype(int)
    (left, top), (right, bottom) = np.clip(low, 0, size), np.clip(high, 0, size)
    return int(left), int(top), int(right), int(bottom)


def _directions(view: View, size: tuple[int, int], box: tuple[int, int, int, int], samples: int) -> np.ndarray:
    """Unit ray directions of all samples of a box of pixels, row by row, float32."""
    left, top, right, bottom = box
    x = (left + (np.arange((right - left) * samples) + 0.5) / samples) * 2.0 - size[0]
    y = size[1] - (top + (np.arange((bottom - top) * samples) + 0.5) / samples) * 2.0
    scale = view.tangent / size[1]
    across = (scale * x[:, None] * view.axes[0]).astype(np.float32)
    down = (scale * y[:, None] * view.axes[1] - view.axes[2]).astype(np.float32)
    return _unit((down[:, None, :] + across[None, :, :]).reshape(-1, 3))


def _vertex_normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Area-weighted unit normals, shape (V, 3)."""
    corners = points[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = triangles.ravel()
    spread = np.repeat(normal, 3, axis=0)
    total = np.stack([np.bincount(flat, spread[:, k], minlength=len(points)) for k in range(3)], axis=1)
    return _unit(total).astype(np.float32)


def _has_area(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Which triangles can be seen: thousands in one place, which nothing shows, would each be tried for each ray."""
    corners = points.astype(np.float32)[triangles].astype(np.float64)
    return np.asarray(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).any(axis=1))


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Scale to length 1; zero stays zero."""
    length = np.sqrt(np.einsum("...k,...k->...", vectors, vectors))[..., None]
    return vectors / np.maximum(length, 1e-20)


def _frames(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across each normal."""
    helper = np.where(np.abs(normals[:, :1]) < 0.7, np.eye(3, dtype=np.float32)[:1], np.eye(3, dtype=np.float32)[1:2])
    first = _unit(np.cross(normals, helper))
    return first, np.cross(normals, first)


def _disk(count: int) -> np.ndarray:
    """Evenly spread points in the unit disk (sunflower), shape (count, 2)."""
    i = np.arange(count)
    radius, angle = np.sqrt((i + 0.5) / count), i * np.pi * (3.0 - np.sqrt(5.0))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def _hemisphere(count: int) -> np.ndarray:
    """Cosine-distributed unit directions about +Z, shape (count, 3)."""
    flat = _disk(count)
    return np.concatenate([flat, np.sqrt(1.0 - (flat**2).sum(axis=1, keepdims=True))], axis=1)


def _bilinear(grid: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Interpolate a grid at (row, column) positions, held at its border."""
    limit = np.array(grid.shape) - 1
    at = np.clip(at, 0, limit - 1e-6)
    low = at.astype(int)
    row, column = (at - low).T
    i, j = low.T
    top = grid[i, j] * (1 - column) + grid[i, j + 1] * column
    bottom = grid[i + 1, j] * (1 - column) + grid[i + 1, j + 1] * column
    return top * (1 - row) + bottom * row


def _encode(linear: np.ndarray) -> np.ndarray:
    """Linear to 8-bit sRGB."""
    value = np.clip(linear, 0.0, 1.0)
    encoded = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
    return np.round(255.0 * encoded).astype(np.uint8)
