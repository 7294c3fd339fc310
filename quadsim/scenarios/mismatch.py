"""What a controller's model lacks of the plant that it flies, where the scenario states both.

`unmodelled` is what moves the limits of the loop: heading, delay, lag of the rotors, numbers of `[actual]`.
`unpredicted` is what hardly does: drag, moments of the air, wind. Each comes with the fields by which the model has it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from quadsim.controller import ROTORS
from quadsim.mpc.laws.geometric import Geometric
from quadsim.mpc.laws.lqr import LQRTable
from quadsim.mpc.laws.nonlinear import Nonlinear
from quadsim.mpc.laws.robust import Robust
from quadsim.mpc.problem.model import SHORTEST_LAG
from quadsim.mpc.tables.bounded import Bounded, Weighted
from quadsim.mpc.tables.lags import resolved_lag
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.plugin import Plugin
from quadsim.scenarios.schema.controllers import AnyController
from quadsim.scenarios.schema.events import SetpointEvent, events_of
from quadsim.sim.effects.rotors import RotorDynamics
from quadsim.state import Array, wrapped
from quadsim.vehicle import AIR_MOMENT, N_ROTORS

HELD_FOR: Final = 1.0
"""Time for which a course has a heading, at least, to count as its largest [s]: not while it turns through it."""
_LEVEL: Final = 1.0  # heading up to which a model linearised at zero yaw lacks nothing [deg]


@dataclass(frozen=True, kw_only=True)
class Unmodelled:
    """Something that a scenario states and that the model of its controller lacks."""

    quantity: str  # as `quadsim stability --over` calls it; empty for what that does not vary
    text: str  # what is stated, e.g. `a heading of 60 deg`
    remedy: str  # the change by which the model has it
    absent: Mapping[str, Any]
    """Fields of the scenario with which the plant lacks it, too, by dotted path; none for a heading."""
    settings: Mapping[str, Any]
    """Fields with which the model has it, by dotted path; of another law where this one cannot."""


def unmodelled(assembly: Assembly) -> tuple[Unmodelled, ...]:
    """Return what a scenario states and the model of its controller lacks; nothing of a user's, which nobody knows.

    That is the largest heading that the course holds, the time that commands take, the rotors' lag, and what `[actual]`
    states.  Every law is built for the control period, so its model has that.
    """
    if isinstance(assembly.scenario.controller, Plugin):
        return ()
    return (*_heading(assembly), *_delay(assembly), *_lag(assembly), *_actual(assembly))


def _heading(assembly: Assembly) -> list[Unmodelled]:
    """Return the heading that a model linearised at zero yaw lacks."""
    spec = assembly.scenario.controller
    is_linear = isinstance(spec, Weighted | LQRTable)
    fields = vars(spec)
    if not is_linear or fields.get("heading", False):
        return []
    heading = worst_heading(assembly)
    if abs(heading) <= _LEVEL:
        return []
    text = f"a heading of {heading:.4g} deg"
    if "heading" in fields or isinstance(spec, Bounded):
        settings = {**_law_with(assembly, "heading"), "controller.heading": True}
    else:
        settings = _law_with(assembly, "heading")
    remedy = _as_written(settings)
    return [Unmodelled(quantity="heading", text=text, remedy=remedy, absent={}, settings=settings)]


def _law_with(assembly: Assembly, name: str) -> dict[str, Any]:
    """Return the change of law by which there is a field, none if there is.

    That is to `robust` where weights and bounds can be kept, and to `nonlinear` with the rotors' lag otherwise.
    """
    spec = assembly.scenario.controller
    lag = _stated_lag(assembly)
    if name in vars(spec):
        return {}
    if isinstance(spec, Bounded):
        return {"controller.type": "robust"}
    law: dict[str, Any] = {"controller.type": "nonlinear"}
    if lag >= SHORTEST_LAG:
        law["controller.rotor_lag"] = lag
    return law


def _as_written(settings: Mapping[str, Any]) -> str:
    """Return fields and values as in a scenario file."""
    return ", ".join(f"{path} = {json.dumps(value)}" for path, value in settings.items())


def _delay(assembly: Assembly) -> list[Unmodelled]:
    """Return the delay that the law does not bridge."""
    computation = assembly.scenario.computation
    spec = assembly.scenario.controller
    delay = 0.0
    if computation is not None:
        delay = computation.delay
    fields = vars(spec)
    known = fields.get("delay", 0.0)
    if delay == known:
        return []
    text = f"commands {1e3 * delay:.4g} ms late"
    if known:
        text += f", where it expects {1e3 * known:.4g} ms"
    settings = {**_law_with(assembly, "delay"), "controller.delay": delay}
    commands = fields.get("commands", ROTORS)
    if commands == "attitude" or (commands != ROTORS and delay >= assembly.scenario.control_period):
        settings = {}  # such a law takes no delay, or none of a period
    absent = {"computation.delay": known}
    remedy = _as_written(settings)
    return [Unmodelled(quantity="delay", text=text, remedy=remedy, absent=absent, settings=settings)]


def _lag(assembly: Assembly) -> list[Unmodelled]:
    """Return the rotors' lag that a predictive law does not predict."""
    spec = assembly.scenario.controller
    lag = _stated_lag(assembly)
    if lag < SHORTEST_LAG or not _predicts_ideal_rotors(spec, assembly):
        return []
    remedy = ", ".join(_lag_remedy(spec, assembly, lag))
    text = f"rotors that lag by {1e3 * lag:.4g} ms"
    settings = {**_law_with(assembly, "rotor_lag"), "controller.rotor_lag": lag}
    return [Unmodelled(quantity="lag", text=text, remedy=remedy, absent=_ideal_rotors(assembly), settings=settings)]


