"""The page of a live session, drawn by viser, which only this module imports.

All clients see the same page; one drives, the others watch.  Callbacks run in viser's thread and do no more than submit
inputs, give orders to the pace and change what is shown.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import inspect
import io
import math
import socket
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from functools import partial
from typing import Any, Final, TypeVar, get_args

import numpy as np

from quadsim.errors import InputError, OutputError, ParameterError
from quadsim.report.figure import LINES
from quadsim.rotation import quaternion_to_euler
from quadsim.vehicle import N_ROTORS
from scenarios.flight import Flight
from scenarios.live import readout
from scenarios.live.knobs import TURNED, Knob, Value, knobs
from scenarios.live.serving import Guard, Pace
from scenarios.live.session import Frame, Session
from scenarios.live.stage import FLAT, Stage
from scenarios.schema.controllers import AnyController
from scenarios.schema.events import SensorText
from scenarios.schema.writing import plain

SECONDS: Final = 20.0  # of the plots
_EVERY: Final = 4
"""Periods from one update of the panel to the next, a fifth of a second at 20 Hz; plots take two of these."""
_SPEEDS: Final = ("0.1", "0.25", "0.5", "1", "2", "4")
_STEER: Final = {"W": (1, 0, 0), "S": (-1, 0, 0), "A": (0, 1, 0), "D": (0, -1, 0), "R": (0, 0, 1), "F": (0, 0, -1)}
"""Keys, and the direction of the set-point's velocity that each adds to."""
_STEER_STEP: Final = 0.5  # [m/s] by which a key changes it
_STEER_MOST: Final = 5.0
_BROKEN: Final = 0.4  # share of its thrust that a rotor loses by the button
_PLOTS: Final = {
    "Position error [m]": ("x", "y", "z"),
    "Tilt and yaw error [deg]": ("tilt", "yaw"),
    "Rotor speeds [rad/s]": ("1", "2", "3", "4"),
    "Step [ms]": ("step",),
}
_SENSORS: Final = get_args(SensorText)
_WIND: Final = {"type": "gust", "velocity": [1.0, 0.0, 0.0], "duration": 1.0}
_LOAD: Final = {"type": "mass", "factor": 1.1}
_LAG: Final = {"type": "rotor_lag", "rise": 0.01}
T = TypeVar("T")


