"""Broad phase: pairs of clusters whose parts can come near one another, or touch, on straight paths.

Nearly all pairs with overlapping boxes are neighbours on the cloth. Pairs in one monotone patch (`patches`) cannot
touch. They are not near either, and are omitted, if m of the patch times their distance in its plane exceeds the search
distance, or if m times the least cosine between faces and plane exceeds the searched fraction of their distance at
rest.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportIndexIssue=false, reportCallIssue=false, reportGeneralTypeIssues=false
from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..mesh.kernels import KERNELS
from ..mesh.threads import LEAST_PER_THREAD, LEAST_QUERIES, argument, run, workers_on
from .boxes import FAR, Swept, mean_path, motion_of, overlap, room_for_swept, sweep_boxes
from .domains import Patches, flat, holds
from .parts import Parts
from .patches import MARGIN, NOTHING
from .topology import Topology

wp.set_module_options(KERNELS)

ROOM = 48
"""Pairs per cluster with room before the pairs are counted."""
LEAST = wp.constant(wp.float32(0.01))
"""Least m used for proofs: single precision rounds m to a few millionths."""
KNOWN = 3
"""Most cached positions found to be near the paths, with the clusters' displacements to them."""
GRADES = wp.constant(64)
"""Number of grades in which the required m is recorded."""
APART, OUT = wp.constant(1), wp.constant(2)
"""Proofs of patches for two clusters: no touch on any covered path, or not near."""


