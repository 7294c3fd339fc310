"""Pages in headless Chromium, for the tests of what we write as HTML."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ADVICE = ("GL Driver Message", "willReadFrequently")
"""Chromium's advice on the speed of plotly.js without a graphics card; a page cannot mend it."""


def open_page(page: Path, profile: Path) -> tuple[str, list[str]]:
    """The page as headless Chromium builds it, and what its console printed."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        pytest.skip("no Chromium here: install the package 'chromium' to open the page in a browser")
    command = [
        *(browser, "--headless", "--no-sandbox", "--no-first-run", "--disable-quic", "--enable-unsafe-swiftshader"),
        *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-extensions"),
        *(f"--user-data-dir={profile}", "--enable-logging=stderr", "--virtual-time-budget=20000", "--dump-dom"),
        page.as_uri(),
    ]
    environment = {**os.environ, "LC_ALL": "C.UTF-8"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True, env=environment)
    output = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return done.stdout, [line for line in output if not any(advice in line for advice in ADVICE)]
