"""The judge of versions: figures of a run, and its verdicts."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr", reason="the judge reads stages with usd-core")

from shots import cloth_shot

from benchmarks.judge_shot import RIPPLES, Job, judged
from benchmarks.verdicts import BETTER, EQUAL, FIGURES, UNKNOWN, WORSE, Band, overall, ratio, verdict


def test_a_shot_is_judged_in_every_figure_and_a_ripple_changes_it(tmp_path: Path):
    shot = str(cloth_shot(tmp_path / "sheet.usda"))
    jobs = [Job(shot, level=1, count=3, ripple=ripple, seed=seed, rest=1) for seed, ripple in enumerate(RIPPLES)]
    figures = [judged(job) for job in jobs]
    assert all(set(FIGURES) <= set(each) for each in figures)
    for each in figures:
        angle, high = each["rest_angle"], each["rest_angle90"]
        assert angle is not None
        assert high is not None
        assert 0.0 <= angle <= high < 180.0
    assert len({each["energy"] for each in figures}) == len(RIPPLES)


def test_frames_solved_on_to_rest_change_no_other_figure_and_no_position(tmp_path: Path):
    shot, found = str(cloth_shot(tmp_path / "sheet.usda")), []
    for rest in (0, 2):
        positions = tmp_path / f"rest{rest}.npz"
        figures = judged(Job(shot, level=1, count=3, rest=rest, positions=str(positions)))
        assert (figures["rest_angle"] is None) == (rest == 0)
        timed = {"warm", "first"}
        kept = {name: each for name, each in figures.items() if name not in timed and not name.startswith("rest_")}
        found.append((kept, np.load(positions)))
    assert found[0][0] == found[1][0]
    for name in ("points", "triangles"):
        assert np.array_equal(found[0][1][name], found[1][1][name])
    assert found[0][1]["points"].shape[0] == 3


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
