"""Controls of the page of `tune`: painting, undo, titles and the wipe, in a browser."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pxr", reason="shots are read with usd-core")
pytest.importorskip("viser", reason="the page is served with viser")
pytest.importorskip("PIL.Image", reason="screenshots are compared with pillow")

from shots import CLOTH, cloth_shot
from test_tune_page import Artist, tuned

from physgraph_usd.studio.maps import stretches
from physgraph_usd.studio.session import TuneSession

pytestmark = [pytest.mark.browser, pytest.mark.slow]
CUT = """() => [...document.querySelectorAll('label, button, input, .mantine-Button-label')].filter(
    each => each.offsetParent && each.scrollWidth > each.clientWidth + 1 && each.clientWidth > 0
    && (each.innerText || each.value || '').trim()).map(each => each.innerText || each.value)"""
"""Texts of labels, buttons and boxes on the page that are wider than their place."""


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    return cloth_shot(tmp_path / "sheet.usda", size=(8, 6))


def cloth(session: TuneSession) -> np.ndarray:
    """The settled cloth [m], shape (V, 3)."""
    points = session.settle().garments[0].points
    assert points is not None
    return points


def click(artist: Artist, place: tuple[int, int]) -> None:
    """Click in the picture, later than a click before could make a double click of it."""
    artist.page.wait_for_timeout(500)
    artist.page.mouse.click(*place)


def test_undo_brings_back_the_cloth_of_the_step(shot: Path):
    """Bit for bit, and at once: solved anew from the present cloth, the cloth would end elsewhere."""
    with tuned(shot) as (session, artist):
        first = cloth(session)
        artist.type("Guide [N/m³]", "20")
        artist.settle("Guide Stiffness")
        second = cloth(session)
        assert not np.array_equal(first, second)
        artist.press("z")
        artist.page.get_by_role("button", name="Redo Guide Stiffness", exact=True).wait_for()
        artist.settle()
        assert np.array_equal(cloth(session), first)
        artist.press("Shift+Z")
        artist.settle("Guide Stiffness")
        assert np.array_equal(cloth(session), second)


def test_a_brush_says_its_size_its_value_and_why_it_changes_nothing(shot: Path):
    with tuned(shot) as (session, artist):
        artist.tab("Paint")
        size = 1e3 * float(np.linalg.norm(np.ptp(session.shot.frame(session.time).garments[0].points, axis=0)))
        radius = artist.page.locator("xpath=//label[normalize-space()='Radius [mm]']/following::*[@role='slider'][1]")
        least, most = (float(radius.get_attribute(f"aria-value{end}")) for end in ("min", "max"))
        assert (least, most) == (pytest.approx(0.005 * size, rel=0.05), pytest.approx(0.3 * size, rel=0.05))
        assert max(len(f"{each:g}") for each in (least, most)) <= 3
        artist.choose("Paint", "easeScale")
        artist.page.get_by_text("No effect yet: the map multiplies Weft Ease and Warp Ease, which are 0").wait_for()
        artist.tab("Values")
        artist.type("Weft Ease [%]", "4")
        artist.settle("Weft Ease")
        artist.tab("Paint")
        artist.until(lambda: artist.page.locator("#remark").count() == 0, "with ease the map has an effect")
        artist.choose("Paint", "pin")
        artist.page.get_by_role("button", name="Fill").click()
        artist.until(lambda: session.painted(CLOTH, "pin").min() == 1.0, "all is filled")
        artist.type("Value", "0.25")
        artist.page.get_by_role("button", name="Invert").click()
        artist.until(lambda: session.painted(CLOTH, "pin").max() == 0.0, "1 becomes 0.25 - 1, which is limited to 0")
        artist.page.get_by_role("button", name="Invert").click()
        artist.until(lambda: session.painted(CLOTH, "pin").min() == 0.25, "0 becomes 0.25")
        artist.settle("Pin")
        artist.choose("Brush", "read")
        artist.picture()
        click(artist, (520, 450))
        artist.page.get_by_text("pin under the brush: 0.25").wait_for()
        assert (session.painted(CLOTH, "pin") == 0.25).all()


def test_a_click_reads_the_map_that_is_drawn(shot: Path):
    with tuned(shot) as (session, artist):
        artist.tab("Picture")
        artist.choose("Map", "strain along weft")
        artist.page.locator("#bar").wait_for(state="attached")
        artist.picture()
        click(artist, (520, 450))
        said = artist.page.locator("#value")
        said.wait_for()
        name, _, value = said.inner_text().partition(" at the click: ")
        number, unit = value.split()
        shown = session.settle()
        strains = stretches(session.solver.refiner, shown.frame, 0, cloth(session))[:, 1]
        assert (name, unit) == ("strain along weft", "%")
        assert abs(strains - float(number)).min() < 1e-3 * abs(strains).max()
        artist.choose("Map", "none")
        artist.until(lambda: said.count() == 0, "the value goes with the map")


def test_a_gradient_is_painted_from_the_lowest_to_the_highest_vertex(shot: Path):
    with tuned(shot) as (session, artist):
        artist.tab("Paint")
        artist.choose("Paint", "bendScale")
        artist.type("Value", "5")
        artist.page.get_by_role("button", name="Gradient").click()
        artist.until(lambda: session.painted(CLOTH, "bendScale").max() > 1.0, "the map is painted")
        height = session.shot.frame(session.time).garments[0].points[:, 1]
        part = (height - height.min()) / np.ptp(height)
        assert session.painted(CLOTH, "bendScale") == pytest.approx(1.0 + 4.0 * part, rel=1e-5)


def test_no_title_is_cut(shot: Path):
    """At 1440 by 900 pixels, with a long name of a step beside undo."""
    with tuned(shot) as (_, artist):
        artist.type("Bending [µN·m]", "80")
        artist.settle("Bending Stiffness")
        artist.choose("Reset", "Bending Stiffness")
        artist.settle("Bending Stiffness as authored")
        cut: dict[str, Any] = {}
        for tab in ("Values", "Picture", "Paint", "Figures"):
            artist.tab(tab)
            artist.page.wait_for_timeout(300)
            cut[tab] = artist.page.evaluate(CUT)
        assert not any(cut.values()), cut


def test_the_wipe_leaves_the_floor_as_light_as_it_was(shot: Path):
    with tuned(shot) as (_, artist):
        artist.tab("Picture")

        def darkest() -> float:
            """Of the grey below the cloth."""
            picture = artist.picture()
            floor = picture[400:][np.ptp(picture[400:], axis=2) < 12.0]
            return float(np.percentile(floor, 1.0))

        artist.page.wait_for_timeout(1500)
        before = darkest()
        artist.choose("Show", "cage | refined")
        artist.number("Wipe").click()
        artist.settle()
        artist.page.wait_for_timeout(1500)
        assert darkest() > before - 10.0
