"""Monotone patches: pieces of cloth that are proved not to touch themselves over a whole move.

Theorem. Let a patch of cloth, projected at rest onto a plane, cover a convex domain D of the plane one to one, and let
f: D -> R^3 be the piecewise linear map from there to where the cloth is. If there is an isometry Q: R^2 -> R^3 with

    sym(Q^T Df) >= m > 0   in every triangle that meets D,

then |f(x) - f(y)| >= m |x - y| for all x, y in D, so no two points of the patch touch.

Proof. <f(x) - f(y), Q (x - y)> is the integral of <Df (x - y), Q (x - y)> along the segment from y to x, which lies in
D. The condition is linear in f: where it holds with one Q at both ends of straight paths, it holds all along them.

That a map whose gradient has a positive definite symmetric part is one to one on a convex domain is a classical fact of
monotone maps. Relatives in collision detection are normal cones (Volino and Magnenat-Thalmann 1994; Provot 1997), with
the test of the contour that they need (Tang et al. 2009; Wang et al. 2018), and certificates of deformation (Barbic and
James 2010). Here one 2x2 matrix a triangle replaces both the cone and the contour.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportIndexIssue=false, reportCallIssue=false, reportGeneralTypeIssues=false
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..level import Level
from ..mesh.kernels import KERNELS
from ..mesh.threads import LEAST_PER_THREAD, LEAST_QUERIES, argument, run, workers_on
from .domains import Patches, area_of, domains_of, single
from .topology import Topology

wp.set_module_options(KERNELS)

SAMPLED = wp.constant(4)
"""Sampling stride of the triangles in the fit of Q: any Q is valid, the best Q proves most."""
MARGIN = wp.constant(wp.float32(0.1))
"""Margin of m over the required m when a proof is made, and the largest change of a triangle's gradient, by its
Frobenius norm, before the patch is checked again."""
NOTHING = wp.constant(wp.float32(-1.0))
"""m of an unmeasured patch, and the required m of a patch without proofs."""


@wp.func
def moved(start: wp.array(dtype=wp.vec3d), path: wp.array(dtype=wp.vec3d), v: wp.int32, time: wp.float64):
    """Position of a vertex at a time of a move; without motion the time is 0 and no path is read."""
    if time == wp.float64(0.0):
        return start[v]
    return start[v] + time * path[v]


@wp.func
def sides_of(t: wp.vec3i, start: wp.array(dtype=wp.vec3d), path: wp.array(dtype=wp.vec3d), time: wp.float64):
    """Two sides of a triangle at a time of a move, in single precision."""
    p = moved(start, path, t[0], time)
    u, v = moved(start, path, t[1], time) - p, moved(start, path, t[2], time) - p
    return single(u), single(v)


@wp.func
def fitted(
    patches: Patches, p: wp.int32, start: wp.array(dtype=wp.vec3d), path: wp.array(dtype=wp.vec3d), time: wp.float64
):
    """Isometry nearest to a patch's mean gradient at a time of a move; zero if the gradient has none."""
    g1, g2 = wp.vec3f(), wp.vec3f()
    for k in range(patches.first_face[p], patches.first_face[p + 1], SAMPLED):
        m = patches.inverse[k]
        u, v = sides_of(patches.faces[k], start, path, time)
        g1 += m[0] * u + m[2] * v
        g2 += m[1] * u + m[3] * v
    a, b, c = wp.dot(g1, g1), wp.dot(g1, g2), wp.dot(g2, g2)
    root = wp.sqrt(wp.max(a * c - b * b, wp.float32(0.0)))
    q1 = wp.normalize((c + root) * g1 - b * g2)
    q2 = (a + root) * g2 - b * g1
    q2 = wp.normalize(q2 - wp.dot(q1, q2) * q1)
    if root <= wp.float32(1.0e-6) * (a + c):
        q1, q2 = wp.vec3f(), wp.vec3f()
    return q1, q2


@wp.func
def has_changed(patches: Patches, p: wp.int32, change: wp.array(dtype=wp.float32), other: wp.array(dtype=wp.float32)):
    """True if a gradient in a patch has changed by more than the margin at one of two positions.

    In the patch's plane the change is larger than at rest, by the inverse cosine.
    """
    most = MARGIN * patches.flattest[p]
    for n in range(patches.first_member[p], patches.first_member[p + 1]):
        c = patches.members[n]
        if change[c] > most or other[c] > most:
            return True
    return False


