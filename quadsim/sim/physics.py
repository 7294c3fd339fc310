"""The simulator's state over physics steps, its conversion to the paper's state, and flown periods as a log.

A physics step is time, position, quaternion, velocity and body rates, as MuJoCo has them; a state of the paper is
x, vx, ..., yaw, yaw_rate (`quadsim.state`).  `Period` has what one control period recorded; `flight_log` stacks the
periods into the `quadsim.flight.log.FlightLog` that the audit reads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from quadsim.controller import FALLBACK, MISSED, Command, Phase, Statistics, StepInputs
from quadsim.core.mirror import core_library
from quadsim.errors import ParameterError
from quadsim.flight.log import (
    ControlLog,
    FlightLog,
    LoggedSignals,
    PeriodLog,
    PlantLog,
    Samples,
    TimingLog,
    stacked,
)
from quadsim.state import INDEX, N_STATES, Array
from quadsim.vehicle import N_ROTORS

PHYSICS: Final = {
    "position": slice(1, 4),  # world [m]
    "attitude": slice(4, 8),  # quaternion wxyz, body to world
    "velocity": slice(8, 11),  # world [m/s]
    "body_rates": slice(11, 14),  # body frame [rad/s]
}
"""Columns of MuJoCo's state (14,), whose first is the time [s]."""
PhysicsSteps = NDArray[np.void]
"""Physics steps, a row each, with the fields of `steps_type`."""
Integrator = Literal["mujoco", "rk4"]  # integrator of the physics steps: MuJoCo, or the core's own method


def whole(owner: str, name: str, value: float, count: float, rule: str, *, smallest: int = 1) -> int:
    """Convert a count of physics steps, derived from a parameter, to a whole number.

    Raises:
        ParameterError: it is not whole, or too small.
    """
    steps = round(count)
    if steps < smallest or not math.isclose(steps, count, rel_tol=1e-9, abs_tol=1e-9):
        raise ParameterError(owner, name, value, rule)
    return steps


def steps_per_period(control_period: float, timestep: float) -> int:
    """Return the number of physics steps in a control period.

    Raises:
        ParameterError: it is not a whole, positive number.
    """
    rule = f"a whole multiple of the physics step of {timestep} s"
    return whole("scenario", "control_period", control_period, control_period / timestep, rule)


def inner_steps(rate: float, timestep: float, owner: str = "controller.inner") -> int:
    """Return the number of physics steps between two calls of an inner loop.

    Raises:
        ParameterError: it is not a whole, positive number.
    """
    rule = f"such that 1 / rate is a whole multiple of the physics step of {timestep} s"
    return whole(owner, "rate", rate, 1.0 / (rate * timestep), rule)


def steps_type(*, wrench: bool = False, wind: bool = False, battery: bool = False) -> np.dtype[np.void]:
    """Return the type of a row of `PhysicsSteps`; fields that nothing causes are absent.

    `physics` (14,) is MuJoCo's state after the step; `speeds` (4,) are the rotor speeds at its start, `commands` (4,)
    those commanded during it, saturated [rad/s]; `thrust` is the collective thrust in its middle [N]; `wrench` (6,) is
    the force, world [N], and torque, body frame about its origin [N m], of all effects but contact over the step;
    `wind` (3,) is the velocity of the air in its middle, world [m/s]; `battery` (2,) is the voltage over the step [V]
    and the charge at its start [-].
    """
    fields: list[tuple[str, type[float], int | tuple[()]]] = [
        ("physics", float, 14),
        ("speeds", float, N_ROTORS),
        ("commands", float, N_ROTORS),
        ("thrust", float, ()),
    ]
    if wrench:
        fields.append(("wrench", float, 6))
    if wind:
        fields.append(("wind", float, 3))
    if battery:
        fields.append(("battery", float, 2))
    return np.dtype(fields)


def physics_to_state(physics: Array, yaw: float = 0.0) -> Array:
    """Convert MuJoCo's states to the paper's states (M, 12).

    They have Euler-angle rates (Sec.  2.2 uses body rates), and a yaw unwrapped along the rows as by `YawUnwrapper`.

    Args:
        physics: (M, 14) time, position (world), quaternion wxyz, velocity (world), angular rates (body).
        yaw: the first row's yaw is unwrapped to the turn nearest to it [rad].
    """
    if physics.strides[1:] != (8,):
        physics = np.ascontiguousarray(physics, np.float64)
    states = np.empty((len(physics), N_STATES))
    width = physics.strides[0] // 8
    core_library().quadsim_states(physics.ctypes.data, len(physics), width, yaw, states.ctypes.data)
    return states