@dataclass(frozen=True, eq=False)
class ClusterPairs:
    """All pairs of clusters that matter while vertices stay near the paths of the search.

    Attributes:
        parts: The parts.
        start: Start positions of the paths [m], float64.
        path: Displacements along the paths [m], float64.
        slack: Largest distance of the vertices from the paths [m].
        pairs: The clusters of each pair, the lower index first, shape (N, 2), int32.
        active: Clusters in pairs, int32.
        apart: True for pairs proved not to touch on the paths, which can only be near, shape (N,).
        allowed: Largest approach of each pair for which a list of parts stays valid [m], shape (N,).
        relied: Required m of each patch for its proofs; -1 without proofs.
    """

    parts: Parts
    start: Float[Tensor, "vertices 3"]
    path: Float[Tensor, "vertices 3"]
    slack: Float[Tensor, " vertices"]
    pairs: Int[Tensor, "pairs 2"]
    active: Int[Tensor, " clusters"]
    apart: Bool[Tensor, " pairs"]
    allowed: Float[Tensor, " pairs"]
    relied: Float[Tensor, " patches"]
    _near: list[tuple[Tensor, wp.array]] = field(default_factory=list)
    _went: list[tuple[Tensor, Tensor, tuple[wp.array, wp.array]]] = field(default_factory=list)

    @staticmethod
    def find(
        parts: Parts,
        start: Float[Tensor, "vertices 3"],
        end: Float[Tensor, "vertices 3"] | None,
        *,
        radius: Float[Tensor, " vertices"],
        slack: Float[Tensor, " vertices"],
        allowed: Float[Tensor, " vertices"],
        half: float,
        asked: Bool[Tensor, " clusters"] | None = None,
    ) -> ClusterPairs:
        """Find the pairs.

        Args:
            parts: The parts.
            start: Positions [m], float64.
            end: End positions [m], float64; None without motion.
            radius: Search radius of each vertex [m], float64.
            slack: Largest distance of each vertex from its path [m], float64.
            allowed: Displacement of each vertex for which a list of parts stays valid [m], float64.
            half: Fraction of the distance at rest within which parts of one garment are searched.
            asked: Clusters of which each pair must contain at least one; all if None.
        """
        path = torch.zeros_like(start) if end is None else end - start
        enough = half + float(MARGIN)
        m = parts.patches.measured(start, end, least=float(LEAST + MARGIN), enough=enough, around=asked)
        motion = motion_of(start, path, radius=radius, slack=slack)
        found, relied = _in_boxes(parts, motion, m, half=half, asked=asked)
        pairs = found[:, :2].contiguous()
        occurs = torch.zeros(parts.count, dtype=torch.bool, device=start.device)
        occurs[pairs.reshape(-1).long()] = True
        active = torch.nonzero(occurs).squeeze(1).to(torch.int32)
        least = parts.least_of(allowed)[pairs.long()].sum(dim=1)
        return ClusterPairs(parts, start, path, slack, pairs, active, found[:, 2] == APART, least, relied)

    def nearer(self, before: Float[Tensor, "vertices 3"], *places: Float[Tensor, "vertices 3"]) -> Tensor:
        """Upper bound of each pair's approach to the nearer of one or two reference positions [m], float64.

        Args:
            before: Positions of the vertices [m].
            places: Reference positions, cached by tensor: do not write to them.

        Returns:
            Shape (pairs,).
        """
        out = before.new_empty(len(self.pairs))
        first, second = self._gone(before, places[0]), self._gone(before, places[-1])
        pairs = argument(self.pairs, wp.vec2i)
        launch(self.parts, approach, len(out), pairs, *first, *second, argument(out))
        return out

    def _gone(self, before: Tensor, x: Tensor) -> tuple[wp.array, wp.array]:
        """Mean displacement of each active cluster's vertices, and the largest deviation from the mean [m]."""
        for start, end, known in self._went:
            if start is before and end is x:
                return known
        size, device = self.parts.count, str(x.device)
        mean, spread = wp.empty(size, dtype=wp.vec3d, device=device), wp.empty(size, dtype=wp.float64, device=device)
        path = argument(x - before, wp.vec3d)
        launch(self.parts, average, len(self.active), path, argument(self.active), mean, spread)
        _keep(self._went, (before, x, (mean, spread)))
        return mean, spread

    def covers(self, start: Float[Tensor, "vertices 3"], end: Float[Tensor, "vertices 3"] | None) -> bool:
        """True if the pairs are valid for a move or for positions, including the proofs by m.

        Results are cached by tensor: do not write to the positions.

        Args:
            start: Positions [m], float64.
            end: End positions [m], float64; None without motion.
        """
        lost = torch.zeros(1, dtype=torch.int32, device=start.device)
        places = (start, start if end is None else end)
        first = self._changes(start, lost)
        changes = (first, first if end is None else self._changes(end, lost))
        self.parts.patches.look(self.relied, start, end, changes=changes, lost=lost)
        if int(lost):
            return False
        for known in zip(places, changes, strict=True):
            _keep(self._near, known)
        return True

    def _changes(self, x: Tensor, lost: Tensor) -> wp.array:
        """Changes of the gradients in each cluster at x [m]; ``lost`` becomes 1 if a vertex is not near its path."""
        for known, change in self._near:
            if known is x:
                return change
        paths = (argument(each.contiguous(), wp.vec3d) for each in (x, self.start, self.path))
        launch(self.parts, find_strays, len(x), *paths, argument(self.slack), argument(lost))
        return self.parts.patches.changes((self.start, self._end), x, lost)

    @cached_property
    def _end(self) -> Float[Tensor, "vertices 3"]:
        """End positions of the paths [m]."""
        return self.start + self.path


def _keep(known: list[Any], one: tuple[Any, ...]) -> None:
    """Add an entry to a cache of bounded size."""
    if not any(all(a is b for a, b in zip(each[:-1], one[:-1], strict=True)) for each in known):
        known.append(one)
        del known[:-KNOWN]


def launch(parts: Parts, kernel: wp.Kernel, size: int, *inputs: object, least: int = LEAST_PER_THREAD) -> None:
    """Run a kernel over clusters or pairs of clusters; a further thread needs a minimum number of items."""
    launched = {"device": parts.level.device, "threads": parts.level.threads, "least": least}
    run(kernel, size, [parts.topology, *inputs], **launched)


