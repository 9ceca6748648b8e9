"""Meshes that garments touch and that nothing names as colliders: found, named, and taken by ``auto``."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from shlex import join
from typing import Any

import numpy as np
import torch

from ..errors import StageError, counted
from ..solver.colliders.mesh import MeshBody
from ..solver.colliders.pose import MeshPose, Pose
from ..solver.colliders.sign import signed_distances
from ..solver.contact.broad_phase import bounds_of
from ..solver.mesh.kernels import start_warp
from ..solver.resolution import sample_frames
from ..solver.scene import Frame, Garment, GarmentFrame
from ..solver.strain import StrainedPart, strained_parts
from ..usd.read.reader import Shot, open_shot
from ..usd.read.rest import FITTED
from ..usd.read.untagged import unnamed_meshes
from ..usd.stage import at_time
from ..usd.view import Stage

AUTO = "auto"
"""In place of a collider: all that the shot names, and the meshes that garments touch."""
MOST_ASKED = 32
"""Most open meshes that are tried as garments."""
NEAR = 0.025
"""How near a body is taken for one that cloth lies on [m]: solvers keep up to 2 cm, and rounding adds."""
FAR = f"no cloth comes within {1e3 * NEAR:.0f} mm of it"
"""Reason for which a mesh is left that cloth does not touch."""
MOST_FRAMES = 10
"""Most frames, spread over the shot, in which it is looked what cloth touches."""
LIES_ALONG = 2.0
"""Distance within which a mesh lies along cloth, in what cloth keeps from a body, its offset and thickness: the outer
skin of a thick export and a button on the cloth are about as far again."""
MOST_OF = 0.95
"""Fraction of a mesh's points that lies along cloth and moves with it."""


@dataclass(frozen=True)
class Candidate:
    """A mesh that is neither a garment nor a collider.

    Attributes:
        path: The mesh.
        reason: Why `AUTO` takes it, or leaves it.
        shares: For each garment that touches it, the fraction of its vertices that is in it or near it, in the first
            frame looked at where any is; empty where it is left.
        pose: Where the mesh is in that frame, or None.
    """

    path: str
    reason: str
    shares: Mapping[str, float] = field(default_factory=dict)
    pose: Pose | None = None

    @property
    def is_taken(self) -> bool:
        """Whether `AUTO` takes it."""
        return bool(self.shares)

    @property
    def garment(self) -> str:
        """Path of the garment that touches it most."""
        return max(self.shares, key=lambda path: self.shares[path])


def find_candidates(shot: Shot) -> list[Candidate]:
    """Meshes that are neither garments nor colliders, taken where cloth overlaps them or lies within `NEAR` of them.

    Not taken are meshes that are not drawn, and trims and second skins: they lie along the cloth and move with it.

    Args:
        shot: An open shot.

    Returns:
        What was found, the one that most of a garment touches first.

    Raises:
        StageError: USD cannot read the files any more.
    """
    frames = sample_frames(shot.every_time, shot.frame, most=MOST_FRAMES)
    if not frames:
        return []
    boxes = [bounds_of(np.concatenate([garment.points for garment in frame.garments])) for frame in frames]
    boxes = [box + np.array([[-NEAR], [NEAR]]) for box in boxes]
    found = []
    for path, why, poses in unnamed_meshes(shot, [frame.time for frame in frames], boxes):
        found.append(Candidate(path, why) if why else _judged(path, poses, shot.scene.garments, frames=frames))
    return sorted(found, key=lambda each: -max(each.shares.values(), default=0.0))


def _judged(
    path: str, poses: Iterator[tuple[int, Pose]], garments: Sequence[Garment], *, frames: Sequence[Frame]
) -> Candidate:
    """A mesh that is drawn, given its poses by number of the frame, taken or left."""
    start_warp()
    body = MeshBody(device="cpu", threads=1)
    for index, pose in poses:
        cages = [cage.points for cage in frames[index].garments]
        fractions = [_fraction_at(body, pose, *each) for each in zip(garments, cages, strict=True)]
        if any(fractions):
            most = int(np.argmax(fractions))
            garment = garments[most]
            seen = [(index, pose), *poses]
            if _moves_with(garment, [(frames[k].garments[most], each) for k, each in seen]):
                why = f"it lies on <{garment.path}> and moves with it: a trim, or the garment's own skin"
                return Candidate(path, why)
            where = f"{fractions[most]:.0%} of <{garment.path}> is inside or within {1e3 * NEAR:.0f} mm"
            shares = {g.path: fraction for g, fraction in zip(garments, fractions, strict=True) if fraction}
            return Candidate(path, where + at_time(frames[index].time), shares, pose)
    return Candidate(path, f"{FAR} in {counted(len(frames), 'frame')}")


