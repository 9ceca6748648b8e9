"""What vertices see of a body: one plane on it, both sides of a crease in it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from bodies import Soup
from folds import levels_of, named, square

from physgraph_usd.solver.colliders.mesh import MeshBody
from physgraph_usd.solver.colliders.pose import MeshPose
from physgraph_usd.solver.contact.bodies import FrameBodies, LevelBodies, Touching
from physgraph_usd.solver.contact.settings import ContactSettings
from physgraph_usd.solver.contact.sight import Sight
from physgraph_usd.solver.level import Level

OFFSET = 0.002
WALL = ((1.0, 0.0, 0.0), (0.0, 0.01, 0.0))
"""Normal and closest point of what is seen first: the wall x = 0."""


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
            hollow=torch.tensor([1e-3]),
        )
    return sight


class TestCreases:
    def test_the_side_that_was_seen_before_stays(self):
        sight = seen_after(WALL, ((0.0, 1.0, 0.0), (0.005, 0.0, 0.0)))
        assert sight.closest.normal.tolist() == [[0.0, 1.0, 0.0]]
        assert bool(sight.crease.there)
        planes = sight.crease.planes()
        assert planes.normal.tolist() == [[1.0, 0.0, 0.0]]
        assert float(planes.height) == pytest.approx(OFFSET)

    def test_so_it_does_as_long_as_that_one_is_seen(self):
        """From the wall to the floor, farther along it, and then to a ramp hardly turned from it."""
        floor = [((0.0, 1.0, 0.0), (along, 0.0, 0.0)) for along in (0.005, 0.006)]
        sight = seen_after(WALL, *floor, ((-0.3, 0.954, 0.0), (0.007, 0.0, 0.0)))
        assert bool(sight.crease.there)
        assert sight.crease.normal.tolist() == [[1.0, 0.0, 0.0]]

    @pytest.mark.parametrize(
        ("normal", "foot"),
        [
            ((0.0, 1.0, 0.0), (-0.005, 0.0, 0.0)),  # Round an edge: the closest point lies behind the wall.
            ((0.0, 1.0, 0.0), (5e-4, 0.0, 0.0)),  # In front by less than is asked for.
            ((0.8, 0.6, 0.0), (0.005, 0.0, 0.0)),  # Hardly turned: the same side, bent.
            ((-0.8, 0.6, 0.0), (0.005, 0.0, 0.0)),  # A wall that faces the first: no room for both.
        ],
    )
    def test_elsewhere_the_closest_plane_is_all(self, normal: tuple[float, ...], foot: tuple[float, ...]):
        sight = seen_after(WALL, (normal, foot))  # type: ignore[arg-type]
        assert bool(sight.closest.there)
        assert not bool(sight.crease.there)

    def test_there_are_none_where_parts_overlap(self):
        sight = seen_after(WALL)
        n, c = torch.tensor([[0.0, 1.0, 0.0]]), torch.tensor([[0.005, 0.0, 0.0]])
        none, one = torch.zeros(1), torch.tensor([0])
        after = sight.renewed(c, torch.tensor([False]), vertex=one, normal=n, signed=none, offset=none, hollow=None)
        assert not bool(after.crease.there)

    def test_what_is_still_sees_what_it_saw(self):
        sight = seen_after(WALL, ((0.0, 1.0, 0.0), (0.005, 0.0, 0.0)))
        nothing = torch.zeros(0)
        after = sight.renewed(
            torch.ones(1, 3),
            torch.tensor([True]),
            vertex=nothing.long(),
            normal=torch.zeros(0, 3),
            signed=nothing,
            offset=nothing,
            hollow=torch.zeros(1),
        )
        assert torch.equal(after.at, sight.at)
        for ours, theirs in ((after.closest, sight.closest), (after.crease, sight.crease)):
            assert bool(ours.there)
            assert torch.equal(ours.normal, theirs.normal)


def trough() -> Soup:
    """A closed body with a right-angled trough along z, walls x = 0 and y = 0 where x and y are positive."""
    profile = np.array([[0.0, 0.0], [0.0, 0.3], [-0.3, 0.3], [-0.3, -0.3], [0.3, -0.3], [0.3, 0.0]])
    front, back = (np.column_stack([profile, np.full(6, z)]) for z in (0.3, -0.3))
    cap = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    sides = [[[i, (i + 1) % 6, 6 + i], [(i + 1) % 6, 6 + (i + 1) % 6, 6 + i]] for i in range(6)]
    faces = np.concatenate([cap, cap[:, ::-1] + 6, np.array(sides).reshape(-1, 3)[:, ::-1]])
    return np.concatenate([front, back]), faces.astype(np.int32)


def view_of(soup: Soup) -> tuple[Level, LevelBodies]:
    """The finest level of a small sheet, and what it sees of a body."""
    levels = levels_of(named(square(6)))
    surface = MeshBody(device="cpu", threads=1).pose(MeshPose(*soup))[0]
    cage = levels[0].rest
    touching = [Touching("/Trough", surface, (OFFSET,))]
    bodies = FrameBodies.begin(levels, touching, cage, origin=np.zeros(3), settings=ContactSettings(stiffness=1.0))
    return levels[1], bodies.at(levels[1], levels[1])


def test_in_a_trough_cloth_feels_both_walls():
    """Vertices near one wall move to where the other is nearer: both push, where one alone would be left through."""
    level, view = view_of(trough())
    x = torch.tensor([0.0015, 0.012, 0.0]).repeat(level.vertex_count, 1)
    view, first = view.seen(x)
    assert first is not None
    assert [each.normal.round().tolist()[0] for each in first.planes] == [[1.0, 0.0, 0.0]]
    _, second = view.seen(x + torch.tensor([0.0, -0.0115, 0.0]))
    assert second is not None
    assert [each.normal.round().tolist()[0] for each in second.planes] == [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    assert [len(each.vertex) for each in second.planes] == [level.vertex_count] * 2
    pushed = torch.zeros_like(x)
    second.add_force(x + torch.tensor([0.0, -0.0115, 0.0]), pushed)
    assert bool((pushed[:, :2] > 0).all())
