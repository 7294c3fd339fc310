"""The page of a session: who is let in, what hostile pages change, and what a browser does with it."""

from __future__ import annotations

import asyncio
import math
import re
import shutil
import signal
import socket
import threading
import time as clock
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import msgspec
import numpy as np
import pytest
import viser
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from quadsim.commands.cli import main
from quadsim.console.results import EXIT_DONE, EXIT_WRONG_INPUT
from quadsim.errors import InputError
from quadsim.features.live import serving
from quadsim.features.live.guard import RequestGuard
from quadsim.features.live.incoming import offers
from quadsim.features.live.pace import Pace
from quadsim.features.live.page import Page
from quadsim.features.live.session import Frame, Session
from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.loading import load_scenario

ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
"""Of Chromium where no GPU is."""
PATIENCE = 60.0
"""For anything that a test waits for [s]."""
pytestmark = pytest.mark.slow("live")
PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")


@pytest.mark.representative("live")
@pytest.mark.parametrize(
    ("headers", "query", "let_in"),
    [
        ({"Host": "127.0.0.1:8080"}, "?token={token}", True),
        ({"Host": "localhost:8080", "Cookie": "quadsim-8080={token}"}, "", True),
        ({"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8080", "Cookie": "quadsim-8080={token}"}, "", True),
        ({"Host": "127.0.0.1:8080"}, "", False),
        ({"Host": "127.0.0.1:8080"}, "?token=guessed", False),
        ({"Host": "127.0.0.1:8080", "Cookie": "quadsim-9090={token}"}, "", False),
        ({"Host": "evil.example:8080", "Cookie": "quadsim-8080={token}"}, "", False),
        ({"Host": "127.0.0.1:8080", "Origin": "http://evil.example", "Cookie": "quadsim-8080={token}"}, "", False),
        ({"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:9090", "Cookie": "quadsim-8080={token}"}, "", False),
        ({"Host": "127.0.0.1:8080", "Origin": "null", "Cookie": "quadsim-8080={token}"}, "", False),
        ({"Host": "[::1"}, "?token={token}", False),
        ({"Host": "127.0.0.1:8080", "Origin": "http://[::1"}, "?token={token}", False),
        ({"Host": "127.0.0.1:8080"}, "/[?token=guessed", False),
    ],
)
def test_who_is_let_in(headers: dict[str, str], query: str, let_in: bool) -> None:
    """Who has the token, at this machine's address, from a page of this session."""
    guard = RequestGuard("127.0.0.1")
    filled = {name: value.replace("{token}", guard.token) for name, value in headers.items()}
    path = "/" + query.replace("{token}", guard.token)
    refused = guard.refusal(filled, path, 8080) is not None
    assert refused != let_in


@pytest.mark.parametrize(
    "others",
    [
        'prefs={"theme":"dark","n":1}',
        "sel=[1,2]",
        "user[id]=3",
        "a=hello world",
        "flag",
        "=nameless",
        "name=J\udcfcrgen",
        "exp=Wed, 21 Oct 2026 07:28:00 GMT",
        'q=a"b; c="d',
        "secure; path=/",
        "quadsim-8080=of-an-earlier-session",
        "quadsim-8080=J\udcfcrgen",
    ],
)
def test_cookies_of_other_programs_on_this_host_lock_nobody_out(others: str) -> None:
    guard = RequestGuard("127.0.0.1")
    ours = f"quadsim-8080={guard.token}"

    def refusal(*cookies: str, hosts: tuple[str, ...] = ("127.0.0.1:8080",)) -> str | None:
        headers = Headers()
        for host in hosts:
            headers.set_insecure("Host", host)  # as the library does with what it has received
        for cookie in cookies:
            headers.set_insecure("Cookie", cookie)
        return guard.refusal(headers, "/", 8080)

    assert refusal(f"{others}; {ours}") is None
    assert refusal(f"{ours}; {others}") is None
    assert refusal(f"{others};{ours}") is None
    assert refusal(others, ours) is None
    assert refusal(others) is not None
    assert refusal(ours, hosts=("127.0.0.1:8080", "evil.example")) == "a header is there twice"


