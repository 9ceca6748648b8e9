"""The chart: gaps against a reference, times, resuming, and the files that come of it."""

import csv
import json
import math
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pxr", reason="charts read stages with usd-core")
pytest.importorskip("matplotlib", reason="charts are drawn with matplotlib")
pytest.importorskip("plotly", reason="charts are drawn with plotly")

from browser import hover, opened
from click.testing import CliRunner
from PIL import Image
from pxr import Usd, UsdGeom
from shots import cloth_shot, refine

from physgraph_usd import cli
from physgraph_usd.errors import UsageError
from physgraph_usd.lab.chart.journal import Journal
from physgraph_usd.lab.chart.measure import DEFAULT, SMOOTH, UPSAMPLED
from physgraph_usd.lab.chart.options import ChartOptions
from physgraph_usd.lab.chart.peers.run import PEERS, Peer, parse_peers
from physgraph_usd.lab.chart.run import chart_shot
from physgraph_usd.lab.chart.table import Chart
from physgraph_usd.lab.chart.words import settings

ECHO = """
import sys
import numpy as np
problem = np.load(sys.argv[1])
x = problem[f"base{int(problem['levels']) - 1}"]
ms = np.array([5.0, 5.0])
np.savez(sys.argv[2], x_0_1=x, ms_0_1=ms, x_1_1=x, ms_1_1=ms)
"""
"""A solver outside that does nothing."""

OPTIONS = ChartOptions(
    level=1, methods=("quasi-newton", "gd"), colliders=("/World/ball",), count=1, repeats=2, budget_minutes=0.5
)
QUICK = replace(OPTIONS, budget_minutes=0.02)


def shot_with_ball(path: Path) -> Path:
    """A waving sheet with a ball in it."""
    shot = cloth_shot(path, size=(8, 6))
    stage = Usd.Stage.Open(str(shot))
    points = UsdGeom.Mesh.Get(stage, "/World/cloth").GetPointsAttr().Get(6.0)
    ball = UsdGeom.Sphere.Define(stage, "/World/ball")
    ball.GetRadiusAttr().Set(1.5)
    ball.AddTranslateOp().Set(tuple(float(sum(p[axis] for p in points)) / len(points) for axis in range(3)))
    stage.Save()
    return shot


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Chart]:
    """A shot, its chart's folder and the chart, continued until all terms are measured, as on a busy machine."""
    folder = tmp_path_factory.mktemp("chart")
    shot = shot_with_ball(folder / "sheet.usda")
    chart = chart_shot(shot, folder / "out", OPTIONS)
    while "warm" not in {row["term"] for row in chart.terms}:
        chart = chart_shot(shot, folder / "out", OPTIONS)
    return shot, folder / "out", chart


@pytest.mark.slow
def test_gaps_lie_between_the_reference_and_plain_upsampling(made: tuple[Path, Path, Chart]):
    chart = made[2]
    assert chart.curve(UPSAMPLED)[0].gap == pytest.approx(1.0)
    assert all(p.gap >= -1e-12 for p in chart.points)
    assert chart.curve("quasi-newton")[-1].gap < 0.2 < chart.curve("gd")[0].gap
    default, plain = chart.curve(DEFAULT)[0].degrees, chart.curve(UPSAMPLED)[0].degrees
    assert default is not None
    assert plain is not None
    assert 0.0 < default < plain < 90.0
    assert chart.words_of_degrees() in list(chart.lines())
    assert f"within {default:.2g} degrees of the converged frame" in chart.words_of_degrees()
    assert set(chart.methods) >= {DEFAULT, UPSAMPLED, SMOOTH, "quasi-newton", "gd", "gd, nested"}


