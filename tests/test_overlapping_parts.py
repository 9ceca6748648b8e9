"""Parts of one body that overlap: what cloth between them sees, where it stays, and that it then lies still."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from bodies import ball, box, surfaces, together
from folds import levels_of, named, square

from physgraph_usd.solver.colliders.mesh import MeshBody, MeshSurface
from physgraph_usd.solver.colliders.pose import MeshPose
from physgraph_usd.solver.contact.bodies import FrameBodies, LevelBodies, Touching
from physgraph_usd.solver.contact.measure import depths, pinched
from physgraph_usd.solver.contact.push_out import pushed_out
from physgraph_usd.solver.contact.settings import ContactSettings
from physgraph_usd.solver.level import Level
from physgraph_usd.solver.mesh.topology import patches_with

SHEET = named(square(12))
SETTINGS = ContactSettings(stiffness=1.0, cloth_stiffness=1e5)
OVER, UNDER = (ball(0.15, at=(0.0, side * 0.13, 0.0), level=4) for side in (1.0, -1.0))
"""Balls that overlap by 4 cm, in a lens of 7.5 cm about the middle of the sheet's plane."""


def bodies_of(levels: tuple[Level, ...], cage: torch.Tensor, *soups: Any) -> FrameBodies:
    """A frame's bodies, meshes all."""
    posed = [MeshBody(device="cpu", threads=1).pose(MeshPose(*soup))[0] for soup in soups]
    touching = [Touching(f"/Body{index}", each, (0.002,)) for index, each in enumerate(posed)]
    return FrameBodies.begin(levels, touching, cage, origin=np.zeros(3), settings=SETTINGS)


def lens_of(level: Level, *, wider: float = 0.0) -> torch.Tensor:
    """Which vertices of the flat sheet are in both balls, or near them [m]."""
    return level.rest[:, [0, 2]].norm(dim=1) < np.sqrt(0.15**2 - 0.13**2) + wider


class TestParts:
    def test_points_are_inside_as_many_parts_as_overlap_there(self):
        """Two balls of 10 cm whose centres are 14 cm apart: 6 cm of either lie in the other."""
        surface = surfaces(together(ball(0.1, at=(-0.07, 0.0, 0.0)), ball(0.1, at=(0.07, 0.0, 0.0))))[0]
        x = torch.tensor([[0.0, 0.0, 0.0], [0.02, 0.03, 0.0], [0.08, 0.0, 0.0], [-0.08, 0.0, 0.0], [0.0, 0.09, 0.0]])
        x = x - torch.as_tensor(surface.origin).to(x)
        assert surface.inside(x).tolist() == [True, True, True, True, False]
        assert surface.inside(x, parts=2).tolist() == [True, True, False, False, False]

    def test_cloth_between_them_is_not_sent_through_one_of_them(self):
        """A point in one part alone, 5 cm from its bare side: it comes out there, unless its cloth was between them.

        However short that way then is: its neighbours may be held on the other side.
        """
        surface = surfaces(together(ball(0.1, at=(-0.07, 0.0, 0.0)), ball(0.1, at=(0.07, 0.0, 0.0))))[0]
        x = torch.tensor([[0.12, 0.0, 0.0]]) - torch.as_tensor(surface.origin).to(torch.float32)
        found = surface.closest(x, torch.full((1,), torch.inf))
        way = surface.exit(x, found)
        lost = torch.ones(1, dtype=torch.bool)
        assert not bool(pinched(surface, x, found, way, longest=0.02))
        assert bool(pinched(surface, x, found, way, longest=0.02, lost=lost))
        assert bool(pinched(surface, x, found, way, longest=0.06, lost=lost))
        # The report counts it as the solve leaves it.
        assert [bool(depths(surface, x, -found.distance, 0.02, lost=each)[1]) for each in (None, lost)] == [False, True]

    @pytest.mark.parametrize("along", [0.5, -0.5])
    def test_a_face_that_a_part_comes_through_is_no_way_out_there(self, along: float):
        """A ball of 5 cm in the middle of a slab's top, whose corners lie bare: beside it one leaves through the top.

        Half a millimetre under the top or over it, in the ball, one would only change sides.
        """
        surface = surfaces(together(box((1.0, 0.2, 1.0)), ball(0.05, at=(0.02, 0.1, 0.01))))[0]
        x = torch.tensor([[0.02, 0.1 - 1e-3 * along, 0.01], [0.3, 0.1 - 5e-4, 0.01]])
        x = x - torch.as_tensor(surface.origin).to(x)
        way = surface.exit(x, surface.closest(x, torch.full((2,), torch.inf)))
        assert not bool(surface.inside(way.point + 1e-3 * way.normal).any())
        assert 0.03 < float(way.distance[0]) < 0.06
        assert float(way.distance[1]) == pytest.approx(5e-4, rel=1e-3)


