"""Moves of cloth: nothing newly crosses, whatever is wanted, and what moves together goes together."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from bodies import BodyMesh, ball
from brute import Soup, crossings
from folds import EDGE, SHAPES, curved, folded, levels_of, named, placed, square, strip, view_of
from scenes import shot

from physgraph_usd.solver.collide.pairs import Pairs
from physgraph_usd.solver.contact.along import ApproachLimits, along
from physgraph_usd.solver.contact.cloth import LevelContact
from physgraph_usd.solver.forces.self_contact import PairConstraints, SelfContact
from physgraph_usd.solver.level import Level, Placed
from physgraph_usd.solver.scene import GIVEN_UP

SIZE = 20
LIFT = 0.3 * EDGE


def pair(upper: str) -> tuple[Level, torch.Tensor]:
    """A level sheet and a smaller one that passes through it, in float64; the second is the one that is bent."""
    cloths = square(4), square(4)
    level = levels_of(named(cloths[0], "A"), named(cloths[1], "B"), dtype=torch.float64)[-1]
    x = level.rest.clone()
    half = len(x) // 2
    points = 0.9 * x[half:].numpy() + np.array([0.0037, 0.0, 0.0051])
    x[half:] = torch.as_tensor(UPPER[upper](points))
    return level, x


def dented(points: np.ndarray) -> np.ndarray:
    """Above the other but for a dent in the middle."""
    radius = np.linalg.norm(points[:, [0, 2]], axis=1)
    return points + np.outer(LIFT - 2.2 * LIFT * np.exp(-((radius / 0.04) ** 2)), [0.0, 1.0, 0.0])


def cornered(points: np.ndarray) -> np.ndarray:
    """Above the other but for a corner."""
    down = 0.5 * (points[:, 0] + points[:, 2] - 0.08)
    return points + np.outer(LIFT - down.clip(0.0) * 1.5, [0.0, 1.0, 0.0])


def tilted(points: np.ndarray) -> np.ndarray:
    """Through the other from rim to rim, a little off its middle."""
    return points + np.outer(0.6 * points[:, 0] + 0.2 * points[:, 2] + 0.2 * LIFT, [0.0, 1.0, 0.0])


def shifted(points: np.ndarray) -> np.ndarray:
    """A flat sheet on its edge, passed through by the rim of the other."""
    return points[:, [1, 0, 2]] + np.array([0.081, 0.013, 0.02])


UPPER = {"dented": dented, "cornered": cornered, "tilted": tilted, "on edge": shifted}


def crossed_strip(name: str) -> tuple[Level, LevelContact, torch.Tensor]:
    """A strip pinned at one end in a shape, and what moves it."""
    cloth = strip(8, 3)
    garment = named(cloth, pin=(cloth[1][:, 0] < 0.01) * 1.0)
    levels = levels_of(garment)
    shapes = {"flat": lambda p: p, "curved": curved, "folded": folded, **SHAPES}
    return levels[-1], view_of(levels, [garment]), placed(levels[-1], shapes[name])


class TestMoves:
    """Whatever is wanted, no more crosses after a move than before, and nothing where nothing did."""

    @pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3))])
    @pytest.mark.parametrize("size", [0.3, 1.0, 3.0])
    @pytest.mark.parametrize("name", ["flat", "folded", "rolled", "crumpled", "rolled through itself"])
    def test_never_more_crossings_than_before(self, name: str, size: float, seed: int):
        level, view, base = crossed_strip(name)
        noise = torch.randn(base.shape, generator=torch.Generator().manual_seed(seed))
        x = view.moved(Placed(base), base + size * 0.3 * EDGE * noise * level.free)
        before, after = (len(crossings(Soup.of(level, at))) for at in (base, x))
        assert view.look(x).crossings.count == after
        assert after <= before
        assert (before > 0) == (name in ("crumpled", "rolled through itself"))
        assert torch.equal(x[~level.free[:, 0]], base[~level.free[:, 0]])

    @pytest.mark.parametrize("name", UPPER)
    @pytest.mark.parametrize("size", [0.1, 0.5, 2.0])
    def test_nor_of_two_sheets(self, name: str, size: float):
        garments = [named(square(4), each) for each in "AB"]
        levels, (level, base) = levels_of(*garments, dtype=torch.float64), pair(name)
        noise = torch.as_tensor(np.random.default_rng(4).normal(size=(len(base), 3)))
        x = view_of(levels, garments).moved(Placed(base), base + size * EDGE * noise)
        assert 0 <= len(crossings(Soup.of(level, x))) <= len(crossings(Soup.of(level, base)))

    def test_only_what_is_near_what_would_cross_is_held_back(self):
        """A smooth wave that pushes the upper half of a fold through the lower one in one corner."""
        level, view, base = crossed_strip("folded")
        upper = (base[:, 1] > 0.009) & (base[:, 2] > 0.03)
        wanted = base.clone()
        wanted[upper, 1] -= 0.014
        assert len(crossings(Soup.of(level, wanted))) > 0
        x = view.moved(Placed(base), wanted)
        assert len(crossings(Soup.of(level, x))) == 0
        moved = (x - wanted).norm(dim=1) > 1e-7
        assert 0 < int(moved.sum()) < 0.6 * level.vertex_count

    def test_crossings_may_wander(self):
        """Two sheets that cross along a line, one of which rises a little: what crosses, crosses elsewhere."""
        garments = [named(square(4), name) for name in "AB"]
        levels = levels_of(*garments)
        base = levels[-1].rest.clone()
        half = len(base) // 2
        base[half:] += 0.1 * EDGE * torch.rand_like(base[half:])
        base[half:, 1] += 0.5 * base[half:, 0]
        x, view = base.clone(), view_of(levels, garments)
        x[half:, 1] += 0.001
        assert 0 < view.look(x).crossings.count <= view.look(base).crossings.count
        assert view.moved(Placed(base), x) is x

    def test_one_tangle_that_would_cross_more_holds_up_no_other(self):
        """Of two pairs of sheets one is pushed deeper, the other drawn out."""
        garments = [named(square(4), name) for name in "ABCD"]
        levels = levels_of(*garments, dtype=torch.float64)
        base = pair("cornered")[1]
        base = torch.cat([base, base + torch.tensor([1.0, 0.0, 0.0], dtype=base.dtype)])
        number, wanted = levels[-1].vertex_garment, base.clone()
        wanted[number == 1, 1] -= 0.004
        wanted[number == 3, 1] += 0.012
        view = view_of(levels, garments)
        x = view.moved(Placed(base), wanted)
        before, asked, after = (view.mesh.between(view.look(at).crossings) for at in (base, wanted, x))
        assert asked[0, 1] > before[0, 1] > 0
        assert after[0, 1] <= before[0, 1]
        assert after[2, 3] == asked[2, 3] < before[2, 3]
        assert torch.equal(x[number >= 2], wanted[number >= 2])


class TestGivenUp:
    """Pieces of cloth that are mostly tangled after all rounds at the cage of a cold frame are given up."""

    @staticmethod
    def shot_of(*shapes: str, bodies: Sequence[BodyMesh] = ()):
        """Two large sheets that in each frame cross everywhere, along one contour, or not at all."""
        garments = [named(square(SIZE), each) for each in "AB"]
        rest = np.asarray(garments[0].rest)
        noise = np.random.default_rng(3).normal(size=len(rest))
        cages = []
        for time, shape in enumerate(shapes):
            upper, lower = rest + 0.3 * EDGE * np.array([1.0, 0.0, 0.7]), rest.copy()
            lower[:, 1] += (2.0 + 0.01 * time) * EDGE * noise if shape == "full" else 0.0
            upper[:, 1] += {"full": 0.0, "contour": 0.5 * rest[:, 0] + 0.1 * EDGE, "apart": 0.5 * EDGE}[shape]
            cages.append([lower, upper])
        return shot(garments, cages, bodies)

    def solved(self, *shapes: str) -> list[int]:
        """Crossings given up in each frame."""
        shown = self.shot_of(*shapes)
        solver = shown.refiner(level=1, steps=2)
        told = [solver.solve(frame).telemetry[0] for frame in shown.frames]
        return [each["contact"]["cloth"]["after"]["given_up"] if "contact" in each else 0 for each in told]

    def test_waves_that_cross_everywhere_are_given_up_until_their_cages_are_apart(self):
        first, second, last = self.solved("full", "full", "apart")
        assert min(first, second) > SIZE**2
        assert last == 0

    def test_cloth_that_is_all_given_up_follows_its_subdivided_cage_and_is_not_solved(self):
        shown = self.shot_of("full", "full")
        answer, later = shown.refiner(level=1, steps=2).refine(shown.frames)
        assert [each.telemetry[0]["start"] for each in (answer, later)] == [GIVEN_UP, GIVEN_UP]
        assert later.telemetry[0]["levels"] == []
        assert {report["level"] for report in answer.telemetry[0]["levels"]} == {0}
        smooth = levels_of(*(named(square(SIZE), name) for name in "AB"))[-1].smooth_from_coarse
        cages = np.concatenate([each.points for each in shown.frames[0].garments])
        np.testing.assert_allclose(np.concatenate(answer.points), smooth @ cages, atol=1e-6)

    def test_its_crossings_with_bodies_count_in_the_subdivided_cage_too(self):
        shown = self.shot_of("full", "full", bodies=[ball(0.1, at=(0.0, 0.09, 0.0))] * 2)
        for answer in shown.refiner(level=1, steps=2).refine(shown.frames):
            (body,) = answer.telemetry[0]["contact"]["bodies"].values()
            assert answer.telemetry[0]["start"] == GIVEN_UP
            assert body["after"]["crossings"] <= body["before"]["crossings"] > 0

    def test_its_energy_above_the_upsampled_cage_is_no_reason_to_solve_it(self):
        """Sheets that rest as their cages lie: the smooth shape is strained, the upsampled one is not."""
        shown = self.shot_of("full", "full")
        pairs = zip(shown.scene.garments, shown.frames[0].garments, strict=True)
        resting = [replace(garment, rest=frame.points) for garment, frame in pairs]
        cages = [[garment.points for garment in frame.garments] for frame in shown.frames]
        answers = shot(resting, cages).refiner(level=1, steps=2).refine(shown.frames)
        told = [answer.telemetry[0] for answer in answers]
        energies = [sum(told[1]["energy_joules"][side].values()) for side in ("input", "output")]
        assert energies[1] > energies[0]
        assert [frame["start"] for frame in told] == [GIVEN_UP, GIVEN_UP]

    def test_one_contour_is_not(self):
        assert self.solved("contour") == [0]

    def test_what_the_last_frame_solved_is_not_given_up(self):
        assert self.solved("apart", "full") == [0, 0]


class TestSides:
    """On which side of one another the parts of two sheets that cross are kept."""

    def gaps(self, x: torch.Tensor) -> tuple[LevelContact, PairConstraints]:
        garments = [named(square(4), name) for name in "AB"]
        view = view_of(levels_of(*garments), garments, thickness=0.4 * EDGE)
        (term,) = view.terms(x)
        assert isinstance(term, SelfContact)
        return view, term.gaps

    def test_what_crosses_has_no_side_to_keep(self):
        """It is drawn out instead, by two planes for each edge and face; what is beside it keeps its side."""
        x = pair("cornered")[1].float()
        view, gaps = self.gaps(x)
        found = view.look(x).crossings
        out = 2 * found.count
        assert 0 < out < len(gaps.corners)
        crossed = view.mesh.crossed(found)
        assert not crossed[gaps.corners[:-out].long()].any()
        assert crossed[gaps.corners[-out:].long()].all()


GAP = 0.2 * EDGE
FLOOR = 0.02
"""The gap that pairs keep [m], of distances of 0.1."""


def two_sheets() -> tuple[list, torch.Tensor, torch.Tensor]:
    """Levels of two sheets, one closely over the other, their positions, and which vertices are the upper one's."""
    (_, flat), garments = square(4), [named(square(4), each) for each in "AB"]
    levels = levels_of(*garments, dtype=torch.float64)
    level = levels[-1]
    x = torch.as_tensor(level.from_coarse @ np.concatenate([flat, flat + np.array([0.31 * EDGE, GAP, 0.17 * EDGE])]))
    return [levels, garments], x, level.vertex_garment == 1


