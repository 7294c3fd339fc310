"""Remake docs/live.gif, a session filmed in a browser at real time, and the numbers of docs/live.md.  `make live`.

Two minutes; the numbers want a quiet machine.
"""

from __future__ import annotations

import base64
import contextlib
import io
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import viser
from make_numbers import Table, markdown, replace_in
from PIL import Image
from playwright.sync_api import Page as Tab
from playwright.sync_api import sync_playwright
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from scenarios.live.pacing import Pace
from scenarios.live.page import Page
from scenarios.live.session import Session
from scenarios.loading import load_scenario

PAGE = Path(__file__).resolve().parent / "live.md"
FILM = PAGE.with_suffix(".gif")
FILM_SIZE = {"width": 960, "height": 600}
FRAME = 0.125
"""[s] between the film's frames."""
SECONDS = 10.0
PRESSES = 40
ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


def received(page: Page, seconds: float) -> tuple[float, float]:
    """Bytes on connecting, and bytes per second from then on, of a client that reads all."""
    address = urlsplit(page.address)
    headers = {"Cookie": f"quadsim-{address.port}={address.query.partition('=')[2]}"}
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    first, later, begun = 0, 0, time.monotonic()
    with connect(
        f"ws://{address.netloc}/", subprotocols=[protocol], additional_headers=headers, max_size=None, close_timeout=1.0
    ) as client:
        while (now := time.monotonic() - begun) < seconds + 2.0:
            size = len(client.recv(timeout=10.0))
            first, later = (first + size, later) if now < 2.0 else (first, later + size)
    return float(first), later / seconds


@contextlib.contextmanager
def opened(page: Page, size: dict[str, int]) -> Iterator[Tab]:
    """The page in a browser, which draws in software."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=next(filter(None, map(shutil.which, ("chromium", "google-chrome")))), args=ARGUMENTS
        )
        tab = browser.new_page(viewport=size)  # type: ignore[arg-type]
        tab.goto(page.address)
        tab.get_by_text("of real time").wait_for(timeout=60_000)
        tab.wait_for_timeout(1000)
        yield tab
        browser.close()


def latencies(session: Session, page: Page) -> list[float]:
    """From a key on a slider in a browser to the event's entry in the flight [s]."""
    found: list[float] = []
    with opened(page, {"width": 800, "height": 600}) as tab:
        row = tab.locator("label", has_text="Mass factor").locator("xpath=ancestor::div[.//*[@role='slider']][1]")
        row.get_by_role("slider").focus()
        for i in range(PRESSES):
            before, begun = masses(session), time.monotonic()
            tab.keyboard.press("ArrowRight" if i % 2 == 0 else "ArrowLeft")
            wait(lambda before=before: masses(session) > before)  # type: ignore[misc]
            found.append(time.monotonic() - begun)
            time.sleep(0.037)  # keys fall anywhere within a period
    return found


