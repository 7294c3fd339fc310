"""A kind of constraint that only this test has, C x + D u + E (u - u_before), through every route to an optimum.

Feasibility is checked by rolling the model out, the optimum by a peer: see `ocp_peer`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import ocp_peer
import pytest
from ocp_peer import Optimum, Period
from support import paper_problem, random_problem, random_rows, robust_mpc, robust_table

from quadsim.controller import CORE, SOLVED, UNCONSTRAINED, StepInputs
from quadsim.mpc.laws.robust import Robust
from quadsim.mpc.problem.constraints import Constraint, Penalty, Soft, tightened
from quadsim.mpc.problem.model import LinearModel, continuous_model, discretise
from quadsim.mpc.problem.ocp import Equilibrium, Objective, Problem, Query, lqr_terminal_weight
from quadsim.mpc.solvers import SOLVERS, Method, QPSolver, find_solver, solver_entries
from quadsim.mpc.solvers.by_name import make_solver
from quadsim.state import Array, make_state
from quadsim.vehicle import Vehicle

OTHERS = ("clarabel", "osqp", "proxqp", "quadprog")
INSTALLED = [name for name in (*SOLVERS, *OTHERS) if name in solver_entries() and find_solver(name).installed]
MAY_FAIL = {"osqp", "proxqp"}
"""Which say so; all others have to solve."""
N = 15
PERIOD = 0.05


def largest(constraint: Constraint, given: Period, plan: Array) -> float:
    return float(ocp_peer.violation(constraint, given, plan).max())


def coupled(problem: Problem, given: Period, *, soft: bool, share: float = 0.5, l1: float = 0.3) -> Constraint:
    """Three rows over states, rotors and their steps, which the optimum without them violates; hover keeps them.

    The first is bounded above, the second below, the third on both sides, each at a share of the way from hover to
    the farthest that the optimum goes.
    """
    rng = np.random.default_rng(11)
    m = 3
    n = 12
    nu = 4
    C = rng.normal(size=(m, n))
    D = 0.1 * rng.normal(size=(m, nu))
    E = 0.1 * rng.normal(size=(m, nu))
    if problem.model.n > n:
        C = np.hstack([C, np.zeros((m, problem.model.n - n))])
    endless = np.full(m, math.inf)
    row = Constraint(name="coupled", C=C, D=D, E=E, lower=-endless, upper=endless)
    goes = ocp_peer.values(row, given, ocp_peer.optimum(problem, given).plan) - D @ problem.model.u_bar
    upwards = np.where(goes.max(axis=0) > -goes.min(axis=0), 1.0, -1.0) * [1.0, -1.0, 1.0]
    C, D, E = (upwards[:, None] * part for part in (C, D, E))
    level = D @ problem.model.u_bar
    half = share * np.abs(goes).max(axis=0)
    assert np.all(half > 1e-2)
    lower = level - half
    upper = level + half
    lower[0] = -math.inf
    upper[1] = math.inf
    penalty = Penalty(l1=np.full(m, l1), l2=np.full(m, 0.5)) if soft else None
    return replace(row, C=C, D=D, E=E, lower=lower, upper=upper, penalty=penalty)


@cache
def paper(*, soft: bool) -> tuple[Problem, Period, Constraint, Optimum]:
    """The paper's problem from hover, 3 m to go, with the coupled rows and their peer's optimum."""
    problem = paper_problem("paper-constrained", f"controller.horizon={N}")
    desired = problem.desired(np.tile([3.0, -2.0, 2.0, 0.3], (N, 1)))
    given = ocp_peer.period(problem, np.zeros(12), desired, problem.model.u_bar)
    row = coupled(problem, given, soft=soft)
    problem = replace(problem, constraints=(row,))
    return problem, given, row, ocp_peer.optimum(problem, given)


@cache
def drawn(seed: int, *, soft: bool) -> tuple[Problem, Period, Constraint, Optimum]:
    rng = np.random.default_rng(seed)
    problem = random_problem(rng, horizon=6, n=3, nu=2, n_c=2)
    row = random_rows(rng, problem, soft=soft)
    problem = replace(problem, constraints=(row,))
    given = ocp_peer.period(problem, 0.2 * rng.normal(size=3), rng.normal(size=(6, 3)), problem.model.u_bar)
    return problem, given, row, ocp_peer.optimum(problem, given)


CASES = ["paper", *range(8)]


def case(which: str | int, *, soft: bool) -> tuple[Problem, Period, Constraint, Optimum]:
    return paper(soft=soft) if isinstance(which, str) else drawn(which, soft=soft)


@pytest.mark.parametrize("soft", [False, True])
def test_the_peers_optimum_is_held_by_these_rows(soft: bool) -> None:
    """What the tests below rest on: it is the optimum, it violates soft rows, and without them it is another."""
    solved = violated = different = 0
    for which in CASES:
        problem, given, row, peer = case(which, soft=soft)
        if peer.solution.status != SOLVED:
            continue
        solved += 1
        assert peer.residual < 1e-6
        beyond = largest(row, given, peer.plan)
        violated += beyond > 1e-3
        assert soft or beyond < 1e-8
        if soft:
            np.testing.assert_allclose(peer.slacks, ocp_peer.violation(row, given, peer.plan), atol=1e-8)
        without = ocp_peer.optimum(replace(problem, constraints=()), given).plan
        different += np.abs(without - peer.plan).max() > 1e-2
    assert solved >= 6
    assert different >= 4
    assert (violated >= 2) == soft
    assert case("paper", soft=soft)[3].solution.status == SOLVED


@pytest.mark.parametrize("name", INSTALLED)
@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("which", CASES)
def test_every_solver_holds_it(which: str | int, soft: bool, name: str) -> None:
    problem, given, row, peer = case(which, soft=soft)
    answer = QPSolver(name, problem).solve(Query(given.state, given.desired, given.u_before))
    if name in MAY_FAIL and answer.status != SOLVED:
        return
    assert (answer.status == SOLVED) == (peer.solution.status == SOLVED)
    if peer.solution.status != SOLVED:
        return
    np.testing.assert_allclose(answer.plan[0], peer.plan[0], rtol=0.0, atol=2e-3)
    np.testing.assert_allclose(answer.plan, peer.plan, rtol=0.0, atol=2e-2)
    assert ocp_peer.cost(problem, given, answer.plan) < ocp_peer.cost(problem, given, peer.plan) * (1.0 + 1e-4) + 1e-4
    beyond = ocp_peer.violation(row, given, answer.plan)
    np.testing.assert_allclose(beyond, answer.slacks if soft else 0.0, atol=1e-5)


@pytest.mark.parametrize("soft", [False, True])
def test_the_core_holds_it(soft: bool) -> None:
    """All rows together, from a cold start and from a warm one."""
    problem, given, row, peer = paper(soft=soft)
    solver = make_solver(CORE, problem)
    for _ in range(2):
        answer = solver.solve(Query(given.state, given.desired, given.u_before))
        assert (answer.status, answer.answered_by) == (SOLVED, CORE)
        np.testing.assert_allclose(answer.plan, peer.plan, rtol=0.0, atol=1e-6)
        beyond = ocp_peer.violation(row, given, answer.plan)
        np.testing.assert_allclose(beyond, answer.slacks if soft else 0.0, atol=1e-7)


@pytest.mark.parametrize("row", range(3))
@pytest.mark.parametrize("side", ["lower", "upper"])
@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("name", ["piqp-multistage", CORE])
def test_the_free_optimum_is_taken_where_and_only_where_it_keeps_it(row: int, side: str, soft: bool, name: str) -> None:
    """A bound just beyond the free optimum's extreme value is inactive; just before it, active."""
    problem, given, wide, _ = paper(soft=soft)
    query = 0.01 * given.state, 0.01 * given.desired, given.u_before
    near = ocp_peer.period(problem, *query[:4])
    wide = replace(wide, lower=np.full(3, -1e6), upper=np.full(3, 1e6))

    def answered(constraint: Constraint) -> Any:
        one = replace(problem, constraints=(constraint,))
        return make_solver(name, one).solve(Query(*query))

    free = answered(wide)
    assert (free.method, free.status) == (Method.FREE, UNCONSTRAINED)
    reached = ocp_peer.values(wide, near, free.plan)[:, row]
    extreme, outwards = (reached.min(), -1.0) if side == "lower" else (reached.max(), 1.0)
    for distance, method in ((1e-7, Method.FREE), (-1e-4, Method.WHOLE)):
        bound = getattr(wide, side).copy()
        bound[row] = extreme + outwards * distance
        answer = answered(replace(wide, **{side: bound}))
        assert answer.method is method
        if not soft:
            assert largest(replace(wide, **{side: bound}), near, answer.plan) < (1e-8 if name == CORE else 1e-6)