@pytest.mark.representative("live")
def test_a_server_that_is_made_past_the_guard_is_not_served(monkeypatch: pytest.MonkeyPatch) -> None:
    """As by a version of viser that does not look `serve` up in the module in which the guard replaces it."""
    module: Any = websockets.asyncio.server
    unguarded = module.serve
    server_class = viser.ViserServer
    made: list[viser.ViserServer] = []

    def past_the_guard(**options: Any) -> viser.ViserServer:
        module.serve = unguarded
        made.append(server_class(**options))
        return made[0]

    monkeypatch.setattr(viser, "ViserServer", past_the_guard)
    rule = "without the token, this one answers 200 and 101 in place of 403"
    session = Session(load_scenario("hover", ["controller.horizon=10"]))
    with closing(session), pytest.raises(InputError, match=rule):
        Page(session, Pace(waiting=True), save=lambda flight: "", others={})
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", made[0].get_port()), timeout=PATIENCE)
    assert module.serve is unguarded


@dataclass
class Served:
    """A session, its page, and what tests ask both of them.

    Attributes:
        session: what flies.
        pace: how fast it flies.
        page: where it is served.
        may_save: whether saving may end.
    """

    session: Session
    pace: Pace
    page: Page
    may_save: threading.Event

    def events(self, kind: str) -> list[Any]:
        """The events of a type so far."""
        return [event for event in self.session.flights[0].scenario.events if event.type == kind]

    def is_pushed(self) -> bool:
        """Whether any push so far had a force."""
        return any(any(event.force) for event in self.events("push"))

    def wait(self, until: Callable[[], bool]) -> None:
        """Wait until a condition holds, and fail if it does not in time."""
        limit = clock.monotonic() + PATIENCE
        while not until():
            assert clock.monotonic() < limit
            clock.sleep(0.02)

    def wait_for_periods(self, count: int) -> None:
        k = self.session.k
        self.wait(lambda: self.session.k > k + count)

    @property
    def url(self) -> str:
        """The address of the page's web socket."""
        return f"ws://{urlsplit(self.page.address).netloc}/"

    @property
    def cookie(self) -> dict[str, str]:
        """The header by which a browser that has opened the page is known."""
        address = urlsplit(self.page.address)
        token = address.query.partition("=")[2]
        return {"Cookie": f"quadsim-{address.port}={token}"}

    def connect(self, **headers: str) -> Any:
        """Open the web socket as a browser does, with its cookie and other headers."""
        return connect(
            self.url,
            subprotocols=[PROTOCOL],
            additional_headers=self.cookie | headers,
            max_size=None,
            close_timeout=0.2,
        )

    @contextmanager
    def driven(self) -> Iterator[threading.Thread]:
        """Fly in a thread until the end of the block."""
        thread = threading.Thread(target=self.pace.drive, args=(self.session, self.page))
        thread.start()
        try:
            yield thread
        finally:
            self.pace.stop()
            thread.join()


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A hover that all tests of the module change one after another; it waits for the first page."""
    target = tmp_path_factory.mktemp("live") / "saved"
    may_save = threading.Event()

    def save(flight: Flight) -> str:
        may_save.wait(PATIENCE)
        flight.save(target, video=False, recording=False, figures=False)
        return str(target)

    pid = load_scenario("hover", ["controller=pid"]).controller
    session = Session(load_scenario("hover", ["controller.horizon=10"]))
    pace = Pace(waiting=True)
    page = Page(session, pace, save=save, others={"PID": pid})
    served = Served(session, pace, page, may_save)
    with served.driven():
        yield served
    page.close()
    session.close()


@pytest.mark.usefixtures("tab")
def test_ten_clients_are_served_and_foreign_ones_are_not(served: Served) -> None:
    foreign = {"Origin": "http://evil.example"}
    for headers in ({}, served.cookie | foreign, served.cookie | {"Host": "evil.example"}):
        with pytest.raises(InvalidStatus, match="403"):
            connect(served.url, subprotocols=[PROTOCOL], additional_headers=headers)
    own = f"http://{urlsplit(served.page.address).netloc}"
    with ExitStack() as stack:
        clients = [stack.enter_context(served.connect(Origin=own)) for _ in range(10)]
        for client in clients:
            for _ in range(3):
                assert client.recv(timeout=PATIENCE), "a message of the page"
        served.wait_for_periods(10)


@pytest.mark.parametrize(
    ("option", "value", "rule"),
    [
        ("--port", "99999", "--port must be from 1 to 65535, or 0 for any that is free; got 99999"),
        ("--host", "no.such.host.invalid", "--host must be an address of this machine"),
    ],
)
def test_an_address_at_which_no_page_can_be_served_is_refused(
    option: str, value: str, rule: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status = main(["live", "hover", "--no-browser", f"{option}={value}", "--out", str(tmp_path / "live")])
    assert status == EXIT_WRONG_INPUT
    assert rule in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("undrawn")
def test_an_interrupt_before_a_page_is_opened_says_that_nothing_was_flown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The flight waits for a page; the command prints the text of the interrupt."""

    def interrupted(pace: Pace, session: Session, page: Page) -> None:
        assert pace.waiting
        raise KeyboardInterrupt

    monkeypatch.setattr(Pace, "drive", interrupted)
    saved = tmp_path / "saved"
    with pytest.raises(KeyboardInterrupt, match=r"had not begun: nothing is written$"):
        main(["live", "hover", "--no-browser", "--set", "controller.horizon=5", "--out", str(saved)])
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("undrawn")
def test_an_interrupt_keeps_what_was_flown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """And ends the server.

    Python's handler of SIGINT is put in place, as a process that a shell starts in the background ignores the signal.
    """
    show = Page.show
    threads_before = {*threading.enumerate()}

    def interrupted(page: Page, frame: Frame, factor: float) -> None:
        show(page, frame, factor)
        if frame.k == 4 and threading.current_thread() is threading.main_thread():
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Page, "show", interrupted)
    monkeypatch.setattr(serving, "Pace", lambda waiting: Pace())  # there is no page to wait for
    saved = tmp_path / "saved"
    handler_before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        status = main(["live", "hover", "--no-browser", "--set", "controller.horizon=5", "--out", str(saved)])
    finally:
        signal.signal(signal.SIGINT, handler_before)
    assert status == EXIT_DONE
    output = capsys.readouterr().out
    (address,) = re.findall(r"Open (\S+[?]token=\S+)", output)
    assert str(saved) in output
    assert load_scenario(str(saved / "scenario.toml")).duration == pytest.approx(0.25)
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(address)
    for thread in {*threading.enumerate()} - threads_before:
        if not thread.daemon:  # it would keep the process from ending
            thread.join(PATIENCE)
            assert not thread.is_alive()


