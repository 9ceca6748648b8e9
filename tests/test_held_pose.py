"""Poses that are held: cloth comes to rest, but for what `docs/notes/contact.md` says does not."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.held_pose import held

REST = 1e-4
"""Move of the farthest vertex from frame to frame that nobody sees [m]."""


@pytest.mark.parametrize("name", ["hood", pytest.param("armpit", marks=pytest.mark.slow)])
def test_it_rests(name: str, tmp_path: Path):
    moves = held(name, tmp_path, level=1)
    assert moves.vertices > 1000
    assert moves.farthest < REST, moves


@pytest.mark.slow
@pytest.mark.parametrize("level", [1, 2])
def test_in_layers_it_rests(level: int, tmp_path: Path):
    """In sharp folds what passed through itself was mended, and did so again, for ever."""
    assert held("layers", tmp_path, level=level).farthest < REST


@pytest.mark.slow
def test_between_overlapping_parts_it_rests(tmp_path: Path):
    """A T-shirt whose arm has come down onto a torso that it overlaps; what crosses starts anew in the first frames."""
    moves = held("tshirt", tmp_path, level=2, frames=18)
    assert moves.many == 0, moves
    assert moves.farthest < REST, moves
