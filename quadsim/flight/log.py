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
    """Return the metadata of a field that is written: the only statement of its columns and their units.

    Args:
        units: unit of each column, by the column's name; a single one for a column with the field's name.
        kind: `NUMBER`, `TEXT` or `COUNT`.
        gaps: whether some rows may lack a value: NaN in memory, null in files.
    """
    return {"units": units, "kind": kind, "gaps": gaps}


class Columns(NamedTuple):
    """What a field of a table states of its columns; see `columns`."""

    units: Mapping[str, str]
    kind: str
    gaps: bool
    optional: bool


def columns_of(table: type[Any]) -> dict[str, Columns]:
    """Return the columns of a table's fields, in their order, by field; those that default to None are optional."""
    by_field = {}
    for one in fields(table):
        if "units" not in one.metadata:
            continue
        units = one.metadata["units"]
        if isinstance(units, str):
            units = {one.name: units}
        by_field[one.name] = Columns(
            units=units, kind=one.metadata["kind"], gaps=one.metadata["gaps"], optional=one.default is None
        )
    return by_field


def _numbered(name: str, unit: str) -> dict[str, str]:
    return {f"{name}{i}": unit for i in range(1, N_ROTORS + 1)}


def _by_axis(name: str, unit: str, axes: str = "xyz") -> dict[str, str]:
    return {f"{name}{axis}": unit for axis in axes}


_STATE: Final = dict(zip(STATE_NAMES, STATE_UNITS, strict=True))
_REFERENCE: Final = {f"ref_{name}": unit for name, unit in zip(REFERENCE_NAMES, REFERENCE_UNITS, strict=True)}


class LoggedSignals(dict[str, tuple[str, float]]):
    """What a controller logs in one period: unit and value by name."""

    def log(self, name: str, value: float, unit: str = "-") -> None:
        """See `quadsim.controller.StepInputs.log`."""
        if not isinstance(name, str) or not name.isidentifier() or name in COLUMNS:
            raise ParameterError("log", "name", name, "an identifier that is no column of flight.parquet")
        number = np.asarray(value)
        if number.shape or number.dtype.kind not in "biuf" or np.isinf(number):
            raise ParameterError("log", name, value, "one number, finite or NaN")
        self[name] = unit, float(number)


def stacked(periods: Sequence[LoggedSignals]) -> dict[str, tuple[str, Array]]:
    """Unit, of its first period, and values (K,) of each signal that K periods logged, NaN in periods without."""
    stack: dict[str, tuple[str, Array]] = {}
    for k, signals in enumerate(periods):
        for name, (unit, value) in signals.items():
            if name not in stack:
                stack[name] = (unit, np.full(len(periods), math.nan))
            _, values = stack[name]
            values[k] = value
    return stack


class Sampled:
    """What follows from states, references and commands at the control samples, whatever else is logged of them."""

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
        error[:, REFERENCE_NAMES.index("yaw")] = wrapped(error[:, REFERENCE_NAMES.index("yaw")])
        return error

    @property
    def measured_error(self) -> Array:
        """(K, 12) measured less true state; a logged attitude gives a rotation vector and body rates, body axes.

        Without one, it is the difference of Euler angles and of their rates.
        """
        error = self.state - self.truth
        error[:, INDEX["yaw"]] = wrapped(error[:, INDEX["yaw"]])
        if self.attitude is not None and self.body_rates is not None:
            angles = self.truth[:, ANGLES]
            rates = self.truth[:, ANGLE_RATES]
            turn = multiply(conjugate(euler_to_quaternion(angles)), self.attitude)
            error[:, ANGLES] = 2.0 * np.copysign(1.0, turn[:, :1]) * turn[:, 1:]
            error[:, ANGLE_RATES] = self.body_rates - euler_to_body_rates(angles, rates)
        return error

    @property
    def slews(self) -> Array:
        """(K, 4) command steps u(k) - u(k-1) [rad/s per period], Eq. (15)."""
        return np.diff(self.speeds, axis=0, prepend=self.speeds_before[None, :])


@dataclass(frozen=True, kw_only=True)
class Samples(Sampled):
    """The fields of a `ControlLog` on which signals depend: what the margins of a single period take."""

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
    speeds: Array = field(metadata=columns(_numbered("u", "rad/s")))
    """(K, 4) commanded rotor speeds in force at the end of the period."""
    speeds_before: Array  # (4,) u(-1), the command before the first [rad/s]
    status: tuple[str, ...] = field(metadata=columns(kind=TEXT))
    """K texts, one of `quadsim.controller.ACCEPTED` or the reason of a rejection; see `quadsim.controller.Command`."""
    answered_by: tuple[str, ...] = field(metadata=columns(kind=TEXT))
    """K texts: `gain`, `core`, a QP solver's name, `law`, `fallback` or `stopped`."""
    phase: tuple[str, ...] = field(metadata=columns(kind=TEXT))  # K texts, see `quadsim.controller.Phase`
    iterations: Counts = field(metadata=columns(kind=COUNT))
    """(K,), as the further fields named as those of `quadsim.controller.Statistics`."""
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
    truth: Array = field(metadata=columns({f"true_{name}": unit for name, unit in _STATE.items()}))
    """(K, 12) true state; not written where it equals the measured one."""
    attitude: Array | None = field(default=None, metadata=columns(_by_axis("q", "-", "wxyz")))
    """(K, 4) measured quaternion, sign continuous; None if Euler angles suffice."""
    body_rates: Array | None = field(default=None, metadata=columns(_by_axis("body_rate_", "rad/s")))
    """(K, 3) measured body rates; None if Euler angles suffice."""
    sqp: Array | None = field(default=None, metadata=columns({"sqp_defect": "-", "sqp_step": "-"}, gaps=True))
    """(K, 2) of `quadsim.controller.Statistics`, NaN in periods without; None if all are."""
    target: Array | None = field(
        default=None, metadata=columns({"target_thrust": "N", **_by_axis("target_body_rate_", "rad/s")}, gaps=True)
    )
    """(K, 4) collective thrust and body rates that the autopilot is to fly, NaN in periods without; None without an
    autopilot."""
    target_attitude: Array | None = field(default=None, metadata=columns(_by_axis("target_q", "-", "wxyz"), gaps=True))
    """(K, 4) attitude that it is to hold; None if it holds none."""
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


_OF_FIELDS: Final = columns_of(ControlLog)
COLUMNS: Final = frozenset(name for columns in _OF_FIELDS.values() for name in columns.units)
"""The columns of flight.parquet, but for those that a controller logs."""
RESIDUALS: Final = tuple(name for name, columns in _OF_FIELDS.items() if columns.gaps and not columns.optional)
"""Fields that every flight has, with gaps."""


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
    speeds: Array = field(metadata=columns(_numbered("w", "rad/s")))
    """(M, 4) rotor speeds from t on; rotors that lag pass through them."""
    wrench: Array | None = field(default=None, metadata=columns(_by_axis("force_", "N") | _by_axis("torque_", "N m")))
    """(M, 6) external force, world, and torque, body frame, from t on; None if there is none."""
    wind: Array | None = field(default=None, metadata=columns(_by_axis("wind_", "m/s")))
    """(M, 3) velocity of the air, world; None without wind."""
    battery: Array | None = field(default=None, metadata=columns({"voltage": "V", "charge": "-"}))
    """(M, 2) of the step from t on; None without a battery."""
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
