"""Draws triangle meshes on the CPU: a z-buffer, a soft key light and light from the whole sky.

One kernel fills depth maps, for the eye and for each direction of light. A vertex is lit from a direction if no surface
occludes the vertex in the direction's map. Light is interpolated between the vertices. No GPU or display is needed.
"""

# Warp reads a kernel's annotations itself; to a type checker they are calls, and vectors have no operators.
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportIndexIssue=false, reportCallIssue=false

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy import sparse
from scipy.ndimage import uniform_filter

from ...solver.mesh.kernels import KERNELS, start_warp
from ...solver.mesh.threads import run
from ...usd.read.meshes import DrawnMesh

wp.set_module_options(KERNELS)

KEY, KEY_WIDTH = np.array([-0.62, 0.62, 0.48]), 0.16
"""Direction to the key light in the camera's frame (right, up, towards the viewer), and its radius at distance 1."""

BACKGROUND = np.array([0.80, 0.80, 0.79])
"""Linear colour of the studio."""

CLOTH_COLOR, BODY_COLOR = (0.73, 0.61, 0.44), (0.30, 0.30, 0.31)
"""Linear colours of cloth and of other meshes without a colour of their own: a light warm one and a grey."""

SKY_MAPS, SKY_SIZE = 12, 256
"""Depth maps of the sky, each for a pair of opposite directions, and the width of a map [pixels]."""

KEY_MAPS, KEY_SIZE = 6, 512
"""Depth maps of the key light, and the width of a map [pixels]: larger, because only key shadows have visible edges."""

LIGHT_BLUR, LIGHT_WIDTH = 16, 0.01
"""Averages over neighbours of the light at the vertices, and how near these are, in the visible size: the edge of a
map's shadow is no step of brightness."""

GROUND_CELLS, GROUND_BLUR = 84, 5
"""Cells along a side of the ground's square grid, and width in cells of the blur of the ground's light."""

FAR = wp.constant(wp.float32(1e30))
"""Depth of an empty pixel."""

EDGE = wp.constant(wp.float32(1e-4))
"""Relative enlargement of a drawn triangle, against rounding: no pixel gaps between neighbours."""


@dataclass(frozen=True, eq=False)
class Surface:
    """One mesh to draw.

    Attributes:
        points: Positions, Y up, shape (V, 3).
        triangles: Corners, counter-clockwise seen from outside, shape (T, 3) int32.
        colors: Linear RGB per triangle, shape (T, 3).
    """

    points: np.ndarray
    triangles: np.ndarray
    colors: np.ndarray


@dataclass(frozen=True, eq=False)
class View:
    """A perspective camera.

    Attributes:
        eye: Position, shape (3,).
        axes: Rows are right, up and backward, shape (3, 3).
        tangent: Half height of the picture at distance 1.
        nearest: Near clipping distance.
    """

    eye: np.ndarray
    axes: np.ndarray
    tangent: float
    nearest: float = 1e-9

    def project(self, points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """Column and row [pixels] and minus the inverse distance, which is linear in the picture, shape (N, 3).

        NaN for a point too near or behind the eye.
        """
        seen = (points - self.eye) @ self.axes.T
        inverse = 1.0 / np.minimum(seen[:, 2], -self.nearest)
        scale = 0.5 * size[1] / self.tangent
        column, row = 0.5 * size[0] - scale * seen[:, 0] * inverse, 0.5 * size[1] + scale * seen[:, 1] * inverse
        return np.where(seen[:, 2:] < -self.nearest, np.stack([column, row, inverse], axis=1), np.nan)


def fit_view(points: np.ndarray, aspect: float, *, azimuth: float = 25.0, elevation: float = 10.0) -> View:
    """Place a camera so that all points fit.

    Args:
        points: Points to show, Y up, shape (N, 3).
        aspect: Width over height of the picture.
        azimuth: Camera's angle about Y from +Z towards +X [degrees].
        elevation: Camera's angle above the ground [degrees].

    Returns:
        A long-lens view centred on the points.
    """
    a, e = np.radians([azimuth, elevation])
    back = np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])
    right = np.array([np.cos(a), 0.0, -np.sin(a)])
    axes = np.stack([right, np.cross(back, right), back])
    tangent = np.tan(np.radians(11.0))
    middle, distance = framed(points @ axes.T, aspect, room=0.86 * tangent)
    return View(middle @ axes + distance * back, axes, float(tangent))