class TestLayersThatMoveTogether:
    def test_go_where_they_want_but_for_where_they_would_cross(self):
        """Twenty edges along their normal, the lower one half an edge farther than the upper one in places."""
        (levels, garments), x, upper = two_sheets()
        bump = 0.5 * EDGE * torch.exp(-((x - x[~upper].mean(dim=0)) / (2 * EDGE)).square().sum(dim=1)) * ~upper
        way = torch.zeros_like(x)
        way[:, 1] = 20 * EDGE + bump
        y = view_of(levels, garments).moved(Placed(x), x + way)
        assert not crossings(Soup.of(levels[-1], y))
        late = (x + way - y).norm(dim=1)
        assert float(late.max()) < 0.5 * EDGE
        assert float(late.median()) < 0.05 * EDGE

    def test_turned_away_from_one_another_go_all_the_way(self):
        (levels, garments), x, _ = two_sheets()
        c, s = np.cos(1.0), np.sin(1.0)
        wanted = x @ torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]], dtype=x.dtype)
        assert torch.allclose(view_of(levels, garments).moved(Placed(x), wanted), wanted, atol=1e-9)


class TestAlong:
    def test_what_turns_on_its_way_is_held_where_it_meets_what_it_meets(self):
        """An edge over another slides along until its end, which goes down, is over it: no plane of its middle sees
        that."""
        ends = [[-1.0, 0.1, 0.0], [1.0, 0.1, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]
        x, way = torch.tensor(ends, dtype=torch.float64), torch.zeros(4, 3, dtype=torch.float64)
        way[0], way[1] = torch.tensor([0.9, -0.4, 0.0]), torch.tensor([0.9, 0.3, 0.0])
        corners, free = torch.arange(4, dtype=torch.int32).reshape(1, 4), torch.ones(4, 1, dtype=torch.bool)
        met = Pairs(corners, torch.ones(1, dtype=torch.float64), torch.tensor([False]))

        def gap(planes: ApproachLimits) -> float:
            end = x + along(way, planes, free=free)
            part = -end[0, 0] / (end[1, 0] - end[0, 0])
            return float(end[0, 1] + part * (end[1, 1] - end[0, 1]) - end[2:, 1].mean())

        planes = ApproachLimits.of(x, x, met, FLOOR)
        assert gap(planes) < 0.0
        for _ in range(2):
            end = x + along(way, planes, free=free)
            planes = planes.joined(ApproachLimits.of(x, end, replace(met, value=0.0 * met.value), FLOOR, corners=True))
        assert gap(planes) > 0.0
