"""Open loop: the same random rotor speeds held by RotorPy and by MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from peers.checks import Check
from peers.rotorpy_plant import make_multirotor
from scipy.spatial.transform import Rotation

from quadsim.sim.physics import steps_per_period
from quadsim.sim.plant import Plant
from quadsim.state import Array, make_state
from quadsim.vehicle import N_ROTORS, Vehicle

SEEDS: Final = range(20)
HOLD: Final = 0.05
"""How long speeds are held [s]: 20 Hz."""
HOLDS: Final = 80
"""Holds per flight: 4 s."""
AMPLITUDE: Final = 5.0
"""Rotor speeds are drawn uniformly from hover plus or minus this [rad/s], which makes the vehicle tumble."""
TIMESTEPS: Final = (5e-3, 2e-3, 1e-3)
"""MuJoCo's steps [s] compared; the last one is what quadsim flies with."""
BETRAYAL: Final = 1e-6
"""The relative error of one inertia that the comparison is shown to see."""


@dataclass(frozen=True, kw_only=True)
class Path:
    """Where a vehicle was at the end of each hold."""

    position: Array  # (HOLDS, 3) in the world frame [m]
    attitude: Rotation  # HOLDS rotations, body to world

    @property
    def tilt(self) -> float:
        """The largest angle between body and world z [rad]."""
        return float(np.arccos(np.clip(self.attitude.as_matrix()[:, 2, 2], -1.0, 1.0)).max())


@dataclass(frozen=True, kw_only=True)
class Difference:
    """The largest over all flights and holds."""

    position: float  # distance along any axis [m]
    attitude: float  # angle of the rotation from one to the other [rad]


@dataclass(frozen=True, kw_only=True)
class OpenLoop:
    """What was found."""

    differences: tuple[Difference, ...]  # MuJoCo from RotorPy, for each of `TIMESTEPS`
    betrayal: Difference  # the same at the last of them, when MuJoCo's Ixx is off by `BETRAYAL`
    tilt: float  # the largest angle between body and world z [rad]

    @property
    def checks(self) -> tuple[Check, ...]:
        """Position and attitude at the step that quadsim flies with."""
        flown = self.differences[-1]
        return (
            Check(what="plant, open loop: position", peer="rotorpy", measured=flown.position, allowed=1e-9, unit="m"),
            Check(what="plant, open loop: attitude", peer="rotorpy", measured=flown.attitude, allowed=1e-9, unit="rad"),
        )


def measure(vehicle: Vehicle) -> OpenLoop:
    """Fly every seed on RotorPy, and on MuJoCo with each of the time steps."""
    speeds = [draw_speeds(vehicle, seed) for seed in SEEDS]
    peer = [fly_rotorpy(vehicle, flight) for flight in speeds]

    def against_peer(flown: Vehicle, timestep: float) -> Difference:
        return largest_difference([fly_mujoco(flown, flight, timestep) for flight in speeds], peer)

    ixx, iyy, izz = vehicle.inertia
    return OpenLoop(
        differences=tuple(against_peer(vehicle, timestep) for timestep in TIMESTEPS),
        betrayal=against_peer(replace(vehicle, inertia=(ixx * (1.0 + BETRAYAL), iyy, izz)), TIMESTEPS[-1]),
        tilt=max(path.tilt for path in peer),
    )


def draw_speeds(vehicle: Vehicle, seed: int) -> Array:
    """(HOLDS, 4) rotor speeds [rad/s]."""
    return vehicle.hover_speeds + np.random.default_rng(seed).uniform(-AMPLITUDE, AMPLITUDE, (HOLDS, N_ROTORS))


def fly_rotorpy(vehicle: Vehicle, speeds: Array) -> Path:
    """Hold speeds (HOLDS, 4) [rad/s] from rest, each by one call of RotorPy's own `step`."""
    multirotor = make_multirotor(vehicle)
    state = {name: np.zeros(3) for name in ("x", "v", "w", "wind")} | {"q": np.array([0.0, 0.0, 0.0, 1.0])}
    positions = []
    quaternions = []
    for held in speeds:
        state = multirotor.step({**state, "rotor_speeds": held}, {"cmd_motor_speeds": held}, HOLD)
        positions.append(state["x"])
        quaternions.append(state["q"])
    return Path(position=np.array(positions), attitude=Rotation.from_quat(quaternions))


def fly_mujoco(vehicle: Vehicle, speeds: Array, timestep: float) -> Path:
    """Hold speeds (HOLDS, 4) [rad/s] from rest in quadsim's plant, with a physics step [s]."""
    steps = steps_per_period(HOLD, timestep)
    with Plant(vehicle, timestep=timestep) as plant:
        plant.reset(make_state())
        physics = np.array([plant.advance(held, steps)["physics"][-1] for held in speeds])
    return Path(position=physics[:, 1:4], attitude=Rotation.from_quat(physics[:, 4:8], scalar_first=True))


def largest_difference(ours: list[Path], peer: list[Path]) -> Difference:
    """The largest differences between flights."""
    pairs = list(zip(ours, peer, strict=True))
    return Difference(
        position=max(float(np.abs(a.position - b.position).max()) for a, b in pairs),
        attitude=max(float((a.attitude.inv() * b.attitude).magnitude().max()) for a, b in pairs),
    )
