"""The page of results: verdicts, its journal, and the measures that only it takes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pxr", reason="benchmarks read stages with usd-core")
pytest.importorskip("PIL", reason="the material grid is written with Pillow")

import torch
from cloth import sheet
from sheets import garment_of

from benchmarks import step, versions
from benchmarks.paper.__main__ import PARTS
from benchmarks.paper.loose import band_energy, chamfer
from benchmarks.paper.materials import Cell, exponents, peak
from benchmarks.paper.page import Journal, Part, page, run
from benchmarks.paper.skinning import turned_over
from benchmarks.rows import Row, under
from physgraph_usd.solver.level import Level, build_levels, refine_garments


def level_of(columns: int, rows: int) -> Level:
    mesh, rest = sheet(columns, rows)
    garments = [garment_of(mesh, rest)]
    return build_levels(garments, refine_garments(garments, [1]), dtype=torch.float64, device="cpu")[-1]


def parts(calls: list[str]) -> list[Part]:
    """Two parts that say when they are measured."""

    def measured(name: str, met: bool | None) -> Part:
        def measure(short: bool) -> list[Row]:
            calls.append(f"{name} {short}")
            return [Row(f"what of {name}", "1", "2", "at most 3", met)]

        return Part(name, f"Title of {name}", measure)

    return [measured("one", True), measured("two", False)]


def test_a_bound_is_met_or_missed_and_nan_is_missed():
    assert under("x", 1.0, 1.0).met
    assert not under("x", 1.1, 1.0).met
    assert not under("x", float("nan"), 1.0).met
    assert "**missed**" in under("x", 2.0, 1.0).line()
    assert Row("x", "1").line().endswith("|  |")


def test_an_interrupted_run_goes_on_where_it_was(tmp_path: Path):
    calls: list[str] = []
    file, key = tmp_path / "journal.jsonl", {"form": "short"}
    one, two = parts(calls)
    run([one], Journal(file, key, fresh=False), short=True)
    file.write_text(file.read_text() + '{"part": "two", "ke', encoding="utf-8")  # a line cut off
    known = run([one, two], Journal(file, key, fresh=False), short=True)
    assert calls == ["one True", "two True"]
    assert set(known) == {"one", "two"}
    assert [json.loads(line)["part"] for line in file.read_text().splitlines()] == ["one", "two"]
    run([one, two], Journal(file, {"form": "other"}, fresh=False), short=False)
    run([one, two], Journal(file, key, fresh=True), short=True)
    assert len(calls) == 6


def test_figures_of_a_gpu_stand_beside_the_papers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    file = tmp_path / "cuda.json"
    line = {"edges": 10208, "forces": 0.04, "quasi-newton": 1.0, "physgraph": 2.0, "physgraph-paper": 20.0}
    file.write_text(json.dumps({"device": "a GPU", "command": "python -m benchmarks.step", "rows": [line]}))
    monkeypatch.setattr(step, "CUDA", file)
    monkeypatch.setattr(step, "timed", lambda *given: [line])
    rows = [row for row in step.measure(True) if "a GPU" in row.what]
    assert [row.met for row in rows] == [True, True, True, False]
    monkeypatch.setattr(step, "CUDA", tmp_path / "absent.json")
    assert any(row.ours == "not measured" and row.met is False for row in step.measure(True))


def test_the_page_counts_what_is_met_and_shows_what_is_missed(tmp_path: Path):
    made = parts([])
    known = run(made, Journal(tmp_path / "journal.jsonl", {}, fresh=True), short=True)
    text = page(made, known, short=True)
    assert "**1 of 2 figures with a target meet it.**" in text
    assert "## Title of one" in text
    assert "`python -m benchmarks.paper --only two --short`" in text
    assert "| what of two | 2 | at most 3 | 1 | **missed** |" in text
    assert "--short" not in page(made, known, short=False)


def test_every_part_has_its_name_once():
    assert len({part.name for part in PARTS}) == len(PARTS) == 11


def test_the_band_holds_waves_of_its_length_alone():
    """Waves of six fine edges against waves of two and a half and of 40 of them, all of one height."""
    level = level_of(24, 24)
    x, h = level.rest.numpy(), float(level.spacing.mean())
    found = {}
    for edges in (2.5, 6.0, 40.0):
        wave = np.sin(2 * np.pi * x[:, 0] / (edges * h))
        found[edges] = band_energy(level, wave[:, None] * np.array([0.0, 0.0, 1.0]))
    assert found[6.0] > 2 * found[2.5]
    assert found[6.0] > 10 * found[40.0]


def test_chamfer_of_a_shifted_sheet_is_the_shift():
    points = sheet(4, 4)[1]
    assert chamfer(points, points + np.array([0.0, 0.0, 0.003])) == pytest.approx(0.003)


def test_a_peak_between_places_is_found_between_them():
    places = np.geomspace(1.0, 16.0, 9)
    values = np.exp(-((np.log(places) - np.log(3.0)) ** 2))
    assert peak(values, places) == pytest.approx(3.0, rel=1e-6)
    assert peak(np.arange(1.0, 10.0), places) == pytest.approx(16.0)


def test_exponents_of_a_law_are_its_own():
    cells = [Cell(y, d, 3.0 * d**0.25 * y**-0.3, np.zeros((0, 3))) for y in (1.0, 7.0, 50.0) for d in (1e-6, 1e-5)]
    assert exponents(cells) == pytest.approx((0.25, -0.3))


def test_a_flat_sheet_has_no_face_turned_over_and_a_flipped_corner_has():
    mesh, points = sheet(4, 4)
    triangles = mesh.triangulate(points).triangles
    assert turned_over(points, triangles) == 0
    folded = points.copy()
    inner = int(np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1)))
    folded[inner, :2] += 0.12
    assert turned_over(folded, triangles) > 0


def test_sizes_are_the_papers_nearest():
    assert [step.size_of({"edges": edges}) for edges in (1008, 10208, 999_941)] == [1_000, 10_000, 1_000_000]


def test_versions_count_garments_that_were_solved_together_once():
    def entry(solve: float, crossings: int) -> dict[str, Any]:
        body = {"after": {"crossings": 2}}
        contact = {"bodies": {"/Body": body}, "cloth": {"after": {"crossings": crossings}}}
        energy = {"output": {"stretch": 1.0, "bending": 0.5}}
        return {"milliseconds": {"solve": solve}, "energy_joules": energy, "contact": contact}

    groups = versions.groups_of({"garments": [entry(1.0, 3), entry(1.0, 3), entry(2.0, 0), {"start": "reused"}]})
    assert [each["milliseconds"]["solve"] for each in groups] == [1.0, 2.0]
    assert [sum(versions.crossings_of(each["contact"])) for each in groups] == [5, 2]
    assert list(versions.crossings_of({"bodies": None, "cloth": None})) == []
    assert versions.Cost(90.0, 0.3, 0).over(versions.Cost(100.0, 0.2, 0)) == "0.900, 1.5000"