@pytest.mark.parametrize("soft", [False, True])
def test_rows_of_states_alone_are_held_axis_by_axis(soft: bool) -> None:
    """Of speed and tilt forwards, of climb, and of a yaw rate: each on its own axis, none of them the paper's kind.

    Rotors that are quick enough for no step of theirs to be at a bound.
    """
    problem = paper_problem("paper-constrained", "controller.output_bounds={}")
    assert problem.bounds is not None
    quick = replace(problem.bounds, delta_min=np.full(4, -100.0), delta_max=np.full(4, 100.0))
    problem = replace(problem, bounds=quick)
    C = np.zeros((3, 12))
    C[0, [1, 8]] = [1.0, 2.0]
    C[1, [4, 5]] = [0.2, 1.0]
    C[2, 11] = 1.0
    penalty = Penalty(l1=np.full(3, 0.2), l2=np.full(3, 1.0)) if soft else None
    row = Constraint(
        name="speeds", C=C, lower=np.array([-0.2, -math.inf, -0.02]), upper=np.array([0.25, 0.1, 0.02]), penalty=penalty
    )
    problem = replace(problem, constraints=(row,))
    desired = np.outer(np.linspace(0.0, 1.0, 50) ** 4, [3.0, 0.0, 1.0, 0.4])
    given = ocp_peer.period(problem, np.zeros(12), desired, problem.model.u_bar)
    peer = ocp_peer.optimum(problem, given)
    without = ocp_peer.optimum(replace(problem, constraints=()), given)
    assert (ocp_peer.violation(row, given, without.plan).max(axis=0) > 1e-2).all()
    answer = make_solver(CORE, problem).solve(given.query._replace(steps=None))
    assert answer.method is Method.AXES
    np.testing.assert_allclose(answer.plan, peer.plan, rtol=0.0, atol=1e-5)
    beyond = ocp_peer.violation(row, given, answer.plan)
    assert (beyond.max() > 1e-3) == soft
    np.testing.assert_allclose(beyond, answer.slacks if soft else 0.0, atol=1e-7)


