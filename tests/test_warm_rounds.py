"""How many steps a warm frame in contact makes, and how low shaken layers end."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from shots import refine

from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.solver.frame.problem import NEAR
from physgraph_usd.solver.frame.solve import STEPS, TOUCHING


def test_a_warm_frame_is_done_early_only_near_rest(sample: Callable[[str], Path], tmp_path: Path):
    steps = []
    for name, frames in (("torus", (17.0, 20.0)), ("dancer", (20.0, 22.0))):
        report = refine(sample(name), tmp_path / f"{name}.usdc", level=1, steps=12, frames=frames)
        for frame in report.frames[1:]:
            rounds = frame["garments"][0]["levels"]
            steps.append(sum(each["steps"] for each in rounds))
            near = rounds[-1]["remaining_move"] < NEAR * RefineOptions().tolerance
            assert near or rounds[-1]["stopped"] == "stalled" or steps[-1] >= TOUCHING * 12
    assert min(steps) == STEPS
    assert max(steps) > TOUCHING * STEPS


@pytest.mark.slow
def test_layers_that_are_shaken_end_about_as_low_as_by_quasi_newton(sample: Callable[[str], Path], tmp_path: Path):
    """The network, whose steps are nearly all corrected there, ended at three to ten times the energy."""
    ends = []
    for who in ("physgraph", "quasi-newton"):
        report = refine(sample("layers"), tmp_path / f"{who}.usdc", integrator=who, level=2, frames=(6.0, 9.0))
        garments = report.frames[-1]["garments"]
        ends.append(sum(sum(each["energy_joules"]["output"].values()) for each in garments))
    assert ends[0] < 1.3 * ends[1]