@dataclass(frozen=True, kw_only=True)
class Observation:
    """The data at the start of a control period."""

    k: int  # index of the period
    state: Array  # (12,) measured or estimated
    truth: Array  # (12,) true
    reference: Array  # (4,) filtered x, y, z [m], yaw [rad] at t_k
    preview: Array  # (N, 4) the same at t_{k+1} .. t_{k+N}, as far as it is known
    moment: StepInputs  # time, and further inputs of a controller; `moment.acting` is u(k-1)


@dataclass(frozen=True, kw_only=True)
class Period:
    """One flown control period: M physics steps, and the command that they follow."""

    observation: Observation  # the data at its start
    command: Command  # the controller's answer, or the command passed to `step`
    speeds: Array
    """(4,) u(k), the rotor speeds of `command`, of an earlier one if it was missed, or of an autopilot at its end
    [rad/s]."""
    target: Array | None  # (4,) or (8,) the same as a target of an autopilot; None without one
    delay: float  # simulated time from the measurement to the command [s]
    missed: bool  # whether the command came too late
    step_s: float  # wall time of the controller's step [s]; 0 if the command was passed in
    before: Array  # (14,) MuJoCo's state at its start; see `quadsim.sim.physics.physics_to_state`
    steps: PhysicsSteps  # (M,) its physics steps
    rotors: Array  # (4,) rotor speeds at its end [rad/s]

    @property
    def phase(self) -> Phase:
        """The phase of the flight."""
        return self.observation.moment.phase

    @property
    def position(self) -> Array:
        """(M, 3) after each step, world [m]."""
        return self._physics("position")

    @property
    def attitude(self) -> Array:
        """(M, 4) after each step: quaternion wxyz, body to world, sign continuous."""
        return self._physics("attitude")

    @property
    def velocity(self) -> Array:
        """(M, 3) after each step, world [m/s]."""
        return self._physics("velocity")

    @property
    def body_rates(self) -> Array:
        """(M, 3) after each step, body frame [rad/s]."""
        return self._physics("body_rates")

    def _physics(self, name: str) -> Array:
        part: Array = self.steps["physics"][:, PHYSICS[name]]
        return part


def flight_log(
    samples: Sequence[Period], start: Array, speeds: Array, yaw: float, period: float, timestep: float,
    *, quaternions: bool = False,
) -> FlightLog:  # fmt: skip
    """Convert control periods of a length [s] to a log with plant rows at the physics rate.

    The start is given by MuJoCo's state (14,), rotor speeds (4,) [rad/s] and a yaw [rad], for its turns.
    """
    control = _control_log(samples, speeds, period)
    plant = _plant_log(samples, start, speeds, yaw, timestep)
    if quaternions:
        attitudes = []
        rates = []
        parts = [start[None]]
        for sample in samples:
            attitudes.append(sample.observation.moment.attitude)
            rates.append(sample.observation.moment.body_rates)
            parts.append(sample.steps["physics"])
        control = replace(
            control,
            attitude=np.array(attitudes, float).reshape(-1, 4),
            body_rates=np.array(rates, float).reshape(-1, 3),
        )
        physics = np.concatenate(parts)
        attitude = physics[:, PHYSICS["attitude"]]
        body_rates = physics[:, PHYSICS["body_rates"]]
        plant = replace(plant, attitude=attitude, body_rates=body_rates)
    if control.target is not None:
        thrusts = [_thrusts(sample) for sample in samples]
        thrust = np.concatenate(thrusts)
        plant = replace(plant, thrust=np.append(thrust, thrust[-1]))
    return FlightLog(control=control, timing=_timing_log(samples, control.t), plant=plant)


def one_period(sample: Period, timestep: float) -> PeriodLog:
    """Return what the margins of a control period take."""
    observed = sample.observation
    moment = sample.observation.moment
    steps = sample.steps
    assert moment.acting is not None
    target = None
    thrust = None
    if sample.target is not None:
        target = sample.target[None, :4]
        thrust = np.append(steps["thrust"], steps["thrust"][-1:])
    t = moment.time + timestep * np.arange(len(steps) + 1)
    physics = np.concatenate([sample.before[None], steps["physics"]])
    return PeriodLog(
        control=Samples(
            t=np.round(t[:1], 9),
            state=observed.state[None],
            truth=observed.truth[None],
            reference=observed.reference[None],
            speeds=sample.speeds[None],
            speeds_before=moment.acting,
            target=target,
        ),
        plant=PlantLog(
            t=np.round(t, 9),
            state=physics_to_state(physics, float(observed.truth[INDEX["yaw"]])),
            speeds=np.concatenate([steps["speeds"], sample.rotors[None]]),
            thrust=thrust,
        ),
    )


