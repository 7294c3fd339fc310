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
from functools import partial
from html import escape
from typing import Any, Final

import numpy as np

from quadsim.controller import OPTIMAL
from quadsim.errors import InputError, OutputError, ParameterError
from quadsim.flight.audit import Limit
from quadsim.report.figure import BOUND, LINES
from quadsim.rotation import quaternion_to_euler
from quadsim.vehicle import N_ROTORS
from scenarios.live.knobs import Knob, Value, knobs
from scenarios.live.look import dressed
from scenarios.live.serving import Guard, Pace
from scenarios.live.session import Frame, Session
from scenarios.live.stage import FIELD, VIEW, Stage
from scenarios.schema.controllers import AnyController
from scenarios.schema.writing import plain

SECONDS: Final = 20.0  # of the plots
_EVERY: Final = 4
"""Periods from one update of the panel to the next, a fifth of a second at 20 Hz; plots take two of these."""
_SPEEDS: Final = ("0.1", "0.25", "0.5", "1", "2", "4")
_STEER: Final = {"W": (1, 0, 0), "S": (-1, 0, 0), "A": (0, 1, 0), "D": (0, -1, 0), "R": (0, 0, 1), "F": (0, 0, -1)}
"""Keys, and the direction of the set-point's velocity that each adds to."""
_STEER_STEP: Final = 0.5  # [m/s] by which a key changes it
_STEER_MOST: Final = 5.0
_ACTIVE: Final = 0.1  # share of a bound's scale within which a margin counts as active
_PLOTS: Final = {
    "Position error [m]": ("x", "y", "z"),
    "Tilt and yaw error [deg]": ("tilt", "yaw"),
    "Rotor speeds [rad/s]": ("1", "2", "3", "4"),
    "Step [ms]": ("step",),
}

