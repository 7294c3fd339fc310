"""The tabs of a session's page by which a person acts: disturbances, steering, the controller's fields.

Handles are viser's; nothing here imports it.
"""

from __future__ import annotations

import asyncio
import inspect
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final, get_args

import numpy as np

from quadsim.errors import InputError
from quadsim.features.live import readout
from quadsim.features.live.knobs import TURNED_FIELDS, Knob, KnobValue, knobs
from quadsim.features.live.session import Disturbances, Session
from quadsim.features.live.stage import Stage
from quadsim.scenarios.schema.controllers import AnyController
from quadsim.scenarios.schema.events import SensorText
from quadsim.scenarios.schema.writing import plain
from quadsim.vehicle import N_ROTORS

_STEER: Final = {"W": ("+", "x"), "S": ("-", "x"), "A": ("+", "y"), "D": ("-", "y"), "R": ("+", "z"), "F": ("-", "z")}
_STEER_STEP: Final = 0.5  # [m/s] by which each of these keys changes the set-point's velocity
_STEER_MOST: Final = 5.0
_BROKEN: Final = 0.4  # share of its thrust that a rotor loses by the button
_WIND: Final = 15.0  # [m/s] up to which fields take a wind
_SENSORS: Final = get_args(SensorText)
BREAKS: Final = "red"
"""Colour of a button that breaks something, or throws something away."""
_Input = Callable[[Any, Disturbances], Mapping[str, Any]]


class Widgets:
    """Widgets that only the driving client may use.

    Args:
        gui: viser's.
        drives: whether a client, by its number, has the controls.
    """

    def __init__(self, gui: Any, session: Session, drives: Callable[[int], bool]) -> None:
        self.gui = gui
        self.session = session
        self._drives = drives
        self._starts: list[tuple[Any, Any]] = []  # widgets, and what they are at the start of a flight
        self._shown: dict[str, tuple[Any, Callable[[Disturbances], Any], _Input]] = {}  # by label: see `shows`
        self._given: dict[str, int] = {}  # likewise, the period in which a person changed it last

    def on(self, register: Callable[[Any], Any], act: Callable[[Any], Any]) -> None:
        """Call a function for changes by the driving client, not for changes by Python, which have no client."""

        async def called(event: Any) -> None:  # a plain function would run in one of many threads
            if event.client is None:
                return
            if not self._drives(event.client.client_id):
                text = "Another page has the controls: Take the controls changes that."
                event.client.add_notification("You watch", text)
            elif inspect.isawaitable(result := act(event)):
                await result

        register(called)

    def reset(self) -> None:
        """Show what a new flight starts with."""
        for widget, value in self._starts:
            widget.value = value
        self._given.clear()
        self.follow()

    def follow(self) -> None:
        """Show what acts on the vehicle, whether a person, an event of the scenario or a refusal has changed it."""
        acts = self.session.disturbances
        for label, (widget, value, _) in self._shown.items():
            pending = self.session.k < self._given.get(label, -2) + 2  # what was typed acts in the period after
            if not pending and widget.value != value(acts):
                widget.value = value(acts)

    def button(self, label: str, act: Callable[[Any], Any], **look: Any) -> Any:
        """A button."""
        button = self.gui.add_button(label, **look)
        self.on(button.on_click, act)
        return button

    def event(self, label: str, table: Callable[[], Mapping[str, Any]], refused: str = "", **look: Any) -> None:
        """A button that submits an event, if this scenario can have it."""
        self.button(label, lambda event: self.session.submit(table()), disabled=bool(refused), **look)

    def group(self, label: str, acts: Mapping[str, Callable[[Any], Any]], **look: Any) -> Any:
        """Buttons in a row."""
        buttons = self.gui.add_button_group(label, tuple(acts), **look)
        self.on(buttons.on_click, lambda event: acts[event.target.value](event))
        return buttons

    def value(self, widget: Any, act: Callable[[Any], Any]) -> Any:
        """Call a function of each value that the driving client gives; a new flight starts with the present one."""
        self._starts.append((widget, widget.value))
        self.on(widget.on_update, lambda event: act(event.target.value))
        return widget

    def submits(self, widget: Any, table: Callable[[Any], Mapping[str, Any]]) -> Any:
        """Submit an input made of a widget's value, likewise."""
        return self.value(widget, lambda value: self.session.submit(table(value), subject=widget.label))

    def shows(self, widget: Any, value: Callable[[Disturbances], Any], table: _Input) -> Any:
        """Show a value that acts, and submit an input made of what a person changes it to and of what else acts."""
        self._shown[widget.label] = widget, value, table
        self.on(widget.on_update, lambda event: self._submit(widget))
        return widget

    def give(self, widget: Any, value: Any) -> None:
        """Change such a widget's value as a person does."""
        widget.value = value
        self._submit(widget)

    def _submit(self, widget: Any) -> None:
        label = widget.label
        acts = self.session.disturbances
        self._given[label] = self.session.k
        self.session.submit(self._shown[label][2](widget.value, acts), subject=label)


