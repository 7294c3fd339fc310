"""The scene of a session: who is who, the page around it, and the recording."""

from __future__ import annotations

import base64
import math
import re
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zstandard

from quadsim.features.live import look
from quadsim.features.live.pace import Pace
from quadsim.features.live.page import Page
from quadsim.features.live.session import Frame, Session
from quadsim.features.live.stage import _course
from quadsim.palette import line_colour
from quadsim.scenarios.loading import load_scenario
from tests.features.live.test_page import PATIENCE, browser

__all__ = ["browser"]  # a fixture

pytestmark = pytest.mark.slow("live")

PERIODS = 30


@pytest.fixture(scope="module")
def flown() -> Iterator[tuple[Page, list[Frame]]]:
    """A page that two vehicles have flown for, far from the origin."""
    start = ["initial.position=[40.0, -30.0, 2.0]", "controller.horizon=10"]
    against = load_scenario("hover", ["controller=pid"]).controller
    session = Session(load_scenario("hover", start), against)
    page = Page(session, Pace(), save=lambda session: "", others={})
    session.submit({"type": "setpoint", "x": 41.0})
    frames = [session.advance() for _ in range(PERIODS)]
    for frame in frames:
        page.stage.show(frame)
        page.stage.pose(frame, 1.0)
    yield page, frames
    page.close()
    session.close()


@pytest.fixture(scope="module")
def recording(flown: tuple[Page, list[Frame]]) -> str:
    return flown[0].stage.recorded("hover")


@pytest.fixture(scope="module")
def messages(recording: str) -> list[tuple[float, dict[str, Any]]]:
    """Times [s] and messages of the recording."""
    embedded = re.findall('__VISER_EMBED_DATA__="([^"]+)"', recording)[0]
    data = zstandard.ZstdDecompressor().decompress(base64.b64decode(embedded)[8:])
    held = msgspec.msgpack.decode(data[8 : 8 + int.from_bytes(data[:8], "little")])
    assert held["durationSeconds"] == pytest.approx(0.05 * PERIODS)
    return [(time, message) for time, message in held["messages"]]


def test_two_vehicles_differ_in_colour_and_have_names(flown: tuple[Page, list[Frame]]) -> None:
    scene = flown[0]._server.scene
    for i, title in enumerate(("constrained MPC", "PID")):
        colour = tuple(bytes.fromhex(line_colour(i)[1:]))
        vehicle = f"/flight/vehicle{i}"
        assert tuple(scene.get_handle_by_name(f"{vehicle}/front").color) == colour
        for name in (f"/flight/path{i}", f"/flight/horizon{i}"):
            assert tuple(np.ravel(scene.get_handle_by_name(name).colors)[:3]) == colour
        assert scene.get_handle_by_name(f"{vehicle}/label").text == title
    assert line_colour(0) != line_colour(1)


def test_the_floor_stays_below_the_vehicle_and_keeps_its_pattern(flown: tuple[Page, list[Frame]]) -> None:
    x, y, z = flown[0]._server.scene.get_handle_by_name("/flight/floor").position
    assert max(abs(x - 40.5), abs(y + 30.0)) <= 1.0 + 0.5
    assert (x % 2.0, y % 2.0) == (0.0, 0.0)
    assert z == pytest.approx(flown[0].stage.ground)


@pytest.mark.parametrize(("arm", "side"), [(0.3, 1.0), (0.17, 0.5), (0.046, 0.1), (0.25, 1.0), (5.0, 20.0)])
def test_squares_of_the_floor_suit_the_vehicle(arm: float, side: float) -> None:
    assert look.square_side(arm) == pytest.approx(side)


def test_the_page_has_our_title_icon_and_theme(flown: tuple[Page, list[Frame]]) -> None:
    request = urllib.request.Request(flown[0].address, headers={"Accept-Encoding": "gzip"})
    with urllib.request.urlopen(request) as response:
        page = response.read().decode()
        assert int(response.headers["Content-Length"]) == len(page.encode())
    assert "<title>quadsim live: hover</title>" in page
    assert page.count("<title>") == page.count('rel="icon"') == page.count("data:image/svg") == 1
    assert "%23f56b14" in page.partition("</head>")[0]
    assert "prefers-color-scheme: dark" in page


def test_a_recording_has_every_pose_with_the_first_vehicle_in_the_middle(
    messages: list[tuple[float, dict[str, Any]]], flown: tuple[Page, list[Frame]]
) -> None:
    poses: dict[str, dict[int, Any]] = {"/flight": {}, "/flight/vehicle0": {}, "/flight/vehicle1": {}}
    for time, message in messages:
        if message["type"] == "SetPositionMessage" and message["name"] in poses:
            poses[message["name"]][round(time / 0.05)] = np.array(message["position"])
    for i, frame in enumerate(flown[1]):
        for vehicle, sample in enumerate(frame.samples):
            assert sample is not None
            shown = [at for k, at in poses[f"/flight/vehicle{vehicle}"].items() if k <= i][-1]
            assert shown == pytest.approx(sample.position[-1], abs=1e-4)
        root = [at for k, at in poses["/flight"].items() if k <= i][-1]
        assert root == pytest.approx(-[at for k, at in poses["/flight/vehicle0"].items() if k <= i][-1], abs=1e-4)
    camera = {m["type"]: m for time, m in messages if m["type"].startswith("SetCamera") and time == 0.0}
    assert camera["SetCameraLookAtMessage"]["look_at"] == [0.0, 0.0, 0.0]
    assert math.hypot(*camera["SetCameraPositionMessage"]["position"]) < 12.0 * flown[0].stage.unit


def test_a_recording_plays_from_a_file_without_a_network_in_the_systems_theme(
    browser: Any, recording: str, tmp_path: Path
) -> None:
    (tmp_path / "scene.html").write_text(recording, encoding="utf-8")
    context = browser.new_context(viewport={"width": 320, "height": 240}, color_scheme="dark", offline=True)
    tab = context.new_page()
    tab.set_default_timeout(1e3 * PATIENCE)
    tab.goto((tmp_path / "scene.html").as_uri())
    time = tab.locator("input").first
    time.wait_for()
    seen = {time.input_value()}
    while len(seen) < 3:
        tab.wait_for_timeout(100)
        seen.add(time.input_value())
    assert tab.title() == "hover"
    assert tab.locator("html").get_attribute("data-mantine-color-scheme") == "dark"
    sky = tab.locator("canvas[data-engine]").evaluate("canvas => getComputedStyle(canvas).backgroundImage")
    assert "rgb(14, 22, 33)" in sky
    context.close()


def test_the_reference_is_drawn_where_it_is_on_a_small_course() -> None:
    circle = {"type": "circle", "radius": 0.2, "period": 1.5, "turns": 78.0}
    scenario = load_scenario("hover", ["constraints=[]", "duration=120.0"]).replace({"reference": circle})
    session = Session(scenario)
    followed = session.flights[0].loop.course.preview(0, scenario.periods)[:, :3]
    starts, ends = np.moveaxis(_course(session), 1, 0)
    session.close()
    chords = ends - starts
    for point in followed[::7]:
        along = np.einsum("ij,ij->i", point - starts, chords) / np.maximum(np.square(chords).sum(axis=1), 1e-12)
        nearest = starts + np.clip(along, 0.0, 1.0)[:, None] * chords
        assert np.linalg.norm(point - nearest, axis=1).min() < 0.01, "a chord, or a lap that is left out"
