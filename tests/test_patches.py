"""Monotone patches: what they leave out never touches; judged by the IPC toolkit, which shares no code with them.

Sheets with hems, slits, holes and corners, tubes and spirals go along random paths, from smooth ones to such on which
much touches. The toolkit says which parts touch on the way, and each of these must be among what is asked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from folds import named
from meshes import grid

from physgraph_usd.solver.collide import broad_phase, patches
from physgraph_usd.solver.collide import detector as detecting
from physgraph_usd.solver.collide.broad_phase import ClusterPairs
from physgraph_usd.solver.collide.detector import Detector
from physgraph_usd.solver.collide.parts import Parts
from physgraph_usd.solver.level import Level, build_levels
from physgraph_usd.solver.mesh.topology import PolygonMesh

ipctk = pytest.importorskip("ipctk", reason="the IPC toolkit is not installed; it is in the extra `dev`")
EDGE = 0.02
Shape = Callable[[], tuple[np.ndarray, np.ndarray]]


def flat(columns: int = 22, rows: int = 14) -> tuple[np.ndarray, np.ndarray]:
    """A rectangle: points [m], and triangles."""
    mesh, points = grid(columns, rows, "triangles")
    return EDGE * points, np.asarray(mesh.indices).reshape(-1, 3)


def without(kept: Callable[[np.ndarray], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The rectangle's faces whose centres, over its size, are of some place."""
    points, faces = flat()
    low, size = points.min(axis=0), np.ptp(points, axis=0).max()
    centre = (points[faces].mean(axis=1) - low) / size
    return compact(points, faces[kept(centre)])


