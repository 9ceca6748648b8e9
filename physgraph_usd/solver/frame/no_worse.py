"""Replaces patches of refined cloth that have more faults than the subdivided cage by the subdivided cage.

A patch is connected cloth around what crosses, in the solution or in the subdivided cage, with the cloth that it
crosses. Its faults are its crossings of cloth, its crossings with bodies, and its vertices inside bodies. A patch with
more faults than in the subdivided cage follows that cage until the solution was as good there for `STAY` frames, so
that it does not flicker between the two.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..collide.crossings import all_crossings
from ..contact.cloth import ContactState, LevelContact
from ..contact.cloth_mesh import RINGS
from ..level import Placed, unhindered
from ..mesh.topology import joined_by

STAY = 20
"""Number of frames for which a patch follows the subdivided cage after the last frame with a worse solution."""
GROWTHS = 4
"""Largest number of passes that enlarge patches: a patch on the subdivided cage may cross the refined cloth around."""


@dataclass(frozen=True, eq=False)
class Faults:
    """Crossings and vertices inside bodies.

    Attributes:
        corners: Vertices of each edge and face that cross, of cloth and bodies, those of given-up cloth too, (N, 5).
        inside: The vertices inside bodies, shape (M,).
    """

    corners: Int[Tensor, "crossings 5"]
    inside: Int[Tensor, " inside"]

    @staticmethod
    def of(view: LevelContact, state: ContactState) -> Faults:
        """Faults of a contact state."""
        crossings, pierced, inside = state.crossings, state.pierced, state.inside
        if view.given_up is not None:
            crossings, pierced = all_crossings(view.mesh.parts, state.corners)
        corners = torch.cat([view.mesh.corners_of(pairs).long() for pairs in (crossings, pierced.crossings)])
        none = corners.new_zeros(0)
        return Faults(corners, none if inside is None else torch.nonzero(inside.any(dim=0)).squeeze(1))

    def per_patch(self, patch: Int[Tensor, " vertices"]) -> Int[Tensor, " vertices"]:
        """Number of faults of each patch, given the patch of each vertex."""
        vertices = torch.cat([self.corners.amin(dim=1), self.inside])  # Cloth has the lower numbers.
        return torch.bincount(patch[vertices], minlength=len(patch))


def patches_worse(view: LevelContact, x: Faults, base: Faults) -> Bool[Tensor, " vertices"]:
    """Mask of the patches that are worse at x than in the subdivided cage, given the faults of both."""
    mesh, count = view.mesh, view.mesh.level.vertex_count
    corners = torch.cat([x.corners, base.corners])
    region = torch.zeros_like(mesh.level.free[:, 0])
    region[corners[corners < count]] = True
    region, edges = mesh.grown(region, RINGS), mesh.level.edges.long()
    across = torch.cat([corners[:, [0, column]] for column in range(1, 5)])
    links = torch.cat([edges[region[edges].all(dim=1)], across[(across < count).all(dim=1)]])
    patch = torch.as_tensor(joined_by(links.cpu().numpy(), count), device=region.device).long()
    return region & (x.per_patch(patch) > base.per_patch(patch))[patch]


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
    remaining = (before - 1).clamp_min(0)
    solved = Faults.of(view, view.look(x))
    if not bool(remaining.any()) and not len(solved.corners):
        return x, remaining, {}
    smooth, free = view.closed(smooth), view.mesh.level.free
    base = Faults.of(view, view.detect(smooth))

    def blended(remaining: Tensor) -> Tensor:
        solved_share = from_coarse @ ((remaining == 0).double().cpu().numpy())
        return view.closed(
            torch.where(free, smooth + torch.as_tensor(solved_share).to(x).unsqueeze(1) * (x - smooth), x)
        )

    def longer(faults: Faults) -> Tensor | None:
        worse = patches_worse(view, faults, base)
        share = from_coarse.T @ worse.double().cpu().numpy()
        again = torch.as_tensor(share > 0, device=remaining.device)
        return torch.where(again, torch.full_like(remaining, STAY), remaining) if bool(worse.any()) else None

    extended = longer(solved)
    if extended is None and not bool(remaining.any()):
        return x, remaining, {}
    y, faults = x, solved
    for _ in range(GROWTHS):
        remaining = remaining if extended is None else extended
        y = blended(remaining)
        faults = Faults.of(view, view.detect(y))
        extended = longer(faults)
        if extended is None:
            break
    crossings = {
        name: len(result.corners) for name, result in (("solved", solved), ("subdivided", base), ("left", faults))
    }
    if crossings["left"] > crossings["solved"] and not bool(before.any()):
        return x, torch.zeros_like(remaining), {}
    share = np.asarray(from_coarse @ (remaining > 0).double().cpu().numpy())
    return unhindered(y), remaining, {"vertices": int((share > 0).sum()), **crossings}
