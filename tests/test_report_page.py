"""The report as a folder: a page with pictures, plots over time and words, beside the JSON."""

import html
import json
import math
import re
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from meshes import quads_of

pytest.importorskip("pxr", reason="shots are read with usd-core")

from browser import opened
from pxr import Gf, Usd, UsdGeom
from shots import CLOTH, EDGE, TIMES, cloth_shot, refine
from stages import add_mesh, author, save

from physgraph_usd.shot.page.worst import close_up, seconds_as_text, verdict
from physgraph_usd.shot.report import RefineReport
from physgraph_usd.usd.read.meshes import RefinedLayer
from physgraph_usd.usd.read.reader import open_shot


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, RefineReport]:
    """A shot with a frame that cannot be solved, its layer and report; the page lies in ``report``."""
    folder = tmp_path_factory.mktemp("page")
    shot = cloth_shot(folder / "sheet.usda", times=(*TIMES, 7.0, 8.0), broken={3.0: math.nan})
    return shot, folder / "fine.usdc", refine(shot, folder / "fine.usdc", report=folder / "report")


def text_of(made: tuple[Path, Path, RefineReport]) -> str:
    return (made[1].parent / "report" / "report.html").read_text(encoding="utf-8")


def test_a_folder_holds_the_page_and_the_same_json(made: tuple[Path, Path, RefineReport]):
    told = json.loads((made[1].parent / "report" / "report.json").read_text(encoding="utf-8"))
    assert told == json.loads(made[2].to_json())
    assert text_of(made).startswith("<!doctype html>")
    assert sorted(file.name for file in (made[1].parent / "report").iterdir()) == ["report.html", "report.json"]


def test_warnings_name_prim_and_time_code(made: tuple[Path, Path, RefineReport]):
    warnings = re.search(r"id='warnings'>(.*?)</ul>", text_of(made), re.S)
    assert warnings
    assert "time code 3" in warnings[1]
    assert f"&lt;{CLOTH}&gt;" in warnings[1]


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.0, "0 s"), (0.0234, "0.023 s"), (5.93, "5.9 s"), (284.0, "280 s"), (12345.0, "12,000 s")]
)
def test_durations_have_no_exponent(seconds: float, text: str):
    assert seconds_as_text(seconds) == text


def test_what_was_left_out_and_why(made: tuple[Path, Path, RefineReport]):
    text = text_of(made)
    for name, why in (made[2].modelled | made[2].left_out).items():
        assert f"<td>{name}</td>" in text
        assert html.escape(why) in text


def test_the_page_begins_with_a_verdict_and_ends_its_times_with_the_report(made: tuple[Path, Path, RefineReport]):
    text = text_of(made)
    assert re.search(
        r"</h1><p id='verdict'>1 of 8 frames could not be solved; 7 frames refined, nothing crosses, "
        r"[\d.,]+ s of wall time per frame",
        text,
    )
    assert f"<tr><td>report</td><td class=number>{made[2].seconds['report']:.2f}</td></tr>" in text
    assert made[2].seconds["total"] > made[2].seconds["frames"] + made[2].seconds["report"] > 0.0


def test_the_close_picture_is_of_cloth_in_a_body(tmp_path: Path):
    shot, layer = cloth_shot(tmp_path / "sheet.usda", times=(1.0, 2.0)), tmp_path / "fine.usdc"
    stage = Usd.Stage.Open(str(shot))
    corner = UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)).GetPointsAttr().Get(2.0)[0]
    ball = UsdGeom.Sphere.Define(stage, "/World/Ball")
    ball.CreateRadiusAttr(1.0)
    UsdGeom.XformCommonAPI(ball).SetTranslate(Gf.Vec3d(*map(float, corner)))
    stage.Save()
    report = refine(shot, layer, colliders=["/World/Ball"], contact="off", report=tmp_path / "report")
    with closing(open_shot(str(shot), garments=[CLOTH], colliders=["/World/Ball"])) as opened_shot:
        worst = close_up(report, opened_shot)
        assert worst is not None
        points = RefinedLayer(layer).points(opened_shot, 0, worst.time)
        centre = opened_shot.to_metres(0, worst.time)[:3, :3] @ np.asarray(corner, float)
    assert points is not None
    assert worst.path == CLOTH
    assert np.linalg.norm(points[worst.vertices[0]] - centre) < 2.0 * EDGE  # The radius and a fine edge's length.
    title, _, fault = worst.caption.partition(": ")
    assert title == "The worst place"
    assert "inside bodies" in fault
    assert verdict(report).startswith(fault.partition(" edges")[0].partition(" vertices")[0])


@pytest.mark.parametrize("seam", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_where_nothing_is_wrong_the_close_picture_is_of_the_best_fold(stage: Usd.Stage, tmp_path: Path, seam: bool):
    """Two strips, one longer than its cage by ease: where it folds is the best fold, not at a crease of the cage."""
    cells, edge = 12, 0.02
    x, y = np.meshgrid(np.arange(cells + 1.0), np.arange(cells + 1.0))
    flat = edge * np.stack([x, y, 0.0 * x], axis=-1).reshape(-1, 3)
    quads = quads_of(cells + 1, cells + 1)
    creased = flat * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.0] * np.abs(flat[:, :1] - edge * cells / 2)
    for name, points, ease in (("creased", creased + np.array([1.0, 0.0, 0.0]), 0.0), ("eased", flat, 5.0)):
        apart = points, quads
        if seam:
            parts = [quads[quads[:, 0] % (cells + 1) < cells // 2], quads[quads[:, 0] % (cells + 1) >= cells // 2]]
            apart = np.concatenate([points, points]), np.concatenate([parts[0], parts[1] + len(points)])
        mesh = add_mesh(stage, f"/World/{name}", *apart)
        author(mesh.GetPrim(), "physgraph:rest:weftEase", ease)
    shot, layer = Path(save(stage)), tmp_path / "fine.usdc"
    report = refine(shot, layer, level=2, steps=6, report=tmp_path / "report")
    with closing(open_shot(str(shot))) as opened_shot:
        close = close_up(report, opened_shot)
    assert close is not None
    assert (close.path, close.caption) == ("/World/eased", "The best fold")
    assert "<figcaption>The best fold</figcaption>" in (tmp_path / "report" / "report.html").read_text(encoding="utf-8")


@pytest.mark.browser
def test_the_page_in_a_browser(made: tuple[Path, Path, RefineReport]):
    with opened(made[1].parent / "report" / "report.html") as shown:
        plots = shown.locator("svg.plot")
        assert plots.count() >= 4
        box = shown.locator("#energy-0").bounding_box()
        shown.locator("#energy-0").hover(position={"x": 0.999 * box["width"], "y": 0.5 * box["height"]})
        said = shown.locator("[data-of='energy-0']").text_content()
        entry = made[2].frames[-1]["garments"][0]["energy_joules"]["output"]
        assert "time code 8" in said
        assert f"bending {1e3 * entry['bending']:.4g}" in said
        assert shown.locator("#energy-0 .cursor").evaluate("line => line.style.visibility") == "visible"