def compact(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A mesh without points that no face has."""
    used, inverse = np.unique(faces, return_inverse=True)
    return points[used], inverse.reshape(faces.shape)


def holed() -> tuple[np.ndarray, np.ndarray]:
    """With a hole."""
    return without(lambda c: np.hypot(c[:, 0] - 0.5, c[:, 1] - 0.3) > 0.12)


def cornered() -> tuple[np.ndarray, np.ndarray]:
    """With a corner that goes in."""
    return without(lambda c: (c[:, 0] < 0.5) | (c[:, 1] < 0.3))


def slit() -> tuple[np.ndarray, np.ndarray]:
    """Cut open along a line that ends inside: the two lips lie at one place."""
    points, faces = flat()
    low, size = points.min(axis=0), np.ptp(points, axis=0)
    row = np.unique(points[:, 1])[7]
    on = (np.abs(points[:, 1] - row) < 1e-9) & ((points[:, 0] - low[0]) / size[0] < 0.6)
    number = np.arange(len(points))
    number[on] = len(points) + np.arange(on.sum())
    above = points[faces].mean(axis=1)[:, 1] > row
    return np.concatenate([points, points[on]]), np.where(above[:, None], number[faces], faces)


def tube() -> tuple[np.ndarray, np.ndarray]:
    """Round at rest, narrow."""
    points, faces = flat()
    turn = 2.0 * np.pi * (points[:, 0] - points[:, 0].min()) / (np.ptp(points[:, 0]) + EDGE)
    radius = (np.ptp(points[:, 0]) + EDGE) / (2.0 * np.pi)
    return np.stack([radius * np.cos(turn), points[:, 1], radius * np.sin(turn)], axis=1), faces


def spiral() -> tuple[np.ndarray, np.ndarray]:
    """Rolled up at rest, layer on layer."""
    points, faces = flat(40, 8)
    length = points[:, 0] - points[:, 0].min()
    turn = np.sqrt(0.3**2 + 2.0 * length / (0.5 * EDGE)) - 0.3
    radius = 0.5 * EDGE * (turn + 0.3)
    return np.stack([radius * np.cos(turn), points[:, 1], radius * np.sin(turn)], axis=1), faces


SHAPES: tuple[Shape, ...] = (flat, holed, cornered, slit, tube, spiral)


class Cloth:
    """A mesh, its parts, and the toolkit's view of it."""

    def __init__(self, shape: Shape) -> None:
        self.rest, faces = shape()
        mesh = PolygonMesh(np.full(len(faces), 3, np.int32), faces.ravel().astype(np.int32), len(self.rest))
        self.level: Level = build_levels([named((mesh, self.rest), "Sheet")], [[]], dtype=torch.float64)[0]
        self.parts = Parts(self.level, np.ones((1, 1), bool))
        edges, triangles = (each.numpy().astype(np.int32) for each in (self.level.edges, self.level.triangles))
        self.oracle = ipctk.CollisionMesh(np.asfortranarray(self.rest), edges, triangles)
        table = self.parts.topology
        self.of_vertex = owners(table.first_vertex, table.vertices)
        self.of_edge, self.of_face = (
            owners(table.first_edge, table.edge_number),
            owners(table.first_face, table.face_number),
        )

    def pairs(self, x: np.ndarray, end: np.ndarray, few: torch.Tensor | None = None) -> ClusterPairs:
        """The broad phase for a move, with nothing to spare, of some clusters alone where these are given."""
        none = torch.zeros(len(x), dtype=torch.float64)
        given = {"radius": none, "slack": none, "allowed": none, "half": 0.0}
        return ClusterPairs.find(self.parts, torch.as_tensor(x), torch.as_tensor(end), **given, asked=few)

    def judged(self, found: ClusterPairs, x: np.ndarray, end: np.ndarray) -> tuple[int, int, bool]:
        """Pairs of parts that the toolkit takes for candidates on the straight way and nobody asks; how many of them
        touch; and whether anything crosses at the end."""
        ask, left, wrong = asked(found), 0, 0
        candidates = ipctk.Candidates()
        candidates.build(self.oracle, np.asfortranarray(x), np.asfortranarray(end))
        for each in (*candidates.fv_candidates, *candidates.ee_candidates):
            is_face = isinstance(each, ipctk.FaceVertexCandidate)
            own = self.of_vertex[each.vertex_id] if is_face else self.of_edge[each.edge0_id]
            other = self.of_face[each.face_id] if is_face else self.of_edge[each.edge1_id]
            if (min(own, other), max(own, other)) not in ask:
                four = each.vertex_ids(self.oracle.edges, self.oracle.faces)
                left, wrong = left + 1, wrong + each.ccd(x[four].ravel(), end[four].ravel())[0]
        return left, wrong, bool(ipctk.has_intersections(self.oracle, np.asfortranarray(end)))


def owners(first, numbers) -> np.ndarray:
    """The cluster of each part."""
    first, numbers = first.numpy(), numbers.numpy()
    out = np.empty(len(numbers), int)
    out[numbers] = np.repeat(np.arange(len(first) - 1), np.diff(first))
    return out


def placed(rest: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The mesh bent by waves of all lengths, a little or much, and turned."""
    x = rest.copy()
    for _ in range(int(rng.integers(1, 5))):
        way = rng.normal(size=3) / (EDGE * 10.0 ** rng.uniform(0.2, 1.2))
        size = EDGE * 10.0 ** rng.uniform(-1.5, 0.7)
        x = x + size * np.sin(rest @ way + rng.uniform(0.0, 6.3))[:, None] * rng.normal(size=3)
    x = x + EDGE * 10.0 ** rng.uniform(-4.0, -0.7) * rng.normal(size=x.shape)
    return x @ np.linalg.qr(rng.normal(size=(3, 3)))[0]


def folded(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One side of a plane through the mesh laid on the other, and through it."""
    middle, normal = x[rng.integers(len(x))], np.linalg.qr(rng.normal(size=(3, 3)))[0][0]
    beyond = np.maximum((x - middle) @ normal, 0.0)
    return x - 2.0 * np.outer(beyond, normal) + 0.1 * EDGE * rng.normal(size=x.shape)


def asked(found: ClusterPairs) -> set[tuple[int, int]]:
    """The pairs of clusters that are asked on a way."""
    return {(int(i), int(j)) for i, j in found.pairs[~found.apart].numpy()}


def judged(shape: Shape, moves: int, seed: int) -> np.ndarray:
    """On so many moves: patches that proved something, pairs that they leave out, and such that touch; and on how many
    moves any crosses at the end."""
    cloth, rng, out = Cloth(shape), np.random.default_rng(seed), np.zeros(4, int)
    for _ in range(moves):
        x = placed(cloth.rest, rng)
        end = x + placed(0.3 * cloth.rest, rng) if rng.uniform() < 0.6 else folded(x, rng)
        found = cloth.pairs(x, end)
        out += [int((found.relied >= 0).sum()), *cloth.judged(found, x, end)]
    return out


@pytest.mark.parametrize("shape", SHAPES)
def test_what_a_patch_leaves_out_never_touches(shape: Shape):
    patches, left, wrong, crossed = judged(shape, 8, seed=4)
    assert patches > 20
    assert left > 1000
    assert crossed > 1
    assert wrong == 0


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
def test_nor_on_ten_thousand_patches_and_moves(shape: Shape):
    patches, left, wrong, crossed = judged(shape, 420, seed=2)
    assert patches > 10_000 / len(SHAPES)
    assert left > 30_000
    assert crossed > 50
    assert wrong == 0


def test_nearly_all_neighbours_are_left_out_where_cloth_is_smooth_and_at_straight_hems():
    """A rigid move: boxes of neighbours meet, and almost nothing is asked."""
    cloth = Cloth(flat)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    found = cloth.pairs(cloth.rest @ turn, cloth.rest @ turn + [0.0, 0.0, 3.0 * EDGE])
    assert len(asked(found)) < 0.5 * cloth.parts.count


def test_lips_of_a_slit_are_asked():
    """They lie at one place, so what keeps distances over those at rest proves nothing of them."""
    cloth = Cloth(slit)
    points, count = cloth.rest, {tuple(each): 0 for each in np.round(cloth.rest, 9)}
    for each in np.round(points, 9):
        count[tuple(each)] += 1
    twice = [np.flatnonzero((np.round(points, 9) == place).all(axis=1)) for place, n in count.items() if n == 2]
    known = asked(cloth.pairs(points, points + 0.0))
    across = {tuple(sorted(map(int, cloth.of_vertex[pair]))) for pair in twice}
    assert len(across) > 3
    assert across <= known


@pytest.mark.parametrize("shape", [flat, tube])
def test_a_move_is_served_only_while_patches_stay_monotone(shape: Shape):
    """What serves for a move has no more to ask on another near it; bent sharply, it serves no more."""
    cloth, rng = Cloth(shape), np.random.default_rng(5)
    x = placed(cloth.rest, np.random.default_rng(11))
    given = {
        name: torch.full((len(x),), size, dtype=torch.float64) for name, size in (("slack", EDGE), ("radius", 0.0))
    }
    found = ClusterPairs.find(cloth.parts, torch.as_tensor(x), None, **given, allowed=given["radius"], half=0.0)
    served = 0
    for _ in range(40):
        start, end = (x + EDGE * 10.0 ** rng.uniform(-2.5, -0.3) * rng.uniform(-1, 1, x.shape) for _ in range(2))
        if found.covers(torch.as_tensor(start), torch.as_tensor(end)):
            served += 1
            assert cloth.judged(found, start, end)[1] == 0
    assert 3 < served < 40


@pytest.mark.parametrize("shape", SHAPES)
def test_several_threads_to_a_patch_find_what_one_finds(shape: Shape, monkeypatch: pytest.MonkeyPatch):
    """As on CUDA; they may rely on less, for each looks at the boxes of its own clusters."""
    cloth, rng = Cloth(shape), np.random.default_rng(5)
    for _ in range(4):
        x = placed(cloth.rest, rng)
        end, found = x + placed(0.2 * cloth.rest, rng), []
        for workers in (1, 5):
            for module in (broad_phase, patches):
                monkeypatch.setattr(module, "workers_on", lambda _, count=workers: count)
            m = cloth.parts.patches.measured(torch.as_tensor(x), torch.as_tensor(end), least=0.1, enough=0.2)
            found.append((m, cloth.pairs(x, end)))
        (m, one), (others, several) = found
        assert torch.equal(m, others)
        assert asked(one) == asked(several)
        assert len(one.pairs) == len(several.pairs)
        assert bool((several.relied <= one.relied).all())


@pytest.mark.parametrize("shape", SHAPES)
def test_what_is_known_of_positions_changes_no_answer(shape: Shape):
    cloth, rng, served = Cloth(shape), np.random.default_rng(6), []
    for _ in range(3):
        start = placed(cloth.rest, rng)
        given = {"radius": torch.zeros(len(start)).double(), "allowed": torch.zeros(len(start)).double(), "half": 0.0}
        slack = torch.full((len(start),), 0.5 * EDGE, dtype=torch.float64)
        at = torch.as_tensor(start)
        found = ClusterPairs.find(cloth.parts, at, None, slack=slack, **given)
        places = [at + EDGE * 10.0 ** rng.uniform(-3.0, 0.0) * torch.randn_like(at) for _ in range(6)]
        for _ in range(20):
            x, end = (places[int(rng.integers(6))] for _ in range(2))
            served.append(found.covers(x, end))
            assert served[-1] == replace(found, _near=[], _went=[]).covers(x, end)
    assert 0 < sum(served) < len(served)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_search_for_few_clusters_has_all_their_pairs(shape: Shape):
    """Each once, and others only where a patch of clusters that are not asked for would have left them out."""
    cloth, rng, more = Cloth(shape), np.random.default_rng(8), 0
    for _ in range(12):
        x = placed(cloth.rest, rng)
        end = x + placed(0.3 * cloth.rest, rng) if rng.uniform() < 0.6 else folded(x, rng)
        few = cloth.parts.with_any(torch.as_tensor(rng.uniform(size=len(x)) < 0.02))
        whole, found = cloth.pairs(x, end), cloth.pairs(x, end, few)
        own = {pair for pair in asked(whole) if few[list(pair)].any()}
        assert own <= asked(found)
        assert len({tuple(pair) for pair in found.pairs.tolist()}) == len(found.pairs)
        assert bool(few[found.pairs.long()].any(dim=1).all())
        more += len(own)
    assert more > 100


def test_a_move_of_few_that_leaves_its_paths_is_asked_as_any(monkeypatch: pytest.MonkeyPatch):
    cloth, rng, met = Cloth(spiral), np.random.default_rng(9), []
    x = torch.as_tensor(placed(cloth.rest, rng))
    for few in (detecting.FEW, 0.0):
        monkeypatch.setattr(detecting, "FEW", few)
        detector, other = Detector(cloth.parts), np.random.default_rng(10)
        detector.impacts(x, x + 0.1 * EDGE, floor=0.0, asked=torch.ones(len(x), dtype=torch.bool))
        found = detector._found
        for _ in range(6):
            near = (x - x[other.integers(len(x))]).norm(dim=1) < 2.0 * EDGE
            end = x + torch.where(near.unsqueeze(1), 4.0 * EDGE * torch.as_tensor(other.normal(size=3)), 0.0)
            pairs = detector.impacts(x, end, floor=0.0, asked=near)
            met.append({tuple(each) for each in pairs.corners.tolist()})
        assert (detector._found is found) == (few > 0.0)
    assert met[:6] == met[6:]
    assert sum(map(len, met)) > 20
