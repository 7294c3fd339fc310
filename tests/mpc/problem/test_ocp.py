"""What a problem may be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support import paper_problem, random_problem

from quadsim.errors import ParameterError
from quadsim.mpc.problem.constraints import Constraint, Origin, Penalty, row_scale, tightened
from quadsim.mpc.problem.ocp import Objective, Problem, reference_rates
from quadsim.state import REFERENCE_RATES, REFERENCE_STATES, Array


@pytest.mark.parametrize(
    "matrix",
    [np.diag([1.0, 0.0]), np.diag([1.0, -1.0]), np.array([[1.0, 2.0], [2.0, 1.0]]), np.array([[1.0, 0.5], [0.0, 1.0]]),
     np.diag([1.0, np.nan])],
)  # fmt: skip
@pytest.mark.parametrize("weight", ["Q_y", "Q_u"])
def test_weights_must_be_positive_definite(matrix: np.ndarray, weight: str) -> None:
    weights = {"Q_y": np.eye(2), "Q_u": np.eye(2), weight: matrix}
    with pytest.raises(ParameterError, match=rf"controller\.{weight}"):
        Objective(C_r=np.eye(2), **weights)


def test_regulated_outputs_are_n_r_by_n() -> None:
    """Erratum after Eq. (4), which prints n_r by n_r."""
    assert paper_problem().objective.C_r.shape == (4, 12)
    with pytest.raises(ParameterError, match=r"controller\.C_r"):
        Objective(C_r=np.eye(3), Q_y=np.eye(4), Q_u=np.eye(4))
    with pytest.raises(ParameterError, match=r"controller\.C_r"):
        replace(paper_problem(), objective=Objective(C_r=np.eye(4), Q_y=np.eye(4), Q_u=np.eye(4)))


def test_desired_outputs_are_the_reference_and_zero_elsewhere() -> None:
    reference = np.array([[1.0, 2.0, 3.0, 0.5]])
    np.testing.assert_array_equal(paper_problem().objective.desired(reference), reference)
    full = paper_problem("paper-unconstrained").objective.desired(reference)
    np.testing.assert_array_equal(full, [[1, 0, 2, 0, 3, 0, 0, 0, 0, 0, 0.5, 0]])


def test_desired_velocities_and_yaw_rate_are_the_differences_of_the_reference() -> None:
    """Against NumPy's differences, which are exact for a parabola at the ends too."""
    full = replace(paper_problem("paper-unconstrained"), horizon=30)
    problem = replace(full, objective=replace(full.objective, follows_rates=True))
    period = problem.model.period
    t = period * np.arange(1, 31)[:, None]
    reference = np.array([1.0, 2.0, 3.0, 4.0]) + t * [0.5, -1.0, 2.0, 0.3] + t**2 * [1.0, 0.2, -0.4, 0.6]
    desired = problem.desired(reference)
    np.testing.assert_array_equal(desired[:, REFERENCE_STATES], reference)
    np.testing.assert_allclose(desired[:, REFERENCE_RATES], [0.5, -1.0, 2.0, 0.3] + 2 * t * [1.0, 0.2, -0.4, 0.6])
    np.testing.assert_array_equal(desired[:, [6, 7, 8, 9]], 0.0)
    wild = np.random.default_rng(1).normal(size=(30, 4))
    np.testing.assert_allclose(
        problem.desired(wild)[:, REFERENCE_RATES], np.gradient(wild, period, axis=0, edge_order=2), atol=1e-10
    )
    np.testing.assert_allclose(reference_rates(wild[:2], 0.1), np.tile(10.0 * (wild[1] - wild[0]), (2, 1)))


def test_desired_velocities_are_never_silently_zero() -> None:
    full = paper_problem("paper-unconstrained")
    problem = replace(full, objective=replace(full.objective, follows_rates=True))
    with pytest.raises(ParameterError, match="rates"):
        problem.objective.desired(np.zeros((100, 4)))
    with pytest.raises(ParameterError, match="horizon"):
        reference_rates(np.zeros((1, 4)), 0.05)


@pytest.mark.parametrize(
    "matrix", [-np.eye(4), np.diag([1.0, 1.0, 1.0, np.nan]), np.eye(4) + np.eye(4, k=1), np.ones((4, 3))]
)
@pytest.mark.parametrize("weight", ["Q_d", "P"])
def test_weights_of_moves_and_of_the_last_state_must_be_semidefinite(matrix: Array, weight: str) -> None:
    weights = {"Q_y": np.eye(4), "Q_u": np.eye(4)}
    Objective(C_r=np.eye(4), **weights, **{weight: np.zeros((4, 4))})
    with pytest.raises(ParameterError, match=rf"controller\.{weight}"):
        Objective(C_r=np.eye(4), **weights, **{weight: matrix})


