"""Finds bodies touched by garments but not named as colliders; the collider ``auto`` uses such bodies."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ...errors import StageError, counted
from ...solver.colliders.pose import Pose, bounds_of
from ...solver.resolution import sample_frames
from ...solver.scene import Garment
from ...usd.read.other_bodies import OtherBody, other_bodies
from ...usd.read.reader import Shot, open_shot
from ...usd.stage import at_time
from ...usd.view import Stage

if TYPE_CHECKING:
    from ...solver.colliders.mesh import MeshBody

AUTO = "auto"
"""Pseudo-collider: all colliders named by the shot, and the bodies touched by garments."""
UNREAD = "its shape is not read: convert it to a Mesh"
"""Reason given for leaving a shape that is not read."""
NEAR = 0.025
"""Distance within which cloth lies on a body [m]: solvers keep up to 2 cm, plus rounding."""
FAR = f"no cloth comes within {1e3 * NEAR:.0f} mm of it"
"""Reason given for leaving a body not touched by cloth."""
LOOKED = 0.2
"""Distance within which the gap between cloth and a body is measured [m], to pass over frames without contact."""
MOST_FRAMES = 10
"""Most frames, spread over the shot, in which a body that touches cloth is looked at again."""
LITTLE = 0.1
"""Fraction of a garment in the first frame with contact below which the largest of `MOST_FRAMES` is reported."""
MOST_POINTS = 20_000
"""Most points of a body that are compared."""
LIES_ALONG = 2.0
"""Distance within which a body lies along cloth, relative to the cloth's offset plus thickness. The outer skin of a
thick export, or a button on the cloth, is about twice as far as the cloth keeps from a body."""
MOST_OF = 0.95
"""Least fraction of a body's points lying along cloth and moving with the cloth."""


@dataclass(frozen=True)
class Candidate:
    """A body that is neither a garment nor a collider.

    Attributes:
        reason: Why `AUTO` takes or leaves the body.
        shares: For each touching garment, the fraction of its vertices inside or near the body, in an early frame with
            contact; empty for a body left out.
        pose: Pose of the body in that frame, or None.
        follows: Path of the garment on which the body lies and with which it moves, or "".
        unread: Type of a body near cloth whose shape is not read, or "".
    """

    path: str
    reason: str
    shares: Mapping[str, float] = field(default_factory=dict)
    pose: Pose | None = None
    follows: str = ""
    unread: str = ""

    @property
    def is_taken(self) -> bool:
        """Whether `AUTO` takes the body."""
        return bool(self.shares)

    @property
    def garment(self) -> str:
        """Path of the garment touching the body most."""
        return max(self.shares, key=lambda path: self.shares[path])


def find_candidates(shot: Shot) -> list[Candidate]:
    """Bodies that are neither garments nor colliders, taken if cloth overlaps the body or comes within `NEAR`.

    Every sample of the garments is searched. Invisible bodies are not taken, nor trims and second skins, which lie
    along the cloth and move with the cloth, nor shapes that are not read.

    Args:
        shot: An open shot.

    Returns:
        The candidates, sorted by the largest touching fraction of a garment, largest first.

    Raises:
        StageError: USD can no longer read the files.
    """
    cloth = _Cloth.of(shot)
    if cloth is None:
        return []
    bodies = other_bodies(shot, cloth.times, cloth.boxes)
    candidates = [Candidate(body.path, body.why) if body.why else _judged(body, cloth) for body in bodies]
    judged = [candidate for candidate in candidates if candidate is not None]
    return sorted(judged, key=lambda candidate: -max(candidate.shares.values(), default=0.0))


