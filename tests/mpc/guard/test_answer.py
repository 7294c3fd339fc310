"""What may reach the plant: hard bounds of actuators, why an answer is rejected, and what is left of a plan."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import paper_problem

from quadsim.controller import SOLVED, UNCONSTRAINED
from quadsim.errors import ParameterError
from quadsim.mpc.guard.answer import BOUND_TOLERANCE, ActuatorBounds, rejection, shifted
from quadsim.mpc.problem.constraints import Constraint, Penalty
from quadsim.mpc.problem.ocp import Problem
from quadsim.state import Array

HOVER = np.full(4, 190.0)


def with_row(name: str, bound: float, *, soft: bool = False, **matrices: Array) -> Problem:
    """The paper's problem with a further row that is at most a bound."""
    penalty = Penalty(l1=np.ones(1), l2=np.ones(1)) if soft else None
    row = Constraint(name=name, lower=np.full(1, -math.inf), upper=np.full(1, bound), penalty=penalty, **matrices)
    return replace(paper_problem(), constraints=(row,))


def test_bounds_of_the_papers_problem_are_its_own() -> None:
    problem = paper_problem()
    assert problem.bounds is not None
    of_rows = ActuatorBounds.of_problem(problem)
    for name in ("u_min", "u_max", "delta_min", "delta_max"):
        np.testing.assert_array_equal(getattr(of_rows, name), getattr(problem.bounds, name))


def test_further_rows_on_single_inputs_and_steps_tighten_them() -> None:
    second = np.eye(4)[1:2]
    np.testing.assert_array_equal(
        ActuatorBounds.of_problem(with_row("worn", 200.0, D=second)).u_max, [250.0, 200.0, 250.0, 250.0]
    )
    np.testing.assert_array_equal(
        ActuatorBounds.of_problem(with_row("slow", 2.0, E=second)).delta_max, [5.0, 2.0, 5.0, 5.0]
    )
    wider = ActuatorBounds.of_problem(with_row("wide", 300.0, D=second))
    np.testing.assert_array_equal(wider.u_max, np.full(4, 250.0))


@pytest.mark.parametrize(
    "row",
    [
        {"D": np.ones((1, 4))},
        {"E": np.ones((1, 4))},
        {"D": np.eye(4)[:1], "E": np.eye(4)[:1]},
        {"D": np.eye(4)[:1], "C": np.ones((1, 12))},
        {"D": -np.eye(4)[:1]},
        {"D": np.eye(4)[:1], "soft": True},
    ],
)
def test_rows_that_bound_no_single_input_in_every_period_are_none_of_them(row: dict[str, Array]) -> None:
    bounds = ActuatorBounds.of_problem(with_row("other", 100.0, **row))  # type: ignore[arg-type]
    np.testing.assert_array_equal(bounds.u_max, np.full(4, 250.0))
    np.testing.assert_array_equal(bounds.u_min, np.zeros(4))
    np.testing.assert_array_equal(bounds.delta_max, np.full(4, 5.0))


def test_inputs_without_bounds_are_refused() -> None:
    problem = paper_problem()
    assert problem.bounds is not None
    endless = replace(problem.bounds, u_max=np.full(4, math.inf))
    with pytest.raises(ParameterError, match=r"controller\.u_min"):
        ActuatorBounds.of_problem(replace(problem, bounds=endless))


BOUNDS = ActuatorBounds.alike((0.0, 250.0), (-10.0, 5.0))
PLAN = np.tile(HOVER, (5, 1))


def test_reach_keeps_speeds_and_steps() -> None:
    lower, upper = BOUNDS.reach(np.array([0.0, 5.0, 192.8, 248.0]))
    np.testing.assert_allclose(lower, [0.0, 0.0, 182.8, 238.0])
    np.testing.assert_allclose(upper, [5.0, 10.0, 197.8, 250.0])


@pytest.mark.parametrize(("before", "only"), [(-100.0, 0.0), (400.0, 250.0)])
def test_speeds_come_before_steps(before: float, only: float) -> None:
    for end in BOUNDS.reach(np.full(4, before)):
        np.testing.assert_array_equal(end, np.full(4, only))


