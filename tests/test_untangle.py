"""The way out of crossings and the promise that there are never more of them than before."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from brute import Soup, contour_length, crossings
from energies import evaluate
from folds import EDGE, SHAPES, crumpled, curved, folded, levels_of, named, placed, square, strip, view_of

from physgraph_usd.contact.cloth import ClothView
from physgraph_usd.contact.cloth_mesh import ClothMesh, Crossings
from physgraph_usd.contact.untangle import gaps_out, ways_out
from physgraph_usd.forces.self_contact import SelfContact
from physgraph_usd.level import Level

BOTH = np.ones((2, 2), bool)
LIFT = 0.3 * EDGE


def pair(upper: str) -> tuple[Level, torch.Tensor]:
    """A level sheet and a smaller one that passes through it, in float64; the second is the one that is bent."""
    cloths = square(4), square(4)
    level = levels_of(named(cloths[0], "A"), named(cloths[1], "B"), dtype=torch.float64)[-1]
    x = level.rest.clone()
    half = len(x) // 2
    points = 0.9 * x[half:].numpy() + np.array([0.0037, 0.0, 0.0051])
    x[half:] = torch.as_tensor(UPPER[upper](points))
    return level, x


def dented(points: np.ndarray) -> np.ndarray:
    """Above the other but for a dent in the middle."""
    radius = np.linalg.norm(points[:, [0, 2]], axis=1)
    return points + np.outer(LIFT - 2.2 * LIFT * np.exp(-((radius / 0.04) ** 2)), [0.0, 1.0, 0.0])


def cornered(points: np.ndarray) -> np.ndarray:
    """Above the other but for a corner."""
    down = 0.5 * (points[:, 0] + points[:, 2] - 0.08)
    return points + np.outer(LIFT - down.clip(0.0) * 1.5, [0.0, 1.0, 0.0])


def tilted(points: np.ndarray) -> np.ndarray:
    """Through the other from rim to rim, a little off its middle."""
    return points + np.outer(0.6 * points[:, 0] + 0.2 * points[:, 2] + 0.2 * LIFT, [0.0, 1.0, 0.0])


def shifted(points: np.ndarray) -> np.ndarray:
    """A flat sheet on its edge, passed through by the rim of the other."""
    return points[:, [1, 0, 2]] + np.array([0.081, 0.013, 0.02])


UPPER = {"dented": dented, "cornered": cornered, "tilted": tilted, "on edge": shifted}


def found_in(level: Level, x: torch.Tensor) -> tuple[ClothMesh, Crossings]:
    mesh = ClothMesh(level, BOTH)
    mesh.move(x)
    found = mesh.crossings(torch.ones(len(x), dtype=torch.bool))
    assert found.count == len(found.edge) > 5
    return mesh, found


class TestWaysOut:
    @pytest.mark.parametrize("name", UPPER)
    def test_the_place_is_where_edge_and_face_meet(self, name: str):
        level, x = pair(name)
        mesh, found = found_in(level, x)
        _, place = ways_out(mesh, found, x)
        ends, face = level.edges.long()[found.edge], mesh.triangles[found.face]
        on_edge = (1 - place[:, :1]) * x[ends[:, 0]] + place[:, :1] * x[ends[:, 1]]
        on_face = (place[:, 1:].unsqueeze(2) * x[face]).sum(dim=1)
        torch.testing.assert_close(on_edge, on_face, atol=1e-9, rtol=0)

    @pytest.mark.parametrize("name", ["dented", "cornered", "on edge"])
    def test_moved_along_it_the_contour_is_shorter(self, name: str):
        """Edges by the ways and faces against them, weighed as the springs weigh them."""
        level, x = pair(name)
        mesh, found = found_in(level, x)
        lengths = [contour_length(Soup.of(level, x))]
        for _ in range(5):
            _, force = evaluate(SelfContact(level, gaps_out(mesh, found, x, step=0.01, stiffness=1.0)), x)
            x = x + 0.04 * EDGE * force / force.norm(dim=1).max()
            lengths.append(contour_length(Soup.of(level, x)))
        assert all(after < before for before, after in pairwise(lengths)), lengths
        assert lengths[-1] < 0.97 * lengths[0]

    @pytest.mark.parametrize("name", ["dented", "cornered", "on edge"])
    def test_a_garment_moved_as_a_whole_along_their_sum_comes_out(self, name: str):
        level, x = pair(name)
        mesh, found = found_in(level, x)
        way, _ = ways_out(mesh, found, x)
        second = level.vertex_garment[level.edges.long()[found.edge, 0]] == 1
        total = torch.where(second.unsqueeze(1), way, -way).sum(dim=0)
        before = contour_length(Soup.of(level, x))
        x[level.vertex_garment == 1] += 0.05 * EDGE * total / total.norm()
        assert contour_length(Soup.of(level, x)) < before

    def test_its_length_is_the_contours_derivative(self):
        """A corner through a plane: the contour grows by G . d when all that is above moves by d."""
        level, x = pair("cornered")
        mesh, found = found_in(level, x)
        way, _ = ways_out(mesh, found, x)
        second = level.vertex_garment[level.edges.long()[found.edge, 0]] == 1
        clipped = way.norm(dim=1) > 0.999
        total = torch.where(second.unsqueeze(1), way, -way).sum(dim=0)
        slope = torch.zeros(3, dtype=x.dtype)
        for axis in range(3):
            sides = []
            for step in (1e-5, -1e-5):
                moved = x.clone()
                moved[level.vertex_garment == 1, axis] += step
                sides.append(contour_length(Soup.of(level, moved)))
            slope[axis] = (sides[0] - sides[1]) / 2e-5
        assert float(torch.nn.functional.cosine_similarity(-total, slope, dim=0)) > (0.7 if clipped.any() else 0.99)

    def test_a_straight_contour_from_rim_to_rim_has_no_way_out(self):
        """Moved across the other sheet it stays as long: at the cage the piece that is cut off goes back."""
        level, x = pair("tilted")
        mesh, found = found_in(level, x)
        way, _ = ways_out(mesh, found, x)
        ends = level.edges.long()[found.edge]
        inner = (x[ends].abs() < 0.08).all(dim=2).all(dim=1)
        assert float(way[inner].norm(dim=1).max()) < 0.35


def views(name: str) -> tuple[Level, ClothView, torch.Tensor]:
    """A strip whose cage does not cross itself, its view, and the base."""
    garment = named(strip(8, 3), pin=(strip(8, 3)[1][:, 0] < 0.01) * 1.0)
    levels = levels_of(garment)
    shapes = {"flat": lambda p: p, "curved": curved, "folded": folded, **SHAPES}
    base = placed(levels[-1], shapes[name])
    return levels[-1], view_of(levels, [garment], base), base


class TestMend:
    @pytest.mark.parametrize("name", ["flat", "curved", "folded", "rolled"])
    def test_where_nothing_crosses_the_input_is_the_result(self, name: str):
        _, view, base = views(name)
        x = base + 1e-3 * torch.sin(100 * base)
        assert view.look(x).crossings.count == 0
        assert view.mend(x).x is x

    @pytest.mark.parametrize("seed", range(4))
    @pytest.mark.parametrize("size", [0.3, 1.0, 3.0])
    @pytest.mark.parametrize("name", ["flat", "folded", "rolled", "crumpled", "rolled through itself"])
    def test_never_more_crossings_than_before(self, name: str, size: float, seed: int):
        level, view, base = views(name)
        noise = torch.randn(base.shape, generator=torch.Generator().manual_seed(seed))
        x = base + size * 0.3 * EDGE * noise * level.free
        before, mended = view.before.crossings.count, view.mend(x)
        now = len(crossings(Soup.of(level, mended.x)))
        assert now == mended.crossings.count
        assert now <= max(before, 0)
        assert (now > 0) <= (before > 0)
        torch.testing.assert_close(mended.x[~level.free[:, 0]], base[~level.free[:, 0]], atol=0, rtol=0)

    def test_only_what_is_near_the_new_crossings_moves(self):
        """A smooth wave that pushes the upper half of a fold through the lower one in one corner."""
        level, view, base = views("folded")
        upper = (base[:, 1] > 0.009) & (base[:, 2] > 0.03)
        x = base.clone()
        x[upper, 1] -= 0.014
        assert view.look(x).crossings.count > 0
        mended = view.mend(x)
        assert mended.crossings.count == 0
        moved = (mended.x - x).norm(dim=1) > 1e-7
        assert 0 < int(moved.sum()) < 0.6 * level.vertex_count

    def test_from_other_good_positions(self):
        level, view, base = views("crumpled")
        good = view.look(placed(level, folded))
        assert view.before.crossings.count > 0
        assert good.crossings.count == 0
        assert view.mend(base, good).crossings.count == 0

    def test_crossings_may_wander_next_to_where_they_were(self):
        """What crossed may cross elsewhere by a ring or two: no move there is taken back."""
        cloths = square(4), square(4)
        garments = [named(cloths[0], "A"), named(cloths[1], "B")]
        levels = levels_of(*garments)
        base = levels[-1].rest.clone()
        half = len(base) // 2
        base[half:] += 0.1 * EDGE * torch.rand_like(base[half:])
        base[half:, 1] += 0.5 * base[half:, 0]
        view = view_of(levels, garments, base)
        x = base.clone()
        x[half:, 1] += 0.001
        after = view.look(x).crossings
        assert 0 < after.count <= view.before.crossings.count
        assert view.mend(x).x is x

    def test_what_crumples_wholly_still_ends_without_more(self):
        level, view, base = views("flat")
        x = torch.as_tensor(crumpled(base.numpy(), 2, size=0.1), dtype=base.dtype)
        x = torch.where(level.free, x, base)
        assert view.look(x).crossings.count > 50
        assert view.mend(x).crossings.count == 0

    def test_what_may_cross_is_not_mended_by_tearing(self, monkeypatch: pytest.MonkeyPatch):
        """Two sheets that cross elsewhere, and more, in an input that is also torn there where they cross now."""
        cloths = square(4), square(4)
        garments = [named(cloths[0], "A"), named(cloths[1], "B")]
        levels = levels_of(*garments)
        x = levels[-1].rest.clone()
        upper = torch.arange(len(x)) >= len(x) // 2
        x[upper, 1] += 0.004
        base, right = x.clone(), x[:, 0] > 0.0
        base[upper & right, 1] -= 0.008
        base[upper & ~right, 0] += 0.03 * (torch.arange(int((upper & ~right).sum())) % 2)
        x[torch.argmin((x - torch.tensor([-0.04, 0.004, 0.0])).norm(dim=1) + 10.0 * ~upper), 1] -= 0.008
        view = view_of(levels, garments, base)
        state, most = view.look(x), view.most_strain(x)
        assert 0 < state.crossings.count < view.before.crossings.count
        mended = view.mend(x)
        assert 0 < mended.crossings.count <= state.crossings.count
        assert not view.is_taut(mended.x, most)
        monkeypatch.setattr(ClothView, "is_taut", lambda *_: False)
        torn = view.mend(x)
        assert torn.crossings.count < mended.crossings.count
        monkeypatch.undo()
        assert view.is_taut(torn.x, most)

    def test_little_strain_is_no_tear(self):
        _, view, base = views("flat")
        assert not view.is_taut(base, view.most_strain(base))
        assert not view.is_taut(1.4 * base, view.most_strain(base))
        assert view.is_taut(1.6 * base, view.most_strain(base))
        assert view.most_strain(1.6 * base) == pytest.approx(1.25 * 0.6, rel=0.05)
