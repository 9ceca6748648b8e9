"""Finds the direction of a garment's warp: along v of the texture coordinates if they are a pattern, else downwards.

Texture coordinates are a pattern if they preserve the cloth's shape: exactly for garments from a cutting program,
nearly for most unwraps. Without a pattern, the warp runs down the cloth of the rest shape, like the usual cut of a
garment. ``primvars:physgraph:grain`` turns the warp.
"""

from __future__ import annotations

import numpy as np
from pxr import Tf, Usd, UsdGeom

from ...solver.mesh.topology import PolygonMesh, face_normals
from ...solver.mesh.weld import Weld
from ...solver.scene import Grain
from ..mesh.attributes import kept_corners
from ..stage import authored_topology, flattened

SKEWED = 1.5
"""Ratio of a face's two texture stretches from which the texture coordinates count as not shape-preserving."""
PATTERN = 0.8
"""Least fraction of the area with shape-preserving texture coordinates in a pattern."""
_NAMES = ("st", "uv", "UVMap", "map1")
_FLAT = 1e-12
PATCH = 6.0
"""Wavelength of the ease's variation, in mean cage edges: five folds of the shortest that two subdivisions show, which
are five fine edges wide. At four edges folds break up into bumps; at twelve half of a skirt has none."""
UNEVEN = 0.6
"""Standard deviation of the logarithm of the ease's variation: folds end where there is half the ease."""
_WAVES = 32


def read_grain(
    prim: Usd.Prim,
    weld: Weld,
    rest: np.ndarray,
    *,
    kept: np.ndarray,
    up: np.ndarray,
    painted: dict[str, np.ndarray],
) -> tuple[Grain, str]:
    """The grain of a garment, and its source, in words.

    Args:
        weld: The kept faces, as authored and welded.
        rest: Rest positions as authored [m], shape (V, 3).
        kept: Numbers of the kept faces among the authored faces, shape (F,).
        up: The stage's upward direction, shape (3,).
        painted: Values of ``easeScale``, ``gather`` [%] and ``grain`` [degrees] at each point, each of shape (V,).

    Returns:
        The grain, with the painted ease times `unevenness`, and the source of the direction.
    """
    mesh = weld.apart
    coordinates = _texture_coordinates(prim, mesh, kept)
    along = None if coordinates is None else _along_v(mesh, rest, coordinates[1])
    source = "the rest shape, downwards"
    if coordinates is not None and along is not None:
        source = f"v of primvars:{coordinates[0]}"
    normal = face_normals(mesh, rest)
    warp = _down(normal, up) if along is None else along
    turn = np.radians(np.add.reduceat(painted["grain"][mesh.indices], mesh.starts[: mesh.face_count]) / mesh.counts)
    warp = np.cos(turn)[:, None] * warp + np.sin(turn)[:, None] * np.cross(normal, warp)
    if turn.any():
        source += ", turned by primvars:physgraph:grain"
    ease = weld.joined(painted["easeScale"]) * unevenness(weld.mesh, weld.joined(rest))
    return Grain(warp[weld.faces], ease, weld.joined(painted["gather"] / 100.0)), source


def unevenness(mesh: PolygonMesh, rest: np.ndarray) -> np.ndarray:
    """Smooth variation of the ease over a cage, of mean one, shape (V,): folds of even ease are parallel ridges.

    The exponential of a sum of plane waves in evenly spread directions, each of `PATCH` mean edges: a function of the
    rest shape alone, unchanged by moving or scaling the shape.

    Args:
        rest: Rest positions [m], shape (V, 3).
    """
    number = np.arange(_WAVES)
    height, turn = (2.0 * number + 1.0) / _WAVES - 1.0, np.pi * (3.0 - np.sqrt(5.0)) * number
    across = np.sqrt(1.0 - height**2)
    directions = np.stack([across * np.cos(turn), across * np.sin(turn), height])
    length = np.linalg.norm(np.diff(rest[mesh.half_edges.edges], axis=1), axis=2).mean()
    phase = 2.0 * np.pi / (PATCH * max(length, np.finfo(float).tiny)) * (rest - rest.mean(axis=0)) @ directions
    waves = np.sqrt(2.0 / _WAVES) * np.sin(phase + turn**2).sum(axis=1)
    uneven = np.exp(UNEVEN * waves)
    return uneven / uneven.mean()


