"""What could be saved by flying several flights together, their physics steps taken as one batch.

A controller's QP, its sensors and the log belong to one flight, and cost the same in company.  What flights could share
is the stepping: MuJoCo's own (`mujoco.batch.Batch`), and the forces that are evaluated between its steps, for all
vehicles at once in arrays.  Both ways are measured here, in turns, and compared to the bit.
"""

from __future__ import annotations

import contextlib
import math
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np
from mujoco.batch import Batch
from threadpoolctl import threadpool_limits

from quadsim.airframe import outline, rotor_thrusts
from quadsim.effects.forces import StepForces
from quadsim.errors import ParameterError
from quadsim.physics import Stretch
from quadsim.plant import Plant
from quadsim.state import Array, make_state
from quadsim.vehicle import N_ROTORS
from scenarios.bench.rungs import CONDITIONS
from scenarios.build import build_plant, build_vehicle
from scenarios.effects import build_wind
from scenarios.loading import load_scenario
from scenarios.runner import fly_scenario, silent
from scenarios.spec import Scenario

SIZES: Final = (8, 16, 32, 64)
"""Flights in a batch."""
ROUNDS: Final = 5
HOLDS: Final = 80
"""Control periods in a round, of each vehicle."""

_WINDY: Final = (*CONDITIONS["wind 3 m/s"].settings, *CONDITIONS["lag 10 ms"].settings)
CASES: Final[dict[str, tuple[str, tuple[str, ...]]]] = {
    "paper-constrained": ("paper-constrained", ()),
    "paper-constrained in wind": ("paper-constrained", _WINDY),
    "paper-unconstrained": ("paper-unconstrained", ()),
    "paper-unconstrained in wind": ("paper-unconstrained", _WINDY),
}
"""Scenarios and their settings; the wind is 3 m/s with turbulence, on rotors with a lag of 10 ms."""
_STATE: Final = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)


@dataclass(frozen=True, kw_only=True)
class Saving:
    """One case, flown one by one, and stepped together.

    Attributes:
        name: of the case.
        flight_s: processor time of one flight, set-up and audit included [s].
        steps: physics steps in it.
        alone_us: processor time of one physics step of one flight, one by one [us].
        together_us: the same by the number of flights stepped together.
        apart: largest difference between any number of the two ways' states, of all flights.
        log_bytes: what a flight keeps of each physics step while it lasts.
    """

    name: str
    flight_s: float
    steps: int
    alone_us: float
    together_us: dict[int, float]
    apart: float
    log_bytes: int

    def ratio(self, size: int) -> float:
        """Time of a flight among `size` over that of one alone, if all but the stepping costs the same."""
        return 1.0 - 1e-6 * self.steps * (self.alone_us - self.together_us[size]) / self.flight_s

    def log_mb(self, size: int) -> float:
        """Memory that the logs of `size` flights take while they are in the air together [MB]."""
        return 1e-6 * size * self.steps * self.log_bytes


