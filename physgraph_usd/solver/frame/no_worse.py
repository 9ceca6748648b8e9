"""No patch of refined cloth crosses more than the subdivided cage: else it follows that cage.

A patch is worse if cloth crosses cloth or bodies more often in it than in the subdivided cage, and neither less often.

A patch is connected cloth around what crosses, in the solution or in the subdivided cage, with the cloth that it
crosses. A patch follows the subdivided cage until the solution was as good there for `STAY` frames, so that it does not
flicker between the two.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..collide.crossings import all_crossings
from ..contact.cloth import LevelContact
from ..contact.cloth_mesh import RINGS
from ..level import Placed, unhindered
from ..mesh.topology import joined_by

Crossed = Int[Tensor, "_ 5"]

STAY = 20
"""Frames for which a patch follows the subdivided cage after the last one with a worse solution."""
GROWTHS = 4
"""Most times that the patches grow: where a patch meets its neighbours, new crossings may come."""


def all_crossed(view: LevelContact, x: Float[Tensor, "vertices 3"]) -> Crossed:
    """Vertices of each edge and face that cross at x [m], of cloth and bodies, those of given-up cloth too."""
    if view.given_up is None:
        found, pierced = view.look(x).crossings, view.look(x).pierced
    else:
        found, pierced = all_crossings(view.mesh.parts, view.corners(x))
    return torch.cat([view.mesh.corners_of(each) for each in (found, pierced.crossings)])


def patches_worse(view: LevelContact, x: Crossed, base: Crossed) -> Bool[Tensor, " vertices"]:
    """Mask of the patches in which more crosses than in the subdivided cage, and neither less cloth nor less of bodies.

    Args:
        x: Corners of what crosses, shape (N, 5).
        base: The same of the subdivided cage.
    """
    mesh, count = view.mesh, view.mesh.level.vertex_count
    corners = torch.cat([x, base]).long()
    region = torch.zeros_like(mesh.level.free[:, 0])
    region[corners[corners < count]] = True
    region, edges = mesh.grown(region, RINGS), mesh.level.edges.long()
    across = torch.cat([corners[:, [0, place]] for place in range(1, 5)])
    links = torch.cat([edges[region[edges].all(dim=1)], across[(across < count).all(dim=1)]])
    patch = torch.as_tensor(joined_by(links.cpu().numpy(), count), device=region.device).long()
    more = []
    for of_bodies in (False, True):
        some = (each[(each >= count).any(dim=1) == of_bodies].amin(dim=1).long() for each in (x, base))
        solved, given = (torch.bincount(patch[each], minlength=count) for each in some)
        more.append(solved - given)
    return region & ((torch.minimum(*more) >= 0) & (torch.maximum(*more) > 0))[patch]


def no_worse(
    view: LevelContact,
    x: Placed,
    smooth: Float[Tensor, "vertices 3"],
    *,
    from_coarse: sp.csr_matrix,
    before: Int[Tensor, " coarse"],
) -> tuple[Placed, Int[Tensor, " coarse"], dict[str, int]]:
    """Positions with no patch worse than the subdivided cage, as far as `GROWTHS` find them.

    Args:
        view: The finest level's contact.
        x: The solution [m].
        smooth: The subdivided cage [m], shape (V, 3).
        from_coarse: The prolongation from the cage, a sparse matrix, shape (V, C).
        before: Frames for which each vertex of the cage was still to follow after the last frame, shape (C,).

    Returns:
        Positions [m], x itself if nothing is to change; the frames for which each cage vertex is still to follow; and
        figures for the report, {} if all cloth is as solved.
    """
    left = (before - 1).clamp_min(0)
    solved = all_crossed(view, x)
    if not bool(left.any()) and not len(solved):
        return x, left, {}
    base = all_crossed(view, smooth)
    free = view.mesh.level.free

    def blended(left: Tensor) -> Tensor:
        kept = from_coarse @ ((left == 0).double().cpu().numpy())
        return torch.where(free, smooth + torch.as_tensor(kept).to(x).unsqueeze(1) * (x - smooth), x)

    def longer(found: Tensor) -> Tensor | None:
        worse = patches_worse(view, found, base)
        share = from_coarse.T @ worse.double().cpu().numpy()
        again = torch.as_tensor(share > 0, device=left.device)
        return torch.where(again, torch.full_like(left, STAY), left) if bool(worse.any()) else None

    y, found, more = x, solved, longer(solved)
    for _ in range(GROWTHS):
        left = left if more is None else more
        y = blended(left)
        found = all_crossed(view, y)
        more = longer(found)
        if more is None:
            break
    if not bool(left.any()) or (len(found) > len(solved) and not bool(before.any())):
        return x, torch.zeros_like(left), {}
    share = np.asarray(from_coarse @ (left > 0).double().cpu().numpy())
    figures = {"vertices": int((share > 0).sum()), "solved": len(solved), "subdivided": len(base), "left": len(found)}
    return unhindered(y), left, figures
