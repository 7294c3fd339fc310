"""A scenario made for a vehicle: its controller, a course that it can fly, and where every number comes from."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import numpy as np

from mpc.baselines.bandwidths import lag_to_allow_for
from mpc.robust.tightening import SHORTEST_LAG
from quadsim.errors import UnknownNameError, printable
from quadsim.vehicle import Vehicle
from scenarios.design.loop import delay_margin
from scenarios.design.tuning import (
    HEADING_RATIO,
    HEADING_STEP,
    HEIGHT_RATIO,
    HEIGHT_STEP,
    HORIZON_TIMES,
    LAG_RATIO,
    MOVE_RATIO,
    PERIOD_SHARE,
    THRUST_SHARE,
    Tuning,
    tune,
)

if TYPE_CHECKING:
    from scenarios.schema.scenario import Scenario

COURSES: Final = ("hover", "step", "figure-eight")
LAWS: Final = ("robust", "lqr", "pid", "geometric")
SHARE: Final = 0.6
"""Share of what the vehicle can do that a figure eight requires: of the largest acceleration within the tilt bound, or
of the fastest level speed where that is reached first."""
EIGHT_RATIO: Final = 0.3
"""Turns of a figure eight per time [rad/s] over the loop's bandwidth: across it moves twice as fast."""
STEP_RATIO: Final = 0.28  # bandwidth of the filter of steps over the loop's
STEP: Final = 1.0  # [m]
ROOM: Final = 0.15
"""The tracking requirement, the same for every controller: the largest error along x, y and z over the course's size.
The robust controller's is 11 % on steps and 5 % on figure eights, at most (docs/own-vehicle.md)."""
CLEARANCE: Final = 1.5
"""Height of the course above the floor over the largest error allowed, where that is more than `LOWEST`."""
LOWEST: Final = 1.0  # height of a course [m]
SOFT: Final = (2e4, 1e3)
"""l1 and l2 of the tilt bounds over the weight of x, as the defaults have them with the paper's weight of 10."""
LQR_TILT: Final = 30.0
BASELINE_SHARE: Final = 0.8
"""Tilt [deg] that an LQR is limited to, and share of the tilt bound that every baseline is: they limit only the tilt
that they command, and overshoot it."""
LAG_SHARE: Final = 0.5
"""Lag that the gains of PID and geometric control allow for, over the rotors' (or half a period, if that is longer):
half of a time constant counts as dead time (the half rule of SIMC, Skogestad, 2003).  The laws' own default is 1."""
PREVIEW: Final = 2.0
"""Preview, times w, from which baselines take the reference's velocity, and all but the LQR its acceleration."""
GRID: Final = 0.2  # durations are multiples of it [s], and so of every control period
_EIGHT_PEAK: Final = float(np.hypot(np.sin(angle := np.linspace(0.0, math.pi, 721)), 2.0 * np.sin(2.0 * angle)).max())
"""Largest |d2p/dt2| of the figure eight (a sin wt, a/2 sin 2wt), over a w^2."""


class Entry(NamedTuple):
    """A line of the file."""

    table: str  # its header, without brackets; empty for the top
    key: str  # of the field; empty for an empty table, which switches a part on
    value: Any  # of TOML
    why: str = ""  # what it is, in its unit, and where it comes from


@dataclass(frozen=True, kw_only=True)
class FirstScenario:
    """A scenario for a vehicle, line by line."""

    notes: tuple[str, ...]  # what it was made from, the comments above it
    entries: tuple[Entry, ...]  # its lines, those of a table together
    size: float  # of the course [m]: the step, or the figure's length; for hover a step's

    @property
    def scenario(self) -> Scenario:
        """To be flown."""
        from scenarios.loading import parse_scenario

        return parse_scenario(self.to_data())

    def to_data(self) -> dict[str, Any]:
        """As nested tables, what parsing `to_toml` gives."""
        data: dict[str, Any] = {}
        for entry in self.entries:
            holder = data
            if entry.table == "[constraints]":
                rows = data.setdefault("constraints", [])
                if entry.key == "name":
                    rows.append({})
                holder = rows[-1]
            else:
                for name in entry.table.split("."):
                    holder = holder.setdefault(name, {}) if name else holder
            if entry.key:
                holder[entry.key] = entry.value
        return data

    def to_toml(self) -> str:
        """As a commented file."""
        lines = [f"# {printable(text)}".rstrip() for text in self.notes]
        table = ""
        for entry in self.entries:
            if entry.table != table or (entry.table == "[constraints]" and entry.key == "name"):
                table = entry.table
                lines += ["", f"[{table}]" + (f"  # {entry.why}" if not entry.key else "")]
            elif not lines[-1].strip() or lines[-1].startswith("#"):
                lines.append("")
            if entry.key:
                lines.append(f"{entry.key} = {_text(entry.value)}" + (f"  # {entry.why}" if entry.why else ""))
        return "\n".join(lines) + "\n"


