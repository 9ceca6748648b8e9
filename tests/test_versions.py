"""The judge of versions: ripples, figures of a run, the motion that it counts, and its verdicts."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("pxr", reason="the judge reads stages with usd-core")

from shots import cloth_shot

from benchmarks.judge_shot import Job, judged
from benchmarks.verdicts import BETTER, EQUAL, FIGURES, UNKNOWN, WORSE, Band, overall, ratio, verdict
from benchmarks.versions import RIPPLES, bands_of, tables

SMALL: dict[str, Any] = {"level": 1, "count": 3}


@pytest.fixture(scope="module")
def figures(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, float | None]]:
    """Figures of a small waving sheet with each ripple."""
    shot = cloth_shot(tmp_path_factory.mktemp("judged") / "sheet.usda")
    return [judged(Job(str(shot), **SMALL, ripple=ripple, seed=seed)) for seed, ripple in enumerate(RIPPLES)]


def runs_of(version: str, figures: list[dict[str, float | None]], **changed: float) -> list[dict[str, Any]]:
    """Finished runs of one shot, as a file of figures has them, with something added to some figures."""
    job = {"first": 0, "count": 3, "level": 1}
    return [
        {
            "row": "sheet",
            "version": version,
            "job": job | {"ripple": ripple},
            "figures": {name: value and value + changed.get(name, 0.0) for name, value in each.items()},
        }
        for ripple, each in zip(RIPPLES, figures, strict=True)
    ]


def test_a_version_beside_itself_is_equal_in_every_figure(figures: list[dict[str, float | None]]):
    assert set(figures[0]) == set(FIGURES)
    assert len({each["energy"] for each in figures}) == len(RIPPLES), "a ripple changes the result a little"
    runs = [*runs_of("old", figures), *runs_of("new", figures)]
    each = bands_of(runs, "old"), bands_of(runs, "new")
    found = {name: verdict(each[0][name], each[1][name]) for name in FIGURES}
    assert found == dict.fromkeys(FIGURES, EQUAL)
    assert "worse" not in tables(runs).partition("Shot by shot")[2]


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
