"""The tabs of a session's page by which a person acts: disturbances, steering, the controller's fields.

Handles are viser's; nothing here imports it.
"""

from __future__ import annotations

import asyncio
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final, NamedTuple, get_args

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

_STEER: Final = {
    "W": ("+x", (1.0, 0.0, 0.0)),
    "S": ("-x", (-1.0, 0.0, 0.0)),
    "A": ("+y", (0.0, 1.0, 0.0)),
    "D": ("-y", (0.0, -1.0, 0.0)),
    "R": ("+z", (0.0, 0.0, 1.0)),
    "F": ("-z", (0.0, 0.0, -1.0)),
}
"""The keys that steer the set-point: where to, in a word and as a direction."""
_STEER_STEP: Final = 0.5  # [m/s] by which each of these keys changes the set-point's velocity
_STEER_MOST: Final = 5.0  # [m/s] largest velocity of the set-point along an axis
_BROKEN: Final = 0.4  # share of its thrust that a rotor loses by the button
_WIND: Final = 15.0  # [m/s] up to which fields take a wind
_SENSORS: Final = get_args(SensorText)
_GUST: Final = {"type": "gust", "velocity": [1.0, 0.0, 0.0], "duration": 1.0}
_MASS: Final = {"type": "mass", "factor": 1.1}
_LAG: Final = {"type": "rotor_lag", "rise": 0.01}
_FAULT: Final = {"type": "sensor_fault", "sensor": _SENSORS[0], "fault": "nan", "duration": 1.0}
BREAKS: Final = "red"
"""Colour of a button that breaks something, or throws something away."""
_Input = Callable[[Any, Disturbances], Mapping[str, Any]]  # of a widget's value, and what acts on the vehicle


class _Shown(NamedTuple):
    """A widget that shows what acts on the vehicle."""

    widget: Any
    value: Callable[[Disturbances], Any]  # what it shows
    table: _Input  # the input that a person's change of it gives


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
        self._shown: dict[str, _Shown] = {}  # by label: see `shows`
        self._given: dict[str, int] = {}  # likewise, the period in which a person changed it last

    def on(self, register: Callable[[Any], Any], act: Callable[[Any], Any]) -> None:
        """Call a function for changes by the driving client, not for changes by Python, which have no client."""

        async def called(event: Any) -> None:  # a plain function would run in one of many threads
            if event.client is None:
                return
            if not self._drives(event.client.client_id):
                text = "Another page has the controls: Take the controls changes that."
                event.client.add_notification("You watch", text)
                return
            result = act(event)
            if inspect.isawaitable(result):
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
        acting = self.session.disturbances
        for label, shown in self._shown.items():
            is_pending = self.session.k < self._given.get(label, -2) + 2  # what was typed acts in the period after
            value = shown.value(acting)
            if not is_pending and shown.widget.value != value:
                shown.widget.value = value

    def button(self, label: str, act: Callable[[Any], Any], **look: Any) -> Any:
        """A button."""
        button = self.gui.add_button(label, **look)
        self.on(button.on_click, act)
        return button

    def event(self, label: str, table: Callable[[], Mapping[str, Any]], refused: str = "", **look: Any) -> None:
        """A button that submits an event, if this scenario can have it."""
        self.button(label, lambda event: self.session.submit(table()), disabled=bool(refused), **look)

    def group(self, label: str, actions: Mapping[str, Callable[[Any], Any]], **look: Any) -> Any:
        """Buttons in a row."""
        buttons = self.gui.add_button_group(label, tuple(actions), **look)
        self.on(buttons.on_click, lambda event: actions[event.target.value](event))
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
        self._shown[widget.label] = _Shown(widget, value, table)
        self.on(widget.on_update, lambda event: self._submit(widget))
        return widget

    def give(self, widget: Any, value: Any) -> None:
        """Change such a widget's value as a person does."""
        widget.value = value
        self._submit(widget)

    def explain(self, refused: str) -> None:
        """Say why this scenario cannot have an event; nothing if it can."""
        self.gui.add_html(readout.says(refused, "why"))

    def _submit(self, widget: Any) -> None:
        label = widget.label
        self._given[label] = self.session.k
        table = self._shown[label].table(widget.value, self.session.disturbances)
        self.session.submit(table, subject=label)


