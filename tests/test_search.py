"""Search of parts that touch on straight paths, judged by the IPC toolkit, which shares no code with it.

Sheets, tubes and spirals follow random paths, from smooth ones to such on which much touches. The toolkit's detector
says which parts touch, and each of these must be found.
"""

from collections.abc import Callable

import numpy as np
import pytest
import torch
import warp as wp
from folds import named
from meshes import grid

from physgraph_usd.solver.collide.narrow_phase import next_slot
from physgraph_usd.solver.collide.pairs import Pairs, Reach
from physgraph_usd.solver.collide.parts import TASKS, Parts, Room
from physgraph_usd.solver.collide.search import blocking_and_near, blocking_pairs, near_parts
from physgraph_usd.solver.contact.cloth import ClothContact
from physgraph_usd.solver.contact.springs import ClothSprings
from physgraph_usd.solver.level import Level, build_levels
from physgraph_usd.solver.mesh import threads
from physgraph_usd.solver.mesh.topology import PolygonMesh

ipctk = pytest.importorskip("ipctk", reason="the IPC toolkit is not installed; it is in the extra `dev`")
EDGE = 0.02
ROOT = 1e-7
"""Distance below which parts touch where they lie in one plane [m]; the toolkit counts a tenth of a millimetre."""
Shape = Callable[[], tuple[np.ndarray, np.ndarray]]
Pair = frozenset[frozenset[int]]


def flat(columns: int = 14, rows: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """A rectangle: points [m], and triangles."""
    mesh, points = grid(columns, rows, "triangles")
    return EDGE * points, np.asarray(mesh.indices).reshape(-1, 3)


def slit() -> tuple[np.ndarray, np.ndarray]:
    """Cut open along a line that ends inside: the two lips lie at one place."""
    points, faces = flat()
    low, size = points.min(axis=0), np.ptp(points, axis=0)
    row = np.unique(points[:, 1])[4]
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
    points, faces = flat(24, 5)
    length = points[:, 0] - points[:, 0].min()
    turn = np.sqrt(0.3**2 + 2.0 * length / (0.5 * EDGE)) - 0.3
    radius = 0.5 * EDGE * (turn + 0.3)
    return np.stack([radius * np.cos(turn), points[:, 1], radius * np.sin(turn)], axis=1), faces


SHAPES: tuple[Shape, ...] = (flat, slit, tube, spiral)


def named_pairs(pairs: Pairs) -> list[Pair]:
    """Pairs as sets of two sets of vertices."""
    split = np.where(pairs.face.numpy(), 1, 2)
    both = zip(pairs.corners.tolist(), split.tolist(), strict=True)
    return [frozenset((frozenset(c[:k]), frozenset(c[k:]))) for c, k in both]


class Cloth:
    """A mesh, its parts, and the toolkit's view of it."""

    def __init__(self, shape: Shape, *, threads: int = 1) -> None:
        self.rest, faces = shape()
        mesh = PolygonMesh(np.full(len(faces), 3, np.int32), faces.ravel().astype(np.int32), len(self.rest))
        self.garments = (named((mesh, self.rest), "Sheet"),)
        self.level: Level = build_levels(self.garments, [[]], dtype=torch.float64, threads=threads)[0]
        self.parts = Parts(self.level, np.ones((1, 1), bool))
        edges, triangles = (each.numpy().astype(np.int32) for each in (self.level.edges, self.level.triangles))
        self.oracle = ipctk.CollisionMesh(np.asfortranarray(self.rest), edges, triangles)

    def found(self, x: np.ndarray, end: np.ndarray, asked: np.ndarray | None = None) -> set[Pair]:
        """Pairs of parts that the search finds on a move, of queried vertices alone where these are given."""
        listed = self.listed(x, end, asked)
        assert len(set(listed)) == len(listed)
        return set(listed)

    def listed(self, x: np.ndarray, end: np.ndarray, asked: np.ndarray | None = None) -> list[Pair]:
        """Pairs that are found, in order."""
        some = np.ones(len(x), bool) if asked is None else asked
        given = [torch.as_tensor(each) for each in (x, end)]
        return named_pairs(blocking_pairs(self.parts, *given, floor=0.0, queried=torch.as_tensor(some)))

    def missed(self, x: np.ndarray, end: np.ndarray, found: set[Pair]) -> set[Pair]:
        """Pairs of parts that touch on a move according to the toolkit, and are not found."""
        candidates, out = ipctk.Candidates(), set()
        candidates.build(self.oracle, np.asfortranarray(x), np.asfortranarray(end))
        for each in (*candidates.fv_candidates, *candidates.ee_candidates):
            four = np.asarray(each.vertex_ids(self.oracle.edges, self.oracle.faces))
            split = 1 if isinstance(each, ipctk.FaceVertexCandidate) else 2
            pair = frozenset((frozenset(four[:split].tolist()), frozenset(four[split:].tolist())))
            if pair not in found and each.ccd(x[four].ravel(), end[four].ravel())[0]:
                if meet(x[four], end[four], is_face=split == 1):
                    out.add(pair)
        return out


def meet(x: np.ndarray, end: np.ndarray, *, is_face: bool) -> bool:
    """Whether two parts touch at a time when their four corners lie in one plane: a root of a cubic."""
    times = np.linspace(0.0, 1.0, 4)
    corners = x + times[:, None, None] * (end - x)
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1])
    distance = ipctk.point_triangle_distance if is_face else ipctk.edge_edge_distance
    roots = np.roots(np.polyfit(times, volume, 3))
    times = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real >= 0.0) & (roots.real <= 1.0)]
    return any(distance(*(x + time * (end - x))) < ROOT**2 for time in times)


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


