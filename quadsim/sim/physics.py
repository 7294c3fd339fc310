"""The simulator's own state over a number of steps, and how it becomes the paper's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from quadsim.rotation import body_to_euler_rates, quaternion_to_euler
from quadsim.sim.sensing import whole
from quadsim.state import ANGLE_RATES, ANGLES, N_STATES, POSITIONS, VELOCITIES, Array

Integrator = Literal["mujoco", "rk4"]  # who takes the physics steps: MuJoCo, or `quadsim.sim.rigid_body`


def steps_per_period(control_period: float, timestep: float) -> int:
    """How many physics steps make one control period.

    Raises:
        ParameterError: the period is not a whole, positive number of steps.
    """
    rule = f"a whole multiple of the physics step of {timestep} s"
    return whole("scenario", "control_period", control_period, control_period / timestep, rule)


def inner_steps(rate: float, timestep: float) -> int:
    """How many physics steps lie between two calls of an inner loop.

    Raises:
        ParameterError: they are not a whole, positive number.
    """
    rule = f"such that 1 / rate is a whole multiple of the physics step of {timestep} s"
    return whole("controller.inner", "rate", rate, 1.0 / (rate * timestep), rule)


def physics_to_state(physics: Array, yaw: float = 0.0) -> Array:
    """The paper's states (M, 12) from MuJoCo's.

    With Euler-angle rates (Sec. 2.2 takes body rates for them), yaw unwrapped along the rows as by `YawTurns`.

    Args:
        physics: (M, 14) time, position (world), quaternion wxyz, velocity (world), angular rates (body).
        yaw: near which turn the first row's yaw is [rad].
    """
    state = np.empty((physics.shape[0], N_STATES))
    euler = quaternion_to_euler(physics[:, 4:8])
    state[:, POSITIONS] = physics[:, 1:4]
    state[:, VELOCITIES] = physics[:, 8:11]
    state[:, ANGLE_RATES] = body_to_euler_rates(euler, physics[:, 11:14])
    if len(euler) > 1:
        euler[:, 2] = np.unwrap(euler[:, 2])
    turns = round((yaw - float(euler[0, 2])) / (2.0 * math.pi)) if len(euler) and math.isfinite(euler[0, 2]) else 0
    euler[:, 2] += 2.0 * math.pi * turns
    upright = np.cos(euler[:, 0]) * np.cos(euler[:, 1]) >= 0.0
    last = yaw
    for first in np.flatnonzero(np.diff(upright)) + 1:  # as `quadsim.state.YawTurns`
        if not upright[first]:
            last = float(euler[first - 1, 2])
        elif math.isfinite(euler[first, 2]):
            euler[first:, 2] += 2.0 * math.pi * round((last - float(euler[first, 2])) / (2.0 * math.pi))
    state[:, ANGLES] = euler
    return state


@dataclass(frozen=True, kw_only=True)
class Segment:
    """What happened over a number of physics steps; M rows, one per step."""

    physics: Array  # (M, 14) MuJoCo's state after each step; see `physics_to_state`
    speeds: Array  # (M, 4) rotor speeds at the start of each step [rad/s]
    wrench: Array | None
    """(M, 6) force, world [N], and torque, body frame about its origin [N m], of all effects but contact, over each
    step; None where no effect makes any."""
    wind: Array | None  # (M, 3) velocity of the air in the middle of each step, world [m/s]; None without wind

    @staticmethod
    def join(parts: Sequence[Segment]) -> Segment:
        """Segments one after the other as one."""
        if len(parts) == 1:
            return parts[0]

        columns = {name: [getattr(part, name) for part in parts] for name in vars(parts[0])}
        stacked: dict[str, Any] = {name: None if c[0] is None else np.concatenate(c) for name, c in columns.items()}
        return Segment(**stacked)
