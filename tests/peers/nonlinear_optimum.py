"""Nonlinear MPC against CasADi and IPOPT: its optimum when converged, and the steps of the real-time iteration."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from peers.casadi_ocp import Case, Found, Peer
from peers.checks import Check
from peers.do_mpc_ocp import DoMPC

from quadsim.controller import ACCEPTED, StepInputs
from quadsim.motion import Motion
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.laws.nonlinear import Nonlinear, Weights
from quadsim.mpc.laws.parts.nonlinear_mpc import STEP_TOLERANCE, NonlinearMPC
from quadsim.mpc.problem.constraints import Soft
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.state import N_STATES, POSITIONS, VELOCITIES, Array

COURSE: Final = "torrente-loop8-drag"
"""Whose reference motion and vehicle these are; the plant is not flown."""
ALLOWED: Final = 1e-5
"""Largest difference of an input, as a share of the largest."""
PAPER: Final = Case(name="Torrente et al., N = 10", nodes=10, node=0.1)
LAGGED: Final = Case(
    name="rotor lag and soft tilt, N = 20", nodes=20, node=0.05, lag=0.03, speeds=True, difference=False, attitude=1.0,
    velocity=0.3, move=0.5, steps=(0.04, *[0.08] * 19), tilt=math.radians(25.0), penalty=(50.0, 50.0),
)  # fmt: skip
PERIOD: Final = {PAPER: 0.02, LAGGED: 0.025}
STATES: Final = {PAPER: 20, LAGGED: 10}
"""Random states for the converged optimum, and periods of the real-time iteration."""


class Question(NamedTuple):
    """A state (n,) after an input (4,), at sample k of the course, with nodes (N + 1, 13) and inputs (N, 4)."""

    k: int
    state: Array
    before: Array
    states: Array
    inputs: Array


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Largest differences of inputs of each problem, and in how many of them a bound is active."""

    case: Case
    optima: Array
    steps: Array
    bounded: int

    @property
    def checks(self) -> tuple[Check, ...]:
        """The worst of each."""
        name = f"{self.case.name}: inputs, relative to the largest"
        both = (("converged solutions from random states", self.optima), ("real-time iterations", self.steps))
        return tuple(
            Check(what=f"{name}; {differences.size} {what}", peer="casadi", measured=float(differences.max()),
                  allowed=ALLOWED)
            for what, differences in both
        )  # fmt: skip


class Course:
    """The vehicle, its reference motion and our controller of a case."""

    def __init__(self, case: Case) -> None:
        scenario = load_scenario(COURSE)
        self.case = case
        self.vehicle = Assembly(scenario).vehicle
        motion = Assembly(scenario).motion
        assert motion is not None
        self.motion: Motion = motion
        self.stride = round(case.node / PERIOD[case])

    def law(self, iterations: int = 1, tolerance: float | None = None) -> NonlinearMPC:
        """Our controller."""
        case = self.case
        largest = self.vehicle.speed_max
        bounds = ActuatorBounds.of_vehicle(self.vehicle)
        if case.steps:
            bounds = ActuatorBounds.alike((0.0, largest), (-case.steps[0] * largest, case.steps[0] * largest))
        weights = {name: getattr(case, name) for name in vars(Weights())}
        made = Nonlinear(
            horizon=case.nodes * self.stride,
            node=case.node,
            iterations=iterations,
            inputs="speed" if case.speeds else "thrust",
            rotor_lag=case.lag,
            attitude_error="difference" if case.difference else "error-state",
            weights=Weights(**weights),
            tilt=math.degrees(case.tilt) if case.tilt else None,
            soft=Soft(linear=case.penalty[0], quadratic=case.penalty[1]) if any(case.penalty) else None,
        )
        return NonlinearMPC(
            self.vehicle, period=PERIOD[case], settings=made, bounds=bounds, tolerance=tolerance or STEP_TOLERANCE
        )

    def question(self, k: int, rng: np.random.Generator, before: Array | None, rotors: Array | None) -> Question:
        """A random state near the course at sample k, after an input, near the course's too where it is not given."""
        case = self.case
        motion = self.motion
        at = k + self.stride * np.arange(case.nodes + 1)
        states = np.hstack([motion.position, motion.attitude, motion.velocity, motion.body_rates])[at]
        inputs = motion.thrusts[at[:-1]] / 20.0
        inputs = np.sqrt(inputs) if case.speeds else inputs
        x = states[0].copy()
        turn = 0.2 * rng.normal(size=3)
        x[:3] += 0.3 * rng.normal(size=3)
        x[3:7] = _turned(x[3:7], turn)
        x[7:10] += 0.5 * rng.normal(size=3)
        x[10:] += 0.5 * rng.normal(size=3)
        if before is None:
            before = np.clip(inputs[0] + 0.03 * rng.normal(size=4), 0.0, 1.0)
        spinning = before if rotors is None else rotors
        return Question(k, np.concatenate([x, spinning]) if case.lag else x, before, states, inputs)

    def plan(self, law: NonlinearMPC, question: Question, time: float) -> Array:
        """(N, 4) inputs that our controller answers."""
        state = np.zeros(N_STATES)
        state[POSITIONS] = question.state[:3]
        state[VELOCITIES] = question.state[7:10]
        moment = StepInputs(
            time=time,
            acting=self.speeds(question.before),
            attitude=question.state[3:7],
            body_rates=question.state[10:13],
            motion=self.motion.after(question.k),
        )
        command = law.step(moment, state, np.zeros((law.horizon, 4)))
        assert command.status in ACCEPTED, command.status
        shares = command.plan[:: self.stride] / self.vehicle.speed_max
        return shares if self.case.speeds else np.square(shares)

    def speeds(self, inputs: Array) -> Array:
        """[rad/s]."""
        return self.vehicle.speed_max * (inputs if self.case.speeds else np.sqrt(inputs))


