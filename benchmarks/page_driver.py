"""The page of `tune` in a headless browser: how long it takes from a press on a slider, its pictures and its film."""

from __future__ import annotations

import io
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from playwright import sync_api

from physgraph_usd.studio.value_panel import CHANGED
from physgraph_usd.studio.values import Tunable

NAMES = ("chromium", "chromium-browser", "google-chrome")
DRAWN = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
"""Drawn by the processor: there may be no graphics card."""
LABEL = f"//label[normalize-space(translate(., '{CHANGED}', ''))='{{}}']"
SETTLED = "settled: as refine solves it"
CALM_MS = 1000
"""How long the page is left alone before a move: pictures that are still drawn would hold the mouse up."""
PATIENCE_MS = 120000
SMALL, RATE, COLORS = (1080, 675), 5, 200
"""A picture's size [pixels], pictures a second of the film, and colours in a picture."""
PART = 12
"""Solved frames in the picture of a range."""
WATCH = """
window.least = Infinity;
window.begin = () => { window.pressed = window.drawn = window.settled = null; window.left = false };
window.begin();
for (const name of ['bufferData', 'bufferSubData']) {
  const own = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...given) {
    const data = given[name === 'bufferData' ? 1 : 2];
    const bytes = (data && data.byteLength) || 0;
    if (bytes >= window.least && window.pressed && !window.drawn) window.drawn = performance.now();
    return own.apply(this, given);
  };
}
addEventListener('pointerdown', () => { window.pressed = performance.now() }, true);
new MutationObserver(() => {
  const state = document.querySelector('#state');
  if (!state || !window.pressed) return;
  const settled = state.textContent.startsWith('settled');
  if (!settled) window.left = true;
  if (settled && window.left) window.settled = performance.now();
}).observe(document, {subtree: true, childList: true, characterData: true});
"""
"""Notes when the mouse goes down, when vertices of the cloth's number go to the graphics card, and when it settles."""


@contextmanager
def opened(url: str, *, vertices: int) -> Iterator[Any]:
    """The page once its first frame has settled; ``vertices`` is the least number that counts as the cloth's.

    Raises:
        FileNotFoundError: There is no browser.
    """
    program = next((found for name in NAMES if (found := shutil.which(name))), None)
    if program is None:
        raise FileNotFoundError(f"no browser: none of {', '.join(NAMES)} is on the path")
    with sync_api.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=DRAWN)
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        page.add_init_script(WATCH)
        page.goto(url)
        page.get_by_text(SETTLED).wait_for(timeout=PATIENCE_MS)
        page.evaluate(f"window.least = {12 * vertices}")  # Three floats each.
        yield page
        browser.close()


