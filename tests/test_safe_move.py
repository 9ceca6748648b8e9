"""The promise: whatever is wanted, what is apart stays apart; judged by the IPC toolkit, which shares no code with it.

A trial is one pair of random sheets and one move. Many pairs make one mesh, each its own garment, far from the others.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from folds import named
from scipy.spatial import Delaunay

from physgraph_usd.solver.collide.parts import Parts
from physgraph_usd.solver.contact.promise import safe_move
from physgraph_usd.solver.level import Level, build_levels
from physgraph_usd.solver.mesh.topology import PolygonMesh

ipctk = pytest.importorskip("ipctk", reason="the IPC toolkit is not installed; it is in the extra `dev`")
EDGE = 0.02
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]


def sheet(rng: np.random.Generator, points: int) -> tuple[np.ndarray, np.ndarray]:
    """A random flat triangle mesh of mean edges about `EDGE`."""
    flat = rng.uniform(0.0, 1.0, (points, 2)) * EDGE * np.sqrt(points)
    return np.c_[flat, np.zeros(points)], Delaunay(flat).simplices


class Scenes:
    """Pairs of sheets, one over the other, as the garments of one mesh."""

    def __init__(
        self, pairs: int, *, gap: float, far: float, seed: int = 0, dtype: torch.dtype, device: str = "cpu"
    ) -> None:
        rng = np.random.default_rng(seed)
        points, faces, self.owner, count = [], [], [], 0
        for number in range(pairs):
            turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
            place = np.array([number % 10, number // 10, 0.0]) + far * EDGE
            for side in range(2):
                x, f = sheet(rng, int(rng.integers(4, 14)))
                x[:, 2] += side * gap * EDGE
                points.append(x @ turn.T + place)
                faces.append(f + count)
                self.owner += [number] * len(x)
                count += len(x)
        self.owner, self.start = np.array(self.owner), np.concatenate(points)
        corners = np.concatenate(faces)
        mesh = PolygonMesh(np.full(len(corners), 3, np.int32), corners.ravel().astype(np.int32), count)
        self.level: Level = build_levels([named((mesh, self.start), "Sheets")], [[]], dtype=dtype, device=device)[0]
        # Each pair is asked against each: farther than any move, others never meet.
        self.parts = Parts(self.level, np.ones((1, 1), bool))
        triangles = corners.astype(np.int32)
        self.oracle = ipctk.CollisionMesh(np.asfortranarray(self.start), ipctk.edges(triangles), triangles)
        self.x = torch.as_tensor(self.start, dtype=dtype, device=device)

    def crosses(self) -> bool:
        """Whether anything crosses, by the toolkit."""
        points = self.x.double().cpu().numpy()
        return bool(ipctk.has_intersections(self.oracle, np.asfortranarray(points - points.mean(axis=0))))

    def go(self, wanted: np.ndarray) -> np.ndarray:
        """Move towards what is wanted; which vertices fall short."""
        end = torch.as_tensor(wanted).to(self.x)
        self.x = safe_move(self.x, end, self.parts, floor=1e-4 * EDGE)
        return (self.x != end).any(dim=1).cpu().numpy()


def noise(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Every vertex anywhere, as far as a few edges or as little as rounding."""
    return x + EDGE * 10.0 ** rng.uniform(-6, 0.5) * rng.normal(size=x.shape)