STYLE: Final = """<style>
.q{font:12px/1.45 system-ui,sans-serif;padding:0 .6em}.q b{font-variant-numeric:tabular-nums}
.q table{width:100%;border-collapse:collapse}.q td{padding:1px 4px 1px 0;white-space:nowrap}
.q .t{width:30%;min-width:40px}.q .r{position:relative;height:9px;background:#8884;border-radius:3px;overflow:hidden}
.q .f{position:absolute;left:0;top:0;bottom:0;border-radius:3px}
.q .n{text-align:right;font-variant-numeric:tabular-nums}
.q .w{width:3.9em;font-size:11px}.q .bad{color:#dc2f38;font-weight:600}.q .act{font-weight:600}.q .act .w{color:#b26b00}
</style>"""


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
        save: writes the run directory of what has been flown and reports where; in the simulation thread.
        others: controllers by name that may take over.

    Attributes:
        address: to open.
    """

    def __init__(
        self,
        session: Session,
        pace: Pace,
        *,
        save: Callable[[Session], str],
        host: str = "127.0.0.1",
        port: int = 0,
        others: Mapping[str, AnyController],
    ) -> None:
        import viser
        from viser import _messages

        self._session, self._pace, self._save, self._others = session, pace, save, others
        guard = Guard(host)
        silent = contextlib.redirect_stdout(io.StringIO())  # viser prints an address that has no token
        self._title = f"quadsim live: {session.scenario.name}"
        with silent, guard.installed(partial(dressed, title=self._title)):
            self._server: Any = viser.ViserServer(host=host, port=port, label="quadsim live", verbose=False)
        listening = self._server.get_port()
        if port not in (0, listening):
            self.close()
            raise ParameterError("", "--port", port, "a port that is free")
        for message in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):  # a tunnel that any client may open
            self._server._websock_server.unregister_handler(message)
        self.address = f"http://{_reachable(host)}:{listening}/?token={guard.token}"
        self._driver: int | None = None
        self._takes: dict[int, Any] = {}  # the button of each client that takes the controls
        self._aims: dict[int, Any] = {}  # where each client looks, from the vehicle [m]
        self._steer = np.zeros(3)
        self._history: deque[tuple[float, ...]] = deque(maxlen=round(SECONDS / session.period))
        self._frame: Frame | None = None
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self._server.gui.set_panel_label(self._title)
        self._server.initial_camera.fov = FIELD
        self.stage = Stage(self._server.scene, session)
        self._fields: dict[str, tuple[Knob, list[Any]]] = {}
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
        self._frame = frame
        self._remember(frame)
        with _unless_gone():
            for reason in frame.refused:
                for client in self._server.get_clients().values():
                    client.add_notification("quadsim", f"refused: {reason}")
        with self._server.atomic():
            self.stage.show(frame)
            if frame.k % _EVERY == 0 or self._pace.paused:
                self._status.content = self._state(frame, factor)
                other = self._session.flights[-1].loop.controller.name
                self._margins.content = _bars(self._session.limits, frame, other)
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
            self._status.content = _says(f"{reason}. Reset begins anew; Save keeps it.", "bad")
            return
        self._history.clear()
        self.stage.reset()
        for widget, value in self._rest:
            widget.value = value
        self._handle.position = np.array(self._place.value)
        self._show_velocity(np.zeros(3))
        self._answer.content = ""
        self._show_knobs(self._session.scenario.controller)

    # What is on the page

    def _build(self) -> None:
        gui = self._server.gui
        self._status = gui.add_html(_says("starting"))
        self._margins = gui.add_html("")
        with gui.add_folder("Run"):
            self._group("Flight", {"Pause": self._toggle, "Step": self._step, "Reset": self._between(self._reset)})
            speed = gui.add_dropdown("Speed", _SPEEDS, initial_value="1", hint="simulated over real time")
            self._on(speed.on_update, lambda event: setattr(self._pace, "speed", float(event.target.value)))
            self._follow = gui.add_checkbox("Camera follows", True)
            keep = {"Save": self._between(self._keep), "Scenario": self._between(self._download), "Scene": self._scene}
            self._group("Keep", keep)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Push"):
            self._pushes()
        with tabs.add_tab("Target"):
            self._targets()
        with tabs.add_tab("Controller"):
            chosen = gui.add_dropdown("Controller", ["as started", *self._others])
            self._answer = gui.add_html("")
            self._button("Take this controller", lambda event: self._take(chosen.value))
            self._knobs_folder = gui.add_folder("Fields")
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

    def _pushes(self) -> None:
        gui = self._server.gui
        gui.add_markdown("Drag the vehicle with the mouse to pull it.")

        def pulled(event: Any) -> None:
            to = None if event.phase == "end" else [float(number) for number in event.end_position]
            self._session.submit({"type": "pull", "to": to}, subject="pull")

        self._on(self.stage.grab.on_drag("left"), pulled)
        wind = gui.add_vector2("Wind x, y [m/s]", (0.0, 0.0), min=(-12.0, -12.0), max=(12.0, 12.0), step=0.5)
        self._submits(wind, lambda value: {"type": "wind", "velocity": [*map(float, value), 0.0]})
        gust = gui.add_vector2("Gust x, y [m/s]", (6.0, 0.0), min=(-15.0, -15.0), max=(15.0, 15.0), step=0.5)
        self._event("Gust", lambda: {"type": "gust", "velocity": [*map(float, gust.value), 0.0], "duration": 1.0})
        mass = self._session.flights[0].actual.mass
        load = gui.add_number("Payload [kg]", round(0.1 * mass, 4), min=0.0, max=mass, step=round(0.01 * mass, 5))
        self._event("Take payload", lambda: {"type": "payload_pickup", "mass": float(load.value)})
        self._event("Drop payload", lambda: {"type": "payload_drop"})
        factor = gui.add_slider("Mass factor", 0.7, 1.5, 0.01, 1.0)
        self._submits(factor, lambda value: {"type": "mass", "factor": float(value)})
        lag = gui.add_slider("Rotor lag [ms]", 0, 100, 5, 0)
        self._submits(lag, lambda value: {"type": "rotor_lag", "rise": float(value) / 1e3})
        for rotor in range(1, N_ROTORS + 1):
            wear = gui.add_slider(f"Rotor {rotor} loss", 0.0, 1.0, 0.05, 0.0)
            self._submits(wear, partial(_wear, rotor))
        sensor = gui.add_dropdown("Sensor", ("position", "velocity", "attitude", "rates"))
        fault = gui.add_dropdown("Fault", ("dropout", "freeze", "nan"))
        failed = {"type": "sensor_fault", "duration": 1.0}
        self._event("Fail sensor for 1 s", lambda: {**failed, "sensor": sensor.value, "fault": fault.value})
        late = gui.add_number("Late commands [ms]", 200, min=10, max=5000, step=10)
        self._event("Stall the computer", lambda: {"type": "stall", "duration": float(late.value) / 1e3})

    def _targets(self) -> None:
        gui, scene = self._server.gui, self._server.scene
        gui.add_markdown(
            "Drag the arrows beside the vehicle's goal, shift-click on the ground, or type. Keys W, S, A, D, R, F fly "
            "the set-point along x, y and z; X stops it."
        )
        here = np.asarray(self._session.flights[0].loop.course.row(0)[:3])
        self._handle = scene.add_transform_controls(
            "/target", scale=3.0 * self.stage.unit, position=here, disable_rotations=True, disable_sliders=True
        )
        self._place = gui.add_vector3("Set-point [m]", tuple(map(float, here)), step=0.1)
        self._rest.append((self._place, self._place.value))

        def clicked(event: Any) -> None:
            origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
            above = origin[2] - self.stage.ground
            if above * direction[2] < 0.0:  # it meets the ground
                meets = origin - above / direction[2] * direction
                sample = None if self._frame is None else self._frame.samples[0]
                height = self._place.value[2] if sample is None else sample.observation.reference[2]
                self._set_point((*meets[:2], height))

        self._on(self._handle.on_update, lambda event: self._set_point(event.target.position))
        self._on(self._place.on_update, lambda event: self._set_point(event.target.value))
        self._on(scene.on_click(modifier="shift"), clicked)
        yaw = gui.add_slider("Yaw [deg]", -180, 180, 5, 0)
        self._submits(yaw, lambda value: {"type": "setpoint", "yaw": float(value)})
        self._steered = gui.add_text("Set-point velocity [m/s]", "0, 0, 0", disabled=True)
        for key, direction in _STEER.items():
            command = gui.add_command(f"Fly {'-+'[sum(direction) > 0]}{'xyz'[np.abs(direction).argmax()]}", hotkey=key)
            self._on(command.on_trigger, partial(self._fly_on, _STEER_STEP * np.array(direction)))
        self._on(gui.add_command("Stop the set-point", hotkey="X").on_trigger, lambda event: self._fly(np.zeros(3)))
        self._button("Stop set-point", lambda event: self._fly(np.zeros(3)))

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
        for _, handles in self._fields.values():
            for handle in handles:
                handle.remove()
        self._fields.clear()
        with self._knobs_folder:
            for knob in knobs(spec):
                handles = self._inputs(knob)
                self._fields[knob.path] = knob, handles
                for handle in handles:
                    self._on(handle.on_update, partial(self._turn, knob.path))

    def _inputs(self, knob: Knob) -> list[Any]:
        """The widgets of a field: two for a pair."""
        gui, value = self._server.gui, knob.value
        if isinstance(value, bool):
            return [gui.add_checkbox(knob.path, value, hint=knob.about)]
        if isinstance(value, str):
            return [gui.add_dropdown(knob.path, knob.choices, initial_value=value, hint=knob.about)]
        look = {"min": knob.minimum, "max": knob.maximum, "hint": knob.about}
        if isinstance(value, tuple):
            names = (f"{knob.path} lower", f"{knob.path} upper")
            return [gui.add_number(name, bound, **look) for name, bound in zip(names, value, strict=True)]
        return [gui.add_number(knob.path, value, step=1 if isinstance(value, int) else None, **look)]

    async def _turn(self, path: str, event: Any) -> None:
        if path not in self._fields:  # of a controller that was replaced meanwhile
            return
        knob, handles = self._fields[path]
        values = tuple(number.value for number in handles)
        value: Value = values[0] if len(handles) == 1 else values
        if await self._replace({path: value}, f"{path} = {value}"):
            self._fields[path] = dataclasses.replace(knob, value=value), handles
            return
        before = knob.value if isinstance(knob.value, tuple) else (knob.value,)
        for handle, number in zip(handles, before, strict=True):
            handle.value = number

    async def _take(self, name: str) -> None:
        spec = self._session.scenario.controller if name == "as started" else self._others[name]
        if await self._replace(plain(spec), name):
            self._show_knobs(spec)

    async def _replace(self, fields: Mapping[str, Any], what: str) -> bool:
        """Build a controller in the background and let it take over; if that fails, report why."""
        try:
            successor = await asyncio.to_thread(self._session.flights[0].successor, fields)
        except InputError as error:
            self._answer.content = _says(f"refused, the controller before flies on: {error}", "bad")
            return False
        self._session.submit({"type": "controller", "fields": dict(fields)}, successor=successor)
        self._answer.content = _says(f"flies from the next period on: {what}")
        return True

    # Buttons

    def _toggle(self, event: Any) -> None:
        self._pace.paused = not self._pace.paused

    def _step(self, event: Any) -> None:
        self._pace.paused = True
        self._pace.single()

    async def _scene(self, event: Any) -> None:
        page = await asyncio.to_thread(self.stage.recorded, self._session.scenario.name)
        _send(event.client, f"{self._session.scenario.name}.html", page)

    def _between(self, act: Callable[[Session, Any], None]) -> Callable[[Any], None]:
        """Return a function that runs `act(session, client)` between two periods, in the flying thread."""
        return lambda event: self._pace.order(lambda session: act(session, event.client))

    def _reset(self, session: Session, client: Any) -> None:
        session.reset()
        self.ended(None)

    def _keep(self, session: Session, client: Any) -> None:
        try:
            result = f"saved: {self._save(session)}"
        except (InputError, OutputError) as error:
            result = f"not saved: {error}"
        with _unless_gone():
            client.add_notification("Save", result)

    def _download(self, session: Session, client: Any) -> None:
        if session.k:
            _send(client, f"{session.scenario.name}.toml", session.flight().scenario.to_toml())

    # Who drives

    async def _connected(self, client: Any) -> None:
        if self._driver is None:
            self._driver = client.client_id
        away = self.stage.unit * VIEW
        upright = client.camera.aspect < 1.0  # a phone, whose lower half is the panel
        aim = self._aims[client.client_id] = np.array([0.0, 0.0, -0.5 * np.linalg.norm(away)]) * upright
        _look(client.camera, np.asarray(self.stage.frames[0].position) + aim, away)
        take = client.gui.add_button("Take the controls", visible=self._driver != client.client_id)
        self._takes[client.client_id] = take

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
        for client, take in self._takes.items():
            take.visible = client != driver

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

    def _button(self, label: str, act: Callable[[Any], Any]) -> None:
        self._on(self._server.gui.add_button(label).on_click, act)

    def _event(self, label: str, table: Callable[[], Mapping[str, Any]]) -> None:
        """A button that submits an event."""
        self._button(label, lambda event: self._session.submit(table()))

    def _group(self, label: str, acts: Mapping[str, Callable[[Any], Any]]) -> None:
        """Buttons in a row."""
        buttons = self._server.gui.add_button_group(label, tuple(acts))
        self._on(buttons.on_click, lambda event: acts[event.target.value](event))

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

    def _state(self, frame: Frame, factor: float) -> str:
        sample = frame.samples[0]
        if sample is None:
            return str(self._status.content)
        command, deadline = sample.command, 1e3 * self._session.period
        worst = self._history[-1] if self._history else (0.0,) * 11
        mark = "" if command.status in OPTIMAL else ' class="bad"'
        back = "" if command.fallback == 0 else f' <span class="bad">fallback {command.fallback}</span>'
        missed = ' <span class="bad">missed</span>' if sample.missed else ""
        others = [flight.loop for flight in self._session.flights[1:]]
        lost = [f"{other.controller.name} was lost: {other.reason}" for other in others if other.reason is not None]
        phase = "paused" if self._pace.paused else escape(sample.phase.value)
        rows = [
            f"<b>{frame.time:.2f} s</b> &times; {factor:.2f} of real time, {phase}",
            f"<span{mark}>{escape(command.status)}</span> by {escape(command.answered_by)}{back}, "
            f"{command.active} active, step <b>{1e3 * sample.step_s:.2f}</b> of {deadline:g} ms{missed}",
            *(f'<span class="bad">{escape(text)}</span>' for text in lost),
            f"tilt <b>{worst[4]:.1f}</b> deg, error <b>{np.linalg.norm(worst[1:4]):.2f}</b> m, pull "
            f"<b>{np.linalg.norm(frame.pull):.1f}</b> N",
        ]
        return _html("<br>".join(rows))


@contextlib.contextmanager
def _unless_gone() -> Iterator[None]:
    """Send to clients that may close their page meanwhile, of which viser warns."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r"Queued a \w+ on a closed connection")
        yield