def _control_log(samples: Sequence[Period], initial_speeds: Array, period: float) -> ControlLog:
    count = len(samples)
    state = np.empty((count, N_STATES))
    truth = np.empty((count, N_STATES))
    reference = np.empty((count, 4))
    speeds = np.empty((count, N_ROTORS))
    rows = np.empty((count, len(Statistics._fields)))
    fallback = np.empty(count, np.int64)
    delay = np.empty(count)
    status = []
    answered_by = []
    phase = []
    signals = []
    for k, sample in enumerate(samples):
        observed = sample.observation
        command = sample.command
        state[k] = observed.state
        truth[k] = observed.truth
        reference[k] = observed.reference
        speeds[k] = sample.speeds
        rows[k] = command.stats
        delay[k] = sample.delay
        phase.append(str(sample.phase))
        fallback[k] = command.fallback
        if sample.missed:
            fallback[k] = max(command.fallback, 1)
            status.append(MISSED)
        else:
            status.append(command.status)
        if fallback[k]:
            answered_by.append(FALLBACK)
        else:
            answered_by.append(command.answered_by)
        if isinstance(observed.moment.signals, LoggedSignals):
            signals.append(observed.moment.signals)
    stats = dict(zip(Statistics._fields, rows.T.copy(), strict=True))
    del stats["solve_s"]  # a clock time
    progress = np.column_stack([stats.pop("sqp_defect"), stats.pop("sqp_step")])
    sqp = None
    if not np.isnan(progress).all():
        sqp = progress
    targets = _targets(samples)
    target = None
    target_attitude = None
    if targets is not None:
        target = targets[:, :4]
        if not np.isnan(targets[:, 4:]).all():
            target_attitude = targets[:, 4:]
    return ControlLog(
        t=instants(count, period),
        state=state,
        truth=truth,
        reference=reference,
        speeds=speeds,
        speeds_before=np.array(initial_speeds, float),
        status=tuple(status),
        answered_by=tuple(answered_by),
        phase=tuple(phase),
        iterations=stats.pop("iterations").astype(np.int64),
        active=stats.pop("active").astype(np.int64),
        fallback=fallback,
        **stats,
        delay=delay,
        sqp=sqp,
        target=target,
        target_attitude=target_attitude,
        logged=stacked(signals),
    )


def _thrusts(sample: Period) -> Array:
    """(M,) collective thrust over the steps of a period [N]; NaN where no autopilot has a target."""
    thrust: Array = sample.steps["thrust"]
    if sample.target is None:
        return np.full(len(thrust), math.nan)
    return thrust


def _targets(samples: Sequence[Period]) -> Array | None:
    """(K, 8) targets in force, four numbers and an attitude, NaN where there is none; None without an autopilot."""
    if all(sample.target is None for sample in samples):
        return None
    rows = np.full((len(samples), 8), math.nan)
    for row, sample in zip(rows, samples, strict=True):
        if sample.target is not None:
            row[: sample.target.size] = sample.target
    return rows


def _timing_log(samples: Sequence[Period], t: Array) -> TimingLog:
    solve_ms = [1e3 * sample.command.stats.solve_s for sample in samples]
    step_ms = [1e3 * sample.step_s for sample in samples]
    return TimingLog(t=t, solve_ms=np.array(solve_ms), step_ms=np.array(step_ms))


def _plant_log(samples: Sequence[Period], start: Array, initial_speeds: Array, yaw: float, timestep: float) -> PlantLog:
    if not samples:
        return PlantLog(t=instants(1, timestep), state=physics_to_state(start[None], yaw), speeds=initial_speeds[None])
    steps = [sample.steps for sample in samples]
    return plant_log(np.concatenate(steps), samples[-1].rotors, start, yaw, timestep)


def plant_log(steps: PhysicsSteps, rotors: Array, start: Array, yaw: float, timestep: float) -> PlantLog:
    """Return the log of physics steps (M,), at least one.

    Args:
        steps: the steps.
        rotors: (4,) rotor speeds at the end [rad/s].
        start: (14,) MuJoCo's state before the first.
        yaw: the first row's is on the turn nearest to it [rad].
        timestep: [s].
    """
    physics = np.concatenate([start[None], steps["physics"]])
    # What acts during a step is shown from its start on, so the last row repeats that of the last step.
    acting = {}
    for name in ("wrench", "wind", "battery"):
        if name in (steps.dtype.names or ()):
            acting[name] = np.append(steps[name], steps[name][-1:], axis=0)
    return PlantLog(
        t=instants(len(physics), timestep),
        state=physics_to_state(physics, yaw),
        speeds=np.concatenate([steps["speeds"], rotors[None]]),
        **acting,
    )


def instants(count: int, spacing: float) -> Array:
    """Return instants k * spacing, without the rounding of accumulation or binary fractions."""
    return np.round(np.arange(count) * spacing, 9)