def framed(seen: np.ndarray, aspect: float, *, room: float) -> tuple[np.ndarray, float]:
    """The middle of points, shape (3,), and the distance from there at which a camera sees them all.

    Args:
        seen: Points along the picture's right and up and towards the camera, shape (N, 3).
        aspect: Width over height of the picture.
        room: Half height of the points' part of the picture at distance 1.
    """
    middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
    seen = seen - middle
    reach = np.maximum(np.abs(seen[:, 0]) / (room * aspect), np.abs(seen[:, 1]) / room) + seen[:, 2]
    return middle, max(float(reach.max()), 1e-6)


def draw(surfaces: Sequence[Surface | DrawnMesh], view: View, *, size: tuple[int, int], floor: float) -> np.ndarray:
    """Draw surfaces on a seamless studio ground.

    Args:
        surfaces: Meshes to draw; may be empty.
        view: The camera.
        size: Width and height [pixels].
        floor: Height of the ground, which is drawn behind all surfaces.

    Returns:
        sRGB picture, shape (height, width, 3) uint8.
    """
    start_warp()
    surfaces = [surface for surface in surfaces if len(surface.triangles)]
    picture = np.tile(BACKGROUND.astype(np.float32), (2 * size[1], 2 * size[0], 1))  # Four samples a pixel.
    if surfaces:
        solid = _joined(surfaces)
        ground = ground_below(solid.points, floor if view.eye[1] > floor > -np.inf else None)
        drawn = _joined([solid, ground])
        seen = view.project(drawn.points, (picture.shape[1], picture.shape[0]))
        visible = drawn.points[_in_view(seen, solid.triangles, picture)]
        if len(visible):
            shade = _shade(solid, ground, view, visible)
            seen[len(solid.points) :, 2] = 0.0
            _rasterize(seen, drawn.triangles, _depths(*picture.shape[:2]), colored=(shade, drawn.colors, picture))
    rows = picture[::2] + picture[1::2]
    return _encode((rows[:, ::2] + rows[:, 1::2]) / 4.0)


def encode_color(color: tuple[float, float, float]) -> tuple[int, int, int]:
    """Convert a linear colour to the 8-bit colour drawn by ``draw``."""
    red, green, blue = _encode(np.array(color))
    return int(red), int(green), int(blue)


def _joined(surfaces: Sequence[Surface | DrawnMesh]) -> Surface:
    starts = np.cumsum([0] + [len(surface.points) for surface in surfaces])
    triangles = [surface.triangles + start for surface, start in zip(surfaces, starts, strict=False)]
    parts = [surface.points for surface in surfaces], triangles, [surface.colors for surface in surfaces]
    return Surface(*(np.concatenate(part) for part in parts))


