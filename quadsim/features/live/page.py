"""The page of a live session, drawn by viser.

All clients see the same page; one drives, the others watch.  Callbacks run in viser's thread and do no more than submit
inputs, give orders to the pace and change what is shown.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import math
import socket
import time as clock
import warnings
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
import viser
from viser import _messages

from quadsim.errors import InputError, OutputError, ParameterError
from quadsim.features.live import readout
from quadsim.features.live.controller_tab import ControllerTab
from quadsim.features.live.disturb_tab import disturb
from quadsim.features.live.guard import RequestGuard
from quadsim.features.live.incoming import Incoming
from quadsim.features.live.look import adapted_page
from quadsim.features.live.pace import Pace
from quadsim.features.live.session import Frame, Session
from quadsim.features.live.stage import FIELD, VIEW, Stage
from quadsim.features.live.steering_tab import Steering
from quadsim.features.live.widgets import BREAKS, Widgets
from quadsim.mpc.laws import law_name
from quadsim.palette import COLOUR, CYCLE
from quadsim.report.figure import least_range
from quadsim.rollout.flown import Flight
from quadsim.rotation import quaternion_to_euler
from quadsim.scenarios.schema.controllers import AnyController
from quadsim.sim.physics import Period
from quadsim.state import POSITION, Array, wrapped

SECONDS: Final = 20.0  # of the plots
_PANEL_PERIODS: Final = 4
"""Periods from one update of the panel to the next, a fifth of a second at 20 Hz; plots take two of these."""
_SPEEDS: Final = ("0.1", "0.25", "0.5", "1", "2", "4")
_OPENING: Final = 5.0  # [s] after which a page's camera is where a person has turned it
_PLOTS: Final = {
    "Position error [m]": {"x": "x_error", "y": "y_error", "z": "z_error"},
    "Attitude [deg]": {"roll": "roll", "pitch": "pitch", "tilt": "tilt", "yaw error": "yaw_error"},
    "Rotor speeds [rad/s]": dict.fromkeys(("1", "2", "3", "4"), "speed"),
    "Step [ms]": {"step": ""},
}
"""The signal that a constraint on each curve has, by its label; the step has its deadline."""
_BOUND: Final = {"label": "bound", "stroke": COLOUR.bound, "dash": (6.0, 4.0), "width": 1.0}
_TIME: Final = {"x": {"time": False}}  # not a date
_AXIS: Final = {"ticks": {"show": False}}  # the grid shows where they are
_LOOK: Final = {
    "axes": (_AXIS, {**_AXIS, "size": 62}),  # of x and y; the width [pixels] that "-0.005" takes
    "legend": {"live": False},  # names alone: the values of a cursor are mostly absent
    "padding": (12, 12, 0, 0),  # of half a label beyond the end of an axis [pixels]
}
T = TypeVar("T")


def _reachable(host: str) -> str:
    """Return the host name for links to this server; one address if it listens on all."""
    if host not in ("0.0.0.0", "::"):
        if ":" in host:
            return f"[{host}]"
        return host
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as route, contextlib.suppress(OSError):
        route.connect(("192.0.2.1", 9))  # of a network that is nowhere: nothing is sent
        return str(route.getsockname()[0])
    return "127.0.0.1"


class Page:
    """A session's page, which `pace` drives.

    Args:
        save: writes the run directory of a flight and reports where.
        others: controllers by name that may take over.

    Attributes:
        address: to open.
    """

    def __init__(
        self,
        session: Session,
        pace: Pace,
        *,
        save: Callable[[Flight], str],
        host: str = "127.0.0.1",
        port: int = 0,
        others: Mapping[str, AnyController],
    ) -> None:
        self._session = session
        self._pace = pace
        self._save = save
        title = f"quadsim live: {session.scenario.name}"
        guard = RequestGuard(host)
        listening = self._serve(guard, title, host, port)
        self.address = f"http://{_reachable(host)}:{listening}/?token={guard.token}"
        self._driver: int | None = None
        Incoming(self._server, self._drives)
        self._watcher_widgets: dict[int, list[Any]] = {}  # of each client: a note and a button, shown to watchers
        self._aims: dict[int, Any] = {}  # where each client looks, from the vehicle [m]
        self._history: deque[tuple[float, ...]] = deque(maxlen=round(SECONDS / session.period))
        self._frame: Frame | None = None
        self._factor = 1.0
        self._activity = ""  # what is done beside the flight
        self._used: set[str] = set()  # hints
        self._constraints = readout.Constraints(session.limits)
        self._names = [law_name(flight.loop.controller.name) for flight in session.flights]
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self._server.gui.set_panel_label(title)
        self._server.gui.main_panel.dock_right()
        self.stage = Stage(self._server.scene, session)
        self._away = self.stage.unit * VIEW  # from the vehicle to a page's camera [m]
        start = np.asarray(session.flights[0].loop.course.row(0)[:3])
        camera = self._server.initial_camera
        camera.position = start + self._away
        camera.look_at = start
        camera.fov = FIELD
        self._widgets = Widgets(self._server.gui, session, self._drives)
        self._build(others)
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._left)

    def _serve(self, guard: RequestGuard, title: str, host: str, port: int) -> int:
        """Start the server, which a guard has to protect; return its port.

        Raises:
            ParameterError: the port is taken.
            InputError: the guard does not protect it.
        """
        silent = contextlib.redirect_stdout(io.StringIO())  # viser prints an address that has no token
        with silent, guard.installed(partial(adapted_page, title=title, served=True)):
            self._server: Any = viser.ViserServer(host=host, port=port, label="quadsim live", verbose=False)
        listening: int = self._server.get_port()
        if port not in (0, listening):
            self.close()
            raise ParameterError("", "--port", port, "a port that is free")
        try:
            guard.require_closed(listening)
        except InputError:
            self.close()
            raise
        for message in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):  # a tunnel that any client may open
            self._server._websock_server.unregister_handler(message)
        return listening

    def close(self) -> None:
        """Stop serving."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    # What the thread that flies calls

    def show(self, frame: Frame, factor: float) -> None:
        """Show a flown period."""
        self._frame = frame
        self._factor = factor
        values = [_values(sample) for sample in frame.samples if sample is not None]
        if frame.samples[0] is not None:
            self._history.append((frame.time, *values[0]))
        self._constraints.add(frame)
        with _unless_gone():
            for reason in frame.refused:
                for client in self._server.get_clients().values():
                    client.add_notification("Refused", reason, color="red", auto_close_seconds=8.0)
        is_time_for_panel = frame.k % _PANEL_PERIODS == 0 or self._pace.paused
        is_time_for_plots = frame.k % (2 * _PANEL_PERIODS) == 0 or self._pace.paused
        with self._server.atomic():
            self.stage.show(frame)
            if is_time_for_panel:
                self._show_panel(frame, values)
            if is_time_for_plots and len(self._history) > 1:
                self._show_plots()

    def _show_panel(self, frame: Frame, values: Sequence[_Values]) -> None:
        """Update the panel's texts and widgets; `values` are those of the vehicles that still fly."""
        self._announce()
        self._widgets.follow()
        lost = []
        for flight in self._session.flights[1:]:
            if flight.loop.reason:
                lost.append(f"{law_name(flight.loop.controller.name)} lost: {flight.loop.reason}")
        states = [(value.tilt, math.hypot(value.x, value.y, value.z)) for value in values]
        self._numbers.content = readout.readings(frame, states, lost)
        audited = {limit.name for limit in self._session.limits}
        self._margins.content = self._constraints.rows(frame, audited)

    def _show_plots(self) -> None:
        """Send the plots, which are the most of what is sent: every second period."""
        time, *rows = np.array(self._history)[::2].T
        curves_left = iter(rows)
        ends = {limit.name: limit.stop for limit in self._session.limits}
        for plot, bounds, (title, names) in zip(self._plots, self._bounds, _PLOTS.items(), strict=True):
            lines = [bound.curve(time, ends) for bound in bounds]
            curves = [*islice(curves_left, len(names)), *lines]
            series = _series(names, [bool(np.isfinite(line).any()) for line in lines])
            if series != plot.series:  # which draws the plot anew
                plot.series = series
            unit = title[title.index("[") + 1 : -1]
            least = least_range(curves, unit)
            scales: dict[str, Any] = _TIME
            if least is not None:
                scales = {**_TIME, "y": {"range": least}}
            if scales != plot.scales:  # likewise
                plot.scales = scales
            plot.data = (time, *curves)

    def pose(self, frame: Frame, share: float) -> None:
        """Draw the vehicles, and let cameras follow."""
        with _unless_gone(), self._server.atomic():
            at = self.stage.pose(frame, share)
            if self._follow.value:
                for number, client in self._server.get_clients().items():
                    if number in self._aims:  # where it looks moves with it
                        camera = client.camera
                        camera.position = camera.position + (at + self._aims[number] - camera.look_at)
        self._server.flush()

    def ended(self, reason: str) -> None:
        """Show why the flight ended."""
        self._announce()
        self._numbers.content = readout.says(f"{reason}. Reset begins anew; Save keeps this flight.", "bad")

    # What is on the page

    def _build(self, others: Mapping[str, AnyController]) -> None:
        """Fill the panel; `others` are controllers that may take over."""
        gui = self._server.gui
        gui.add_html(readout.READOUT_STYLE)
        self._overlay = gui.add_html(readout.hints(self._used, self._names))
        self._headline = gui.add_html("")
        self._numbers = gui.add_html(readout.readings(None))
        self._margins = gui.add_html("")
        with gui.add_folder("Run"):
            self._add_run()
        tabs = gui.add_tab_group()
        with tabs.add_tab("Disturb"):
            disturb(self._widgets, self.stage, self._use)
        with tabs.add_tab("Steer"):
            self._steering = Steering(self._widgets, self._server.scene, self.stage, self._use)
        with tabs.add_tab("Controller"):
            self._controller = ControllerTab(self._widgets, others, self._doing)
        with tabs.add_tab("Plots"):
            self._add_plots()
        self._announce()

    def _add_run(self) -> None:
        """Add the buttons of the flight and its outputs, its speed and the camera."""
        gui = self._server.gui
        flight_buttons = {"Pause": self._toggle, "Resume": self._toggle, "Step": self._step}
        self._flight = self._widgets.group("Flight", flight_buttons)  # of the first two one at a time
        outputs = {"Save": self._keep, "Scenario": self._download, "Replay": self._scene}
        self._widgets.group("Output", outputs, hint=readout.OUTPUT)
        speed = gui.add_dropdown("Speed", _SPEEDS, initial_value="1", hint="simulated over real time")
        self._widgets.on(speed.on_update, lambda event: setattr(self._pace, "speed", float(event.target.value)))
        self._follow = gui.add_checkbox("Camera follows", True)
        self._widgets.button("Reset", self._reset, hint="begin anew; what was not saved is lost", color=BREAKS)

    def _add_plots(self) -> None:
        """Add the plots, empty, with a curve for each of their bounds."""
        self._bounds: list[list[_Line]] = []
        self._plots: list[Any] = []
        for title, names in _PLOTS.items():
            bounds = _lines_of(self._session, title)
            curves = [np.zeros(2)] * (len(names) + len(bounds))
            data = (np.array([0.0, 1.0]), *curves)
            series = _series(names, [False] * len(bounds))
            plot = self._server.gui.add_uplot(data, series, scales=_TIME, aspect=1.9, title=title, **_LOOK)
            self._bounds.append(bounds)
            self._plots.append(plot)

    # Buttons

    @contextlib.contextmanager
    def _doing(self, activity: str) -> Iterator[None]:
        """Show at once what is done beside the flight, until it is done."""
        self._activity = activity
        self._announce()
        try:
            yield
        finally:
            self._activity = ""
            self._announce()

    def _announce(self) -> None:
        """Show what the session does now."""
        self._headline.content = readout.status_line(self._state(), self._frame, self._factor)
        if self._pace.paused:
            self._flight.options = ("Resume", "Step")
        else:
            self._flight.options = ("Pause", "Step")

    def _state(self) -> str:
        """Return what the session does now, in a word or two."""
        if self._activity:
            return self._activity
        if self._session.reason is not None:
            return "ended"
        if not self._pace.paused:
            return "flying"
        if self._frame is None:
            return "ready"
        return "paused"

    def _use(self, hint: str) -> None:
        """Take a hint away that a person has followed."""
        if hint not in self._used:
            self._used.add(hint)
            self._overlay.content = readout.hints(self._used, self._names)

    async def _ask(self, question: Callable[[Session], T]) -> T:
        """Return a function of the session, called between two periods in the flying thread."""
        answer: Future[T] = Future()

        def call(session: Session) -> None:
            try:
                answer.set_result(question(session))
            except Exception as error:
                answer.set_exception(error)

        self._pace.order(call)
        return await asyncio.wrap_future(answer)

    def _toggle(self, event: Any) -> None:
        self._pace.paused = not self._pace.paused
        self._announce()

    def _step(self, event: Any) -> None:
        self._pace.paused = True
        self._pace.single()

    async def _reset(self, event: Any) -> None:
        await self._ask(lambda session: session.reset())
        self._frame = None
        self._history.clear()
        for part in (self._constraints, self.stage, self._widgets, self._steering, self._controller):
            part.reset()
        self._announce()

    async def _keep(self, event: Any) -> None:
        """Save what has been flown, beside the flight."""
        with self._doing("saving"):
            try:
                flight = await self._ask(lambda session: session.flight())
                place = await asyncio.to_thread(self._save, flight)
                result = f"saved: {place}, on the machine that flies"
            except (InputError, OutputError) as error:
                result = f"not saved: {error}"
        with _unless_gone():
            event.client.add_notification("Save", result, auto_close_seconds=20.0)

    async def _download(self, event: Any) -> None:
        if self._session.k:
            text = await self._ask(lambda session: session.flight().to_toml())
            _send(event.client, f"{self._session.scenario.name}.toml", text)

    async def _scene(self, event: Any) -> None:
        with self._doing("recording the scene"):
            page = await asyncio.to_thread(self.stage.recorded, self._session.scenario.name)
        _send(event.client, f"{self._session.scenario.name}.html", page)

    # Who drives

    def _drives(self, client: int) -> bool:
        return client == self._driver

    async def _connected(self, client: Any) -> None:
        """Let the first client drive, the others watch."""
        if self._driver is None:
            self._driver = client.client_id
        if self._frame is None and self._pace.waiting:  # the clock starts with the first page
            self._pace.waiting = False
            self._pace.paused = False
            self._announce()
        is_upright = client.camera.aspect < 1.0  # a phone, whose lower half is the panel
        aim = np.zeros(3)
        if is_upright:
            aim[2] = -0.3 * np.linalg.norm(self._away)
            self._add_tapped_floor(client)
        self._follow_with(client, aim)
        watches = self._driver != client.client_id
        note = client.gui.add_html(readout.WATCH, order=-2.0, visible=watches)
        take = client.gui.add_button("Take the controls", order=-1.0, visible=watches, color="orange")
        self._watcher_widgets[client.client_id] = [note, take]
        take.on_click(partial(self._hand_over, client.client_id))

    def _follow_with(self, client: Any, aim: Array) -> None:
        """Let a client's camera follow the vehicle, looking at a point from it [m], once its page has it in place.

        A page reports viser's own place before it receives ours.
        """
        connected = clock.monotonic()

        async def moved(camera: Any) -> None:
            away = camera.position - camera.look_at
            in_place = np.allclose(away, self._away, atol=0.1 * self.stage.unit)
            if in_place or clock.monotonic() > connected + _OPENING:
                self._aims.setdefault(client.client_id, aim)

        client.camera.on_update(moved)

    def _add_tapped_floor(self, client: Any) -> None:
        """Show a phone more of the floor, to tap: it has no Shift key, and viser's own clicks ignore touches."""
        below = (0.0, 0.0, self.stage.ground - self.stage.unit)  # it would hide what is behind it
        floor = client.scene.add_box("/tapped", dimensions=(200.0, 200.0, 1e-3), position=below, opacity=1e-3)
        self._widgets.on(floor.on_click(), self._steering.clicked)
        client.camera.fov = 1.4 * FIELD

    async def _left(self, client: Any) -> None:
        """Forget a client; another one gets its controls."""
        self._aims.pop(client.client_id, None)
        self._watcher_widgets.pop(client.client_id, None)
        if self._driver == client.client_id:
            await self._hand_over(min(self._watcher_widgets, default=None))

    async def _hand_over(self, driver: int | None, event: Any = None) -> None:
        """Give a client the controls; the pull and the manual set-point end."""
        self._session.submit({"type": "pull"}, subject="pull")
        self._steering.stop()
        self._driver = driver
        with _unless_gone():
            for client, widgets in self._watcher_widgets.items():
                for widget in widgets:
                    widget.visible = client != driver


