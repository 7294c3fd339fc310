"""A vehicle that is disturbed exactly as the filter assumes: by white force and torque on a rigid body."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy_filter import difference
from scipy.spatial.transform import Rotation
from sensor_samples import sampler_of, taken

from quadsim.sim.estimator import ErrorStateFilter, EstimatorSettings
from quadsim.sim.sensing import KINDS, Sensor, SensorName
from quadsim.state import Array
from quadsim.vehicle import Vehicle

TIMESTEP = 1e-3


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Made-up flights of S vehicles over M physics steps.

    Attributes:
        physics: (S, M + 1, 14) as MuJoCo's state, the start first.
        commands: (M, 4) rotor speeds during each step.
    """

    physics: Array
    commands: Array

    def bias_free_mean(self, seed: int, step: int) -> Array:
        """(16,) the true mean, gyro bias zero."""
        row = self.physics[seed, step]
        return np.concatenate([row[1:4], row[8:11], row[4:8], row[11:14], np.zeros(3)])


def simulate(
    vehicle: Vehicle,
    settings: EstimatorSettings,
    commands: Array,
    *,
    seeds: int,
    rng: np.random.Generator,
    attitude: tuple[float, float, float] = (0.0, 0.0, 0.0),
    rates: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Motion:
    """Rigid bodies under rotor speeds (M, 4) and white noise of the settings' densities, Euler-Maruyama at 1 ms.

    Written with rotation matrices of SciPy's, and apart from the filter's prediction in all else.
    """
    inertia = np.array(vehicle.inertia)
    turn = Rotation.from_euler("ZYX", np.tile(np.radians(attitude[::-1]), (seeds, 1)), degrees=False)
    p = np.zeros((seeds, 3))
    v = np.zeros((seeds, 3))
    w = np.tile(np.array(rates, float), (seeds, 1))
    physics = np.zeros((seeds, len(commands) + 1, 14))
    down = np.array([0.0, 0.0, -vehicle.gravity])
    for k in range(len(commands) + 1):
        physics[:, k, 0] = k * TIMESTEP
        physics[:, k, 1:4] = p
        physics[:, k, 8:11] = v
        physics[:, k, 11:14] = w
        physics[:, k, 4:8] = turn.as_quat(scalar_first=True)
        if k == len(commands):
            break
        wrench = vehicle.allocation @ commands[k] ** 2
        kicks = np.sqrt(TIMESTEP) * rng.standard_normal((2, seeds, 3))
        before = v
        spin = w
        w = w + TIMESTEP * (wrench[1:] - np.cross(w, inertia * w)) / inertia
        middle = turn * Rotation.from_rotvec(0.5 * TIMESTEP * spin)
        v = v + TIMESTEP * (middle.apply([0.0, 0.0, wrench[0] / vehicle.mass]) + down)
        turn = turn * Rotation.from_rotvec(0.5 * TIMESTEP * (spin + w))
        p = p + 0.5 * TIMESTEP * (before + v)
        v = v + settings.acceleration_noise * kicks[0]
        w = w + settings.angular_acceleration_noise * kicks[1]
    return Motion(physics=physics, commands=commands)


def run(
    vehicle: Vehicle,
    motion: Motion,
    sensors: dict[SensorName, Sensor],
    settings: EstimatorSettings,
    *,
    seed: int,
    assumed: dict[SensorName, Sensor] | None = None,
    chunk: int = 50,
    standing: range = range(0),
    **faults: Any,
) -> tuple[ErrorStateFilter, Array, Array, list[float]]:
    """One seed through sensors and filter, which receives that the vehicle stands in chunks that begin in `standing`.

    Returns:
        The filter, its errors (K, 15) against the truth after each `chunk` steps, gyro bias included, its standard
        deviations (K, 15), and its NEES at each.
    """
    rng = np.random.default_rng([8, seed])
    bias = math.radians(settings.initial_gyro_bias) * rng.standard_normal(3)
    known = {
        name: replace(s, bias=tuple(np.degrees(bias))) if name is SensorName.RATES else s for name, s in sensors.items()
    }
    generators = rng.spawn(len(SensorName))
    samples = np.concatenate(
        [
            taken(sampler_of(name, s, *faults.get("faults", ()), rng=g), motion.physics[seed])
            for (name, s), g in zip(known.items(), generators, strict=False)
        ]
    )
    latency = np.zeros(len(SensorName), int)
    for name, sensor in known.items():
        latency[KINDS[name]] = sensor.latency(name, TIMESTEP)
    arrival = samples["taken"] + latency[samples["kind"]]
    filter_ = ErrorStateFilter(vehicle, assumed or sensors, settings, timestep=TIMESTEP)
    filter_.reset(motion.bias_free_mean(seed, 0), motion.commands[0], rng)
    errors = []
    deviations = []
    nees = []
    for first in range(0, len(motion.commands), chunk):
        stop = first + chunk
        arrived = samples[(arrival > (first if first else -1)) & (arrival <= stop)]
        filter_.advance(motion.commands[first:stop], [arrived], on_ground=first in standing)
        mean, covariance = filter_.estimate()
        true = motion.bias_free_mean(seed, stop)
        true[13:] = bias
        error = difference(true, mean)
        errors.append(error)
        deviations.append(np.sqrt(np.diag(covariance)))
        nees.append(float(error @ np.linalg.solve(covariance, error)))
    return filter_, np.array(errors), np.array(deviations), nees


@pytest.fixture(scope="session")
def simulate_motion(vehicle: Vehicle) -> Callable[..., Motion]:
    return lambda *args, **kwargs: simulate(vehicle, *args, **kwargs)


@pytest.fixture(scope="session")
def run_filter(vehicle: Vehicle) -> Callable[..., Any]:
    return lambda *args, **kwargs: run(vehicle, *args, **kwargs)