@pytest.mark.usefixtures("undrawn")
def test_a_fault_of_the_page_loses_no_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(page: Page, frame: Frame, factor: float) -> None:
        if frame.k == 4:
            raise ZeroDivisionError("a page")

    monkeypatch.setattr(Page, "show", fails)
    monkeypatch.setattr(serving, "Pace", lambda waiting: Pace())  # there is no page to wait for
    saved = tmp_path / "saved"
    with pytest.raises(ZeroDivisionError):
        serving.fly_live(
            load_scenario("hover", ["controller.horizon=5"]),
            None,
            None,
            onward=False,
            out=saved,
            overwrite=False,
            video=False,
            host="127.0.0.1",
            port=0,
            browser=False,
        )
    assert load_scenario(str(saved / "scenario.toml")).duration == pytest.approx(0.25)


CAMERA = {  # what a browser says of its view before anything else
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [3.0, 3.0, 3.0],
    "fov": 0.8,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 800,
    "image_width": 1200,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}
NUMBERS = (math.nan, math.inf, -1, -math.inf, 1e308, 2**62)
OTHERS = ("x", "0", "nan", None, [], {"a": 1}, b"x", True, [1e308, math.nan], [math.nan] * 3, [1.0] * 7)
HOSTILE: tuple[Any, ...] = NUMBERS + OTHERS
"""Values that a page of ours does not send."""


@pytest.fixture
def flying() -> Iterator[Served]:
    """A session that flies; the test fails if it has ended, whatever was sent to its page."""
    session = Session(load_scenario("playground", ["controller.horizon=5"]))
    pace = Pace()
    page = Page(session, pace, save=lambda flight: "", others={})
    served = Served(session, pace, page, threading.Event())
    with served.driven() as thread:
        yield served
        alive = thread.is_alive()
    page.close()
    session.close()
    assert alive


