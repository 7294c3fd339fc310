"""The page on which the paper's MPC flies: what it computes, against Python and the same C compiled natively."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from exported_c import Host, replay
from fly.build import CONTROLLERS, build

from quadsim.features.export.record import record
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.loading import load_scenario

ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
PHONE = {"width": 390, "height": 844}
TOLERANCE = 1e-6
"""[m], [rad] and per second between a flight by this MuJoCo and by the page's; 20 times what was measured."""
COMMANDS = """([name, degrees, speeds, states, actings, path]) => {
  const c = quadsim.flight.controllers[name];
  quadsim.flight.bound(degrees);
  c.acting.set(speeds);
  c.reset();
  return states.map((state, k) => {
    c.state.set(state); c.acting.set(actings[k]); c.reference.set(path.slice(k, k + c.horizon).flat());
    return [c.step(), c.changes(), ...c.command];
  });
}"""
FLY = """periods => {
  const { flight } = quadsim, states = [];
  document.getElementById('course').click();
  document.getElementById('constrained').click();
  flight.bound(5);
  flight.reset();
  while (flight.k < periods) { flight.step(); if (flight.substep === 1) states.push(flight.measured); }
  return states;
}"""
DRAGGED = "quadsim.flight.pull && Math.hypot(...quadsim.flight.pull.force) > 5"
ON_SCREEN = """() => {
  const { stage } = quadsim, box = stage.canvas.getBoundingClientRect();
  const at = stage.vehicle.position.clone().project(stage.camera);
  return [box.left + box.width * (1 + at.x) / 2, box.top + box.height * (1 - at.y) / 2];
}"""


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api", reason="no Playwright here: pip install playwright")
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        pytest.skip("no Chromium here: install the package 'chromium' to open the page in a browser")
    folder = tmp_path_factory.mktemp("fly")
    if reason := build(folder):
        pytest.skip(f"the page cannot be built: {reason}")
    requests: list[str] = []
    errors: list[str] = []
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=ARGUMENTS)
        page = browser.new_page(viewport=PHONE)
        page.on("request", lambda request: requests.append(request.url))
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto((folder / "index.html").as_uri())
        page.wait_for_function("window.quadsim", timeout=60_000)
        yield page
        browser.close()
    assert not errors
    assert {url.partition(":")[0] for url in requests} <= {"file", "data", "blob"}, "reading the page takes a network"


@pytest.mark.parametrize(("name", "degrees"), [*((name, 5.0) for name in CONTROLLERS), ("constrained", 8.0)])
def test_commands_in_the_page_have_the_bits_of_the_native_ones(tab: Any, name: str, degrees: float) -> None:
    """At another bound, those of an export with that bound: the bound itself differs in its last bits."""
    scenario = load_scenario(CONTROLLERS[name])
    if degrees != 5.0:
        bounds = {f"controller.output_bounds.{angle}": [-degrees, degrees] for angle in ("roll", "pitch")}
        scenario = scenario.replace(bounds)
    host = Host(scenario)
    recording = record(scenario)
    native = [[reply.status, reply.changes, *reply.command] for reply in replay(host, recording)]
    recorded = (recording.before, recording.state, recording.acting, recording.path)
    answers = tab.evaluate(COMMANDS, [name, degrees, *(array.tolist() for array in recorded)])
    assert len(answers) == scenario.periods
    if degrees == 5.0:
        assert answers == native
    else:
        assert np.allclose(answers, native, rtol=0.0, atol=1e-6)


def test_the_page_flies_as_quadsim_does(tab: Any) -> None:
    scenario = load_scenario(CONTROLLERS["constrained"], ['controller.solver="core"'])
    states = np.array(tab.evaluate(FLY, scenario.periods))
    assert np.abs(states - Rollout(scenario).fly().log.control.state[: len(states)]).max() < TOLERANCE


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_pulled_and_pushed_vehicle_returns_to_its_target(tab: Any, name: str) -> None:
    tab.click("#reset")
    tab.click(f"#{name}")
    tab.click("#target")
    tab.evaluate("while (quadsim.flight.k < 200) quadsim.flight.step()")
    tab.wait_for_timeout(200)  # for a frame
    x, y = tab.evaluate(ON_SCREEN)
    tab.mouse.move(x, y)
    tab.mouse.down()
    tab.mouse.move(x + 60, y)
    tab.wait_for_function(DRAGGED)
    tab.mouse.up()
    tab.click("#push")
    tilt, lost = tab.evaluate(
        """() => { const { flight } = quadsim; let most = 0;
        for (const end = flight.k + 300; flight.k < end && !flight.lost;) {
          flight.step(); most = Math.max(most, ...flight.euler.slice(0, 2).map(Math.abs)); }
        return [most, flight.lost]; }"""
    )
    assert lost is None
    # Soft bounds yield by a degree to a pull whose length is the browser's; without bounds it is 20 deg.
    assert (tilt > np.radians(8.0)) == (name == "unconstrained"), "the tilt bound of 5 deg limits the others"
    position, target = tab.evaluate("[Array.from(quadsim.flight.data.qpos.slice(0, 3)), quadsim.flight.target]")
    assert position == pytest.approx(target, abs=0.1)


def test_the_page_fits_a_phone_and_its_slider_moves_the_bound(tab: Any) -> None:
    assert tab.evaluate("document.documentElement.scrollWidth") == PHONE["width"]
    tab.locator("#bound").fill("12")
    assert tab.evaluate("quadsim.flight.tilt") == 12
    tab.click("#pause")
    before = tab.evaluate("quadsim.flight.k")
    tab.wait_for_timeout(300)
    assert tab.evaluate("quadsim.flight.k") == before
    tab.click("#reset")
    assert tab.evaluate("quadsim.flight.k") == 0
