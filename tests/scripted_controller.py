"""A controller that answers as instructed, the guard around it, and the paper's model for both to fly by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from support import paper_problem

from quadsim.controller import SOLVED, Command, Statistics, StepInputs
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.guard.contract import Guard
from quadsim.mpc.pilot.pilot import Pilot
from quadsim.mpc.problem.equilibrium import Trim
from quadsim.mpc.problem.heading import advance as advance_from
from quadsim.mpc.problem.heading import turn
from quadsim.mpc.problem.model import LinearModel
from quadsim.mpc.problem.ocp import Problem
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.state import INDEX, Array
from quadsim.vehicle import Vehicle

PERIOD = 0.05


@cache
def problem() -> Problem:
    return paper_problem()


@cache
def vehicle() -> Vehicle:
    return Assembly(load_scenario("paper-constrained")).vehicle


@cache
def model() -> LinearModel:
    return problem().model


@cache
def bounds() -> ActuatorBounds:
    hard = problem().bounds
    assert hard is not None
    return ActuatorBounds(u_min=hard.u_min, u_max=hard.u_max, delta_min=hard.delta_min, delta_max=hard.delta_max)


@cache
def level() -> Trim:
    """Of the undisturbed vehicle."""
    return Trim(speeds=model().u_bar, lift=np.array([0.0, 0.0, 1.0]))


@cache
def pressed() -> Trim:
    """Of a vehicle that is heavier than its model, blown along x and turned by a torque of its own."""
    return Trim(speeds=model().u_bar + np.array([27.0, 31.0, 27.0, 23.0]), lift=np.array([-0.3, 0.0, 9.81]))


def advance(state: Array, speeds: Array, trim: Trim | None = None) -> Array:
    """The state (12,) a period later, by default undisturbed."""
    return advance_from(model(), state, speeds, trim or level())


def random_state(seed: int, scale: float = 0.1) -> Array:
    return scale * np.random.default_rng(seed).normal(size=12)


@dataclass
class Scripted:
    """Plans hover with one rotor a little faster, follows a script, and records its calls.

    A script's entry changes fields of that answer, or is raised.
    """

    script: dict[int, dict[str, Any] | Exception] = field(default_factory=dict)
    horizon: int = 30
    name: str = "scripted"
    solver: str = "none"
    calls: list[tuple[StepInputs, Array]] = field(default_factory=list)
    resets: list[Array] = field(default_factory=list)

    def reset(self, speeds: Array) -> None:
        self.resets.append(speeds)

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        entry = self.script.get(len(self.calls), {})
        self.calls.append((now, state.copy()))
        if isinstance(entry, Exception):
            raise entry
        plan = np.tile(model().u_bar, (self.horizon, 1))
        plan[:, 0] += np.linspace(0.0, 0.5, self.horizon)
        return replace(
            Command(speeds=plan[0].copy(), plan=plan, status=SOLVED, stats=Statistics(iterations=7)), **entry
        )

    def predict(self, states: Array, plans: Array) -> Array:
        predicted = np.empty((*plans.shape[:2], 12))
        for k, state in enumerate(states):
            now = state
            for i, speeds in enumerate(plans[k]):
                now = predicted[k, i] = advance(now, speeds)
        return predicted


def guard(inner: Any, **options: Any) -> Pilot:
    guarded = Pilot(inner, vehicle(), guard=Guard(model(), **{"bounds": bounds(), **options}))
    guarded.reset(model().u_bar)
    return guarded


def call(guarded: Pilot, state: Array | None = None, **now: Any) -> Command:
    return guarded.step(StepInputs(**now), np.zeros(12) if state is None else state, np.zeros((guarded.horizon, 4)))


def failing(periods: Sequence[int], **answer: Any) -> dict[int, dict[str, Any] | Exception]:
    return dict.fromkeys(periods, answer or {"status": "numerics"})


def following(guarded: Pilot, periods: int) -> list[Command]:
    """Commands while the vehicle moves as the model predicts."""
    state = np.zeros(12)
    commands = []
    for _ in range(periods):
        commands.append(call(guarded, state))
        state = advance(state, commands[-1].speeds)
    return commands


class Pressed(Scripted):
    """Knows what presses the vehicle, and plans what holds it at rest."""

    trim = pressed()

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        plan = np.tile(self.trim.speeds, (self.horizon, 1))
        answer = super().step(now, state, reference)
        return replace(answer, speeds=plan[0], plan=plan)

    def predict(self, states: Array, plans: Array) -> Array:
        raise ZeroDivisionError


def at_rest(yaw: float) -> Array:
    """Under `pressed`, at the origin, headed anywhere."""
    rest = turn(yaw) @ pressed().state(yaw)
    rest[INDEX["yaw"]] = yaw
    return rest