def joined(served: Served, stack: ExitStack) -> Callable[..., None]:
    """Open a web socket as a page does, and return a function that sends a message from it."""
    clients = len(served.page._server.get_clients())
    page = stack.enter_context(served.connect())

    def send(message: str, **fields: Any) -> None:
        page.send(msgspec.msgpack.encode({"type": message, **fields}))

    send("ViewerCameraMessage", **CAMERA)
    served.wait(lambda: len(served.page._server.get_clients()) > clients)
    return send


def test_hostile_values_change_nothing_and_end_nothing(flying: Served) -> None:
    """The last message, which is not hostile, is obeyed: those before it have been looked at by then."""
    widgets = flying.page._server.gui._gui_input_handle_from_uuid
    values = {uuid: widget.value for uuid, widget in widgets.items() if not widget._impl.is_button}
    (speed,) = [uuid for uuid, widget in widgets.items() if getattr(widget, "label", "") == "Speed"]
    with ExitStack() as stack:
        send = joined(flying, stack)
        for uuid, value in values.items():
            for hostile in HOSTILE:
                if not offers(widgets[uuid], hostile):
                    send("GuiUpdateMessage", uuid=uuid, updates={"value": hostile})
            send("GuiUpdateMessage", uuid=uuid, updates={"value": value, "visible": False})
            send("GuiUpdateMessage", uuid=uuid, updates={"_impl": None})
        for name, impossible in {"position": [math.nan] * 3, "fov": math.inf, "look_at": [1e308] * 3}.items():
            send("ViewerCameraMessage", **CAMERA | {name: impossible})
        send("TransformControlsUpdateMessage", name="/target", wxyz=[1.0, 0.0, 0.0, 0.0], position=[math.nan] * 3)
        send("GuiUpdateMessage", uuid=speed, updates={"value": "0"})
        send("GuiUpdateMessage", uuid=speed, updates={"value": "2"})
        flying.wait(lambda: flying.pace.speed == 2.0)
        flying.wait_for_periods(5)
    assert {uuid: widgets[uuid].value for uuid in values} == values | {speed: "2"}


def test_a_watching_page_changes_nothing_that_the_driver_gives(flying: Served) -> None:
    widgets = flying.page._server.gui._gui_input_handle_from_uuid
    by_label = {getattr(widget, "label", ""): uuid for uuid, widget in widgets.items()}
    payload = by_label["Payload [kg]"]
    take = by_label["Take payload"]
    speed = by_label["Speed"]
    camera = by_label["Camera follows"]
    mass = widgets[payload].value
    with ExitStack() as stack:
        drive = joined(flying, stack)
        watch = joined(flying, stack)
        watch("GuiUpdateMessage", uuid=payload, updates={"value": 0.5 * mass})
        watch("GuiUpdateMessage", uuid=speed, updates={"value": "4"})
        watch("GuiUpdateMessage", uuid=take, updates={"value": True})
        watch("GuiUpdateMessage", uuid=camera, updates={"value": False})
        drive("GuiUpdateMessage", uuid=speed, updates={"value": "2"})
        flying.wait(lambda: flying.pace.speed == 2.0)
        flying.wait_for_periods(5)
        assert flying.pace.speed == 2.0
        assert not flying.events("payload_pickup")
        drive("GuiUpdateMessage", uuid=take, updates={"value": True})
        flying.wait(lambda: bool(flying.events("payload_pickup")))
    assert [event.mass for event in flying.events("payload_pickup")] == [mass]
    assert widgets[camera].value is True


@pytest.fixture
def windy() -> Iterator[Served]:
    """A session in wind, with a mass, a lag and a worn rotor of its own, flown by no thread but the test's."""
    effects = {
        "effects.air.wind": [4.0, 0.0, 0.5],
        "effects.load": {"mass_factor": 1.1},
        "effects.rotors": {"rise": 0.015, "fall": 0.025, "efficiency": [0.9, 1.0, 1.0, 1.0]},
    }
    scenario = load_scenario("playground", ["controller.horizon=10"]).replace(effects)
    session = Session(scenario)
    pace = Pace(waiting=True)
    page = Page(session, pace, save=lambda flight: "", others={})
    yield Served(session, pace, page, threading.Event())
    page.close()
    session.close()


