"""What was closest before serves again: the same as everything asked anew, or without asking at its closest points."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from brute import on_triangles
from test_cloth_mesh import SCENES, everything, moved, reach, scene, two_sheets


def crosswise(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Whether the closest points of lines through pairs of edges, of shape (N, 2, 3), lie inside both edges."""
    along, other, way = first[:, 1] - first[:, 0], second[:, 1] - second[:, 0], first[:, 0] - second[:, 0]
    system = np.stack([along, -other], axis=2)
    places = np.stack([np.linalg.lstsq(m, -w, rcond=None)[0] for m, w in zip(system, way, strict=True)])
    return np.all((places > 0.0) & (places < 1.0), axis=1)


class TestAskedAgain:
    """What was closest before serves where nothing has moved: the same as everything asked anew, bit for bit."""

    @pytest.mark.parametrize("name", SCENES)
    @pytest.mark.parametrize("part", [0.003, 0.1, 0.5])
    def test_beside_what_moved(self, name: str, part: float):
        level, x = scene(name)
        rng = np.random.default_rng(5)
        near = reach(level) / 4.0
        which = torch.as_tensor(rng.random(len(x)) < part) | (torch.arange(len(x)) == 7)
        there = x + which.unsqueeze(1) * torch.as_tensor(rng.normal(0.0, 0.02, x.shape), dtype=x.dtype)
        mesh = moved(level, x)
        before = mesh.nearest(everything(level), near)
        kept = [each.clone() for each in (before.x, before.face, before.weight, before.edge, before.place)]
        mesh.move(there)
        anew = mesh.nearest(everything(level), near)
        again = mesh.nearest(everything(level), near, known=before, moved=which)
        assert not torch.equal(anew.pairs(level).weight, before.pairs(level).weight)
        assert torch.equal(again.face, anew.face)
        assert torch.equal(again.edge, anew.edge)
        for ours, theirs in zip(vars(again.pairs(level)).values(), vars(anew.pairs(level)).values(), strict=True):
            assert torch.equal(ours, theirs)
        after = (before.x, before.face, before.weight, before.edge, before.place)
        assert all(torch.equal(a, b) for a, b in zip(kept, after, strict=True)), "what was known is not written to"

    def test_what_something_moved_away_from(self):
        level, x = two_sheets()
        other = level.vertex_garment.long() == 1
        mesh = moved(level, x)
        before = mesh.nearest(everything(level), reach(level))
        mesh.move(x + other.unsqueeze(1) * torch.tensor([1.0, 0.0, 0.0], dtype=x.dtype))
        anew = mesh.nearest(everything(level), reach(level))
        again = mesh.nearest(everything(level), reach(level), known=before, moved=other)
        assert bool((before.face != anew.face)[~other].any())
        assert torch.equal(again.face, anew.face)
        assert torch.equal(again.edge, anew.edge)

    def test_only_beside_what_moved(self):
        """A vertex far from what moved keeps its face, also where it has crept a little, and sees its closest point."""
        level, x = scene("folded")
        mesh = moved(level, x)
        near = reach(level) / 4.0
        before = mesh.nearest(everything(level), near)
        one = torch.arange(len(x)) == int((before.face >= 0).any(dim=1).nonzero()[0])
        crept = x + 0.003 * x[:, [1, 2, 0]] * torch.tensor([1.0, 0.0, 0.0])
        mesh.move(crept)
        again = mesh.nearest(everything(level), near, known=before, moved=one)
        asked = (again.x == crept).all(dim=1)
        assert bool(asked[one].all())
        assert 0.0 < float(asked.double().mean()) < 0.8
        assert torch.equal(again.x[~asked], before.x[~asked])
        assert torch.equal(again.face[~asked], before.face[~asked])
        kept = ~asked & (again.face[:, 0] >= 0)
        assert bool(kept.any())
        three = crept[level.triangles.long()[again.face[kept, 0].long()]].double().numpy()
        foot = on_triangles(crept[kept].double().numpy(), *np.moveaxis(three, 1, 0))
        there = (again.weight[0, kept, :, None].double().numpy() * three).sum(axis=1)
        np.testing.assert_allclose(there, foot, atol=2e-6)

    def test_pairs_that_are_kept_see_their_closest_points(self):
        """Edges whose closest points are past an end now are left out, and nothing is asked anew."""
        level, x = two_sheets()
        mesh = moved(level, x)
        before = mesh.nearest(everything(level), reach(level) / 4.0)
        known = before.edge.clone()
        crept = x + 0.003 * torch.as_tensor(np.random.default_rng(2).normal(size=x.shape), dtype=x.dtype)
        mesh.move(crept)
        mesh._clusters = None  # pyright: ignore[reportAttributeAccessIssue]
        after = mesh.slid(before)
        assert torch.equal(after.face, before.face)
        assert torch.equal(before.edge, known), "what was known is not written to"
        vertex = torch.nonzero(after.face[:, 1] >= 0).squeeze(1)
        three = crept[level.triangles.long()[after.face[vertex, 1].long()]].double().numpy()
        there = (after.weight[1, vertex, :, None].double().numpy() * three).sum(axis=1)
        foot = on_triangles(crept[vertex].double().numpy(), *np.moveaxis(three, 1, 0))
        np.testing.assert_allclose(there, foot, atol=2e-6)
        kept, gone = after.edge >= 0, (before.edge >= 0) & (after.edge < 0)
        assert torch.equal(after.edge[kept], before.edge[kept])
        assert 0 < int(gone.sum()) < int(kept.sum())
        for these, inside in ((kept, True), (gone, False)):
            edge, side = torch.nonzero(these, as_tuple=True)
            ends = [crept[level.edges[each].long()].double().numpy() for each in (edge, before.edge[edge, side].long())]
            assert (crosswise(*ends) == inside).mean() > 0.99
