"""Three garments of quads that no sample shows: a cape in wind, trousers cached from mid-stride, an open skinned coat.

    python -m benchmarks.quad_garments OUT_FOLDER [NAME...]

Writes OUT_FOLDER/NAME.usdc. Each cage is as a studio hands it over: a little jagged, shortened in places, and with a
fault of its own. The cape has quads of 1 x 4 to 7 x 4 cm. The trousers have neither a rest shape nor default points.
The coat is moved by linear blend skinning alone, which takes it into the shoulders when the arms rise.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom
from scipy.spatial import cKDTree

from benchmarks.rows import say
from physgraph_usd.lab.samples import walker
from physgraph_usd.lab.samples.dancer import Rig, blend, move_out, posed_cones, rig, skin, surface, turned
from physgraph_usd.lab.samples.drape import Drape, DrapeOptions
from physgraph_usd.lab.samples.panel import Cut, sew
from physgraph_usd.lab.samples.shapes import Solid, ease, grid_uv, mesh, quad_grid
from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.usd.write.plain import FaceVarying, Look, PlainMesh, PlainStage
from physgraph_usd.usd.write.sample_stage import write_stage

RATE, STEPS, GAP = 24.0, 2, 0.012
"""Frames a second, simulated steps a frame, and distance of simulated cages from the body [m]."""
CANVAS = Look("Canvas", (0.60, 0.56, 0.50))
"""Look of the bodies."""

CAPE_FRAMES, CAPE_BEFORE = 36, 30
"""Samples of the cape, and frames simulated before them."""
CAPE_ROWS, CAPE_COLUMNS, CAPE_ROW = 23, 44, 0.04
"""Rows and columns of the cape's vertices, and distance of rows [m]."""
CAPE_ARC = np.radians((114.0, 426.0))
"""Directions about the neck between which the cape lies [rad]: open at the front."""
AIR = 0.5 * 1.2
"""Half the density of air [kg/m^3]: pressure over the square of the wind's speed across the cloth."""

LEG_GAP = 0.007
"""Distance of the trousers from the body [m]: the thighs stand 16 mm apart."""
WALK_FRAMES, WALK_FROM = 30, 1.5625
"""Samples of the trousers, and time of the first one [s]: a leg is then farthest ahead."""

COAT_FRAMES = 30
COAT = Cut(0.215, 1.255, 1.470, 0.66, 0.43, 0.078, (20, 14, 18, 6), depth=(0.72, 0.90))
"""The coat before it is shaped [m]."""
SLEEVE_FROM, SLEEVE_DOWN = (0.165, 1.385), np.radians(30.0)
"""Where a sleeve turns down from level [m], and by how much [rad]: as the arms of the dancer's body at rest."""


def main() -> None:
    """Write the stages."""
    out = Path(sys.argv[1])
    for name in sys.argv[2:] or GARMENTS:
        say(str(write_garment(name, out)))


def write_garment(name: str, folder: Path) -> Path:
    """Write one of `GARMENTS` as ``<folder>/<name>.usdc``, in place of an earlier one, and return that path."""
    path = write_stage(GARMENTS[name](), folder / f"{name}.usdc", overwrite=True)
    if name in WITHOUT_DEFAULT:
        stage = Usd.Stage.Open(str(path))
        UsdGeom.Mesh(stage.GetPrimAtPath(WITHOUT_DEFAULT[name])).GetPointsAttr().ClearDefault()
        stage.Save()
    return path


