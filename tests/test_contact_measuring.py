"""Contact is measured whether or not it is modelled, where a report is asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from bodies import ball
from cloth import sheet
from folds import levels_of, named
from touching import frame, measured, mesh_pose, refiner

from physgraph_usd.solver.colliders.mesh import MeshBody, MeshSurface
from physgraph_usd.solver.colliders.pose import MeshPose
from physgraph_usd.solver.contact.bodies import FrameBodies, Touching
from physgraph_usd.solver.contact.push_out import projected
from physgraph_usd.solver.contact.settings import ContactSettings
from physgraph_usd.solver.level import Level
from physgraph_usd.solver.scene import State

MESH, REST = sheet(8, 8, 0.05)
HANGING = REST - REST.mean(axis=0)
NORMAL = np.eye(3)[np.ptp(HANGING, axis=0).argmin()]
BALL = ball(0.1)


def solved(contact: ContactSettings) -> State:
    """A sheet whose middle is in a ball."""
    solver = refiner((MESH, REST), temporal="off")
    solver.use(replace(solver._settings, contact=contact))
    return solver.solve(frame(HANGING, mesh_pose((BALL[0] - 0.09 * NORMAL, BALL[1]))))


def test_what_is_off_is_measured_and_changes_no_bit():
    off = ContactSettings("off", cloth="off")
    without, judged = solved(off), solved(replace(off, measured=True))
    assert "contact" not in without.telemetry[0]
    assert measured(judged, "before")["inside"] > 20
    assert measured(judged)["inside"] > 20
    assert measured(judged)["crossings"] > 20
    assert bool((np.asarray(without.points[0]) == np.asarray(judged.points[0])).all())


class TestBodies:
    """What is known of the upsampled cage's distances saves asking for them again, and nothing else."""

    def begun(self) -> tuple[FrameBodies, Level, torch.Tensor]:
        """A sheet over a ball and just clear of it, with what is known of it."""
        levels = levels_of(named((MESH, HANGING)))
        surface = MeshBody(device="cpu", threads=1).pose(MeshPose(BALL[0] - 0.13 * NORMAL, BALL[1]))[0]
        cage = torch.as_tensor(HANGING, dtype=torch.float32)
        body = Touching("/Ball", surface, (0.002,))
        return (
            FrameBodies.begin(levels, [body], cage, origin=np.zeros(3), settings=ContactSettings()),
            levels[-1],
            levels[-1].base.apply(cage),
        )

    def test_what_moved_into_one_is_found(self):
        bodies, level, base = self.begun()
        x = base - 0.05 * torch.as_tensor(NORMAL, dtype=base.dtype)
        found = bodies.measure(level, base, x)["bodies"]
        assert isinstance(found, dict)
        deep = np.linalg.norm(x.numpy() + 0.13 * NORMAL, axis=1) < 0.0995
        assert found["/Ball"]["before"]["inside"] == 0
        assert found["/Ball"]["after"]["inside"] == pytest.approx(deep.sum(), abs=0.1 * deep.sum())
        assert deep.sum() > 20

    @pytest.mark.parametrize("depth", [0.0, 0.08])
    def test_what_the_solve_knows_serves(self, monkeypatch: pytest.MonkeyPatch, depth: float):
        """What it found outside is not asked for again, where it has not moved into a body since; all else is."""
        bodies, level, base = self.begun()
        view, normal = bodies.at(level, level), torch.as_tensor(NORMAL, dtype=base.dtype)
        view, _ = view.seen(base - 0.04 * normal)
        view, out, _ = projected(view, base - 0.04 * normal)
        x = out - depth * normal * (torch.arange(len(out)) % 3 == 0).unsqueeze(1)
        fresh = self.begun()[0].measure(level, base, x)
        asked, closest = list[int](), MeshSurface.closest
        monkeypatch.setattr(
            MeshSurface, "closest", lambda self, x, reach: asked.append(len(x)) or closest(self, x, reach)
        )
        assert bodies.measure(level, base, x, view=view) == fresh
        unknown = int((view.tracks[0].least(x) <= 0).sum())
        assert unknown > 20 if depth else unknown == 0
        assert max(asked, default=0) <= unknown < 0.5 * len(x)
