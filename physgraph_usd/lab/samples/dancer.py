"""A dancer who turns once on one foot, in a dress of quads with short sleeves and a wide skirt.

The body is the level set of a smooth union of round cones (limbs whose radius changes along them) on a skeleton.
It is meshed once, at rest; in each frame its vertices are skinned and then moved onto the level set of the posed
cones, so that joints stay full and the mesh is exactly the surface that the coarse dress is kept off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ...solver.fabric import PRESETS
from ...usd.write.plain import Look, PlainMesh, PlainStage
from .drape import Drape, DrapeOptions
from .panel import Cut, sew
from .shapes import CANVAS, Solid, ease, mesh

FRAMES, RATE = 60, 24.0
"""Samples of the shot, a single turn, and samples per second."""
BONES = {
    "hips": (None, (0.0, 0.96, 0.0)),
    "chest": ("hips", (0.0, 1.10, 0.0)),
    "head": ("chest", (0.0, 1.46, 0.0)),
    "arm": ("chest", (0.165, 1.385, 0.0)),
    "hand": ("arm", (0.385, 1.258, 0.0)),
    "thigh": ("hips", (0.085, 0.91, 0.0)),
    "shin": ("thigh", (0.10, 0.50, 0.005)),
    "foot": ("shin", (0.105, 0.085, -0.01)),
}
"""Joints: parent and place at rest [m]; those off the middle stand for the left one of a pair."""
CONES = (
    ("head", (0.0, 1.600, 0.020), 0.082, "head", (0.0, 1.545, 0.030), 0.064),
    ("head", (0.0, 1.590, -0.018), 0.086, "chest", (0.0, 1.43, -0.010), 0.050),
    ("chest", (0.030, 1.425, -0.010), 0.050, "arm", (0.155, 1.380, -0.005), 0.050),
    ("chest", (0.075, 1.315, 0.0), 0.086, "chest", (0.050, 1.12, 0.0), 0.076),
    ("chest", (0.070, 1.265, 0.062), 0.050, "chest", (0.066, 1.30, 0.03), 0.060),
    ("chest", (0.050, 1.12, 0.0), 0.076, "hips", (0.075, 0.965, -0.005), 0.094),
    ("hips", (0.070, 0.935, -0.045), 0.083, "thigh", (0.090, 0.87, -0.005), 0.086),
    ("arm", (0.165, 1.378, -0.005), 0.050, "arm", (0.385, 1.258, 0.0), 0.037),
    ("hand", (0.385, 1.258, 0.0), 0.037, "hand", (0.590, 1.140, 0.015), 0.025),
    ("hand", (0.600, 1.134, 0.015), 0.028, "hand", (0.690, 1.082, 0.020), 0.017),
    ("thigh", (0.090, 0.87, 0.0), 0.086, "thigh", (0.10, 0.50, 0.005), 0.053),
    ("shin", (0.10, 0.50, 0.0), 0.052, "shin", (0.102, 0.36, -0.014), 0.052),
    ("shin", (0.102, 0.36, -0.012), 0.051, "shin", (0.105, 0.095, -0.012), 0.033),
    ("foot", (0.105, 0.050, -0.030), 0.034, "foot", (0.113, 0.030, 0.120), 0.022),
)
"""Round cones: joint, place [m] and radius [m] of either end. Those off the middle come with their mirror image."""
BLEND = 0.016
"""Radius of the blend between neighbouring cones of the body [m]."""
CELL = 0.02
"""Size of the body's faces [m]."""
DRESS = Cut(0.196, 1.285, 1.470, 0.56, 0.15, 0.078, (22, 5, 23, 7), depth=(0.70, 0.90))
"""The unshaped dress [m]."""
WAIST, SHOULDER, GAP = 1.075, (0.165, 1.385), 0.012
"""Height of the waist, where a sleeve turns, and distance of the coarse dress from the body [m]."""
GIRTH, HEM, LENGTH, FOLDS = (0.146, 0.108), 0.37, 0.515, 6
"""Half axes of the waist, radius of the hem and length of the skirt [m], and its folds."""
STEPS = 2
"""Simulated steps a frame."""


def build() -> PlainStage:
    """A dress that hangs from the shoulders and is held at the waist, and a closed body that dances."""
    body = rig()
    solid = surface(body)
    weights = skin(solid.points, body)
    samples = []
    for frame in range(FRAMES):
        matrices = pose(body, frame / RATE)
        samples.append(move_out(blend(solid.points, weights, matrices), posed_cones(body, matrices), body.radii))
    form = solid.collider("Body", CANVAS, samples=np.stack(samples))
    doc = "A dancer in a dress with a wide skirt, who turns once on one foot"
    return PlainStage("DancerShot", doc, (_dress(body), form), 1.0 + np.arange(FRAMES))


