"""Cloth that walks from where it was: what is apart stays apart, whatever its cage does."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from brute import Soup, crossings
from folds import (
    EDGE,
    SHAPES,
    folded,
    frame_with,
    levels_of,
    named,
    near_pairs,
    placed,
    refiner_with,
    square,
    strip,
    view_of,
)
from meshes import grid

from physgraph_usd.solver.collide.pairs import Reach
from physgraph_usd.solver.collide.parts import Parts
from physgraph_usd.solver.level import Level

ipctk = pytest.importorskip("ipctk", reason="the IPC toolkit is not installed; it is in the extra `dev`")
ONE = np.ones((1, 1), bool)


def reach_of(level: Level, within: float) -> Reach:
    """What is near within a distance [m], however near it is at rest."""
    radius = torch.full((level.vertex_count,), 0.5 * within, dtype=torch.float64)
    return Reach(radius, torch.zeros_like(radius), 1e9)


class TestCagesThatPassThroughOneAnother:
    def test_fine_cloth_never_does(self):
        """One sheet sinks through another in the cage, and rises again; turned, so that corners come first."""
        mesh, flat = square(4)
        turn = np.array([[0.8, 0.0, -0.6], [0.0, 1.0, 0.0], [0.6, 0.0, 0.8]])
        sheets = [named((mesh, flat), "A"), named((mesh, flat), "B")]
        solver, level = refiner_with(sheets), levels_of(*sheets)[-1]
        inputs, results = [], []
        for number, height in enumerate([0.03, 0.015, 0.0, -0.015, 0.0, 0.03]):
            tilted = (flat + 0.2 * flat[:, :1] * [0.0, 1.0, 0.0]) @ turn.T
            cages = [flat, tilted + np.array([0.004, height, 0.003])]
            points = solver.solve(frame_with(cages, time=float(number))).points
            for found, x in ((inputs, level.from_coarse @ np.concatenate(cages)), (results, np.concatenate(points))):
                found.append(len(crossings(Soup.of(level, x))))
        assert max(inputs) > 10
        assert results == [0] * len(results)


def test_what_the_upsampled_cage_crosses_is_undone_though_the_cage_crosses_nothing():
    """A quad's two triangles bend along a diagonal; its four quads sag to its centre, onto a strip that is between."""
    mesh, flat = square(1, kind="quads")
    triangles = levels_of(named((mesh, flat)))[0].triangles.numpy()
    ends = np.flatnonzero(np.bincount(triangles.ravel()) == 2)
    quad = flat.copy()
    quad[ends, 1] += 0.01
    length, across = np.linspace(0.2, 0.8, 5), 0.001 * np.cross(flat[ends[1]] - flat[ends[0]], [0.0, 1.0, 0.0])
    middle = flat[ends[0]] + np.outer(length, flat[ends[1]] - flat[ends[0]]) + np.array([0.0, 0.0075, 0.0])
    below, points = grid(4, 1, "triangles")[0], np.concatenate([middle - 0.9 * across, middle + 1.1 * across])
    sheets = [named((mesh, flat), "A"), named((below, points), "B")]
    solver, levels, cages = refiner_with(sheets), levels_of(*sheets), np.concatenate([quad, points])
    assert len(crossings(Soup.of(levels[0], cages))) == 0
    assert len(crossings(Soup.of(levels[-1], levels[-1].from_coarse @ cages))) > 0
    solved = np.concatenate(solver.solve(frame_with([quad, points])).points)
    assert len(crossings(Soup.of(levels[-1], solved))) == 0


class TestNearPairs:
    """Judged by the IPC toolkit, pair by pair."""

    @pytest.mark.parametrize("shape", ["folded", "rolled", "crumpled"])
    def test_all_that_is_near_is_found_and_nothing_else(self, shape: str):
        level, within = levels_of(named(strip(8, 3)))[-1], 0.0213
        x = placed(level, SHAPES[shape])
        found = near_pairs(Parts(level, ONE), x, reach_of(level, within))
        split = np.where(found.face.numpy(), 1, 2)
        listed = [parts_of(four, at) for four, at in zip(found.corners.tolist(), split, strict=True)]
        points, edges, faces = x.double().numpy(), level.edges.tolist(), level.triangles.tolist()
        pairs = [([vertex], face) for vertex in range(len(points)) for face in faces]
        pairs += [(edge, other) for number, edge in enumerate(edges) for other in edges[:number]]
        expected = set()
        for one, other in pairs:
            distance = ipctk.point_triangle_distance if len(one) == 1 else ipctk.edge_edge_distance
            if not {*one} & {*other} and distance(*points[[*one, *other]]) < within**2:
                expected.add(parts_of([*one, *other], len(one)))
        assert len(expected) > 100
        assert len(listed) == len(set(listed))
        assert set(listed) == expected

    def test_of_one_garment_what_is_near_at_rest_is_nearer_than_half_of_that(self):
        """As the force asks: a flat sheet has none, a folded one has those of the fold."""
        level = levels_of(named(strip(8, 3)))[-1]
        parts, rest = Parts(level, ONE), level.rest.double()
        near = replace(reach_of(level, 0.03), play=torch.zeros(level.vertex_count, dtype=torch.float64), half=0.5)
        assert len(near_pairs(parts, level.rest, near).face) == 0
        x = placed(level, folded)
        found, every = near_pairs(parts, x, near), near_pairs(parts, x, reach_of(level, 0.03))
        assert 0 < len(found.face) < len(every.face)
        at_rest = (found.weight.double().unsqueeze(2) * rest[found.corners.long()]).sum(dim=1).norm(dim=1)
        # The closest points at rest are others: they are no farther apart than these.
        assert bool((found.separation.norm(dim=1) < 0.5 * at_rest + 1e-6).all())

    @pytest.mark.parametrize("moved", [0.02, 0.2, 0.9])
    def test_pairs_kept_from_the_last_search_and_new_ones_are_those_of_a_new_search(self, moved: float):
        """A part of the vertices moves a little after a search; with most of them moved, all pairs are searched."""
        garment = named(strip(8, 3))
        levels = levels_of(garment)
        x = placed(levels[-1], SHAPES["crumpled"])
        seeded = torch.Generator().manual_seed(1)
        chosen = torch.rand((len(x), 1), generator=seeded) < moved
        other = x + 0.1 * EDGE * torch.randn(x.shape, generator=seeded).to(x) * chosen

        def springs(*shapes: torch.Tensor) -> list[tuple[int, ...]]:
            view = view_of(levels, [garment], thickness=0.01)
            *_, terms = [view.terms(shape) for shape in shapes]
            return sorted(tuple(row) for term in terms for row in term.gaps.corners.tolist())

        assert len(springs(other)) > 100
        assert springs(x, other) == springs(other) != springs(x)


def parts_of(corners: list[int], split: int) -> frozenset[frozenset[int]]:
    """A pair of parts as sets of their corners."""
    return frozenset((frozenset(corners[:split]), frozenset(corners[split:])))
