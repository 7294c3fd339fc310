"""One flight as arrays with units: the control periods, clock times, and the plant between commands.

`quadsim.flight.parquet` writes and reads it; `docs/conventions.md` defines states, frames and times.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Final, NamedTuple

import numpy as np

from quadsim.controller import Phase
from quadsim.errors import ParameterError
from quadsim.rotation import conjugate, euler_to_body_rates, euler_to_quaternion, multiply
from quadsim.state import (
    ANGLE_RATES,
    ANGLES,
    INDEX,
    REFERENCE_NAMES,
    REFERENCE_STATES,
    REFERENCE_UNITS,
    STATE_NAMES,
    STATE_UNITS,
    Array,
    wrapped,
)
from quadsim.vehicle import N_ROTORS

Counts = np.ndarray[Any, np.dtype[np.int64]]
PredictedPositions = np.ndarray[Any, np.dtype[np.float32]]
NUMBER = "number"
TEXT = "text"
COUNT = "count"
"""Kinds of columns."""


def columns(units: Mapping[str, str] | str = "-", *, kind: str = NUMBER, gaps: bool = False) -> dict[str, Any]:
    """Return the metadata of a field that is written to files: its columns, which are stated here and nowhere else.

    Args:
        units: unit of each column, by the column's name; a single unit, where the field is one column of its own name.
        kind: `NUMBER`, `TEXT` or `COUNT`.
        gaps: whether some rows may lack a value: NaN in memory, null in files.
    """
    return {"units": units, "kind": kind, "gaps": gaps}


class Columns(NamedTuple):
    """The columns of one field of a table, as its metadata states them; see `columns`."""

    units: Mapping[str, str]  # unit of each column, by the column's name
    kind: str  # `NUMBER`, `TEXT` or `COUNT`
    gaps: bool  # whether some rows may lack a value
    optional: bool  # whether the field may be None; then its columns are absent


def columns_of(table: type[Any]) -> dict[str, Columns]:
    """Return the columns of a table's written fields, in order, by field; those that default to None are optional."""
    by_field = {}
    for table_field in fields(table):
        metadata = table_field.metadata
        if "units" not in metadata:
            continue
        units = metadata["units"]
        if isinstance(units, str):
            units = {table_field.name: units}
        optional = table_field.default is None
        by_field[table_field.name] = Columns(
            units=units, kind=metadata["kind"], gaps=metadata["gaps"], optional=optional
        )
    return by_field


def _by_rotor(name: str, unit: str) -> dict[str, str]:
    """Return the unit of a column per rotor, by the columns' names, e.g. `u1` .. `u4`."""
    return {f"{name}{i}": unit for i in range(1, N_ROTORS + 1)}


def _by_axis(name: str, unit: str, axes: str = "xyz") -> dict[str, str]:
    """Return the unit of a column per axis, by the columns' names, e.g. `wind_x`, `wind_y`, `wind_z`."""
    return {f"{name}{axis}": unit for axis in axes}


_STATE: Final = dict(zip(STATE_NAMES, STATE_UNITS, strict=True))
_TRUE_STATE: Final = {f"true_{name}": unit for name, unit in _STATE.items()}
_REFERENCE: Final = {f"ref_{name}": unit for name, unit in zip(REFERENCE_NAMES, REFERENCE_UNITS, strict=True)}
_TARGET: Final = {"target_thrust": "N", **_by_axis("target_body_rate_", "rad/s")}
_WRENCH: Final = _by_axis("force_", "N") | _by_axis("torque_", "N m")


class LoggedSignals(dict[str, tuple[str, float]]):
    """What a controller logs in one period: unit and value by name."""

    def log(self, name: str, value: float, unit: str = "-") -> None:
        """See `quadsim.controller.StepInputs.log`."""
        if not isinstance(name, str) or not name.isidentifier() or name in COLUMNS:
            raise ParameterError("log", "name", name, "an identifier that is no column of flight.parquet")
        number = np.asarray(value)
        is_number = number.ndim == 0 and number.dtype.kind in "biuf"  # a truth value, an integer or a float
        if not is_number or np.isinf(number):
            raise ParameterError("log", name, value, "one number, finite or NaN")
        self[name] = unit, float(number)


def stacked(periods: Sequence[LoggedSignals]) -> dict[str, tuple[str, Array]]:
    """Return the signals that K periods logged, by name: unit, and values (K,), NaN in periods without a value.

    A signal's unit is the one that it was first logged with.
    """
    stack: dict[str, tuple[str, Array]] = {}
    for k, signals in enumerate(periods):
        for name, (unit, value) in signals.items():
            if name not in stack:
                stack[name] = (unit, np.full(len(periods), math.nan))
            _, values = stack[name]
            values[k] = value
    return stack


