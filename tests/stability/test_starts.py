"""S13, S15: starts that an integrator could be stuck at or thrown by: the flat saddle, and a crumpled cage."""

from typing import Any

import numpy as np
import pytest
import torch
from cloth import Answer, finest_system, frame_of, group_of, refiner_of, sheet, solved, total, wave
from sheets import garment_of, rotation

from physgraph_usd.solver.fabric import Fabric

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
@pytest.mark.parametrize(("strain", "tolerance"), [(0.01, 1e-4), (0.3, 2e-3)])
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


@pytest.mark.parametrize("strain", [0.0, -0.05])
def test_s13_a_sheet_at_rest_or_stretched_stays_flat(strain: float):
    assert squeezed(strain)[1].max() < 1e-5 * EDGE


def test_s13_a_sheet_that_is_all_but_flat_leaves_it_as_well():
    """A fiftieth of an edge of waviness is near enough to the saddle to be stuck there, at forty times the energy."""
    mesh, rest = sheet(8, 8, EDGE)
    outs = [
        total(solved(mesh, rest, wave(rest, height=h), level=2, tolerance=2e-4).telemetry[0], "output")
        for h in (1e-4, 0.01)
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


def test_s15_a_crumpled_cage_is_solved():
    """The cage itself is noise of three edges: the coarse animation is absurd, the answer finite and no worse."""
    mesh, rest = sheet(6, 6, EDGE)
    points = rest + 3.0 * EDGE * np.random.default_rng(5).normal(size=rest.shape)
    state = solved(mesh, rest, points, level=1, dtype=torch.float32)
    assert np.isfinite(state.points[0]).all()
    assert total(state.telemetry[0], "output") <= total(state.telemetry[0], "input")