def cape() -> PlainStage:
    """A cape that hangs from the neck of a tailor's dummy, in gusts from the front."""
    body = _without_arms(rig())
    rest = move_out(_cape_shape(), body.cones, body.radii, gap=GAP)
    quads, held = quad_grid(CAPE_ROWS, CAPE_COLUMNS)[:, ::-1], np.arange(CAPE_COLUMNS)
    options = DrapeOptions(
        step=1 / (RATE * STEPS), iterations=8, give=0.86, bend=0.12, drag=0.8, density=0.22, contact=1.0
    )

    def project(points: np.ndarray, _: float) -> np.ndarray:
        return move_out(points, body.cones, body.radii, gap=GAP)

    cloth = Drape(rest, quads, held, options=options, project=project)
    samples = []
    for _ in range(CAPE_BEFORE + CAPE_FRAMES):
        samples.append(cloth.points)
        for _ in range(STEPS):
            _blow(cloth, quads, _wind(cloth.time - CAPE_BEFORE / RATE))
            cloth.step(rest[held])
    garment = mesh(
        "Cape",
        quads,
        rest,
        Look("Wool", (0.13, 0.20, 0.17)),
        samples=np.stack(samples[CAPE_BEFORE:]),
        uv=_flipped_uv(),
        pin=(np.arange(len(rest)) < CAPE_COLUMNS).astype(float),
        fabric=PRESETS["wool"],
        scheme="catmullClark",
    )
    form = surface(body).collider("Body", CANVAS)
    return PlainStage("CapeShot", "A cape in gusts of wind", (garment, form), 1.0 + np.arange(CAPE_FRAMES))


def _without_arms(body: Rig) -> Rig:
    """The body as a tailor's dummy."""
    kept = [not body.names[first].startswith(("arm", "hand")) for first in body.ends[:, 0]]
    return replace(body, ends=body.ends[kept], cones=body.cones[kept], radii=body.radii[kept])


def _cape_shape() -> np.ndarray:
    """The cape at rest, row by row from the neck [m]: over the shoulders, then down in soft folds."""
    widths = np.random.default_rng(7).choice([1.0, 2.0, 4.0, 6.0, 7.0], CAPE_COLUMNS - 1)
    along = np.concatenate([[0.0], np.cumsum(widths)]) / widths.sum()
    a = CAPE_ARC[0] + (CAPE_ARC[1] - CAPE_ARC[0]) * along
    shoulder = 1.0 / np.hypot(np.cos(a) / 0.225, np.sin(a) / 0.155)
    radius, height = 1.0 / np.hypot(np.cos(a) / 0.080, np.sin(a) / 0.076), 1.494 - 0.030 * np.sin(a).clip(0.0)
    rows, parts = [], 10
    for row in range(CAPE_ROWS):
        fold = 0.05 * (row / (CAPE_ROWS - 1)) ** 1.3 * np.cos(7.0 * a + 0.7 * np.sin(2 * a) + 0.4 * np.sin(3 * a))
        rows.append(np.stack([radius * (1.0 + fold) * np.cos(a), height, radius * (1.0 + fold) * np.sin(a)], axis=1))
        for _ in range(parts):
            down = np.radians(18.0 + 60.0 * ease((radius - 0.70 * shoulder) / (0.45 * shoulder)))
            radius = radius + CAPE_ROW / parts * np.cos(down)
            height = height - CAPE_ROW / parts * np.sin(down)
    return np.concatenate(rows)


def _flipped_uv() -> FaceVarying:
    """UVs of the cape, whose quads run the other way round than the grid's."""
    uv = grid_uv(CAPE_ROWS, CAPE_COLUMNS)
    return FaceVarying(uv.values, uv.indices.reshape(-1, 4)[:, ::-1].ravel())


def _wind(time: float) -> np.ndarray:
    """Velocity of the wind [m/s]: gusts from the front that turn to either side."""
    gust = 2.4 + 1.5 * np.sin(2 * np.pi * 0.9 * time) + 0.6 * np.sin(2 * np.pi * 2.3 * time + 1.0)
    side = 0.7 * np.sin(2 * np.pi * 0.6 * time + 0.5)
    return gust * np.array([np.sin(side), 0.12, -np.cos(side)])


def _blow(cloth: Drape, quads: np.ndarray, wind: np.ndarray) -> None:
    """Speed a cloth up by the air's pressure over one step."""
    corners = cloth.points[quads]
    across = 0.25 * np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    normal = np.zeros_like(cloth.points)
    for corner in quads.T:
        np.add.at(normal, corner, across)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    through = np.einsum("ij,ij->i", wind - cloth.velocity, normal)
    pressure = AIR * through * np.abs(through) / cloth.options.density
    cloth.velocity = cloth.velocity + cloth.options.step * pressure[:, None] * normal