def disturb(widgets: Widgets, stage: Stage, use: Callable[[str], None]) -> None:
    """Fill the tab with every event that this scenario can have; the others are disabled, with the reason.

    `use` takes a hint away.
    """
    faults = [_FAULT | {"sensor": name} for name in _SENSORS]
    no_wind, no_mass, no_lag, *no_fault = widgets.session.refusals([_GUST, _MASS, _LAG, *faults])
    _add_pull(widgets, stage, use)
    _add_rotor_losses(widgets, use)
    _add_wind(widgets, no_wind)
    _add_load(widgets, no_mass)
    _add_rotor_lag(widgets, no_lag)
    _add_sensor_faults(widgets, no_fault)
    late = widgets.gui.add_number("Late commands [ms]", 200, min=10, max=5000, step=10)
    widgets.event("Stall the computer", lambda: {"type": "stall", "duration": late.value / 1e3}, color=BREAKS)


def _add_pull(widgets: Widgets, stage: Stage, use: Callable[[str], None]) -> None:
    """Let the mouse pull the first vehicle."""

    def pulled(event: Any) -> None:
        to = None
        if event.phase != "end":
            to = [float(number) for number in event.end_position]
        widgets.session.submit({"type": "pull", "to": to}, subject="pull")
        use("pull")

    widgets.on(stage.grab.on_drag("left"), pulled)


def _add_rotor_losses(widgets: Widgets, use: Callable[[str], None]) -> None:
    """Add a button that breaks the first rotor and repairs it, and a slider for what each rotor lacks."""
    session = widgets.session
    acting = session.disturbances

    def worn() -> float:
        return float(session.disturbances.worn[0])

    def is_broken() -> bool:
        return bool(sliders[0].value > round(worn(), 4))

    def clicked(event: Any) -> None:
        use("break")
        loss = worn()
        if not is_broken():
            loss += (1.0 - loss) * _BROKEN
        widgets.give(sliders[0], round(loss, 4))

    async def changed(event: Any) -> None:  # also by a reset
        if is_broken():
            button.label = "Repair the rotor"
            button.color = None
        else:
            button.label = "Break a rotor"
            button.color = BREAKS

    hint = f"rotor 1 loses {100 * _BROKEN:.0f} % of its thrust"
    button = widgets.button("Break a rotor", clicked, hint=hint, color=BREAKS)
    sliders = []
    for rotor in range(1, N_ROTORS + 1):
        slider = widgets.gui.add_slider(f"Rotor {rotor} loss", 0.0, 1.0, 0.05, _rotor_loss(rotor, acting))
        sliders.append(widgets.shows(slider, partial(_rotor_loss, rotor), partial(_wear, rotor)))
    sliders[0].on_update(changed)


def _add_wind(widgets: Widgets, refused: str) -> None:
    """Add a gust and the mean wind, both along the ground."""
    acting = widgets.session.disturbances
    most = max(_WIND, *map(abs, acting.wind))
    look = {"min": (-most, -most), "max": (most, most), "step": 0.5, "disabled": bool(refused)}
    gust = widgets.gui.add_vector2("Gust x, y [m/s]", (6.0, 0.0), **look)
    widgets.event("Gust for 1 s", lambda: _GUST | {"velocity": [*gust.value, 0.0]}, refused)
    widgets.shows(
        widgets.gui.add_vector2("Wind x, y [m/s]", acting.wind[:2], **look),
        lambda acting: acting.wind[:2],
        lambda value, acting: {"type": "wind", "velocity": [*value, acting.wind[2]]},
    )
    if refused:
        refused = f"No wind: {refused}"
    widgets.explain(refused)