def _in_boxes(
    parts: Parts, motion: Any, m: Tensor, *, half: float, asked: Bool[Tensor, " clusters"] | None
) -> tuple[Int[Tensor, "pairs 3"], Float[Tensor, " patches"]]:
    """Pairs of clusters with overlapping swept boxes, their proofs, and the m required by the proofs."""
    size, device = parts.count, str(m.device)
    swept = room_for_swept(size, device)
    launch(parts, sweep_boxes, size, motion, swept)
    table = parts.patches.table
    groups = parts.patches.count - parts.patches.wide
    all_low, all_high = (wp.empty(groups, dtype=wp.vec3f, device=device) for _ in range(2))
    launch(parts, join_boxes, groups, table, swept, all_low, all_high)
    grades = torch.zeros((len(m), int(GRADES) + 1), dtype=torch.uint8, device=device)
    proofs = Proofs()
    proofs.m, proofs.grades, proofs.half = wp.from_torch(m), wp.from_torch(grades.view(-1)), half
    tree, room, workers = wp.Bvh(all_low, all_high), ROOM, workers_on(device)
    which = None if asked is None else torch.nonzero(asked).squeeze(1).to(torch.int32)
    rows = size if which is None else len(which)
    while True:
        slots = torch.empty((rows, room, 3), dtype=torch.int32, device=device)
        count = torch.zeros(rows, dtype=torch.int32, device=device)
        out = (room, argument(slots.view(-1, 3), wp.vec3i), argument(count))
        if which is None:
            inputs = [workers, table, proofs, tree.id, swept, all_low, all_high, *out]
            launch(parts, find_clusters, groups * workers, *inputs, least=LEAST_QUERIES)
        else:
            inputs = [argument(which), argument(asked), table, proofs, tree.id, swept, *out]
            launch(parts, find_asked, rows, *inputs, least=LEAST_QUERIES)
        most = int(count.max()) if rows else 0
        if most <= room:
            return slots[torch.arange(room, device=device) < count.unsqueeze(1)], _relied(m, grades)
        room = most


def _relied(m: Float[Tensor, " patches"], grades: Tensor) -> Float[Tensor, " patches"]:
    """Highest grade recorded for each patch, as a fraction of its m; -1 without proofs."""
    highest = (grades * torch.arange(int(GRADES) + 1, dtype=torch.uint8, device=m.device)).amax(dim=1)
    return torch.where(highest > 0, highest * (m / float(GRADES)), float(NOTHING))


@wp.struct
class Proofs:
    """m of each patch, the m required by proofs, and the searched fraction of distances at rest.

    The required m is recorded as marks in `GRADES` grades of m, rounded up: marks set by several threads do not depend
    on their order. A maximum would, because Warp's atomic maximum takes no lock on the CPU.
    """

    m: wp.array(dtype=wp.float32)
    grades: wp.array(dtype=wp.uint8)
    half: wp.float32


@wp.func
def gap_in(patches: Patches, p: wp.int32, i: wp.int32, j: wp.int32):
    """Least distance of two clusters at rest in a patch's plane."""
    between = wp.length(flat(patches, p, patches.centre[i]) - flat(patches, p, patches.centre[j]))
    return wp.max(between - patches.size[i] - patches.size[j], wp.float64(0.0))


@wp.func
def note(proofs: Proofs, p: wp.int32, needed: wp.float32):
    """Mark the m required of a patch; the required m is less than the patch's m."""
    grade = wp.min(wp.int32(wp.ceil(needed / proofs.m[p] * wp.float32(GRADES))), GRADES)
    proofs.grades[p * (GRADES + 1) + grade] = wp.uint8(1)


@wp.func
def proved_by(
    patches: Patches,
    proofs: Proofs,
    reach: wp.float64,
    p: wp.int32,
    i: wp.int32,
    j: wp.int32,
):
    """Proof of a patch for two clusters; the required m is marked."""
    if proofs.m[p] <= LEAST + MARGIN:
        return 0
    begin, end = patches.first_inside[p], patches.first_inside[p + 1]
    if not holds(patches.inside, begin, end, i):
        return 0
    if not holds(patches.inside, begin, end, j):
        return 0
    needed = proofs.half / patches.flattest[p]
    gap = wp.float32(gap_in(patches, p, i, j))
    if gap > wp.float32(0.0):
        needed = wp.min(needed, wp.float32(reach) / gap)
    needed = wp.max(needed, LEAST)
    if proofs.m[p] > needed + MARGIN:
        note(proofs, p, needed)
        return OUT
    note(proofs, p, LEAST)
    return APART


