"""The judge of versions: figures of a run, and its verdicts."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("pxr", reason="the judge reads stages with usd-core")

from shots import cloth_shot

from benchmarks.judge_shot import Job, judged
from benchmarks.verdicts import BETTER, EQUAL, FIGURES, UNKNOWN, WORSE, Band, overall, ratio, verdict
from benchmarks.versions import RIPPLES


def test_a_shot_is_judged_in_every_figure_and_a_ripple_changes_it(tmp_path: Path):
    shot = str(cloth_shot(tmp_path / "sheet.usda"))
    figures = [judged(Job(shot, level=1, count=3, ripple=ripple, seed=seed)) for seed, ripple in enumerate(RIPPLES)]
    assert {name for each in figures for name in each} == set(FIGURES)
    assert len({each["energy"] for each in figures}) == len(RIPPLES)


def test_a_verdict_needs_more_than_the_noise_and_more_than_a_hundredth():
    assert verdict(Band(100.0, 3.0), Band(106.5, 3.0)) == WORSE
    assert verdict(Band(100.0, 3.0), Band(105.5, 3.0)) == EQUAL
    assert verdict(Band(100.0, 0.0), Band(100.9, 0.0)) == EQUAL
    assert verdict(Band(-100.0, 1.0), Band(-104.0, 1.0)) == BETTER
    assert verdict(Band(0.0, 0.0), Band(1.0, 0.0)) == WORSE
    assert verdict(None, Band(1.0, 0.0)) == UNKNOWN
    assert Band.of([1.0, 2.0, 6.0]) == Band(3.0, 2.5)
    assert Band.of([1.0, None, 6.0]) is None
    assert ratio(Band(-1.0, 0.0), Band(1.0, 0.0)) is None
    pair = {"warm": Band(100.0, 1.0)}, {"warm": Band(80.0, 1.0)}
    assert "| warm frame [ms] | 0.800 | 1 | 0 | 0 | a | - |" in overall({"a": pair})