@wp.func
def least_of(
    patches: Patches,
    p: wp.int32,
    start: wp.array(dtype=wp.vec3d),
    path: wp.array(dtype=wp.vec3d),
    moves: wp.bool,
    wanted: wp.float32,
    worker: wp.int32,
    workers: wp.int32,
):
    """m of a patch over a move in one worker's share of the faces.

    Q is fitted half way. The result is `NOTHING` if m is less than the wanted m.
    """
    q1, q2 = fitted(patches, p, start, path, wp.where(moves, wp.float64(0.5), wp.float64(0.0)))
    least = wp.float32(1.0)
    for k in range(patches.first_face[p] + worker, patches.first_face[p + 1], workers):
        inverse = patches.inverse[k]
        for at in range(wp.where(moves, 2, 1)):
            u, v = sides_of(patches.faces[k], start, path, wp.float64(at))
            f1, f2 = inverse[0] * u + inverse[2] * v, inverse[1] * u + inverse[3] * v
            h11, h22 = wp.dot(q1, f1), wp.dot(q2, f2)
            other = wp.float32(0.5) * (h11 - h22)
            h12 = wp.float32(0.5) * (wp.dot(q1, f2) + wp.dot(q2, f1))
            least = wp.min(least, wp.float32(0.5) * (h11 + h22) - wp.sqrt(other * other + h12 * h12))
            if not least > wanted:
                return NOTHING
    return least


@wp.kernel
def measure_patches(
    first: wp.int32,
    workers: wp.int32,
    begin_at: wp.int32,
    patches: Patches,
    start: wp.array(dtype=wp.vec3d),
    path: wp.array(dtype=wp.vec3d),
    moves: wp.bool,
    least: wp.float32,
    enough: wp.float32,
    known: wp.array(dtype=wp.float32),
    wanted: wp.array(dtype=wp.bool),
    found: wp.array(dtype=wp.float32),
):
    """m of some wanted patches over a move along straight paths, by each worker.

    Small patches are measured only if the known m of the surrounding wide patch is not enough in every case.
    """
    place = (first + wp.tid()) + begin_at * workers
    p, worker = place // workers, place % workers
    if not wanted[p] or patches.first_face[p] == patches.first_face[p + 1]:
        return
    around = patches.within[p]
    if around >= 0:
        if known[around] * patches.flattest[around] > enough:
            return
    found[place] = least_of(patches, p, start, path, moves, least, worker, workers)


@wp.kernel
def find_lost(
    first: wp.int32,
    workers: wp.int32,
    patches: Patches,
    start: wp.array(dtype=wp.vec3d),
    path: wp.array(dtype=wp.vec3d),
    moves: wp.bool,
    relied: wp.array(dtype=wp.float32),
    change: wp.array(dtype=wp.float32),
    other: wp.array(dtype=wp.float32),
    lost: wp.array(dtype=wp.int32),
):
    """Mark if m of any patch over a move is less than the required m.

    Patches whose gradients have changed little at both ends pass without a measurement.
    """
    place = first + wp.tid()
    p, worker = place // workers, place % workers
    if lost[0] > 0 or relied[p] == NOTHING:
        return
    if has_changed(patches, p, change, other):
        if least_of(patches, p, start, path, moves, relied[p], worker, workers) == NOTHING:
            lost[0] = 1


@wp.kernel
def find_changes(
    first: wp.int32,
    parts: Topology,
    rest: wp.array(dtype=wp.vec3f),
    start: wp.array(dtype=wp.vec3d),
    end: wp.array(dtype=wp.vec3d),
    x: wp.array(dtype=wp.vec3d),
    lost: wp.array(dtype=wp.int32),
    change: wp.array(dtype=wp.float32),
):
    """Largest change of a gradient in each cluster from the nearer of two positions to a third.

    Skipped if the result is no longer needed.
    """
    i = first + wp.tid()
    if lost[0] > 0:
        return
    most = wp.float32(0.0)
    for k in range(parts.first_face[i], parts.first_face[i + 1]):
        t, r = parts.faces[k], rest[k]
        most = wp.max(most, wp.min(change_of(t, r, start, x), change_of(t, r, end, x)))
    change[i] = most


@wp.func
def change_of(t: wp.vec3i, r: wp.vec3f, before: wp.array(dtype=wp.vec3d), x: wp.array(dtype=wp.vec3d)):
    """Frobenius norm of the change of a triangle's gradient between two positions."""
    p = x[t[0]] - before[t[0]]
    u, v = single(x[t[1]] - before[t[1]] - p), single(x[t[2]] - before[t[2]] - p)
    along = r[0] * u
    return wp.sqrt(wp.length_sq(along) + wp.length_sq(r[2] * v - r[1] * along))


@wp.kernel
def measure_rest(first: wp.int32, parts: Topology, rest: wp.array(dtype=wp.vec3f)):
    """Coefficients that turn the sides of each face into a gradient at rest.

    Let b be the first side's length, and h and s the second side's components across and along the first side. The
    coefficients are 1 / b, s / h and 1 / h.
    """
    i = first + wp.tid()
    for k in range(parts.first_face[i], parts.first_face[i + 1]):
        t = parts.faces[k]
        e, f = parts.rest[t[1]] - parts.rest[t[0]], parts.rest[t[2]] - parts.rest[t[0]]
        length = wp.length(e)
        height = wp.length(area_of(parts, t)) / length
        rest[k] = single(wp.vec3d(wp.float64(1.0) / length, wp.dot(e, f) / (length * height), wp.float64(1.0) / height))


