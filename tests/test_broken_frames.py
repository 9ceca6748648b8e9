"""One broken frame in the input leaves nothing behind, and is told of."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from shots import CLOTH, cloth_shot, fine, refine

from benchmarks.glitches import BEFORE, GLITCHES, run

AFTER = 5


@pytest.fixture(scope="module")
def clean() -> list[np.ndarray]:
    return [points for points, _ in run(1, AFTER, travel=0.0)]


@pytest.mark.parametrize("name", GLITCHES)
def test_cloth_is_back_after_five_frames(clean: list[np.ndarray], name: str):
    """Unmended, cloth that a body swallowed for one frame stayed 34 mm from its place for good."""
    told = run(1, AFTER, travel=0.0, glitch=GLITCHES[name])
    assert np.linalg.norm(told[-1][0] - clean[-1], axis=1).max() < 1e-3
    assert told[BEFORE + 1][1].get("broken_before", BEFORE) == BEFORE


@pytest.mark.parametrize("scale", [100.0, 0.0, -1.0])
def test_a_warning_names_the_frame(tmp_path: Path, scale: float):
    shot = cloth_shot(tmp_path / "shot.usdc", broken={3.0: scale})
    report = refine(shot, tmp_path / "fine.usdc")
    assert [each for each in report.warnings if each.startswith(f"<{CLOTH}> at time code 3: ")], report.warnings
    whole = cloth_shot(tmp_path / "whole.usdc")
    unbroken = refine(whole, tmp_path / "unbroken.usdc")
    assert not [each for each in unbroken.warnings if "leaves its place" in each]
    pair = [fine(shot, tmp_path / name, 6.0) for name in ("fine.usdc", "unbroken.usdc")]
    assert np.abs(pair[0] - pair[1]).max() < 1e-3


def test_cloth_that_moves_on_or_turns_round_is_not_broken(tmp_path: Path):
    """The sheet waves to and fro by less than an edge a frame; thrown by ten edges a frame it does not come back."""
    shot = cloth_shot(tmp_path / "shot.usdc", broken={3.0: 1.02})
    assert not [each for each in refine(shot, tmp_path / "fine.usdc").warnings if "leaves its place" in each]