def pull(tab: Tab, x: float, y: float, seconds: float) -> None:
    """Drag the vehicle, at the middle of the picture, by this many pixels, and hold it for a while."""
    box = tab.locator("canvas").first.bounding_box()
    assert box is not None
    begin = np.array([box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"]])
    tab.mouse.move(*begin)
    tab.wait_for_timeout(300)
    tab.mouse.move(*(begin + 1.0))
    tab.wait_for_timeout(300)
    tab.mouse.down()
    for share in np.linspace(0.0, 1.0, 12):
        tab.mouse.move(*(begin + share * np.array([x, y])))
        tab.wait_for_timeout(50)
    tab.wait_for_timeout(1e3 * seconds)
    tab.mouse.up()


def film() -> None:
    """Two vehicles by two controllers, pulled alike, as the browser shows them."""
    frames: list[tuple[float, bytes]] = []
    session = Session(load_scenario("robust"), load_scenario("paper-constrained").controller)
    with flying(session) as (_, page), opened(page, FILM_SIZE) as tab:
        tab.get_by_text("Software WebGL").locator("xpath=ancestor::*[.//button][1]").get_by_role("button").click()
        tab.wait_for_timeout(1000)
        chrome = tab.context.new_cdp_session(tab)

        def arrived(frame: Any) -> None:
            frames.append((frame["metadata"]["timestamp"], base64.b64decode(frame["data"])))
            chrome.send("Page.screencastFrameAck", {"sessionId": frame["sessionId"]})

        chrome.on("Page.screencastFrame", arrived)
        chrome.send("Page.startScreencast", {"format": "png"})
        tab.wait_for_timeout(1000)
        pull(tab, 180.0, -60.0, 1.2)
        tab.wait_for_timeout(4000)
        chrome.send("Page.stopScreencast")
    write(frames)


def write(frames: list[tuple[float, bytes]]) -> None:
    """The film, of as many colours as fit, each frame the last one that had arrived."""
    times = np.array([at for at, _ in frames])
    wanted = np.arange(times[0], times[-1], FRAME)
    shown = [
        Image.open(io.BytesIO(frames[np.searchsorted(times, at, side="right") - 1][1])).convert("RGB") for at in wanted
    ]
    some = np.concatenate([np.asarray(each) for each in shown[::8]])
    colours = Image.fromarray(some).quantize(128, Image.Quantize.MAXCOVERAGE)  # rare ones too, as what is violated
    pictures = [each.quantize(palette=colours, dither=Image.Dither.NONE) for each in shown]
    pictures[0].save(FILM, save_all=True, append_images=pictures[1:], duration=1e3 * FRAME, loop=0, optimize=True)
    print(f"{FILM}: {len(frames)} pictures in {times[-1] - times[0]:.1f} s, {FILM.stat().st_size / 1e6:.2f} MB")


@contextlib.contextmanager
def flying(session: Session) -> Iterator[tuple[Session, Page]]:
    """A session that is served."""
    pace = Pace()
    page = Page(session, pace, save=str, others={})
    flight = threading.Thread(target=pace.drive, args=(session, page))
    flight.start()
    try:
        yield session, page
    finally:
        pace.stop()
        flight.join()
        page.close()
        session.close()


def masses(session: Session) -> int:
    """Changes of the mass up to now."""
    return sum(event.type == "mass" for event in session.flights[0].scenario.events)


def wait(until: Callable[[], bool], seconds: float = 5.0) -> None:
    """Look every millisecond.

    Raises:
        SystemExit: it does not happen.
    """
    limit = time.monotonic() + seconds
    while not until():
        if time.monotonic() > limit:
            sys.exit("A key had no effect.")
        time.sleep(0.001)


def measure() -> Table:
    """All of it, of one session."""
    with flying(Session(load_scenario("robust"))) as (session, page):
        used, k = time.process_time(), session.k
        alone = time.monotonic()
        time.sleep(SECONDS)
        cores = (time.process_time() - used) / ((session.k - k) * session.period)
        factor = (session.k - k) * session.period / (time.monotonic() - alone)
        used, k = time.process_time(), session.k
        connected, rate = received(page, SECONDS)
        watched = (time.process_time() - used) / ((session.k - k) * session.period)
        keys = 1e3 * np.array(latencies(session, page))
    return [
        ("`robust`, N = 50, at 20 Hz", "target", "measured"),
        ("server with the flight, processor time per flown time", "<= 0.3", f"{cores:.2f}"),
        ("the same with a client that reads, its own time included", "<= 0.3", f"{watched:.2f}"),
        ("flown over real time", "1", f"{factor:.2f}"),
        ("key on a slider to the period flown with it, median [ms]", "<= 100", f"{np.median(keys):.0f}"),
        ("the same, 90 % [ms]", "-", f"{np.quantile(keys, 0.9):.0f}"),
        ("to each client [kB/s]", "-", f"{rate / 1e3:.0f}"),
        ("on connecting, within 2 s [kB]", "-", f"{connected / 1e3:.0f}"),
    ]


if __name__ == "__main__":
    film()
    replace_in(PAGE, "live", markdown(measure()), command="make live")
