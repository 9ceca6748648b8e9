"""S13, S15: starts that an integrator could be stuck at or thrown by: the flat saddle, and a crumpled ball."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from cloth import Answer, Watched, finest_system, frame_of, group_of, refiner_of, sheet, solved, total, wave
from sheets import garment_of, rotation

from physgraph_usd.lab.methods import METHODS
from physgraph_usd.solver.fabric import Fabric
from physgraph_usd.solver.integrate.base import Carry
from physgraph_usd.solver.integrate.guard import Guard
from physgraph_usd.solver.integrate.solve import Budget, solve_level

EDGE = 0.05


LIMP = Fabric(30.0, 2e-7, 0.187)
"""Soft enough in bending that every strain below buckles it in waves that the finest level can show."""


def squeezed(strain: float, *, turn: np.ndarray | None = None, **options: Any) -> tuple[Answer, np.ndarray]:
    """A flat, weightless sheet squeezed in its plane between two held sides, no guide; and how far it lifts [m]."""
    mesh, rest = sheet(8, 8, EDGE)
    axes = np.eye(3) if turn is None else turn
    held = np.isin(rest[:, 0], [0.0, rest[:, 0].max()]) * 1.0
    garment = garment_of(mesh, rest @ axes, pin=held)
    refiner = refiner_of([garment], level=2, dtype=torch.float32, gravity=np.zeros(3), **options)
    state = refiner.solve(frame_of((rest * [1.0 - strain, 1.0, 1.0]) @ axes, fabric=LIMP, guide=0.0))
    return state, np.abs(state.points[0] @ axes[2])


@pytest.mark.parametrize("turn", [None, rotation(3)], ids=["in an axis plane", "turned"])
@pytest.mark.parametrize(("strain", "tolerance"), [(0.01, 1e-4), (0.03, 2e-3), (0.1, 2e-3), (0.3, 2e-3)])
def test_s13_flat_sheet_leaves_the_saddle(strain: float, tolerance: float, turn: np.ndarray | None):
    """At one per cent the usual tolerance is met before wrinkles have grown: they grow by the strain a step.

    Out of the plane, springs keep their length: waves of length L have an amplitude of L sqrt(strain) / pi.
    """
    state, lift = squeezed(strain, turn=turn, tolerance=tolerance, steps=40)
    shortest = 2 * EDGE / 4
    assert lift.max() > 0.5 * shortest * np.sqrt(strain) / np.pi, lift.max()
    flat = 0.5 * 30.0 * strain**2 * 0.4 * 0.4 * (1 - strain)
    stretch = state.telemetry[0]["energy_joules"]["output"]["stretch"]
    assert stretch < 0.5 * flat, stretch / flat


def test_s13_the_same_wrinkles_each_run():
    assert squeezed(0.1)[0].points[0].tobytes() == squeezed(0.1)[0].points[0].tobytes()


@pytest.mark.parametrize("strain", [0.0, -0.05])
def test_s13_a_sheet_at_rest_or_stretched_stays_flat(strain: float):
    assert squeezed(strain)[1].max() < 1e-5 * EDGE


@pytest.mark.parametrize("height", [1e-5, 1e-4, 1e-3])
def test_s13_a_sheet_that_is_all_but_flat_leaves_it_as_well(height: float):
    """A fiftieth of an edge of waviness is near enough to the saddle to be stuck there, at forty times the energy."""
    mesh, rest = sheet(8, 8, EDGE)
    outs = [
        total(solved(mesh, rest, wave(rest, height=h), level=2, tolerance=2e-4).telemetry[0], "output")
        for h in (height, 0.01)
    ]
    assert outs[0] < 1.1 * outs[1], outs


def ball(level: int = 1, dtype: torch.dtype = torch.float64):
    """A sheet's system and a start that is noise of three edges."""
    mesh, rest = sheet(6, 6, EDGE)
    group = group_of(mesh, rest, level=level, dtype=dtype)
    system, x = finest_system(group, wave(rest))
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(x.shape, generator=generator, dtype=torch.float64).to(dtype)
    return system, x + 3.0 * system.spacing.unsqueeze(1) * noise


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("name", "steps"),
    [
        ("quasi-newton", 200),
        ("lbfgs", 200),
        ("newton", 25),
        pytest.param("newton", 200, marks=pytest.mark.slow),
    ],
)
def test_s15_a_crumpled_ball_uncrumples(name: str, steps: int, dtype: torch.dtype):
    system, x = ball(dtype=dtype)
    seen: list[Carry] = []
    integrator = Guard(METHODS[name].build())
    solve_level(system, Watched(integrator, seen.append), x, level=0, budget=Budget(steps))
    assert all(bool(carry.x.isfinite().all()) for carry in seen)
    assert all(after.energy <= before.energy for before, after in pairwise(seen))
    assert seen[-1].energy < 0.1 * seen[0].energy, seen[-1].energy / seen[0].energy


@pytest.mark.parametrize("name", ["adam", "gd", "quasi-newton-flat"])
def test_s15_no_method_is_thrown(name: str):
    system, x = ball(dtype=torch.float32)
    out, report = solve_level(system, Guard(METHODS[name].build()), x, level=0, budget=Budget(200))
    assert bool(out.isfinite().all())
    assert report.energy_after < report.energy_before


def test_s15_a_crumpled_cage_is_solved():
    """The cage itself is noise of three edges: the coarse animation is absurd, the answer finite and no worse."""
    mesh, rest = sheet(6, 6, EDGE)
    points = rest + 3.0 * EDGE * np.random.default_rng(5).normal(size=rest.shape)
    state = solved(mesh, rest, points, level=1, dtype=torch.float32)
    assert np.isfinite(state.points[0]).all()
    assert total(state.telemetry[0], "output") <= total(state.telemetry[0], "input")