@wp.func
def proved(
    patches: Patches,
    proofs: Proofs,
    reach: wp.float64,
    i: wp.int32,
    j: wp.int32,
):
    """Proof for two clusters by the patches that contain them."""
    most = proved_by(patches, proofs, reach, patches.wide[i], i, j)
    if most < OUT:
        most = wp.max(most, proved_by(patches, proofs, reach, patches.small[i], i, j))
    if most < OUT and patches.wide[j] != patches.wide[i]:
        most = wp.max(most, proved_by(patches, proofs, reach, patches.wide[j], i, j))
    if most < OUT and patches.small[j] != patches.small[i]:
        most = wp.max(most, proved_by(patches, proofs, reach, patches.small[j], i, j))
    return most


@wp.func
def have_both(
    patches: Patches,
    proofs: Proofs,
    p: wp.int32,
    a: wp.int32,
    b: wp.int32,
):
    """True if a patch contains two groups and proves that no parts of the two are near; the required m is marked."""
    needed = wp.max(proofs.half / patches.flattest[p], LEAST)
    if proofs.m[p] <= needed + MARGIN:
        return False
    begin, end = patches.first_whole[p], patches.first_whole[p + 1]
    if not holds(patches.whole, begin, end, a):
        return False
    if not holds(patches.whole, begin, end, b):
        return False
    note(proofs, p, needed)
    return True


@wp.func
def lie_apart(
    patches: Patches,
    proofs: Proofs,
    a: wp.int32,
    b: wp.int32,
):
    """True if a patch containing two groups proves that no parts of the two are near."""
    small, other = patches.wide_count + a, patches.wide_count + b
    if have_both(patches, proofs, patches.within[small], a, b):
        return True
    if have_both(patches, proofs, small, a, b):
        return True
    if a == b:
        return False
    if have_both(patches, proofs, patches.within[other], a, b):
        return True
    return have_both(patches, proofs, other, a, b)


@wp.func
def feel(parts: Topology, i: wp.int32, j: wp.int32):
    """True if the garments of two clusters may be in contact."""
    return parts.meets[parts.garment[i] * parts.garments + parts.garment[j]] != 0


@wp.func
def box_of(patches: Patches, swept: Swept, begin: wp.int32, end: wp.int32, step: wp.int32):
    """Bounding box of some clusters of a group."""
    lowest, highest = wp.vec3f(wp.float32(FAR)), wp.vec3f(wp.float32(-FAR))
    for n in range(begin, end, step):
        lowest = wp.min(lowest, swept.low[patches.own[n]])
        highest = wp.max(highest, swept.high[patches.own[n]])
    return lowest, highest


@wp.kernel
def join_boxes(
    first: wp.int32,
    parts: Topology,
    patches: Patches,
    swept: Swept,
    all_low: wp.array(dtype=wp.vec3f),
    all_high: wp.array(dtype=wp.vec3f),
):
    """Bounding box of each group's clusters."""
    a = first + wp.tid()
    p = patches.wide_count + a
    lowest, highest = box_of(patches, swept, patches.first_own[p], patches.first_own[p + 1], 1)
    all_low[a] = lowest
    all_high[a] = highest


@wp.func
def pairs_of(
    parts: Topology,
    patches: Patches,
    proofs: Proofs,
    swept: Swept,
    room: wp.int32,
    out: wp.array(dtype=wp.vec3i),
    found: wp.array(dtype=wp.int32),
    row: wp.int32,
    i: wp.int32,
    begin: wp.int32,
    end: wp.int32,
):
    """Write the pairs of a cluster and a patch's own clusters that the cluster can come near, consecutively."""
    for k in range(begin, end):
        j = patches.own[k]
        if not overlap(swept.low[i], swept.high[i], swept.low[j], swept.high[j]):
            continue
        known = proved(patches, proofs, swept.near[i] + swept.near[j], i, j)
        if known < OUT:
            if found[row] < room:
                out[row * room + found[row]] = wp.vec3i(wp.min(i, j), wp.max(i, j), known)
            found[row] = found[row] + 1