class Sampled:
    """What follows from states, references and commands at the control samples.

    `ControlLog` and `Samples` have these fields, which are described there.
    """

    t: Array
    state: Array
    reference: Array
    speeds: Array
    speeds_before: Array
    truth: Array
    attitude: Array | None
    body_rates: Array | None
    target: Array | None

    @property
    def tracking_error(self) -> Array:
        """(K, 4) true state less reference: x, y, z [m], yaw [rad] in (-pi, pi]."""
        error = self.truth[:, REFERENCE_STATES] - self.reference
        yaw = REFERENCE_NAMES.index("yaw")
        error[:, yaw] = wrapped(error[:, yaw])
        return error

    @property
    def measured_error(self) -> Array:
        """(K, 12) measured less true state.

        If attitude and body rates are measured, the errors in place of Euler angles and their rates are, in body axes,
        twice the vector part of the rotation from the true to the measured attitude, which for small errors is its
        rotation vector [rad], and the difference of the body rates [rad/s].
        """
        error = self.state - self.truth
        yaw = INDEX["yaw"]
        error[:, yaw] = wrapped(error[:, yaw])
        if self.attitude is not None and self.body_rates is not None:
            angles = self.truth[:, ANGLES]
            rates = self.truth[:, ANGLE_RATES]
            turn = multiply(conjugate(euler_to_quaternion(angles)), self.attitude)
            sign = np.copysign(1.0, turn[:, :1])  # of the two quaternions of a rotation, the one by less than 180 deg
            error[:, ANGLES] = 2.0 * sign * turn[:, 1:]
            error[:, ANGLE_RATES] = self.body_rates - euler_to_body_rates(angles, rates)
        return error

    @property
    def slews(self) -> Array:
        """(K, 4) command steps u(k) - u(k-1) [rad/s per period], Eq. (15)."""
        return np.diff(self.speeds, axis=0, prepend=self.speeds_before[None, :])


@dataclass(frozen=True, kw_only=True)
class Samples(Sampled):
    """The fields of a `ControlLog` that the signals of an audit are computed from: enough for a single period."""

    t: Array
    state: Array
    reference: Array
    speeds: Array
    speeds_before: Array
    truth: Array
    attitude: Array | None = None
    body_rates: Array | None = None
    target: Array | None = None


@dataclass(frozen=True, kw_only=True)
class ControlLog(Sampled):
    """One row per control period k, taken at t_k; K rows.  Its fields are the columns of flight.parquet, in order."""

    t: Array = field(metadata=columns("s"))  # (K,)
    state: Array = field(metadata=columns(_STATE))  # (K, 12) measured state, as the controller received it
    reference: Array = field(metadata=columns(_REFERENCE))  # (K, 4) filtered, at t_k
    speeds: Array = field(metadata=columns(_by_rotor("u", "rad/s")))
    """(K, 4) commanded rotor speeds u(k), in force once their delay has passed; with an autopilot, its last answer."""
    speeds_before: Array  # (4,) u(-1), the command before the first [rad/s]
    status: tuple[str, ...] = field(metadata=columns(kind=TEXT))
    """K texts, one of `quadsim.controller.ACCEPTED` or the reason of a rejection; see `quadsim.controller.Command`."""
    answered_by: tuple[str, ...] = field(metadata=columns(kind=TEXT))
    """K texts: `gain`, `core`, a QP solver's name, `law`, `fallback` or `stopped`."""
    phase: tuple[str, ...] = field(metadata=columns(kind=TEXT))  # K texts, see `quadsim.controller.Phase`
    iterations: Counts = field(metadata=columns(kind=COUNT))
    """(K,); `quadsim.controller.Statistics` defines this field, and the further ones that it names."""
    active: Counts = field(metadata=columns(kind=COUNT))
    fallback: Counts = field(metadata=columns(kind=COUNT))  # (K,) 0 none, higher = deeper
    slack: Array = field(metadata=columns("rad"))
    reported_primal: Array = field(metadata=columns(gaps=True))
    reported_dual: Array = field(metadata=columns(gaps=True))
    infeasibility: Array = field(metadata=columns(gaps=True))
    kkt_stationarity: Array = field(metadata=columns(gaps=True))
    kkt_complementarity: Array = field(metadata=columns(gaps=True))
    kkt_dual: Array = field(metadata=columns(gaps=True))
    delay: Array = field(metadata=columns("s"))  # (K,) simulated time from the measurement to the command
    truth: Array = field(metadata=columns(_TRUE_STATE))
    """(K, 12) true state; not written where it equals the measured one."""
    attitude: Array | None = field(default=None, metadata=columns(_by_axis("q", "-", "wxyz")))
    """(K, 4) measured quaternion, sign continuous; None if Euler angles suffice."""
    body_rates: Array | None = field(default=None, metadata=columns(_by_axis("body_rate_", "rad/s")))
    """(K, 3) measured body rates; None if Euler angles suffice."""
    sqp: Array | None = field(default=None, metadata=columns({"sqp_defect": "-", "sqp_step": "-"}, gaps=True))
    """(K, 2) of `quadsim.controller.Statistics`, NaN in periods without; None if no period has them."""
    target: Array | None = field(default=None, metadata=columns(_TARGET, gaps=True))
    """(K, 4) collective thrust and body rates that the autopilot is to fly, NaN in periods without; None without an
    autopilot."""
    target_attitude: Array | None = field(default=None, metadata=columns(_by_axis("target_q", "-", "wxyz"), gaps=True))
    """(K, 4) attitude, as a quaternion, that the autopilot is to hold; None if it holds none."""
    logged: Mapping[str, tuple[str, Array]] = field(default_factory=dict)
    """What the controller logged, by name: unit and values (K,), NaN in periods without."""

    @property
    def measured_perfectly(self) -> bool:
        """Whether the measured state always equals the true one."""
        return self.state is self.truth or bool(np.array_equal(self.state, self.truth))

    @property
    def crashed(self) -> bool:
        """Whether anything but the feet touched the ground."""
        return str(Phase.CRASHED) in self.phase


