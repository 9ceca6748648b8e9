"""Pages opened in a headless Chromium."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")


@contextmanager
def opened(file: Path) -> Iterator[Any]:
    """A page; what it asks the network for and every complaint in its console fail the test."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="pages are driven with playwright")
    program = next((found for name in NAMES if (found := shutil.which(name))), None)
    if program is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is on the path")
    said: list[str] = []
    with sync_api.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
        try:
            page = browser.new_page(viewport={"width": 1280, "height": 1000})
            page.on("console", lambda message: said.append(message.text))
            page.on("pageerror", lambda error: said.append(str(error)))
            page.on(
                "request",
                lambda asked: None if asked.url.startswith(("file:", "data:", "blob:")) else said.append(asked.url),
            )
            page.goto(file.as_uri())
            yield page
        finally:
            browser.close()
    assert said == []


def hover(page: Any, spot: Any) -> str:
    """Move the mouse over a mark of a plot; returns what the plot says of it."""
    spot.scroll_into_view_if_needed()
    box = spot.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    label = page.locator(".hoverlayer .hovertext")
    label.first.wait_for(state="attached")
    return str(label.first.text_content())
