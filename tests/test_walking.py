"""Cloth that walks from where it was: what is apart stays apart, whatever its cage does."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from brute import Soup, crossings, on_triangles
from folds import SHAPES, crumpled, folded, frame_with, levels_of, named, placed, refiner_with, square, strip

from physgraph_usd.collide.near import near_pairs
from physgraph_usd.collide.parts import Parts
from physgraph_usd.contact.settings import ContactSettings

WALKING = ContactSettings(promise=True)


class TestCagesThatPassThroughOneAnother:
    def test_fine_cloth_never_does(self):
        """One sheet sinks through another in the cage, and rises again; turned, so that corners come first."""
        mesh, flat = square(4)
        turn = np.array([[0.8, 0.0, -0.6], [0.0, 1.0, 0.0], [0.6, 0.0, 0.8]])
        sheets = [named((mesh, flat), "A"), named((mesh, flat), "B")]
        solver, level = refiner_with(sheets, contact=WALKING), levels_of(*sheets)[-1]
        inputs, results = [], []
        for number, height in enumerate([0.03, 0.015, 0.0, -0.015, 0.0, 0.03]):
            tilted = (flat + 0.2 * flat[:, :1] * [0.0, 1.0, 0.0]) @ turn.T
            cages = [flat, tilted + np.array([0.004, height, 0.003])]
            points = solver.solve(frame_with(cages, time=float(number))).points
            for found, x in ((inputs, level.from_coarse @ np.concatenate(cages)), (results, np.concatenate(points))):
                found.append(len(crossings(Soup.of(level, x))))
        assert max(inputs) > 10
        assert results == [0] * len(results)


class TestNearPairs:
    @pytest.mark.parametrize("shape", ["folded", "rolled", "crumpled"])
    def test_every_vertex_and_face_that_is_near_is_found_and_no_other(self, shape: str):
        level = levels_of(named(strip(8, 3)))[-1]
        x, within = placed(level, SHAPES[shape]), 0.025
        found = near_pairs(Parts(level, np.ones((1, 1), bool)), x, within)
        corners = found.corners[found.face].long().numpy()
        listed = {(int(v), *sorted(map(int, t))) for v, *t in corners}
        points, faces = x.double().numpy(), level.triangles.long().numpy()
        expected = set()
        for vertex in range(len(points)):
            apart = ~(faces == vertex).any(axis=1)
            a, b, c = (points[faces[apart][:, i]] for i in range(3))
            p = np.broadcast_to(points[vertex], a.shape)
            near = np.linalg.norm(p - on_triangles(p, a, b, c), axis=1) < within
            expected |= {(vertex, *sorted(map(int, t))) for t in faces[apart][near]}
        assert len(expected) > 20
        assert listed == expected

    def test_ways_are_as_long_as_parts_are_apart(self):
        level = levels_of(named(strip(8, 3)))[-1]
        x = placed(level, folded)
        found = near_pairs(Parts(level, np.ones((1, 1), bool)), x, 0.012)
        way = (found.weight.unsqueeze(2) * x[found.corners.long()]).sum(dim=1)
        torch.testing.assert_close(way, found.way)
        assert float(found.way.norm(dim=1).max()) < 0.012
        assert float(found.weight.sum(dim=1).abs().max()) < 1e-6

    def test_exempt_vertices_are_in_none(self):
        level = levels_of(named(strip(8, 3)))[-1]
        x = placed(level, crumpled)
        exempt = torch.rand(len(x), generator=torch.Generator().manual_seed(0)) < 0.3
        found = near_pairs(Parts(level, np.ones((1, 1), bool)), x, 0.012, exempt=exempt)
        assert len(found.face)
        assert not bool(exempt[found.corners.long()].any())
