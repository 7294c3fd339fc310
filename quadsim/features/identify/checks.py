"""What of a log can be used, and whether its columns are what they should be; before any fit.

`airborne_spans` finds the parts in the air: on the ground, the rotors carry less than the weight while the vehicle
rests.  `check_log` then makes every check of `LOG_CHECKS` on these parts, in an order in which a later one relies on
what an earlier one has checked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

from quadsim.errors import InputError
from quadsim.features.identify.axes import check_rate_axes, check_tilt, check_velocity_axes
from quadsim.features.identify.clocks import check_clocks
from quadsim.features.identify.quantities import RPM
from quadsim.features.identify.record import HELD_INPUTS, ROTOR_INPUTS, SLOWEST_COMMANDS, Record, in_parts, rotor_inputs
from quadsim.features.identify.rotor_order import check_rotor_order
from quadsim.features.identify.rotor_speeds import check_against_commands, check_against_each_other, check_not_commands
from quadsim.features.identify.scales import check_scales
from quadsim.features.identify.sensors import LONGEST_HELD, ROUNDING, at_rest, runs, still_steps
from quadsim.features.identify.series import interpolated
from quadsim.features.identify.windows import load_factor, rate_over_window
from quadsim.state import Array
from quadsim.vehicle import Vehicle

SHORTEST_SPAN: Final = 2.0  # [s] of a span that is used
LEAST_AIRBORNE: Final = 4.0  # [s] that the longest span must have
GROUND_MARGIN: Final = 0.5  # [s] cut beside the ground, where it still acts through the air and the legs
RESTING_SPEED: Final = 0.3  # [m/s] below which a vehicle may stand on the ground
RESTING_RATE: Final = 0.5  # [rad/s] the same
LEAST_LACKING: Final = 0.15  # share of the weight that the rotors leave to the ground, at least
SUPPORTED: Final = 0.4  # of the acceleration by the lacking weight: less, and the ground carries it
# From these shares of the largest effort and of the weight on, the rotors carry the vehicle in the air.
CARRIED_EFFORT: Final = 0.5
CARRIED_LOAD: Final = 0.3
CONSTANT: Final = 3e-3  # share of the outputs below which their change in a second is none
UNCHANGED: Final = 1e-3  # share of the largest output below which a rotor's outputs never change
MOST_REPEATED: Final = 0.05  # share of rows that may repeat the one before
GOOD_RATE: Final = 50.0  # [Hz] below which lag and inertias are poor
LOAD_WINDOW: Final = 0.2  # [s] of an acceleration that shows what the rotors carry
REFUSED_HOVER_RATIO: Final = 1.8  # of the hover speeds in the log and by the start, either way
NOTED_HOVER_RATIO: Final = 1.4
LIKELY_UNITS: Final = (
    (1.0 / RPM, "rpm taken for rad/s"),
    (RPM, "rad/s taken for rpm"),
    (2.0, "pole pairs given as poles, or a start with half the hover speed"),
    (0.5, "twice the motor's poles given, or a start with twice the hover speed"),
    (7.0, "eRPM not divided by the pole pairs"),
    (7.0 / RPM, "eRPM taken for rad/s"),
    (1e-3, "a throttle taken for a speed in rad/s"),
)
"""Ratios of hover speeds, log over start, and their usual causes."""
AT_LIMIT: Final = 2e-3  # share of an output's range within which it is at a limit
MOST_AT_LIMIT: Final = 0.2  # share of samples at a limit from which a note says so


def airborne_spans(record: Record, vehicle: Vehicle) -> list[slice]:
    """Return the parts of a log in the air and without gaps, each 2 s or longer.

    Raises:
        InputError: none is 4 s long, the motors never run, or what was logged is not what was flown.
    """
    logged = _logged(record)
    if np.count_nonzero(logged) > 1:
        for check in ROW_CHECKS:
            check.run(record, logged)
    if record.flying is None:
        flying = logged
    else:
        flying = logged & record.flying
    if not flying.any() and logged.any():
        raise InputError(f"{record.name}: never flies: by its autopilot it is disarmed or landed all the time")
    shortest = max(round(SHORTEST_SPAN / record.period), 2)
    airborne = []
    if runs(logged, shortest):
        airborne = runs(flying & ~_grounded(record, logged, vehicle.gravity), shortest)
    longest = max((span.stop - span.start for span in airborne), default=0) * record.period
    if longest < LEAST_AIRBORNE * (1.0 - 1e-6):
        raise InputError(_never_flies(record, logged, longest))
    return airborne


def _never_flies(record: Record, logged: NDArray[np.bool_], longest: float) -> str:
    """Why a log that is in the air for `longest` [s] at most cannot be used, in words."""
    inputs = rotor_inputs(record)[logged]
    swing = 0.0
    height = ""
    if len(inputs):
        swing = float(np.ptp(inputs, axis=0).max() / max(np.abs(inputs).max(), 1e-9))
        if record.position is not None:
            height = f", its altitude by {np.ptp(record.position[logged, 2]):.2f} m"
    if longest:
        flies = f"flies for {longest:.1f} s at most in one piece"
    else:
        flies = "never flies"
    return (
        f"{record.name}: {flies}; {LEAST_AIRBORNE:g} s in the air without a gap are needed "
        f"({100.0 * logged.mean():.0f} % of its samples are complete; in them the rotors' outputs change by "
        f"{100.0 * swing:.0f} %{height})"
    )


def _check_motors_run(record: Record, logged: NDArray[np.bool_]) -> None:
    inputs = rotor_inputs(record)[logged]
    unchanged = np.ptp(inputs, axis=0) <= UNCHANGED * np.abs(inputs).max()
    if unchanged.all():
        raise InputError(
            f"{record.name}: the motors never run: the rotors' outputs stay at {inputs.mean():.4g}: no flight"
        )
    if unchanged.any():
        rotors = " and ".join(str(i + 1) for i in np.flatnonzero(unchanged))
        raise InputError(f"{record.name}: the outputs of rotor {rotors} never change while the others do: log all four")


def _check_columns_move(record: Record, logged: NDArray[np.bool_]) -> None:
    columns = {"rates": "wx wy wz", "velocity": "vx vy vz", "attitude": "qw qx qy qz"}
    for field, names in columns.items():
        rows = getattr(record, field)[logged]
        frozen = np.flatnonzero(np.ptp(rows, axis=0) <= ROUNDING)
        if not frozen.size:
            continue
        listed = ", ".join(names.split()[i] for i in frozen)
        if len(frozen) == rows.shape[1]:
            raise InputError(f"{record.name}: {listed} stand still while the motors run: log what was measured")
        elsewhere = np.abs(rows[0, frozen]) > ROUNDING
        if field != "attitude" and elsewhere.any():
            raise InputError(f"{record.name}: {listed} stands still while the others change: log all three axes")


def _still(record: Record, logged: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Steps between logged rows in which nothing turns, and those of them at which the vehicle rests."""
    still = still_steps(record.rates[logged], record.attitude[logged])
    return still, at_rest(still, round(LONGEST_HELD / record.period))