WINDY = {
    "Wind x, y [m/s]": (4.0, 0.0),
    "Mass factor": 1.1,
    "Rotor lag up, down [ms]": (15.0, 25.0),
    "Rotor 1 loss": 0.1,
    "Rotor 2 loss": 0.0,
    "Rotor 3 loss": 0.0,
    "Rotor 4 loss": 0.0,
}
"""What the page of `windy` shows of its disturbances at first."""


def shown_by(served: Served) -> dict[str, Any]:
    """What a page shows of the disturbances, by label."""
    return {label: widget.value for label, (widget, *_) in served.page._widgets._shown.items()}


def give(served: Served, label: str, value: Any) -> None:
    """Change a disturbance as the driver's browser does, and wait for its callbacks."""
    page = served.page
    widget, *_ = page._widgets._shown[label]
    page._driver = 1
    widget.value = value
    event = SimpleNamespace(client=SimpleNamespace(client_id=1), client_id=1, target=widget)
    for callback in widget._impl.update_cb:
        asyncio.run_coroutine_threadsafe(callback(event), page._server.gui._event_loop).result(PATIENCE)


def advance(served: Served, periods: int) -> None:
    """Fly for some periods, which the page shows."""
    for _ in range(periods):
        served.page.show(served.session.advance(), 1.0)


def test_disturbances_show_what_acts_and_change_only_what_was_given(windy: Served) -> None:
    assert shown_by(windy) == WINDY
    advance(windy, 1)
    given = {"Wind x, y [m/s]": (4.0, -2.0), "Rotor lag up, down [ms]": (15.0, 30.0), "Rotor 1 loss": 0.19}
    for label, value in given.items():
        give(windy, label, value)
    advance(windy, 8)
    assert shown_by(windy) == WINDY | given
    acting = windy.session.disturbances
    assert acting.wind == (4.0, -2.0, 0.5)  # the air still rises
    assert acting.mass_factor == 1.1
    assert acting.lag == (0.015, 0.03)
    assert acting.loss == pytest.approx([0.19, 0.0, 0.0, 0.0])


def test_a_disturbance_that_cannot_act_goes_back_to_what_does(windy: Served) -> None:
    """A lag of 0, as the rotors have inertia; a rotor better than new, as the scenario's lacks a tenth."""
    advance(windy, 1)
    give(windy, "Rotor lag up, down [ms]", (15.0, 30.0))
    give(windy, "Rotor 1 loss", 0.19)
    advance(windy, 8)
    give(windy, "Rotor lag up, down [ms]", (15.0, 0.0))
    give(windy, "Rotor 1 loss", 0.0)
    advance(windy, 8)
    assert shown_by(windy) == WINDY | {"Rotor lag up, down [ms]": (15.0, 30.0), "Rotor 1 loss": 0.1}


def test_disturbances_show_an_event_that_the_page_did_not_give_and_a_reset(windy: Served) -> None:
    """As an event of the file, or of a script, would be."""
    windy.session.submit({"type": "wind", "velocity": [1.0, 1.0, 0.0]})
    advance(windy, 9)
    assert shown_by(windy) == WINDY | {"Wind x, y [m/s]": (1.0, 1.0)}
    windy.session.reset()
    windy.page._widgets.reset()
    assert shown_by(windy) == WINDY


def test_plots_have_the_bounds_of_their_signals(windy: Served) -> None:
    """The last lines of the plot of angles are the bounds on roll."""
    advance(windy, 9)
    roll = windy.session.limits[0]
    assert (roll.lower, roll.upper) == (-25.0, 25.0)
    angles = windy.page._plots[1].data
    assert {float(line[-1]) for line in angles[5:]} == {roll.lower, roll.upper}
    speed, deadline = windy.page._bounds[2:4]
    assert [bound.value for bound in speed] == [0.0, 838.0]
    assert [bound.value for bound in deadline] == [50.0]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api", reason="no Playwright here: pip install playwright")
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no Chromium here: install the package 'chromium' to open the page in a browser")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=ARGUMENTS)
        yield browser
        browser.close()


