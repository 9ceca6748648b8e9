"""How long the page of `tune` takes in a headless browser, from a press on a slider to new cloth."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from playwright import sync_api

from physgraph_usd.studio.values import Tunable

NAMES = ("chromium", "chromium-browser", "google-chrome")
DRAWN = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
"""Drawn by the processor: there may be no graphics card."""
SETTLED = "settled: as refine solves it"
CALM_MS = 1000
"""How long the page is left alone before a move: pictures that are still drawn would hold the mouse up."""
PATIENCE_MS = 120000
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


def waits(page: Any, tunable: Tunable, place: float) -> tuple[float, float]:
    """Seconds from a press on a slider to the first new cloth at the graphics card, and to the settled cloth."""
    number = page.get_by_label(tunable.title, exact=True).last
    thumb = number.locator("xpath=following::*[@role='slider'][1]")
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