def _wear(rotor: int, loss: Any) -> dict[str, Any]:
    return {"type": "wear", "rotor": rotor, "loss": float(loss)}


def _look(camera: Any, at: Any, away: Any = None) -> None:
    """Turn a camera to a point [m], from as far away as it is."""
    away = np.asarray(camera.position) - camera.look_at if away is None else away
    camera.position = at + away  # which moves where it looks
    camera.look_at = at


def _send(client: Any, name: str, text: str) -> None:
    client.send_file_download(name, text.encode(), save_immediately=True)


def _html(content: str, mark: str = "") -> str:
    return f'{STYLE}<div class="q {mark}">{content}</div>'


def _says(text: str, mark: str = "") -> str:
    return _html(escape(text), mark)


def _bars(limits: tuple[Limit, ...], frame: Frame, other: str) -> str:
    """Margins as bars: full is the middle of the bounds, empty is at the bound; amber is active, red is violated."""
    rows = []
    for limit in limits:
        values = [margins.get(limit.name, math.nan) for margins in frame.margins]
        for i, margin in enumerate(values):
            if math.isnan(margin):
                continue
            share = min(1.0, abs(margin) / limit.half_band)
            red = margin < -limit.tolerance
            active = not red and margin <= _ACTIVE * limit.half_band
            colour = BOUND if red else LINES[1] if active else LINES[2] if i == 0 else LINES[4]
            mark = "bad" if red else "act" if active else ""
            fill = f'<div class="f" style="width:{100.0 * share:.0f}%;background:{colour}"></div>'
            name = escape(limit.name if i == 0 else other)
            verdict = "violated" if red else "active" if active else ""
            number = f'<td class="n">{margin:+.2g} {escape(limit.unit)}</td><td class="w">{verdict}</td>'
            rows.append(
                f'<tr class="{mark}"><td>{name}</td><td class="t"><div class="r">{fill}</div></td>{number}</tr>'
            )
    return f'<div class="q"><table>{"".join(rows)}</table></div>' if rows else ""