def trousers() -> PlainStage:
    """Loose trousers of denim on legs that walk; the first sample is in mid-stride and nothing says the rest shape."""
    cells = walker.Cells(36, 8, np.linspace(1.05, 0.845, 7), np.linspace(0.745, 0.21, 18))
    cage = walker.trousers(cells, lambda height: 0.010 + 0.022 * ease((0.74 - height) / 0.25))
    rest = (cage.points - (0.0, 1.05, 0.0)) * (1.04, 1.05, 1.04) + (0.0, 1.05, 0.0)
    held = np.flatnonzero(cage.points[:, 1] > 1.01)
    solid = walker.body()
    push = _off_sides(solid, cage.points)
    options = DrapeOptions(
        step=1 / (RATE * STEPS), iterations=8, give=0.8, bend=0.1, drag=3.0, density=0.3, contact=1.0
    )
    cloth = Drape(rest, cage.quads, held, options=options, project=push, start=cage.points)
    samples, times = [], WALK_FROM + np.arange(WALK_FRAMES) / RATE
    while len(samples) < WALK_FRAMES:
        if (
            cloth.time > WALK_FROM - 1e-6
            and round(cloth.time / options.step) % STEPS == round(WALK_FROM / options.step) % STEPS
        ):
            samples.append(cloth.points)
        cloth.step(walker.walk(cage.points[held], cloth.time + options.step))
    garment = mesh(
        "Trousers",
        cage.quads,
        samples[0],
        Look("Denim", (0.12, 0.17, 0.30)),
        samples=np.stack(samples),
        uv=cage.uv,
        fabric=PRESETS["denim"],
        scheme="catmullClark",
    )
    form = solid.collider("Body", CANVAS, samples=np.stack([walker.walk(solid.points, time) for time in times]))
    return PlainStage("TrousersShot", "Trousers in mid-stride", (garment, form), 1.0 + np.arange(WALK_FRAMES))


def _off_sides(solid: Solid, cloth: np.ndarray) -> Callable[[np.ndarray, float], np.ndarray]:
    """A push to `LEG_GAP` off the walking body, by the tangent plane of the nearest vertex on the cloth's own side.

    Args:
        solid: The standing body.
        cloth: Points of the cloth round the standing body [m], shape (V, 3).
    """
    starts = np.concatenate([[0], np.cumsum(solid.counts)])[:-1]
    following = np.arange(1, len(solid.indices) + 1)
    following[starts + solid.counts - 1] = starts
    here, there = solid.indices, solid.indices[following]
    sides = [(np.flatnonzero(s * cloth[:, 0] > -1e-9), np.flatnonzero(s * solid.points[:, 0] > -1e-9)) for s in (1, -1)]

    def push(points: np.ndarray, time: float) -> np.ndarray:
        body, out = walker.walk(solid.points, time), points.copy()
        normal = np.zeros_like(body)
        face = np.add.reduceat(np.cross(body[here], body[there]), starts, axis=0)
        np.add.at(normal, here, np.repeat(face, solid.counts, axis=0))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        for own, near in sides:
            nearest = near[cKDTree(body[near]).query(out[own])[1]]
            depth = np.einsum("ij,ij->i", out[own] - body[nearest], normal[nearest])
            out[own] += (LEG_GAP - depth).clip(0.0)[:, None] * normal[nearest]
        return out

    return push


def coat() -> PlainStage:
    """An open coat on a person who raises the arms, both moved by linear blend skinning; only the body is mended."""
    body = rig()
    solid, cloth = surface(body), _coat_shape(body)
    weights, around = skin(solid.points, body), _coat_weights(cloth.points, body)
    bodies, samples = [], []
    for frame in range(COAT_FRAMES):
        matrices = turned(body, _raised(frame / (COAT_FRAMES - 1)))
        samples.append(blend(cloth.points, around, matrices))
        bodies.append(move_out(blend(solid.points, weights, matrices), posed_cones(body, matrices), body.radii))
    cloth = replace(cloth, samples=np.stack(samples))
    form = solid.collider("Body", CANVAS, samples=np.stack(bodies))
    return PlainStage("CoatShot", "An open coat, arms rise", (cloth, form), 1.0 + np.arange(COAT_FRAMES))