def _reachable(host: str) -> str:
    """Return the host name for links to this server; one address if it listens on all."""
    if host not in ("0.0.0.0", "::"):
        return f"[{host}]" if ":" in host else host
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
        import viser
        from viser import _messages

        self._session, self._pace, self._save, self._others = session, pace, save, others
        guard = Guard(host)
        silent = contextlib.redirect_stdout(io.StringIO())  # viser prints an address that has no token
        with silent, guard.installed():
            self._server: Any = viser.ViserServer(host=host, port=port, label="quadsim live", verbose=False)
        listening = self._server.get_port()
        if port not in (0, listening):
            self.close()
            raise ParameterError("", "--port", port, "a port that is free")
        for message in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):  # a tunnel that any client may open
            self._server._websock_server.unregister_handler(message)
        self.address = f"http://{_reachable(host)}:{listening}/?token={guard.token}"
        self._driver: int | None = None
        self._takes: dict[int, list[Any]] = {}  # of each client, what a watcher sees
        self._aims: dict[int, Any] = {}  # where each client looks, from the vehicle [m]
        self._steer = np.zeros(3)
        self._history: deque[tuple[float, ...]] = deque(maxlen=round(SECONDS / session.period))
        self._frame: Frame | None = None
        self._factor = 1.0
        self._activity = ""  # what is done beside the flight
        self._used: set[str] = set()  # hints
        self._limits = session.limits  # of the flight's start, so that no row goes
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self._server.gui.set_panel_label(f"quadsim live: {session.scenario.name}")
        self._server.gui.main_panel.dock_right()
        self.stage = Stage(self._server.scene, session)
        self._away = self.stage.unit * np.array([-4.0, -6.0, 3.0])
        start = np.asarray(session.flights[0].loop.course.row(0)[:3])
        self._server.initial_camera.position, self._server.initial_camera.look_at = start + self._away, start
        self._fields: dict[str, tuple[Knob, Any]] = {}
        self._groups: list[Any] = []  # folders of fields
        self._rest: list[tuple[Any, Any]] = []  # widgets, and what they are at the start of a flight
        self._build()
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._left)

    def close(self) -> None:
        """Stop serving."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    # What the thread that flies calls

    def show(self, frame: Frame, factor: float) -> None:
        """Show a flown period."""
        self._frame, self._factor = frame, factor
        self._remember(frame)
        with _unless_gone():
            for reason in frame.refused:
                for client in self._server.get_clients().values():
                    client.add_notification("quadsim", f"refused: {reason}")
        with self._server.atomic():
            self.stage.show(frame)
            if frame.k % _EVERY == 0 or self._pace.paused:
                self._announce()
                self._show_numbers(frame)
                audited = {limit.name for limit in self._session.limits}
                self._margins.content = readout.constraint_rows(self._limits, audited, frame)
            if (frame.k % (2 * _EVERY) == 0 or self._pace.paused) and len(self._history) > 1:
                table = np.array(self._history)[::2].T  # plots are the most of what is sent
                first = 1
                for plot, names in zip(self._plots, _PLOTS.values(), strict=True):
                    plot.data = (table[0], *table[first : first + len(names)])
                    first += len(names)

    def pose(self, frame: Frame, share: float) -> None:
        """Draw the vehicles, and let cameras follow."""
        with _unless_gone(), self._server.atomic():
            at = self.stage.pose(frame, share)
            for client in self._server.get_clients().values() if self._follow.value else ():
                if client.client_id in self._aims:
                    _look(client.camera, at + self._aims[client.client_id])
        self._server.flush()

    def ended(self, reason: str | None) -> None:
        """Show why the flight ended, or that it restarted (None)."""
        if reason is not None:
            self._announce()
            self._numbers.content = readout.says(f"{reason}. Reset begins anew; Save keeps this flight.", "bad")
            return
        self._history.clear()
        self._frame = None
        self.stage.reset()
        for widget, value in self._rest:
            widget.value = value
        self._handle.position = np.array(self._place.value)
        self._show_velocity(np.zeros(3))
        self._answer.content = ""
        self._show_knobs(self._session.scenario.controller)
        self._announce()

    # What is on the page

    def _build(self) -> None:
        gui = self._server.gui
        gui.add_html(readout.STYLE)
        self._overlay = gui.add_html(readout.hints(self._used))
        self._headline = gui.add_html("")
        self._numbers = gui.add_html(readout.numbers(None))
        gui.add_html(readout.legend(flight.loop.controller.name for flight in self._session.flights))
        self._margins = gui.add_html("")
        with gui.add_folder("Run"):
            flight = {"Pause": self._toggle, "Step": self._step, "Reset": self._reset}
            self._flight = self._group("Flight", flight | {"Resume": self._toggle}, tuple(flight))
            self._group("Keep", {"Save": self._keep, "Scenario": self._download, "Scene": self._scene})
            speed = gui.add_dropdown("Speed", _SPEEDS, initial_value="1", hint="simulated over real time")
            self._on(speed.on_update, lambda event: setattr(self._pace, "speed", float(event.target.value)))
            self._follow = gui.add_checkbox("Camera follows", True)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Disturb"):
            self._disturbances()
        with tabs.add_tab("Steer"):
            self._targets()
        with tabs.add_tab("Controller"):
            chosen = gui.add_dropdown("Controller", ["as started", *self._others])
            self._button("Take this controller", lambda event: self._take(chosen.value))
            self._answer = gui.add_html("")
            self._knobs_folder = gui.add_folder(None)
            self._show_knobs(self._session.scenario.controller)
        with tabs.add_tab("Plots"):
            self._plots = [
                gui.add_uplot(
                    (np.array([0.0, 1.0]), *([np.zeros(2)] * len(names))),
                    ({"label": "t [s]"}, *({"label": n, "stroke": c} for n, c in zip(names, LINES, strict=False))),
                    scales={"x": {"time": False}},
                    aspect=1.9,
                    title=title,
                )
                for title, names in _PLOTS.items()
            ]
        self._announce()

    def _disturbances(self) -> None:
        """Every event that this scenario can have; the others are disabled, with the reason."""
        gui, mass = self._server.gui, self._session.flights[0].actual.mass
        sensors = [{"type": "sensor_fault", "sensor": name, "fault": "nan", "duration": 1.0} for name in _SENSORS]
        no_wind, no_load, no_lag, *blind = self._session.refusals([_WIND, _LOAD, _LAG, *sensors])

        def pulled(event: Any) -> None:
            to = None if event.phase == "end" else [float(number) for number in event.end_position]
            self._session.submit({"type": "pull", "to": to}, subject="pull")
            self._use("pull")

        def broken(event: Any) -> None:
            self._use("break")
            wear[0].value = _BROKEN
            self._session.submit(_wear(1, _BROKEN), subject=wear[0].label)

        self._on(self.stage.grab.on_drag("left"), pulled)
        self._button("Break a rotor", broken, hint=f"rotor 1 loses {100 * _BROKEN:.0f} % of its thrust")
        wear = [gui.add_slider(f"Rotor {rotor} loss", 0.0, 1.0, 0.05, 0.0) for rotor in range(1, N_ROTORS + 1)]
        for rotor, slider in enumerate(wear, 1):
            self._submits(slider, partial(_wear, rotor))
        box = {"min": (-15.0, -15.0), "max": (15.0, 15.0), "step": 0.5, "disabled": bool(no_wind)}
        gust = gui.add_vector2("Gust x, y [m/s]", (6.0, 0.0), **box)
        self._event("Gust for 1 s", lambda: _WIND | {"velocity": [*map(float, gust.value), 0.0]}, no_wind)
        wind = gui.add_vector2("Wind x, y [m/s]", (0.0, 0.0), **box)
        self._submits(wind, lambda value: {"type": "wind", "velocity": [*map(float, value), 0.0]})
        gui.add_html(readout.says(no_wind, "why"))
        off = bool(no_load)
        factor = gui.add_slider("Mass factor", 0.7, 1.5, 0.01, 1.0, disabled=off)
        self._submits(factor, lambda value: {"type": "mass", "factor": float(value)})
        step = round(0.01 * mass, 5)
        load = gui.add_number("Payload [kg]", round(0.1 * mass, 4), min=0.0, max=mass, step=step, disabled=off)
        self._event("Take payload", lambda: {"type": "payload_pickup", "mass": float(load.value)}, no_load)
        self._event("Drop payload", lambda: {"type": "payload_drop"}, no_load)
        gui.add_html(readout.says(no_load, "why"))
        lag = gui.add_slider("Rotor lag [ms]", 0, 100, 5, 0, disabled=bool(no_lag))
        self._submits(lag, lambda value: {"type": "rotor_lag", "rise": float(value) / 1e3})
        gui.add_html(readout.says(no_lag, "why"))
        seen = [name for name, reason in zip(_SENSORS, blind, strict=True) if not reason]
        sensor = gui.add_dropdown("Sensor", seen or _SENSORS, disabled=not seen)
        fault = gui.add_dropdown("Fault", ("dropout", "freeze", "nan"), disabled=not seen)
        no_fault = "" if seen else blind[0]
        self._event(
            "Fail sensor for 1 s", lambda: sensors[0] | {"sensor": sensor.value, "fault": fault.value}, no_fault
        )
        late = gui.add_number("Late commands [ms]", 200, min=10, max=5000, step=10)
        self._event("Stall the computer", lambda: {"type": "stall", "duration": float(late.value) / 1e3})

    def _targets(self) -> None:
        gui, scene = self._server.gui, self._server.scene
        gui.add_html(readout.block(readout.STEER, "why"))
        here = np.asarray(self._session.flights[0].loop.course.row(0)[:3])
        self._handle = scene.add_transform_controls(
            "/target",
            scale=3.0 * self.stage.unit,
            position=here,
            disable_rotations=True,
            disable_sliders=True,
            visible=False,  # it would lie over the vehicle, and take its pulls
        )
        arrows = gui.add_checkbox("Arrows to drag", False)
        self._on(arrows.on_update, lambda event: setattr(self._handle, "visible", event.target.value))
        self._place = gui.add_vector3("Set-point [m]", tuple(map(float, here)), step=0.1)
        self._rest.append((self._place, self._place.value))
        self._on(self._handle.on_update, lambda event: self._set_point(event.target.position))
        self._on(self._place.on_update, lambda event: self._set_point(event.target.value))
        self._on(scene.on_click(modifier="shift"), self._clicked)
        yaw = gui.add_slider("Yaw [deg]", -180, 180, 5, 0)
        self._submits(yaw, lambda value: {"type": "setpoint", "yaw": float(value)})
        self._steered = gui.add_text("Set-point velocity [m/s]", "0, 0, 0", disabled=True)
        for key, direction in _STEER.items():
            command = gui.add_command(f"Fly {'-+'[sum(direction) > 0]}{'xyz'[np.abs(direction).argmax()]}", hotkey=key)
            self._on(command.on_trigger, partial(self._fly_on, _STEER_STEP * np.array(direction)))
        self._on(gui.add_command("Stop the set-point", hotkey="X").on_trigger, lambda event: self._fly(np.zeros(3)))
        self._button("Stop set-point", lambda event: self._fly(np.zeros(3)))

    def _clicked(self, event: Any) -> None:
        """Fly to the point of the ground that was clicked, at the set-point's height."""
        origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
        if origin[2] * direction[2] < 0.0:  # it meets the ground
            meets = origin - origin[2] / direction[2] * direction
            sample = None if self._frame is None else self._frame.samples[0]
            height = self._place.value[2] if sample is None else sample.observation.reference[2]
            self._set_point((*meets[:2], height))
            self._use("waypoint")

    def _set_point(self, at: Any) -> None:
        self._fly(np.zeros(3))
        x, y, z = (round(float(number), 2) for number in at)
        self._handle.position, self._place.value = np.array([x, y, z]), (x, y, z)
        self._session.submit({"type": "setpoint", "x": x, "y": y, "z": z}, subject="setpoint")

    def _fly_on(self, change: Any, event: Any) -> None:
        self._fly(self._steer + change)

    def _fly(self, velocity: Any) -> None:
        self._show_velocity(np.clip(velocity, -_STEER_MOST, _STEER_MOST))
        self._session.submit({"type": "steer", "velocity": self._steer.tolist()}, subject="steer")

    def _show_velocity(self, velocity: Any) -> None:
        self._steer = velocity
        self._steered.value = ", ".join(f"{speed:g}" for speed in velocity)

    def _show_knobs(self, spec: AnyController) -> None:
        while self._groups:
            self._groups.pop().remove()
        self._fields.clear()
        fields = {knob.path: knob for knob in knobs(spec)}
        with self._knobs_folder:
            groups = {
                title: [(fields.pop(path), label) for path, label in turned.items() if path in fields]
                for title, turned in TURNED.items()
            }
            for title, group in {**groups, "All fields": [(knob, knob.path) for knob in fields.values()]}.items():
                if not group:
                    continue
                self._groups.append(self._server.gui.add_folder(title, expand_by_default=title != "All fields"))
                with self._groups[-1]:
                    for knob, label in group:
                        handle = self._input(knob, label)
                        self._fields[knob.path] = knob, handle
                        self._on(handle.on_update, partial(self._turn, knob.path))

    def _input(self, knob: Knob, label: str) -> Any:
        """The widget of a field."""
        gui, value, look = self._server.gui, knob.value, {"hint": knob.about}
        if isinstance(value, bool):
            return gui.add_checkbox(label, value, **look)
        if isinstance(value, str):
            return gui.add_dropdown(label, knob.choices, initial_value=value, **look)
        if isinstance(value, tuple):
            ends = {
                name: None if end is None else (end, end)
                for name, end in (("min", knob.minimum), ("max", knob.maximum))
            }
            return gui.add_vector2(label, value, step=0.1, **ends, **look)
        step = 1 if isinstance(value, int) else None
        return gui.add_number(label, value, step=step, min=knob.minimum, max=knob.maximum, **look)

    async def _turn(self, path: str, event: Any) -> None:
        if path not in self._fields:  # of a controller that was replaced meanwhile
            return
        knob, handle = self._fields[path]
        if handle.value == knob.value:
            return
        value: Value = handle.value
        if await self._replace({path: value}, f"{path} = {value}"):
            self._fields[path] = dataclasses.replace(knob, value=value), handle
        else:
            handle.value = knob.value

    async def _take(self, name: str) -> None:
        spec = self._session.scenario.controller if name == "as started" else self._others[name]
        if await self._replace(plain(spec), name):
            self._show_knobs(spec)

    async def _replace(self, fields: Mapping[str, Any], what: str) -> bool:
        """Build a controller in the background and let it take over; if that fails, report why."""
        with self._doing("building the controller"):
            try:
                successor = await asyncio.to_thread(self._session.successor, fields)
            except InputError as error:
                self._answer.content = readout.says(f"Refused, the controller before flies on: {error}", "bad")
                return False
        self._session.submit({"type": "controller", "fields": dict(fields)}, successor=successor)
        self._answer.content = readout.says(f"Flies from the next period on: {what}")
        return True

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
        if self._activity:
            state, kind = self._activity, "busy"
        elif self._session.reason is not None:
            state, kind = "ended", "ended"
        elif self._pace.paused:
            state, kind = "paused" if self._frame is not None else "ready", "paused"
        else:
            state, kind = "flying", "flying"
        self._headline.content = readout.headline(state, kind, self._frame, self._factor)
        self._flight.options = ("Resume" if self._pace.paused else "Pause", "Step", "Reset")

    def _use(self, hint: str) -> None:
        """Take a hint away that a person has followed."""
        if hint not in self._used:
            self._used.add(hint)
            self._overlay.content = readout.hints(self._used)

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
        self.ended(None)

    async def _keep(self, event: Any) -> None:
        """Save what has been flown, beside the flight."""
        with self._doing("saving"):
            try:
                flight = await self._ask(lambda session: session.flight())
                result = f"saved: {await asyncio.to_thread(self._save, flight)}"
            except (InputError, OutputError) as error:
                result = f"not saved: {error}"
        with _unless_gone():
            event.client.add_notification("Save", result)

    async def _download(self, event: Any) -> None:
        if self._session.k:
            text = await self._ask(lambda session: session.flight().scenario.to_toml())
            _send(event.client, f"{self._session.scenario.name}.toml", text)

    def _scene(self, event: Any) -> None:
        _send(event.client, f"{self._session.scenario.name}.html", self._server.scene.as_html())

    # Who drives

    async def _connected(self, client: Any) -> None:
        if self._driver is None:
            self._driver = client.client_id
        if self._frame is None and self._pace.waiting:  # the clock starts with the first page
            self._pace.waiting = self._pace.paused = False
            self._announce()
        upright = client.camera.aspect < 1.0  # a phone, whose lower half is the panel
        aim = np.array([0.0, 0.0, -0.36 * np.linalg.norm(self._away)]) * upright

        async def moved(camera: Any) -> None:
            if not np.allclose(camera.position, 3.0):  # viser's own place, until the page hears of ours
                self._aims.setdefault(client.client_id, aim)

        client.camera.on_update(moved)
        if upright:  # it has no Shift key, and viser's clicks of the scene ignore touches
            floor = client.scene.add_box("/tapped", dimensions=(200.0, 200.0, 1e-3), opacity=0.001, **FLAT)
            self._on(floor.on_click(), self._clicked)
        watches = self._driver != client.client_id
        note = client.gui.add_html(readout.says(readout.WATCH, "watch"), order=-2.0, visible=watches)
        take = client.gui.add_button("Take the controls", order=-1.0, visible=watches)
        self._takes[client.client_id] = [note, take]

        async def taken(event: Any) -> None:
            self._hand_over(client.client_id)

        take.on_click(taken)

    async def _left(self, client: Any) -> None:
        self._aims.pop(client.client_id, None)
        self._takes.pop(client.client_id, None)
        if self._driver == client.client_id:
            self._hand_over(min(self._takes, default=None))

    def _hand_over(self, driver: int | None) -> None:
        """Give a client the controls; the pull and the manual set-point end."""
        self._session.submit({"type": "pull"}, subject="pull")
        self._fly(np.zeros(3))
        self._driver = driver
        for client, widgets in self._takes.items():
            for widget in widgets:
                widget.visible = client != driver

    def _on(self, register: Callable[[Any], Any], act: Callable[[Any], Any]) -> None:
        """Call a function for changes by the driving client, not for changes by Python, which have no client."""

        async def called(event: Any) -> None:  # a plain function would run in one of many threads
            if event.client is None:
                return
            if event.client.client_id != self._driver:
                text = "Another page has the controls: Take the controls changes that."
                event.client.add_notification("You watch", text)
            elif inspect.isawaitable(result := act(event)):
                await result

        register(called)

    def _button(self, label: str, act: Callable[[Any], Any], **look: Any) -> None:
        self._on(self._server.gui.add_button(label, **look).on_click, act)

    def _event(self, label: str, table: Callable[[], Mapping[str, Any]], refused: str = "") -> None:
        """A button that submits an event, if this scenario can have it."""
        self._button(label, lambda event: self._session.submit(table()), disabled=bool(refused))

    def _group(self, label: str, acts: Mapping[str, Callable[[Any], Any]], shown: tuple[str, ...] = ()) -> Any:
        """Buttons in a row."""
        buttons = self._server.gui.add_button_group(label, shown or tuple(acts))
        self._on(buttons.on_click, lambda event: acts[event.target.value](event))
        return buttons

    def _submits(self, widget: Any, table: Callable[[Any], Mapping[str, Any]]) -> None:
        """Submit an input made of a widget's value whenever the driving client changes that."""
        self._rest.append((widget, widget.value))
        self._on(widget.on_update, lambda event: self._session.submit(table(event.target.value), subject=widget.label))

    # Numbers

    def _remember(self, frame: Frame) -> None:
        sample = frame.samples[0]
        if sample is None:
            return
        observed, physics = sample.observation, sample.segment.physics[-1]
        error = observed.truth[[0, 2, 4]] - observed.reference[:3]
        yaw = quaternion_to_euler(physics[None, 4:8])[0, 2] - observed.reference[3]
        up = 1.0 - 2.0 * (physics[5] ** 2 + physics[6] ** 2)
        tilt = math.degrees(math.acos(min(1.0, max(-1.0, up))))
        yaw = math.degrees(math.remainder(yaw, 2.0 * math.pi))
        self._history.append((frame.time, *error, tilt, yaw, *sample.speeds, 1e3 * sample.step_s))

    def _show_numbers(self, frame: Frame) -> None:
        sample, others = frame.samples[0], [flight.loop for flight in self._session.flights[1:]]
        if sample is not None and self._history:
            lost = [f"{other.controller.name} was lost: {other.reason}" for other in others if other.reason is not None]
            now = self._history[-1]
            error = float(np.linalg.norm(now[1:4]))
            self._numbers.content = readout.numbers(frame, sample, tilt=now[4], error=error, lost=lost)


@contextlib.contextmanager
def _unless_gone() -> Iterator[None]:
    """Send to clients that may close their page meanwhile, of which viser warns."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r"Queued a \w+ on a closed connection")
        yield


def _wear(rotor: int, loss: Any) -> dict[str, Any]:
    return {"type": "wear", "rotor": rotor, "loss": float(loss)}


def _look(camera: Any, at: Any) -> None:
    """Turn a camera to a point [m], from as far away as it is."""
    away = np.asarray(camera.position) - camera.look_at
    camera.position = at + away  # which moves where it looks
    camera.look_at = at


def _send(client: Any, name: str, text: str) -> None:
    client.send_file_download(name, text.encode(), save_immediately=True)
