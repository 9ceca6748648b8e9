"""Final projection: moves cloth below the minimum clearance out to it, and lifts faces pierced by a body."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..deadline import is_over
from .bodies import LevelBodies
from .corners import lift_over
from .measure import DEEP
from .track import Track

LIFT = 2.0
"""Largest lift of a pierced face, in edge lengths: a spike would be more visible."""
STALLED = 6
"""Most lifts without a drop in the number of pierced faces."""


def projected(
    bodies: LevelBodies, x: Float[Tensor, "vertices 3"]
) -> tuple[LevelBodies, Float[Tensor, "vertices 3"], int]:
    """Move free vertices out to the minimum clearance, and farther if a body pierces a face.

    Args:
        bodies: The level's view of the bodies.
        x: Positions [m].

    Returns:
        The view from the new positions; positions [m], x itself if no vertex had to move; and the number of passes.
    """
    level = bodies.level
    bodies, out, passes = pushed_out(bodies, x)
    first, best, least, stalled = out, out, len(level.triangles) + 1, 0
    for _ in range(bodies.settings.lifts):
        faces = [_pierced_faces(bodies, track, out) for track in bodies.tracks]
        count = sum(len(each) for each in faces)
        if count < least:
            best, least, stalled = out, count, 0
        stalled += 1
        if not count or stalled > STALLED or is_over():
            break
        bodies, lifted = _over_corners(bodies, out, faces)
        out, passes = no_farther(lifted, first, LIFT * level.spacing), passes + 1
    if best is first:
        return bodies, first, passes
    # What was lifted in vain goes back: it would stand as a spike, and the body still come through.
    stuck = torch.zeros_like(level.free[:, 0])
    for track in bodies.tracks if least else ():
        stuck[level.triangles[_pierced_faces(bodies, track, best)].long().reshape(-1)] = True
    bodies, out, _ = pushed_out(bodies, torch.where(stuck.unsqueeze(1), first, best))
    return bodies, out, passes


def pushed_out(
    bodies: LevelBodies, x: Float[Tensor, "vertices 3"]
) -> tuple[LevelBodies, Float[Tensor, "vertices 3"], int]:
    """Push free vertices to the minimum clearance, body by body, without a check for pierced faces.

    Vertices that bodies push back and forth until the passes end move by half steps, to the middle between the bodies.
    Arguments and results are as for `projected`.
    """
    out, passes, tracks = x, 0, list(bodies.tracks)
    for attempt in range(2 * bodies.settings.projections):
        together = attempt >= bodies.settings.projections
        moved, total = False, torch.zeros_like(x)
        for index, track in enumerate(tracks):
            tracks[index], vertex, push = _pushes(bodies, track, out)
            if not len(vertex):
                continue
            moved = True
            if together:
                total[vertex] += 0.5 * push
            else:
                out = out.clone() if out is x else out
                out[vertex] += push
        out = out + total if together and moved else out
        if not moved or (together and float(total.abs().max()) < 1e-7):
            break
        passes += 1
    return replace(bodies, tracks=tuple(tracks)), out if bodies.seam is None else bodies.seam.closed(out), passes


def _pushes(bodies: LevelBodies, track: Track, x: Tensor) -> tuple[Track, Tensor, Tensor]:
    """Vertices below their minimum clearance to a surface, and the displacements to the clearance."""
    least = bodies.settings.clearance * track.offset
    track, vertex, normal, signed = track.refresh(x, least)
    lack = least[vertex] - signed
    push = (lack > 1e-7) & bodies.level.free[vertex, 0]
    return track, vertex[push], lack[push].unsqueeze(1) * normal[push]


def _over_corners(bodies: LevelBodies, x: Tensor, faces: list[Tensor]) -> tuple[LevelBodies, Tensor]:
    """Positions with the corners of pierced faces moved out of each body."""
    out = x
    for track, own in zip(bodies.tracks, faces, strict=True):
        if len(own):
            least = bodies.settings.clearance * track.offset
            out = out + lift_over(
                track.surface, bodies.level, out + track.shift, own, clearance=least, start=track.side
            )
    bodies, out, _ = pushed_out(bodies, out)
    bodies, after = _depth(bodies, out)
    bodies, before = _depth(bodies, x)
    # What another body is in the way of stays where it is.
    return bodies, torch.where((after > before.clamp_min(DEEP)).unsqueeze(1), x, out)


def _pierced_faces(bodies: LevelBodies, track: Track, x: Tensor) -> Tensor:
    """Faces pierced by a body whose corners are all outside the body."""
    level, found = bodies.level, track.pierced(bodies.level, x)
    triangles, ends = level.triangles.long(), level.edges[found.edges].long()
    hit = torch.zeros(len(triangles), dtype=torch.bool, device=x.device)
    hit[found.triangles] = True
    if len(ends):
        around = torch.zeros_like(level.free[:, 0])
        around[ends.reshape(-1)] = True
        near = torch.nonzero(around[triangles].sum(dim=1) >= 2).squeeze(1)
        sides = triangles[near][:, [[0, 1], [1, 2], [2, 0]]].sort(dim=2).values
        key, known = sides[..., 0] * len(x) + sides[..., 1], ends.sort(dim=1).values
        hit[near[torch.isin(key, known[:, 0] * len(x) + known[:, 1]).any(dim=1)]] = True
    stays = (track.known < 0) | ~track.offset.isfinite()
    for other in bodies.tracks:  # Between two bodies there is no room to lift anything.
        if other is not track:
            stays |= other.known - (x - other.at).norm(dim=1) < 2.0 * bodies.settings.clearance * other.offset
    return torch.nonzero(hit & ~stays[triangles].any(dim=1)).squeeze(1)


def _depth(bodies: LevelBodies, x: Tensor) -> tuple[LevelBodies, Tensor]:
    """Depth of each vertex in the deepest body [m]."""
    out, tracks = torch.zeros_like(x[:, 0]), []
    for each in bodies.tracks:
        track, vertex, _, signed = each.refresh(x, torch.zeros_like(out))
        out[vertex] = torch.maximum(out[vertex], -signed)
        tracks.append(track)
    return replace(bodies, tracks=tuple(tracks)), out


def no_farther(
    x: Float[Tensor, "vertices 3"], start: Float[Tensor, "vertices 3"], most: Float[Tensor, " vertices"]
) -> Float[Tensor, "vertices 3"]:
    """Positions with the displacement from the start limited to most [m]; x itself if none exceeds the limit."""
    way = x - start
    length = way.norm(dim=1)
    far = length > most
    return torch.where(far.unsqueeze(1), start + way * (most / length).unsqueeze(1), x) if bool(far.any()) else x


def moves(x: Float[Tensor, "vertices 3"], out: Float[Tensor, "vertices 3"], passes: int) -> dict[str, int | float]:
    """Number of moved vertices, largest move [mm] and number of passes."""
    shifts = (out - x).norm(dim=1)
    far = 1e3 * float(shifts.max()) if len(shifts) else 0.0
    return {"vertices": int((shifts > 0).sum()), "largest_mm": round(far, 4), "passes": passes}