class Tour:
    """An artist's way through the page, with a picture of each thing that it can do.

    Attributes:
        film: Every picture on the way.
    """

    def __init__(self, page: Any) -> None:
        """Begin on the page of a session."""
        self._page = page
        self.film: list[Image.Image] = []

    def go(self, folder: Path) -> None:
        """Go all the way; writes the pictures of docs into a folder."""
        self._page.locator(".mantine-Notification-closeButton").first.click()
        self._page.wait_for_timeout(1000)
        self._hold(3)
        for place in np.linspace(0.1, 0.75, 8):
            self._slide("Weft Ease [%]", float(place))
        self._settle(folder / "tune.png")
        self._tab("Picture")
        self._choose("Show", "A | B")
        self._tab("Values")
        for place in np.linspace(0.5, 0.85, 8):
            self._slide("Bending [µN·m]", float(place))
        self._settle(folder / "tune_ab.png")
        self._tab("Picture")
        self._choose("Show", "subdivision | refined")
        self._input("Wipe").click()
        for place in np.linspace(0.1, 0.9, 12):
            self._slide("Wipe at", float(place))
        self._slide("Wipe at", 0.5)
        self._settle(folder / "tune_wipe.png")
        self._input("Wipe").click()
        self._choose("Show", "refined")
        self._choose("Map", "strain along weft")
        self._settle(folder / "tune_map.png")
        self._tab("Paint")
        self._choose("Paint", "easeScale")
        self._paint()
        self._settle(folder / "tune_paint.png")
        self._choose("Paint", "off")
        self._tab("Picture")
        self._choose("Map", "none")
        self._choose("Show", "cage | refined")
        self._play(folder / "tune_time.png")

    def write(self, file: Path) -> None:
        """Write the film, and its first picture beside it; takes the program ffmpeg with libx264."""
        self.film[len(self.film) // 3].save(file.with_suffix(".jpg"), quality=80)
        words = ["ffmpeg", "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]
        words += ["-s", "{}x{}".format(*SMALL), "-r", str(RATE), "-i", "-", "-c:v", "libx264", "-crf", "27"]
        words += ["-pix_fmt", "yuv420p", "-vf", "scale=1080:674", "-movflags", "+faststart", str(file)]
        subprocess.run(words, input=b"".join(each.tobytes() for each in self.film), check=True)

    def _snap(self) -> Image.Image:
        whole = Image.open(io.BytesIO(self._page.screenshot())).convert("RGB")
        self.film.append(whole.resize(SMALL, Image.Resampling.LANCZOS))
        return self.film[-1]

    def _hold(self, count: int) -> None:
        self._snap()
        self.film += [self.film[-1]] * (count - 1)

    def _settle(self, picture: Path | None = None) -> None:
        """Wait for settled cloth, and write its picture."""
        self._page.wait_for_timeout(500)
        self._page.get_by_text(SETTLED).wait_for(timeout=PATIENCE_MS)
        self._page.wait_for_timeout(1500)
        self._hold(5)
        if picture is not None:
            self.film[-1].quantize(COLORS).save(picture, optimize=True)

    def _input(self, title: str) -> Any:
        """The input box behind a label."""
        found = f"xpath={LABEL.format(title)}/following::input[not(@type='hidden')][1]"
        return self._page.locator(found)

    def _slide(self, title: str, place: float) -> None:
        """Press on a slider."""
        label = self._page.locator(f"xpath={LABEL.format(title)}")
        thumb = label.locator("xpath=following::*[@role='slider'][1]")
        box = thumb.locator("xpath=ancestor::*[contains(@class, 'Slider-track')][1]").bounding_box()
        self._page.mouse.click(box["x"] + place * box["width"], box["y"] + box["height"] / 2)
        self._page.wait_for_timeout(400)
        self._snap()

    def _tab(self, name: str) -> None:
        self._page.get_by_role("tab", name=name).click()

    def _choose(self, title: str, option: str) -> None:
        self._input(title).click()
        self._page.get_by_role("option", name=option, exact=True).click()
        self._page.wait_for_timeout(1500)
        self._snap()

    def _paint(self) -> None:
        """Drag the brush over the middle of the refined cloth."""
        mouse, (x, y) = self._page.mouse, (500, 420)
        for row in range(3):
            mouse.move(x - 60, y + 30 * row)
            mouse.down()
            for step in range(8):
                mouse.move(x - 60 + 16 * step, y + 30 * row)
                self._page.wait_for_timeout(120)
            self._snap()
            mouse.up()
            self._page.wait_for_timeout(300)

    def _play(self, picture: Path) -> None:
        """Play a range, and write a picture once `PART` of its frames are solved."""
        self._page.get_by_role("button", name="Play").click()
        waits = True
        for _ in range(30):
            self._page.wait_for_timeout(100)
            self._snap()
            if waits and int(self._page.locator("#takes").inner_text().split()[0]) >= PART:
                self.film[-1].quantize(COLORS).save(picture, optimize=True)
                waits = False
        self._page.get_by_role("button", name="Pause").click()


def waits(page: Any, tunable: Tunable, place: float) -> tuple[float, float]:
    """Seconds from a press on a slider to the first new cloth at the graphics card, and to the settled cloth."""
    label = page.locator(f"xpath={LABEL.format(tunable.title)}")
    thumb = label.locator("xpath=following::*[@role='slider'][1]")
    track = thumb.locator("xpath=ancestor::*[contains(@class, 'Slider-track')][1]")
    track.scroll_into_view_if_needed()
    box = track.bounding_box()
    page.mouse.move(box["x"] + box["width"] * place, box["y"] + box["height"] / 2)
    page.wait_for_timeout(CALM_MS)
    page.evaluate("window.begin()")
    page.mouse.down()
    page.mouse.up()
    page.wait_for_function("window.drawn && window.settled", timeout=PATIENCE_MS)
    pressed, drawn, settled = page.evaluate("[window.pressed, window.drawn, window.settled]")
    return 1e-3 * (drawn - pressed), 1e-3 * (settled - pressed)