@dataclass(frozen=True, eq=False)
class _Cloth:
    """The cages of a shot's garments at every sample.

    Attributes:
        times: Time codes of the frames that can be read.
        boxes: Bounds of all cages and their neighbourhood in each frame [m], each of shape (2, 3).
        along: Distance within which a body lies along each garment [m].
    """

    shot: Shot
    times: Sequence[float | None]
    boxes: Sequence[np.ndarray]
    along: Sequence[float]

    @classmethod
    def of(cls, shot: Shot) -> _Cloth | None:
        """The cloth of a shot; None if no frame can be read."""
        boxes: dict[float | None, np.ndarray] = {}
        for time in shot.every_time or (None,):
            with suppress(StageError):
                cages = [shot.cage(index, time) for index in range(len(shot.sources))]
                boxes[time] = bounds_of(np.concatenate(cages)) + np.array([[-NEAR], [NEAR]])
        first = sample_frames(shot.every_time, shot.frame, most=1) if boxes else []
        if not first:
            return None
        along = [LIES_ALONG * (cage.offset + cage.fabric.thickness) for cage in first[0].garments]
        return cls(shot, [*boxes], [*boxes.values()], along)

    def cages(self, index: int) -> list[np.ndarray]:
        """Positions of each cage in a frame by number [m], each of shape (V, 3)."""
        return [self.shot.cage(number, self.times[index]) for number in range(len(self.shot.sources))]


def _judged(body: OtherBody, cloth: _Cloth) -> Candidate | None:
    """Judge a visible body: taken or left; None for a shape that is not read and not near cloth.

    After a frame in which cloth and body are apart, frames are passed over while neither has moved far enough to meet.
    """
    from ...solver.colliders.mesh import MeshBody
    from ...solver.mesh.kernels import start_warp

    start_warp()
    solid = MeshBody(device="cpu", threads=1)
    apart: tuple[float, list[np.ndarray], np.ndarray] | None = None
    for index in body.frames:
        cages, hull = cloth.cages(index), body.hull(index)
        if apart is not None and apart[0] - _moved([*apart[1], apart[2]], [*cages, hull]) > NEAR:
            continue
        pose = body.pose(index)
        if pose is None:
            continue
        near = [_nearness(solid, pose, cage) for cage in cages]
        fractions = [fraction for fraction, _ in near]
        if any(fractions):
            return _touched(body, solid, cloth, (index, fractions))
        apart = min(gap for _, gap in near), cages, hull
    return None if body.unread else Candidate(body.path, f"{FAR} in {counted(len(cloth.times), 'frame')}")


def _touched(body: OtherBody, solid: MeshBody, cloth: _Cloth, first: tuple[int, Sequence[float]]) -> Candidate:
    """The candidate of a body that touches cloth, given the first frame with contact and each garment's fraction."""
    index, fractions = first
    most = int(np.argmax(fractions))
    garment, later = cloth.shot.scene.garments[most], [number for number in body.frames if number > index]
    picks = np.linspace(0, len(later) - 1, min(MOST_FRAMES, len(later))).round().astype(int)
    frames = [index, *(later[pick] for pick in picks)]
    pairs = ((cloth.cages(number)[most], body.pose(number)) for number in frames)
    if _moves_with(garment, [(cage, pose) for cage, pose in pairs if pose is not None], reach=cloth.along[most]):
        reason = f"it lies on <{garment.path}> and moves with it: a trim, or the garment's own skin"
        return Candidate(body.path, reason, follows=garment.path)
    if body.unread:
        return Candidate(body.path, UNREAD, unread=body.unread)
    for number in frames[1:] if fractions[most] < LITTLE else ():
        pose = body.pose(number)
        later_fractions = [0.0 if pose is None else _nearness(solid, pose, cage)[0] for cage in cloth.cages(number)]
        index, fractions = max((index, fractions), (number, later_fractions), key=lambda entry: max(entry[1]))
    most = int(np.argmax(fractions))
    garment = cloth.shot.scene.garments[most]
    share_text = f"{percent(fractions[most])} of <{garment.path}> is inside or within {1e3 * NEAR:.0f} mm"
    shares = {g.path: part for g, part in zip(cloth.shot.scene.garments, fractions, strict=True) if part}
    return Candidate(body.path, share_text + at_time(cloth.times[index]), shares, body.pose(index))


def percent(fraction: float) -> str:
    """A fraction above 0 in words."""
    return f"{fraction:.0%}" if fraction >= 0.005 else "under 1%"


def _moved(before: Sequence[np.ndarray], after: Sequence[np.ndarray]) -> float:
    """Sum of the largest move of the cages and of the body [m], the last of the arrays; infinite for unlike arrays."""
    pairs = list(zip(before, after, strict=True))
    if any(a.shape != b.shape for a, b in pairs):
        return np.inf
    moves = [float(np.linalg.norm(b - a, axis=1).max(initial=0.0)) for a, b in pairs]
    return max(moves[:-1], default=0.0) + moves[-1]


