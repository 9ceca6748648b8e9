"""A T-shirt of quads on a body, both skinned: raised and lowered arms show the armpit artefact of linear blending."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ...solver.fabric import PRESETS
from ...usd.write.plain import Look, PlainMesh, PlainStage, Skeleton, Skin
from .panel import Cut, Pillow, sew
from .shapes import CANVAS, Solid, ease, mesh, quad_grid, rings

SHIRT = Cut(0.200, 0.405, 0.575, 0.0, 0.16, 0.078, (18, 6, 18, 8))
BODY = Cut(0.172, 0.440, 0.556, -0.10, 0.36, 0.0, (16, 12, 16, 8), closed=True)
"""Measures of the shirt and of the body in it [m]."""
SLOPE = np.radians(28.0)
"""How far the arms point down at bind time [rad]."""
SHOULDER = (0.150, 0.505)
"""Where an arm turns: distance from the middle and height [m]."""
SPINE = 0.17
"""Height at which the chest bends on the hips [m]."""
FRAMES = 36


def build() -> PlainStage:
    """A shirt with two materials and a body on one skeleton."""
    times = np.arange(1.0, FRAMES + 1)
    shirt = sew(SHIRT)
    garment = mesh(
        "Shirt",
        shirt.quads,
        _slope(dress(shirt)),
        Look("Body", (0.20, 0.40, 0.33)),
        uv=shirt.uv,
        subsets=((Look("Trim", (0.78, 0.66, 0.40)), trim(shirt)),),
        fabric=PRESETS["jersey"],
        level=3,
        skin=_weights(shirt.points),
        scheme="catmullClark",
    )
    doc = "A T-shirt whose arms are raised and lowered, and whose chest turns, by linear-blend skinning"
    return PlainStage("TshirtShot", doc, (garment, _form()), times, _skeleton(times))


def _form() -> PlainMesh:
    body = sew(BODY)
    points = body.points.copy()
    reach = ((np.abs(points[:, 0]) - BODY.half_width) / BODY.sleeve).clip(0.0)
    thin = (1.0 - 0.25 * reach) * _round((reach - 0.85) / 0.15)
    axis = 0.5 * (BODY.armpit + BODY.shoulder)
    arm = ease(reach / 0.15)
    points[:, 1] = axis + (points[:, 1] - axis) * (1.0 + arm * (thin - 1.0))
    points[:, 2] *= 1.0 + arm * (thin - 1.0)
    points[:, 0] *= _round((-0.01 - points[:, 1]) / 0.09)
    neck = quad_grid(9, 20, closed=True)[:, ::-1] + len(points)
    outline = np.array([[0.02, 0.690], [0.042, 0.684], [0.052, 0.67], [0.05, 0.64], [0.048, 0.61]])
    outline = np.concatenate([outline, [[0.05, 0.585], [0.058, 0.56], [0.075, 0.535], [0.08, 0.51]]])
    radius, height = outline.T
    level = np.concatenate([points, rings(radius, height, 0.9 * radius, 20).reshape(-1, 3)])
    cap = np.arange(20)[::-1] + len(points)
    weights = _weights(level)
    weights.weights[len(points) :] = 0.0, 1.0, 0.0
    counts = np.concatenate([np.full(len(body.quads) + len(neck), 4), [20]])
    indices = np.concatenate([body.quads.ravel(), neck.ravel(), cap])
    form = Solid(np.concatenate([_slope(points), level[len(points) :]]), counts, indices)
    return form.collider("Form", CANVAS, skin=weights, scheme="catmullClark")


def _round(t: np.ndarray) -> np.ndarray:
    """A quarter ellipse: 1 up to t = 0, falling to nearly 0 at t = 1."""
    return np.sqrt(1.0 - 0.97 * np.clip(t, 0.0, 1.0) ** 2)


def _slope(points: np.ndarray) -> np.ndarray:
    """Lower the level arms to the bind pose by bending about the shoulders."""
    reach = (np.abs(points[:, 0]) - 0.125).clip(0.0)
    angle = SLOPE * ease(reach / 0.16) * _above(points)
    side, height = np.sign(points[:, 0]), points[:, 1] - SHOULDER[1]
    along = np.abs(points[:, 0]) - reach + reach * np.cos(angle) + height * np.sin(angle)
    drop = SHOULDER[1] + height * np.cos(angle) - reach * np.sin(angle)
    return np.column_stack([side * along, drop, points[:, 2]])


def _above(points: np.ndarray) -> np.ndarray:
    """1 at the arms' height, 0 well below the armpits."""
    return ease((points[:, 1] - 0.28) / 0.14)


