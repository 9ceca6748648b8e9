"""Closed meshes that garments touch and that nothing names as colliders: found, named, and taken by ``auto``."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from shlex import join
from typing import Any

import numpy as np
import torch

from ..errors import StageError
from ..solver.colliders.mesh import MeshBody
from ..solver.colliders.pose import MeshPose, Pose
from ..solver.colliders.sign import signed_distances
from ..solver.contact.broad_phase import bounds_of, mean_edge
from ..solver.mesh.kernels import start_warp
from ..solver.resolution import sample_frames
from ..solver.scene import Frame, Garment
from ..solver.strain import StrainedPart, strained_parts
from ..usd.read.reader import Shot, open_shot
from ..usd.read.rest import FITTED
from ..usd.read.untagged import meshes_beside
from ..usd.view import Stage

AUTO = "auto"
"""In place of a collider: all that the shot names, and closed meshes that garments touch."""
MOST_ASKED = 32
"""Most open meshes that are tried as garments."""
NEAR = 0.025
"""How near a body is taken for one that cloth lies on [m]: solvers keep up to 2 cm, and rounding adds."""
TRIM = 4.0
"""Bodies without a side of so many of the cage's edges are buttons and buckles: no cloth drapes over them."""


@dataclass(frozen=True)
class Beside:
    """A closed mesh that a garment touches and does not feel.

    Attributes:
        path: The mesh.
        shares: For each garment that touches it, the share of its vertices that is in it or near it, in the first frame
            looked at where any is.
        pose: Where the mesh is in that frame.
    """

    path: str
    shares: Mapping[str, float]
    pose: Pose

    @property
    def garment(self) -> str:
        """Path of the garment that touches it most."""
        return max(self.shares, key=lambda path: self.shares[path])


def bodies_beside(shot: Shot, frames: Sequence[Frame]) -> list[Beside]:
    """Closed meshes that are neither garments nor colliders and that garments overlap or lie within `NEAR` of.

    Args:
        shot: An open shot.
        frames: A few of its frames, of which the first, the middle and the last are read.

    Returns:
        What was found, the one that most of a garment touches first.

    Raises:
        StageError: USD cannot read the files any more.
    """
    sampled = list(dict.fromkeys(frames[k] for k in (0, len(frames) // 2, -1) if frames))
    boxes = [bounds_of(np.concatenate([garment.points for garment in frame.garments])) for frame in sampled]
    boxes = [box + np.array([[-NEAR], [NEAR]]) for box in boxes]
    least, found = _smallest_body(shot.scene.garments), []
    for path, poses in meshes_beside(shot, [frame.time for frame in sampled], boxes, least=least):
        start_warp()
        body = MeshBody(device="cpu", threads=1)
        for index, pose in poses:
            cages = zip(shot.scene.garments, sampled[index].garments, strict=True)
            shares = {
                g.path: _fraction_at(body, pose, g, cage.points) for g, cage in cages if isinstance(pose, MeshPose)
            }
            touched = {path: share for path, share in shares.items() if share}
            if touched:
                found.append(Beside(path, touched, pose))
                break
    return sorted(found, key=lambda each: -max(each.shares.values()))


def open_with_colliders(shot: str | os.PathLike[str] | Stage, *, colliders: Sequence[str] = (), **options: Any) -> Shot:
    """Open a shot, where `AUTO` among the colliders stands for the meshes of `bodies_beside`.

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
        beside = bodies_beside(first, sample_frames(first.every_time, first.frame))
        named = [*first.colliders, *(each.path for each in beside)]
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
            found = bodies_beside(opened, sampled)
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


def _smallest_body(garments: Sequence[Garment]) -> float:
    """Longest side of the smallest body that some garment could drape over [m]."""
    return TRIM * min(map(mean_edge, garments), default=0.0)


def _fraction_at(body: MeshBody, pose: MeshPose, garment: Garment, cage: np.ndarray) -> float:
    """Fraction of a cage's vertices that is in a body's closed part or near it.

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
    for surface in body.pose(pose):
        if surface.closed:
            signed = signed_distances(surface, torch.as_tensor(cage - surface.origin), edges, reach=2.0 * NEAR)
            touches = (signed.abs() <= NEAR).any() or ((signed < 0).any() and (signed > 0).any())
            fraction = max(fraction, float((signed <= NEAR).double().mean())) if bool(touches) else fraction
    return fraction
