"""Remake the numbers of docs/live.md: what a session costs, and how soon a knob acts.  `make live`, a minute."""

from __future__ import annotations

import shutil
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import viser
from make_numbers import Table, markdown, replace_in
from playwright.sync_api import sync_playwright
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from scenarios.live.pacing import Pace
from scenarios.live.page import Page
from scenarios.live.session import Session
from scenarios.loading import load_scenario

PAGE = Path(__file__).resolve().parent / "live.md"
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


def latencies(session: Session, page: Page) -> list[float]:
    """From a key on a slider in a browser to the event's entry in the flight [s]."""
    found: list[float] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=next(filter(None, map(shutil.which, ("chromium", "google-chrome")))), args=ARGUMENTS
        )
        tab = browser.new_page(viewport={"width": 800, "height": 600})
        tab.goto(page.address)
        tab.get_by_text("of real time").wait_for(timeout=60_000)
        row = tab.locator("label", has_text="Mass factor").locator("xpath=ancestor::div[.//*[@role='slider']][1]")
        row.get_by_role("slider").focus()
        time.sleep(1.0)
        for i in range(PRESSES):
            before, begun = masses(session), time.monotonic()
            tab.keyboard.press("ArrowRight" if i % 2 == 0 else "ArrowLeft")
            wait(lambda before=before: masses(session) > before)  # type: ignore[misc]
            found.append(time.monotonic() - begun)
            time.sleep(0.037)  # keys fall anywhere within a period
        browser.close()
    return found


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
    session, pace = Session(load_scenario("robust")), Pace()
    page = Page(session, pace, save=str, others={})
    flight = threading.Thread(target=pace.drive, args=(session, page))
    flight.start()
    try:
        used, k = time.process_time(), session.k
        alone = time.monotonic()
        time.sleep(SECONDS)
        cores = (time.process_time() - used) / ((session.k - k) * session.period)
        factor = (session.k - k) * session.period / (time.monotonic() - alone)
        used, k = time.process_time(), session.k
        connected, rate = received(page, SECONDS)
        watched = (time.process_time() - used) / ((session.k - k) * session.period)
        keys = 1e3 * np.array(latencies(session, page))
    finally:
        pace.stop()
        flight.join()
        page.close()
        session.close()
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
    replace_in(PAGE, "live", markdown(measure()), command="make live")