def disturb(widgets: Widgets, stage: Stage, use: Callable[[str], None]) -> None:
    """Fill the tab with every event that this scenario can have; the others are disabled, with the reason.

    `use` takes a hint away.
    """
    gui = widgets.gui
    session = widgets.session
    mass = widgets.session.flights[0].actual.mass
    acts = session.disturbances
    gust = {"type": "gust", "velocity": [1.0, 0.0, 0.0], "duration": 1.0}
    load = {"type": "mass", "factor": 1.1}
    lag = {"type": "rotor_lag", "rise": 0.01}
    sensors = [{"type": "sensor_fault", "sensor": name, "fault": "nan", "duration": 1.0} for name in _SENSORS]
    no_wind, no_load, no_lag, *blind = session.refusals([gust, load, lag, *sensors])

    def pulled(event: Any) -> None:
        if event.phase == "end":
            to = None
        else:
            to = [float(number) for number in event.end_position]
        session.submit({"type": "pull", "to": to}, subject="pull")
        use("pull")

    def is_broken() -> bool:
        return bool(wear[0].value > round(float(session.disturbances.worn[0]), 4))

    def broken(event: Any) -> None:
        use("break")
        worn = float(session.disturbances.worn[0])
        widgets.give(wear[0], round(worn if is_broken() else worn + (1.0 - worn) * _BROKEN, 4))

    async def named(event: Any) -> None:  # also after a reset
        if is_broken():
            button.label = "Repair the rotor"
        else:
            button.label = "Break a rotor"
        button.color = None if is_broken() else BREAKS

    widgets.on(stage.grab.on_drag("left"), pulled)
    loss = f"rotor 1 loses {100 * _BROKEN:.0f} % of its thrust"
    button = widgets.button("Break a rotor", broken, hint=loss, color=BREAKS)
    wear = []
    for rotor in range(1, N_ROTORS + 1):
        wear.append(
            widgets.shows(
                gui.add_slider(f"Rotor {rotor} loss", 0.0, 1.0, 0.05, _rotor_loss(rotor, acts)),
                partial(_rotor_loss, rotor),
                partial(_wear, rotor),
            )
        )
    wear[0].on_update(named)
    most = max(_WIND, *map(abs, acts.wind))
    box = {"min": (-most, -most), "max": (most, most), "step": 0.5, "disabled": bool(no_wind)}
    blow = gui.add_vector2("Gust x, y [m/s]", (6.0, 0.0), **box)
    widgets.event("Gust for 1 s", lambda: gust | {"velocity": [*blow.value, 0.0]}, no_wind)
    widgets.shows(
        gui.add_vector2("Wind x, y [m/s]", acts.wind[:2], **box),
        lambda acts: acts.wind[:2],
        lambda value, acts: {"type": "wind", "velocity": [*value, acts.wind[2]]},
    )
    gui.add_html(readout.says(f"No wind: {no_wind}" if no_wind else "", "why"))
    off = {"disabled": bool(no_load)}
    least = min(0.7, acts.mass_factor)
    most = max(1.5, acts.mass_factor)
    widgets.shows(
        gui.add_slider("Mass factor", least, most, 0.01, acts.mass_factor, **off),
        lambda acts: acts.mass_factor,
        lambda value, acts: {"type": "mass", "factor": float(value)},
    )
    step = round(0.01 * mass, 5)
    payload = gui.add_number("Payload [kg]", round(0.1 * mass, 4), min=0.0, max=mass, step=step, **off)
    widgets.event("Take payload", lambda: {"type": "payload_pickup", "mass": float(payload.value)}, no_load)
    widgets.event("Drop payload", lambda: {"type": "payload_drop"}, no_load)
    gui.add_html(readout.says(no_load, "why"))
    ends = {"min": (0.0, 0.0), "max": (max(100.0, *_shown_lag(acts)),) * 2, "step": 1.0, "disabled": bool(no_lag)}
    widgets.shows(
        gui.add_vector2("Rotor lag up, down [ms]", _shown_lag(acts), **ends),
        _shown_lag,
        lambda value, acts: {"type": "rotor_lag", "rise": value[0] / 1e3, "fall": value[1] / 1e3},
    )
    gui.add_html(readout.says(no_lag, "why"))
    seen = [name for name, reason in zip(_SENSORS, blind, strict=True) if not reason]
    sensor = gui.add_dropdown("Sensor", seen or _SENSORS, disabled=not seen)
    fault = gui.add_dropdown("Fault", ("dropout", "freeze", "nan"), disabled=not seen)
    no_fault = "" if seen else blind[0]
    widgets.event(
        "Fail sensor for 1 s",
        lambda: sensors[0] | {"sensor": sensor.value, "fault": fault.value},
        no_fault,
        color=BREAKS,
    )
    gui.add_html(readout.says(no_fault, "why"))
    late = gui.add_number("Late commands [ms]", 200, min=10, max=5000, step=10)
    widgets.event("Stall the computer", lambda: {"type": "stall", "duration": late.value / 1e3}, color=BREAKS)