def opened(place: Any, served: Served, **options: Any) -> Any:
    """Open the page of a session in a browser, or in a context of one, and wait until it flies."""
    tab = place.new_page(**options)
    tab.set_default_timeout(1e3 * PATIENCE)
    tab.goto(served.page.address)
    tab.get_by_text("real-time factor").wait_for()
    return tab


def centre_of_scene(tab: Any) -> tuple[float, float]:
    """Where the vehicle is on a page [px]."""
    box = tab.locator("canvas").first.bounding_box()
    return box["x"] + box["width"] / 2.0, box["y"] + box["height"] / 2.0


def inputs_of(tab: Any, label: str) -> Any:
    """The fields beside a label."""
    return tab.locator("label", has_text=label).locator("xpath=ancestor::div[.//input][1]").locator("input")


def slider_of(tab: Any, label: str) -> Any:
    """The slider beside a label."""
    row = tab.locator("label", has_text=label).locator("xpath=ancestor::div[.//*[@role='slider']][1]")
    return row.get_by_role("slider")


@pytest.fixture(scope="module")
def tab(browser: Any, served: Served) -> Iterator[Any]:
    """The page of `served` in a browser, on which tests of the module act one after another."""
    clock.sleep(0.3)
    assert served.session.k == 0, "it flies although no page is open"
    tab = opened(browser, served, viewport={"width": 760, "height": 360})
    yield tab
    tab.close()


WHAT_TO_OPEN = "Open the whole address that quadsim live printed"


@pytest.mark.representative("live")
def test_the_whole_address_opens_the_page_and_the_one_without_its_token_says_what_to_open(served: Served) -> None:
    bare = served.page.address.partition("?")[0]
    with pytest.raises(urllib.error.HTTPError, match="403") as refused:
        urllib.request.urlopen(bare)
    text = refused.value.read().decode()
    assert text.startswith("quadsim: the token is missing, or another session's")
    assert WHAT_TO_OPEN in text
    with urllib.request.urlopen(served.page.address) as response:
        assert "HttpOnly" in response.headers["Set-Cookie"]


def test_a_push_by_the_mouse_acts_and_ends(tab: Any, served: Served) -> None:
    x, y = centre_of_scene(tab)
    tab.get_by_text("Drag the drone").wait_for()
    limit = clock.monotonic() + PATIENCE
    while not served.is_pushed():  # the page has to see the mouse above the vehicle before its button goes down
        assert clock.monotonic() < limit
        tab.mouse.up()
        for i in range(4):
            tab.mouse.move(x + i, y)
            tab.wait_for_timeout(50)
        tab.mouse.down()
        for i in range(8):
            tab.mouse.move(x + 8.0 * i, y - 4.0 * i)
            tab.wait_for_timeout(30)
    tab.mouse.up()
    served.wait(lambda: served.session._held.pull is None)
    tab.get_by_text("Drag the drone").wait_for(state="detached")  # as the hint was followed


def test_inputs_that_cannot_act_are_disabled_with_the_reason(tab: Any) -> None:
    assert tab.get_by_role("button", name="Gust for 1 s").is_disabled()
    assert tab.get_by_text("the vehicle 'lopes2011' states no drag").is_visible()
    assert tab.get_by_role("button", name="Take payload").is_enabled()


def test_keys_and_clicks_give_set_points(tab: Any, served: Served) -> None:
    set_points = partial(served.events, "setpoint")
    tab.keyboard.press("w")
    served.wait(lambda: len(set_points()) > 3)
    assert set_points()[-1].x > set_points()[0].x
    tab.keyboard.press("x")
    served.wait(lambda: not served.session._held.steer.any())
    count = len(set_points())
    box = tab.locator("canvas").first.bounding_box()
    tab.keyboard.down("Shift")
    tab.mouse.click(box["x"] + 0.2 * box["width"], box["y"] + 0.9 * box["height"])
    tab.keyboard.up("Shift")
    served.wait(lambda: len(set_points()) > count)


NO_STICKS = "window.axes = null; navigator.getGamepads = () => [null]"
STICKS = """navigator.getGamepads = () => [null, {connected: true, axes: window.axes}]; window.axes = [0, 0, 0, 0]"""


