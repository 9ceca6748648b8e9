"""CUDA: the same kernels give the CPU's answer, and the same bits each time (S33, S34)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from cloth import frame_of, settings_of, sheet, wave
from sheets import garment_of

from physgraph_usd.group import Group
from physgraph_usd.level import refine_garments
from physgraph_usd.scene import GarmentFrame

EDGE = 0.02

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
]


def cloth(device: str, dtype: torch.dtype, **options: Any) -> tuple[Group, list[GarmentFrame]]:
    """A waved sheet at level 2."""
    mesh, rest = sheet(8, 8, EDGE)
    garments = [garment_of(mesh, rest)]
    chains = refine_garments(garments, [2])
    down = np.array([0.0, 0.0, -9.81])
    one = Group(garments, chains, down, settings_of(**options), dtype=dtype, device=device)
    return one, list(frame_of(wave(rest, height=0.005, squeeze=0.02)).garments)


@pytest.mark.parametrize(("dtype", "most"), [(torch.float64, 1e-13), (torch.float32, 2e-6)])
def test_forces_energies_and_metrics_agree(dtype: torch.dtype, most: float) -> None:
    """Forces within rounding of stiffness times edge length: that is what their differences of lengths lose."""
    answers = []
    scale = 0.0
    for device in ("cpu", "cuda"):
        one, frames = cloth(device, dtype)
        systems, coarse = one.systems(frames)
        x = one.levels[-1].base.apply(coarse)
        energy, force = systems[-1].energy_and_force(x)
        again = systems[-1].energy_and_force(x)[1]
        assert torch.equal(force, again)
        move = systems[-1].apply_metric_inverse(force)
        scale = float((systems[-1].diagonal(x) * one.levels[-1].spacing).max())
        answers.append((energy, force.cpu().double().numpy(), move.cpu().double().numpy()))
    (energy, force, move), (other_energy, other_force, other_move) = answers
    assert other_energy == pytest.approx(energy, rel=100 * most)
    assert np.abs(other_force - force).max() < most * scale
    assert np.abs(other_move - move).max() < most * EDGE


def test_s33_a_solved_frame_agrees_and_repeats() -> None:
    answers = []
    for device in ("cpu", "cuda", "cuda"):
        one, frames = cloth(device, torch.float64, steps=60, tolerance=1e-7)
        answers.append(one.solve(frames, None, at=None).points[0])
    here, there, again = answers
    assert there.tobytes() == again.tobytes()
    assert np.abs(here - there).max() < 1e-4 * EDGE / 4