def test_a_plan_in_reach_stays_and_any_other_is_brought_into_it() -> None:
    before = HOVER
    steady = before + np.linspace(0.0, 40.0, 9)[:, None]
    np.testing.assert_array_equal(BOUNDS.clip_plan(steady, before), steady)
    wild = np.random.default_rng(0).uniform(-500.0, 500.0, (30, 4))
    clipped = BOUNDS.clip_plan(wild, before)
    steps = np.diff(clipped, axis=0, prepend=before[None])
    assert clipped.min() >= 0.0
    assert clipped.max() <= 250.0
    assert steps.min() >= -10.0 - 1e-12
    assert steps.max() <= 5.0 + 1e-12


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"u_max": [1.0]}, r"controller\.u_max must be 4 numbers; got \[1\.0\]"),
        ({"delta_min": [math.nan] * 4}, r"controller\.delta_min must be 4 numbers"),
        ({"u_max": [math.inf] * 4}, r"controller\.u_min must be finite and below a finite u_max"),
        ({"u_min": [250.0] * 4}, r"controller\.u_min must be finite and below"),
        ({"delta_max": [-1.0] * 4}, r"controller\.delta_min must be <= 0 and delta_max = .* so that a speed can be"),
    ],
)
def test_impossible_bounds_are_refused(change: dict[str, list[float]], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        replace(BOUNDS, **change)  # type: ignore[arg-type]


def off(first: float, row: int = 0) -> Array:
    plan = PLAN.copy()
    plan[row, 2] += first
    return plan


@pytest.mark.parametrize(
    ("status", "plan", "reason"),
    [
        (SOLVED, PLAN, None),
        (UNCONSTRAINED, PLAN, None),
        ("max_iterations", PLAN, "max_iterations"),
        ("primal_infeasible", PLAN * np.nan, "primal_infeasible"),  # its solver's status comes first
        ("", PLAN, ""),
        (SOLVED, off(math.nan), "not_finite"),
        (SOLVED, off(math.inf, row=4), "not_finite"),
        (SOLVED, off(5.0), None),
        (SOLVED, off(5.0 + 0.5 * BOUND_TOLERANCE), None),
        (SOLVED, off(5.0 + 2.0 * BOUND_TOLERANCE), "out_of_bounds"),
        (SOLVED, off(-10.0), None),
        (SOLVED, off(-10.0 - 2.0 * BOUND_TOLERANCE), "out_of_bounds"),
        (SOLVED, off(40.0, row=1), None),  # only the first action reaches the plant
    ],
)
def test_rejection_gives_the_reason(status: str, plan: Array, reason: str | None) -> None:
    assert rejection(status, plan[0], plan, BOUNDS, HOVER) == reason


def test_rejection_is_by_speed_where_steps_are_free() -> None:
    free = ActuatorBounds.alike((0.0, 250.0))
    for change, reason in ((60.0, None), (60.1, "out_of_bounds"), (-190.1, "out_of_bounds")):
        plan = off(change)
        assert rejection(SOLVED, plan[0], plan, free, HOVER) == reason


def test_a_command_need_not_be_the_plans_first_input() -> None:
    """Both have to be finite, and the command is the one that has to be in reach."""
    assert rejection(SOLVED, HOVER, off(40.0), BOUNDS, HOVER) is None
    assert rejection(SOLVED, HOVER + 5.1, PLAN, BOUNDS, HOVER) == "out_of_bounds"
    assert rejection(SOLVED, HOVER * np.nan, PLAN, BOUNDS, HOVER) == "not_finite"
    assert rejection(SOLVED, HOVER, off(math.nan), BOUNDS, HOVER) == "not_finite"


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 260.0, allow_nan=False))
def test_whatever_is_clipped_is_not_rejected(seed: int, level: float) -> None:
    rng = np.random.default_rng(seed)
    before = level + rng.normal(size=4)
    plan = BOUNDS.clip_plan(level + 30.0 * rng.normal(size=(6, 4)), before)
    assert rejection(SOLVED, plan[0], plan, BOUNDS, before) is None


@pytest.mark.parametrize("steps", [0, 1, 3, 4])
def test_a_shifted_plan_goes_on_and_holds_its_last_input(steps: int) -> None:
    plan = np.arange(20.0).reshape(5, 4)
    left = shifted(plan, steps)
    assert left.shape == plan.shape
    for i in range(5):
        np.testing.assert_array_equal(left[i], plan[min(i + steps, 4)])
    left[:] = -1.0
    assert plan.min() == 0.0  # a copy