class Together:
    """Vehicles of one scenario, each with a seed of its own, whose physics steps are taken together.

    Args:
        scenario: what they fly in; rotor lag, rotor drag and wind are the effects that it may have.
        size: how many they are.

    Raises:
        ParameterError: the scenario has an effect that is not one of these.
    """

    def __init__(self, scenario: Scenario, size: int) -> None:
        vehicle = build_vehicle(scenario)
        scenarios = [seeded(scenario, k) for k in range(size)]
        with contextlib.ExitStack() as stack:
            plants = [stack.enter_context(build_plant(each, vehicle)) for each in scenarios]
            self._models = [plant.model for plant in plants]
        effects = plants[0].effects
        left = effects.body_drag or effects.rotor_radius or effects.contact or effects.disturbance or effects.changes
        if left or effects.efficiency != (1.0,) * N_ROTORS:
            raise ParameterError("scenario", "effects", scenario.name, "none but rotor lag, rotor drag and wind")
        self._vehicle, self._rotors, self._timestep = vehicle, effects.rotors, scenario.plant.timestep
        self._winds = [build_wind(each, vehicle) for each in scenarios]
        shape = outline(vehicle)
        self._forces = StepForces(
            vehicle, effects, timestep=scenario.plant.timestep, floor=shape.floor, disc=shape.disc
        )
        self._by_step = effects.follows_state or self._winds[0] is not None
        self._batch = Batch(self._models[0], size, 1)
        self._batch.set_models(self._models)

    @property
    def size(self) -> int:
        """How many vehicles there are."""
        return self._batch.nsim

    def reset(self, physics: Array, speeds: Array) -> None:
        """Put all vehicles at one state (14,) with rotor speeds (4,) [rad/s]."""
        self._batch.reset()
        self._batch.qpos[:], self._batch.qvel[:] = physics[1:8], physics[8:]
        self._before = _entries(self._batch.qvel)
        self._speeds = [speeds] * self.size
        for wind in self._winds:
            if wind is not None:
                wind.reset()

    def advance(self, target: Array, steps: int) -> Array:
        """Hold a command (4,) [rad/s] for a number of steps: states (size, steps, 14)."""
        edges = self._timestep * np.arange(steps + 1, dtype=np.float64)
        times = np.concatenate([edges, edges[:-1] + 0.5 * self._timestep])
        thrusts = np.empty((self.size, steps, N_ROTORS))
        of_rotors, air = np.empty((steps, 6, self.size)), np.zeros((steps, 3, self.size))
        for k, wind in enumerate(self._winds):
            if self._rotors is None:
                middle, slopes = np.broadcast_to(target, (steps, N_ROTORS)), np.zeros((steps, N_ROTORS))
            else:
                speeds, slopes = self._rotors.respond(self._speeds[k], target, times)
                self._speeds[k], middle, slopes = speeds[steps], speeds[steps + 1 :], slopes[steps + 1 :]
            thrusts[k] = rotor_thrusts(self._vehicle, middle)
            if self._by_step:
                of_rotors[:, :, k] = self._forces.of_rotors(middle, slopes)
                if wind is not None:
                    air[:, :, k] = wind.advance(steps)
        if self._by_step:
            return self._take_steps(thrusts, of_rotors, air)
        return self._batch.rollout(steps, thrusts, record=(_STATE,))[_STATE]

    def _take_steps(self, thrusts: Array, of_rotors: Array, air: Array) -> Array:
        batch, forces = self._batch, self._forces.midway
        qpos, qvel, applied, control = batch.qpos, batch.qvel, batch.qfrc_applied, batch.ctrl
        steps = thrusts.shape[1]
        trajectory = np.empty((self.size, steps, 14))
        wrench = np.empty((6, self.size))
        for i in range(steps):
            position, velocity = _entries(qpos), _entries(qvel)
            acting = forces(position, velocity, self._before, (), list(of_rotors[i]), list(air[i]))
            self._before = velocity
            for row, entry in zip(wrench, acting, strict=True):
                row[:] = entry
            applied[:], control[:] = wrench.T, thrusts[:, i]
            batch.step()
            trajectory[:, i, 0], trajectory[:, i, 1:8], trajectory[:, i, 8:] = batch.time, qpos, qvel
        return trajectory


def _entries(table: Array) -> list[Any]:
    """Columns of a table (size, m), copied: each stands for one number of every vehicle."""
    return list(table.T.copy())


def seeded(scenario: Scenario, k: int) -> Scenario:
    """The scenario with the k-th of several seeds."""
    return scenario.model_copy(update={"seed": scenario.seed + k})


def bench_together(
    cases: Sequence[str] = tuple(CASES),
    *,
    sizes: Sequence[int] = SIZES,
    rounds: int = ROUNDS,
    holds: int = HOLDS,
    progress: Callable[[str, int, int], None] = silent,
) -> list[Saving]:
    """Measure what flying together could save: processor time on one thread, best of several rounds, in turns.

    Args:
        cases: of `CASES`.
        sizes: flights in a batch.
        rounds: of each way.
        holds: control periods in a round.
        progress: told how far it is.
    """
    savings = []
    with threadpool_limits(limits=1):
        for done, name in enumerate(cases):
            file, settings = CASES[name]
            savings.append(_measure(name, load_scenario(file, settings), sizes, rounds, holds))
            progress("cases", done + 1, len(cases))
    return savings