class TestPatches:
    def test_those_with_a_seed_are_kept_whole(self):
        """A row of ten: 0 to 3, 5 to 6 and 8 to 9 hang together; seeds in the first, beside the second, and outside."""
        edges = np.stack([np.arange(9), np.arange(1, 10)], axis=1)
        some = np.isin(np.arange(10), [0, 1, 2, 3, 5, 6, 8, 9])
        assert np.flatnonzero(patches_with(edges, some, np.isin(np.arange(10), [2, 4, 7]))).tolist() == [0, 1, 2, 3]
        assert not patches_with(edges, some, np.zeros(10, bool)).any()


class TestLost:
    """Which cloth no body sends out, and that it does not."""

    @staticmethod
    def view(*soups: Any, height: float = 0.0) -> tuple[Level, LevelBodies, torch.Tensor]:
        """The finest level of a flat sheet [m], and what it sees of bodies."""
        levels = levels_of(SHEET)
        cage = torch.as_tensor(SHEET.rest, dtype=torch.float32) + torch.tensor([0.0, height, 0.0])
        view, x = bodies_of(levels, cage, *soups).at(levels[-1], levels[-1]), levels[-1].base.apply(cage)
        return levels[-1], view.losing(x), x

    def test_cloth_right_through_an_overlap_is_lost_there(self):
        level, view, x = self.view(together(OVER, UNDER))
        lost = view.tracks[0].lost
        assert lost is not None
        assert int(lens_of(level).sum()) > 9
        assert bool(lost[lens_of(level, wider=-0.01)].all())
        assert not bool(lost[~lens_of(level, wider=0.01)].any())
        out = pushed_out(view, x)[1]
        assert torch.equal(out[lost], x[lost])

    def test_closest_points_of_the_upsampled_cage_are_not_asked_for_twice(self, monkeypatch: pytest.MonkeyPatch):
        """Those of cloth that has moved since are; what is lost is then what is in the lens where it is now."""
        asked: list[int] = []
        level, view, x = self.view(together(OVER, UNDER))
        closest = MeshSurface.closest
        monkeypatch.setattr(MeshSurface, "closest", lambda *args: asked.append(len(args[1])) or closest(*args))
        known = view.tracks[0].lost
        view = view.losing(x)
        assert not asked
        again = replace(view, tracks=(replace(view.tracks[0], inside=None),)).losing(x).tracks[0].lost
        assert asked
        assert known is not None
        assert again is not None
        assert torch.equal(again, known)
        level, view, x = self.view(together(OVER, UNDER))
        asked.clear()
        view = view.losing(x + torch.tensor([0.02, 0.0, 0.0]))
        assert asked
        lost, away = view.tracks[0].lost, (level.rest[:, [0, 2]] + torch.tensor([0.02, 0.0])).norm(dim=1)
        lens = np.sqrt(0.15**2 - 0.13**2)
        assert lost is not None
        assert bool(lost[away < lens - 0.01].all())
        assert not bool(lost[away > lens + 0.01].any())

    def test_two_bodies_that_overlap_lose_none(self):
        """Each has bare faces all over: cloth between them is pushed to the middle."""
        assert [track.lost for track in self.view(OVER, UNDER)[1].tracks] == [None, None]

    def test_nor_does_a_body_whose_parts_only_graze_it(self):
        """In one part, whose face over it the other buries, but nowhere in both: it is pushed out."""
        _, view, x = self.view(together(OVER, UNDER), height=0.03)
        assert [track.lost for track in view.tracks] == [None]
        out = pushed_out(view, x)[1]
        assert not torch.equal(out, x)

    def test_one_body_does_not_keep_what_another_pushes(self):
        """A third one, a small ball in the lens: what the first lost lies outside that."""
        level, view, x = self.view(together(OVER, UNDER), ball(0.03, at=(0.0, -0.005, 0.0), level=4))
        assert view.tracks[0].lost is not None
        assert view.tracks[1].lost is None
        out = pushed_out(view, x)[1]
        inner = level.rest[:, [0, 2]].norm(dim=1) < 0.02
        assert float((out[inner] - torch.tensor([0.0, -0.005, 0.0])).norm(dim=1).min()) > 0.0299
