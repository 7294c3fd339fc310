"""Samples of a motion that is known beforehand: one by one, as `quadsim.sim.sensing` states them, or by the core."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from quadsim.core.mirror import core_library
from quadsim.core.structs import SAMPLE, SampleFault
from quadsim.sim.navigation import Navigation
from quadsim.sim.physics import steps_type
from quadsim.sim.sensing import KINDS, Sampler, Sensor, SensorFault, SensorName, truth
from quadsim.state import Array

TIMESTEP = 1e-3


def sampler_of(
    name: SensorName, sensor: Sensor, *faults: SensorFault, seed: int = 0, rng: np.random.Generator | None = None
) -> Sampler:
    return Sampler(name, sensor, timestep=TIMESTEP, faults=faults, rng=rng or np.random.default_rng(seed))


def taken(sampler: Sampler, physics: Array) -> NDArray[np.void]:
    """The samples of a motion (M, 14) from its start, without lost ones: an independent version of the core's."""
    steps = np.arange(0, len(physics), sampler.stride)
    errors, sample_faults = sampler.draw(0, len(steps))
    rows = physics[steps]
    if sampler.name is SensorName.ATTITUDE:
        turned = Rotation.from_quat(rows[:, 4:8], scalar_first=True) * Rotation.from_rotvec(errors)
        values = turned.as_euler("ZYX")[:, ::-1].copy()
    else:
        values = truth(sampler.name, rows) + errors
    through = None
    for value, faults in zip(values, sample_faults, strict=True):
        if faults & SampleFault.FROZEN and through is not None:
            value[:] = through
        elif not faults & SampleFault.LOST:
            through = value.copy()
        value[[bool(faults & SampleFault.NO_NUMBER << axis) for axis in range(3)]] = np.nan
    samples = np.empty(len(steps), SAMPLE)
    samples["taken"] = steps
    samples["kind"] = KINDS[sampler.name]
    samples["value"] = values
    return samples[sample_faults & SampleFault.LOST == 0]


def follow(navigation: Navigation, physics: Array, commands: Array, first: int, *, on_ground: bool = False) -> None:
    """Let a navigation follow a motion (M, 14) under commands (M, 4) from after physics step `first` on."""
    sensing = navigation.begin(len(physics))
    for step, row in enumerate(physics, first + 1):
        motion = np.ascontiguousarray(row[1:])
        core_library().quadsim_sense(sensing, step, motion.ctypes.data)
    flown = np.zeros(len(physics), steps_type())
    flown["physics"] = physics
    flown["commands"] = commands
    navigation.record(flown, on_ground=on_ground)
