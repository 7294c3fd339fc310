"""The plant: the only owner of the MuJoCo model and its data."""

from __future__ import annotations

import math
from types import TracebackType
from typing import Final

import mujoco
import numpy as np
from mujoco.rollout import Rollout

from quadsim.airframe import compile_model, rotor_thrusts
from quadsim.controller import check_command
from quadsim.errors import CommandError, DivergenceError, ParameterError
from quadsim.state import (
    EULER,
    EULER_RATE,
    N_STATES,
    POSITION,
    VELOCITY,
    Array,
    body_to_euler_rates,
    euler_to_body_rates,
    euler_to_quaternion,
    quaternion_to_euler,
)
from quadsim.vehicle import N_ROTORS, Vehicle

_FULL: Final = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
_CONTROL: Final = int(mujoco.mjtState.mjSTATE_CTRL)
_PLAUSIBLE: Final = 1e6
"""Largest magnitude of any time [s], position [m], speed [m/s] or rate [rad/s] taken for flight, not divergence."""
_NUMERICAL_WARNINGS: Final = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
    mujoco.mjtWarning.mjWARN_BADCTRL,
)


def steps_per_period(control_period: float, timestep: float) -> int:
    """How many physics steps make one control period.

    Raises:
        ParameterError: the period is not a whole, positive number of steps.
    """
    steps = round(control_period / timestep)
    if steps < 1 or not math.isclose(steps * timestep, control_period, rel_tol=1e-9):
        rule = f"a whole multiple of the physics step of {timestep} s"
        raise ParameterError("scenario", "control_period", control_period, rule)
    return steps


def physics_to_state(physics: Array, yaw: float = 0.0) -> Array:
    """The paper's state from MuJoCo's.

    Args:
        physics: (M, 14) time, position (world), quaternion wxyz, velocity (world), angular rates (body).
        yaw: near which turn the first row's yaw is [rad].

    Returns:
        (M, 12) states with Euler-angle rates (Sec. 2.2 takes body rates for them; see `quadsim.state`), yaw
        unwrapped along the rows.
    """
    state = np.empty((physics.shape[0], N_STATES))
    euler = quaternion_to_euler(physics[:, 4:8])
    state[:, POSITION] = physics[:, 1:4]
    state[:, VELOCITY] = physics[:, 8:11]
    state[:, EULER_RATE] = body_to_euler_rates(euler, physics[:, 11:14])
    if len(euler) > 1:
        euler[:, 2] = np.unwrap(euler[:, 2])
    turns = round((yaw - float(euler[0, 2])) / (2.0 * math.pi)) if len(euler) and math.isfinite(euler[0, 2]) else 0
    euler[:, 2] += 2.0 * math.pi * turns
    state[:, EULER] = euler
    return state


class Plant:
    """A vehicle in MuJoCo: fourth-order Runge-Kutta at a fixed step, rotor speeds held between commands.

    Use as a context manager; it owns native memory.

    Attributes:
        vehicle: what flies.
        timestep: physics step [s].
        model: the compiled model, not to be changed.
    """

    def __init__(self, vehicle: Vehicle, *, timestep: float = 1e-3, limit_speeds: bool = False) -> None:
        self.vehicle = vehicle
        self.timestep = timestep
        self.model = compile_model(vehicle, timestep=timestep, limit_speeds=limit_speeds)
        self._speed_range = (vehicle.speed_min, vehicle.speed_max) if limit_speeds else (0.0, math.inf)
        self._data = mujoco.MjData(self.model)
        mujoco.set_mju_user_warning(_discard)
        self._rollout = Rollout(nthread=0)
        self._physics = np.zeros((1, mujoco.mj_stateSize(self.model, _FULL)))
        self._yaw = 0.0

    def __enter__(self) -> Plant:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._rollout.close()

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return float(self._physics[0, 0])

    @property
    def hover_speeds(self) -> Array:
        """(4,) omega_bar on all rotors [rad/s], u(-1) of a flight that starts at rest in the air."""
        return np.full(N_ROTORS, self.vehicle.hover_speed)

    @property
    def physics(self) -> Array:
        """(14,) copy of MuJoCo's own state; see `physics_to_state`."""
        return self._physics[0].copy()

    def reset(self, state: Array) -> None:
        """Put the vehicle at a state (12,) at time zero.

        Raises:
            ParameterError: the state is not 12 finite numbers.
        """
        state = np.asarray(state, float)
        if state.shape != (N_STATES,) or not np.all(np.isfinite(state)):
            raise ParameterError("plant", "state", state.tolist(), f"{N_STATES} finite numbers")
        mujoco.mj_resetData(self.model, self._data)
        euler = state[list(EULER)]
        self._physics[0] = np.concatenate(
            [
                [0.0],
                state[list(POSITION)],
                euler_to_quaternion(euler),
                state[list(VELOCITY)],
                euler_to_body_rates(euler, state[list(EULER_RATE)]),
            ]
        )
        self._yaw = float(euler[2])

    def state(self) -> Array:
        """(12,) the true state now, yaw unwrapped since the last reset."""
        state = physics_to_state(self._physics, self._yaw)[0]
        self._yaw = float(state[EULER[2]])
        return state

    def applied(self, speeds: Array) -> Array:
        """The rotor speeds (4,) [rad/s] that a command makes: it saturates at what the rotors can do, and at zero."""
        return np.clip(speeds, *self._speed_range)

    def advance(self, speeds: Array, steps: int) -> Array:
        """Hold rotor speeds for a number of physics steps.

        Args:
            speeds: (4,) commanded rotor speeds [rad/s].
            steps: physics steps.

        Returns:
            (steps, 14) MuJoCo's state after each step; see `physics_to_state`.

        Raises:
            CommandError: the command is not four finite numbers; nothing moved.
            DivergenceError: the state is no longer finite or plausible.
        """
        problem = check_command(speeds)
        if problem is not None:
            raise CommandError(problem, time=self.time)
        thrusts = rotor_thrusts(self.vehicle, self.applied(speeds))
        control = np.broadcast_to(thrusts, (1, steps, N_ROTORS))
        trajectory: Array = self._run(control, steps)
        self._check(trajectory)
        self._physics[0] = trajectory[-1]
        return trajectory

    def _run(self, control: Array, steps: int) -> Array:
        states = np.empty((1, steps, self._physics.shape[1]))
        sensors = np.empty((1, steps, self.model.nsensordata))
        self._rollout.rollout(
            [self.model],
            [self._data],
            self._physics,
            np.ascontiguousarray(control),
            control_spec=_CONTROL,
            skip_checks=True,
            nstep=steps,
            state=states,
            sensordata=sensors,
        )
        return states[0]

    def _check(self, trajectory: Array) -> None:
        if not np.abs(trajectory).max() < _PLAUSIBLE:  # as NaN is not
            plausible = (np.abs(trajectory) < _PLAUSIBLE).all(axis=1)
            time = self.time + self.timestep * (1 + int(np.argmin(plausible)))
            raise DivergenceError("the plant diverged: its state is not finite or beyond all plausibility", time=time)
        counts = self._data.warning.number
        if counts.any() and (raised := [kind.name for kind in _NUMERICAL_WARNINGS if counts[int(kind)]]):
            raise DivergenceError(f"the plant diverged: MuJoCo reports {', '.join(raised)}", time=self.time)


def _discard(message: str) -> None:
    """Receive MuJoCo's warnings, which `Plant._check` reads as counts; else they go to the terminal and a log file."""