def _measure(name: str, scenario: Scenario, sizes: Sequence[int], rounds: int, holds: int) -> Saving:
    steps = scenario.steps_per_period
    batches = [Together(scenario, size) for size in sizes]
    alone_us, flight_s = math.inf, math.inf
    together_us = dict.fromkeys(sizes, math.inf)
    with build_plant(scenario, build_vehicle(scenario)) as plant:
        start, physics = _start(plant)
        target = plant.hover_speeds * [1.0, 1.0 + 1e-5, 1.0, 1.0]  # so that nothing stays zero
        for _ in range(rounds):
            started = clock.process_time()
            flight = fly_scenario(scenario)
            flight_s = min(flight_s, clock.process_time() - started)
            plant.reset(start)
            started = clock.process_time()
            for _ in range(holds):
                stretch = plant.advance(target, steps)
            alone_us = min(alone_us, 1e6 * (clock.process_time() - started) / (holds * steps))
            for batch in batches:
                batch.reset(physics, plant.hover_speeds)
                started = clock.process_time()
                for _ in range(holds):
                    batch.advance(target, steps)
                us = 1e6 * (clock.process_time() - started) / (holds * steps * batch.size)
                together_us[batch.size] = min(together_us[batch.size], us)
        apart = difference(scenario, min(sizes), holds)
    return Saving(
        name=name,
        flight_s=flight_s,
        steps=flight.log.control.t.size * steps,
        alone_us=alone_us,
        together_us=together_us,
        apart=apart,
        log_bytes=_kept(stretch) // steps,
    )


def difference(scenario: Scenario, size: int, holds: int) -> float:
    """Largest difference between the states of flights stepped together and one by one."""
    steps, apart = scenario.steps_per_period, 0.0
    vehicle, batch = build_vehicle(scenario), Together(scenario, size)
    with contextlib.ExitStack() as stack:
        plants = [stack.enter_context(build_plant(seeded(scenario, k), vehicle)) for k in range(size)]
        start, physics = _start(plants[0])
        batch.reset(physics, plants[0].hover_speeds)
        for plant in plants:
            plant.reset(start)
        for hold in range(holds):
            target = plants[0].hover_speeds * (1.0 + 1e-3 * np.sin(hold + np.arange(N_ROTORS)))
            together = batch.advance(target, steps)
            for plant, trajectory in zip(plants, together, strict=True):
                apart = max(apart, float(np.abs(plant.advance(target, steps).physics - trajectory).max()))
    return apart


def saving_rows(savings: Sequence[Saving]) -> list[tuple[str, ...]]:
    """A table with its head: a line per case."""
    sizes = tuple(savings[0].together_us)
    head = ("flight", "alone [s]", "a step alone [us]", *(f"among {size} [us]" for size in sizes))
    ratios = tuple(f"flight among {size}, ratio" for size in sizes)
    rows = [(*head, *ratios, f"logs of {max(sizes)} [MB]", "largest difference")]
    for saving in savings:
        rows.append(
            (
                saving.name,
                f"{saving.flight_s:.2f}",
                f"{saving.alone_us:.1f}",
                *(f"{saving.together_us[size]:.1f}" for size in sizes),
                *(f"{saving.ratio(size):.2f}" for size in sizes),
                f"{saving.log_mb(max(sizes)):.0f}",
                f"{saving.apart:g}",
            )
        )
    return rows


def _start(plant: Plant) -> tuple[Array, Array]:
    """A tilted state (12,), and MuJoCo's for it (14,)."""
    start = make_state(position=(0.0, 0.0, 50.0), euler=(0.05, -0.03, 0.3))
    plant.reset(start)
    return start, plant.physics


def _kept(stretch: Stretch) -> int:
    """Bytes of a stretch's arrays, without what is one row told again and again."""
    arrays = (stretch.physics, stretch.speeds, stretch.wrench, stretch.wind)
    return sum(array.nbytes for array in arrays if array is not None and array.strides[0])