def test_sticks_steer_beyond_their_dead_zone_and_stop_when_they_are_unplugged(tab: Any, served: Served) -> None:
    def steered() -> list[float]:
        return list(served.session._held.steer)

    tab.evaluate(STICKS)
    tab.evaluate("axes = [0.1, -0.14, 0, 0.1]")
    served.wait_for_periods(10)
    assert steered() == [0.0, 0.0, 0.0], "within the dead zone"
    tab.evaluate("axes = [-1, -0.6, 0, 1]")
    served.wait(lambda: steered() == [1.0, 2.0, -2.0])
    tab.evaluate("axes = [0.36, 0, 0, 0]")
    served.wait(lambda: steered() == [0.0, -0.5, 0.0])
    tab.evaluate(NO_STICKS)
    served.wait(lambda: steered() == [0.0, 0.0, 0.0])


def test_a_slider_turns(tab: Any, served: Served) -> None:
    slider_of(tab, "Mass factor").focus()
    tab.keyboard.press("ArrowRight")
    served.wait(lambda: any(event.factor == 1.01 for event in served.events("mass")))


def test_a_controller_is_changed_in_flight_and_one_that_cannot_be_is_refused(tab: Any, served: Served) -> None:
    tab.get_by_role("tab", name="Controller").click()
    field = inputs_of(tab, "N [periods]")
    field.fill("12")
    field.press("Enter")
    served.wait(lambda: served.session.flights[0].loop.controller.horizon == 12)
    upper_bound = inputs_of(tab, "roll [deg]").last
    upper_bound.fill("-1")  # of a range from -5 on, which is one without 0
    upper_bound.press("Enter")
    tab.get_by_text("a range that contains 0, as in hover").first.wait_for()
    served.wait(lambda: upper_bound.input_value() == "5")  # which flies on
    assert served.session.flights[0].loop.controller.horizon == 12
    assert served.session.reason is None


def test_pause_stands_still_and_save_keeps_what_flies_again_to_the_bit(tab: Any, served: Served) -> None:
    """Steps fly one period each, also while a flight is saved."""
    tab.get_by_role("button", name="Pause", exact=True).click()
    served.wait(lambda: served.pace.paused)
    clock.sleep(0.2)
    k = served.session.k
    clock.sleep(0.2)
    assert served.session.k == k
    tab.get_by_role("button", name="Step", exact=True).click()
    served.wait(lambda: served.session.k == k + 1)
    tab.get_by_role("button", name="Save", exact=True).click()
    tab.get_by_text("saving", exact=True).first.wait_for()
    k = served.session.k
    tab.get_by_role("button", name="Step", exact=True).click()
    served.wait(lambda: served.session.k == k + 1)
    served.may_save.set()
    tab.get_by_text("saved:").first.wait_for()
    tab.get_by_text("paused", exact=True).first.wait_for()
    flight = served.session.flight()
    again = Rollout(flight.scenario).fly()
    assert np.array_equal(again.command, flight.command)
    assert np.array_equal(again.log.plant.state, flight.log.plant.state)
    tab.get_by_role("button", name="Resume", exact=True).click()
    served.wait(lambda: served.session.k > k + 3)


def test_a_reset_puts_everything_back(tab: Any, served: Served) -> None:
    tab.get_by_role("tab", name="Disturb").click()
    tab.get_by_role("button", name="Break a rotor").click()
    tab.get_by_role("button", name="Repair the rotor").wait_for()
    served.wait(lambda: bool(served.events("rotor_loss")))
    tab.get_by_role("tab", name="Controller").click()
    k = served.session.k
    tab.get_by_role("button", name="Reset", exact=True).click()
    served.wait(lambda: served.session.k < k)
    served.wait(lambda: inputs_of(tab, "N [periods]").input_value() == "10")
    tab.get_by_role("tab", name="Disturb").click()
    tab.get_by_role("button", name="Break a rotor").wait_for()
    served.wait(lambda: slider_of(tab, "Mass factor").get_attribute("aria-valuenow") == "1")
    assert served.session.flights[0].loop.controller.horizon == 10