def _check_rows_are_new(record: Record, logged: NDArray[np.bool_]) -> None:
    still, rest = _still(record, logged)
    repeated = float((still & ~rest).mean())
    if repeated > MOST_REPEATED:
        raise InputError(
            f"{record.name}: {repeated:.0%} of its rows repeat rates and attitude of the one before, on clocks of "
            f"their own; at most {MOST_REPEATED:.0%} may: drop such rows, or log on board"
        )


def _check_outputs_are_logged_often(record: Record, logged: NDArray[np.bool_]) -> None:
    if record.speeds is not None:
        return
    inputs = rotor_inputs(record)[logged]
    _, rest = _still(record, logged)
    changed = (np.abs(np.diff(inputs, axis=0)) > ROUNDING * np.abs(inputs).max()).any(axis=1)
    rate = 0.0
    if not rest.all():
        rate = float(changed[~rest].mean()) / record.period
    if rate < 0.9 * SLOWEST_COMMANDS and 1.0 / record.period > 1.5 * rate:
        raise InputError(
            f"{record.name}: the rotors' outputs change {rate:.3g} times per second, and rates are logged "
            f"{1.0 / record.period:.3g} times: log the outputs as often as they are sent, "
            f"{SLOWEST_COMMANDS:g} times or more{_advised(record)}"
        )


def _advised(record: Record) -> str:
    if record.advice:
        return f" ({record.advice})"
    return ""


def _logged(record: Record) -> NDArray[np.bool_]:
    """Rows (N,) without a gap in any field."""
    logged = np.ones(len(record.t), bool)
    for name in ("velocity", "attitude", "rates", "position", *ROTOR_INPUTS):
        rows = getattr(record, name)
        if rows is not None:
            logged &= np.isfinite(rows).all(axis=1)
    return logged