def dress(shirt: Pillow) -> np.ndarray:
    """Positions of `SHIRT`'s pillow with a neckline and shoulders; the sleeves stay level [m], shape (V, 3)."""
    points = shirt.points.copy()
    x, y = points[:, 0], points[:, 1]
    near = ease((y - 0.30) / (SHIRT.shoulder - 0.30)) * np.sqrt((1.0 - (x / (1.15 * SHIRT.neck)) ** 2).clip(0.0))
    front = points[:, 2] > 0
    points[:, 1] -= np.where(front, 0.060, 0.020) * near
    points[:, 1] += 0.030 * ease((y - 0.35) / 0.22) * (1.0 - np.abs(x) / 0.2).clip(0.0)
    points[:, 0] *= 1.0 + 0.05 * ease(1.0 - y / 0.2) - 0.03 * np.exp(-(((y - 0.2) / 0.09) ** 2))
    return points


def trim(shirt: Pillow) -> np.ndarray:
    """Numbers of the faces of the hem, the cuffs and the collar of `SHIRT`'s pillow."""
    row, column = shirt.cell.T
    torso, sleeve, below, across = SHIRT.cells
    centre = shirt.points[shirt.quads].mean(axis=1)
    cuffs = (column == 0) | (column == 2 * sleeve + torso - 1)
    collar = (row == below + across - 1) & (np.abs(centre[:, 0]) < SHIRT.neck + 0.01)
    return np.flatnonzero((row == 0) | cuffs | collar)


def _weights(points: np.ndarray) -> Skin:
    """Weights of hips, chest and an arm, from points with level arms."""
    arm = ease((np.abs(points[:, 0]) - 0.10) / 0.15) * _above(points)
    chest = ease((points[:, 1] - SPINE + 0.14) / 0.28)
    count = len(points)
    joints = np.column_stack([np.zeros(count, int), np.ones(count, int), np.where(points[:, 0] > 0, 2, 3)])
    return Skin(joints, np.column_stack([(1.0 - chest) * (1.0 - arm), chest * (1.0 - arm), arm]))


def _skeleton(times: np.ndarray) -> Skeleton:
    """The left and right arms rise and fall in turn, and the chest leans and turns with the arms."""
    bind = np.tile(np.eye(4), (4, 1, 1))
    bind[1, 1, 3] = SPINE
    bind[2, :2, 3] = SHOULDER
    bind[3, :2, 3] = -SHOULDER[0], SHOULDER[1]
    t = (times - times[0]) / (times[-1] - times[0])
    up = ease(t / 0.45) - 2.0 * ease((t - 0.5) / 0.45)  # 1: left raised, right lowered; -1: the reverse
    zero = np.zeros_like(up)
    left = np.where(up > 0, 64.0, 44.0) * up
    right = np.where(up > 0, 44.0, 64.0) * up
    turns = [[zero, -6.0 * up, zero], [zero, -22.0 * up, 17.0 * up], [zero, zero, left], [zero, zero, right]]
    vectors = np.moveaxis(np.array(turns), 2, 0)
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3), degrees=True).as_quat().reshape(-1, 4, 4)
    rotations = np.roll(rotations, 1, axis=2)  # the real part first
    local = bind[:, :3, 3] - bind[[0, 0, 1, 1], :3, 3]
    joints = ("hips", "hips/chest", "hips/chest/arm_left", "hips/chest/arm_right")
    return Skeleton(joints, bind, rotations, np.broadcast_to(local, (len(times), 4, 3)))
