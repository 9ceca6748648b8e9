"""Sharp folds, where parts one edge apart can pass through one another and so are pairs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from folds import EDGE, crumpled, curved, flat, folded, levels_of, named, placed, strip, view_of

from physgraph_usd.contact.cloth_mesh import ClothMesh
from physgraph_usd.contact.nearest import Pairs
from physgraph_usd.forces.self_contact import SelfContact

CLOTH = named(strip(8, 4))
ALL = np.ones((1, 1), bool)


def creased(points: np.ndarray) -> np.ndarray:
    """Laid back over itself within less than an edge of the finer level."""
    return folded(points, gap=0.1 * EDGE)


def rings_apart(mesh: ClothMesh, pairs: Pairs) -> set[int]:
    """How many edges apart the nearest corners of the two parts of each pair are: 0, 1, or 2 for more."""
    out, beside = set(), mesh.beside.toarray() > 0
    for corners, is_face in zip(pairs.corners.tolist(), pairs.face.tolist(), strict=True):
        one, other = (corners[:1], corners[1:]) if is_face else (corners[:2], corners[2:])
        near = [0 if a == b else 1 if beside[a, b] else 2 for a in one for b in other]
        out.add(min(near))
    return out


def near_at(mesh: ClothMesh, x: torch.Tensor, *, folds: bool) -> Pairs:
    """All pairs within an edge."""
    everything = torch.ones(len(x), dtype=torch.bool)
    mesh.move(x)
    return mesh.nearest(everything, torch.full((len(x),), EDGE), folds=folds).pairs(mesh.level)


class TestQueries:
    @pytest.fixture
    def mesh(self) -> ClothMesh:
        return ClothMesh(levels_of(CLOTH)[-1], ALL)

    def test_in_a_sharp_fold_parts_one_edge_apart_are_near(self, mesh: ClothMesh):
        x = placed(mesh.level, creased)
        assert rings_apart(mesh, near_at(mesh, x, folds=False)) == {2}
        assert rings_apart(mesh, near_at(mesh, x, folds=True)) == {1, 2}

    @pytest.mark.parametrize("shape", [flat, curved])
    def test_elsewhere_they_are_not(self, mesh: ClothMesh, shape: Callable[[np.ndarray], np.ndarray]):
        x = placed(mesh.level, shape)
        assert len(near_at(mesh, x, folds=True).corners) == 0

    def test_what_is_sewn_together_is_no_pair(self, mesh: ClothMesh):
        """Two vertices that lie on one another are one: what has either as a corner has both."""
        x = placed(mesh.level, creased)
        before = near_at(mesh, x, folds=True)
        one_apart = [
            (c[0], c[k])
            for c, face in zip(before.corners.tolist(), before.face.tolist(), strict=True)
            if face
            for k in (1, 2, 3)
            if mesh.beside[c[0], c[k]] == 0
        ]
        a, b = one_apart[0]
        mesh.sew(np.array([[a, b]]))
        after = near_at(mesh, x, folds=True)
        both = zip(after.corners.tolist(), after.face.tolist(), strict=True)
        parts = [({*c[:1]}, {*c[1:]}) if face else ({*c[:2]}, {*c[2:]}) for c, face in both]
        assert not any((a in p and b in q) or (b in p and a in q) for p, q in parts)


class TestViews:
    """What a frame's view makes pairs of, for an input that is flat or passes through itself."""

    def pushed(self, level: int, base: Callable[[np.ndarray], np.ndarray], *, wanted: bool = True) -> set[int]:
        """Edges between the parts that push one another in the fold."""
        levels = levels_of(CLOTH, level=level)
        finest = levels[-1]
        view = view_of(levels, [CLOTH], placed(finest, base), thickness=0.2 * EDGE)
        view.look_in_folds(wanted)
        term = view.term(placed(finest, creased))
        assert isinstance(term, SelfContact)
        beside, out = ClothMesh(finest, ALL).beside.toarray() > 0, set()
        for corners, weights in zip(term.gaps.corners.tolist(), term.gaps.weight.tolist(), strict=True):
            of = [[c for c, w in zip(corners, weights, strict=True) if side * w > 1e-6] for side in (1.0, -1.0)]
            out.add(min(1 if beside[a, b] else 2 for a in of[0] for b in of[1]))
        return out

    def test_parts_one_edge_apart_push_one_another_at_fine_levels(self):
        assert self.pushed(1, flat) == {1, 2}

    def test_not_where_nobody_asked_for_them(self):
        assert 1 not in self.pushed(1, flat, wanted=False)

    def test_not_at_the_cage_whose_folds_are_the_inputs(self):
        assert 1 not in self.pushed(0, flat)

    def test_not_where_the_input_crosses(self):
        levels = levels_of(CLOTH)
        base = view_of(levels, [CLOTH], placed(levels[-1], crumpled)).before
        assert base.crossings.count > 0
        assert 1 not in self.pushed(1, crumpled)
