"""Layers written over real assets, refined without a solver: every rule and USD's own validators hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from layers import errors, fine_points, open_over, refine_all, world_metres, write_shot
from shots import VALID

from physgraph_usd.usd.read.reader import open_shot


@pytest.mark.real_data
@pytest.mark.parametrize("mode", ["over", "sibling"])
@pytest.mark.parametrize("name", VALID)
def test_a_real_shot(real_data: Path, tmp_path: Path, name: str, mode: str) -> None:
    path, out = real_data / "shots" / name, tmp_path / "out.usdc"
    shot = open_shot(str(path), level=1, garments=VALID[name])
    steps = refine_all(shot)
    times = [*shot.scene.times[:2], *shot.scene.times[-1:]] or [None]
    writer = write_shot(shot, out, times=times, mode=mode, velocities=True)
    assert errors(out, path) == []
    stage = open_over(path, out)
    for time in times:
        for target, points in zip(writer.targets, fine_points(shot, steps, time), strict=True):
            size = float(np.ptp(points, axis=0).max())
            np.testing.assert_allclose(world_metres(stage, str(target), time), points, atol=1e-5 * size)
