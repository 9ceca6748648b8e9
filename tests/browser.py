"""Pages opened in a headless Chromium."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

OF_VIEWER = "Unable to preventDefault inside passive event listener invocation."
"""What the viewer's own code complains of when a mesh is dragged."""
PATIENCE_MS = 120_000
"""How long something must not have happened before a test gives up; nothing else depends on it."""
NAMES = ("chromium", "chromium-browser", "google-chrome")


@contextmanager
def opened(file: Path) -> Iterator[Any]:
    """A page; what it asks the network for and every complaint in its console fail the test."""
    said: list[str] = []
    with _browser() as browser:
        page = browser.new_page(viewport={"width": 1280, "height": 1000})
        page.on("console", lambda message: said.append(message.text))
        _watch(page, said, own=("file:", "data:", "blob:"))
        page.goto(file.as_uri())
        yield page
    assert said == []


@contextmanager
def served(url: str) -> Iterator[Any]:
    """A page of a server on this machine; errors, and what it asks other hosts for, fail the test."""
    said: list[str] = []

    def heard(message: Any) -> None:
        if message.type == "error" and message.text != OF_VIEWER:
            said.append(message.text)

    with _browser() as browser:
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        page.on("console", heard)
        _watch(page, said, own=(url, "data:", "blob:"))
        page.on("websocket", lambda asked: None if asked.url.startswith(f"ws{url[4:]}") else said.append(asked.url))
        page.goto(url)
        yield page
    assert said == []


@contextmanager
def _browser() -> Iterator[Any]:
    """A headless Chromium that draws without a graphics card."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="pages are driven with playwright")
    program = next((found for name in NAMES if (found := shutil.which(name))), None)
    if program is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is on the path")
    drawn = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_api.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=drawn)
        try:
            yield browser
        finally:
            browser.close()


def _watch(page: Any, said: list[str], *, own: tuple[str, ...]) -> None:
    """Note errors, and what is asked for elsewhere."""
    page.set_default_timeout(PATIENCE_MS)
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda asked: None if asked.url.startswith(own) else said.append(asked.url))


def hover(page: Any, spot: Any) -> str:
    """Move the mouse over a mark of a plot; returns what the plot says of it."""
    spot.scroll_into_view_if_needed()
    box = spot.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    label = page.locator(".hoverlayer .hovertext")
    label.first.wait_for(state="attached")
    return str(label.first.text_content())