def replaced(problem: Problem, **parts: object) -> Problem:
    assert problem.bounds is not None
    return replace(problem, bounds=replace(problem.bounds, **parts))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p: replace(p, objective=replace(p.objective, Q_u=np.eye(3))), r"Q_u must be of shape \(2, 2\)"),
        (lambda p: replace(p, objective=replace(p.objective, Q_d=np.eye(3))), r"Q_d must be of shape \(2, 2\)"),
        (lambda p: replace(p, objective=replace(p.objective, P=np.eye(2))), r"P must be of shape \(3, 3\)"),
        (lambda p: replaced(p, penalty=Penalty(l1=np.ones(2), l2=np.ones(2))), r"l1 must be of shape \(1,\)"),
        (lambda p: replaced(p, margins=np.zeros((3, 1))), r"outputs\.lower must be of shape \(4, 1\); got \(3, 1\)"),
        (lambda p: replaced(p, margins=np.zeros((4, 2))), r"margins must be finite numbers >= 0 of shape"),
        (lambda p: replaced(p, margins=np.full((4, 1), 100.0)), r"margins must be less than half of the gap"),
        (lambda p: with_row(p, C=np.ones((1, 2))), r"thrust\.C must be of shape \(1, 3\)"),
        (lambda p: with_row(p, D=np.ones((1, 3))), r"thrust\.D must be of shape \(1, 2\)"),
        (lambda p: with_row(p, E=np.ones((1, 3))), r"thrust\.E must be of shape \(1, 2\)"),
        (lambda p: with_row(p), r"thrust must be 1 rows"),
        (lambda p: with_row(p, D=np.ones((2, 2))), r"thrust must be 1 rows; got \[2\]"),
        (lambda p: with_row(p, D=np.array([[np.nan, 0.0]])), r"thrust must be finite numbers"),
        (lambda p: with_row(p, D=np.ones((1, 2)), lower=np.ones(1)), r"thrust\.lower must be below upper"),
        (lambda p: with_row(p, D=np.ones((1, 2)), lower=np.full(1, np.nan)), r"thrust\.lower must be numbers of the"),
    ],
)
def test_parts_that_do_not_fit_are_refused(make: Callable[[Problem], Problem], message: str) -> None:
    with pytest.raises(ParameterError, match=rf"controller\.{message}"):
        make(random_problem(np.random.default_rng(0), horizon=4))


def with_row(problem: Problem, **parts: Any) -> Problem:
    """A further row, between 0 and 1 unless another is given."""
    given = {"lower": np.zeros(1), "upper": np.ones(1), **parts}
    return replace(problem, constraints=(Constraint(name="thrust", **given),))


def test_rows_are_all_that_bound_anything_in_the_constraints_order() -> None:
    """Rows without a bound are left out; others are distinguished by what they are on, and by their penalty."""
    problem = random_problem(np.random.default_rng(0), horizon=3, n_c=2)
    assert problem.bounds is not None
    endless = np.full(2, np.inf)
    penalty = Penalty(l1=np.array([1.0, 2.0]), l2=np.array([3.0, 4.0]))
    bounds = replace(problem.bounds, delta_max=endless, delta_min=np.array([-1.0, -np.inf]), penalty=penalty)
    late = np.array([[np.inf], [np.inf], [2.0]])  # a bound at the last step alone
    extra = Constraint(name="late", lower=-late, upper=late, C=np.ones((1, 3)), D=np.array([[2.0, 0.0]]))
    rows = replace(problem, bounds=bounds, constraints=(extra,)).rows
    assert rows.names == ("outputs", "outputs", "slews", "inputs", "inputs", "late")
    np.testing.assert_array_equal(rows.of_states, [True, True, False, False, False, False])
    np.testing.assert_array_equal(rows.input, [-1, -1, -1, 0, 1, -1])
    np.testing.assert_array_equal(rows.scale[2:], [1.0, 1.0, 1.0, 0.5])
    np.testing.assert_array_equal(rows.l1 * rows.scale, [1.0, 2.0, *[np.inf] * 4])
    np.testing.assert_array_equal(rows.l2 * rows.scale**2, [3.0, 4.0, *[0.0] * 4])
    np.testing.assert_array_equal(rows.soft, [0, 1])
    np.testing.assert_array_equal(rows.upper[:, -1:], 0.5 * late)
    np.testing.assert_array_equal(rows.lower, np.broadcast_to(rows.lower, (3, 6)))
    np.testing.assert_array_equal(rows.C[:2], bounds.C_c * rows.scale[:2, None])
    np.testing.assert_array_equal(rows.C[-1], np.full(3, 0.5))
    np.testing.assert_array_equal(rows.D[3:], [[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]])