def collapsed(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """All to one point."""
    return np.broadcast_to(x.mean(axis=0), x.shape) + 0.01 * EDGE * rng.normal(size=x.shape)


def mirrored(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Through itself."""
    normal = np.linalg.qr(rng.normal(size=(3, 3)))[0][0]
    return x - 2.0 * np.outer((x - x.mean(axis=0)) @ normal, normal)


def flung(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One vertex far through all the rest, the others a little."""
    out = x + 0.01 * EDGE * rng.normal(size=x.shape)
    one = rng.integers(len(x))
    out[one] += (x.mean(axis=0) - x[one]) * rng.uniform(1.0, 3.0)
    return out


def turned(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rigidly turned about its middle, half of it the other way."""
    angle = rng.uniform(-2.0, 2.0) * np.where(np.arange(len(x)) < len(x) // 2, 1.0, -1.0)
    y, c, s = x - x.mean(axis=0), np.cos(angle), np.sin(angle)
    return x.mean(axis=0) + np.stack([c * y[:, 0] - s * y[:, 1], s * y[:, 0] + c * y[:, 1], y[:, 2]], axis=1)


WISHES = (noise, collapsed, mirrored, flung, turned)


def wanted_of(scenes: Scenes, rng: np.random.Generator) -> np.ndarray:
    """A wish for each pair, another each time."""
    out = scenes.x.double().cpu().numpy().copy()
    for number in np.unique(scenes.owner):
        own = scenes.owner == number
        out[own] = WISHES[rng.integers(len(WISHES))](out[own], rng)
    return out


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    ("gap", "far", "dtype"),
    [(0.3, 0.0, torch.float32), (1e-2, 0.0, torch.float32), (1e-6, 1e4, torch.float64), (1e-6, 0.0, torch.float64)],
    ids=["apart", "near", "near and far from the origin", "near at the origin"],
)
class TestNothingEverCrosses:
    def trials(self, pairs: int, moves: int, *, seed: int, **given: object) -> None:
        scenes, rng = Scenes(pairs, seed=seed, **given), np.random.default_rng(seed)  # type: ignore[arg-type]
        assert not scenes.crosses()
        for move in range(moves):
            scenes.go(wanted_of(scenes, rng))
            assert not scenes.crosses(), f"move {move} of seed {seed}"

    def test_whatever_is_wanted(self, gap: float, far: float, dtype: torch.dtype, device: str):
        self.trials(10, 6, seed=1, gap=gap, far=far, dtype=dtype, device=device)

    @pytest.mark.slow
    def test_in_ten_thousand_trials(self, gap: float, far: float, dtype: torch.dtype, device: str):
        for seed in range(25):
            self.trials(10, 10, seed=100 + seed, gap=gap, far=far, dtype=dtype, device=device)


class TestWhatIsFreeToGoGoes:
    def test_all_the_way_and_to_the_last_bit(self):
        scenes = Scenes(4, gap=0.5, far=0.0, dtype=torch.float32)
        wanted = scenes.x + 1e-5 * EDGE * torch.randn_like(scenes.x)
        assert safe_move(scenes.x, wanted, scenes.parts, floor=1e-6) is wanted

    def test_layers_that_move_together_are_not_held_up(self):
        scenes = Scenes(4, gap=1e-3, far=0.0, dtype=torch.float64)
        assert not scenes.go(scenes.start + EDGE * np.array([30.0, 7.0, -11.0])).any()

    def test_what_stops_stops_what_comes_behind_it(self):
        """Two sheets fly as fast as one another; the first meets a wall, to which the second would not come."""
        points, faces, count = [], [], 0
        for height in (-6.0, 0.0, 4.0):
            x, f = sheet(np.random.default_rng(3), 40)
            points.append(x + np.array([0.0, 0.0, height * EDGE]))
            faces.append(f + count)
            count += len(x)
        start, corners = np.concatenate(points), np.concatenate(faces)
        mesh = PolygonMesh(np.full(len(corners), 3, np.int32), corners.ravel().astype(np.int32), count)
        level = build_levels([named((mesh, start), "Row")], [[]], dtype=torch.float64)[0]
        wanted = start.copy()
        wanted[:80, 2] += 9.9 * EDGE
        parts = Parts(level, np.ones((1, 1), bool))
        moved = safe_move(torch.as_tensor(start), torch.as_tensor(wanted), parts, floor=1e-4 * EDGE)
        behind, first, wall = moved.numpy()[:, 2].reshape(3, 40)
        assert first.max() < wall.min()
        assert behind.max() < first.min()

    def test_what_is_in_one_tangle_goes_through_itself_wherever_it_is_wanted(self):
        scenes = Scenes(2, gap=0.1, far=0.0, dtype=torch.float64)
        wanted = torch.as_tensor(mirrored(scenes.start, np.random.default_rng(1)))
        whole = torch.as_tensor(np.asarray(scenes.owner, np.int32))
        assert safe_move(scenes.x, wanted, scenes.parts, floor=1e-6, tangle=torch.zeros_like(whole)) is wanted

    def test_but_not_through_another_nor_through_what_is_in_none(self):
        scenes, rng = Scenes(3, gap=0.1, far=0.0, dtype=torch.float64), np.random.default_rng(1)
        wanted = scenes.start.copy()
        for number in range(3):
            own = scenes.owner == number
            wanted[own] = mirrored(wanted[own], rng)
        tangle = torch.as_tensor(np.asarray(scenes.owner, np.int32))
        tangle[tangle == 2] = -1
        moved = safe_move(scenes.x, torch.as_tensor(wanted), scenes.parts, floor=1e-6, tangle=tangle)
        owner = np.asarray(scenes.owner)
        own, none = owner < 2, owner == 2
        np.testing.assert_array_equal(moved.numpy()[own], wanted[own])
        assert (moved.numpy() != wanted)[none].any()


def test_moves_are_the_same_each_time_and_in_any_number_of_threads():
    results = []
    for threads in (1, 1, 2):
        scenes = Scenes(40, gap=1e-2, far=0.0, dtype=torch.float32)
        scenes.parts.level = replace(scenes.level, threads=threads)
        scenes.go(wanted_of(scenes, np.random.default_rng(5)))
        results.append(scenes.x)
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])
