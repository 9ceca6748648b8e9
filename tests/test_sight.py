"""What vertices see of a body: one plane each, kept while the vertex stays."""

from __future__ import annotations

import pytest
import torch

from physgraph_usd.solver.contact.sight import Sight

OFFSET = 0.002


def seen_after(*sights: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Sight:
    """What one vertex sees after it saw planes of given normals through given closest points [m], 1 mm behind each."""
    sight = Sight.none(torch.zeros(1, 3))
    for normal, foot in sights:
        n, c = (torch.tensor([each]) for each in (normal, foot))
        sight = sight.renewed(
            c - 1e-3 * n,
            torch.tensor([False]),
            vertex=torch.tensor([0]),
            normal=n,
            signed=torch.tensor([-1e-3]),
            offset=torch.tensor([OFFSET]),
        )
    return sight


def test_the_plane_seen_last_is_all():
    sight = seen_after(((1.0, 0.0, 0.0), (0.0, 0.01, 0.0)), ((0.0, 1.0, 0.0), (0.005, 0.01, 0.0)))
    planes = sight.planes()
    assert planes.vertex.tolist() == [0]
    assert planes.normal.tolist() == [[0.0, 1.0, 0.0]]
    assert float(planes.height) == pytest.approx(0.01 + OFFSET)


def test_what_is_still_sees_what_it_saw():
    sight = seen_after(((0.0, 1.0, 0.0), (0.005, 0.0, 0.0)))
    nothing = torch.zeros(0)
    after = sight.renewed(
        torch.ones(1, 3),
        torch.tensor([True]),
        vertex=nothing.long(),
        normal=torch.zeros(0, 3),
        signed=nothing,
        offset=nothing,
    )
    assert torch.equal(after.at, sight.at)
    assert bool(after.there)
    assert torch.equal(after.normal, sight.normal)
    assert torch.equal(after.height, sight.height)


def test_what_moved_and_is_near_nothing_sees_nothing():
    sight = seen_after(((0.0, 1.0, 0.0), (0.005, 0.0, 0.0)))
    nothing = torch.zeros(0)
    after = sight.renewed(
        torch.ones(1, 3),
        torch.tensor([False]),
        vertex=nothing.long(),
        normal=torch.zeros(0, 3),
        signed=nothing,
        offset=nothing,
    )
    assert not bool(after.there)
    assert len(after.planes().vertex) == 0
