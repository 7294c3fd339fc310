"""Processor time of whole flights, with and without their controllers, beside that of MuJoCo's step alone."""

from __future__ import annotations

import time as clock
from collections.abc import Mapping
from functools import partial
from typing import Any, Final

import mujoco
import numpy as np
from timing import Record, flown, options, run, undisturbed

from quadsim.commands.app import load
from quadsim.console.progress import Progress
from quadsim.core.mirror import core_library
from quadsim.core.structs import SAMPLE, SAMPLES, TrackStruct
from quadsim.scenarios.assembly import Assembly

SHORT: Final = 10.0  # [s] that is flown of a longer flight
GUSTY: Final = {
    "effects.rotors": {},
    "effects.air": {"rotor_drag": 1e-5, "turbulence": {"wind_speed_20ft": 5.0, "airspeed": 3.0}},
    "effects.ground": {"effect": True, "contact": False, "rotor_radius": 0.1},
}
MOTION_CAPTURE: Final = {
    **{"sensors.position.rate": 100.0, "sensors.position.noise": 0.01},
    **{"sensors.attitude.rate": 100.0, "sensors.attitude.noise": 0.26, "estimator.type": "error_state"},
}
FLIGHTS: Final[dict[str, tuple[str, Mapping[str, Any]]]] = {
    "paper-unconstrained": ("paper-unconstrained", {}),
    "paper-constrained": ("paper-constrained", {}),
    "robust": ("robust", {}),
    "robust; rotors, drag, turbulence, ground effect": ("robust", GUSTY),
    "battery": ("battery", {}),
    "autopilot, 1 kHz gyro": ("autopilot", {}),
    "autopilot; motion capture, Kalman filter": ("autopilot", MOTION_CAPTURE),
    "motion-capture; 1 kHz gyro": ("motion-capture", {"sensors.rates.rate": 1000.0}),
    "landing-by-estimate, 500 Hz gyro": ("landing-by-estimate", {}),
    "torrente-loop8-all, own Runge-Kutta step": ("torrente-loop8-all", {}),
}
"""Flights by what a row says: a scenario, and what is changed of it."""


def measure(quick: bool, report: Progress) -> list[Record]:
    """The best of rounds, of each flight."""
    rounds, records = 1 if quick else 3, []
    with undisturbed():
        for i, (name, (scenario_name, changes)) in enumerate(FLIGHTS.items()):
            report("flights", i, len(FLIGHTS))
            scenario = load(scenario_name)
            length = min(scenario.duration, 1.0 if quick else SHORT)
            scenario = scenario.replace({**changes, "duration": length, "constraints": []})
            times = [flown(scenario) for _ in range(rounds)]
            without = min(whole - sum(controller) for controller, whole, _ in times)
            _, whole, steps = min(times, key=lambda one: one[1])
            seconds = steps * scenario.plant.timestep
            records.append(
                {
                    "flight": name,
                    "without_the_controller_ms_per_s": 1e3 * without / seconds,
                    "whole_ms_per_s": 1e3 * whole / seconds,
                    "whole_us_per_step": 1e6 * whole / steps,
                }
            )
        records.append({"flight": "MuJoCo's step alone", "whole_us_per_step": 1e6 * _mujoco_step(rounds)})
        records.append({"flight": "a sample of the Kalman filter", "whole_us_per_step": 1e6 * _filter_sample(rounds)})
    return records


def _mujoco_step(rounds: int, steps: int = 2000) -> float:
    with Assembly(load("paper-constrained")).plant() as plant:
        data = mujoco.MjData(plant.model)
        return min(_timed(partial(mujoco.mj_step, plant.model, data, nstep=steps)) for _ in range(rounds)) / steps


def _filter_sample(rounds: int, samples: int = 1000) -> float:
    """Prediction over a step of 1 ms, and update by a gyro's sample."""
    assembly = Assembly(load("motion-capture"))
    navigation = assembly.navigation()
    assert navigation is not None
    with assembly.plant() as plant:
        navigation.reset(plant.physics, plant.vehicle.hover_speeds)
        commands, grounded = np.tile(plant.vehicle.hover_speeds, (samples, 1)), np.zeros(samples, np.uint8)
    estimator = navigation.filter
    assert estimator is not None
    taken = np.zeros(samples, SAMPLE)
    taken["taken"], taken["kind"] = np.arange(1, samples + 1), 3
    taken["value"] = 0.01 * np.random.default_rng(0).standard_normal((samples, 3))

    def use() -> None:
        track = TrackStruct.from_buffer_copy(estimator.track)
        given = taken.ctypes.data_as(SAMPLES), samples, commands.ctypes.data, grounded.ctypes.data, 0, -1
        core_library().quadsim_filter_run(estimator.struct, track, *given)

    return min(_timed(use) for _ in range(rounds)) / samples


def _timed(call: Any) -> float:
    started = clock.thread_time()
    call()
    return clock.thread_time() - started


def main() -> None:
    """Fly, print and write."""
    chosen = options(__doc__)
    run(partial(measure, chosen.quick), "Processor time of flights", chosen.json)


if __name__ == "__main__":
    main()
