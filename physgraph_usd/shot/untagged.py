"""Finds meshes touched by garments but not named as colliders; the collider ``auto`` uses such meshes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from ..errors import counted
from ..solver.colliders.mesh import MeshBody
from ..solver.colliders.pose import Pose
from ..solver.contact.broad_phase import bounds_of
from ..solver.mesh.kernels import start_warp
from ..solver.resolution import sample_frames
from ..solver.scene import Frame, Garment, GarmentFrame
from ..usd.read.other_meshes import other_meshes
from ..usd.read.reader import Shot, open_shot
from ..usd.stage import at_time
from ..usd.view import Stage

AUTO = "auto"
"""Pseudo-collider: all colliders named by the shot, and the meshes touched by garments."""
NEAR = 0.025
"""Distance within which cloth lies on a body [m]: solvers keep up to 2 cm, plus rounding."""
FAR = f"no cloth comes within {1e3 * NEAR:.0f} mm of it"
"""Reason given for leaving a mesh not touched by cloth."""
MOST_FRAMES = 10
"""Most frames, spread over the shot, searched for contact."""
LIES_ALONG = 2.0
"""Distance within which a mesh lies along cloth, relative to the cloth's offset plus thickness. The outer skin of a
thick export, or a button on the cloth, is about twice as far as the cloth keeps from a body."""
MOST_OF = 0.95
"""Least fraction of a mesh's points lying along cloth and moving with the cloth."""


@dataclass(frozen=True)
class Candidate:
    """A mesh that is neither a garment nor a collider.

    Attributes:
        reason: Why `AUTO` takes or leaves the mesh.
        shares: For each touching garment, the fraction of its vertices inside or near the mesh, in the first examined
            frame with contact; empty for a mesh left out.
        pose: Pose of the mesh in the first frame with contact, or None.
        follows: Path of the garment on which the mesh lies and with which it moves, or "".
    """

    path: str
    reason: str
    shares: Mapping[str, float] = field(default_factory=dict)
    pose: Pose | None = None
    follows: str = ""

    @property
    def is_taken(self) -> bool:
        """Whether `AUTO` takes the mesh."""
        return bool(self.shares)

    @property
    def garment(self) -> str:
        """Path of the garment touching the mesh most."""
        return max(self.shares, key=lambda path: self.shares[path])


def find_candidates(shot: Shot) -> list[Candidate]:
    """Meshes that are neither garments nor colliders, taken if cloth overlaps the mesh or comes within `NEAR`.

    Invisible meshes are not taken, nor trims and second skins, which lie along the cloth and move with the cloth.

    Args:
        shot: An open shot.

    Returns:
        The candidates, sorted by the largest touching fraction of a garment, largest first.

    Raises:
        StageError: USD can no longer read the files.
    """
    frames = sample_frames(shot.every_time, shot.frame, most=MOST_FRAMES)
    if not frames:
        return []
    boxes = [bounds_of(np.concatenate([garment.points for garment in frame.garments])) for frame in frames]
    boxes = [box + np.array([[-NEAR], [NEAR]]) for box in boxes]
    found = []
    for path, why, poses in other_meshes(shot, [frame.time for frame in frames], boxes):
        found.append(Candidate(path, why) if why else _judged(path, poses, shot.scene.garments, frames=frames))
    return sorted(found, key=lambda each: -max(each.shares.values(), default=0.0))


def _judged(
    path: str, poses: Iterator[tuple[int, Pose]], garments: Sequence[Garment], *, frames: Sequence[Frame]
) -> Candidate:
    """Judge a visible mesh, given its poses by frame number: taken or left."""
    start_warp()
    body = MeshBody(device="cpu", threads=1)
    for index, pose in poses:
        cages = [cage.points for cage in frames[index].garments]
        fractions = [_fraction_at(body, pose, cage) for cage in cages]
        if any(fractions):
            most = int(np.argmax(fractions))
            garment = garments[most]
            seen = [(index, pose), *poses]
            if _moves_with(garment, [(frames[k].garments[most], each) for k, each in seen]):
                why = f"it lies on <{garment.path}> and moves with it: a trim, or the garment's own skin"
                return Candidate(path, why, follows=garment.path)
            where = f"{fractions[most]:.0%} of <{garment.path}> is inside or within {1e3 * NEAR:.0f} mm"
            shares = {g.path: fraction for g, fraction in zip(garments, fractions, strict=True) if fraction}
            return Candidate(path, where + at_time(frames[index].time), shares, pose)
    return Candidate(path, f"{FAR} in {counted(len(frames), 'frame')}")


def _moves_with(garment: Garment, frames: Sequence[tuple[GarmentFrame, Pose]]) -> bool:
    """Whether a mesh lies along a cage in the first frame, and stays near the same places of the cage in all frames."""
    (cloth, pose), *later = frames
    triangles = garment.mesh.triangulate(garment.rest).triangles
    surfaces = MeshBody(side="start", device="cpu", threads=1).pose(Pose(cloth.points, triangles))
    if not surfaces:
        return False
    used = np.unique(pose.triangles)
    points = torch.as_tensor(pose.points[used] - surfaces[0].origin)
    reach = LIES_ALONG * (cloth.offset + cloth.fabric.thickness)
    found = surfaces[0].closest(points, torch.full_like(points[:, 0], reach))
    near = found.distance.isfinite().numpy()
    if near.mean() < MOST_OF:
        return False
    corners = surfaces[0].triangles[found.face.numpy()[near]]
    weights = _weights(cloth.points[corners], found.point.numpy()[near] + surfaces[0].origin)
    for other, moved in later:
        if moved.points.shape != pose.points.shape:
            return False
        places = np.einsum("nk,nkd->nd", weights, other.points[corners])
        away = np.linalg.norm(moved.points[used][near] - places, axis=1)
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
    with closing(open_shot(shot, colliders=[each for each in colliders if each != AUTO], **options)) as first:
        named = [*first.colliders, *(each.path for each in find_candidates(first) if each.is_taken)]
    return open_shot(shot, colliders=named, **options)


def _fraction_at(body: MeshBody, pose: Pose, cage: np.ndarray) -> float:
    """Fraction of a cage's vertices inside a body's closed part, or near the body.

    Args:
        cage: Positions of the cage [m], shape (V, 3).

    Returns:
        The fraction; 0 without contact. A room or a sky around the whole cage, with no walls nearby, counts as no
        contact.
    """
    fraction = 0.0
    for surface in body.pose(pose):
        x = torch.as_tensor(cage - surface.origin)
        near = surface.closest(x, torch.full_like(x[:, 0], NEAR)).distance.isfinite()
        inside = surface.inside(x)
        touches = near.any() or (inside.any() and not inside.all())
        fraction = max(fraction, float((near | inside).double().mean())) if bool(touches) else fraction
    return fraction
