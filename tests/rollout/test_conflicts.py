"""The elastic problem on random ones: zero where, and only where, there is an answer; and what it names is needed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import ocp_peer
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from support import changing_period, random_problem, with_terms

from quadsim.mpc.problem.constraints import Constraint, Penalty
from quadsim.mpc.problem.model import LinearModel
from quadsim.mpc.problem.ocp import InfeasiblePeriod, Objective, Problem, Query
from quadsim.rollout.conflicts import Conflict, Side, find_conflict, has_answer, recovery, smallest_widening

TERMS = ((), ("constraints",), ("margins", "constraints"), ("soft",), ("soft", "margins", "constraints", "P", "Q_d"))
NEAR = 1e-4
"""Violation, as a share, that is too little for an independent solver to be sure of."""


def fewer(share: float) -> settings:
    """Settings for a property whose examples take long: a share of as many as the profile draws."""
    return settings(max_examples=round(share * settings.default.max_examples))


def posed(seed: int, terms: tuple[str, ...], *, changing: bool, far: float) -> InfeasiblePeriod:
    """A random problem from a state that is so far from the origin."""
    rng = np.random.default_rng(seed)
    problem = with_terms(rng, random_problem(rng, horizon=6, n=4, nu=2, n_c=2), terms)
    state = far * rng.normal(size=4)
    desired = rng.normal(size=(6, 4))
    before = problem.model.u_bar + rng.uniform(-3.0, 3.0, 2)
    now = changing_period(rng, problem)
    query = Query(state, desired, before, now.equilibrium, (now.A, now.B, now.c) if changing else None)
    return InfeasiblePeriod(problem=problem, query=query, status="unsolved", time=0.0)


def period(infeasible_period: InfeasiblePeriod) -> ocp_peer.Period:
    problem = infeasible_period.problem
    query = infeasible_period.query
    now = ocp_peer.period(problem, query.state, query.desired, query.u_before, query.equilibrium)
    return now if query.steps is None else replace(now, **dict(zip("ABc", query.steps, strict=True)))


def conflict_of(infeasible_period: InfeasiblePeriod) -> Conflict:
    conflict = find_conflict(infeasible_period)
    assert conflict is not None
    return conflict


RANDOM = {
    "seed": st.integers(0, 2**32 - 1),
    "terms": st.sampled_from(TERMS),
    "changing": st.booleans(),
    "far": st.sampled_from([0.1, 1.0, 5.0]),
}


@given(**RANDOM)
def test_violation_is_zero_if_and_only_if_the_qp_is_feasible(
    seed: int, terms: tuple[str, ...], changing: bool, far: float
) -> None:
    infeasible_period = posed(seed, terms, changing=changing, far=far)
    least = ocp_peer.least_violation(infeasible_period.problem, period(infeasible_period))
    assume(least is None or least == pytest.approx(0.0, abs=1e-9) or least > NEAR)
    conflict = conflict_of(infeasible_period)
    feasible = least is not None and least < NEAR
    assert conflict.feasible == feasible
    assert (conflict.total == pytest.approx(0.0, abs=1e-6)) == feasible
    if least is not None:
        assert conflict.total == pytest.approx(least, rel=1e-5, abs=1e-6)
        assert not {side for side in conflict.violated if side.place in (1, 2)}


@given(**RANDOM)
@example(seed=164, terms=TERMS[-1], changing=False, far=0.1)  # multipliers down to 1e-8 along a chain of bounds,
@example(seed=179393, terms=TERMS[-1], changing=False, far=0.1)  # and to less than the solver resolves
@example(seed=60885742, terms=("constraints",), changing=True, far=0.1)  # the simplex method fails
@fewer(0.3)
def test_what_is_named_is_a_conflict_by_itself_and_each_part_of_it_is_needed(
    seed: int, terms: tuple[str, ...], changing: bool, far: float
) -> None:
    """Of bounds on states: without all others they stay as large, and shrink without any one that is blocking."""
    infeasible_period = posed(seed, terms, changing=changing, far=far)
    problem = infeasible_period.problem
    now = period(infeasible_period)
    assume(ocp_peer.least_violation(problem, now) is not None)
    conflict = conflict_of(infeasible_period)
    assume(conflict.total > NEAR)
    named = {*conflict.violated, *conflict.blocking}
    assert ocp_peer.least_violation(problem, now, named) == pytest.approx(conflict.total, rel=1e-5)
    for side in conflict.blocking:
        less = ocp_peer.least_violation(problem, now, named - {side})
        assert less is not None
        assert less < conflict.total * (1.0 - 1e-7)
    shares = [result.share for result in conflict.violated.values()]
    assert max(shares) <= conflict.total * (1.0 + 1e-6)
    assert all(result.first <= result.last <= problem.horizon for result in conflict.violated.values())


@given(**RANDOM)
@fewer(0.3)
def test_the_smallest_widening_is_enough_and_no_less_is(
    seed: int, terms: tuple[str, ...], changing: bool, far: float
) -> None:
    """Each violated bound by itself, and all of them together."""
    infeasible_period = posed(seed, terms, changing=changing, far=far)
    problem = infeasible_period.problem
    query = infeasible_period.query
    conflict = conflict_of(infeasible_period)
    assume(conflict.total > NEAR)
    for sides in ({side} for side in conflict.violated):
        amount = smallest_widening(infeasible_period, sides)
        if amount is None or amount < NEAR:
            continue
        assert has_answer(widened(problem, sides, 1.01 * amount + 1e-4), query)
        assert not has_answer(widened(problem, sides, 0.99 * amount - 1e-4), query)


def widened(problem: Problem, sides: set[Side], amount: float) -> Problem:
    parts = []
    for place, part in enumerate(problem.every_constraint):
        lower = part.lower.copy()
        upper = part.upper.copy()
        for side in sides:
            if side.place == place and side.upper:
                upper[..., side.row] += amount
            elif side.place == place:
                lower[..., side.row] -= amount
        parts.append(replace(part, lower=lower, upper=upper))
    return replace(problem, bounds=None, constraints=tuple(parts))


def integrator(*constraints: Constraint) -> InfeasiblePeriod:
    """x(k+1) = x(k) + u(k) over four steps from 3, with |u| <= 1."""
    model = LinearModel(A=np.eye(1), B=np.eye(1), u_bar=np.zeros(1), period=1.0)
    inputs = Constraint(name="inputs", lower=-np.ones(1), upper=np.ones(1), D=np.eye(1))
    problem = Problem(
        model=model,
        horizon=4,
        objective=Objective(C_r=np.eye(1), Q_y=np.eye(1), Q_u=np.eye(1)),
        constraints=(inputs, *constraints),
    )
    query = Query(np.array([3.0]), np.zeros((4, 1)), np.zeros(1))
    return InfeasiblePeriod(problem=problem, query=query, status="unsolved", time=0.0)


BAND = Constraint(name="band", lower=-np.ones(1), upper=np.ones(1), C=np.eye(1))


def test_an_integrator_by_hand() -> None:
    """By one a step, 2, 1, .. violates the bound of 1 once, by 1; the lower bound on inputs is blocking."""
    infeasible_period = integrator(BAND)
    conflict = conflict_of(infeasible_period)
    assert conflict.blocking == (Side(0, 0, False),)
    ((side, result),) = conflict.violated.items()
    assert side == Side(1, 0, True)
    assert (result.amount, result.share, result.first, result.last) == (pytest.approx(1.0), pytest.approx(1.0), 1, 1)
    assert smallest_widening(infeasible_period, {side}) == pytest.approx(1.0)
    assert smallest_widening(infeasible_period, {Side(0, 0, False)}) == pytest.approx(1.0)
    assert smallest_widening(infeasible_period, {Side(0, 0, True)}) is None
    assert recovery(infeasible_period, -np.ones((4, 1))) == 1
    assert recovery(infeasible_period, np.ones((4, 1))) is None


def test_bounds_on_inputs_come_first_and_states_give_way_to_what_is_left() -> None:
    """Inputs >= 3 against <= 1: the one with the wider scale is relaxed; then states follow from inputs of 1 to 3."""
    pushed = Constraint(name="pushed", lower=np.array([3.0]), upper=np.array([np.inf]), D=np.eye(1))
    conflict = conflict_of(integrator(BAND, pushed))
    assert conflict.violated[Side(2, 0, False)].amount == pytest.approx(2.0)
    assert conflict.violated[Side(2, 0, False)].first == 0
    assert conflict.violated[Side(2, 0, False)].last == 3
    # Inputs of 1 at least, once 3 is relaxed to that: 4, 5, 6, 7 from 3.
    assert conflict.violated[Side(1, 0, True)].amount == pytest.approx(6.0, abs=1e-4)


def test_soft_constraints_are_never_in_conflict() -> None:
    soft = replace(BAND, penalty=Penalty(l1=np.ones(1), l2=np.ones(1)))
    conflict = conflict_of(integrator(soft))
    assert conflict.feasible
    assert (conflict.total, conflict.blocking) == (pytest.approx(0.0), ())


def test_stored_periods_are_copies() -> None:
    state = np.zeros(1)
    before = np.zeros(1)
    problem = integrator().problem
    stored = InfeasiblePeriod(
        problem=problem, query=Query(state, np.zeros((4, 1)), before), status="unsolved", time=0.0
    )
    state[:] = 1.0
    before[:] = 1.0
    assert (stored.query.state, stored.query.u_before) == (0.0, 0.0)