def _turned(q: Array, by: Array) -> Array:
    """The quaternion q after a rotation vector in the body frame."""
    angle = np.linalg.norm(by)
    d = math.cos(angle / 2)
    v = math.sin(angle / 2) / angle * by
    return np.concatenate([[q[0] * d - q[1:] @ v], q[0] * v + d * q[1:] + np.cross(q[1:], v)])


def optima(case: Case, peer: Peer | DoMPC) -> Iterator[tuple[Found, Array]]:
    """A peer's optimum and our inputs (N, 4), converged, at random states along the course."""
    course = Course(case)
    rng = np.random.default_rng(17)
    law = course.law(iterations=300, tolerance=1e-9)
    for k in rng.integers(0, len(course.motion) - 50, STATES[case]).tolist():
        question = course.question(k, rng, None, None)
        law.reset(course.speeds(question.before))
        result = peer.optimum(question.state, question.states, question.inputs, question.before)
        yield result, course.plan(law, question, 0.0)


def steps(case: Case) -> Iterator[tuple[Found, Array]]:
    """IPOPT's optimum of each period's QP, linearised along its own last plan, and our inputs (N, 4)."""
    course = Course(case)
    peer = Peer(case)
    rng = np.random.default_rng(18)
    law = course.law()
    first = 300
    before = rotors = course.question(first, rng, None, None).inputs[0]
    law.reset(course.speeds(before))
    plan = None
    for i in range(STATES[case]):
        if i and case.lag:
            rotors = before + math.exp(-PERIOD[case] / case.lag) * (rotors - before)
        question = course.question(first + i, rng, before, rotors)
        if plan is None:
            speeds = np.concatenate([question.inputs, question.inputs[-1:]])
            start = np.hstack([question.states, speeds]) if case.lag else question.states
            plan = start, np.clip(question.inputs, 0.0, 1.0)
        result = peer.step(plan, question.state, question.states, question.inputs, before)
        yield result, course.plan(law, question, PERIOD[case] * i)
        plan = result[:2]
        before = result.inputs[0]


def measure(case: Case) -> Agreement:
    """Both comparisons.

    Raises:
        ArithmeticError: IPOPT did not solve a problem.
    """
    whole = list(optima(case, Peer(case)))
    each = list(steps(case))
    if not all(result.solved for result, _ in (*whole, *each)):
        raise ArithmeticError(f"{case.name}: IPOPT did not solve every problem")
    differences = [np.array([np.abs(result.inputs - ours).max() for result, ours in pairs]) for pairs in (whole, each)]
    return Agreement(
        case=case,
        optima=differences[0],
        steps=differences[1],
        bounded=sum(_bounded(case, result) for result, _ in (*whole, *each)),
    )


def _bounded(case: Case, found: Found) -> bool:
    """Whether a bound is active: on an input, or the one on the tilt."""
    q = found.states[1:, 3:7]
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    up = 1.0 - 2.0 * (q[:, 1] ** 2 + q[:, 2] ** 2)
    at_bound = np.minimum(found.inputs, 1.0 - found.inputs) < 1e-7
    return bool(at_bound.any() or (case.tilt and (up < math.cos(0.97 * case.tilt)).any()))