class Steering:
    """The set-point, by every way that there is to give one."""

    def __init__(self, widgets: Widgets, scene: Any, stage: Stage, use: Callable[[str], None]) -> None:
        """Fill the tab; `use` takes a hint away."""
        self._session = widgets.session
        self._stage = stage
        self._use = use
        gui = widgets.gui
        self._velocity = np.zeros(3)
        gui.add_html(readout.block(readout.STEER, "why"))
        here = np.asarray(self._session.flights[0].loop.course.row(0)[:3])
        plain_arrows = {"disable_rotations": True, "disable_sliders": True}
        self._handle = scene.add_transform_controls("/target", scale=3.0 * stage.unit, position=here, **plain_arrows)
        self._handle.visible = False  # it would lie over the vehicle, and take its pulls
        arrows = gui.add_checkbox("Arrows to drag", False)
        widgets.on(arrows.on_update, lambda event: setattr(self._handle, "visible", event.target.value))
        widgets.on(self._handle.on_update, lambda event: self._set_point(event.target.position))
        place = gui.add_vector3("Set-point [m]", tuple(map(float, here)), step=0.1)
        self._place = widgets.value(place, self._set_point)
        widgets.on(scene.on_click(modifier="shift"), self.clicked)
        turned = math.degrees(math.remainder(self._session.flights[0].loop.course.row(0)[3], 2.0 * math.pi))
        yaw = gui.add_slider("Yaw [deg]", -180.0, 180.0, 5.0, round(turned, 1))
        widgets.submits(yaw, lambda value: {"type": "setpoint", "yaw": float(value)})
        self._steered = gui.add_text("Set-point velocity [m/s]", "0, 0, 0", disabled=True)
        for key, (sign, axis) in _STEER.items():
            change = float(f"{sign}{_STEER_STEP}") * np.eye(3)["xyz".index(axis)]
            command = gui.add_command(f"Fly {sign}{axis}", hotkey=key)
            widgets.on(command.on_trigger, partial(self._fly_on, change))
        widgets.on(gui.add_command("Stop the set-point", hotkey="X").on_trigger, lambda event: self.stop())
        widgets.button("Stop set-point", lambda event: self.stop())

    def clicked(self, event: Any) -> None:
        """Fly to the point of the ground that was clicked, at the set-point's height."""
        origin = np.array(event.ray_origin)
        direction = np.array(event.ray_direction)
        above = origin[2] - self._stage.ground
        if above * direction[2] < 0.0:  # it meets the ground
            meets = origin - above / direction[2] * direction
            last = self._session.flights[0].loop.last
            if last is None:
                height = self._place.value[2]
            else:
                height = last.observation.reference[2]
            self._set_point((*meets[:2], height))
            self._use("waypoint")

    def _set_point(self, at: Any) -> None:
        self.stop()
        x, y, z = (round(float(number), 2) for number in at)
        self._handle.position = np.array([x, y, z])
        self._place.value = (x, y, z)
        self._stage.mark.position = (x, y, self._stage.ground)
        self._stage.mark.visible = True
        self._session.submit({"type": "setpoint", "x": x, "y": y, "z": z}, subject="setpoint")

    def stop(self) -> None:
        """Let the set-point stand."""
        self._fly(np.zeros(3))

    def reset(self) -> None:
        """Show what a new flight starts with, after the widgets have been reset."""
        self._handle.position = np.array(self._place.value)
        self._show(np.zeros(3))

    def _fly_on(self, change: Any, event: Any) -> None:
        self._fly(self._velocity + change)

    def _fly(self, velocity: Any) -> None:
        self._show(np.clip(velocity, -_STEER_MOST, _STEER_MOST))
        self._session.submit({"type": "steer", "velocity": self._velocity.tolist()}, subject="steer")

    def _show(self, velocity: Any) -> None:
        self._velocity = velocity
        self._steered.value = ", ".join(f"{speed:g}" for speed in velocity)


