"""Pages in headless Chromium, for the tests of what we write as HTML."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
ADVICE = ("GL Driver Message", "willReadFrequently")
"""Chromium's advice on the speed of plotly.js without a graphics card; a page cannot mend it."""
PATIENCE = 120e3  # [ms]
CLASHES = """plot => {
  const titles = [...plot.querySelectorAll(".annotation-text, .infolayer text[class$='title']")];
  const boxes = titles.map((title) => title.getBoundingClientRect()).filter((box) => box.width);
  const meet = (a, b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;
  const beyond = boxes.filter((box) => box.left < 0 || box.right > innerWidth);
  return beyond.length + boxes.flatMap((a, i) => boxes.slice(i + 1).filter((b) => meet(a, b))).length;
}"""
"""Titles of a plot's panels that overlap one another or leave the window."""


@contextmanager
def opened(page: Path, *, width: int = 1280, dark: bool = False) -> Iterator[Any]:
    """A tab with the page and its drawn plots.

    The page must be no wider than its window, its console must stay empty, and it may fetch nothing but files.
    """
    api = pytest.importorskip("playwright.sync_api", reason="no Playwright here: pip install playwright")
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        pytest.skip("no Chromium here: install the package 'chromium' to open the page in a browser")
    printed: list[str] = []
    requests: list[str] = []
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=ARGUMENTS)
        tab = browser.new_page(viewport={"width": width, "height": 800}, color_scheme="dark" if dark else "light")
        tab.set_default_timeout(PATIENCE)
        tab.on("console", lambda message: printed.append(message.text))
        tab.on("pageerror", lambda error: printed.append(str(error)))
        tab.on("request", lambda request: requests.append(request.url))
        tab.goto(page.as_uri(), wait_until="commit")
        tab.wait_for_function("'drawn' in document.documentElement.dataset")
        assert tab.evaluate("document.documentElement.scrollWidth") <= width, "the page is wider than its window"
        yield tab
        browser.close()
    assert [line for line in printed if not any(advice in line for advice in ADVICE)] == []
    assert {url.partition(":")[0] for url in requests} <= {"file", "data", "blob"}
