"""One flight as arrays with units: the control periods, clock times, and the plant between commands.

`quadsim.flight.parquet` writes and reads it; `docs/conventions.md` defines states, frames and times.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

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

RESIDUALS: Final = (
    *("reported_primal", "reported_dual", "infeasibility"),
    *("kkt_stationarity", "kkt_complementarity", "kkt_dual"),
)
"""Columns that some periods lack: NaN here, null in files; see `quadsim.controller.Command`."""
WRENCH: Final = {**{f"force_{axis}": "N" for axis in "xyz"}, **{f"torque_{axis}": "N m" for axis in "xyz"}}
"""Columns of the external force, world, and torque, body frame, with units; only if there is any."""
WIND: Final = {f"wind_{axis}": "m/s" for axis in "xyz"}
"""Columns of the wind, world, with units; only if there is any."""
BATTERY: Final = {"voltage": "V", "charge": "-"}
"""Columns of the battery, with units; only if there is one."""

QUATERNION: Final = {f"q{axis}": "-" for axis in "wxyz"}
"""Columns of the attitude, body to world, with units; only for flights that may turn upside down."""
BODY_RATES: Final = {f"body_rate_{axis}": "rad/s" for axis in "xyz"}
"""Columns of the body rates, with units; same condition."""
SQP_RESIDUAL: Final = {"sqp_defect": "-", "sqp_step": "-"}
"""Columns of `quadsim.controller.SQP`, with units; only for flights with sequential quadratic programming."""
TARGET: Final = {"target_thrust": "N", **{f"target_body_rate_{axis}": "rad/s" for axis in "xyz"}}
"""Columns of the target in force, with units; only for flights with an autopilot."""
TARGET_ATTITUDE: Final = {f"target_q{axis}": "-" for axis in "wxyz"}
"""Columns of the attitude in it, with units; only where it has one."""

Fields = dict[str, dict[str, str]]
"""The fields of a log, each with its columns and their units."""
STATE: Final = dict(zip(STATE_NAMES, STATE_UNITS, strict=True))
TEXTS: Final = ("status", "answered_by", "phase")
COUNTS: Final = ("iterations", "active", "fallback")
CONTROL: Final[Fields] = {
    "t": {"t": "s"},
    "state": STATE,
    "reference": {f"ref_{name}": unit for name, unit in zip(REFERENCE_NAMES, REFERENCE_UNITS, strict=True)},
    "speeds": {f"u{i}": "rad/s" for i in range(1, N_ROTORS + 1)},
    **{name: {name: "-"} for name in (*TEXTS, *COUNTS)},
    "slack": {"slack": "rad"},
    **{name: {name: "-"} for name in RESIDUALS},
    "delay": {"delay": "s"},
    "truth": {f"true_{name}": unit for name, unit in STATE.items()},  # where the measured state differs
    "attitude": QUATERNION,
    "body_rates": BODY_RATES,
    "sqp": SQP_RESIDUAL,
    "target": TARGET,
    "target_attitude": TARGET_ATTITUDE,
}
COLUMNS: Final = frozenset(name for units in CONTROL.values() for name in units)
"""The columns of flight.parquet, but for those that a controller logs."""


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
    """Unit and values (K,) of each signal that K periods logged, NaN in periods without."""
    units = {name: unit for signals in reversed(periods) for name, (unit, _) in signals.items()}
    return {
        name: (units[name], np.array([signals.get(name, ("", math.nan))[1] for signals in periods]))
        for name in dict.fromkeys(name for signals in periods for name in signals)
    }


@dataclass(frozen=True, kw_only=True)
class ControlLog:
    """One row per control period k, taken at t_k; K rows."""

    t: Array  # (K,) [s]
    state: Array  # (K, 12) measured state, as the controller received it; units of `STATE_UNITS`
    truth: Array  # (K, 12) true state; equal if measurement is perfect
    reference: Array  # (K, 4) filtered reference x, y, z [m], yaw [rad] at t_k
    speeds: Array  # (K, 4) commanded rotor speeds in force at the end of the period [rad/s]
    speeds_before: Array  # (4,) u(-1), the command before the first [rad/s]
    status: tuple[str, ...]
    """K texts, one of `quadsim.controller.ACCEPTED` or the reason of a rejection; see `quadsim.controller.Command`."""
    answered_by: tuple[str, ...]
    """K texts: `gain`, `core`, a QP solver's name, `law`, `fallback` or `stopped`."""
    phase: tuple[str, ...]  # K texts, see `quadsim.controller.Phase`
    iterations: np.ndarray[Any, np.dtype[np.int64]]  # (K,) of the solver that answered
    active: np.ndarray[Any, np.dtype[np.int64]]  # (K,) constraints active at the optimum
    fallback: np.ndarray[Any, np.dtype[np.int64]]  # (K,) 0 none, higher = deeper
    slack: Array  # (K,) largest softening of an output bound [rad]
    reported_primal: Array  # (K,) as reported by the QP solver; here and below NaN if not available
    reported_dual: Array  # (K,) same
    infeasibility: Array  # (K,) largest violation of a row by the plan, less the row's slack [row's unit]
    kkt_stationarity: Array  # (K,) residuals computed from the QP; see `quadsim.controller.Command`
    kkt_complementarity: Array  # (K,) same
    kkt_dual: Array  # (K,) same
    delay: Array  # (K,) simulated time from the measurement to the command [s]
    attitude: Array | None = None  # (K, 4) measured quaternion wxyz, sign continuous; None if Euler angles suffice
    body_rates: Array | None = None  # (K, 3) measured body rates [rad/s]; None if Euler angles suffice
    sqp: Array | None = None  # (K, 2) of `quadsim.controller.SQP`, NaN in periods without; None if all are
    target: Array | None = None
    """(K, 4) collective thrust [N] and body rates [rad/s] that the autopilot is to fly, NaN in periods without; None
    without an autopilot."""
    target_attitude: Array | None = None  # (K, 4) attitude that it is to hold, wxyz; None if it holds none
    logged: Mapping[str, tuple[str, Array]] = field(default_factory=dict)
    """What the controller logged, by name: unit and values (K,), NaN in periods without."""

    @property
    def measured_perfectly(self) -> bool:
        """Whether the measured state always equals the true one."""
        return self.state is self.truth or bool(np.array_equal(self.state, self.truth))

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
            angles, rates = self.truth[:, ANGLES], self.truth[:, ANGLE_RATES]
            turn = multiply(conjugate(euler_to_quaternion(angles)), self.attitude)
            error[:, ANGLES] = 2.0 * np.copysign(1.0, turn[:, :1]) * turn[:, 1:]
            error[:, ANGLE_RATES] = self.body_rates - euler_to_body_rates(angles, rates)
        return error

    @property
    def crashed(self) -> bool:
        """Whether anything but the feet touched the ground."""
        return str(Phase.CRASHED) in self.phase

    @property
    def slews(self) -> Array:
        """(K, 4) command steps u(k) - u(k-1) [rad/s per period], Eq. (15)."""
        return np.diff(self.speeds, axis=0, prepend=self.speeds_before[None, :])