class ControllerTab:
    """The controller's fields, and other controllers that may take over.

    Args:
        others: these, by name.
        doing: returns a context in which an activity is shown.
    """

    def __init__(self, widgets: Widgets, others: Mapping[str, AnyController], doing: Callable[[str], Any]) -> None:
        self._widgets = widgets
        self._session = widgets.session
        self._doing = doing
        self._laws = {"initial": self._session.scenario.controller, **others}
        self._values: dict[str, KnobValue] = {}  # by path, as they fly
        self._groups: list[Any] = []  # folders of fields
        chosen = widgets.gui.add_dropdown("Controller", tuple(self._laws))
        widgets.button("Use this controller", lambda event: self._take(event, chosen.value))
        self._answer = widgets.gui.add_html("")
        self._folder = widgets.gui.add_folder(None)
        self._show(self._session.scenario.controller)

    def reset(self) -> None:
        """Show what a new flight starts with."""
        self._answer.content = ""
        self._show(self._session.scenario.controller)

    def _show(self, spec: AnyController) -> None:
        while self._groups:
            self._groups.pop().remove()
        fields = {knob.path: knob for knob in knobs(spec)}
        self._values = {path: knob.value for path, knob in fields.items()}
        groups = {
            title: [(fields.pop(path), label) for path, label in turned.items() if path in fields]
            for title, turned in TURNED_FIELDS.items()
        }
        groups["All fields"] = [(knob, knob.path) for knob in fields.values()]
        for title, group in groups.items():
            if group:
                with self._folder:
                    self._groups.append(self._widgets.gui.add_folder(title, expand_by_default=title != "All fields"))
                with self._groups[-1]:
                    for knob, label in group:
                        self._widgets.on(self._input(knob, label).on_update, partial(self._turn, knob.path))

    def _input(self, knob: Knob, label: str) -> Any:
        """The widget of a field."""
        gui = self._widgets.gui
        look = {"hint": knob.about}
        low = knob.minimum
        high = knob.maximum
        match knob.value:
            case bool(value):
                return gui.add_checkbox(label, value, **look)
            case str(value):
                return gui.add_dropdown(label, knob.choices, initial_value=value, **look)
            case tuple(value):
                least, most = (None if end is None else (end, end) for end in (low, high))
                return gui.add_vector2(label, value, step=0.1, min=least, max=most, **look)
            case value:
                step = 1 if isinstance(value, int) else None
                return gui.add_number(label, value, step=step, min=low, max=high, **look)

    async def _turn(self, path: str, event: Any) -> None:
        handle = event.target
        value = event.target.value
        before = self._values.get(path)
        if before is None or value == before:  # of a controller that was replaced meanwhile, or put back
            return
        if await self._replace(event, {path: value}, f"{path} = {value}, was {before}"):
            self._values[path] = value
        else:
            handle.value = before

    async def _take(self, event: Any, name: str) -> None:
        spec = self._laws[name]
        if await self._replace(event, plain(spec), name):
            self._show(spec)

    async def _replace(self, event: Any, fields: Mapping[str, Any], what: str) -> bool:
        """Build a controller in the background and let it take over; if that fails, report why."""
        with self._doing("building the controller"):
            try:
                successor = await asyncio.to_thread(self._session.successor, fields)
            except InputError as error:
                self._answer.content = readout.says(f"Refused, the previous controller stays active: {error}", "bad")
                event.client.add_notification("Refused", str(error), color="red", auto_close_seconds=8.0)
                return False
        self._session.submit({"type": "controller", "fields": dict(fields)}, successor=successor)
        self._answer.content = readout.says(f"Active from the next period on: {what}")
        return True


def _rotor_loss(rotor: int, acts: Disturbances) -> float:
    return round(float(acts.loss[rotor - 1]), 4)


def _shown_lag(acts: Disturbances) -> tuple[float, float]:
    """Return the rotors' time constants [ms]."""
    rise, fall = acts.lag
    return round(1e3 * rise, 3), round(1e3 * fall, 3)


def _wear(rotor: int, loss: Any, acts: Disturbances) -> dict[str, Any]:
    """Return the input by which a rotor lacks a share of its thrust; what it lacks by the scenario stays."""
    left = 1.0 - float(acts.worn[rotor - 1])
    if left > 0.0:
        more = max(0.0, 1.0 - (1.0 - float(loss)) / left)
    else:
        more = 0.0
    return {"type": "wear", "rotor": rotor, "loss": round(more, 4)}