@dataclass(frozen=True, eq=False)
class MonotonePatches:
    """The patches of a level.

    Attributes:
        level: The level.
        parts: Parts of the level by cluster.
        clusters: Number of clusters.
        table: Warp struct of the patches.
        wide: Number of wide patches, which come first.
        count: Number of patches.
        rest: Result of `measure_rest` for each face by cluster.
    """

    level: Level
    parts: Topology
    clusters: int
    table: Patches
    wide: int
    count: int
    rest: wp.array

    @staticmethod
    def of(level: Level, parts: Topology, clusters: int) -> MonotonePatches:
        """The patches of a level with a given number of clusters."""
        rest = wp.zeros(len(parts.faces), dtype=wp.vec3f, device=level.device)
        out = MonotonePatches(level, parts, clusters, *domains_of(level, parts, clusters), rest)
        out._launch(measure_rest, clusters, parts, rest)
        return out

    def measured(
        self,
        start: Float[Tensor, "vertices 3"],
        end: Float[Tensor, "vertices 3"] | None,
        *,
        least: float,
        enough: float,
        around: Bool[Tensor, " clusters"] | None = None,
    ) -> Float[Tensor, " patches"]:
        """m of each patch on the straight paths between positions [m], float64; -1 if unknown.

        Args:
            start: Positions.
            end: End positions; None without motion.
            least: Exclusive lower limit of m.
            enough: Largest fraction of the distance at rest within which all pairs must be omitted.
            around: Only patches with some of these clusters as own clusters; all if None.
        """
        workers = workers_on(self.level.device)
        wanted = torch.full((self.count,), around is None, dtype=torch.bool, device=start.device)
        for of in () if around is None else (self.table.wide, self.table.small):
            wanted[wp.to_torch(of)[around].long()] = True
        by_worker = torch.full((self.count, workers), float(NOTHING), dtype=torch.float32, device=start.device)
        out, x, moves = by_worker[:, 0].clone(), _array(start), end is not None
        path = x if end is None else _array(end - start)
        for begin, size in ((0, self.wide), (self.wide, self.count - self.wide)):
            inputs = (begin, self.table, x, path, moves, least, enough, argument(out), argument(wanted))
            self._launch(
                measure_patches, size * workers, workers, *inputs, argument(by_worker.view(-1)), least=LEAST_QUERIES
            )
            out = by_worker.amin(dim=1)
        return out

    def changes(
        self,
        between: tuple[Float[Tensor, "vertices 3"], Float[Tensor, "vertices 3"]],
        x: Float[Tensor, "vertices 3"],
        lost: Int[Tensor, " 1"],
    ) -> wp.array:
        """Largest change of a gradient in each cluster, from the nearer of two positions [m] to x [m], float64.

        Args:
            between: The two reference positions.
            x: Positions.
            lost: Flag; above 0 the changes are not needed.
        """
        change = wp.empty(self.clusters, dtype=wp.float32, device=self.level.device)
        arrays = (*(_array(each) for each in (*between, x)), argument(lost), change)
        self._launch(find_changes, self.clusters, self.parts, self.rest, *arrays)
        return change

    def look(
        self,
        relied: Float[Tensor, " patches"],
        start: Float[Tensor, "vertices 3"],
        end: Float[Tensor, "vertices 3"] | None,
        *,
        changes: tuple[wp.array, wp.array],
        lost: Int[Tensor, " 1"],
    ) -> None:
        """Check that m of each patch on other paths [m], float64, is at least the required m.

        Args:
            relied: Required m; m exceeded it by `MARGIN` between two positions.
            start: Positions.
            end: End positions; None without motion.
            changes: Changes in each cluster at both.
            lost: Flag, set to 1 if m is less than required; the check is skipped if the flag is already set.
        """
        x, workers = _array(start), workers_on(self.level.device)
        inputs = (self.table, x, x if end is None else _array(end - start), end is not None, argument(relied))
        self._launch(find_lost, self.count * workers, workers, *inputs, *changes, argument(lost), least=LEAST_QUERIES)

    def _launch(self, kernel: wp.Kernel, size: int, *inputs: object, least: int = LEAST_PER_THREAD) -> None:
        """Run a kernel over patches or clusters; a further thread needs a minimum number of items."""
        launched = {"device": self.level.device, "threads": self.level.threads, "least": least}
        run(kernel, size, list(inputs), **launched)


def _array(x: Tensor) -> Any:
    """Positions as a Warp array."""
    return argument(x.contiguous(), wp.vec3d)