def ground_below(points: np.ndarray, floor: float | None) -> Surface:
    """A square of cells at a height below points, shape (N, 3); without triangles where the floor is None."""
    low, high = points.min(axis=0)[[0, 2]], points.max(axis=0)[[0, 2]]
    half = 1.1 * max(float(np.max(high - low)), 0.6 * float(np.linalg.norm(np.ptp(points, axis=0))))
    side = np.linspace(-half, half, GROUND_CELLS + 1)
    x, z = 0.5 * (low + high)[:, None, None] + np.meshgrid(side, side, indexing="ij")
    nodes = np.stack([x, np.full_like(x, floor or 0.0), z], axis=2)
    number = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (corner.ravel() for corner in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    triangles = triangles[: 0 if floor is None else None]
    return Surface(nodes.reshape(-1, 3), triangles, np.tile(BACKGROUND, (len(triangles), 1)))


def _in_view(seen: np.ndarray, triangles: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """Numbers of the triangles' vertices possibly in the picture."""
    columns, rows = seen[:, 0][triangles.T], seen[:, 1][triangles.T]
    right, below = columns.min(axis=0) > picture.shape[1], rows.min(axis=0) > picture.shape[0]
    inside = (columns.max(axis=0) >= 0) & (rows.max(axis=0) >= 0) & ~right & ~below
    mask = np.zeros(len(seen), bool)
    mask[triangles[inside]] = True
    return np.flatnonzero(mask)


def _shade(solid: Surface, ground: Surface, view: View, visible: np.ndarray) -> np.ndarray:
    """Shading factors at each vertex of the surfaces and the ground: all fronts, then all backs, shape (2 N, 3)."""
    towards = _unit(KEY) @ view.axes
    lit = soft_light(solid, ground, visible=visible, towards=towards)
    facing, sky, key = np.concatenate([lit.normals, -lit.normals]), lit.sky.ravel(), lit.key.ravel()
    spots = np.tile(np.concatenate([solid.points, ground.points]), (2, 1))
    front = np.einsum("vk,vk->v", facing, _unit(view.eye - spots)).clip(0, 1)
    warm, cool = np.array([1.04, 1.0, 0.95]), np.array([0.95, 1.0, 1.06])
    shade = (0.98 * (facing @ towards).clip(0, 1) * key)[:, None] * warm
    shade += (sky * (0.36 * (0.75 + 0.25 * facing[:, 1]) + 0.10 * front))[:, None] * cool
    shade[len(lit.normals) :] *= 0.72
    shade[len(solid.points) : len(lit.normals)] = 1.0 - ground_shadow(ground, lit)[:, None]
    return shade


@dataclass(frozen=True, eq=False)
class SoftLight:
    """Light that arrives at the vertices of surfaces and of the ground below, on their fronts and their backs.

    Attributes:
        normals: Unit normals of the fronts, shape (N, 3).
        sky: Visible fraction of the sky on each side, shape (2, N).
        key: Visible fraction of the key light on each side, shape (2, N), whether the side faces it or not.
    """

    normals: np.ndarray
    sky: np.ndarray
    key: np.ndarray


def soft_light(
    solid: Surface,
    ground: Surface,
    *,
    visible: np.ndarray,
    towards: np.ndarray,
    cancelled: Callable[[], bool] = lambda: False,
) -> SoftLight:
    """Light at the vertices of surfaces, averaged over neighbours, and of the ground.

    Args:
        solid: The surfaces, which occlude light.
        ground: The ground, which occludes none; may be empty.
        visible: Points that the maps of light cover, shape (M, 3); all beyond is lit.
        towards: Unit vector towards the key light, shape (3,).
        cancelled: Asked before each map of light: whether the caller no longer needs the result, which then is wrong.
    """
    start_warp()
    points, up = np.concatenate([solid.points, ground.points]), np.tile([0.0, 1.0, 0.0], (len(ground.points), 1))
    normals = np.concatenate([vertex_normals(solid), up])
    spots, facing = np.tile(points, (2, 1)), np.concatenate([normals, -normals])
    factors = _light(solid, spots, facing, visible=visible, towards=towards, cancelled=cancelled)
    sky, key = (values.reshape(2, -1) for values in factors)
    mean = _mean_of_neighbours(solid, LIGHT_WIDTH * float(np.ptp(visible, axis=0).max()))
    for light in (sky, key):
        for _ in range(0 if cancelled() else LIGHT_BLUR):
            light[:, : len(solid.points)] = (mean @ light[:, : len(solid.points)].T).T
    return SoftLight(normals, sky, key)


def ground_shadow(ground: Surface, light: SoftLight) -> np.ndarray:
    """Darkness of each node of a ground of `ground_below`, 0 for none, fading towards its edges, shape (G,)."""
    sky, key = light.sky[0, -len(ground.points) :], light.key[0, -len(ground.points) :]
    if not len(ground.points):
        return np.zeros(0)
    away = np.linalg.norm(ground.points - ground.points.mean(axis=0), axis=1) / (0.5 * np.ptp(ground.points[:, 0]))
    fade = np.clip(2.6 * (1.0 - away), 0.0, 1.0)
    lit = uniform_filter((0.62 * sky + 0.38 * key).reshape((GROUND_CELLS + 1,) * 2), GROUND_BLUR, mode="nearest")
    return 0.70 * fade * fade * (3 - 2 * fade) * (1.0 - lit.ravel())


def _mean_of_neighbours(solid: Surface, width: float) -> sparse.csr_matrix:
    """Mean over each vertex and its neighbours, weighted by a Gaussian of their distance, shape (V, V)."""
    count = len(solid.points)
    ends = np.concatenate([solid.triangles[:, side] for side in ((0, 1), (1, 2), (2, 0))]).T
    apart = np.subtract(*solid.points[ends]) / max(width, 1e-30)
    half = sparse.csr_matrix((np.exp(-np.einsum("ek,ek->e", apart, apart)), ends), shape=(count, count))
    beside = half + half.T + sparse.eye(count, format="csr")
    beside.data /= np.repeat(np.asarray(beside.sum(axis=1)).ravel(), np.diff(beside.indptr))
    return beside


def _light(
    solid: Surface,
    spots: np.ndarray,
    facing: np.ndarray,
    *,
    visible: np.ndarray,
    towards: np.ndarray,
    cancelled: Callable[[], bool],
) -> tuple[np.ndarray, np.ndarray]:
    """Fractions of sky light and of key light reaching spots with given normals, shape (N,).

    The maps cover the visible points; everything outside is lit.
    """
    light = np.zeros((len(spots), 3), np.float32)
    points, normals, light_at = (_vectors(vectors) for vectors in (spots, facing, light))
    across = _frame(towards)[:2]
    key = [_unit(towards + KEY_WIDTH * offset @ across) for offset in _disk(KEY_MAPS)]
    for is_key, directions, size in ((0, _hemisphere(SKY_MAPS), SKY_SIZE), (1, key, KEY_SIZE)):
        for direction in directions:
            if cancelled():
                break
            frame = _frame(direction)
            area = frame[:2] @ visible.T
            pixel = max(float(np.ptp(area, axis=1).max()), 1e-9) / size
            turn = frame / [[pixel], [pixel], [1.0]]
            shift = np.append(area.min(axis=1) / pixel, 0.0)
            depths = _depths(size, size)
            _rasterize(solid.points @ turn.T - shift, solid.triangles, depths)
            inputs = [points, normals, wp.mat33(turn), wp.vec3(shift), pixel, is_key, *map(_map, depths), light_at]
            run(_add_light, len(spots), inputs, device="cpu")
    return light[:, 0] / np.maximum(light[:, 2], 1e-9), light[:, 1] / KEY_MAPS


def _depths(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Empty maps of least and greatest depth per pixel."""
    return np.full((rows, columns), FAR, np.float32), np.full((rows, columns), -FAR, np.float32)


def _rasterize(
    seen: np.ndarray,
    triangles: np.ndarray,
    depths: tuple[np.ndarray, np.ndarray],
    *,
    colored: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
) -> None:
    """Draw triangles sequentially on one thread, so pixels need no locks.

    Args:
        seen: Column, row and depth of each vertex, shape (V, 3).
        triangles: Corners, shape (T, 3).
        depths: Least and greatest depth in each pixel.
        colored: Shading factor at each vertex, fronts before backs, shape (2 V, 3), colour of each triangle, and the
            picture to draw into.
    """
    shade, colors, picture = colored or (np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 0, 3), np.float32))
    corners = wp.array(np.ascontiguousarray(triangles, np.int32), dtype=wp.int32, device="cpu", copy=False)
    pixels = wp.array(picture, dtype=wp.vec3, ndim=2, device="cpu", copy=False)
    inputs = [_vectors(seen), corners, _vectors(shade), _vectors(colors), *map(_map, depths), pixels]
    run(_draw_triangle, len(triangles), inputs, device="cpu")


def _vectors(values: np.ndarray) -> wp.array:
    return wp.array(np.ascontiguousarray(values, np.float32), dtype=wp.vec3, device="cpu", copy=False)


def _map(depths: np.ndarray) -> wp.array:
    return wp.array(depths, dtype=wp.float32, device="cpu", copy=False)


@wp.kernel
def _draw_triangle(
    first: int,
    seen: wp.array(dtype=wp.vec3),
    triangles: wp.array2d(dtype=wp.int32),
    shade: wp.array(dtype=wp.vec3),
    colors: wp.array(dtype=wp.vec3),
    near: wp.array2d(dtype=wp.float32),
    far: wp.array2d(dtype=wp.float32),
    picture: wp.array2d(dtype=wp.vec3),
):
    """Draw one triangle into the depths, and into the picture if not empty."""
    t = first + wp.tid()
    i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
    a, b, c = seen[i], seen[j], seen[k]
    ab, ac = b - a, c - a
    area = ab[0] * ac[1] - ab[1] * ac[0]
    if not wp.abs(area) > 0.0:  # A vertex behind the eye is NaN.
        return
    back = wp.where(area > 0.0, shade.shape[0] / 2, 0)  # Rows run downwards: fronts turn the other way.
    low, high = wp.min(wp.min(a, b), c), wp.max(wp.max(a, b), c)
    left, right = int(wp.max(low[0], 0.0) + 0.5), int(wp.min(high[0], float(near.shape[1])) + 0.5)
    top, bottom = int(wp.max(low[1], 0.0) + 0.5), int(wp.min(high[1], float(near.shape[0])) + 0.5)
    v_column, v_row, w_column, w_row = ac[1] / area, -ac[0] / area, -ab[1] / area, ab[0] / area
    depth_column, depth_row = v_column * ab[2] + w_column * ac[2], v_row * ab[2] + w_row * ac[2]
    x = float(left) + 0.5 - a[0]
    for row in range(top, bottom):
        y = float(row) + 0.5 - a[1]
        v, w = x * v_column + y * v_row, x * w_column + y * w_row
        depth = a[2] + x * depth_column + y * depth_row
        for column in range(left, right):
            inside = wp.min(wp.min(v, w), 1.0 - v - w) >= -EDGE
            if picture.shape[0] == 0:  # Code without branches takes half the time.
                near[row, column] = wp.min(near[row, column], wp.where(inside, depth, FAR))
                far[row, column] = wp.max(far[row, column], wp.where(inside, depth, -FAR))
            elif inside and depth < near[row, column]:
                near[row, column] = depth
                factor = (1.0 - v - w) * shade[back + i] + v * shade[back + j] + w * shade[back + k]
                picture[row, column] = wp.cw_mul(factor, colors[t])
            v += v_column
            w += w_column
            depth += depth_column


@wp.kernel
def _add_light(
    first: int,
    spots: wp.array(dtype=wp.vec3),
    facing: wp.array(dtype=wp.vec3),
    turn: wp.mat33,
    shift: wp.vec3,
    pixel: float,
    is_key: int,
    near: wp.array2d(dtype=wp.float32),
    far: wp.array2d(dtype=wp.float32),
    light: wp.array(dtype=wp.vec3),
):
    """Add light from a map's direction, or from the opposite direction, to a spot one pixel above its surface."""
    i = first + wp.tid()
    at = turn * (spots[i] + pixel * facing[i]) - shift
    incidence = wp.dot(facing[i], wp.vec3(turn[2, 0], turn[2, 1], turn[2, 2]))
    column, row = wp.clamp(int(at[0]), 0, near.shape[1] - 1), wp.clamp(int(at[1]), 0, near.shape[0] - 1)
    outside = wp.min(at[0], at[1]) < 0.0 or wp.max(at[0], at[1]) >= float(near.shape[0])
    if is_key == 1:
        light[i] += wp.vec3(0.0, wp.where(outside or at[2] >= far[row, column], 1.0, 0.0), 0.0)
    else:
        clear = wp.where(incidence > 0.0, at[2] >= far[row, column], at[2] <= near[row, column])
        light[i] += wp.abs(incidence) * wp.vec3(wp.where(outside or clear, 1.0, 0.0), 0.0, 1.0)


def vertex_normals(surface: Surface | DrawnMesh) -> np.ndarray:
    """Area-weighted unit normals, shape (V, 3)."""
    corners = surface.points[surface.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat, count = surface.triangles.ravel(), len(surface.points)
    spread = np.repeat(normal, 3, axis=0)
    return _unit(np.stack([np.bincount(flat, spread[:, k], minlength=count) for k in range(3)], axis=1))


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Scale to length 1; zero stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-20)


def _frame(direction: np.ndarray) -> np.ndarray:
    """Two unit vectors across a direction, and the direction, as rows."""
    first = _unit(np.cross(direction, np.eye(3)[int(abs(direction[0]) > 0.7)]))
    return np.stack([first, np.cross(direction, first), direction])


def _disk(count: int) -> np.ndarray:
    """Evenly spread points in the unit disk (sunflower), shape (count, 2)."""
    i = np.arange(count)
    radius, angle = np.sqrt((i + 0.5) / count), i * np.pi * (3.0 - np.sqrt(5.0))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def _hemisphere(count: int) -> np.ndarray:
    """Evenly spread unit directions above the ground, as representatives of opposite pairs, shape (count, 3)."""
    flat = _disk(count)
    height = 1.0 - (flat**2).sum(axis=1)
    return np.stack([flat[:, 0] * np.sqrt(1.0 + height), height, flat[:, 1] * np.sqrt(1.0 + height)], axis=1)


def _encode(linear: np.ndarray) -> np.ndarray:
    """Linear to 8-bit sRGB."""
    value = np.clip(linear, 0.0, 1.0)
    encoded = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
    return np.round(255.0 * encoded).astype(np.uint8)
