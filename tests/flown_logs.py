"""Logs of simulated flights, as a logger writes them: a CSV table at 100 Hz, with the noise of its sensors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import quadsim
from quadsim.rollout.flown import Flight
from quadsim.rotation import euler_to_body_rates, euler_to_quaternion
from quadsim.state import ANGLE_RATES, ANGLES, POSITIONS, VELOCITIES

COLUMNS = "t,x,y,z,vx,vy,vz,qw,qx,qy,qz,wx,wy,wz,u1,u2,u3,u4"
NOISE = (0.0, *3 * [1e-3], *3 * [1e-2], *4 * [0.0], *3 * [1e-2], *4 * [0.0])
"""Standard deviation of each column: s, m, m/s, -, rad/s, rad/s."""


def fly_eight(vehicle: str | Path, **changes: Any) -> Flight:
    """A figure eight of some 12 s with yaw steps, by the geometric controller at 100 Hz."""
    first = quadsim.scenario(vehicle=vehicle, course="figure-eight", controller="geometric").scenario
    steps = [{"type": "setpoint", "at": 2.0 + 1.5 * i, "yaw": 25.0 * (-1) ** i} for i in range(6)]
    turn = 0.75 * first.reference.period  # type: ignore[union-attr]
    course = {"reference.period": turn, "reference.ramp": 0.5 * turn, "reference.turns": 10.0 / turn - 0.5}
    return quadsim.fly(
        first.replace({"control_period": 0.01, "constraints": [], "events": steps, **course, **changes}), progress=False
    )


def write_log(flight: Flight, path: Path, seed: int = 0) -> Path:
    """Write the flight's log."""
    log = flight.log.control
    angles = log.state[:, ANGLES]
    rows = np.column_stack(
        [
            *(log.t, log.state[:, POSITIONS], log.state[:, VELOCITIES], euler_to_quaternion(angles)),
            *(euler_to_body_rates(angles, log.state[:, ANGLE_RATES]), log.speeds),
        ]
    )
    rows += np.array(NOISE) * np.random.default_rng(seed).standard_normal(rows.shape)
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=COLUMNS, comments="")
    return path
