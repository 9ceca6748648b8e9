"""The page of `tune`, driven in a browser as an artist drives it."""

import io
import time
from base64 import b64decode
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pxr", reason="shots are read with usd-core")
pytest.importorskip("viser", reason="the page is served with viser")
pytest.importorskip("PIL.Image", reason="screenshots are compared with pillow")

import viser
from browser import PATIENCE_MS, served
from PIL import Image
from pxr import Usd
from shots import CLOTH, cloth_shot
from stages import add_subset

from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.studio.page import TunePage
from physgraph_usd.studio.picture import partly_on_side
from physgraph_usd.studio.session import TuneSession
from physgraph_usd.studio.skins import LOADED_SECONDS, Placed, Skins
from physgraph_usd.studio.value_panel import CHANGED, SWATCHES
from physgraph_usd.studio.values import TUNABLES
from physgraph_usd.usd.read.reader import open_shot

pytestmark = pytest.mark.browser
SETTLED = "settled: as refine solves it"
POLL_MS = 50
FRAMES = "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
"""Waits until the browser has drawn twice: once may be under way."""
EMPTY = (60, 850)
"""A place of the picture without cloth."""


class Artist:
    """Hands on a page."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.settle()

    def until(self, happened: Callable[[], Any], what: str) -> Any:
        """Wait until something has happened; returns what it gives."""
        end = time.monotonic() + 1e-3 * PATIENCE_MS
        while not (found := happened()):
            assert time.monotonic() < end, f"never: {what}"
            self.page.wait_for_timeout(POLL_MS)
        return found

    def settle(self, undone: str = "") -> None:
        """Wait until cloth is settled, after the change that undo would take back.

        Without a change the page may still say so of what was before: wait for the session, too.
        """
        if undone:
            self.page.get_by_role("button", name=f"Undo {undone}", exact=True).wait_for()
        self.page.get_by_text(SETTLED).wait_for()

    def whole(self) -> np.ndarray:
        """The picture without the controls, as it is now: sRGB, shape (900, 1000, 3)."""
        self.page.evaluate(FRAMES)
        return np.asarray(Image.open(io.BytesIO(self.page.screenshot())).convert("RGB"), float)[:, :1000]

    def picture(self, holds: Callable[[np.ndarray], object] = lambda _: True) -> np.ndarray:
        """The lower part of the picture, once something holds of it and it stands still: twice the same in a row."""
        last = np.zeros(0)

        def found() -> list[np.ndarray]:
            nonlocal last
            now = self.whole()[250:]
            stands, last = np.array_equal(now, last), now
            return [now] if stands and holds(now) else []

        return self.until(found, "the picture stands still, and shows what is waited for")[0]

    def tab(self, name: str) -> None:
        self.page.get_by_role("tab", name=name).click()

    def number(self, title: str) -> Any:
        """The input box behind a label."""
        label = f"//label[normalize-space(translate(., '{CHANGED}', ''))='{title}']"
        return self.page.locator(f"xpath={label}/following::input[not(@type='hidden')][1]")

    def shows(self, title: str, value: float | None) -> bool:
        """Whether a number box shows a value."""
        return float(self.number(title).input_value()) == pytest.approx(value, rel=0.01)

    def type(self, title: str, number: str) -> None:
        self.number(title).fill(number)
        self.number(title).press("Enter")

    def choose(self, title: str, option: str) -> None:
        self.number(title).click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def press(self, key: str) -> None:
        """Press a key with the pointer in the picture."""
        self.page.mouse.click(*EMPTY)
        self.page.keyboard.press(key)

    def begin_stroke(self, row: float) -> None:
        """Drag across the middle of the picture, and hold the mouse button."""
        mouse = self.page.mouse
        mouse.move(460, row)
        mouse.down()
        for step in range(20):
            mouse.move(460 + 5 * step, row)
            self.page.evaluate(FRAMES)

    def slide(self, title: str, place: float) -> float:
        """Drag a slider to a place, 0 to 1; returns the place where its thumb is let go."""
        thumb = self.number(title).locator("xpath=following::*[@role='slider'][1]")
        thumb.scroll_into_view_if_needed()
        track = thumb.locator("xpath=ancestor::*[contains(@class, 'Slider-track')][1]").bounding_box()
        box, mouse = thumb.bounding_box(), self.page.mouse
        mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        mouse.down()
        mouse.move(track["x"] + place * track["width"], box["y"] + box["height"] / 2, steps=5)
        mouse.up()
        self.page.evaluate(FRAMES)  # The thumb is drawn at its last place a little later.
        return float(thumb.get_attribute("aria-valuenow"))


def colored(picture: np.ndarray) -> np.ndarray:
    """Whether each pixel of a picture has more colour than the grey of bodies, ground and background."""
    return np.ptp(picture[:, 310:], axis=2) > 15.0  # Beside the viewer's notes.


def labelled(picture: np.ndarray) -> np.ndarray:
    """Whether each pixel of a picture is white, as the labels' ground alone is."""
    return picture.min(axis=2) > 250.0