@wp.kernel
def find_clusters(
    first: wp.int32,
    parts: Topology,
    workers: wp.int32,
    patches: Patches,
    proofs: Proofs,
    tree: wp.uint64,
    swept: Swept,
    all_low: wp.array(dtype=wp.vec3f),
    all_high: wp.array(dtype=wp.vec3f),
    room: wp.int32,
    out: wp.array(dtype=wp.vec3i),
    found: wp.array(dtype=wp.int32),
):
    """Candidate clusters of each group, in it and in later groups; counted even without room, split among workers."""
    a = (first + wp.tid()) // workers
    b = wp.int32(0)
    p = patches.wide_count + a
    begin_own, end_own = patches.first_own[p] + (first + wp.tid()) % workers, patches.first_own[p + 1]
    if begin_own >= end_own:
        return
    lowest, highest = box_of(patches, swept, begin_own, end_own, workers)
    query = wp.bvh_query_aabb(tree, lowest, highest)
    while wp.bvh_query_next(query, b):
        if b < a:
            continue
        q = patches.wide_count + b
        if not feel(parts, patches.own[patches.first_own[p]], patches.own[patches.first_own[q]]):
            continue
        if lie_apart(patches, proofs, a, b):
            continue
        for n in range(begin_own, end_own, workers):
            i = patches.own[n]
            if overlap(swept.low[i], swept.high[i], all_low[b], all_high[b]):
                begin, end = wp.where(a == b, n, patches.first_own[q]), patches.first_own[q + 1]
                pairs_of(parts, patches, proofs, swept, room, out, found, i, i, begin, end)


@wp.kernel
def find_asked(
    first: wp.int32,
    parts: Topology,
    which: wp.array(dtype=wp.int32),
    asked: wp.array(dtype=wp.bool),
    patches: Patches,
    proofs: Proofs,
    tree: wp.uint64,
    swept: Swept,
    room: wp.int32,
    out: wp.array(dtype=wp.vec3i),
    found: wp.array(dtype=wp.int32),
):
    """Candidate clusters for the queried clusters, each pair once, in the layout of `find_clusters`."""
    n = first + wp.tid()
    i, b = which[n], wp.int32(0)
    query = wp.bvh_query_aabb(tree, swept.low[i], swept.high[i])
    while wp.bvh_query_next(query, b):
        q = patches.wide_count + b
        begin, end = patches.first_own[q], patches.first_own[q + 1]
        if not feel(parts, i, patches.own[begin]):
            continue
        for k in range(begin, end):
            j = patches.own[k]
            if j >= i or not asked[j]:
                pairs_of(parts, patches, proofs, swept, room, out, found, n, i, k, k + 1)


@wp.kernel
def find_strays(
    first: wp.int32,
    parts: Topology,
    x: wp.array(dtype=wp.vec3d),
    start: wp.array(dtype=wp.vec3d),
    path: wp.array(dtype=wp.vec3d),
    slack: wp.array(dtype=wp.float64),
    lost: wp.array(dtype=wp.int32),
):
    """Mark vertices farther from their path than their tolerance."""
    v = first + wp.tid()
    if lost[0] > 0:
        return
    moved, way = x[v] - start[v], path[v]
    part = wp.dot(moved, way) / wp.max(wp.dot(way, way), wp.float64(1.0e-300))
    off = moved - wp.clamp(part, wp.float64(0.0), wp.float64(1.0)) * way
    if not wp.dot(off, off) <= slack[v] * slack[v]:
        lost[0] = 1


@wp.kernel
def average(
    first: wp.int32,
    parts: Topology,
    path: wp.array(dtype=wp.vec3d),
    active: wp.array(dtype=wp.int32),
    mean: wp.array(dtype=wp.vec3d),
    spread: wp.array(dtype=wp.float64),
):
    """Mean displacement of some clusters' vertices, and the largest deviation from the mean."""
    i = active[first + wp.tid()]
    path_of_it, most = mean_path(parts, path, i)
    mean[i] = path_of_it
    spread[i] = most


@wp.kernel
def approach(
    first: wp.int32,
    parts: Topology,
    clusters: wp.array(dtype=wp.vec2i),
    mean: wp.array(dtype=wp.vec3d),
    spread: wp.array(dtype=wp.float64),
    other_mean: wp.array(dtype=wp.vec3d),
    other_spread: wp.array(dtype=wp.float64),
    out: wp.array(dtype=wp.float64),
):
    """Upper bound of the approach of each pair's clusters to the nearer of two reference positions."""
    n = first + wp.tid()
    i, j = clusters[n][0], clusters[n][1]
    here = wp.length(mean[i] - mean[j]) + spread[i] + spread[j]
    out[n] = wp.max(here, wp.length(other_mean[i] - other_mean[j]) + other_spread[i] + other_spread[j])