# The robust controller


def margins(row: Constraint, level: Array) -> Array:
    """Growing along the horizon to half of the distance between hover and the nearer bound."""
    half = np.minimum(level - row.lower, row.upper - level)
    return np.asarray(np.linspace(0.0, 0.5, N)[:, None] * half)


def modelled(vehicle: Vehicle, table: Robust, drawn_in: Array | None, constraints: tuple[Constraint, ...]) -> Problem:
    """What the controller is to solve at hover, built once more."""
    problem = paper_problem("paper-constrained", f"controller.horizon={N}")
    assert problem.bounds is not None
    A, B = discretise(*continuous_model(vehicle, table.rotor_lag), PERIOD)
    more = ((0, 0), (0, len(A) - 12))
    model = LinearModel(A=A, B=B, u_bar=problem.model.u_bar, period=PERIOD)
    objective = Objective(
        C_r=np.pad(problem.objective.C_r, more),
        Q_y=problem.objective.Q_y,
        Q_u=problem.objective.Q_u,
        Q_d=None if table.move_weight is None else table.move_weight * np.eye(4),
    )
    if table.terminal:
        objective = replace(objective, P=lqr_terminal_weight(model, objective))
    penalty = None if table.soft is None else table.soft.penalty(2)
    bounds = replace(problem.bounds, C_c=np.pad(problem.bounds.C_c, more), penalty=penalty, margins=drawn_in)
    widened = tuple(
        part if part.C is None else replace(part, C=np.pad(part.C, ((0, 0), (0, len(A) - part.C.shape[1]))))
        for part in constraints
    )
    return Problem(model=model, horizon=N, objective=objective, bounds=bounds, constraints=widened)


SETTINGS: dict[str, tuple[dict[str, Any], Array | None]] = {
    "plain": ({}, None),
    "everything": (
        {"soft": Soft(linear=2e5, quadratic=1e4), "rotor_lag": 0.03, "move_weight": 0.5},
        np.linspace(0.0, 0.02, N)[:, None] * np.ones(2),
    ),
    "terminal": ({"terminal": "lqr"}, None),
}
"""Fields of the table, and the tightening of its output bounds."""


@pytest.mark.parametrize("parts", SETTINGS)
@pytest.mark.parametrize("kind", ["hard", "soft", "tightened"])
def test_the_robust_controller_holds_it(vehicle: Vehicle, parts: str, kind: str) -> None:
    """From hover with a little tilt and speed."""
    fields, drawn_in = SETTINGS[parts]
    table = robust_table(horizon=N, **fields)
    base = modelled(vehicle, table, drawn_in, ())
    hover = np.full(4, vehicle.hover_speed)
    reference = np.tile([3.0, -2.0, 2.0, 0.3], (N, 1))
    state = make_state(euler=(0.01, -0.02, 0.0))
    state[1] = 0.05
    x0 = np.concatenate([state, hover])[: base.model.n]
    rest = Equilibrium(np.zeros(base.model.n), hover)
    rest.x[12:] = hover[: base.model.n - 12]
    given = ocp_peer.period(base, x0, base.desired(reference), hover, rest)
    row = coupled(base, given, soft=kind == "soft", share=0.7)
    row = replace(row, C=None if row.C is None else row.C[:, :12])
    if kind == "tightened":
        assert row.D is not None
        row = tightened(row, margins(row, row.D @ hover))
    problem = modelled(vehicle, table, drawn_in, (row,))
    peer = ocp_peer.optimum(problem, given)
    assert peer.solution.status == SOLVED
    posed = table.problem(vehicle, PERIOD)
    assert posed.bounds is not None
    posed = replace(posed, bounds=replace(posed.bounds, margins=drawn_in), constraints=problem.constraints)
    controller = robust_mpc(vehicle, table, posed, CORE)
    controller.reset(hover)
    command = controller.step(StepInputs(acting=hover), state, reference)
    assert command.status == SOLVED
    np.testing.assert_allclose(command.plan, peer.plan, rtol=0.0, atol=1e-5)
    held = problem.constraints[0]
    beyond = ocp_peer.violation(held, given, command.plan)
    assert command.stats.slack == pytest.approx(peer.slacks.max(initial=0.0), abs=1e-6)
    assert (beyond.max() > 1e-3) == (kind == "soft")
    if kind != "soft":
        assert beyond.max() < 1e-6
        without = ocp_peer.optimum(replace(problem, constraints=()), given)
        assert largest(held, given, without.plan) > 1e-2
