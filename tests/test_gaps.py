"""On which side the planes between near parts of cloth hold them, and which parts have none."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch
from energies import evaluate
from folds import levels_of, named, square, view_of
from test_untangle import BOTH, pair

from physgraph_usd.contact.cloth_mesh import ClothMesh
from physgraph_usd.forces.self_contact import Gaps, SelfContact


class TestCrossing:
    """Two sheets of 4 by 4 cells that cross, as cloth without layers and as layers."""

    def own_gaps(self, *layers: float | None) -> tuple[Gaps, torch.Tensor]:
        """The planes but for those that draw out what crosses, and which vertices cross."""
        garments = [named(square(4), name, layer=layer) for name, layer in zip("AB", layers, strict=True)]
        levels = levels_of(*garments)
        _, x = pair("cornered")
        view = view_of(levels, garments, x.float())
        term = view.term(x.float())
        assert isinstance(term, SelfContact)
        out = 2 * view.before.crossings.count
        assert view.tangled
        assert 0 < out < len(term.gaps.corners)
        crossed = ClothMesh(levels[-1], BOTH).crossed(view.before.crossings)
        kept = len(term.gaps.corners) - out
        return Gaps(*(getattr(term.gaps, each.name)[:kept] for each in fields(Gaps))), crossed

    def test_what_crosses_has_no_side_to_keep(self):
        own, crossed = self.own_gaps(None, None)
        assert not crossed[own.corners.long()].any()

    def test_layers_keep_theirs_even_so(self):
        own, crossed = self.own_gaps(0, 1)
        assert crossed[own.corners.long()].any()


class TestLayers:
    """Two wavy sheets of 8 by 8 cells, 8 mm apart; their fronts face down, so outside is below."""

    def lacks(self, height: float, turn: float, *, upper_is_outer: bool) -> np.ndarray:
        """How far each pair is under what it keeps [m]; waves are so many fine edges high, and turn so fast an edge."""
        layers = (0, 1) if upper_is_outer else (1, 0)
        garments = [named(square(8), name, layer=layer) for name, layer in zip("AB", layers, strict=True)]
        levels = levels_of(*garments)
        x, edge = levels[-1].rest.clone(), float(levels[-1].spacing.mean())
        x[:, 1] = height * edge * torch.sin(turn * x[:, 0] / edge) + 0.2 * edge * torch.sin(1.3 * x[:, 2] / edge)
        upper = torch.arange(len(x)) >= len(x) // 2
        x[upper] += torch.tensor([0.13 * edge, 0.008, 0.0])
        view = view_of(levels, garments, x)
        term = view.term(x)
        assert not view.tangled
        assert isinstance(term, SelfContact)
        assert len(term.gaps.corners) > 1000
        return term.gaps.lacks(x).numpy()

    @pytest.mark.parametrize(("height", "turn"), [(0.0, 1.0), (1.0, 1.0), (1.0, 1.5), (2.0, 1.0)])
    def test_none_is_sent_back_that_lies_right(self, height: float, turn: float):
        """Beyond the next wave an outer sheet lies behind the inner one's normals, and is outside all the same."""
        assert self.lacks(height, turn, upper_is_outer=False).max() < 1e-6

    @pytest.mark.parametrize("height", [0.0, 0.5])
    def test_all_are_sent_back_that_lie_wrong(self, height: float):
        assert (self.lacks(height, 1.0, upper_is_outer=True) > 0.001).mean() > 0.95


def test_the_energy_of_each_pair_counts_for_the_garment_of_its_first_corner():
    garments = [named(square(4), name) for name in "AB"]
    levels = levels_of(*garments)
    _, x = pair("dented")
    term = view_of(levels, garments, x.float()).term(x.float())
    assert isinstance(term, SelfContact)
    whole, _ = evaluate(term, x.float())
    energy, owner = term.split(x.float())
    gaps = term.gaps
    np.testing.assert_allclose(energy.numpy(), 0.5 * gaps.stiffness * gaps.lacks(x.float()) ** 2, rtol=1e-5, atol=1e-12)
    assert float(energy.sum()) == pytest.approx(float(whole), rel=1e-5)
    assert float(whole) > 0
    upper = gaps.corners[:, 0] >= len(x) // 2
    np.testing.assert_array_equal(owner.numpy(), upper.numpy())
    assert 0 < int(upper.sum()) < len(upper)