def first_scenario(vehicle: Vehicle, file: str, *, course: str = "hover", law: str = "robust") -> FirstScenario:
    """A scenario that the vehicle flies well, with its controller's numbers made from the vehicle's.

    Args:
        vehicle: the numbers.
        file: where they are, as the scenario is to name it: a shipped vehicle or a path ending in `.toml`.
        course: one of `COURSES`.
        law: one of `LAWS`.

    Raises:
        UnknownNameError: there is no such course or law.
    """
    for kind, name, known in (("course", course, COURSES), ("controller", law, LAWS)):
        if name not in known:
            raise UnknownNameError(kind, name, known)
    tuning = tune(vehicle)
    flown, duration, size = _course(course, vehicle, tuning)
    name = re.sub(r"[^a-z0-9._-]+", "-", f"first-{vehicle.name}-{course}".lower())[:80]
    why = f"s, tau: the longest of the usual ones with tau w <= {PERIOD_SHARE:g}"
    entries = (
        Entry("", "name", name),
        Entry("", "description", _description(course, vehicle, tuning)),
        *([] if duration is None else [Entry("", "duration", duration, "s")]),
        Entry("", "control_period", tuning.period, why),
        Entry("vehicle", "file", file, "made for its numbers: remake this file when they change"),
        Entry("initial", "position", [0.0, 0.0, _height(vehicle, size)], "m, world; at rest"),
        Entry("plant", "limit_speeds", True, "rotors saturate at their lowest and highest speed"),
        *flown,
        *(_robust(vehicle, tuning) if law == "robust" else _baseline(law, vehicle, tuning)),
        *_rotors(vehicle),
        Entry("effects.air", "", None, "drag of the vehicle file"),
        *_constraints(vehicle, tuning, size),
    )
    return FirstScenario(notes=_notes(vehicle, tuning, course, law), entries=entries, size=size)


def _rotors(vehicle: Vehicle) -> Iterator[Entry]:
    """The lines of `[effects.rotors]`; rotors that change their speed at once can have no inertia."""
    if vehicle.rotor_inertia and not (vehicle.rotor_rise and vehicle.rotor_fall):
        yield Entry("effects.rotors", "inertia", 0.0, "kg m^2; that of the vehicle file needs its rotor_rise and fall")
    else:
        yield Entry("effects.rotors", "", None, "lag and inertia of the vehicle file")


def _notes(vehicle: Vehicle, tuning: Tuning, course: str, law: str) -> tuple[str, ...]:
    can = tuning.authority
    limits = {
        "lag": f"the rotors' lag: 1 / ({LAG_RATIO:g} (T + tau / 2)), T = {1e3 * can.lag:.3g} ms",
        "torque": "torque: 0.5 sqrt(alpha / tilt bound), alpha the smaller of roll's and pitch's",
        "period": "what a period of 10 ms or more can serve",
    }
    bandwidths = f"{tuning.height:.3g} rad/s for z, {tuning.heading:.3g} rad/s for yaw"
    if law == "robust":
        what, margin = "The loop's bandwidth for x and y", delay_margin(vehicle, tuning)
        then = [
            f"{bandwidths}. Without bounds it tolerates {1e3 * margin:.3g} ms more delay than it knows of.",
            "Weights by Bryson's rule, 1 / (largest accepted deviation)^2; rules and sources: "
            "scenarios/design/tuning.py.",
        ]
    else:
        what = "The course is made for a robust MPC, whose bandwidth for x and y"
        then = [f"{bandwidths}. The controller's own rules: docs/own-vehicle.md."]
    return (
        f"A first flight of {_description(course, vehicle, tuning)}.",
        f"Made by: quadsim scenario --for VEHICLE --course {course}"
        + ("" if law == "robust" else f" --controller {law}"),
        "",
        f"Thrust to weight {can.thrust_to_weight:.3g}: at most {math.degrees(can.steady_tilt):.3g} deg of steady tilt; "
        "angular acceleration in reserve at hover",
        f"{can.turning[0]:.3g}, {can.turning[1]:.3g}, {can.turning[2]:.3g} rad/s^2 about x, y, z.",
        f"{what} is w = {tuning.bandwidth:.3g} rad/s,",
        f"limited by {limits[tuning.limited_by]};",
        *then,
    )