def random_moves(cloth: Cloth, moves: int, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Starts and ends of random moves [m]."""
    rng, out = np.random.default_rng(seed), []
    for _ in range(moves):
        x = placed(cloth.rest, rng)
        out.append((x, x + placed(0.3 * cloth.rest, rng) if rng.uniform() < 0.6 else folded(x, rng)))
    return out


def judged(shape: Shape, moves: int, seed: int) -> tuple[int, int]:
    """Pairs found on random moves, and pairs that touch and are not found."""
    cloth, total, lost = Cloth(shape), 0, 0
    for x, end in random_moves(cloth, moves, seed):
        found = cloth.found(x, end)
        total, lost = total + len(found), lost + len(cloth.missed(x, end, found))
    return total, lost


@wp.kernel
def list_items(first: wp.int32, count: wp.array(dtype=wp.int32), out: wp.array(dtype=wp.int32)):  # pyright: ignore
    """Write the number of each item of a launch to a place of its own."""
    out[next_slot(count)] = first + wp.tid()


def test_threads_that_count_at_once_share_no_place():
    """Two threads that share a place count once. On a busy machine they seldom run at once, so it is tried often."""
    size, count = 2**22, torch.zeros(1, dtype=torch.int32)
    out = torch.full((size,), -1, dtype=torch.int32)
    for _ in range(50):  # The first launch tells how long an item takes.
        given = [wp.from_torch(count.zero_()), wp.from_torch(out)]
        threads.run(list_items, size, given, device="cpu", threads=4)  # pyright: ignore[reportArgumentType]
        assert int(count) == size
    assert torch.equal(out.sort().values, torch.arange(size, dtype=torch.int32))


@pytest.mark.parametrize("tasks", [1, TASKS])
@pytest.mark.parametrize("shape", SHAPES)
def test_room_threads_and_a_cards_kernels_change_neither_pairs_nor_their_order(
    shape: Shape, tasks: int, monkeypatch: pytest.MonkeyPatch
):
    """With little room at first, on four threads that share each launch; a card finds pairs by boxes, then judges."""
    cloth, other = Cloth(shape), Cloth(shape, threads=4)
    other.parts.tasks, other.parts.room = tasks, Room(2, 2, 2, 2)
    for x, end in random_moves(cloth, 4, seed=4):
        expected = cloth.listed(x, end)
        with monkeypatch.context() as shared:
            shared.setattr(threads, "LEAST_SECONDS", 1e-9)
            shared.setattr(threads, "SLICE_SECONDS", 1e-9)
            both = [other.listed(x, end) for _ in range(2)]
        assert both[0] == both[1]
        assert set(both[0]) == set(expected)
        assert both[0] == expected or tasks > 1


@pytest.mark.parametrize(("moves", "seed"), [(5, 4), pytest.param(100, 2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("shape", SHAPES)
def test_what_touches_is_found(shape: Shape, moves: int, seed: int):
    total, lost = judged(shape, moves, seed=seed)
    assert total > 20
    assert lost == 0


@pytest.mark.parametrize("shape", SHAPES)
def test_few_queried_vertices_give_their_own_pairs(shape: Shape):
    cloth, rng, total = Cloth(shape), np.random.default_rng(8), 0
    for x, end in random_moves(cloth, 20, seed=3):
        asked = rng.uniform(size=len(x)) < 0.1
        own = {pair for pair in cloth.found(x, end) if asked[list(frozenset().union(*pair))].any()}
        assert cloth.found(x, end, asked) == own
        total += len(own)
    assert total > 20


def near_by(cloth: Cloth, rng: np.random.Generator) -> Reach:
    """Search radii as of contact springs, unequal among the vertices; a tenth have no play, as without an edge."""
    size = rng.uniform(0.5, 1.5, len(cloth.rest)) * (rng.uniform(size=len(cloth.rest)) > 0.1)
    play = torch.as_tensor(0.05 * EDGE * size)
    return Reach(play + 0.05 * EDGE, play, 0.5)


@pytest.mark.parametrize("shape", SHAPES)
def test_no_pair_that_blocks_a_move_is_lost_where_near_pairs_are_known(shape: Shape):
    """Small and large moves from their start, on each of which some vertices leave their neighbours' reach."""
    cloth, rng, total, more = Cloth(shape), np.random.default_rng(5), 0, 0
    for x, end in random_moves(cloth, 30, seed=9):
        some, reach = 10.0 ** rng.uniform(-3.0, 0.0, (len(x), 1)), near_by(cloth, rng)
        start, aim = torch.as_tensor(x), torch.as_tensor(x + some * (end - x))
        given = {"floor": 0.01 * EDGE, "queried": torch.ones(len(x), dtype=torch.bool)}
        near = near_parts(cloth.parts, start, reach)
        expected = set(named_pairs(blocking_pairs(cloth.parts, start, aim, **given)))
        found = set(named_pairs(blocking_pairs(cloth.parts, start, aim, near=near, **given)))
        assert expected <= found
        total, more = total + len(expected), more + len(found - expected)
    assert total > 50
    assert more < 0.01 * total  # Kept apart along an axis, by their boxes, which known pairs do not ask.


@pytest.mark.parametrize("shape", SHAPES)
def test_one_search_finds_what_blocks_a_move_and_what_is_near_at_its_end(shape: Shape):
    cloth, rng, found, more = Cloth(shape), np.random.default_rng(7), [0, 0], 0
    for x, end in random_moves(cloth, 30, seed=10):
        reach, floor = near_by(cloth, rng), 0.01 * EDGE
        start, aim = torch.as_tensor(x), torch.as_tensor(end)
        blocked, near = blocking_and_near(cloth.parts, start, aim, reach, floor=floor)
        asked = torch.ones(len(x), dtype=torch.bool)
        alone = blocking_pairs(cloth.parts, start, aim, floor=floor, queried=asked)
        expected = set(named_pairs(alone))
        values = dict(zip(named_pairs(blocked), blocked.value.tolist(), strict=True))
        assert [values[pair] for pair in named_pairs(alone)] == pytest.approx(alone.value.tolist(), abs=1e-12)
        both, at_end = set(named_pairs(blocked)), set(named_pairs(near_parts(cloth.parts, aim, reach).pairs))
        assert expected <= both
        assert set(named_pairs(near.pairs)) == at_end - both
        found = [found[0] + len(expected), found[1] + len(at_end)]
        more += len(both - expected)
    assert min(found) > 50
    assert more < 0.01 * found[0]


@pytest.mark.parametrize("shape", SHAPES)
def test_near_pairs_after_few_vertices_moved_are_those_of_a_new_search(shape: Shape):
    """A tenth of the vertices is put back from the end of a move, and in every other move what blocks it too."""
    cloth, rng, total = Cloth(shape), np.random.default_rng(11), 0
    mesh = ClothContact((cloth.level,), cloth.garments).mesh(cloth.level, None, None, itself=True)
    springs = ClothSprings(mesh, cloth.level.rest, torch.tensor([0.3 * EDGE]), None)
    for number, (x, end) in enumerate(random_moves(cloth, 20, seed=12)):
        start, aim = torch.as_tensor(x), torch.as_tensor(end)
        blocking = springs.blocking(start, aim, aim, floor=0.01 * EDGE, queried=None)
        moved = torch.zeros(len(x), dtype=torch.bool)
        moved[blocking.corners.long().reshape(-1)] = number % 2 == 0
        moved |= torch.as_tensor(rng.uniform(size=len(x)) < 0.1)
        placed_back = torch.where(moved.unsqueeze(1), start, aim)
        found = named_pairs(springs.near(placed_back, placed_back, queried=None, inside=None).pairs)
        expected = named_pairs(near_parts(cloth.parts, placed_back, springs.reach).pairs)
        assert len(found) == len(set(found))
        assert set(found) == set(expected)
        total += len(found)
    assert total > 50