def test_a_page_beside_other_cookies_flies_and_one_without_ours_says_why(browser: Any, windy: Served) -> None:
    domain = urlsplit(windy.page.address).hostname
    with windy.driven(), browser.new_context() as context:
        for name, value in (("prefs", '{"theme":"dark"}'), ("who", "hello world"), ("sel", "[1,2]")):
            context.add_cookies([{"name": name, "value": value, "domain": domain, "path": "/"}])
        tab = opened(context, windy)
        context.clear_cookies()  # as of a browser that keeps none, or a session that has started anew
        tab.get_by_text(WHAT_TO_OPEN).wait_for()


def test_one_component_that_is_typed_leaves_the_other(browser: Any, windy: Served) -> None:
    with windy.driven():
        tab = opened(browser, windy, viewport={"width": 760, "height": 800})
        wind = inputs_of(tab, "Wind x, y")
        assert wind.nth(0).input_value() == "4"
        assert wind.nth(1).input_value() == "0"
        wind.nth(1).fill("-3")
        wind.nth(1).press("Enter")
        windy.wait(lambda: windy.session.disturbances.wind == (4.0, -3.0, 0.5))
        assert windy.session.disturbances.lag == (0.015, 0.025)
        tab.close()


@pytest.fixture(scope="module")
def phone(browser: Any, served: Served) -> Iterator[Any]:
    """The same page on a phone, beside `tab`."""
    context = browser.new_context(viewport={"width": 390, "height": 600}, has_touch=True, is_mobile=True)
    yield opened(context, served)
    context.close()


def test_a_second_page_watches_until_it_takes_the_controls(served: Served, tab: Any, phone: Any) -> None:
    phone.get_by_text("You watch").wait_for()
    faint = "button => getComputedStyle(button).opacity < 1"
    assert phone.get_by_role("button", name="Break a rotor").evaluate(faint)
    assert not phone.get_by_role("button", name="Take the controls").evaluate(faint)
    before = served.pace.paused
    phone.get_by_role("button", name="Pause", exact=True).click()
    phone.get_by_text("Another page has the controls:").first.wait_for()
    assert served.pace.paused == before
    for page in (phone, tab, phone):
        page.get_by_role("button", name="Take the controls").click()
        page.get_by_role("button", name="Take the controls").wait_for(state="hidden")


def test_nothing_is_cut_on_a_phone(phone: Any) -> None:
    assert phone.evaluate("document.documentElement.scrollWidth") <= 390
    assert phone.locator("canvas").first.bounding_box()["width"] == 390
    for cell in ("roll [deg]", "utilisation", "worst"):
        box = phone.get_by_text(cell, exact=True).first.bounding_box()
        assert box["x"] >= 0.0
        assert box["x"] + box["width"] <= 390
    assert phone.get_by_role("tabpanel").bounding_box()["width"] > 360
    assert phone.get_by_text("Shift-click the floor").is_hidden()


def test_a_finger_pulls_and_taps_waypoints(served: Served, phone: Any) -> None:
    phone.get_by_role("button", name="Reset", exact=True).click()
    served.wait(lambda: served.session.k > 5 and not served.is_pushed())
    fingers = phone.context.new_cdp_session(phone)

    def touch(kind: str, *points: tuple[float, float]) -> None:
        at = [{"x": x, "y": y} for x, y in points]
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})

    notices = phone.locator(".mantine-Notification-closeButton")
    while notices.count():
        notices.first.click()  # they lie over the scene
        phone.wait_for_timeout(300)
    limit = clock.monotonic() + PATIENCE
    while not served.is_pushed():
        assert clock.monotonic() < limit
        touch("touchStart", (195, 140))
        for i in range(8):
            touch("touchMove", (195 + 8 * i, 140 - 4 * i))
            phone.wait_for_timeout(50)
        touch("touchEnd")
    served.wait(lambda: served.session._held.pull is None)
    count = len(served.events("setpoint"))
    phone.touchscreen.tap(30, 225)  # the floor
    served.wait(lambda: len(served.events("setpoint")) > count)


def test_a_closed_page_ends_its_push(served: Served, phone: Any) -> None:
    take = phone.get_by_role("button", name="Take the controls")
    if take.is_visible():
        take.click()
        take.wait_for(state="hidden")
    served.session.submit({"type": "pull", "to": [0.1, 0.0, 1.0]}, subject="pull")
    served.wait(lambda: served.session._held.pull is not None)
    phone.close()
    served.wait(lambda: served.session._held.pull is None)
