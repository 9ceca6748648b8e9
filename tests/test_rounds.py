"""Rounds: what crosses at their start is mended, and planes last while vertices stay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from bodies import ball
from folds import EDGE, contact_of, folded, levels_of, named, square, strip

from physgraph_usd.colliders.mesh import MeshBody, MeshSurface
from physgraph_usd.colliders.pose import MeshPose
from physgraph_usd.contact import rounds
from physgraph_usd.contact.bodies import STALE, FrameBodies, Touching
from physgraph_usd.contact.cloth import MOST
from physgraph_usd.contact.cloth_mesh import ClothMesh
from physgraph_usd.contact.settings import ContactSettings
from physgraph_usd.integrate.base import Carry, System
from physgraph_usd.integrate.metric import Metric
from physgraph_usd.integrate.quasi_newton import QuasiNewton
from physgraph_usd.integrate.solve import Budget
from physgraph_usd.level import Level


class Springs:
    """Each vertex on a spring to a place of its own [m]."""

    def __init__(self, goal: torch.Tensor) -> None:
        self.goal = goal

    def energy_and_force(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return 0.5 * (x - self.goal).square().sum(), self.goal - x

    def diagonal(self, x: torch.Tensor) -> torch.Tensor:
        return torch.ones_like(x[:, 0])


def system_of(level: Level, field: Springs) -> System:
    """Springs at a level, by themselves, with the metric that fits them."""
    metric = Metric(sp.csr_matrix(sp.identity(level.vertex_count)), free=level.free, dtype=level.dtype)
    return System(field, metric, free=level.free, spacing=level.spacing, level=level)


class Noting(QuasiNewton):
    """Quasi-Newton that notes where it starts and where it goes on from, with as many setbacks a step as it is told."""

    def __init__(self, setbacks: int) -> None:
        super().__init__()
        self.setbacks = setbacks
        self.started: list[torch.Tensor] = []
        self.resumed: list[torch.Tensor] = []

    def start(self, system: System, x: torch.Tensor) -> Carry:
        self.started.append(x)
        return super().start(system, x)

    def resume(self, system: System, carry: Carry) -> Carry:
        self.resumed.append(carry.x)
        return super().resume(system, carry)

    def step(self, system: System, carry: Carry) -> Carry:
        return replace(super().step(system, carry), setbacks=self.setbacks)


class Fold:
    """A fold whose upper half is drawn through the lower one at a vertex, and along z elsewhere."""

    def __init__(self, **settings: str) -> None:
        cloth, points = strip()
        garment = named((cloth, points))
        self.levels = levels_of(garment)
        self.level = self.levels[1]
        cage = torch.as_tensor(folded(points, 0.4 * EDGE), dtype=torch.float32)
        self.view = contact_of(self.levels, [garment], cage, **settings).at(self.level)
        self.x = self.level.base.apply(cage)
        above = (self.x[:, 1] > 0.3 * EDGE) & (self.x[:, 2].abs() < EDGE)
        self.over = torch.nonzero(above & ((self.x[:, 0] - 3 * EDGE).abs() < EDGE)).squeeze(1)
        self.goal = self.x.clone()
        self.goal[self.over[len(self.over) // 2], 1] -= 0.8 * EDGE
        self.away = self.x[:, 0] > self.x[:, 0].max() - EDGE
        self.goal[self.away, 2] += 0.1 * EDGE

    def solved(self, integrator: QuasiNewton, *, whole: bool) -> torch.Tensor:
        system = system_of(self.level, Springs(self.goal))
        return rounds.solve_rounds(
            lambda *_: system,
            integrator,
            self.x,
            terms=self.view.terms(self.x),
            view=self.view,
            level=1,
            budget=Budget(3),
            rounds=3,
            whole=whole,
        )[0]

    def touching(
        self,
        goal: torch.Tensor,
        x: torch.Tensor,
        *,
        integrator: QuasiNewton | None = None,
        finest: bool = True,
        warm: bool = True,
        still: bool = False,
        steps: int = 3,
    ) -> torch.Tensor:
        """The level solved from x, drawn to a goal."""
        system = system_of(self.level, Springs(goal))
        return rounds.solve_touching(
            lambda *_: system,
            integrator or QuasiNewton(),
            x,
            view=self.view,
            level=self.level,
            finest=finest,
            outward=torch.ones(1),
            smoothing=None if warm else torch.zeros_like(x),
            still=still,
            budget=Budget(steps),
        )[0]

    def crossings(self, x: torch.Tensor) -> int:
        assert self.view.cloth is not None
        return self.view.cloth.look(x).crossings.count


@pytest.mark.parametrize("warm", [True, False])
def test_what_crosses_at_a_levels_start_is_mended(warm):
    fold = Fold()
    assert fold.crossings(fold.goal) > 0
    assert fold.view.cloth is not None
    assert fold.view.cloth.before.crossings.count == 0
    assert fold.crossings(fold.touching(fold.goal, fold.goal, finest=False, warm=warm, steps=0)) == 0


class TestWholeRounds:
    def test_what_one_makes_cross_is_taken_back_and_nothing_else(self):
        fold = Fold()
        assert fold.crossings(fold.solved(QuasiNewton(), whole=False)) > 0
        x = fold.solved(QuasiNewton(), whole=True)
        assert fold.crossings(x) == 0
        torch.testing.assert_close(x[fold.away], fold.goal[fold.away], rtol=0.0, atol=1e-6)

    @pytest.mark.parametrize("setbacks", [0, 1])
    def test_the_next_goes_on_from_there(self, setbacks):
        fold, integrator = Fold(), Noting(setbacks)
        fold.solved(integrator, whole=True)
        assert len(integrator.started) == (3 if setbacks else 1)
        assert len(integrator.resumed) == (0 if setbacks else 2)
        for x in (*integrator.started, *integrator.resumed):
            assert fold.crossings(x) == 0

    def test_the_first_starts_from_what_the_way_off_a_saddle_did_not_make_cross(self, monkeypatch):
        fold, integrator = Fold(), Noting(0)
        monkeypatch.setattr(rounds, "leave_saddle", lambda *_, **__: fold.goal)
        monkeypatch.setattr(rounds, "crowded", lambda *_: True)
        fold.touching(fold.x, fold.x, integrator=integrator, warm=False, steps=1)
        assert fold.crossings(fold.goal) > 0
        assert fold.crossings(integrator.started[0]) == 0

    def test_nothing_is_taken_back_to_a_start_that_crosses(self):
        fold = Fold()
        assert fold.view.uncrossed(fold.x, fold.goal) is fold.x
        x = fold.goal.clone()
        x[fold.over[0], 1] -= 0.8 * EDGE
        assert fold.crossings(x) > fold.crossings(fold.goal)
        assert fold.view.uncrossed(x, fold.goal) is x
        assert fold.view.uncrossed(x, fold.x) is not x

    def test_the_papers_spheres_are_left_alone(self):
        fold = Fold(cloth="spheres")
        assert fold.view.uncrossed(fold.goal, fold.x) is fold.goal


@pytest.mark.parametrize(
    ("warm", "still", "much", "each"),
    [(True, False, False, 6), (True, True, False, 12), (True, False, True, 12), (False, True, False, 4)],
)
def test_rounds_share_a_budget_but_in_a_held_pose_and_where_it_is_crowded(warm, still, much, each, monkeypatch):
    fold, asked = Fold(), list[int]()
    monkeypatch.setattr(rounds, "crowded", lambda *_: much)
    solve = rounds.solve_level
    monkeypatch.setattr(
        rounds, "solve_level", lambda *args, **more: asked.append(more["budget"].steps) or solve(*args, **more)
    )
    fold.touching(fold.x, fold.x, warm=warm, still=still, steps=12)
    assert asked[0] == each


class TestPairs:
    """Of a warm frame's two rounds the second keeps the first one's pairs; more rounds find them anew."""

    @pytest.mark.parametrize(
        ("warm", "still", "kept"), [(True, False, True), (True, True, False), (False, False, False)]
    )
    def test_in_warm_frames_that_are_not_held(self, warm: bool, still: bool, kept: bool, monkeypatch):
        fold, asked, slid = Fold(), list[object](), list[object]()
        nearest, slide = ClothMesh.nearest, ClothMesh.slid
        monkeypatch.setattr(ClothMesh, "nearest", lambda *args, **more: asked.append(0) or nearest(*args, **more))
        monkeypatch.setattr(ClothMesh, "slid", lambda *args: slid.append(0) or slide(*args))
        goal = fold.x.clone()
        goal[fold.away, 2] += 0.2 * EDGE
        fold.touching(goal, fold.x, warm=warm, still=still, steps=2)
        assert bool(slid) == kept
        assert (len(asked) == 1) == kept

    @pytest.mark.parametrize(("moved", "kept"), [(0.1, True), (0.9, False)])
    def test_not_where_much_has_moved(self, moved: float, kept: bool, monkeypatch):
        assert self.slides(Fold(), moved, monkeypatch) == kept

    def test_what_is_known_stays_as_it_was_found(self):
        """Looked for again afterwards, pairs are those that were never kept."""
        found = []
        for keep in (False, True):
            fold = Fold()
            cloth, shift = fold.view.cloth, torch.tensor([0.0, 0.0, 0.3 * EDGE])
            assert cloth is not None
            some = (fold.x[:, 1] > 0.3 * EDGE) & (fold.x[:, 0] > 4.5 * EDGE)
            assert float(some.double().mean()) < MOST
            fold.view.terms(fold.x)
            fold.view.terms(fold.x + shift * some.unsqueeze(1), keep_pairs=keep)
            # Those that come back have not moved since what is known was found.
            fold.view.terms(fold.x + 0.2 * EDGE * (fold.x[:, :1] < EDGE))
            assert cloth._found is not None
            found.append(cloth._found.nearest)
        assert torch.equal(found[0].edge, found[1].edge)
        assert torch.equal(found[0].face, found[1].face)

    def test_not_where_something_crossed(self, monkeypatch):
        fold = Fold()
        fold.x = fold.goal
        assert not self.slides(fold, 0.1, monkeypatch)

    @staticmethod
    def slides(fold: Fold, moved: float, monkeypatch: pytest.MonkeyPatch) -> bool:
        """Whether pairs are kept after a part of the vertices has moved."""
        slid, slide = list[object](), ClothMesh.slid
        monkeypatch.setattr(ClothMesh, "slid", lambda *args: slid.append(0) or slide(*args))
        fold.view.terms(fold.x)
        some = torch.arange(len(fold.x)) < moved * len(fold.x)
        fold.view.terms(fold.x + 0.2 * EDGE * some.unsqueeze(1), keep_pairs=True)
        return bool(slid)


class TestRelaxing:
    """What was mended is where no force would put it: rounds of fewer steps follow, none of which leaves it crossed."""

    @staticmethod
    def relaxed(fold: Fold, x: torch.Tensor) -> tuple[torch.Tensor, int]:
        system = system_of(fold.level, Springs(fold.goal))
        given = {"view": fold.view, "level": fold.level.index, "budget": Budget(3), "most": 4}
        out, reports = rounds.relax(lambda *_: system, QuasiNewton(), x, **given)
        return out, len(reports)

    def test_energy_falls_and_nothing_crosses(self):
        fold = Fold()
        field = Springs(fold.goal)
        out, made = self.relaxed(fold, fold.x)
        assert made == 4
        assert fold.crossings(fold.goal) > fold.crossings(out) == 0
        assert float(field.energy_and_force(out)[0]) < 0.5 * float(field.energy_and_force(fold.x)[0])

    def test_what_crosses_is_left_as_it_is(self):
        fold = Fold()
        out, made = self.relaxed(fold, fold.goal)
        assert out is fold.goal
        assert made == 0

    def test_it_follows_where_the_last_round_was_mended(self, monkeypatch: pytest.MonkeyPatch):
        """And only where much cloth pushes cloth: elsewhere it would cost more than it wins."""
        fold, made = Fold(), list[torch.Tensor]()
        monkeypatch.setattr(rounds, "relax", lambda *args, **_: (made.append(args[2]) or args[2], []))
        for much, goal, wanted in ((True, fold.x, 0), (False, fold.goal, 0), (True, fold.goal, 1)):
            monkeypatch.setattr(rounds, "crowded", lambda *_, much=much: much)
            fold.touching(goal, fold.x)
            assert len(made) == wanted

    @pytest.mark.parametrize("warm", [True, False])
    def test_it_follows_where_cloth_is_crowded_at_the_end_only(self, warm: bool, monkeypatch: pytest.MonkeyPatch):
        """And from cold takes more rounds: what folds form there is where mending left it."""
        fold, made = Fold(), list[int]()
        monkeypatch.setattr(rounds, "relax", lambda *args, **more: (made.append(more["most"]) or args[2], []))
        crowds = iter([False, True])
        monkeypatch.setattr(rounds, "crowded", lambda *_: next(crowds))
        fold.touching(fold.goal, fold.x, warm=warm)
        assert made == [rounds.WARM_RELAXATIONS if warm else rounds.RELAXATIONS]


class TestPlanes:
    def test_those_of_vertices_that_stay_are_not_looked_for_again(self, monkeypatch):
        garment = named(square(6))
        levels = levels_of(garment)
        surface = MeshBody(device="cpu", lanes=1).pose(MeshPose(*ball(0.2, at=(0.0, -0.201, 0.0))))[0]
        cage = torch.as_tensor(garment.rest, dtype=torch.float32)
        body = Touching("/Ball", surface, (0.002,))
        settings = ContactSettings(stiffness=1.0)
        bodies = FrameBodies.begin(levels, [body], cage, origin=np.zeros(3), settings=settings)
        view, level = bodies.at(levels[1], levels[1]), levels[1]
        asked: list[torch.Tensor] = []
        closest = MeshSurface.closest
        monkeypatch.setattr(MeshSurface, "closest", lambda self, x, reach: asked.append(x) or closest(self, x, reach))
        x = level.rest.clone()
        first = view.term(x)
        assert first is not None
        seen = first.planes[0].vertex.long()
        assert len(asked.pop()) >= len(seen) > 20
        moved = x + 0.5 * STALE * level.spacing.unsqueeze(1) * torch.tensor([0.0, 1.0, 0.0])
        one = int(seen[len(seen) // 2])
        moved[one, 0] += 3.0 * STALE * float(level.spacing[one])
        second = view.term(moved)
        assert second is not None
        again = (asked[0].unsqueeze(1) == (moved[seen] - torch.as_tensor(surface.origin)).to(x)).all(dim=2).any(dim=0)
        assert seen[again].tolist() == [one]
        before, after = first.planes[0], second.planes[0]
        assert torch.equal(before.vertex, after.vertex)
        same = before.vertex != one
        assert torch.equal(before.height[same], after.height[same])
        assert torch.equal(before.normal[same], after.normal[same])
        assert not torch.equal(before.normal[~same], after.normal[~same])
