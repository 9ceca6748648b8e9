"""Cages that start crossed, drawn apart before anything is solved: the smaller piece that a contour cuts off goes back.

Springs shorten a contour step by step and stop where the cloth between is stretched. Which piece is on the wrong side
is known at once, the smaller one (Baraff, Witkin and Kass 2003): its vertices are laid as far above the other cloth as
they were under it, but at most a gap, so a dent, a corner or half a sheet comes back whole, however deep it was.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..collide.crossings import Crossings, crossings
from ..colliders.mesh import MeshSurface
from ..colliders.pose import MeshPose
from ..deadline import is_over
from ..mesh.topology import joined_by
from .cloth_mesh import ClothMesh

PASSES = 6
"""Most pieces' goes: a piece laid back may uncover another contour."""
WIDER = (0.0, 0.25, 0.5)
"""Least gaps that are tried, in mean edges: faces of curved cloth come through ones that lie closer than they sag."""
BESIDE = 2
"""Rings round a piece that are its own cloth and no barrier to it."""


def drawn_apart(
    mesh: ClothMesh, x: Float[Tensor, "vertices 3"], *, gap: float
) -> tuple[Float[Tensor, "vertices 3"], int, int]:
    """Lay pieces that contours cut off back to their side, while fewer parts cross.

    Args:
        mesh: The cloth of one level.
        x: Positions [m].
        gap: Distance that they end from what they were behind [m], or a part of an edge where that crosses less.

    Returns:
        Positions [m], x itself where nothing gets better, and the number of crossings before and after.
    """
    start = _look(mesh, x)
    best = (x, start)
    for least in WIDER:
        if not best[1].count or is_over():
            break
        found = _in_passes(mesh, x, start, gap=max(gap, least * float(mesh.level.spacing.mean())))
        best = found if found[1].count < best[1].count else best
    return best[0], start.count, best[1].count


def _in_passes(mesh: ClothMesh, x: Tensor, found: Crossings, *, gap: float) -> tuple[Tensor, Crossings]:
    """Lay pieces back while fewer parts cross; the positions, and what crosses there."""
    for _ in range(PASSES):
        moved = _lay_back(mesh, found, x, gap=gap)
        after = _look(mesh, moved)
        if after.count >= found.count:
            break
        x, found = moved, after
        if not found.count:
            break
    return x, found


def _look(mesh: ClothMesh, x: Tensor) -> Crossings:
    """What crosses at x [m]."""
    return crossings(mesh.parts, x)


def _lay_back(mesh: ClothMesh, found: Crossings, x: Tensor, *, gap: float) -> Tensor:
    """Each chosen piece on the other side of the cloth that it went through."""
    out = x.clone()
    for piece, barrier in _chosen(mesh, found):
        faces = mesh.level.triangles.cpu().numpy()[barrier[mesh.triangles].all(dim=1).cpu().numpy()]
        which = torch.nonzero(piece & mesh.level.free[:, 0]).squeeze(1)
        if not len(faces) or not len(which):
            continue
        never = np.zeros(faces.shape, bool)
        pose = MeshPose(out.double().cpu().numpy(), faces)
        surface = MeshSurface(pose, faces, (never, never), device=str(x.device), threads=mesh.level.threads)
        asked = out[which] - torch.as_tensor(surface.origin).to(x)
        near = surface.closest(asked, torch.full_like(asked[:, 0], float("inf")))
        back = near.point - asked
        beyond = near.distance.clamp_max(gap).unsqueeze(1) * torch.nn.functional.normalize(back, dim=1, eps=1e-30)
        out[which] = out[which] + back + beyond
    return out


def pieces_of(mesh: ClothMesh, found: Crossings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The pieces into which contours cut the cloth.

    Args:
        mesh: The cloth.
        found: What crosses.

    Returns:
        The piece of each vertex, which pieces are cut off (smaller than the largest of what hangs together without
        crossings), and their areas [m^2].
    """
    count = mesh.level.vertex_count
    ends = mesh.parts.links.cpu().numpy()
    kept = np.ones(len(ends), bool)
    kept[found.edge.cpu().numpy()] = False
    whole, piece = joined_by(ends, count), joined_by(ends[kept], count)
    area = np.bincount(piece, mesh.level.vertex_area.double().cpu().numpy())
    first = np.unique(piece, return_index=True)[1]
    largest = np.zeros(int(whole.max()) + 1)
    np.maximum.at(largest, whole[first], area)
    return piece, area < largest[whole[first]], area


def _chosen(mesh: ClothMesh, found: Crossings) -> list[tuple[Bool[Tensor, " vertices"], Bool[Tensor, " vertices"]]]:
    """The smallest pieces that every contour has one of, and the cloth that each of them went through."""
    piece, off, area = pieces_of(mesh, found)
    corners = mesh.corners_of(found).cpu().numpy()
    pieces = piece[corners]
    left = np.ones(len(corners), bool)
    candidates = np.unique(pieces[off[pieces]])
    chosen = []
    for number in candidates[np.argsort(area[candidates], kind="stable")]:
        of_edge, of_face = (pieces == number)[:, :2].any(axis=1), (pieces == number)[:, 2:].any(axis=1)
        own = left & (of_edge ^ of_face)
        if not own.any():
            continue
        left &= ~own
        met = np.zeros(mesh.level.vertex_count, bool)
        met[corners[own & of_edge, 2:]] = True
        met[corners[own & of_face, :2]] = True
        chosen.append(_with_barrier(mesh, piece == number, met))
    return chosen


def _with_barrier(
    mesh: ClothMesh, piece: np.ndarray, met: np.ndarray
) -> tuple[Bool[Tensor, " vertices"], Bool[Tensor, " vertices"]]:
    """A piece, and the cloth round what it met, as far as the piece is wide."""
    device = mesh.level.rest.device
    inside, around = (torch.as_tensor(each, device=device) for each in (piece, met))
    own = mesh.grown(inside, BESIDE)
    rings = int(np.ceil(np.sqrt(piece.sum()))) + BESIDE
    return inside, mesh.grown(around, rings) & ~own