_CONTROL_COLUMNS: Final = columns_of(ControlLog)
COLUMNS: Final = frozenset(name for stated in _CONTROL_COLUMNS.values() for name in stated.units)
"""The columns of flight.parquet, but for those that a controller logs."""
RESIDUALS: Final = tuple(name for name, stated in _CONTROL_COLUMNS.items() if stated.gaps and not stated.optional)
"""Fields of the residuals of a solution; each flight has them, NaN in periods where they are not available."""


@dataclass(frozen=True, kw_only=True)
class TimingLog:
    """Clock times per control period: the columns of timing.parquet."""

    t: Array = field(metadata=columns("s"))
    solve_ms: Array = field(metadata=columns("ms"))
    step_ms: Array = field(metadata=columns("ms"))


@dataclass(frozen=True, kw_only=True)
class PlantLog:
    """The plant between commands; M rows, the first at t = 0 before the first command: the columns of plant.parquet."""

    t: Array = field(metadata=columns("s"))  # (M,)
    state: Array = field(metadata=columns(_STATE))  # (M, 12) true state, yaw unwrapped
    speeds: Array = field(metadata=columns(_by_rotor("w", "rad/s")))
    """(M, 4) rotor speeds of the physics step from t on; of rotors that lag, those at t."""
    wrench: Array | None = field(default=None, metadata=columns(_WRENCH))
    """(M, 6) external force, world, and torque, body frame, from t on; None if there is none."""
    wind: Array | None = field(default=None, metadata=columns(_by_axis("wind_", "m/s")))
    """(M, 3) velocity of the air, world; None without wind."""
    battery: Array | None = field(default=None, metadata=columns({"voltage": "V", "charge": "-"}))
    """(M, 2) voltage and charge of the physics step from t on; None without a battery."""
    attitude: Array | None = field(default=None, metadata=columns(_by_axis("q", "-", "wxyz")))
    """(M, 4) true quaternion, body to world; None if Euler angles suffice."""
    body_rates: Array | None = field(default=None, metadata=columns(_by_axis("body_rate_", "rad/s")))
    """(M, 3) true body rates; None if Euler angles suffice."""
    thrust: Array | None = field(default=None, metadata=columns("N", gaps=True))
    """(M,) collective thrust of the rotors, NaN where no autopilot has a target; None without an autopilot."""

    def every(self, stride: int) -> PlantLog:
        """Return every `stride`-th row, starting with the first."""
        thinned: dict[str, Any] = {}
        for name, rows in vars(self).items():
            thinned[name] = rows
            if rows is not None:
                thinned[name] = rows[::stride]
        return PlantLog(**thinned)


class PeriodLog(NamedTuple):
    """One control period: its sample, and the plant's rows from its start to its end, both included."""

    control: Samples
    plant: PlantLog


@dataclass(frozen=True, kw_only=True, repr=False)
class FlightLog:
    """A whole flight, or the part that was flown."""

    control: ControlLog  # one row per control period
    timing: TimingLog  # clock times, one row per control period
    plant: PlantLog  # the plant, at the physics rate after a flight, at the log rate when read from a file
    predicted: PredictedPositions | None = None
    """(K, N, 3) float32 positions [m] predicted in each period for t_{k+1} .. t_{k+N}, N the shortest horizon of its
    controllers; None if one of them has no model."""
    foreseen: Array | None = None
    """(K, 12) states predicted in each period for the next one, NaN where there is no prediction; None if there is
    none, or the flight was read: it is not written."""
    reason: str | None = None  # why the flight ended early; None if it was completed
    interrupted: bool = False  # whether the user ended it
    traceback: tuple[str, ...] = ()  # last traceback lines of the exception in a controller or force that ended it
    lost: str | None = None  # loss criterion that ended it, e.g. `tilt`; None if none did

    def __repr__(self) -> str:
        ended = ""
        if self.reason is not None:
            ended = f", {self.reason}"
        return f"<FlightLog: {self.control.t.size} control periods, {self.plant.t.size} rows of the plant{ended}>"

    @property
    def aborted(self) -> bool:
        """Whether the user or an exception ended the flight, not the vehicle."""
        return self.interrupted or bool(self.traceback)

    @property
    def status(self) -> str:
        """`completed` or `aborted`."""
        if self.reason is None:
            return "completed"
        return "aborted"