def _dress(body: Rig) -> PlainMesh:
    cut = sew(DRESS)
    rest = move_out(_shape(cut.points), body.cones, body.radii, gap=GAP)
    held = _held(cut.points)
    return mesh(
        "Dress",
        cut.quads,
        rest,
        Look("Cotton", (0.50, 0.10, 0.13)),
        samples=_simulate(body, rest, cut.quads, np.flatnonzero(held)),
        uv=cut.uv,
        pin=held.astype(float),
        fabric=PRESETS["cotton"],
        scheme="catmullClark",
    )


def _held(points: np.ndarray) -> np.ndarray:
    """Vertices of the unshaped dress that move with the body: along the waist, on the shoulders and at the cuffs."""
    rows = np.unique(points[:, 1].round(6))
    waist = rows[np.abs(rows - WAIST).argmin()]
    shoulders = (points[:, 1] > DRESS.shoulder - 0.03) & (np.abs(points[:, 0]) < DRESS.half_width - 0.05)
    cuffs = np.abs(points[:, 0]) > np.abs(points[:, 0]).max() - 1e-6
    return (np.abs(points[:, 1] - waist) < 1e-4) | shoulders | cuffs


def _shape(points: np.ndarray) -> np.ndarray:
    """Lower the sleeves, cut the neckline, take in the waist and widen the skirt."""
    x, y, z = points.T
    reach = (np.abs(x) - SHOULDER[0]).clip(0.0)
    angle = np.radians(30.0) * ease(reach / 0.12) * ease((y - 1.18) / 0.10)
    height = y - SHOULDER[1]
    across = np.abs(x) - reach + reach * np.cos(angle) + height * np.sin(angle)
    near = ease((y - 1.20) / 0.22) * np.sqrt((1.0 - (x / (1.15 * DRESS.neck)) ** 2).clip(0.0))
    y = np.where(reach > 0.0, SHOULDER[1] + height * np.cos(angle) - reach * np.sin(angle), y)
    y = y - np.where(z > 0.0, 0.07, 0.02) * near + 0.03 * ease((y - 1.32) / 0.12) * (1.0 - np.abs(x) / 0.2).clip(0.0)
    taken = 1.0 - 0.22 * np.exp(-(((points[:, 1] - WAIST) / 0.10) ** 2))
    return _skirt(points, np.stack([np.sign(x) * across * taken, y, z * taken], axis=1))


def _skirt(points: np.ndarray, shaped: np.ndarray) -> np.ndarray:
    """Widen what is below the waist into folds; every line from waist to hem has the same length."""
    v = ((WAIST - points[:, 1]) / (WAIST - DRESS.hem)).clip(0.0)
    columns = np.unique(points[np.abs(points[:, 1] - DRESS.hem) < 1e-6, 0].round(9))
    a = np.interp(points[:, 0], columns, np.linspace(np.pi, 0.0, len(columns))) * np.where(
        points[:, 2] < 0.0, -1.0, 1.0
    )
    fold = 1.0 + 0.06 * v**1.6 * np.cos(FOLDS * a + 0.6 * np.sin(2 * a) + 0.4 * np.sin(3 * a + 1.0))
    wide, far = ((start + (HEM - start) * v) * fold for start in GIRTH)
    out = np.hypot((wide - GIRTH[0]) * np.cos(a), (far - GIRTH[1]) * np.sin(a))
    drop = np.sqrt(((LENGTH * v) ** 2 - out**2).clip(0.0))
    skirt = np.stack([wide * np.cos(a), np.where(v > 0.0, WAIST - drop, points[:, 1]), far * np.sin(a)], axis=1)
    below = ease((1.24 - points[:, 1]) / (1.24 - WAIST))[:, None]
    return shaped + below * (skirt - shaped)


def _simulate(body: Rig, rest: np.ndarray, quads: np.ndarray, held: np.ndarray) -> np.ndarray:
    options = DrapeOptions(step=1.0 / (RATE * STEPS), iterations=8, give=0.84, bend=0.3, drag=3.0, density=0.15)
    legs = np.flatnonzero([body.names[first].startswith(("thigh", "shin")) for first in body.ends[:, 0]])
    radii = np.concatenate([body.radii, body.radii[legs[::2]]])
    before = FRAMES

    def project(points: np.ndarray, time: float) -> np.ndarray:
        cones = posed_cones(body, pose(body, time - before / RATE))
        between = cones[legs].reshape(-1, 2, 2, 3).mean(axis=1)  # the skirt does not go in between the legs
        return move_out(points, np.concatenate([cones, between]), radii, gap=GAP)

    weights = skin(rest[held], body)
    dress = Drape(rest, quads, held, options=options, project=project)

    def targets(time: float) -> np.ndarray:
        matrices = pose(body, time - before / RATE)
        return move_out(blend(rest[held], weights, matrices), posed_cones(body, matrices), body.radii, gap=GAP)

    return dress.film(before + FRAMES, STEPS, targets)[before:]