def _moves_with(garment: Garment, frames: Sequence[tuple[np.ndarray, Pose]], *, reach: float) -> bool:
    """Whether a body lies along a cage in the first frame, and stays near the same places of the cage in all frames.

    Args:
        frames: Positions of the cage [m], shape (V, 3), and the body's pose.
        reach: Distance from the cage [m].
    """
    import torch

    from ...solver.colliders.mesh import MeshBody

    (cage, pose), *later = frames
    triangles = garment.mesh.triangulate(garment.rest).triangles
    surfaces = MeshBody(side="start", device="cpu", threads=1).pose(Pose(cage, triangles))
    if not surfaces:
        return False
    used = np.unique(pose.triangles) if len(pose.triangles) else np.arange(len(pose.points))
    used = used[:: max(1, len(used) // MOST_POINTS)]
    points = torch.as_tensor(pose.points[used] - surfaces[0].origin)
    nearest = surfaces[0].closest(points, torch.full_like(points[:, 0], reach))
    near = nearest.distance.isfinite().numpy()
    if near.mean() < MOST_OF:
        return False
    corners = surfaces[0].triangles[nearest.face.numpy()[near]]
    weights = _weights(cage[corners], nearest.point.numpy()[near] + surfaces[0].origin)
    for later_cage, moved in later:
        if moved.points.shape != pose.points.shape:
            return False
        attached = np.einsum("nk,nkd->nd", weights, later_cage[corners])
        away = np.linalg.norm(moved.points[used][near] - attached, axis=1)
        if np.quantile(away, MOST_OF) > reach:
            return False
    return True


def _weights(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Barycentric coordinates of points on triangles of shape (N, 3, 3), one a triangle, shape (N, 3)."""
    spokes = triangles - points[:, None]
    areas = np.linalg.norm(np.cross(np.roll(spokes, -1, axis=1), np.roll(spokes, -2, axis=1)), axis=2)
    return areas / np.maximum(areas.sum(axis=1, keepdims=True), np.finfo(float).tiny)


def open_with_colliders(shot: str | os.PathLike[str] | Stage, *, colliders: Sequence[str] = (), **options: Any) -> Shot:
    """Open a shot, replacing `AUTO` among the colliders by the candidates taken.

    Args:
        shot: As in `open_shot`.
        colliders: As in `open_shot`, or `AUTO` among the paths.
        options: Other options of `open_shot`.

    Raises:
        UsageError: When an option cannot be used.
        StageError: When the stage cannot be read.
    """
    if AUTO not in colliders:
        return open_shot(shot, colliders=colliders, **options)
    with closing(open_shot(shot, colliders=[path for path in colliders if path != AUTO], **options)) as first:
        named = [*first.colliders, *(candidate.path for candidate in find_candidates(first) if candidate.is_taken)]
    return open_shot(shot, colliders=named, **options)


def _nearness(body: MeshBody, pose: Pose, cage: np.ndarray) -> tuple[float, float]:
    """Fraction of a cage's vertices inside a body's closed part, or near the body; and the least distance [m].

    Args:
        pose: The body's pose; without triangles, its points count.
        cage: Positions of the cage [m], shape (V, 3).

    Returns:
        The fraction, 0 without contact, and the distance, at most `LOOKED`. A room or a sky around the whole cage, with
        no walls nearby, counts as no contact.
    """
    import torch
    from scipy.spatial import cKDTree

    fraction, gap = 0.0, LOOKED
    if not len(pose.triangles):
        points = pose.points[np.isfinite(pose.points).all(axis=1)]
        away = cKDTree(points).query(cage, distance_upper_bound=LOOKED)[0] if len(points) else np.full(1, LOOKED)
        return float(np.mean(away <= NEAR)), min(gap, float(np.min(away)))
    for surface in body.pose(pose):
        x = torch.as_tensor(cage - surface.origin)
        near = surface.closest(x, torch.full_like(x[:, 0], NEAR)).distance.isfinite()
        inside = surface.inside(x)
        touches = near.any() or (inside.any() and not inside.all())
        if bool(touches):
            fraction = max(fraction, float((near | inside).double().mean()))
        elif not fraction:
            gap = min(gap, float(surface.closest(x, torch.full_like(x[:, 0], LOOKED)).distance.min()))
    return fraction, gap
