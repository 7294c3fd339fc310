"""Build the page on which the paper's MPC flies into site/fly, and link it from site/index.html: `make docs`.

It takes clang and wasm-ld for the controllers, npm for MuJoCo, three.js and esbuild, and a network the first time.
Without them the page is left out.  The font of formulas takes npm alone.
"""

from __future__ import annotations

import gzip
import json
import math
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from importlib.metadata import distribution, version
from pathlib import Path
from typing import Any

from quadsim.assets import models_dir
from quadsim.features.export.exporter import c_controller
from quadsim.palette import css
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.courses.steps import Steps
from quadsim.scenarios.loading import load_scenario

HERE = Path(__file__).resolve().parent
SITE = HERE.parents[1] / "site"
CACHE = Path(sys.prefix) / "fly"
"""Where npm installs."""
PACKAGES = {"@mujoco/mujoco": "3.14.0", "three": "0.187.0", "esbuild": "0.28.2"}
FONT_PACKAGE = {"@fontsource/stix-two-math": "5.3.0"}
"""For formulas, where the reader's machine has no font with a MATH table."""
FONT_CACHE = Path(sys.prefix) / "math-font"
FONT = FONT_CACHE / "node_modules/@fontsource/stix-two-math"
FONT_LINK = ', url("math.woff2") format("woff2")'
"""What docs/assets/site.css has of it."""
CONTROLLERS = {"constrained": "paper-constrained", "unconstrained": "paper-unconstrained", "robust": "robust"}
"""Buttons, and the scenarios whose controllers they switch to."""
CLANG = [
    *("clang", "--target=wasm32", "-O3", "-std=c99", "-ffp-contract=off", "-nostdlib", "-Wl,--no-entry,--strip-all"),
    *("-fno-builtin", *(f"-Wl,--export={name}" for name in ("start", "horizon", "changes", "widen", "reset", "step"))),
]
LIBC = """#include <stddef.h>
void *memcpy(void *restrict to, const void *restrict from, size_t bytes);
void *memset(void *to, int value, size_t bytes);
"""
ESBUILD = [
    *("--bundle", "--minify", "--format=iife", "--log-level=error", "--loader:.gz=binary", "--loader:.xml=text"),
    *("--define:import.meta.url=document.baseURI", "--external:module", "--external:node:*", "--legal-comments=none"),
]
PALETTE = "/* palette: docs/fly/build.py */"
LEFT_OUT = '<p id="fly"></p>'
SECTION = re.compile(r'<h2 id="without-installing">.*?(?=<h2 )', re.DOTALL)
"""Of the home page, what stands around it."""
LINK = '<p id="fly"><a class="md-button md-button--primary" href="fly/index.html">Fly it</a></p>'


def lacking(*tools: str) -> str | None:
    """Which of the tools is not installed; None where all are."""
    for tool in tools:
        if shutil.which(tool) is None:
            return f"{tool} is not installed"
    return None


def install(packages: Mapping[str, str], place: Path) -> str | None:
    """Install packages into a folder of their own, where they are not yet; why it cannot be done, or None."""
    if reason := lacking("npm"):
        return reason
    wanted = json.dumps(packages)
    stamp = place / "installed.json"
    if stamp.is_file() and stamp.read_text(encoding="utf-8") == wanted:
        return None
    place.mkdir(exist_ok=True)
    command = ["npm", "install", "--no-save", "--no-package-lock", "--no-audit", "--no-fund", "--fetch-retries=3"]
    names = [f"{name}@{pin}" for name, pin in packages.items()]
    done = subprocess.run([*command, f"--prefix={place}", *names], capture_output=True, text=True)
    if done.returncode != 0:
        return f"npm could not install {', '.join(names)}"
    stamp.write_text(wanted, encoding="utf-8")
    return None