@dataclass(frozen=True, eq=False)
class Rig:
    """The skeleton with both sides, and the cones on it.

    Attributes:
        names: Joints, parents first.
        parents: Number of each joint's parent, -1 for the first.
        places: Joints at rest [m], shape (J, 3).
        ends: Joint of either end of each cone, shape (C, 2).
        cones: Both ends of each cone at rest [m], shape (C, 2, 3).
        radii: Radii at the ends [m], shape (C, 2).
    """

    names: list[str]
    parents: np.ndarray
    places: np.ndarray
    ends: np.ndarray
    cones: np.ndarray
    radii: np.ndarray


def rig() -> Rig:
    """Build the skeleton; the right side is the mirror image of the left."""
    names = [name + side for name, (_, place) in BONES.items() for side in (("_l", "_r") if place[0] else ("",))]

    def named(name: str, side: str) -> int:
        return names.index(name if name in names else name + side)

    parents, places = [], []
    for name in names:
        base, side = (name[:-2], name[-2:]) if name[-2:] in ("_l", "_r") else (name, "")
        parent, place = BONES[base]
        parents.append(-1 if parent is None else named(parent, side))
        places.append(np.array(place) * (-1.0 if side == "_r" else 1.0, 1.0, 1.0))
    ends, cones, radii = [], [], []
    for first, start, thick, second, stop, thin in CONES:
        for side in ("_l", "_r") if stop[0] else ("_l",):
            mirror = (-1.0 if side == "_r" else 1.0, 1.0, 1.0)
            ends.append((named(first, side), named(second, side)))
            cones.append(np.array([start, stop]) * mirror)
            radii.append((thick, thin))
    return Rig(names, np.array(parents), np.array(places), np.array(ends), np.array(cones), np.array(radii))


def pose(body: Rig, time: float) -> np.ndarray:
    """Matrices that take joints from rest to a time since a turn began [s], shape (J, 4, 4); the right foot stays."""
    angles = motion(time)
    matrices = np.tile(np.eye(4), (len(body.names), 1, 1))
    for i, (name, parent, place) in enumerate(zip(body.names, body.parents, body.places, strict=True)):
        turn = Rotation.from_rotvec(angles.get(name, np.zeros(3)), degrees=True).as_matrix()
        matrices[i, :3, :3], matrices[i, :3, 3] = turn, place - turn @ place
        if parent >= 0:
            matrices[i] = matrices[parent] @ matrices[i]
    foot = body.names.index("foot_r")
    standing = body.places[foot] * (0.0, 1.0, 1.0)
    matrices[:, :3, 3] += standing - matrices[foot, :3, :3] @ body.places[foot] - matrices[foot, :3, 3]
    return matrices


def motion(time: float) -> dict[str, np.ndarray]:
    """Rotation vectors of the joints at a time [s], in degrees."""
    t = time * RATE / FRAMES % 1.0
    wave = np.sin(2 * np.pi * t)
    up = float(ease(t / 0.35) - ease((t - 0.62) / 0.35))
    y, z = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    return {
        "hips": (360.0 * t - 40.0 * wave) * y,
        "chest": 16.0 * wave * y,
        "head": 20.0 * wave * y,
        "arm_l": -(10.0 + 22.0 * up) * y - (4.0 - 22.0 * up) * z,
        "arm_r": (10.0 + 22.0 * up) * y + (4.0 - 22.0 * up) * z,
        "hand_l": -(18.0 + 30.0 * up) * y,
        "hand_r": (18.0 + 30.0 * up) * y,
        "thigh_l": np.array([-32.0 * up, 0.0, 8.0 * up]),
        "shin_l": np.array([62.0 * up, 0.0, 0.0]),
        "foot_l": np.array([24.0 * up, 0.0, 0.0]),
        "thigh_r": -5.0 * up * z,
        "foot_r": 5.0 * up * z,
    }