def _description(course: str, vehicle: Vehicle, tuning: Tuning) -> str:
    what = {
        "hover": f"hover at {_height(vehicle, STEP):g} m",
        "step": f"steps of {STEP:g} m in x, y and z",
        "figure-eight": f"a figure eight at {100.0 * SHARE:g} % of {_eight_limit(vehicle, tuning)}",
    }
    return f"{vehicle.name}: {what[course]}"


def largest_eight(vehicle: Vehicle, tuning: Tuning) -> tuple[float, Literal["tilt", "speed"]]:
    """The largest level acceleration [m/s^2] of a figure eight that the vehicle can fly, and what is reached there."""
    tilting = vehicle.gravity * tuning.acceleration
    # Of (a sin wt, a/2 sin 2wt) the largest speed is sqrt(2) a w.
    moving = tuning.fastest * _EIGHT_PEAK * EIGHT_RATIO * tuning.bandwidth / math.sqrt(2.0)
    return (moving, "speed") if moving < tilting else (tilting, "tilt")


def _eight_limit(vehicle: Vehicle, tuning: Tuning) -> str:
    if largest_eight(vehicle, tuning)[1] == "speed":
        return f"the fastest level speed, {tuning.fastest:.3g} m/s"
    return "the largest acceleration within the tilt bound"


def _course(course: str, vehicle: Vehicle, tuning: Tuning) -> tuple[list[Entry], float | None, float]:
    """The lines of `[reference]`, the flight's duration [s], None to the end of the course, and its size [m]."""
    if course == "hover":
        why = "no windows: every axis stays at its initial position, yaw at 0"
        return [Entry("reference", "", None, why)], 4.0, STEP
    if course == "step":
        slowest = min(tuning.bandwidth, tuning.height)
        response = round(3.0 / (STEP_RATIO * slowest), 2)
        start = _later(max(1.0, 3.0 / tuning.bandwidth))
        hold = _later(max(1.5, 1.2 * response))
        why = f"s, 95 % of a step: 3 / ({STEP_RATIO:g} times {slowest:.3g} rad/s, the slower of w and that of z)"
        found = [Entry("reference", "response_time", response, why)]
        above = round(_height(vehicle, STEP) + STEP, 9)
        for axis, begin, until, value in (("x", 0, 2, STEP), ("y", 1, 3, STEP), ("z", 0, 2, above)):
            window = {"start": round(start + begin * hold, 9), "stop": round(start + until * hold, 9), "value": value}
            found.append(Entry("reference", axis, [window], "s, s, m"))
        return found, round(start + 4.0 * hold, 9), STEP
    acceleration = SHARE * largest_eight(vehicle, tuning)[0]
    length = _rounded(2.0 * acceleration / (_EIGHT_PEAK * (EIGHT_RATIO * tuning.bandwidth) ** 2), 3)
    turn = round(math.tau * math.sqrt(0.5 * length * _EIGHT_PEAK / acceleration), 3)
    ramp = round(0.5 * turn, 3)
    to_end = f"m, end to end: such that it turns with {EIGHT_RATIO:g} w; width half of it"
    why = f"s: at most {acceleration:.3g} m/s^2, at {100.0 * SHARE:g} % of {_eight_limit(vehicle, tuning)}"
    found = [
        Entry("reference", "type", "figure_eight"),
        Entry("reference", "start", 1.0, "s"),
        Entry("reference", "length", length, to_end),
        Entry("reference", "period", turn, why),
        Entry("reference", "ramp", ramp, "s, half a turn to gain its speed, and to lose it"),
    ]
    return found, None, length


