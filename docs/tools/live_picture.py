"""A picture of a live session for docs/index.md, on a light and on a dark page: `make numbers OPTIONS=pictures`."""

from __future__ import annotations

import io
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Final, Literal

from PIL import Image
from playwright.sync_api import Browser, sync_playwright

ASSETS: Final = Path(__file__).resolve().parents[1] / "assets"
WIDTH, HEIGHT = 1280, 720  # of the browser's window [pixels]
FLOWN: Final = 12.0  # s of the flight before the picture
OPTIONS: Final = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")


def picture(browser: Browser, address: str, scheme: Literal["light", "dark"]) -> Image.Image:
    """The page while the mouse pulls the vehicle, which is in the middle of the scene."""
    page: Any = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme=scheme)
    page.goto(address)
    page.add_style_tag(content=".mantine-Notifications-root { display: none }")  # that no graphics card draws here
    page.wait_for_timeout(1e3 * FLOWN)
    box = page.locator("canvas").first.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    for i in range(4):  # the page has to see the mouse above the vehicle before its button goes down
        page.mouse.move(x + i, y)
        page.wait_for_timeout(200)
    page.mouse.down()
    page.mouse.move(x + 120, y - 60, steps=6)
    page.wait_for_timeout(1500)
    shown = Image.open(io.BytesIO(page.screenshot()))
    page.mouse.up()
    page.close()
    return shown.convert("RGB")


def main() -> None:
    """Start a session, as a user does, and look at its page."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    command = [str(Path(sys.executable).with_name("quadsim")), "live", "--no-browser", "--port", "0"]
    with (
        sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=chromium, args=[*OPTIONS]) as browser,
    ):
        for scheme, name in (("light", "live.jpg"), ("dark", "live-dark.jpg")):
            with (
                tempfile.TemporaryDirectory() as folder,
                subprocess.Popen([*command, "--out", f"{folder}/live"], stdout=subprocess.PIPE, text=True) as session,
            ):
                assert session.stdout is not None
                address = next(filter(None, (re.search(r"http\S+token=\S+", line) for line in session.stdout)))[0]
                picture(browser, address, scheme).save(ASSETS / name, quality=80, optimize=True)
                session.terminate()


if __name__ == "__main__":
    main()