def _ideal_rotors(assembly: Assembly) -> dict[str, Any]:
    """Return the fields with which the plant's rotors follow as good as at once."""
    absent: dict[str, Any] = {}
    if assembly.scenario.actual is not None:
        stated = assembly.scenario.actual.overrides()
        for name in ("rotor_rise", "rotor_fall"):
            if name in stated:
                absent[f"actual.{name}"] = None
    if assembly.effects.rotors is not None:  # not 0: rotors with inertia need a lag
        absent |= {"effects.rotors.rise": 0.5 * SHORTEST_LAG, "effects.rotors.fall": 0.5 * SHORTEST_LAG}
    return absent


def _actual(assembly: Assembly) -> list[Unmodelled]:
    """Return the numbers of the vehicle that the law has otherwise; lags are left to `_lag`."""
    actual = assembly.scenario.actual
    if actual is None:
        return []
    entries: list[Unmodelled] = []
    for name, value in actual.overrides().items():
        if value == getattr(assembly.vehicle, name) or name in ("rotor_rise", "rotor_fall"):
            continue
        stated = value
        if isinstance(value, tuple):
            stated = [*value]
        entry = Unmodelled(
            quantity=_QUANTITY_OF_PARAMETER.get(name, ""),
            text=f"actual.{name}",
            remedy=f"vehicle.{name} = {stated}",
            absent={f"actual.{name}": None},
            settings={f"vehicle.{name}": stated},
        )
        entries.append(entry)
    return entries


_QUANTITY_OF_PARAMETER: Final = {"mass": "mass", "inertia": "inertia", "thrust_coefficient": "thrust"}
"""What `quadsim stability --over` calls parameters of the vehicle that it varies."""


def unpredicted(assembly: Assembly) -> tuple[Unmodelled, ...]:
    """Return the drag, the moments and the forces that a scenario states, where a law has a field for them.

    They hardly move the limits of a loop, which is why `unmodelled` is without them.
    """
    spec = assembly.scenario.controller
    entries: list[Unmodelled] = []
    if isinstance(spec, Plugin):
        return ()
    if isinstance(spec, Nonlinear):
        entries += _drag(spec, assembly)
    entries += _moments(spec, assembly)
    if isinstance(spec, Nonlinear | Bounded):
        entries += _forces(spec, assembly)
    return tuple(entries)


