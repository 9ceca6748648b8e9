"""A T-shirt on a body whose arm goes down to the side and up again: sleeve and side are pinched in the armpit.

Shirt and body are moved by one kind of map, as skinning moves them: about the armpit it turns the arm, closes the space
below it and opens the space above it. No two points are ever brought to one place, so the coarse shirt does not cross
itself, however narrow the space gets.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import PchipInterpolator

from ...solver.fabric import PRESETS
from ...usd.write.plain import Look, PlainStage
from .panel import sew
from .shapes import CANVAS, Solid, at_height, ease, ellipsoid, join, lathe, mesh, rings
from .tshirt import SHIRT, dress, trim

ARMPIT = (0.202, 0.403)
"""Where the left arm turns, just below the seam: distance from the middle and height [m]."""
TORSO = np.array(
    [
        [0.560, 0.080, 0.040],
        [0.545, 0.130, 0.058],
        [0.520, 0.165, 0.078],
        [0.480, 0.182, 0.098],
        [0.420, 0.193, 0.114],
        [0.350, 0.193, 0.122],
        [0.250, 0.187, 0.122],
        [0.150, 0.184, 0.122],
        [0.050, 0.190, 0.122],
        [-0.06, 0.180, 0.116],
        [-0.10, 0.140, 0.090],
    ]
)
"""The torso: height, half axes across and deep [m]."""
ARM = np.array([[0.14, 0.068], [0.22, 0.071], [0.34, 0.070], [0.42, 0.054], [0.56, 0.040]])
"""An arm, level: distance from the middle and radius [m]."""
RAISED, HANGING, WORN = 18.0, 86.0, 45.0
"""How far the arm points down at the ends of the shot, in its middle, and in the rest shape [degrees]."""
PRESSED = 7.0
"""How much farther down the hanging arm points than its sleeve, which it presses to the side [degrees]."""
SUNK = 0.24
"""By how much the shoulder comes closer to the armpit when the arm hangs."""
FRAMES = 30


def build() -> PlainStage:
    """A shirt with two materials, pinned at the collar, and a body of closed parts that overlap."""
    shirt = sew(SHIRT)
    level = dress(shirt)
    rest = _lower(level, WORN, WORN) * (1.02, 1.04, 1.02)
    down = [float(ease(2.0 * t) - ease(2.0 * t - 1.0)) for t in np.linspace(0.0, 1.0, FRAMES)]
    angles = [(RAISED + (HANGING - RAISED) * d, RAISED + 20.0 * d) for d in down]
    pressed = [(left + PRESSED * d, right) for (left, right), d in zip(angles, down, strict=True)]
    garment = mesh(
        "Shirt",
        shirt.quads,
        rest,
        Look("Body", (0.36, 0.22, 0.40)),
        samples=np.stack([_lower(level, *pair) for pair in angles]),
        uv=shirt.uv,
        subsets=((Look("Trim", (0.74, 0.70, 0.62)), trim(shirt)),),
        pin=((np.abs(shirt.points[:, 0]) < 0.12) & (shirt.points[:, 1] > 0.56)).astype(float),
        fabric=PRESETS["jersey"],
    )
    moving = join(_torso(), _arm(1.0), _arm(-1.0))
    neck = ellipsoid(np.array([0.050, 0.130, 0.048]), np.array([0.0, 0.60, -0.005]), (24, 14))
    poses = [_lower(moving.points, *pair, below=(-95.0, 2.5)) for pair in pressed]
    solids = [join(Solid(pose, moving.counts, moving.indices), neck) for pose in poses]
    samples = np.stack([solid.points for solid in solids])
    body = solids[0].collider("Form", CANVAS, samples=samples)
    doc = "A T-shirt pinched between a hanging arm and the side"
    return PlainStage("ArmpitShot", doc, (garment, body), 1.0 + np.arange(FRAMES))


def _lower(points: np.ndarray, left: float, right: float, *, below: tuple[float, float] = (-89.0, -1.5)) -> np.ndarray:
    """Lower level arms and what is on them by angles [degrees]; nothing of them may lie between two angles below."""
    side = np.where(points[:, 0] >= 0.0, 1.0, -1.0)
    x, y = side * points[:, 0] - ARMPIT[0], points[:, 1] - ARMPIT[1]
    reach, angle = np.hypot(x, y), np.degrees(np.arctan2(y, x))
    down = np.where(side > 0.0, left, right)
    turned = np.radians(np.where(side > 0.0, _close(angle, left, below), _close(angle, right, below)))
    reach *= 1.0 - SUNK * down / 90.0 * np.exp(-(((angle - 68.0) / 45.0) ** 2))
    x, y = ARMPIT[0] + reach * np.cos(turned), ARMPIT[1] + reach * np.sin(turned)
    return np.stack([side * x, y, points[:, 2]], axis=1)


def _close(angle: np.ndarray, down: float, below: tuple[float, float]) -> np.ndarray:
    """Turn directions from the armpit [degrees]: torso, free space between two angles, arm to 50, shoulder to 128."""
    start = np.array([-180.0, -120.0, *below, 50.0, 128.0, 150.0, 180.0])
    moved = start - down * np.array([0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    return PchipInterpolator(start, moved)(angle)


def _torso() -> Solid:
    """The torso as rings that are closer together at the shoulders."""
    around, rows = 56, 30
    height = TORSO[0, 0] - (TORSO[0, 0] - TORSO[-1, 0]) * np.linspace(0.0, 1.0, rows) ** 1.3
    across, deep = at_height(TORSO, height)
    return lathe(
        rings(across, height, deep, around),
        np.array([[0.0, TORSO[0, 0] + 0.005, 0.0], [0.0, TORSO[-1, 0] - 0.015, 0.0]]),
    )


def _arm(side: float) -> Solid:
    """A level arm with rounded ends, from inside the torso outward."""
    turn = np.linspace(0.15, 0.5 * np.pi, 5)
    (first, thick), (last, thin) = ARM[0], ARM[-1]
    along = np.concatenate(
        [first - 0.5 * thick * np.cos(turn), np.linspace(first, last, 22)[1:-1], last + thin * np.cos(turn[::-1])]
    )
    radius = np.interp(along, ARM[:, 0], ARM[:, 1])
    radius[:5], radius[-5:] = thick * np.sin(turn), thin * np.sin(turn[::-1])
    a = 2 * np.pi * np.arange(28) / 28
    height = 0.5 * (SHIRT.armpit + SHIRT.shoulder) - 0.005
    ring = [along[:, None], height + radius[:, None] * np.cos(a), 0.94 * radius[:, None] * np.sin(a)]
    solid = lathe(
        np.stack(np.broadcast_arrays(*ring), axis=-1),
        np.array([[first - 0.51 * thick, height, 0.0], [last + 1.01 * thin, height, 0.0]]),
    )
    return Solid(solid.points * (side, 1.0, side), solid.counts, solid.indices)
