"""Which parts of cloth push one another, on which side, and which do not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from energies import evaluate
from folds import EDGE, curved, flat, levels_of, named, placed, square, strip, view_of
from test_tangles import pair

from physgraph_usd.solver.contact.cloth import ClothView
from physgraph_usd.solver.forces.self_contact import PairConstraints, SelfContact

QUIET: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "flat": flat,
    "curved": curved,
    "half a turn": lambda points: curved(points, np.pi),
    "rippled": lambda points: points + np.outer(0.004 * np.sin(40 * points[:, 0]), [0.0, 1.0, 0.0]),
}


class TestOneSheet:
    @pytest.mark.parametrize("name", QUIET)
    def test_what_is_bent_little_pushes_nothing(self, name: str):
        garment = named(strip(12, 4))
        levels = levels_of(garment, level=1)
        x = placed(levels[-1], QUIET[name])
        terms = view_of(levels, [garment]).terms(x)
        assert not any(bool(evaluate(term, x)[1].abs().max() > 0.0) for term in terms)


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