def rows_of(pixels: np.ndarray) -> int:
    """Height of the part of a picture that holds some pixels, shape (H, W), without stray ones."""
    rows = np.flatnonzero(pixels.sum(axis=1) > 2)
    return int(np.ptp(rows)) + 1 if len(rows) else 0


def assert_no_yellow(picture: np.ndarray) -> None:
    """Nothing of a picture has the colour of viser's outlines."""
    red, green, blue = np.moveaxis(picture, 2, 0)
    assert ((np.minimum(red, green) - blue)[:, 310:] < 60.0).all()


def middle_of(picture: np.ndarray) -> np.ndarray:
    """Column and row of the middle of a picture's black pixels, those of the rings."""
    rows, columns = np.nonzero(picture[:, 310:].max(axis=2) < 60.0)
    return 0.5 * np.array([620 + columns.min() + columns.max(), rows.min() + rows.max()]) if len(rows) else np.zeros(2)


@contextmanager
def tuned(shot: Path, **options: Any) -> Iterator[tuple[TuneSession, Artist]]:
    """A session of a shot, its page, and an artist at it."""
    with closing(TuneSession(shot, garments=[CLOTH], **options)) as session, closing(TunePage(session)) as page:
        with served(page.url) as shown:
            yield session, Artist(shown)


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    return cloth_shot(tmp_path / "sheet.usda", size=(8, 6))


def test_values_are_slid_typed_undone_and_saved(shot: Path):
    stage = Usd.Stage.Open(str(shot))
    add_subset(stage, "trim", np.arange(8), bendStiffness=1e-4)
    stage.Save()
    with tuned(shot) as (session, artist):
        artist.page.get_by_text(f"<{CLOTH}/trim>: 8 faces of another fabric: bendStiffness times").wait_for()
        before = artist.picture()
        slid = TUNABLES["guide:stiffness"].at(artist.slide("Guide [N/m³]", 0.2))
        assert slid < 300.0
        arrived = "the last place of the drag is the session's value, and the box shows it"
        artist.until(lambda: session.value(CLOTH, "guide:stiffness") == pytest.approx(slid), arrived)
        artist.settle("Guide Stiffness")
        artist.until(lambda: artist.shows("Guide [N/m³]", slid), arrived)
        artist.picture(lambda now: np.abs(now - before).mean() > 0.1)
        artist.type("Bending [µN·m]", "80")
        artist.settle("Bending Stiffness")
        assert session.value(CLOTH, "bendStiffness") == pytest.approx(8e-5)
        artist.press("z")
        artist.settle("Guide Stiffness")
        assert session.value(CLOTH, "bendStiffness") != pytest.approx(8e-5)
        artist.press("Shift+Z")
        artist.settle("Bending Stiffness")
        artist.number("Density [g/m²]").hover()
        artist.page.get_by_text("hangs more heavily").wait_for()
        artist.choose("Reset", "Guide Stiffness")
        artist.settle("Guide Stiffness as authored")
        assert session.value(CLOTH, "guide:stiffness") == 2000.0
        save = artist.page.get_by_role("button", name="Save layer")
        assert save.bounding_box()["y"] < 850
        save.click()
        artist.page.get_by_text("saved bendStiffness into").wait_for()
        stage = Usd.Stage.Open(str(session.out))
        prim = stage.GetPrimAtPath(CLOTH)
        assert prim.GetAttribute("physgraph:material:bendStiffness").Get() == pytest.approx(8e-5)
        assert not prim.GetAttribute("physgraph:guide:stiffness").HasAuthoredValue()