def _robust(vehicle: Vehicle, tuning: Tuning) -> Iterator[Entry]:
    place, height, heading = (_rounded(weight) for weight in tuning.weights)
    speed = _rounded(tuning.speed_weight)
    lag = vehicle.rotor_rise is not None and vehicle.rotor_rise >= SHORTEST_LAG

    def line(key: str, value: Any, why: str, table: str = "") -> Entry:
        return Entry(f"controller{table}", key, value, why)

    yield line("type", "robust", "")
    yield line(
        "horizon", tuning.horizon, f"N, periods: {HORIZON_TIMES:g} / w = {HORIZON_TIMES / tuning.bandwidth:.3g} s"
    )
    known = "the vehicle's rotor_rise is predicted" if lag else "the vehicle gives no lag"
    yield line("rotor_lag", "vehicle" if lag else 0.0, known)
    yield line("heading", True, "the hover model is turned by the present yaw")
    why = f"of changes: as much as speed costs at {MOVE_RATIO:g} w, speed / ({MOVE_RATIO:g} w tau)^2"
    yield line("move_weight", _rounded(tuning.move_weight), why)
    yield line("", None, "force and torque that the model does not know are estimated and compensated", ".offset_free")
    yield line("linear", _rounded(SOFT[0] * place), f"l1: {SOFT[0]:g} times the weight of x", ".soft")
    yield line("quadratic", _rounded(SOFT[1] * place), f"l2: {SOFT[1]:g} times the weight of x", ".soft")
    where = ".output_weights"
    why = f"1 / (g tan(tilt bound) / w^2)^2: {tuning.deviation:.3g} m is what the tilt bound answers"
    yield line("x", place, why, where)
    yield line("y", place, "as x", where)
    why = f"for {tuning.height:.3g} rad/s, at most {HEIGHT_RATIO:g} w; all thrust in reserve answers {HEIGHT_STEP:g} m"
    yield line("z", height, f"{why} or more", where)
    turned = math.degrees(HEADING_STEP)
    why = f"for {tuning.heading:.3g} rad/s, at most {HEADING_RATIO:g} w; all torque in reserve answers {turned:.3g} deg"
    yield line("yaw", heading, f"{why} or more", where)
    why = f"1 / ({speed**-0.5:.3g} rad/s)^2: with it four integrators have the bandwidth w, (g beta)^2 x / w^8"
    yield line("speed", speed, why, ".input_weights")
    tilt = _tilt(tuning)
    limit = math.degrees(math.acos(min(1.0, 1.0 / (THRUST_SHARE * tuning.authority.thrust_to_weight))))
    why = f"deg: what the hover model stands, or {limit:.3g} deg, what {100 * THRUST_SHARE:g} % of the thrust holds"
    yield line("roll", [-tilt, tilt], why, ".output_bounds")
    yield line("pitch", [-tilt, tilt], "as roll", ".output_bounds")
    yield from _inputs(vehicle, tuning)


def _baseline(law: str, vehicle: Vehicle, tuning: Tuning) -> Iterator[Entry]:
    known = {"lqr": "weights by Bryson's rule, its defaults; it tracks pose and velocity, not acceleration"}
    yield Entry("controller", "type", law, known.get(law, ""))
    steepest = BASELINE_SHARE * _tilt(tuning)
    why = "deg, largest that it commands; below the audit's, which it overshoots"
    yield Entry("controller", "tilt", round(min(LQR_TILT, steepest) if law == "lqr" else steepest, 3), why)
    ahead = math.ceil(PREVIEW / (tuning.bandwidth * tuning.period))
    why = f"periods of preview for the reference's velocity: {PREVIEW:g} / w = {PREVIEW / tuning.bandwidth:.3g} s"
    yield Entry("controller", "horizon", ahead, why)
    if law != "lqr":
        lag = lag_to_allow_for(vehicle, tuning.period)
        why = f"s that its gains allow for: {LAG_SHARE:g} times {1e3 * lag:.3g} ms, the rotors' lag or half a period"
        yield Entry("controller", "lag", _rounded(LAG_SHARE * lag), why)
    if law == "geometric":
        yield Entry("controller", "integral", True, "against drag and what else is not modelled")
    yield from _inputs(vehicle, tuning)