def level(points: np.ndarray, cones: np.ndarray, radii: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance from the smooth union of cones [m], shape (V,), and its gradient, shape (V, 3).

    With the distance d to each cone this is -BLEND log(sum(exp(-d / BLEND))). Points [m] have shape (V, 3), the ends of
    cones [m] (C, 2, 3) and their radii [m] (C, 2), here as below.
    """
    distance, along, length = apart(points, cones, radii)
    least = distance.min(axis=1, keepdims=True)
    near = np.exp((least - distance) / BLEND)
    total = near.sum(axis=1, keepdims=True)
    weight = near / total / length
    axes = weight @ cones[:, 0] + (weight * along) @ (cones[:, 1] - cones[:, 0])
    return (least - BLEND * np.log(total))[:, 0], points * weight.sum(axis=1, keepdims=True) - axes


def apart(points: np.ndarray, cones: np.ndarray, radii: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance from each cone [m], place along it from 0 to 1, and distance from its axis [m], shapes (V, C)."""
    start, axis = cones[:, 0], cones[:, 1] - cones[:, 0]
    size = (axis**2).sum(axis=1)
    ahead = points @ axis.T - (start * axis).sum(axis=1)
    along = (ahead / size).clip(0.0, 1.0)
    square = (points**2).sum(axis=1, keepdims=True) - 2.0 * points @ start.T + (start**2).sum(axis=1)
    length = np.sqrt((square + along * (along * size - 2.0 * ahead)).clip(1e-12))
    return length - radii[:, 0] - along * (radii[:, 1] - radii[:, 0]), along, length


def move_out(points: np.ndarray, cones: np.ndarray, radii: np.ndarray, *, gap: float = 0.0) -> np.ndarray:
    """Positions [m] with those nearer to the cones than a gap [m] moved out; without a gap, all on the surface."""
    points, moved = points.copy(), np.arange(len(points))
    for _ in range(4):
        value, slope = level(points[moved], cones, radii)
        if gap > 0.0:
            near = value < gap - 1e-5
            moved, value, slope = moved[near], value[near], slope[near]
        steep = np.maximum((slope**2).sum(axis=1, keepdims=True), 0.1)
        points[moved] -= (value - gap)[:, None] * slope / steep
    return points


def skin(points: np.ndarray, body: Rig) -> np.ndarray:
    """Skinning weights of points at rest, shape (V, J), from nearby cones, split between a cone's ends by position."""
    distance, along, _ = apart(points, body.cones, body.radii)
    near = np.exp((distance.min(axis=1, keepdims=True) - distance) / 0.02)
    weights = np.zeros((len(points), len(body.names)))
    for cone, (first, second) in enumerate(body.ends):
        weights[:, first] += near[:, cone] * (1.0 - along[:, cone])
        weights[:, second] += near[:, cone] * along[:, cone]
    return weights / weights.sum(axis=1, keepdims=True)


def blend(points: np.ndarray, weights: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    """Linear blend skinning, shape (V, 3)."""
    blended = np.tensordot(weights, matrices[:, :3], axes=1)
    return np.einsum("vij,vj->vi", blended[..., :3], points) + blended[..., 3]


def posed_cones(body: Rig, matrices: np.ndarray) -> np.ndarray:
    """Both ends of each cone after a pose [m], shape (C, 2, 3)."""
    moved = matrices[body.ends]
    return np.einsum("ceij,cej->cei", moved[..., :3, :3], body.cones) + moved[..., :3, 3]


def surface(body: Rig) -> Solid:
    """The body at rest as quads: surface nets of the level set (a vertex in each crossed cell).

    Source: Gibson, "Constrained Elastic Surface Nets", 1998.
    """
    low, high = body.cones.min(axis=(0, 1)) - 0.13, body.cones.max(axis=(0, 1)) + 0.13
    axes = [np.arange(start, stop, CELL) for start, stop in zip(low, high, strict=True)]
    shape = tuple(len(axis) for axis in axes)
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = np.concatenate([level(part, body.cones, body.radii)[0] < 0.0 for part in np.array_split(grid, 200)])
    inside = inside.reshape(shape)
    cells = np.arange(inside.size).reshape(shape)
    quads = []
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        rolled = np.roll(inside, -1, axis)
        for crossing, order in ((inside & ~rolled, 1), (~inside & rolled, -1)):
            back, side = np.roll(cells, 1, first), np.roll(cells, 1, second)
            four = np.stack([cells, back, np.roll(back, 1, second), side], axis=-1)
            quads.append(four[crossing][:, ::order])
    used, numbers = np.unique(np.concatenate(quads), return_inverse=True)
    quads = numbers.reshape(-1, 4)
    points = grid[used] + 0.5 * CELL
    for _ in range(6):  # even out the faces, on the surface
        total = np.zeros_like(points)
        for i in range(4):
            np.add.at(total, quads[:, i], points[quads[:, (i + 1) % 4]] + points[quads[:, (i + 3) % 4]])
        points = total / (2.0 * np.bincount(quads.ravel()))[:, None]
        points = move_out(points, body.cones, body.radii)
    return Solid(points, np.full(len(quads), 4), quads.ravel())
