"""Which parts of cloth push one another, on which side, and which do not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from energies import evaluate
from folds import EDGE, curved, flat, folded, levels_of, named, placed, square, strip, view_of
from test_tangles import pair

from physgraph_usd.solver.contact.cloth import ClothView
from physgraph_usd.solver.forces.self_contact import PairConstraints, SelfContact

QUIET: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "flat": flat,
    "curved": curved,
    "half a turn": lambda points: curved(points, np.pi),
    "rippled": lambda points: points + np.outer(0.004 * np.sin(40 * points[:, 0]), [0.0, 1.0, 0.0]),
}


def creased(points: np.ndarray) -> np.ndarray:
    """Laid back over itself within less than an edge of the finer level."""
    return folded(points, gap=0.1 * EDGE)


class TestOneSheet:
    @pytest.mark.parametrize("level", [0, 1, 2])
    @pytest.mark.parametrize("name", QUIET)
    def test_what_is_bent_little_pushes_nothing(self, name: str, level: int):
        garment = named(strip(12, 4))
        levels = levels_of(garment, level=level)
        x = placed(levels[-1], QUIET[name])
        term = view_of(levels, [garment]).term(x)
        assert term is None or float(evaluate(term, x)[1].abs().max()) == 0.0

    @pytest.mark.parametrize("level", [1, 2])
    def test_in_a_sharp_fold_parts_one_edge_apart_push(self, level: int):
        garment = named(strip(8, 4))
        levels = levels_of(garment, level=level)
        view, x = view_of(levels, [garment], thickness=0.2 * EDGE), placed(levels[-1], creased)
        term = view.term(x)
        assert isinstance(term, SelfContact)
        beside, nearest = view.mesh.beside.toarray() > 0, []
        pushes = term.gaps.penetration(x).abs() > 0
        for corners, weights in zip(term.gaps.corners[pushes].tolist(), term.gaps.weight[pushes].tolist(), strict=True):
            of = [[c for c, w in zip(corners, weights, strict=True) if side * w > 1e-6] for side in (1.0, -1.0)]
            nearest.append(min(1 if beside[a, b] else 2 for a in of[0] for b in of[1]))
        assert {1, 2} <= set(nearest)


class TestCrossing:
    """Two sheets of 4 by 4 cells that cross."""

    def gaps(self, x: torch.Tensor) -> tuple[ClothView, PairConstraints]:
        garments = [named(square(4), name) for name in "AB"]
        view = view_of(levels_of(*garments), garments, thickness=0.4 * EDGE)
        term = view.term(x)
        assert isinstance(term, SelfContact)
        return view, term.gaps

    def test_what_crosses_has_no_side_to_keep(self):
        """It is drawn out instead, by two planes for each edge and face; what is beside it keeps its side."""
        x = pair("cornered")[1].float()
        view, gaps = self.gaps(x)
        found = view.crossings(x)
        out = 2 * found.count
        assert 0 < out < len(gaps.corners)
        crossed = view.mesh.crossed(found)
        assert not crossed[gaps.corners[:-out].long()].any()
        assert crossed[gaps.corners[-out:].long()].all()


def test_the_energy_of_each_pair_counts_for_the_garment_of_its_first_corner():
    garments = [named(square(4), name) for name in "AB"]
    levels = levels_of(*garments)
    _, x = pair("dented")
    term = view_of(levels, garments).term(x.float())
    assert isinstance(term, SelfContact)
    whole, _ = evaluate(term, x.float())
    energy, owner = term.split(x.float())
    gaps = term.gaps
    np.testing.assert_allclose(
        energy.numpy(), 0.5 * gaps.stiffness * gaps.penetration(x.float()) ** 2, rtol=1e-5, atol=1e-12
    )
    assert float(energy.sum()) == pytest.approx(float(whole), rel=1e-5)
    assert float(whole) > 0
    upper = gaps.corners[:, 0] >= len(x) // 2
    np.testing.assert_array_equal(owner.numpy(), upper.numpy())
    assert 0 < int(upper.sum()) < len(upper)