@pytest.mark.slow
def test_page_and_summary_name_who_found_the_least_and_how_far_the_next_one_is(made: tuple[Path, Path, Chart]):
    _, folder, chart = made
    [known] = chart.references
    assert known["apart"] >= 0.0
    assert any(known["by"] in line and f"ends {known['apart']:.2%} of the fall above" in line for line in chart.lines())
    assert f"{known['apart']:.2%}" in (folder / "chart.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_default_is_judged_as_refine_reports_it(made: tuple[Path, Path, Chart], tmp_path: Path):
    shot, _, chart = made
    report = refine(
        shot, tmp_path / "fine.usdc", level=1, steps=12, temporal="off", frames=(6.0, 6.0), colliders=["/World/ball"]
    )
    [garment] = report.frames[0]["garments"]
    (own,) = chart.curve(DEFAULT)
    told = garment["energy_joules"]["output"]
    for name in ("stretch", "bending", "guide"):
        assert own.energies[name] == pytest.approx(told[name], rel=1e-3)
    after = garment["contact"]["bodies"]["/World/ball"]["after"]
    assert (own.inside, own.crossings) == (after["inside"], after["crossings"])
    assert chart.curve(UPSAMPLED)[0].inside > 0


@pytest.mark.slow
def test_terms_tell_what_is_worse_without_them(made: tuple[Path, Path, Chart]):
    rows = {row["term"]: row for row in made[2].terms}
    assert rows["contact"]["without"]["inside"] > rows["contact"]["with"]["inside"]
    assert rows["level 0"]["without"]["energy"] > rows["level 1"]["without"]["energy"]
    assert rows["level 1"]["moved_mm"] == 0.0
    assert min(rows["tether"][which]["jerk"] for which in ("with", "without")) > 0.0
    assert {"gravity", "bending", "guide", "warm"} <= set(rows)


@pytest.mark.slow
def test_the_files(made: tuple[Path, Path, Chart]):
    _, folder, chart = made
    with (folder / "chart.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0][0] == "method"
    assert len(rows) == len(chart.points) + 1
    told = json.loads((folder / "chart.json").read_text(encoding="utf-8"))
    assert told["default"] == chart.default_place()
    assert len(told["points"]) == len(chart.points)
    with Image.open(folder / "chart.png") as picture:
        assert picture.width > 800
    assert (folder / "chart.svg").read_text(encoding="utf-8").count("<text") > 20


@pytest.mark.slow
def test_an_interrupted_run_goes_on(made: tuple[Path, Path, Chart], tmp_path: Path):
    shot, folder, chart = made
    whole = (folder / "chart.rows.jsonl").read_text(encoding="utf-8")
    out = shot.parent / "cut"
    out.mkdir()
    (out / "chart.rows.jsonl").write_text(whole[: 4 * len(whole) // 5], encoding="utf-8")
    again = chart_shot(shot, out, QUICK)
    energies, known = ({(p.method, p.steps): p.energy for p in each.points} for each in (again, chart))
    both = energies.keys() & known.keys()
    assert len(both) > 5
    assert {key: energies[key] for key in both} == {key: known[key] for key in both}


@pytest.mark.slow
def test_another_shot_in_the_same_folder_is_refused(made: tuple[Path, Path, Chart]):
    shot, folder, _ = made
    with pytest.raises(UsageError, match="another shot or of other options"):
        chart_shot(shot, folder, replace(OPTIONS, level=0))


@pytest.mark.browser
@pytest.mark.slow
def test_the_page_in_a_browser(made: tuple[Path, Path, Chart]):
    _, folder, chart = made
    with opened(folder / "chart.html") as page:
        page.locator("#curves .scatterlayer .trace").first.wait_for()
        panels = 1 + len({**chart.seen, **chart.panels, **chart.likeness})
        beside = 1 + len({each.method for each in chart.warm})
        curves = page.locator("#curves .scatterlayer .trace")
        assert page.locator("#methods button").count() == len(chart.methods)
        assert curves.count() == panels * len(chart.methods) + beside
        index = chart.methods.index("gd, nested")
        said = hover(page, curves.nth(1 + index).locator(".points path").nth(1))
        own = chart.curve("gd, nested")[1]
        assert f"gd, nested, {own.steps} steps there" in said
        assert f"{own.ms:.1f} ms a frame" in said
        page.locator("#methods button").nth(index).click()
        left = panels * (len(chart.methods) - 1) + beside
        page.wait_for_function(f"document.querySelectorAll('#curves .scatterlayer .trace').length == {left}")
        assert "contact" in page.locator("#terms").text_content()


@pytest.mark.parametrize("changes", [{"count": 0}, {"budget_minutes": -1.0}, {"device": "tpu"}, {"clock": "sun"}])
def test_wrong_options_are_refused(changes: dict[str, Any]):
    with pytest.raises(UsageError):
        replace(ChartOptions(), **changes).check()


def test_a_line_that_was_cut_off_is_dropped(tmp_path: Path):
    journal = Journal(tmp_path, {"shot": "a"}, overwrite=False)
    journal.add("point", method="a", ms=1.0)
    file = tmp_path / "chart.rows.jsonl"
    file.write_text(file.read_text(encoding="utf-8") + '{"row": "poi', encoding="utf-8")
    again = Journal(tmp_path, {"shot": "a"}, overwrite=False)
    again.add("point", method="b", ms=math.pi)
    assert [row["method"] for row in Journal(tmp_path, {"shot": "a"}, overwrite=False).rows("point")] == ["a", "b"]


@pytest.mark.parametrize("line", [b"{", b"[1]", b"\xff", b'{"row": "moon"}', b"[" * 100_000])
def test_a_damaged_row_is_named(tmp_path: Path, line: bytes):
    Journal(tmp_path, {"shot": "a"}, overwrite=False).add("point", method="a")
    file = tmp_path / "chart.rows.jsonl"
    file.write_bytes(file.read_bytes() + line + b"\n")
    with pytest.raises(UsageError, match=r"chart\.rows\.jsonl, line 3"):
        Journal(tmp_path, {"shot": "a"}, overwrite=False)
    assert Journal(tmp_path, {"shot": "a"}, overwrite=True).rows("point") == []


@pytest.mark.slow
def test_a_solver_outside_is_measured_by_the_same_ruler(
    made: tuple[Path, Path, Chart], tmp_path: Path, monkeypatch: Any
):
    """A peer that hands back the plain upsampling has a gap of 1."""
    adapter = tmp_path / "echo.py"
    adapter.write_text(ECHO, encoding="utf-8")
    monkeypatch.setitem(PEERS, "echo", Peer("Echo", str(adapter), "nothing of the problem"))
    shot = made[0]
    options = replace(QUICK, methods=("gd",), peers=(f"echo={sys.executable}",))
    chart = chart_shot(shot, tmp_path / "out", options)
    assert [(p.steps, p.nested, p.repeats) for p in chart.curve("Echo, nested")] == [(1, True, 2)]
    assert chart.curve("Echo")[0].gap == pytest.approx(1.0, abs=1e-6)
    assert chart.curve("Echo")[0].ms == 5.0
    assert "nothing of the problem" in settings(chart.curve("Echo")[0])
    assert chart.curve("Echo")[0].apart_mm == pytest.approx(chart.curve(UPSAMPLED)[0].apart_mm, abs=1e-4)
    assert "Echo was given nothing of the problem" in list(chart.lines())
    assert set(chart.likeness) == {"strain", "apart_mm"}
    assert "was given" in (tmp_path / "out" / "chart.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_solver_outside_that_fails_is_told(made: tuple[Path, Path, Chart], tmp_path: Path, monkeypatch: Any):
    adapter = tmp_path / "broken.py"
    adapter.write_text("raise SystemExit('out of luck')", encoding="utf-8")
    monkeypatch.setitem(PEERS, "broken", Peer("Broken", str(adapter), ""))
    options = replace(QUICK, methods=("gd",), peers=(f"broken={sys.executable}",))
    chart = chart_shot(made[0], tmp_path / "out", options)
    assert [row["error"] for row in chart.failed] == ["Broken ended with code 1: out of luck"]


@pytest.mark.parametrize("given", ["nobody=python", "newton", "newton=no/such/python"])
def test_wrong_peers_are_refused(given: str):
    with pytest.raises(UsageError, match="peer"):
        parse_peers([given])


@pytest.mark.slow
def test_the_command_prints_a_summary_and_tells_progress(made: tuple[Path, Path, Chart], tmp_path: Path):
    shot, folder, _ = made
    shutil.copytree(folder, tmp_path / "out")
    line = "--level 1 --method quasi-newton --method gd --collider /World/ball --budget-minutes 0.02".split()
    result = CliRunner().invoke(cli.main, ["chart", str(shot), "-o", str(tmp_path / "out"), *line])
    assert result.exit_code == 0, result.stderr
    assert result.stdout.startswith("| method | ms to 10% | ms to 3% | ms to 1% | least gap | degrees | at ms |")
    assert "refine's default: " in result.stdout
    assert "left" in result.stderr


@pytest.mark.parametrize("missing", ["matplotlib", "plotly"])
def test_a_missing_library_is_told_with_its_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, missing: str):
    for name in [name for name in sys.modules if name.startswith("physgraph_usd.lab.chart")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, missing, None)
    shot = tmp_path / "shot.usda"
    shot.touch()
    result = CliRunner().invoke(cli.main, ["chart", str(shot), "-o", str(tmp_path / "out")])
    assert result.exit_code == 1
    assert result.stderr == f"error: {missing} is not installed: pip install {missing}\n"