def _grounded(record: Record, logged: NDArray[np.bool_], gravity: float) -> NDArray[np.bool_]:
    """Rows (N,) on the ground or near it; gaps are bridged by a straight line.

    A log with less than a second of motion or of changing outputs has no flight: all its rows at rest are returned.
    """
    velocity = _bridged(record.velocity, logged)
    attitude = _bridged(record.attitude, logged)
    rates = _bridged(record.rates, logged)
    inputs = _bridged(rotor_inputs(record), logged)
    second = round(1.0 / record.period)
    acceleration = rate_over_window(velocity, record.period, LOAD_WINDOW)
    load = load_factor(acceleration, attitude, gravity)
    effort = uniform_filter1d(np.square(inputs).mean(axis=1), max(second // 10, 1))
    lacking = 1.0 - effort / max(_hover_effort(effort, load, logged), 1e-30)  # share of the weight
    calm = _slower_than(velocity, RESTING_SPEED, second) & _slower_than(rates, RESTING_RATE, second)
    change = maximum_filter1d(inputs, second, axis=0) - minimum_filter1d(inputs, second, axis=0)
    constant = calm & (change <= CONSTANT * np.abs(inputs).mean()).all(axis=1)
    if np.count_nonzero(logged & ~constant) < second:
        return constant
    supported = np.abs(acceleration[:, 2]) < SUPPORTED * lacking * gravity
    resting = calm & (lacking > LEAST_LACKING) & supported
    eighth = second // 8
    lasting = minimum_filter1d(resting.astype(np.int8), 2 * eighth + 1)  # the top of a climb does not last
    margin = round(GROUND_MARGIN * second)
    return np.asarray(maximum_filter1d(lasting, 2 * (margin + eighth) + 1) > 0)


def _hover_effort(effort: Array, load: Array, logged: NDArray[np.bool_]) -> float:
    """Mean squared output of the rotors that carries the weight, by effort (N,) and load factor (N,)."""
    carried = logged & (effort > CARRIED_EFFORT * effort[logged].max()) & (load > CARRIED_LOAD)
    if carried.any():
        return float(np.median(effort[carried] / load[carried]))
    return float(np.median(effort[logged]))


def _slower_than(rows: Array, most: float, second: int) -> NDArray[np.bool_]:
    """Rows (N,) whose mean over a fifth of a second, of rows (N, 3), is shorter than `most`."""
    means = uniform_filter1d(rows, max(second // 5, 1), axis=0)
    return np.asarray(np.linalg.norm(means, axis=1) < most)


def _bridged(rows: Array, logged: NDArray[np.bool_]) -> Array:
    index = np.arange(len(rows))
    return interpolated(index, index[logged], rows[logged])


def _check_units(record: Record, parts: Sequence[slice], vehicle: Vehicle) -> Iterator[str]:
    """Refuse rotor speeds far from those that carry the start vehicle."""
    for field in ("commands", "speeds"):
        rows = getattr(record, field)
        if rows is None:
            continue
        hover = _hover_speed(record, rows, parts, vehicle.gravity)
        ratio = hover / vehicle.hover_speed
        what = (
            f"{record.name}: {field} of {hover:.4g} rad/s carry the weight, {ratio:.3g} times the start's hover speed"
        )
        start = f"of {vehicle.hover_speed:.4g} rad/s"
        if not 1.0 / REFUSED_HOVER_RATIO <= ratio <= REFUSED_HOVER_RATIO:
            raise InputError(
                f"{what} {start}; at most a factor of {REFUSED_HOVER_RATIO:g} is allowed. Likely: "
                f"{_likely_unit(ratio)}. Correct the unit, the poles, or the start's thrust_coefficient and mass"
            )
        most = float(rows[np.isfinite(rows)].max())
        if field == "commands" and most > 1.02 * vehicle.speed_max:
            yield (
                f"{record.name}: commands reach {most:.4g} rad/s, above the start's speed_max of {vehicle.speed_max:g} "
                "rad/s: correct it"
            )
        if not 1.0 / NOTED_HOVER_RATIO <= ratio <= NOTED_HOVER_RATIO:
            yield f"{what} {start}: check unit, poles and the start's thrust_coefficient"


def _hover_speed(record: Record, speeds: Array, parts: Sequence[slice], gravity: float) -> float:
    """Speed [rad/s] at which the rotors carry the weight, by speeds (N, 4) and the load factor in all parts."""
    squares = []
    loads = []
    for part in parts:
        acceleration = rate_over_window(record.velocity[part], record.period, LOAD_WINDOW)
        loads.append(load_factor(acceleration, record.attitude[part], gravity))
        squares.append(np.square(speeds[part]).mean(axis=1))
    load = max(np.median(np.concatenate(loads)), 0.1)
    return float(np.sqrt(np.median(np.concatenate(squares)) / load))


def _likely_unit(ratio: float) -> str:
    """The usual cause of a ratio of hover speeds."""

    def distance(pair: tuple[float, str]) -> float:
        return abs(float(np.log(max(ratio, 1e-9) / pair[0])))

    return min(LIKELY_UNITS, key=distance)[1]


def _note_gaps(record: Record, parts: Sequence[slice], vehicle: Vehicle) -> Iterator[str]:
    logged = _logged(record)
    if not logged.all():
        share = 100.0 * (1.0 - logged.mean())
        first = record.t[np.argmin(logged)]
        yield f"{record.name}: {share:.2g} % of its samples, left out, are in gaps, the first at t = {first:.4g} s"


def _note_slow_logs(record: Record, parts: Sequence[slice], vehicle: Vehicle) -> Iterator[str]:
    if record.period > (1.0 + 1e-6) / GOOD_RATE:
        poor = f"{1.0 / record.period:.3g} Hz; below {GOOD_RATE:g} Hz, lag and inertias will be poor"
        yield f"{record.name}: {poor}{_advised(record)}"


def _note_limits(record: Record, parts: Sequence[slice], vehicle: Vehicle) -> Iterator[str]:
    for field in HELD_INPUTS:
        rows = getattr(record, field)
        if rows is None:
            continue
        flown = in_parts(rows, parts)
        low = flown.min()
        high = flown.max()
        near = AT_LIMIT * (high - low)
        at_limit = (flown <= low + near) | (flown >= high - near)
        share = float(at_limit.any(axis=1).mean())
        if share > MOST_AT_LIMIT:
            yield (
                f"{record.name}: in {100.0 * share:.0f} % of its samples a rotor's {field} are at a limit, "
                f"{low:.4g} or {high:.4g}; fly more gently"
            )


class RowCheck(NamedTuple):
    """What has to hold of a log's complete rows; it is checked before the parts in the air are sought."""

    holds: str
    run: Callable[[Record, NDArray[np.bool_]], None]  # raises InputError where it does not


class LogCheck(NamedTuple):
    """What has to hold of the parts of a log that fly."""

    holds: str
    needs: tuple[str, ...]  # fields of a record that not every log has
    run: Callable[[Record, Sequence[slice], Vehicle], Iterable[str] | None]
    """Raises InputError where it does not hold; returns notes where it nearly does not."""


ROW_CHECKS: Final = (
    RowCheck("the motors run, each of them", _check_motors_run),
    RowCheck("no column stands still while others move", _check_columns_move),
    RowCheck("rows are new, not those before once more", _check_rows_are_new),
    RowCheck("outputs are logged about as often as they are sent", _check_outputs_are_logged_often),
)
LOG_CHECKS: Final = (
    LogCheck("the attitude turns at the body rates", (), check_rate_axes),
    LogCheck("the velocity is the slope of the position", ("position",), check_velocity_axes),
    LogCheck("the velocity changes as tilt and thrust make it", (), check_tilt),
    LogCheck("gyro, attitude, velocity, position and gravity agree in scale", (), check_scales),
    LogCheck("rates, attitude and velocity share one clock", (), check_clocks),
    LogCheck("speeds that carry the weight are about the start's", (), _check_units),
    LogCheck("each rotor turns as the others do at its command", ("speeds",), check_against_commands),
    LogCheck("no rotor's speed alone unbalances the torques", ("speeds",), check_against_each_other),
    LogCheck("the vehicle turns with the measured speeds, not behind them", ("speeds",), check_not_commands),
    LogCheck("the rotors are in the start's order and layout", (), check_rotor_order),
    LogCheck("there are no gaps", (), _note_gaps),
    LogCheck("samples are frequent", (), _note_slow_logs),
    LogCheck("the rotors are within their limits", (), _note_limits),
)
"""Every check of a log that flies, in the order in which they are made: a later one relies on the earlier ones."""


def check_log(record: Record, vehicle: Vehicle, spans: Sequence[slice]) -> tuple[str, ...]:
    """Make the `LOG_CHECKS`; return notes on a log that can be used, empty if nothing is to be said.

    Raises:
        InputError: naming what is wrong: an axis, a frame, a clock, a unit, a rotor, or their order.
    """
    notes = [*record.notes]
    for check in LOG_CHECKS:
        if all(getattr(record, field) is not None for field in check.needs):
            notes += check.run(record, spans, vehicle) or ()
    return tuple(notes)