def test_the_first_view_is_filled_with_cloth_and_framed_again_by_key_and_double_click(shot: Path):
    with tuned(shot) as (_, artist):
        artist.picture()
        high = rows_of(colored(artist.whole()))
        assert high >= 0.45 * 900
        mouse = artist.page.mouse
        for frame in (lambda: artist.press("f"), lambda: mouse.dblclick(*EMPTY)):
            mouse.move(500, 450)
            mouse.wheel(0, 1500)
            artist.until(lambda: rows_of(colored(artist.whole())) < 0.7 * high, "the cloth is small")
            artist.page.wait_for_timeout(500)  # Longer than a double click: the next click is no second one.
            frame()
            artist.until(lambda: abs(rows_of(colored(artist.whole())) - high) < 0.03 * high, "cloth fills the view")


@pytest.mark.slow
def test_presets_camera_and_frame_outlive_a_restart(shot: Path):
    with tuned(shot) as (session, artist):
        artist.type("Bending [µN·m]", "80")
        artist.settle("Bending Stiffness")
        artist.type("Name", "stiff")
        artist.page.get_by_role("button", name="Keep as preset").click()
        straight = artist.picture()
        mouse = artist.page.mouse
        mouse.move(*EMPTY)
        mouse.down()
        mouse.move(300, 700, steps=5)
        mouse.up()
        artist.picture(lambda now: np.abs(now - straight).mean() > 1.0)
        artist.press("l")
        artist.until(lambda: session.time != session.times[0], "the next frame")
        artist.settle()
        turned, frame = artist.picture(), session.time
    with tuned(shot) as (session, artist):
        assert session.time == frame
        assert session.value(CLOTH, "bendStiffness") != pytest.approx(8e-5)
        artist.choose("Preset", "own: stiff")
        artist.settle("own: stiff")
        assert session.value(CLOTH, "bendStiffness") == pytest.approx(8e-5)
        artist.picture(lambda now: np.abs(now - turned).mean() < 3.0)
        other = artist.page.context.browser.new_page(viewport=artist.page.viewport_size)
        other.goto(artist.page.url)
        artist.page.close()
        again = Artist(other)
        again.until(lambda: again.shows("Bending [µN·m]", 80.0), "the box of another page shows the value")
        again.picture(lambda now: np.abs(now - turned).mean() < 3.0)


@pytest.mark.slow
def test_the_picture_wipes_maps_wires_and_compares(shot: Path):
    with tuned(shot) as (session, artist):
        artist.tab("Picture")
        artist.choose("Show", "cage | refined")
        side_by_side = artist.picture()
        artist.number("Wipe").click()
        wiped = artist.picture(lambda now: np.abs(now - side_by_side).mean() > 1.0)
        artist.press("g")
        wired = artist.picture(lambda now: np.abs(now - wiped).mean() > 0.3)
        assert artist.number("Wireframe").is_checked()
        artist.press("g")
        plain = artist.picture(lambda now: np.abs(now - wired).mean() > 0.3)
        assert not artist.number("Wireframe").is_checked()
        artist.choose("Map", "strain along weft")
        artist.page.locator("#bar").wait_for()
        artist.picture(lambda now: np.abs(now - plain).mean() > 0.3)
        artist.choose("Map", "none")
        artist.number("Wipe").click()
        artist.press("k")
        artist.tab("Values")
        artist.type("Guide [N/m³]", "50")
        artist.settle("Guide Stiffness")
        artist.press("x")
        artist.settle("A and B exchanged")
        assert session.value(CLOTH, "guide:stiffness") == 2000.0


def test_cloth_that_moves_and_rests_again_leaves_no_nodes_in_the_scene():
    points, triangles = np.random.default_rng(1).random((30, 3), np.float32), np.arange(30).reshape(10, 3)
    server, axes, counts = viser.ViserServer(host="127.0.0.1", port=8300, verbose=False), np.eye(3), list[int]()
    with ExitStack() as end:
        end.callback(server.stop)
        skins = Skins(server, axes)
        for step in range(4):
            moved = points + np.float32(step)
            skins.place("refined/0", Placed(moved, triangles, whole=triangles, color=np.ones(3)))
            skins.shade([["refined/0"]], lambda: False, grounds=1)
            time.sleep(2 * LOADED_SECONDS)
            counts.append(len(server.scene._handle_from_node_name))
    assert counts == [counts[0]] * 4


def test_a_picture_of_each_preset_chooses_it(shot: Path):
    with tuned(shot) as (session, artist):
        for name in PRESETS:
            button = artist.page.get_by_role("button", name=name, exact=True)
            url = button.evaluate("drawn => getComputedStyle(drawn).backgroundImage")
            picture = b64decode(url.partition("base64,")[2].partition('"')[0])
            assert picture == (SWATCHES / f"{name}.webp").read_bytes()
            box = button.bounding_box()
            assert 48 < box["width"] < 70
            assert 48 < box["height"]
        artist.page.get_by_role("button", name="denim", exact=True).click()
        artist.settle("denim")
        assert session.value(CLOTH, "weftStretchStiffness") == 226.0
        assert artist.number("Preset").input_value() == "denim"