def _series(names: Collection[str], bounds: Collection[bool]) -> tuple[dict[str, Any], ...]:
    """The look of a plot's curves, and of its bounds, which are shown or not: one without values spoils the axis.

    The legend has one entry for all bounds: `readout.READOUT_STYLE` hides the others.
    """
    series: list[dict[str, Any]] = [{"label": "t [s]"}]
    for name, colour in zip(names, CYCLE, strict=False):
        series.append({"label": name, "stroke": colour})
    has_entry = False
    for shown in bounds:
        if shown and not has_entry:
            series.append({**_BOUND, "show": shown})
            has_entry = True
        else:
            series.append({**_BOUND, "class": readout.FURTHER, "show": shown})
    return tuple(series)


@dataclass(frozen=True)
class _Line:
    """A line in a plot."""

    name: str  # of its constraint; empty of the deadline
    value: float
    start: float  # [s]

    def curve(self, time: Array, ends: Mapping[str, float]) -> Array:
        """(M,) its value at times [s], NaN where it does not hold; `ends` has those of the constraints in force [s]."""
        if self.name:
            until = ends.get(self.name, -math.inf)
        else:
            until = math.inf
        return np.where((time >= self.start) & (time <= until), self.value, np.nan)


def _lines_of(session: Session, title: str) -> list[_Line]:
    """Return the bounds of a plot, each once."""
    if title.startswith("Step"):
        return [_Line("", 1e3 * session.period, 0.0)]
    lines = {}
    for limit in session.limits:
        if limit.signal not in _PLOTS[title].values():
            continue
        for value in (limit.lower, limit.upper):
            if math.isfinite(value):
                lines[value, limit.start, limit.stop] = _Line(limit.name, value, limit.start)
    return list(lines.values())


