"""The stability report: every case has its row, and a few are measured."""

from __future__ import annotations

from pathlib import Path

import pytest
import report
import report_contact as contact
import report_solver as solver
from report_solver import Result, under

from physgraph_usd.errors import SolveError


def test_every_case_of_the_list_has_a_row():
    assert [case.number for case in report.CASES] == list(range(1, 41))
    for case in report.CASES:
        measured = case.by_method is not None or case.once is not None
        assert measured != bool(case.left_out), case.number
        assert bool(case.bound) == measured, case.number


def test_rows_have_a_cell_for_each_method():
    names = ["one", "two"]
    case = report.Case(1, "title", "bound", lambda name: Result(name == "one", f"{name}!"))
    held, line = report.row(case, names)
    assert held == [True, False]
    assert line == "| S1 | title | bound | n/a | pass one! | **fail** two! |"
    left = report.row(report.Case(2, "title", "", left_out="later"), names)[1]
    once = report.row(report.Case(3, "title", "bound", once=lambda: Result(True, "fine")), names)[1]
    assert line.count("|") == left.count("|") == once.count("|")


@pytest.mark.parametrize("error", [SolveError("no"), RuntimeError("no"), ValueError("no")])
def test_an_error_is_a_failure(error: Exception):
    def measure() -> Result:
        raise error

    assert report.cell(measure) == (False, f"**fail** {type(error).__name__}")


def test_a_cell_that_is_known_is_not_measured_again(tmp_path: Path):
    file, calls = tmp_path / "cells.jsonl", []

    def measure() -> Result:
        calls.append(1)
        return Result(False, "bad")

    first = report.Cells(file).get(7, "one", measure)
    file.write_text(file.read_text() + '["S8 one", tr', encoding="utf-8")  # cut off
    assert report.Cells(file).get(7, "one", measure) == first == (False, "**fail** bad")
    assert len(calls) == 1
    report.Cells(file).get(7, "two", measure)
    assert len(calls) == 2


def test_nan_is_no_pass():
    assert not under(float("nan"), 1.0).held
    assert under(0.5, 1.0).held
    assert not under(2.0, 1.0).held


@pytest.mark.parametrize(
    "measure",
    [
        solver.s1_almost_nothing,
        solver.s3_needles,
        solver.s4_fins,
        solver.s17_pins,
        solver.s37_guard,
        contact.s23_on_the_surface,
        contact.s26_stacked,
        contact.s28_seams,
    ],
)
def test_the_default_passes(measure):
    result = measure("quasi-newton")
    assert result.held, result.figure
