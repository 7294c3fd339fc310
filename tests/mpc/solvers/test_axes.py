"""Which axes a problem falls into, and that they are worth as much together as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support import paper_problem, random_axes, random_problem

from quadsim.mpc.problem.ocp import Problem
from quadsim.mpc.solvers.core_axes import Axis, axes
from quadsim.state import STATE_NAMES, Array

QUADROTOR = {("x", "vx", "pitch", "pitch_rate"), ("y", "vy", "roll", "roll_rate")}


def names(problem: Problem) -> set[tuple[str, ...]]:
    """The states of the axes that have bounds; of none, where there is one axis only."""
    result = axes(problem)
    if len(result) == 1:
        np.testing.assert_array_equal(result[0].T, np.eye(problem.model.nu))
        np.testing.assert_array_equal(result[0].states, np.arange(problem.model.n))
        return set()
    return {tuple(STATE_NAMES[i] for i in axis.states) for axis in result if axis.outputs.size}


def inverse(problem: Problem, axis: Axis) -> Array:
    """S (m, nu) in w = S (u - u_bar), of all axes together."""
    weighted = axis.T.T @ problem.objective.Q_u
    return np.asarray(np.linalg.solve(weighted @ axis.T, weighted))


@pytest.mark.parametrize("vehicle", ["lopes2011", "crazyflie2", "hummingbird"])
def test_a_hovering_quadrotor_falls_into_four_axes_and_tilts_in_two(vehicle: str) -> None:
    """Whether its arms point along its axes or between them."""
    problem = paper_problem("paper-constrained", f"vehicle.file={vehicle}")
    assert names(problem) == QUADROTOR
    result = axes(problem)
    assert sorted(np.concatenate([axis.states for axis in result])) == list(range(12))
    assert [axis.T.shape for axis in result] == [(4, 1)] * 4
    every = np.hstack([axis.T for axis in result])
    np.testing.assert_allclose(np.vstack([inverse(problem, axis) for axis in result]) @ every, np.eye(4), atol=1e-12)


def test_every_axis_with_a_bound_counts() -> None:
    problem = paper_problem("paper-constrained", "controller.output_bounds={roll=[-5.0, 5.0], vz=[-1.0, 1.0]}")
    assert names(problem) == {("y", "vy", "roll", "roll_rate"), ("z", "vz")}
    unbounded = paper_problem("paper-constrained", "controller.output_bounds={}")
    assert names(unbounded) == set()


def test_rotors_of_different_weight_tie_the_axes() -> None:
    """The fourth rotor leaves pitch alone, and trades roll for climb and yaw."""
    problem = paper_problem("paper-constrained", "controller.input_weights.speed=[0.01, 0.01, 0.01, 0.02]")
    rest = tuple(name for name in STATE_NAMES if name not in ("x", "vx", "pitch", "pitch_rate"))
    assert names(problem) == {("x", "vx", "pitch", "pitch_rate"), rest}
    whole = paper_problem("paper-constrained", "controller.input_weights.speed=[0.01, 0.01, 0.015, 0.02]")
    assert names(whole) == set()


@pytest.mark.parametrize("tie", ["A", "Q_y", "C_r", "C_c", "two rows of C_c"])
def test_whatever_ties_two_states_ties_their_axes(tie: str) -> None:
    problem = paper_problem()
    assert problem.bounds is not None
    x, y, pitch, roll = (STATE_NAMES.index(name) for name in ("x", "y", "pitch", "roll"))
    if tie == "A":
        A = problem.model.A.copy()
        A[x, y] = 1e-3
        problem = replace(problem, model=replace(problem.model, A=A))
    elif tie == "Q_y":
        Q_y = problem.objective.Q_y.copy()
        Q_y[0, 1] = Q_y[1, 0] = 1e-3
        problem = replace(problem, objective=replace(problem.objective, Q_y=Q_y))
    elif tie == "C_r":  # rows whose product with the weights is the identity all the same
        C_r = problem.objective.C_r.copy()
        Q_y = problem.objective.Q_y.copy()
        C_r[0, [x, y]] = 1.0
        Q_y[:2, :2] = [[1.0, -1.0], [-1.0, 2.0]]
        problem = replace(problem, objective=replace(problem.objective, C_r=C_r, Q_y=Q_y))
    else:
        C_c = problem.bounds.C_c.copy()
        C_c[0, [roll, pitch]] = 1.0
        if tie != "C_c":  # roll + pitch and roll - pitch, whose product is diagonal all the same
            C_c[1, [roll, pitch]] = [1.0, -1.0]
        problem = replace(problem, bounds=replace(problem.bounds, C_c=C_c))
    together = tuple(name for name in STATE_NAMES if name not in ("z", "vz", "yaw", "yaw_rate"))
    assert names(problem) == {together}


def test_one_piece_is_one_axis() -> None:
    problem = random_problem(np.random.default_rng(0), horizon=4)
    (whole,) = axes(problem)
    np.testing.assert_array_equal(whole.outputs, np.flatnonzero(problem.rows.C.any(axis=1)))
    for ours, its in (
        (problem.model.A, whole.problem.model.A),
        (problem.model.B, whole.problem.model.B),
        (problem.objective.Q_y, whole.problem.objective.Q_y),
        (problem.objective.Q_u, whole.problem.objective.Q_u),
    ):
        np.testing.assert_array_equal(ours, its)


def test_a_bounded_axis_that_nothing_moves_or_without_a_set_point_leaves_one_piece() -> None:
    problem = paper_problem()
    B = problem.model.B.copy()
    B[[STATE_NAMES.index(name) for name in ("y", "vy", "roll", "roll_rate")]] = 0.0
    assert names(replace(problem, model=replace(problem.model, B=B))) == set()
    assert problem.bounds is not None
    on_nothing = replace(problem.bounds, C_c=problem.bounds.C_c * [[0.0], [1.0]])
    assert names(replace(problem, bounds=on_nothing)) == set()
    indifferent = paper_problem("paper-constrained", "controller.output_weights={x=1.0, z=1.0, yaw=1.0}")
    assert names(indifferent) == set()


def test_an_unbounded_axis_without_a_set_point_is_left_out() -> None:
    problem = paper_problem("paper-constrained", "controller.output_weights={x=1.0, y=1.0, z=1.0}")
    assert names(problem) == QUADROTOR
    assert len(axes(problem)) == 3


def test_an_empty_row_prevents_separation() -> None:
    """By a weight on it with another row, its set-point would count."""
    problem = paper_problem()
    C_r = problem.objective.C_r.copy()
    C_r[0] = 0.0
    assert names(replace(problem, objective=replace(problem.objective, C_r=C_r))) == set()


def cost(problem: Problem, state: Array, desired: Array, moves: Array) -> float:
    """Eq. (5), by recursion, of moves u - u_bar (N, nu)."""
    model = problem.model
    objective = problem.objective
    total = 0.0
    for move, wanted in zip(moves, desired, strict=True):
        state = model.A @ state + model.B @ move
        error = objective.C_r @ state - wanted
        total += error @ objective.Q_y @ error + move @ objective.Q_u @ move
    return float(total)


def test_costs_and_outputs_fall_apart() -> None:
    """Whatever the inputs of an axis, they change its own cost, states and outputs, and no other's."""
    rng = np.random.default_rng(3)
    problem = random_axes(rng, horizon=5, wider=1.0)
    assert problem.bounds is not None
    result = axes(problem)
    assert sorted(axis.states.size for axis in result) == [2, 2, 3]
    state = rng.normal(size=7)
    desired = rng.normal(size=(5, 7))
    moves = rng.normal(size=(5, 4))
    for axis in result:
        own = (axis.problem, state[axis.states], desired[:, axis.regulated])
        w = moves @ inverse(problem, axis).T
        change = rng.normal(size=(5, axis.T.shape[1]))
        whole = cost(problem, state, desired, moves + change @ axis.T.T) - cost(problem, state, desired, moves)
        assert cost(*own, w + change) - cost(*own, w) == pytest.approx(whole, rel=1e-9)
        others = np.setdiff1d(np.arange(7), axis.states)
        np.testing.assert_allclose(problem.model.B[others] @ axis.T, 0.0, atol=1e-12)
        np.testing.assert_allclose(problem.model.B[axis.states] @ moves.T, axis.problem.model.B @ w.T, atol=1e-9)
        assert not problem.bounds.C_c[np.ix_(axis.outputs, others)].any()