class _Values(NamedTuple):
    """What is plotted of a period, in the order of `_PLOTS`."""

    x: float  # position error [m]
    y: float
    z: float
    roll: float  # [deg]
    pitch: float
    tilt: float
    yaw_error: float
    speed_1: float  # [rad/s]
    speed_2: float
    speed_3: float
    speed_4: float
    step: float  # [ms]


def _values(sample: Period) -> _Values:
    """Return what is plotted of a period; angles at their largest."""
    observed = sample.observation
    _, x, y, _ = sample.attitude.T
    up = 1.0 - 2.0 * (x**2 + y**2)
    tilt = math.degrees(math.acos(np.clip(up.min(), -1.0, 1.0)))
    euler = quaternion_to_euler(sample.attitude)
    roll = math.degrees(max(euler[:, 0].tolist(), key=abs))
    pitch = math.degrees(max(euler[:, 1].tolist(), key=abs))
    yaw_error = math.degrees(wrapped(float(euler[-1, 2] - observed.reference[3])))
    x_error, y_error, z_error = observed.truth[[*POSITION]] - observed.reference[:3]
    speed_1, speed_2, speed_3, speed_4 = sample.speeds
    return _Values(
        x=x_error,
        y=y_error,
        z=z_error,
        roll=roll,
        pitch=pitch,
        tilt=tilt,
        yaw_error=yaw_error,
        speed_1=speed_1,
        speed_2=speed_2,
        speed_3=speed_3,
        speed_4=speed_4,
        step=1e3 * sample.step_s,
    )


@contextlib.contextmanager
def _unless_gone() -> Iterator[None]:
    """Send to clients that may close their page meanwhile, of which viser warns."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r"Queued a \w+ on a closed connection")
        yield


def _send(client: Any, name: str, text: str) -> None:
    client.send_file_download(name, text.encode(), save_immediately=True)