def _moves_with(garment: Garment, frames: Sequence[tuple[GarmentFrame, Pose]]) -> bool:
    """Whether a mesh lies along a cage in the first of some frames, and stays near the same places of it in all."""
    (cloth, pose), *later = frames
    triangles = garment.mesh.triangulate(garment.rest).triangles
    surfaces = MeshBody(side="start", device="cpu", threads=1).pose(MeshPose(cloth.points, triangles))
    if not isinstance(pose, MeshPose) or not surfaces:
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
        if not isinstance(moved, MeshPose) or moved.points.shape != pose.points.shape:
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
    """Open a shot, where `AUTO` among the colliders stands for the candidates that are taken.

    Args:
        shot: As `open_shot` takes it.
        colliders: As `open_shot` takes them, or `AUTO` among them.
        options: Its other options.

    Raises:
        UsageError: When an option cannot be used.
        StageError: When the stage cannot be read.
    """
    if AUTO not in colliders:
        return open_shot(shot, colliders=colliders, **options)
    with closing(open_shot(shot, colliders=[each for each in colliders if each != AUTO], **options)) as first:
        named = [*first.colliders, *(each.path for each in find_candidates(first) if each.is_taken)]
    return open_shot(shot, colliders=named, **options)


def proposal(shot: str | Stage, meshes: Sequence[str], frames: tuple[float, float] | None) -> str:
    """The command for a shot in which nothing is marked: open meshes that lie on closed ones are its garments.

    Args:
        shot: The shot.
        meshes: Its open meshes, the largest first.
        frames: First and last time code, or None.

    Returns:
        The command, or "" where there are none, or they cannot be read together.
    """
    try:
        with closing(open_shot(shot, garments=meshes[:MOST_ASKED], frames=frames)) as opened:
            sampled = sample_frames(opened.every_time, opened.frame)
            found = [each for each in find_candidates(opened) if each.is_taken]
            lying = {path for each in found for path in each.shares}
            garments = [garment.path for garment in opened.scene.garments if garment.path in lying]
            bodies, rest = [each.path for each in found], rest_options(_strained(opened, sampled, garments))
            return command_of(opened.path, garments, bodies, rest=rest) if found else ""
    except StageError:
        return ""


def command_of(shot: str, garments: Iterable[str], colliders: Iterable[str], *, rest: Sequence[str]) -> str:
    """The command that refines a shot's garments with colliders; ``rest`` as of `rest_options`."""
    out = str(Path(shot).with_suffix(".refined.usdc"))
    words = ["physgraph-usd", "refine", shot, "-o", out, *rest]
    return join([*words, *options_of("--garment", garments), *options_of("--collider", colliders)])


def rest_options(strained: Iterable[tuple[str, Sequence[StrainedPart]]]) -> list[str]:
    """``--rest auto`` as words of a command, where a garment needs it.

    Args:
        strained: For each garment where its rest shape is from, and the parts that are not of its size.
    """
    wrong = any(part.needs_rest for source, parts in strained if not source.startswith(FITTED) for part in parts)
    return ["--rest", "auto"] if wrong else []


def options_of(name: str, values: Iterable[str]) -> list[str]:
    """An option for each of some values, as words of a command."""
    return [word for value in values for word in (name, value)]


def _strained(
    shot: Shot, frames: Sequence[Frame], paths: Sequence[str]
) -> Iterator[tuple[str, Sequence[StrainedPart]]]:
    """Source of the rest shape of some garments, and their parts that are not of its size."""
    for index, (garment, source) in enumerate(zip(shot.scene.garments, shot.sources, strict=True)):
        if garment.path in paths:
            cages = [frame.garments[index].points for frame in frames]
            yield source.sources["rest"], strained_parts(garment, cages, source.subsets, up=-shot.scene.gravity)


def _fraction_at(body: MeshBody, pose: Pose, garment: Garment, cage: np.ndarray) -> float:
    """Fraction of a cage's vertices that is in a body's closed part or near it or its open part.

    Args:
        body: The body.
        pose: Where it is.
        garment: The garment.
        cage: Positions of its cage [m], shape (V, 3).

    Returns:
        The fraction; 0 where it does not touch it. A room or a sky that holds all of it, with nothing near its walls,
        is not touched.
    """
    fraction, edges = 0.0, torch.as_tensor(garment.mesh.half_edges.edges)
    for surface in body.pose(pose) if isinstance(pose, MeshPose) else ():
        signed = signed_distances(surface, torch.as_tensor(cage - surface.origin), edges, reach=2.0 * NEAR)
        touches = (signed.abs() <= NEAR).any() or ((signed < 0).any() and (signed > 0).any())
        fraction = max(fraction, float((signed <= NEAR).double().mean())) if bool(touches) else fraction
    return fraction