def facts() -> dict[str, Any]:
    """The numbers of the paper's flight that the page needs."""
    scenario = load_scenario(CONTROLLERS["constrained"])
    vehicle, course, controller = Assembly(scenario).vehicle, scenario.reference, scenario.controller
    assert isinstance(course, Steps)
    assert controller.output_bounds["roll"] == controller.output_bounds["pitch"]
    period = scenario.control_period
    windows = [
        [[round(window.start / period), round(window.stop / period), window.value] for window in windows]
        for windows in (course.x, course.y, course.z)
    ]
    return {
        "period": period,
        "timestep": scenario.plant.timestep,
        "steps": round(period / scenario.plant.timestep),
        "end": scenario.periods,
        "windows": windows,
        "keep": math.exp(-3.0 * period / course.response_time),
        "position": scenario.initial.position,
        "yaw": math.radians(scenario.initial.euler[2]),
        "hover": vehicle.hover_speed,
        "thrust": vehicle.thrust_coefficient,
        "tilt": controller.output_bounds["roll"][1],
        "speed": controller.input_bounds.speed,
        "slew": controller.input_bounds.slew,
        "tolerance": next(bound.tolerance for bound in scenario.constraints if bound.name == "roll"),
        "native": version("mujoco"),
        "wasm": PACKAGES["@mujoco/mujoco"],
        "three": PACKAGES["three"],
    }


def controller_wasm(name: str, work: Path) -> bytes:
    """A scenario's exported controller, compiled."""
    source = c_controller(load_scenario(name))
    for file, text in source.files.items():
        (work / file).write_text(text, encoding="utf-8")
    compiled, sources = work / "controller.wasm", [HERE / "controller.c", *work.glob("quadsim_*.c")]
    define = f"-DBOUNDS={source.tables.lower.size}"
    subprocess.run([*CLANG, define, f"-I{work}", "-o", compiled, *sources], check=True)
    return compiled.read_bytes()


def build(out: Path) -> str | None:
    """Build the page into a directory; what is missing where it cannot be."""
    if reason := lacking("clang", "wasm-ld") or install(PACKAGES, CACHE):
        return reason
    modules = CACHE / "node_modules"
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        (work / "string.h").write_text(LIBC, encoding="utf-8")
        binaries = {label: controller_wasm(scenario, work) for label, scenario in CONTROLLERS.items()}
        binaries["mujoco"] = (modules / "@mujoco/mujoco/mujoco.wasm").read_bytes()
        for label, binary in binaries.items():
            (work / f"{label}.wasm.gz").write_bytes(gzip.compress(binary, 9, mtime=0))
        (work / "facts.json").write_text(json.dumps(facts()), encoding="utf-8")
        shutil.copy(models_dir() / "quadrotor.xml", work)
        shutil.copy(HERE / "fly.js", work)
        (work / "node_modules").symlink_to(modules)
        out.mkdir(parents=True, exist_ok=True)
        subprocess.run([modules / ".bin/esbuild", work / "fly.js", *ESBUILD, f"--outfile={out / 'fly.js'}"], check=True)
    page = (HERE / "index.html").read_text(encoding="utf-8")
    assert PALETTE in page, "docs/fly/index.html has no place for the palette"
    (out / "index.html").write_text(page.replace(PALETTE, css()), encoding="utf-8")
    shutil.copy(modules / "three/LICENSE", out / "LICENSE-three.txt")
    for file in distribution("mujoco").files or ():
        if file.name in {"LICENSE", "LICENSES_THIRD_PARTY.md"}:
            shutil.copy(str(file.locate()), out / f"{file.stem}-mujoco.txt")
    return None


def add_font() -> str | None:
    """Put the font of formulas into the site; where it cannot be had, why, and the site does not ask for it."""
    reason = install(FONT_PACKAGE, FONT_CACHE)
    if reason is None:
        shutil.copy(FONT / "files/stix-two-math-latin-400-normal.woff2", SITE / "assets/math.woff2")
        shutil.copy(FONT / "LICENSE", SITE / "assets/LICENSE-math.txt")
        return None
    style = SITE / "assets/site.css"
    text = style.read_text(encoding="utf-8")
    assert FONT_LINK in text, "docs/assets/site.css has no font"
    style.write_text(text.replace(FONT_LINK, ""), encoding="utf-8")
    return reason


def main() -> None:
    """Build the page and the font into the site, and link the page; the home page has no place for one left out."""
    if reason := add_font():
        print(f"Formulas are shown in a font of the reader's machine: {reason}.")
    reason = build(SITE / "fly")
    page = SITE / "index.html"
    text = page.read_text(encoding="utf-8")
    assert LEFT_OUT in text, "docs/index.md has no place for the link"
    if reason is None:
        text = text.replace(LEFT_OUT, LINK)
    else:
        print(f"The page on which the MPC flies is left out of the site: {reason}.")
        text, count = SECTION.subn("", text)
        assert count == 1, "docs/index.md has no section for the page"
    page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