def test_a_and_b_stand_side_by_side_under_their_letters(shot: Path):
    with tuned(shot) as (session, artist):
        artist.tab("Picture")
        assert not labelled(artist.picture()).any()
        artist.choose("Show", "A | B")
        artist.until(lambda: session.kept is not None, "choosing A | B keeps A")
        artist.tab("Values")
        artist.type("Guide [N/m³]", "50")
        artist.settle("Guide Stiffness")
        picture = artist.picture()
        cloth = np.ptp(picture, axis=2) > 12.0
        across, letters = (np.flatnonzero(each.sum(axis=0) > 2) for each in (cloth, labelled(picture)))
        (gap,) = np.flatnonzero(np.diff(across) > 8)
        left, right = across[: gap + 1], across[gap + 1 :]
        a, b = letters[letters < right[0]], letters[letters > left[-1]]
        assert left[0] < a[0] < a[-1] < left[-1], "a letter over A"
        assert right[0] < b[0] < b[-1] < right[-1], "a letter over B"
        lowest = [np.flatnonzero(cloth[:, side].any(axis=1)).max() for side in (left, right)]
        assert lowest[1] > lowest[0] + 8, "B hangs lower, A is as it was"
        artist.tab("Picture")
        artist.choose("Show", "refined")
        artist.picture(lambda now: not labelled(now).any())


@pytest.mark.slow
def test_a_map_is_painted_with_the_mouse_and_saved(shot: Path):
    with tuned(shot) as (session, artist):
        for tab in ("Picture", "Paint"):
            artist.tab(tab)
        artist.choose("Paint", "pin")
        artist.page.locator("#bar").wait_for(state="attached")  # The map is drawn, and with it what the brush meets.
        artist.picture()
        assert abs(middle_of(artist.whole()) - [520, 450]).max() < 30, "the rings wait in the middle of the cloth"
        mouse, up = artist.page.mouse, session.shot.frame(session.time).garments[0].points @ [0.0, 1.0, 0.0]
        for row in (330, 560):  # The second while the cloth still settles.
            artist.begin_stroke(row)
            assert_no_yellow(artist.whole())
            artist.until(lambda row=row: abs(middle_of(artist.whole()) - [555, row]).max() < 15, "the rings follow")
            mouse.up()
        assert_no_yellow(artist.whole())

        def height() -> float:
            held = session.painted(CLOTH, "pin") > 0.3
            return float(np.ptp(up[held])) if held.any() else 0.0

        artist.until(lambda: height() > 0.25 * np.ptp(up), "both strokes are in the map")
        artist.settle("Pin")
        was = height()
        artist.page.keyboard.down("Control")
        artist.begin_stroke(330)
        mouse.up()
        artist.page.keyboard.up("Control")
        artist.until(lambda: height() < 0.8 * was, "what is dragged over with ctrl is erased")
        artist.settle("Pin")
        held = session.painted(CLOTH, "pin")
        assert 0 < (held > 0.3).sum() < len(held) // 2
        artist.page.get_by_role("button", name="Save layer").click()
        artist.page.get_by_text("saved pin into").wait_for()
        with closing(open_shot(str(session.out))) as saved:
            assert saved.scene.garments[0].pin == pytest.approx(held)
        artist.choose("Paint", "off")
        for _ in range(3):
            artist.press("z")
        artist.page.get_by_role("button", name="Redo Pin", exact=True).wait_for()
        artist.until(lambda: session.painted(CLOTH, "pin").max() == 0.0, "all strokes are undone")


def test_a_wipe_leaves_no_gap():
    """Wherever the line stands, the faces of each side cover all of that side."""
    across, faces = np.tile(np.arange(5.0), 3), np.array([[n, n + 1, n + 6] for n in (0, 1, 2, 3, 5, 6, 7, 8)])
    for line in (-1.0, 1.3, 2.0, 9.0):
        left, right = (partly_on_side(across - line, faces, left=side) for side in (True, False))
        assert len(left) == (across[faces].min(axis=1) < line).sum()
        assert len(right) == (across[faces].max(axis=1) >= line).sum()