def _add_load(widgets: Widgets, refused: str) -> None:
    """Add the factor of the mass, and a payload to take and drop."""
    factor = widgets.session.disturbances.mass_factor
    mass = widgets.session.flights[0].actual.mass
    disabled = bool(refused)
    least = min(0.7, factor)
    most = max(1.5, factor)
    widgets.shows(
        widgets.gui.add_slider("Mass factor", least, most, 0.01, factor, disabled=disabled),
        lambda acting: acting.mass_factor,
        lambda value, acting: {"type": "mass", "factor": float(value)},
    )
    step = round(0.01 * mass, 5)
    look = {"min": 0.0, "max": mass, "step": step, "disabled": disabled}
    payload = widgets.gui.add_number("Payload [kg]", round(0.1 * mass, 4), **look)
    widgets.event("Take payload", lambda: {"type": "payload_pickup", "mass": float(payload.value)}, refused)
    widgets.event("Drop payload", lambda: {"type": "payload_drop"}, refused)
    widgets.explain(refused)


def _add_rotor_lag(widgets: Widgets, refused: str) -> None:
    """Add the rotors' time constants."""
    lag = _shown_lag(widgets.session.disturbances)
    most = max(100.0, *lag)
    look = {"min": (0.0, 0.0), "max": (most, most), "step": 1.0, "disabled": bool(refused)}
    widgets.shows(
        widgets.gui.add_vector2("Rotor lag up, down [ms]", lag, **look),
        _shown_lag,
        lambda value, acting: {"type": "rotor_lag", "rise": value[0] / 1e3, "fall": value[1] / 1e3},
    )
    widgets.explain(refused)


def _add_sensor_faults(widgets: Widgets, refused: Sequence[str]) -> None:
    """Add the faults of the sensors that this scenario has; `refused` says of each sensor why it cannot fail."""
    present = [name for name, reason in zip(_SENSORS, refused, strict=True) if not reason]
    reason = ""
    if not present:
        reason = refused[0]
    disabled = not present
    sensor = widgets.gui.add_dropdown("Sensor", present or _SENSORS, disabled=disabled)
    fault = widgets.gui.add_dropdown("Fault", ("dropout", "freeze", "nan"), disabled=disabled)
    widgets.event(
        "Fail sensor for 1 s",
        lambda: _FAULT | {"sensor": sensor.value, "fault": fault.value},
        reason,
        color=BREAKS,
    )
    widgets.explain(reason)


