"""Closest points on spheres, capsules, cylinders, boxes and planes, in closed form."""

from __future__ import annotations

import functools

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from trimesh import creation

from .base import Nearest, Solid
from .pose import Pose, ShapePose

AROUND = 64
"""Triangles around a capsule or a cylinder: between them a round surface is a thousandth of its radius higher."""
WIDE = 1e3
"""Half size of the square that stands for a plane [m]."""


class ShapeSurface:
    """A primitive at one pose; exact on the surface, outside and inside.

    Attributes:
        closed: True.
        fixed_side: None.
        origin: World position of the centre [m], shape (3,), float64.
        bounds: Least and greatest corner [m], infinite for a plane, shape (2, 3), float64.
    """

    closed = True
    fixed_side: float | None = None

    def __init__(self, pose: ShapePose, *, device: str = "cpu") -> None:
        """Take a pose."""
        self._pose = pose
        self._turn = torch.as_tensor(pose.turn, device=device)
        self._size = torch.as_tensor(pose.size, device=device)
        self.origin = pose.centre

    @property
    def solid(self) -> Solid:
        """The shape divided into triangles, about its centre."""
        return _solid(self._pose.kind, *map(float, self._pose.size))

    @property
    def world(self) -> np.ndarray:
        """World positions of the solid's corners [m], shape (B, 3), float64."""
        return self.solid.points @ self._pose.turn.T + self._pose.centre

    def placed(self, pose: Pose) -> np.ndarray | None:
        """World positions of the corners in another pose [m]; None if the pose is of another shape."""
        if not isinstance(pose, ShapePose) or pose.kind != self._pose.kind:
            return None
        return _solid(pose.kind, *map(float, pose.size)).points @ pose.turn.T + pose.centre

    @property
    def bounds(self) -> np.ndarray:
        """Least and greatest corner [m], shape (2, 3)."""
        if self._pose.kind == "plane":
            return np.stack([np.full(3, -np.inf), np.full(3, np.inf)])
        size = self._pose.size + np.array([0.0, 0.0, self._pose.size[0] if self._pose.kind == "capsule" else 0.0])
        half = np.abs(self._pose.turn) @ size
        return np.stack([-half, half])

    def closest(self, x: Float[Tensor, "points 3"], reach: Float[Tensor, " points"]) -> Nearest:
        """The closest points; an arbitrary choice if there are several, as at a sphere's centre."""
        turn, size = self._turn.to(x), self._size.to(x)
        local = x @ turn
        signed, normal = _SHAPES[self._pose.kind](local, size)
        point = local - signed.unsqueeze(1) * normal
        distance = torch.where(signed.abs() <= reach, signed.abs(), torch.full_like(signed, float("inf")))
        side = torch.where(signed < 0, -torch.ones_like(signed), torch.ones_like(signed))
        rim = torch.zeros_like(side, dtype=torch.bool)
        face = torch.full_like(side, -1, dtype=torch.int32)
        return Nearest(distance, point @ turn.T, normal @ turn.T, side, rim, face)

    def inside(self, x: Float[Tensor, "points 3"], *, parts: int = 1) -> Bool[Tensor, " points"]:
        """Mask of the points inside; a shape has a single part."""
        if parts > 1:
            return torch.zeros_like(x[:, 0], dtype=torch.bool)
        return _SHAPES[self._pose.kind](x @ self._turn.to(x), self._size.to(x))[0] < 0

    def exit(self, x: Float[Tensor, "points 3"], found: Nearest) -> Nearest:
        """The closest points, unchanged: a convex shape has no buried faces."""
        return found


def _ball(x: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distance to a ball about zero and its gradient; up at the centre."""
    length = x.norm(dim=1)
    up = torch.zeros_like(x)
    up[:, 2] = 1.0
    normal = torch.where(length.unsqueeze(1) > 0, x / length.clamp_min(torch.finfo(x.dtype).tiny).unsqueeze(1), up)
    return length - radius, normal


def _sphere(x: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    return _ball(x, size[0])


def _capsule(x: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    from_axis = x.clone()
    from_axis[:, 2] -= x[:, 2].clamp(-float(size[2]), float(size[2]))
    signed, normal = _ball(from_axis, size[0])
    sideways = torch.zeros_like(x)
    sideways[:, 0] = 1.0
    on_axis = (from_axis == 0).all(dim=1, keepdim=True)
    return signed, torch.where(on_axis, sideways, normal)


def _plane(x: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    normal = torch.zeros_like(x)
    normal[:, 2] = 1.0
    return x[:, 2], normal


def _cube(x: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    sign = torch.where(x < 0, -torch.ones_like(x), torch.ones_like(x))
    return _corner(x.abs() - size, sign)


def _cylinder(x: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    radius = x[:, :2].norm(dim=1)
    out = torch.stack([radius - size[0], x[:, 2].abs() - size[2]], dim=1)
    signed, direction = _corner(out, torch.ones_like(out))
    sideways = torch.zeros_like(x[:, :2])
    sideways[:, 0] = 1.0
    tiny = torch.finfo(x.dtype).tiny
    around = torch.where(radius.unsqueeze(1) > 0, x[:, :2] / radius.clamp_min(tiny).unsqueeze(1), sideways)
    upward = torch.where(x[:, 2:] < 0, -torch.ones_like(x[:, 2:]), torch.ones_like(x[:, 2:]))
    return signed, torch.cat([direction[:, :1] * around, direction[:, 1:] * upward], dim=1)


def _corner(out: Tensor, sign: Tensor) -> tuple[Tensor, Tensor]:
    """Distance to a box's corner region, from how far a point is past each face, and its gradient."""
    beyond = out.clamp_min(0.0)
    length = beyond.norm(dim=1)
    deepest = out.argmax(dim=1)
    nearest_face = torch.nn.functional.one_hot(deepest, out.shape[1]).to(out)
    outside = length > 0
    direction = torch.where(
        outside.unsqueeze(1), beyond / length.clamp_min(torch.finfo(out.dtype).tiny).unsqueeze(1), nearest_face
    )
    return torch.where(outside, length, out.max(dim=1).values), direction * sign


@functools.lru_cache(maxsize=64)
def _solid(kind: str, x: float, y: float, z: float) -> Solid:
    """A shape of given half sizes [m] divided into triangles."""
    if kind == "plane":
        square = WIDE * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
        return Solid.of(square, np.array([[0, 1, 2], [0, 2, 3]]))
    made = {
        "sphere": lambda: creation.icosphere(subdivisions=4, radius=x),
        "capsule": lambda: creation.capsule(height=2.0 * z, radius=x, count=(AROUND, AROUND)),
        "cylinder": lambda: creation.cylinder(radius=x, height=2.0 * z, sections=AROUND),
        "cube": lambda: creation.box(extents=(2.0 * x, 2.0 * y, 2.0 * z)),
    }[kind]()
    points = made.vertices - (made.bounds.mean(axis=0) if kind == "capsule" else 0.0)
    return Solid.of(np.asarray(points), np.asarray(made.faces))


_SHAPES = {"sphere": _sphere, "capsule": _capsule, "cylinder": _cylinder, "cube": _cube, "plane": _plane}
