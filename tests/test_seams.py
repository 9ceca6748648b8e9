"""Seams: cloth cut along a line whose sides are at one place stays one cloth."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from bodies import ball
from cloth import FABRIC, base_of
from folds import (
    EDGE,
    Cloth,
    curved,
    fine,
    frame_with,
    levels_of,
    named,
    near_pairs,
    refiner_with,
    sewn,
    square,
    strip,
    view_of,
)
from meshes import grid

from physgraph_usd.solver.collide.crossings import crossings
from physgraph_usd.solver.collide.pairs import Reach
from physgraph_usd.solver.collide.parts import Parts
from physgraph_usd.solver.contact.settings import ContactSettings
from physgraph_usd.solver.forces import elastic_terms
from physgraph_usd.solver.forces.base import ForceModule
from physgraph_usd.solver.forces.seam import Seam, SewnForces
from physgraph_usd.solver.level import Level, Placed
from physgraph_usd.solver.mesh.topology import PolygonMesh, joined_by
from physgraph_usd.solver.scene import Garment

SOFT = replace(FABRIC, shear=10.0)
"""A fabric that also resists shear."""


def cut(cloth: Cloth, sides: np.ndarray) -> tuple[Cloth, np.ndarray]:
    """A mesh cut into panels, each face on the side of that number; also which vertex each vertex was."""
    mesh, points = cloth
    faces = mesh.indices.reshape(-1, 3)
    key = sides[:, None] * len(points) + faces
    number, again = np.unique(key, return_inverse=True)
    source = number % len(points)
    panels = PolygonMesh(np.full(len(faces), 3), again.reshape(-1), len(source))
    return (panels, points[source]), source


def panels(cloth: Cloth, count: int = 2) -> tuple[Cloth, np.ndarray]:
    """A sheet cut across x into strips of faces."""
    mesh, points = cloth
    centre = points[mesh.indices.reshape(-1, 3)].mean(axis=1)[:, 0]
    inner = np.quantile(np.unique(points[:, 0].round(9)), np.arange(1, count) / count, method="nearest")
    return cut(cloth, np.searchsorted(inner, centre))


def seam_of(level: Level, base: torch.Tensor) -> Seam:
    """Every two vertices at one place."""
    found = np.argwhere(np.triu((torch.cdist(base.double(), base.double()) < 1e-6).numpy(), 1))
    return Seam(level, found)


def two_halves() -> tuple[Level, Seam, torch.Tensor]:
    """A sheet cut in two at its finest level, its seam, and its positions."""
    cloth, _ = panels(square(4))
    levels = levels_of(named(cloth), dtype=torch.float64)
    base = fine(levels, cloth[1])
    return levels[-1], seam_of(levels[-1], base), base


def noise(like: torch.Tensor, seed: int = 0) -> torch.Tensor:
    return torch.randn(like.shape, generator=torch.Generator().manual_seed(seed), dtype=like.dtype)


class TestForces:
    def sewn(self) -> tuple[SewnForces, ForceModule, Seam, torch.Tensor]:
        level, seam, base = two_halves()
        apart = ForceModule(elastic_terms(level, [SOFT]))
        return SewnForces(apart, seam), apart, seam, base + 2e-3 * noise(base)

    def test_the_force_is_minus_the_gradient(self):
        forces, _, seam, x = self.sewn()
        force, way = forces.energy_and_force(x)[1], noise(x, 1)
        step = 1e-6
        rise = forces.energy_and_force(x + step * way)[0] - forces.energy_and_force(x - step * way)[0]
        assert float(rise) / (2 * step) == pytest.approx(-float((force * way).sum()), rel=1e-6)
        for a, b in seam.pairs:
            assert torch.equal(force[a], force[b])


def stretched(points: np.ndarray) -> np.ndarray:
    """Pulled along x, and bent to and fro within the plane."""
    return points * [1.15, 1.0, 1.0] + 0.02 * np.sin(20.0 * points[:, :1]) * [0.0, 0.0, 1.0]


@pytest.mark.parametrize("count", [2, 4])
def test_a_cut_sheet_in_tension_is_the_whole_one(count: int):
    """Held at both ends and pulled: a seam transmits what the cloth would, so the cut shows nowhere."""
    whole = strip(8, 4)
    pieces, source = panels(whole, count)
    answers = []
    for cloth in (whole, pieces):
        x = cloth[1][:, 0]
        pin = ((x < 0.01) | (x > x.max() - 0.01)) * 1.0
        solver = refiner_with(
            sewn([named(cloth, pin=pin)], cloth[1]),
            level=1,
            gravity=np.zeros(3),
            dtype=torch.float64,
            steps=400,
            tolerance=1e-8,
        )
        frame = frame_with([stretched(cloth[1])], fabric=SOFT, guide=0.0)
        answers.append((solver.solve(frame).points[0], base_of(cloth[0], cloth[1], 1)))
    (one, rest), (other, places) = answers
    same = np.linalg.norm(places[:, None] - rest, axis=2).argmin(axis=1)
    assert len(source) > len(whole[1])
    assert np.abs(one - base_of(whole[0], stretched(whole[1]), 1)).max() > 0.05 * EDGE
    assert np.abs(other - one[same]).max() < 1e-4 * EDGE


def gap_of(points: np.ndarray, places: np.ndarray) -> float:
    """How far what is at one place in the cage is apart [m]."""
    near = np.argwhere(np.triu(np.linalg.norm(places[:, None] - places, axis=2) < 1e-9, 1))
    assert len(near)
    return float(np.linalg.norm(points[near[:, 0]] - points[near[:, 1]], axis=1).max())


@pytest.mark.parametrize("options", [{}, {"contact": ContactSettings(cloth="off")}, {"integrator": "physgraph"}])
def test_seams_stay_closed_on_a_body(options: dict[str, Any]):
    """A sheet of four panels sinks onto a ball that stands in it: closed, and as far outside as a whole one."""
    cloth, _ = panels(square(8, edge=0.5 * EDGE), 4)
    solver = refiner_with(sewn([named(cloth)], cloth[1]), ["mesh"], times=(0.0, 1.0), **options)
    for time in (0.0, 1.0):
        cage = cloth[1] + [0.0, 0.058 - 0.004 * time, 0.0]
        answer = solver.solve(frame_with([cage], ball(0.06, level=3), time=time))
        assert gap_of(answer.points[0], base_of(cloth[0], cage, 1)) < 1e-7
        after = next(iter(answer.telemetry[0]["contact"]["bodies"].values()))["after"]
        assert after["inside"] == 0


HEM = 8
"""Edges of a hem along x, at y = 0; the cloth above it has the first vertices."""


def on_a_hem(pieces: Sequence[Sequence[tuple[float, float]]]) -> Cloth:
    """A sheet with a hem, and faces hanging from it, with corners at places (along the hem, above it) in edges."""
    mesh, points = grid(HEM, 1)
    number = len(points) + np.arange(sum(map(len, pieces)))
    counts, indices = np.append(mesh.counts, [len(piece) for piece in pieces]), np.append(mesh.indices, number)
    corners = np.array([(x, y, 0.0) for piece in pieces for x, y in piece])
    return PolygonMesh(counts, indices, len(points) + len(number)), EDGE * np.concatenate([points, corners])


STRAPS = {
    "a strip between two points": [[(3.2, -1.0), (3.6, -1.0), (3.6, 0.0), (3.2, 0.0)]],
    "a tip in an edge": [[(1.8, -1.0), (3.0, -1.0), (2.4, 0.0)]],
    "a strip over two edges": [[(2.7, -1.0), (3.4, -1.0), (3.4, 0.0), (2.7, 0.0)]],
    "a fringe": [[(k + 0.2, -2.0), (k + 0.6, -2.0), (k + 0.6, 0.0), (k + 0.2, 0.0)] for k in range(HEM)],
}


@pytest.mark.parametrize("level", [1, *(pytest.param(level, marks=pytest.mark.slow) for level in (0, 2))])
@pytest.mark.parametrize("name", STRAPS)
def test_a_strap_sewn_on_between_two_points_of_a_border_stays_on_it(name: str, level: int):
    """No two vertices of the cage are at one place: each sewn corner lies within an edge of a hem that is bent."""
    mesh, points = on_a_hem(STRAPS[name])
    bent = points + 0.5 * EDGE * np.sin(20.0 * points[:, :1]) * [0.0, 0.0, 1.0]
    solver = refiner_with(sewn([named((mesh, points))], points), level=level)
    x = solver.solve(frame_with([bent])).points[0]
    at, strap = base_of(mesh, points, level), base_of(mesh, np.arange(len(points)) > 2 * HEM + 1, level) > 0.5
    on_hem = np.abs(at[:, 1]) < 1e-9
    hem, ends = np.flatnonzero(on_hem & ~strap), np.flatnonzero(on_hem & strap)
    hem = x[hem[np.argsort(at[hem, 0])]]
    along = (hem[:-1] + np.linspace(0.0, 1.0, 65)[:, None, None] * np.diff(hem, axis=0)).reshape(-1, 3)
    away = np.linalg.norm(x[ends][:, None] - along, axis=2).min(axis=1)
    assert len(ends) >= len(STRAPS[name])
    assert away.max() < 0.01 * EDGE / 2**level


def test_a_box_of_sewn_faces_settles():
    """A box whose faces are held together by seams alone, pressed: no part is pushed by the one it is sewn to."""
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    points = 0.01 * np.concatenate([corner[list(side)] for side in sides])
    mesh = PolygonMesh(np.full(6, 4), np.arange(24), 24)
    pressed = points * [0.95, 0.9, 1.0] + [0.1, 0.0, 0.0] * points[:, 1:2]
    solver = refiner_with(sewn([named((mesh, points))], points), level=4, steps=50)
    answer = solver.solve(frame_with([pressed]))
    assert answer.telemetry[0]["contact"]["cloth"]["after"]["crossings"] == 0
    assert answer.telemetry[0]["levels"][-1]["remaining_move"] < 0.02
    assert gap_of(answer.points[0], base_of(mesh, pressed, 4)) == 0.0


class TestCloth:
    def sewn(self) -> tuple[Garment, tuple[Level, ...], Seam, torch.Tensor]:
        cloth, _ = panels(strip(8, 3))
        garment = named(cloth)
        levels = levels_of(garment)
        base = fine(levels, curved(cloth[1], 2.0))
        return garment, levels, seam_of(levels[-1], base), base

    def test_what_is_sewn_is_no_pair_with_what_is_beside_it(self):
        """Folded sharply along the seam, so that nothing is in one plane."""
        cloth, _ = panels(strip(8, 3))
        levels = levels_of(named(cloth))
        level = levels[-1]
        x = level.rest.clone()
        middle = float(np.median(x[:, 0]))
        x[:, 1] = 0.4 * (x[:, 0] - middle).abs()
        one = joined_by(seam_of(level, level.rest).pairs, level.vertex_count)
        near = Reach(torch.full_like(x[:, 0], 0.02).double(), torch.ones_like(x[:, 0]).double(), 0.0)

        def joined(label: np.ndarray | None) -> int:
            pairs = near_pairs(Parts(level, np.ones((1, 1), bool), label), x, near)
            split = np.where(pairs.face.numpy(), 1, 2)
            return sum(
                len({*four[:k]} & {*four[k:]}) > 0 for four, k in zip(one[pairs.corners.numpy()], split, strict=True)
            )

        assert joined(None) > 0
        assert joined(one) == 0

    @pytest.mark.parametrize("seed", range(4))
    def test_whatever_is_wanted_seams_stay_closed_and_nothing_crosses(self, seed: int):
        """Noise that would cross the cloth on both sides of its seam, and open that."""
        garment, levels, seam, base = self.sewn()
        view, start = view_of(levels, [garment], seam=seam), seam.closed(base)
        wanted = seam.closed(base + 0.3 * EDGE * noise(base, seed))
        assert view.look(wanted).crossings.count > 0
        x = view.moved(Placed(start), wanted)
        assert crossings(view.mesh.parts, x).count == 0
        assert gap_of(x.numpy(), base.numpy()) < 1e-6
        assert torch.equal(seam.closed(x), x)
        assert bool((x != start).any(dim=1)[seam.pairs.reshape(-1)].any())

    def test_a_frame_whose_carried_detail_opens_at_a_seam_is_closed(self):
        """Two frames of a sewn strip that is bent at its seam by ever more."""
        cloth, _ = panels(strip(8, 3))
        solver = refiner_with(sewn([named(cloth)], cloth[1]), times=(0.0, 1.0, 2.0))
        middle = float(np.median(cloth[1][:, 0]))
        for time in range(3):
            bent = cloth[1].copy()
            bent[:, 1] = 0.2 * (1 + time) * np.abs(bent[:, 0] - middle)
            answer = solver.solve(frame_with([bent], time=float(time)))
            assert gap_of(answer.points[0], base_of(cloth[0], bent, 1)) < 1e-7
            assert answer.telemetry[0]["contact"]["cloth"]["after"]["crossings"] == 0

    def test_what_meets_at_a_corner_does_not_cross(self):
        """Edges that begin at corners of faces they are sewn to: rounding puts them on either side, at any place."""
        garment, levels, seam, base = self.sewn()
        for seed in range(8):
            turn = torch.linalg.qr(noise(torch.zeros((3, 3)), seed))[0]
            x = seam.closed(base + 0.02 * EDGE * noise(base, seed)) @ turn + noise(torch.zeros(3), seed)
            x = seam.closed(x)
            assert view_of(levels, [garment], seam=seam).look(x).crossings.count == 0