class Steering:
    """The set-point, by every way that there is to give one."""

    def __init__(self, widgets: Widgets, scene: Any, stage: Stage, use: Callable[[str], None]) -> None:
        """Fill the tab; `use` takes a hint away."""
        self._session = widgets.session
        self._stage = stage
        self._use = use
        self._velocity = np.zeros(3)
        gui = widgets.gui
        gui.add_html(readout.block(readout.STEER, "why"))
        x, y, z, heading = map(float, self._session.flights[0].loop.course.row(0)[:4])
        start = np.array([x, y, z])
        plain_arrows = {"disable_rotations": True, "disable_sliders": True}
        self._handle = scene.add_transform_controls("/target", scale=3.0 * stage.unit, position=start, **plain_arrows)
        self._handle.visible = False  # it would lie over the vehicle, and take its pulls
        arrows = gui.add_checkbox("Arrows to drag", False)
        widgets.on(arrows.on_update, lambda event: setattr(self._handle, "visible", event.target.value))
        widgets.on(self._handle.on_update, lambda event: self._set_point(event.target.position))
        place = gui.add_vector3("Set-point [m]", (x, y, z), step=0.1)
        self._place = widgets.value(place, self._set_point)
        widgets.on(scene.on_click(modifier="shift"), self.clicked)
        yaw = math.degrees(math.remainder(heading, 2.0 * math.pi))
        slider = gui.add_slider("Yaw [deg]", -180.0, 180.0, 5.0, round(yaw, 1))
        widgets.submits(slider, lambda value: {"type": "setpoint", "yaw": float(value)})
        self._steered = gui.add_text("Set-point velocity [m/s]", "0, 0, 0", disabled=True)
        self._add_keys(widgets)
        widgets.button("Stop set-point", lambda event: self.stop())

    def _add_keys(self, widgets: Widgets) -> None:
        """Add the commands that keys give."""
        for key, (name, direction) in _STEER.items():
            command = widgets.gui.add_command(f"Fly {name}", hotkey=key)
            widgets.on(command.on_trigger, partial(self._fly_on, _STEER_STEP * np.array(direction)))
        stop = widgets.gui.add_command("Stop the set-point", hotkey="X")
        widgets.on(stop.on_trigger, lambda event: self.stop())

    def clicked(self, event: Any) -> None:
        """Fly to the point of the ground that was clicked, at the set-point's height."""
        origin = np.array(event.ray_origin)
        direction = np.array(event.ray_direction)
        above = origin[2] - self._stage.ground
        if above * direction[2] >= 0.0:  # it does not meet the ground
            return
        x, y, _ = origin - above / direction[2] * direction
        last = self._session.flights[0].loop.last
        if last is None:
            height = self._place.value[2]
        else:
            height = last.observation.reference[2]
        self._set_point((x, y, height))
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
        """Show the fields of a controller, those that people turn first."""
        while self._groups:
            self._groups.pop().remove()
        fields = {knob.path: knob for knob in knobs(spec)}
        self._values = {path: knob.value for path, knob in fields.items()}
        for title, labels in TURNED_FIELDS.items():
            group = []
            for path, label in labels.items():
                if path in fields:
                    group.append((fields.pop(path), label))
            self._add_group(title, group, expanded=True)
        rest = [(knob, knob.path) for knob in fields.values()]
        self._add_group("All fields", rest, expanded=False)

    def _add_group(self, title: str, group: Sequence[tuple[Knob, str]], *, expanded: bool) -> None:
        """Add a folder of fields with their labels; none without fields."""
        if not group:
            return
        with self._folder:
            folder = self._widgets.gui.add_folder(title, expand_by_default=expanded)
        self._groups.append(folder)
        with folder:
            for knob, label in group:
                self._widgets.on(self._input(knob, label).on_update, partial(self._turn, knob.path))

    def _input(self, knob: Knob, label: str) -> Any:
        """The widget of a field."""
        gui = self._widgets.gui
        limits = {"min": knob.minimum, "max": knob.maximum}
        match knob.value:
            case bool(value):
                return gui.add_checkbox(label, value, hint=knob.about)
            case str(value):
                return gui.add_dropdown(label, knob.choices, initial_value=value, hint=knob.about)
            case tuple(value):
                limits_of_pair = {}
                for name, limit in limits.items():
                    if limit is not None:
                        limits_of_pair[name] = (limit, limit)
                return gui.add_vector2(label, value, step=0.1, hint=knob.about, **limits_of_pair)
            case int(value):
                return gui.add_number(label, value, step=1, hint=knob.about, **limits)
            case value:
                return gui.add_number(label, value, hint=knob.about, **limits)

    async def _turn(self, path: str, event: Any) -> None:
        """Let a controller take over that has a field as a person has turned it; put it back if that fails."""
        widget = event.target
        value = widget.value
        before = self._values.get(path)
        if before is None or value == before:  # of a controller that was replaced meanwhile, or put back
            return
        if await self._replace(event, {path: value}, f"{path} = {value}, was {before}"):
            self._values[path] = value
        else:
            widget.value = before

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


def _rotor_loss(rotor: int, acting: Disturbances) -> float:
    """Return the share of its thrust that a rotor lacks."""
    return round(float(acting.loss[rotor - 1]), 4)


def _shown_lag(acting: Disturbances) -> tuple[float, float]:
    """Return the rotors' time constants [ms]."""
    rise, fall = acting.lag
    return round(1e3 * rise, 3), round(1e3 * fall, 3)


def _wear(rotor: int, loss: Any, acting: Disturbances) -> dict[str, Any]:
    """Return the input by which a rotor lacks a share of its thrust; what it lacks by the scenario stays."""
    left = 1.0 - float(acting.worn[rotor - 1])
    further = 0.0
    if left > 0.0:
        further = max(0.0, 1.0 - (1.0 - float(loss)) / left)
    return {"type": "wear", "rotor": rotor, "loss": round(further, 4)}