def _raised(t: float) -> dict[str, np.ndarray]:
    """Rotation vectors of the joints [degrees] over the coat's shot, t from 0 to 1: hanging, raised, half lowered."""
    up = float(-30.0 * (1.0 - ease(t / 0.55)) + 68.0 * ease(t / 0.55) - 40.0 * ease((t - 0.65) / 0.35))
    turn = 14.0 * np.sin(2 * np.pi * t)
    angles = {f"arm_{side}": _about_z(-up, side) for side in "lr"}
    bend = np.array([0.0, -25.0 * ease(t / 0.6), 0.0])
    return angles | {"hand_l": bend, "hand_r": -bend, "chest": np.array([0.0, turn, 0.0])}


def _about_z(down: float, side: str) -> np.ndarray:
    """Rotation vector that lowers an arm [degrees]."""
    return np.array([0.0, 0.0, -down if side == "l" else down])


def _coat_shape(body: Rig) -> PlainMesh:
    """The coat at rest: sleeves lowered, a neckline, wider towards the hem, and open along the middle of the front."""
    cut = sew(COAT)
    x, y, z = cut.points.T
    reach = (np.abs(x) - SLEEVE_FROM[0]).clip(0.0)
    angle = SLEEVE_DOWN * ease(reach / 0.12) * ease((y - 1.14) / 0.10)
    height = y - SLEEVE_FROM[1]
    across = np.abs(x) - reach + reach * np.cos(angle) + height * np.sin(angle)
    near = ease((y - 1.20) / 0.22) * np.sqrt((1.0 - (x / (1.15 * COAT.neck)) ** 2).clip(0.0))
    low = np.where(reach > 0.0, SLEEVE_FROM[1] + height * np.cos(angle) - reach * np.sin(angle), y)
    low = low - np.where(z > 0.0, 0.09, 0.02) * near + 0.03 * ease((y - 1.32) / 0.12) * (1 - np.abs(x) / 0.2).clip(0)
    wide = 1.0 + 0.22 * ease((1.15 - y) / 0.5)
    points = np.stack([np.sign(x) * across * wide, low, z * wide], axis=1)
    points, quads = _opened(points, cut.quads)
    return mesh(
        "Coat",
        quads,
        move_out(points, body.cones, body.radii, gap=GAP),
        Look("Wool", (0.36, 0.25, 0.15)),
        uv=cut.uv,
        fabric=PRESETS["wool"],
        scheme="catmullClark",
    )


def _opened(points: np.ndarray, quads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and quads cut along the middle of the front, whose two edges come apart towards the hem."""
    middle = np.flatnonzero((np.abs(points[:, 0]) < 1e-9) & (points[:, 2] > 0.0))
    twin = np.arange(len(points))
    twin[middle] = len(points) + np.arange(len(middle))
    right = points[quads, 0].mean(axis=1) < 0.0
    quads = np.where(right[:, None], twin[quads], quads)
    both = np.concatenate([points, points[middle]])
    apart = 0.012 + 0.045 * ease((1.30 - points[middle, 1]) / 0.6)
    both[middle, 0] += apart
    both[len(points) :, 0] -= apart
    return both, quads


def _coat_weights(points: np.ndarray, body: Rig) -> np.ndarray:
    """Weights as an artist copies them from the body; the skirt of the coat goes with the hips, not with a leg."""
    weights = skin(points, body)
    legs = [i for i, name in enumerate(body.names) if name.startswith(("thigh", "shin", "foot"))]
    weights[:, body.names.index("hips")] += weights[:, legs].sum(axis=1)
    weights[:, legs] = 0.0
    return weights


GARMENTS: dict[str, Callable[[], PlainStage]] = {"cape": cape, "trousers": trousers, "coat": coat}
"""Shots by name; the garment's prim path is /<Name>Shot/<Name>."""
WITHOUT_DEFAULT = {"trousers": "/TrousersShot/Trousers"}
"""Garments whose points have time samples alone."""


if __name__ == "__main__":
    main()
