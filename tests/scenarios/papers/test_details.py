"""Effects of details of Torrente et al. that no field of a scenario holds, flown with a test's own law or force.

The numbers are those of a separate implementation of the published simulation.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

import quadsim
from mpc.nonlinear.controller import NonlinearMPC
from mpc.nonlinear.reference import Nodes, nodes_of_motion
from mpc.nonlinear.rigidbody import linearise_nodes, rigid_body
from quadsim.controller import Command, Moment
from quadsim.state import POSITIONS, VELOCITIES, Array
from scenarios.build import build_controller
from scenarios.courses.make import build_motion
from scenarios.flight import Flight
from scenarios.loading import load_scenario
from scenarios.parts.vehicle import build_vehicle
from scenarios.run import fly_scenario

N, STRIDE = 10, 5
Q = np.repeat([10.0, 0.1, 0.05, 0.05], [3, 4, 3, 3])
R = 0.1


class LateWindow:
    """Nodes k + 1, k + 6, ... in place of k, k + 5, ..."""

    name, solver = "late", ""

    def __init__(self, law: NonlinearMPC) -> None:
        self._law, self.horizon = law, law.horizon

    def reset(self, speeds: Array) -> None:
        self._law.reset(speeds)

    def step(self, now: Moment, state: Array, reference: Array) -> Command:
        assert now.motion is not None
        return self._law.step(replace(now, motion=now.motion.after(1)), state, reference)

    def predict(self, states: Array, plans: Array) -> Array:
        return self._law.predict(states, plans)


@pytest.mark.parametrize(("name", "expected", "digit"), [("loop4-ideal", 0.04073, 5e-6), ("loop8-drag", 0.18521, 2e-4)])
def test_a_window_one_sample_late(name: str, expected: float, digit: float) -> None:
    scenario = load_scenario(f"torrente-{name}", ["constraints=[]"])
    law = build_controller(scenario, build_vehicle(scenario))
    assert isinstance(law, NonlinearMPC)
    assert mean_error(fly_scenario(scenario, law=LateWindow(law))) == pytest.approx(expected, abs=digit)


def drag_in_world_axes(time: float, state: Array) -> Array:
    """The published drag of 1 kg, but by components of the velocity in the world frame."""
    x, y, z = state[VELOCITIES].tolist()
    return np.array([-(0.08 * abs(x) + 0.3) * x, -(0.08 * abs(y) + 0.3) * y, -0.08 * abs(z) * z, 0.0, 0.0, 0.0])


def test_drag_by_component_in_the_world_frame() -> None:
    scenario = load_scenario("torrente-loop8-ideal", ["constraints=[]"])
    assert mean_error(quadsim.fly(scenario, forces=[drag_in_world_axes], progress=False)) == pytest.approx(
        0.2492, abs=1e-4
    )


def mean_error(flight: Flight) -> float:
    assert flight.log.reason is None
    return float(flight.metrics["position_error.mean"])


def first_command(nodes: Nodes, state: Array, guess: tuple[Array, Array]) -> Array:
    """(4,) of one Gauss-Newton step from a guess of states (N + 1, 13) and inputs (N, 4), condensed and least squares.

    Nothing of our controller is in it but the linearised model.
    """
    x, u = guess
    model = rigid_body(build_vehicle(load_scenario("torrente-loop8-ideal")), 0.1)
    A, B, end = linearise_nodes(model, x[:-1], u)
    c = end - x[1:]
    free, forced = [state - x[0]], [np.zeros((13, 4 * N))]
    for i in range(N):
        step = A[i] @ forced[-1]
        step[:, 4 * i : 4 * i + 4] += B[i]
        free.append(A[i] @ free[-1] + c[i])
        forced.append(step)
    weights = np.sqrt(Q)
    rows = [weights[:, None] * each for each in forced[:N]]
    wanted = [weights * (nodes.states[i] - x[i] - free[i]) for i in range(N)]
    left = np.vstack([*rows, np.sqrt(R) * np.eye(4 * N)])
    right = np.concatenate([*wanted, np.sqrt(R) * (nodes.thrusts / 20.0 - u).ravel()])
    found = lsq_linear(left, right, (-u.ravel(), 1.0 - u.ravel()), tol=1e-14)
    return np.asarray(u[0] + found.x[:4])


@pytest.mark.parametrize("course", ["loop8", "lemniscate8"])
def test_the_first_command_differs_by_the_first_guess_alone(course: str) -> None:
    """From a guess of zero it is the published one, from the reference ours."""
    scenario = load_scenario(f"torrente-{course}-ideal")
    vehicle = build_vehicle(scenario)
    motion = build_motion(scenario, vehicle)
    assert motion is not None
    nodes = nodes_of_motion(motion, N, STRIDE)
    state = nodes.states[0]
    low, high = 0.122371, 0.122879
    published = [low, high, high, low] if course == "loop8" else [high, high, low, low]
    zero = np.zeros((N + 1, 13)), np.zeros((N, 4))
    np.testing.assert_allclose(first_command(nodes, state, zero), published, atol=6e-7)

    law = build_controller(scenario, vehicle)
    assert isinstance(law, NonlinearMPC)
    received = np.zeros(12)
    received[POSITIONS], received[VELOCITIES] = state[:3], state[7:10]
    moment = Moment(time=0.0, attitude=state[3:7], body_rates=state[10:], motion=motion)
    ours = np.square(law.step(moment, received, np.zeros((law.horizon, 4))).speeds / vehicle.speed_max)
    from_reference = first_command(nodes, state, (nodes.states, np.clip(nodes.thrusts / 20.0, 0.0, 1.0)))
    np.testing.assert_allclose(ours, from_reference, atol=1e-7)
    assert np.abs(ours - published).max() > 5e-5