@pytest.mark.parametrize(
    ("largest", "scale"),
    [
        (0.0, 1.0),
        (1.0, 1.0),
        (np.nextafter(1.0, 2.0), 1.0),  # a unit normal with rounding
        (3.0**-0.5, 1.0),  # the least that a unit normal's largest component can be
        (0.5, 2.0),
        (2.0, 0.5),
        (57.3, 2.0**-6),
        (1e-8, 2.0**26),
        (1e-320, 2.0**1000),
    ],
)
def test_rows_are_scaled_by_powers_of_two(largest: float, scale: float) -> None:
    assert row_scale(np.array([largest])) == scale


def test_rows_that_share_a_slack_share_a_scale() -> None:
    penalty = Penalty(l1=np.full(2, 8.0), l2=np.full(2, 8.0), largest=True)
    C = np.array([[1.0, 0.0, 0.0], [0.0, 4.0, 0.0]])
    shared = Constraint(name="shared", lower=np.full(2, -1.0), upper=np.ones(2), C=C, penalty=penalty)
    rows = replace(random_problem(np.random.default_rng(0), horizon=3), bounds=None, constraints=(shared,)).rows
    np.testing.assert_array_equal(rows.scale, [0.25, 0.25])
    np.testing.assert_array_equal(rows.l1, [32.0, 32.0])
    np.testing.assert_array_equal(rows.l2, [128.0, 128.0])
    np.testing.assert_array_equal(rows.slack_scale, [0.25])


def test_margins_tighten_both_bounds_of_each_step() -> None:
    problem = random_problem(np.random.default_rng(0), horizon=3, n_c=2)
    assert problem.bounds is not None
    margins = 0.1 * np.random.default_rng(1).uniform(size=(3, 2))
    outputs, *others = replace(problem.bounds, margins=margins).constraints
    np.testing.assert_array_equal(outputs.lower, problem.bounds.y_min + margins)
    np.testing.assert_array_equal(outputs.upper, problem.bounds.y_max - margins)
    assert [part.name for part in others] == ["slews", "inputs"]
    unbounded = Constraint(name="above", lower=np.full(1, -np.inf), upper=np.ones(1), C=np.ones((1, 3)))
    np.testing.assert_array_equal(tightened(unbounded, np.full((3, 1), 0.5)).upper, np.full((3, 1), 0.5))
    assert np.isneginf(tightened(unbounded, np.full((3, 1), 0.5)).lower).all()


def test_a_row_of_outputs_has_the_name_of_a_state_where_it_is_one() -> None:
    bounds = paper_problem().bounds
    assert bounds is not None
    C_c = np.zeros((4, 12))
    C_c[0, 6] = 1.0
    C_c[1, 6] = 2.0
    C_c[2, [6, 8]] = 1.0
    C_c[3, 5] = 1.0
    rows = [replace(bounds, C_c=C_c, y_min=np.full(4, -1.0), y_max=np.ones(4)).output(i) for i in range(4)]
    assert [row.name for row in rows] == ["roll", "row 1 of C_c", "row 2 of C_c", "vz"]
    assert [row.field for row in rows] == ["controller.output_bounds.roll", "", "", "controller.output_bounds.vz"]
    assert rows[0].factor == pytest.approx(180.0 / np.pi)


def test_a_side_of_a_bound_is_an_entry_of_the_file() -> None:
    pair = Origin("roll", field="controller.output_bounds.roll")
    listed = Origin("p", field="controller.p", row=2)
    assert [pair.place(upper=upper)[1] for upper in (False, True)] == [0, 1]
    assert [listed.place(upper=upper) for upper in (False, True)] == [
        ("controller.p.lower", 2),
        ("controller.p.upper", 2),
    ]
    assert Origin("row").place(upper=True)[0] == ""