def _drag(spec: Nonlinear, assembly: Assembly) -> list[Unmodelled]:
    """Return the drag of body and rotors that the prediction lacks, that of the rotors as in hover."""
    air = assembly.effects.air
    if air is None or spec.disturbance is not None or any((*spec.drag, *spec.quadratic_drag)):
        return []
    rotor_drag = N_ROTORS * assembly.vehicle.hover_speed * (air.rotor_drag or 0.0)
    x, y, z = air.linear_drag
    linear = [float(f"{drag:.4g}") for drag in (x + rotor_drag, y + rotor_drag, z)]
    quadratic = [*air.quadratic_drag]
    settings: dict[str, Any] = {}
    if any(linear):
        settings["controller.drag"] = linear
    if any(quadratic):
        settings["controller.quadratic_drag"] = quadratic
    if not settings:
        return []
    still = [0.0, 0.0, 0.0]
    absent = {"effects.air.linear_drag": still, "effects.air.quadratic_drag": still, "effects.air.rotor_drag": 0.0}
    return [Unmodelled(quantity="drag", text="drag", remedy=_as_written(settings), absent=absent, settings=settings)]


def _moments(spec: AnyController, assembly: Assembly) -> list[Unmodelled]:
    """Return the air's moments that the vehicle has numbers for and that a law of rotor speeds lacks.

    An inner loop balances them where a law commands rates or an attitude.
    """
    air = assembly.effects.air
    vehicle = assembly.vehicle
    fields = vars(spec)
    vehicle_has_moments = any(np.any(getattr(vehicle, name) or 0.0) for name in AIR_MOMENT)
    is_predicted = fields.get("moment", False)
    commands_rotors = fields.get("commands", ROTORS) == ROTORS
    if air is None or not vehicle_has_moments or is_predicted or not commands_rotors:
        return []
    absent = {
        "effects.air.rotor_moment": [0.0, 0.0],
        "effects.air.inflow_moment": [0.0, 0.0],
        "effects.air.rate_damping": [0.0, 0.0, 0.0],
        "effects.air.inflow": 0.0,
    }
    settings: dict[str, Any] = {**_law_with(assembly, "moment"), "controller.moment": True}
    if isinstance(spec, Geometric):
        settings["controller.feedforward"] = True
    text = "moments of the air"
    return [Unmodelled(quantity="", text=text, remedy=_as_written(settings), absent=absent, settings=settings)]


def _forces(spec: Nonlinear | Bounded, assembly: Assembly) -> list[Unmodelled]:
    """Return wind and disturbance that the law does not estimate."""
    fields = vars(spec)
    air = assembly.effects.air
    disturbance = assembly.effects.disturbance
    if fields.get("offset_free") is not None or fields.get("disturbance") is not None:
        return []
    absent: dict[str, Any] = {}
    stated: list[str] = []
    if air is not None and (any(air.wind) or air.turbulence is not None):
        stated.append("wind")
        absent |= {"effects.air.wind": [0.0, 0.0, 0.0], "effects.air.turbulence": None}
    if disturbance is not None:
        stated.append("a disturbance")
        absent["effects.disturbance"] = None
    if not stated:
        return []
    if isinstance(spec, Nonlinear):
        estimate = "controller.disturbance"
    else:
        estimate = "controller.offset_free"
    settings = {**_law_with(assembly, "offset_free"), estimate: {}}
    text = " and ".join(stated)
    return [Unmodelled(quantity="", text=text, remedy=_as_written(settings), absent=absent, settings=settings)]