def _down(normal: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Steepest downward direction on each face, shape (F, 3); 0 for a level face."""
    down = normal * (normal @ up)[:, None] - up
    length = np.linalg.norm(down, axis=1, keepdims=True)
    return np.where(length > 1e-3, down / np.maximum(length, 1e-3), 0.0)


def _texture_coordinates(prim: Usd.Prim, mesh: PolygonMesh, kept: np.ndarray) -> tuple[str, np.ndarray] | None:
    """Name, and values at the kept faces' corners, shape (C, 2), of the first valid texture coordinates."""
    api = UsdGeom.PrimvarsAPI(prim)
    every = [primvar.GetPrimvarName() for primvar in api.GetPrimvars() if "texCoord2" in str(primvar.GetTypeName())]
    for name in dict.fromkeys([preferred for preferred in _NAMES if preferred in every] + every):
        primvar = api.GetPrimvar(name)
        try:
            flat = flattened(primvar, Usd.TimeCode.EarliestTime())
        except Tf.ErrorException:  # Indices of a wrong type: the layer writer reports such primvars.
            continue
        values = np.zeros((0, 2)) if flat is None else np.asarray(flat, np.float64)
        if not np.isfinite(values).all():
            continue
        if primvar.GetInterpolation() == UsdGeom.Tokens.faceVarying:
            corners = kept_corners(*authored_topology(prim), kept)
            if len(corners) == len(mesh.indices) and corners.max(initial=-1) < len(values):
                return name, values[corners]
        elif len(values) == mesh.vertex_count and primvar.GetInterpolation() != UsdGeom.Tokens.uniform:
            return name, values[mesh.indices]
    return None


def _along_v(mesh: PolygonMesh, rest: np.ndarray, corners: np.ndarray) -> np.ndarray | None:
    """Direction of v on each face, shape (F, 3), or None if the coordinates are no pattern.

    Over each face positions are fitted by p = u P_u + v P_v; shape-preserving faces are weighted by area.
    """
    starts, face = mesh.starts[: mesh.face_count], mesh.corner_face

    def centred(values: np.ndarray) -> np.ndarray:
        return values - (np.add.reduceat(values, starts) / mesh.counts[:, None])[face]

    point, uv = centred(rest[mesh.indices]), centred(corners)
    uu, uw, ww = (np.add.reduceat(uv[:, i] * uv[:, j], starts) for i, j in ((0, 0), (0, 1), (1, 1)))
    pu, pv = (np.add.reduceat(uv[:, k, None] * point, starts) for k in (0, 1))
    determinant = uu * ww - uw**2
    sound = determinant > _FLAT * (uu + ww) ** 2
    inverse = np.where(sound, 1.0 / np.where(sound, determinant, 1.0), 0.0)[:, None]
    along_u, along_v = inverse * (ww[:, None] * pu - uw[:, None] * pv), inverse * (uu[:, None] * pv - uw[:, None] * pu)
    a, b, c = (np.einsum("fc,fc->f", x, y) for x, y in ((along_u, along_u), (along_u, along_v), (along_v, along_v)))
    root = np.sqrt(np.maximum((a - c) ** 2 + 4.0 * b**2, 0.0))
    low, high = np.maximum(a + c - root, 0.0), a + c + root
    area = np.linalg.norm(
        np.add.reduceat(np.cross(rest[mesh.indices], rest[mesh.indices[mesh.next_corner]]), starts), axis=1
    )
    keeps = sound & (high < SKEWED**2 * low)
    if area[keeps].sum() < PATTERN * area.sum():
        return None
    return along_v / np.maximum(np.linalg.norm(along_v, axis=1, keepdims=True), np.finfo(float).tiny)