@dataclass(frozen=True, kw_only=True)
class TimingLog:
    """Clock times per control period."""

    t: Array
    solve_ms: Array
    step_ms: Array


@dataclass(frozen=True, kw_only=True)
class PlantLog:
    """The plant between commands; M rows, the first at t = 0 before the first command."""

    t: Array  # (M,) [s]
    state: Array  # (M, 12) true state, yaw unwrapped
    speeds: Array  # (M, 4) rotor speeds from t on [rad/s]; rotors that lag pass through them
    wrench: Array | None = None
    """(M, 6) external force, world [N], and torque, body frame [N m], from t on; None if there is none."""
    wind: Array | None = None  # (M, 3) velocity of the air, world [m/s]; None without wind
    battery: Array | None = None  # (M, 2) voltage [V] and charge [-] of the step from t on; None without a battery
    attitude: Array | None = None  # (M, 4) true quaternion wxyz; None if Euler angles suffice
    body_rates: Array | None = None  # (M, 3) true body rates [rad/s]; None if Euler angles suffice
    thrust: Array | None = None
    """(M,) collective thrust of the rotors [N], NaN where no autopilot has a target; None without an autopilot."""

    def every(self, stride: int) -> PlantLog:
        """Return every `stride`-th row, starting with the first."""
        thinned: dict[str, Any] = {name: None if rows is None else rows[::stride] for name, rows in vars(self).items()}
        return PlantLog(**thinned)


@dataclass(frozen=True, kw_only=True)
class FlightLog:
    """A whole flight, or the part that was flown."""

    control: ControlLog  # one row per control period
    timing: TimingLog  # clock times, one row per control period
    plant: PlantLog  # the plant, at the physics rate after a flight, at the log rate when read from a file
    predicted: np.ndarray[Any, np.dtype[np.float32]] | None = None
    """(K, N, 3) float32 positions [m] predicted in each period for t_{k+1} .. t_{k+N}, N the shortest horizon of its
    controllers; None if one of them has no model."""
    reason: str | None = None  # why the flight ended early; None if it was completed
    interrupted: bool = False  # whether the user ended it
    traceback: tuple[str, ...] = ()  # last traceback lines of the exception in a controller or force that ended it
    lost: str | None = None  # loss criterion that ended it, e.g. `tilt`; None if none did

    @property
    def aborted(self) -> bool:
        """Whether the user or an exception ended the flight, not the vehicle."""
        return self.interrupted or bool(self.traceback)

    @property
    def status(self) -> str:
        """`completed` or `aborted`."""
        return "completed" if self.reason is None else "aborted"