def worst_heading(assembly: Assembly) -> float:
    """Return the heading farthest from zero that the course, or a set-point, has for `HELD_FOR` seconds [deg]."""
    headings = wrapped(course_headings(assembly))
    periods_held = min(max(round(HELD_FOR / assembly.scenario.control_period), 1), headings.size)
    nearest_first = np.argsort(np.abs(headings), kind="stable")
    farthest = headings[nearest_first[-periods_held]]
    stated = [float(farthest)]
    for event in events_of(assembly.scenario.events, SetpointEvent):
        if "yaw" in event.values:
            stated.append(float(wrapped(event.values["yaw"])))
    return round(math.degrees(max(stated, key=abs)), 9)


def modelling_changes(assembly: Assembly) -> list[dict[str, Any]]:
    """Return the changes by which a law has what the scenario states and its model lacks.

    All of `unmodelled` together come first, then each alone, then each of `unpredicted`.  `robust` gets soft bounds
    with them, as a state that the old model led to may lie beyond hard ones; a heading comes without them, too.
    """
    spec = assembly.scenario.controller
    lacking = [{**entry.settings} for entry in unmodelled(assembly)]
    others = [_softened(spec, entry.settings) for entry in unpredicted(assembly)]
    if not lacking:
        return others
    together: dict[str, Any] = {}
    for settings in lacking:
        together |= settings
    changes = [together]
    if len(lacking) > 1:
        changes += lacking
    softened = [_softened(spec, settings) for settings in changes]
    if softened != changes and "controller.heading" in together:
        softened.append({**_law_with(assembly, "heading"), "controller.heading": True})
    return softened + others


def _softened(spec: AnyController, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return a change with soft bounds, named after the law, where it is one of `robust` with hard ones."""
    new_type = settings.get("controller.type")
    is_robust = isinstance(spec, Robust) or new_type == "robust"
    if not is_robust or vars(spec).get("soft") is not None:
        return {**settings}
    softened: dict[str, Any] = {}
    if new_type is not None:  # first: it replaces the whole table
        softened["controller.type"] = new_type
    softened["controller.soft"] = {}
    return {**softened, **settings}


def model_notes(assembly: Assembly) -> list[str]:
    """Return a line if the plant's rotors lag and a predictive controller of the scenario predicts none."""
    scenario = assembly.scenario
    lag = _stated_lag(assembly)
    if lag < SHORTEST_LAG:
        return []
    controllers = [scenario.controller, *(spec for _, spec in scenario.controller_changes)]
    for spec in controllers:
        if _predicts_ideal_rotors(spec, assembly):
            remedy = ", ".join(_lag_remedy(spec, assembly, lag))
            return [f"the rotors lag by {1e3 * lag:.4g} ms, and {spec.type} predicts none; to predict it: {remedy}"]
    return []


def _stated_lag(assembly: Assembly) -> float:
    """Return the time constant of the plant's rotors [s]."""
    rotors = assembly.effects.rotors or RotorDynamics()
    return rotors.rise or rotors.fall or 0.0


def _lag_remedy(spec: AnyController, assembly: Assembly, lag: float) -> list[str]:
    """Return the changes by which a predictive law predicts the lag [s]."""
    if isinstance(spec, Robust | Nonlinear):
        remedy = []
    else:
        remedy = ['controller.type = "robust" or "nonlinear"']
    if assembly.vehicle.rotor_rise is None:
        remedy.append(f"vehicle.rotor_rise = {lag:g}")
    remedy.append('controller.rotor_lag = "vehicle"')
    return remedy


def _predicts_ideal_rotors(spec: AnyController, assembly: Assembly) -> bool:
    """Return whether a predictive law commands rotor speeds and takes the rotors to follow at once."""
    if isinstance(spec, Robust | Nonlinear):  # an autopilot's lags include that of its rotors
        return spec.commands == ROTORS and resolved_lag(spec.rotor_lag, assembly.vehicle) == 0.0
    return isinstance(spec, Weighted)


def course_headings(assembly: Assembly) -> Array:
    """Return the course's headings at the control instants of the flight (K,), without its filter [rad]."""
    scenario = assembly.scenario
    t = scenario.control_period * np.arange(scenario.periods + 1, dtype=np.float64)
    return assembly.course.sample(t)[:, 3]
