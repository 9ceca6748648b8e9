"""Moves of cloth towards wanted positions that add no crossings: cloth that is apart never crosses.

Theorem. Let every vertex-face and edge-edge pair of a mesh, except pairs that share a vertex, have a positive distance
at ``start``. Then every such pair has a positive distance at the result of `safe_move`, and the result has no crossings
that ``start`` did not have: a plane keeps each pair apart on the straight path between the two positions, as rounded
(`collide.separation`), so no pair can have changed sides. The theorem holds for any wanted positions.

Exempt are pairs that touch at the start (`TOUCHES` of `collide.separation`), and pairs with all vertices in a single
given tangle. If the start is in double precision and the wanted positions in single, gaps below single precision's
rounding cannot be returned, and are not promised.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..collide.pairs import NearAt, Pairs
from ..collide.parts import Parts
from ..collide.search import blocking_pairs
from ..deadline import is_over
from ..forces.seam import Seam
from ..level import Placed
from .along import ApproachLimits, along
from .cloth_mesh import RINGS, ClothMesh

ROUNDS = 4
"""Number of passes that shorten blocked displacements. Vertices that are blocked after the last pass do not move."""

STRAINS, NEGLIGIBLE = 0.5, 0.01
"""Largest strain of an edge between vertices with shortened displacements, and the fraction of this strain that is
neglected. Without the limit shot 02 needs 53 instead of 24 rounds in frame 18 and keeps crossings."""


@dataclass(frozen=True, eq=False)
class Promise:
    """The pairs of parts of cloth and bodies that a move keeps apart.

    Attributes:
        floor: Gap that pairs keep, as for `safe_move` [m].
        tangle, inside: As for `safe_move`.
    """

    mesh: ClothMesh
    seam: Seam | None
    floor: float
    tangle: Int[Tensor, " all"] | None
    inside: Bool[Tensor, " all"] | None

    def blocking(self, begin: Tensor, end: Tensor, queried: Tensor, *, near: NearAt | None = None) -> Pairs:
        """As `blocking_pairs`."""
        parts, tangle, inside = self.mesh.parts, self.tangle, self.inside
        return blocking_pairs(
            parts, begin, end, floor=self.floor, queried=queried, tangle=tangle, inside=inside, near=near
        )

    def safe_corners(
        self,
        begin: Float[Tensor, "all 3"],
        end: Float[Tensor, "all 3"],
        met: Pairs,
        *,
        halved: bool,
        near: NearAt | None = None,
    ) -> tuple[Float[Tensor, "all 3"], bool]:
        """Corners after a safe move, ``end`` itself if no pair blocks; and whether pairs with bodies are proved.

        Displacements are projected onto the planes of the blocking pairs, and then shortened. Only pairs of vertices
        with changed ends are checked again.

        Args:
            begin: Corners of cloth and bodies [m], float64.
            end: Wanted corners [m]; those of bodies are reached.
            met: Pairs that block the move.
            halved: Whether vertices around pairs that stay blocked move in two halves, so that planes may turn once.
            near: All near pairs at the start; None if unknown.
        """
        if not len(met.value):
            return end, True
        mesh, moves = self.mesh, (end != begin).any(dim=1)
        stand = not bool(moves[mesh.level.vertex_count :].any())
        free = mesh.free & moves.unsqueeze(1) if stand else mesh.free
        ends, wanted = end, end - begin
        planes = ApproachLimits.of(begin, ends, met, self.floor)
        for _ in range(ROUNDS):
            last, gone = ends, along(wanted, planes, free=free, threads=mesh.level.threads)
            ends = self._rounded(begin + gone, end)
            met = self.blocking(begin, ends, _with_corners(met, (ends != last).any(dim=1)), near=near)
            if not len(met.value):
                return ends, True
            planes = planes.joined(ApproachLimits.of(begin, ends, met, self.floor, corners=True))
        late = _with_corners(met, torch.zeros_like(moves))
        if halved:  # Pairs of other vertices stay apart on both halves of their straight paths.
            late, proved = mesh.grown(late, RINGS) & moves, True
            last = torch.where(late.unsqueeze(1), end, ends)
            halfway = 0.5 * (begin + last)
            for aim in (self._rounded(halfway, halfway), last):
                begin, half_proved = self.safe_corners(begin, aim, self.blocking(begin, aim, late), halved=False)
                late, proved = late | (begin != aim).any(dim=1), proved and half_proved
            return begin, proved
        # Cloth that a moving body reaches, and that cannot move on, is then inside the body.
        inside = self.inside if stand else torch.arange(len(moves), device=moves.device) < mesh.level.vertex_count
        parts, floor, tangle, dtype = mesh.parts, self.floor, self.tangle, mesh.level.dtype
        x = safe_move(
            begin, ends, parts, floor=floor, tangle=tangle, inside=inside, queried=late, near=near, dtype=dtype
        )
        return x, stand

    def _rounded(self, points: Tensor, end: Tensor) -> Float[Tensor, "all 3"]:
        """Corners of the cloth rounded to the type of the solve, seams closed, and corners of bodies at their ends."""
        cloth = points[: self.mesh.level.vertex_count].to(self.mesh.level.dtype)
        cloth = cloth if self.seam is None else self.seam.closed(cloth)
        return torch.cat([cloth.double(), end[len(cloth) :]])


def _with_corners(met: Pairs, vertices: Bool[Tensor, " all"]) -> Bool[Tensor, " all"]:
    mask = vertices.clone()
    mask[met.corners.long().reshape(-1)] = True
    return mask


def safe_move(
    start: Float[Tensor, "vertices 3"],
    wanted: Float[Tensor, "vertices 3"],
    parts: Parts,
    *,
    floor: float,
    tangle: Int[Tensor, " vertices"] | None = None,
    inside: Bool[Tensor, " vertices"] | None = None,
    queried: Bool[Tensor, " vertices"] | None = None,
    near: NearAt | None = None,
    dtype: torch.dtype | None = None,
) -> Placed:
    """Move vertices towards wanted positions as far as a plane keeps each pair of parts apart.

    Corners of blocked pairs move as far as the plane at the start allows. Pairs with changed vertices are then checked
    again, until no pair is blocked. Only relative motion counts, so layers that move together are not stopped.

    Args:
        start: Start positions, the reference of the promise [m].
        wanted: Wanted positions [m], of the same dtype.
        parts: Table of vertex, edge and face pairs that may be in contact.
        floor: Gap that pairs keep [m]; a pair that is already closer keeps most of its distance.
        tangle: The tangle of each vertex, int32, -1 outside tangles; pairs inside a single tangle have no promise. None
            without tangles.
        inside: Cloth inside a body; its pairs with bodies have no promise. None for none.
        queried: Vertices whose pairs must be checked; pairs without such a vertex are safe. None checks every
            vertex that moves.
        near: All near pairs at the start; None if unknown.
        dtype: Type to which positions of the cloth are rounded; None for the type of the wanted positions.

    Returns:
        Positions [m], ``wanted`` itself if no pair is blocked.
    """
    at = start.double()
    displacement = wanted.double() - at
    share = torch.ones(len(displacement), dtype=torch.float64, device=displacement.device)
    x, queried = wanted, (displacement != 0).any(dim=1) if queried is None else queried
    cloth, dtype = torch.arange(len(share), device=share.device) < parts.level.vertex_count, dtype or wanted.dtype
    for attempt in range(len(displacement) + ROUNDS):
        blocking = blocking_pairs(
            parts, start, x, floor=floor, queried=queried, tangle=tangle, inside=inside, near=near
        )
        if not len(blocking.value):
            break
        least = torch.ones_like(share)
        corner = blocking.corners.long().reshape(-1)
        least.scatter_reduce_(0, corner, blocking.value.repeat_interleave(4), "amin")
        shorter = share * least if attempt < ROUNDS else torch.where(least < 1.0, 0.0, share)
        # After the deadline no vertex moves.
        less = torch.zeros_like(share) if is_over() else _spread(shorter, displacement, parts)
        last_share, share = share, torch.where(cloth, less, share)  # Bodies always move to their ends.
        queried = share < last_share
        moved = (at + share.unsqueeze(1) * displacement).to(dtype).to(wanted)
        x = torch.where((share < 1.0).unsqueeze(1), moved, wanted)
    return Placed(x)


def _spread(share: Tensor, displacement: Tensor, parts: Parts) -> Float[Tensor, " vertices"]:
    """Fractions of displacements, reduced around shortened vertices: no edge is strained by more than `STRAINS`."""
    length = displacement.norm(dim=1)
    late = length * (1.0 - share)
    least = NEGLIGIBLE * STRAINS * parts.lengths.mean()
    changed = torch.nonzero(late > least).squeeze(1)
    while len(changed) and not is_over():
        vertex, neighbour, rest = parts.links_of(changed)
        new = late.scatter_reduce(0, neighbour, late[vertex] - STRAINS * rest, "amax")
        late, changed = new, torch.nonzero(new > late + least).squeeze(1)
    out = torch.minimum(share, (1.0 - late / length.clamp_min(1e-300)).clamp_min(0.0))
    sewn, partner = parts.links[len(parts.level.edges) :].T  # Seams stay closed to the last bit.
    out = out.scatter_reduce(0, partner, out[sewn], "amin")
    return out.scatter_reduce(0, sewn, out[partner], "amin")
