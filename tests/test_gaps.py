"""Which parts of cloth push one another, on which side, and which do not."""

from __future__ import annotations

import torch
from folds import EDGE, levels_of, named, square, view_of
from test_tangles import pair

from physgraph_usd.solver.contact.cloth import ClothView
from physgraph_usd.solver.forces.self_contact import PairConstraints, SelfContact


class TestCrossing:
    """Two sheets of 4 by 4 cells that cross."""

    def gaps(self, x: torch.Tensor) -> tuple[ClothView, PairConstraints]:
        garments = [named(square(4), name) for name in "AB"]
        view = view_of(levels_of(*garments), garments, thickness=0.4 * EDGE)
        (term,) = view.terms(x)
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
