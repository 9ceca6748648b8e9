"""The laws that every force keeps; `stability/test_forces_gradients.py` holds them to their energies."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from energies import apart, difference_force, evaluate
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from meshes import grid, mesh_of, planar_mesh
from sheets import KINDS, Sheet, garment_of, irregular, level_of, quality, rotation
from torch import Tensor

from physgraph_usd.solver.forces.base import Force
from physgraph_usd.solver.forces.bending import Bending
from physgraph_usd.solver.forces.gravity import Gravity
from physgraph_usd.solver.forces.guide import Guide, GuideMap
from physgraph_usd.solver.forces.membrane import Membrane
from physgraph_usd.solver.forces.self_contact import PairConstraints, SelfContact
from physgraph_usd.solver.forces.stretch import Stretch
from physgraph_usd.solver.forces.tether import Tether
from physgraph_usd.solver.level import Level, build_levels, refine_garments
from physgraph_usd.solver.mesh.topology import PolygonMesh

DOWN = np.array([0.0, 0.0, -9.81])
INTERNAL = ("stretch", "membrane", "bending")
ELASTIC = (*INTERNAL, "gravity")


@dataclass(frozen=True, eq=False)
class Case:
    """A sheet and what was done to it. Levels are built in the tests: the shape checker draws random numbers."""

    rest: np.ndarray
    triangles: np.ndarray
    bent: bool
    noise: float
    seed: int

    def build(self, *, dtype: torch.dtype = torch.float64) -> Level:
        return level_of(self.rest, self.triangles, bent=self.bent, dtype=dtype)

    @property
    def x(self) -> Tensor:
        return crumple(self.rest, self.noise, self.seed)


def force_of(name: str, level: Level) -> Force:
    """A term with constants of everyday size."""

    def of(value: float) -> Tensor:
        return torch.full((len(level.spans),), value, dtype=torch.float64)

    makers: dict[str, Callable[[], Force]] = {
        "stretch": lambda: Stretch(level, of(30.0)),
        "membrane": lambda: Membrane(level, of(30.0), of(7.0)),
        "bending": lambda: Bending(level, of(0.05)),
        "gravity": lambda: Gravity(level, of(0.2), DOWN),
        "guide": lambda: guide_of(level),
        "tether": lambda: Tether(level, of(0.2), 400.0, level.rest * 1.1),
    }
    return makers[name]()


def guide_of(level: Level) -> Guide:
    stiffness = torch.full((level.from_coarse.shape[1],), 2000.0)
    return Guide(level, GuideMap(level), stiffness).retarget(1.1 * level.rest)


def crumple(rest: np.ndarray, amount: float, seed: int) -> Tensor:
    """The rest shape with noise, turned and moved."""
    rng = np.random.default_rng(seed)
    x = rest + rng.normal(scale=amount, size=rest.shape)
    return torch.as_tensor(x @ rotation(seed).T + rng.normal(size=3))


@st.composite
def cases(draw: st.DrawFn) -> Case:
    """A crumpled sheet of jittered triangles with holes, on a bent rest shape in any position."""
    mesh, rest = draw(planar_mesh())
    triangles = mesh.triangulate(rest).triangles
    assume(len(triangles) > 0 and quality(rest, triangles).min() > 0.15)
    seed = draw(st.integers(0, 2**16))
    rest[:, 2] = 0.3 * np.sin(rest[:, 0] + seed)
    rest = rest @ rotation(seed + 1).T
    return Case(rest, triangles, draw(st.booleans()), draw(st.sampled_from([0.02, 0.2])), seed)


@settings(max_examples=25)
@given(case=cases(), seed=st.integers(0, 99))
def test_internal_forces_balance_and_turn_with_the_mesh(case: Case, seed: int):
    level, x = case.build(), case.x
    turn, shift = torch.as_tensor(rotation(seed)), torch.tensor([0.3, -2.0, 1.0])
    for name in INTERNAL:
        force = force_of(name, level)
        energy, f = evaluate(force, x)
        size = f.abs().sum() + 1e-30
        assert f.sum(dim=0).abs().max() < 1e-12 * size
        assert torch.linalg.cross(x, f).sum(dim=0).abs().max() < 1e-11 * size * x.abs().max()
        turned_energy, turned = evaluate(force, x @ turn.T + shift)
        assert turned_energy == pytest.approx(energy, rel=1e-9, abs=1e-15)
        assert (turned - f @ turn.T).abs().max() < 1e-9 * size


@settings(max_examples=15)
@given(case=cases())
def test_float32_agrees_with_float64_and_repeats_bit_for_bit(case: Case):
    level, x = case.build(), case.x
    single = case.build(dtype=torch.float32)
    for name in (*ELASTIC, "guide", "tether"):
        energy, f = evaluate(force_of(name, level), x)
        found, g = evaluate(force_of(name, single), x.float())
        again, h = evaluate(force_of(name, single), x.float())
        stiffness = float(force_of(name, level).diagonal(x).max()) * float(level.spacing.mean())
        size = max(float(f.abs().max()), stiffness)
        assert found == again
        assert torch.equal(g, h)
        assert abs(found - energy) < 1e-5 * max(abs(energy), size)
        assert (g - f).abs().max() < 3e-5 * size


def sheet(kind: str = "irregular") -> Sheet:
    points, triangles = KINDS[kind](0.5, 0.4, 0.1)
    return points @ rotation(5).T + 0.3, triangles


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", INTERNAL)
def test_springs_at_rest_are_the_trace_of_the_flat_hessian(name: str, kind: str):
    level, step = level_of(*sheet(kind)), 1e-6
    force, trace = force_of(name, level), np.zeros((level.vertex_count,) * 2)
    for v in range(len(trace)):
        for axis in range(3):
            shift = torch.zeros_like(level.rest)
            shift[v, axis] = step
            behind, ahead = (evaluate(force, level.rest + sign * shift)[1] for sign in (-1, 1))
            trace[v] += ((behind - ahead) / (2 * step))[:, axis].numpy()
    (a, b), (between, fixed) = level.springs.numpy().T, force.rest_springs()
    assert np.allclose(-between, trace[a, b], atol=1e-6 * np.abs(trace).max())
    assert np.allclose(fixed, trace.sum(axis=1), atol=1e-6 * np.abs(trace).max())


def refined() -> Level:
    mesh, points = grid(3, 2, "mixed")
    pin = np.where(np.arange(len(points)) == 4, 0.5, 0.0)
    garment = garment_of(mesh, points, pin=pin)
    return build_levels([garment], refine_garments([garment], [2]), dtype=torch.float64)[-1]


def test_guide_is_at_rest_on_the_cage_and_blind_to_wrinkles():
    level = refined()
    guide_map = GuideMap(level)
    count = level.from_coarse.shape[1]
    coarse = torch.randn((count, 3), dtype=torch.float64)
    guide = Guide(level, guide_map, torch.full((count,), 100.0)).retarget(coarse)
    x = level.base.apply(coarse)
    energy, f = evaluate(guide, x)
    assert float(energy) == 0.0
    assert not f.any()
    matrix = guide_map.spread_matrix.T.toarray()
    wrinkle = torch.as_tensor(null_vector(matrix, (level.pin > 0).numpy()))[:, None] * torch.ones(3)
    assert float(evaluate(guide, x + wrinkle)[0]) == pytest.approx(0.0, abs=1e-12)
    off = torch.randn_like(x)
    lag = guide_map.average.apply(off)
    area = torch.as_tensor(guide_map.coarse_area)[:, None]
    expected = 0.5 * 100.0 * (area * lag**2).sum() + 0.5 * 10 * (soft(level, 100.0)[:, None] * off**2).sum()
    assert float(evaluate(guide, x + off)[0]) == pytest.approx(float(expected), rel=1e-9)


def soft(level: Level, stiffness: float) -> Tensor:
    return stiffness * level.vertex_area * level.pin / (1 - level.pin)


def null_vector(matrix: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    """A unit vector that the averaging does not see and that leaves fixed vertices alone."""
    constraints = np.concatenate([matrix, np.eye(len(fixed))[fixed]])
    return np.linalg.svd(constraints)[2][-1]


def levels_of(
    mesh: PolygonMesh, rest: np.ndarray, depth: int = 0, *, dtype: torch.dtype = torch.float64
) -> tuple[Level, ...]:
    garment = garment_of(mesh, rest, bent=True)
    return build_levels([garment], refine_garments([garment], [depth]), dtype=dtype)


def test_no_corner_of_a_quad_is_the_first():
    """Small twists are the same round either diagonal; stretch is the mean of both splits."""
    mesh, flat = grid(4, 3)
    rest = flat * [1.0, 0.7, 0.0]
    x = torch.as_tensor(rest + 1e-4 * np.random.default_rng(0).normal(size=rest.shape))
    energies = []
    for turn in range(4):
        rolled = PolygonMesh(mesh.counts, np.roll(mesh.indices.reshape(-1, 4), turn, axis=1).ravel(), len(rest))
        level = levels_of(rolled, rest)[0]
        energies.append([evaluate(force_of(name, level), x)[0] for name in INTERNAL])
    np.testing.assert_allclose(energies, np.broadcast_to(energies[0], (4, 3)), rtol=1e-3)


@pytest.mark.parametrize("name", INTERNAL)
def test_forces_of_triangles_beside_quads_are_minus_the_gradient(name: str):
    """In single precision they are the same forces."""
    mesh, flat = grid(4, 2, "mixed")
    rest = flat + np.random.default_rng(0).normal(scale=0.05, size=flat.shape)
    single, double = (force_of(name, levels_of(mesh, rest, dtype=dtype)[0]) for dtype in (torch.float32, torch.float64))
    x = crumple(flat, 0.1, 2)
    force = evaluate(double, x)[1]
    assert apart(force, difference_force(double, x, 1e-3)) < 1e-6
    assert apart(evaluate(single, x.float())[1].double(), force) < 3e-5


@pytest.mark.parametrize(
    "corners", [[[0, 0], [1, -3], [0, 9], [-1, -3]], [[0, 0], [1, 0], [1, 0], [0, 1]], [[0, 0], [1, 0], [2, 0], [0, 1]]]
)
def test_quads_that_are_not_convex_count_as_triangles(corners: list[list[float]]):
    """A dart, a quad with a side without length, and a quad with a straight corner."""
    rest = np.column_stack([np.array(corners, float), np.zeros(4)])
    level = levels_of(mesh_of([[0, 1, 2, 3]]), rest)[0]
    assert torch.equal(level.membrane, level.triangles)
    assert torch.equal(level.springs, level.edges)
    a, b, c = rest[mesh_of([[0, 1, 2, 3]]).triangulate(rest).triangles].swapaxes(0, 1)
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    assert float(level.membrane_area.sum()) == pytest.approx(areas.sum())


def test_a_flat_cage_of_triangles_rests_unstrained():
    """Smooth subdivision rounds its outline, and the cloth keeps its own."""
    mesh, points = grid(4, 3, "triangles")
    for level in levels_of(mesh, points, 2):
        for name in INTERNAL:
            assert evaluate(force_of(name, level), level.base.apply(torch.as_tensor(points)))[0] < 1e-12


POINTS, TRIANGLES = irregular(0.4, 0.3, 0.1)
LEVEL = level_of(POINTS, TRIANGLES)
X = crumple(POINTS, 0.05, 8)


def gaps_of(x: torch.Tensor, count: int = 40, *, lack: float | None = None, seed: int = 0) -> PairConstraints:
    """Random pairs, vertex-face ones first; all short of their offset by the same, or by anything between +-2 cm."""
    rng = np.random.default_rng(seed)
    corners = torch.as_tensor(np.array([rng.choice(len(x), 4, replace=False) for _ in range(count)]), dtype=torch.int32)
    b, st = rng.dirichlet(np.ones(3), count), rng.uniform(0, 1, (count, 2))
    face = np.arange(count)[:, None] < count // 2
    weight = np.where(
        face, np.column_stack([np.ones(count), -b]), np.column_stack([1 - st[:, 0], st[:, 0], st[:, 1] - 1, -st[:, 1]])
    )
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    none = torch.zeros(count, dtype=x.dtype)
    made = PairConstraints(corners, torch.as_tensor(weight), torch.as_tensor(normal), none, none)
    offset = (made.vectors(x) * made.normal).sum(dim=1)
    short = torch.as_tensor(rng.uniform(-0.02, 0.02, count)) if lack is None else torch.full_like(none, lack)
    return replace(made, offset=offset + short, stiffness=torch.as_tensor(rng.uniform(10, 1000, count)))


TERMS = {
    "gaps": lambda: SelfContact(LEVEL, gaps_of(X)),
    "gaps, just open": lambda: SelfContact(LEVEL, gaps_of(X, lack=-1e-5)),
    "gaps, just short": lambda: SelfContact(LEVEL, gaps_of(X, lack=1e-3)),
}
OPEN = ("gaps, just open",)


@pytest.mark.parametrize("name", TERMS)
def test_the_force_is_minus_the_gradient(name: str):
    term = TERMS[name]()
    energy, force = evaluate(term, X)
    assert (energy == 0.0) == (name in OPEN)
    assert bool(force.any()) == (name not in OPEN)
    difference = difference_force(term, X, 2e-7)
    assert float((force - difference).abs().max()) < 1e-6 * max(float(difference.abs().max()), 1e-3)