def _inputs(vehicle: Vehicle, tuning: Tuning) -> Iterator[Entry]:
    down, up = _slew(tuning)
    table = "controller.input_bounds"
    why = f"rad/s, what the rotors hold; hover is {vehicle.hover_speed:.4g}"
    yield Entry(table, "speed", [vehicle.speed_min, vehicle.speed_max], why)
    why = "rad/s per period: what a rotor's own speed makes in one, from hover towards its limits"
    yield Entry(table, "slew", [down, up], why)


def _constraints(vehicle: Vehicle, tuning: Tuning, size: float) -> Iterator[Entry]:
    """What the flight is audited against, whatever its controller; `size` of the course [m]."""
    tilt, (down, up) = _tilt(tuning), _slew(tuning)
    rounding = _rounded(1e-9 * vehicle.speed_max)

    def entry(
        name: str, signal: str, bounds: tuple[float, float | None], tolerance: float, why: str
    ) -> Iterator[Entry]:
        pairs = {"name": name, "signal": signal, "lower": bounds[0]}
        if bounds[1] is not None:
            pairs["upper"] = bounds[1]
        if tolerance:
            pairs |= {"tolerance": tolerance, "tolerance_sampled": tolerance}
        for key, value in pairs.items():
            comment = {"lower": why, "tolerance": "rounding"}.get(key, "")
            yield Entry("[constraints]", key, value, comment)

    for name in ("roll", "pitch"):
        yield from entry(name, name, (-tilt, tilt), 0.0, "deg, the tilt bound, at every instant")
    yield from entry("speed", "speed", (vehicle.speed_min, vehicle.speed_max), rounding, "rad/s, what the rotors hold")
    yield from entry("slew", "slew", (down, up), rounding, "rad/s per period, the controller's bound")
    why = (
        "m, radius of the ball about the hull: the lowest centre that keeps all of the vehicle above the ground, z = 0"
    )
    yield from entry("floor", "z", (_floor(vehicle), None), 0.0, why)
    off = _rounded(ROOM * size)
    for axis in "xyz":
        why = f"m, {100 * ROOM:g} % of the course's size, {size:g} m: the same for every controller"
        yield from entry(f"hold_{axis}", f"{axis}_error", (-off, off), 0.0, why)


def _floor(vehicle: Vehicle) -> float:
    """Lowest z [m] of the centre of mass at which no attitude brings the hull to the ground, to a millimetre above."""
    return math.ceil(1e3 * vehicle.enclosing_radius - 1e-6) / 1e3


def _height(vehicle: Vehicle, size: float) -> float:
    """Height [m] of the lowest points of a course of some size [m], to a decimetre above."""
    return max(LOWEST, math.ceil(10.0 * (_floor(vehicle) + CLEARANCE * ROOM * size) - 1e-6) / 10.0)


def _tilt(tuning: Tuning) -> float:
    """The tilt bound [deg], a whole number where it is above 5."""
    degrees = math.degrees(tuning.tilt) + 1e-9
    return float(math.floor(degrees)) if degrees > 5.0 else _rounded(degrees)


def _slew(tuning: Tuning) -> tuple[float, float]:
    return _rounded(tuning.slew[0], 4), _rounded(tuning.slew[1], 4)


def _later(time: float) -> float:
    """The next multiple of `GRID`."""
    return round(GRID * math.ceil(round(time / GRID, 6)), 9)


def _rounded(number: float, digits: int = 3) -> float:
    return float(f"{number:.{digits}g}")


def _text(value: Any) -> str:
    """A value as TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_text(entry)}" for key, entry in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_text, value)) + "]"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, bool | str) else repr(value)
