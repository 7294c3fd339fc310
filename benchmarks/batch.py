"""Environment steps per second of processor time: single and many at once, beside gym-pybullet-drones if installed.

A step is 50 ms of flight: 50 physics steps of 1 ms, thrust and body rates flown at 500 Hz, a random agent that stays in
the air for a while.  Resets count.  The peer steps at 30 Hz with 8 physics steps each, as it ships.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from typing import Any, Final

import numpy as np
from timing import Record, options, run, undisturbed

import quadsim.gym
from quadsim.commands.app import load
from quadsim.console.progress import Progress
from quadsim.scenarios.schema.scenario import Scenario

SCENARIO: Final = "hummingbird-figure-eight"
OWN: Final = {"plant.integrator": "rk4"}
NOISY: Final = {"effects.thrust_noise": {"deviation": 0.02}, "effects.disturbance.force_noise": 0.01, **OWN}
MASS: Final = [
    {"name": "mass", "fields": ["actual.mass"], "distribution": "uniform", "low": 0.6, "high": 0.8},
    {"name": "inertia", "fields": ["actual.rotor_rise"], "distribution": "uniform", "low": 0.01, "high": 0.05},
]
SHAPE: Final = {"action": "rates", "observation": ("ahead", "state"), "preview": 5}
MANY: Final = 64
PEER: Final = "gym_pybullet_drones"
GENTLE: Final = 0.05  # share of the action space that the agent draws from
CASES: Final[dict[str, tuple[int, Mapping[str, Any], Mapping[str, Any]]]] = {
    "own method": (MANY, OWN, {}),
    "own method, without margins": (MANY, OWN, {"margins": False}),
    "own method, thrust noise and disturbance": (MANY, NOISY, {}),
    "own method, mass and lag drawn at each reset": (MANY, OWN, {"vary": MASS}),
    "MuJoCo's step": (MANY, {}, {}),
    "one environment, own method": (1, OWN, {}),
    "one environment, MuJoCo's step": (1, {}, {}),
}
"""By what a row says: how many environments, what is changed of the scenario, and options."""


def measure(quick: bool, report: Progress) -> list[Record]:
    """The best of rounds, of each kind of environment."""
    rounds, seconds = (1, 0.3) if quick else (3, 1.5)
    records = []
    with undisturbed():
        for i, (name, (count, changes, further)) in enumerate(CASES.items()):
            report("environments", i, len(CASES))
            scenario = load(SCENARIO).replace(dict(changes))
            stepping = _single(scenario) if count == 1 else _vector(scenario, count, further)
            rate = max(_rate(stepping, count, seconds) for _ in range(rounds))
            records.append(_record(name, count, rate, steps=50, period=scenario.control_period))
        if find_spec(PEER) is not None:
            rate = max(_rate(_peer(), 1, seconds) for _ in range(rounds))
            records.append(_record("gym-pybullet-drones", 1, rate, steps=8, period=1.0 / 30.0))
    return records


def _record(name: str, vehicles: int, rate: float, *, steps: int, period: float) -> Record:
    """A row: environment steps of a period [s], with so many physics steps each."""
    return {
        "environment": name,
        "vehicles": vehicles,
        "steps_per_cpu_s": rate,
        "physics_steps_per_cpu_s": rate * steps,
        "real_time": rate * period,
    }


def _rate(stepping: Callable[[], None], count: int, seconds: float) -> float:
    """Environment steps per second of processor time."""
    stepping()
    started, calls = clock.process_time(), 0
    while (elapsed := clock.process_time() - started) < seconds:
        stepping()
        calls += 1
    return count * calls / elapsed


def _vector(scenario: Scenario, count: int, further: Mapping[str, Any]) -> Callable[[], None]:
    envs = quadsim.gym.make_vec(scenario, count, **SHAPE, **further)
    envs.reset(seed=0)
    rng = np.random.default_rng(0)

    def step() -> None:
        envs.step(rng.uniform(-GENTLE, GENTLE, (count, 4)).astype(np.float32))

    return step


def _single(scenario: Scenario) -> Callable[[], None]:
    env = quadsim.gym.QuadrotorEnv(scenario, **SHAPE)  # type: ignore[arg-type]
    env.reset(seed=0)
    rng = np.random.default_rng(0)

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(rng.uniform(-GENTLE, GENTLE, 4).astype(np.float32))
        if terminated or truncated:
            env.reset()

    return step


def _peer() -> Callable[[], None]:
    """A vehicle of gym-pybullet-drones, as it ships: 240 Hz, 30 Hz."""
    from gym_pybullet_drones.envs.HoverAviary import HoverAviary
    from gym_pybullet_drones.utils.enums import ActionType, ObservationType

    env = HoverAviary(obs=ObservationType("kin"), act=ActionType("rpm"))
    env.reset(seed=0)
    action = np.zeros((1, 4), np.float32)

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()

    return step


if __name__ == "__main__":
    arguments = options(__doc__)
    run(lambda report: measure(arguments.quick, report), "environment steps per second of one core", arguments.json)
