"""The active set method: the optimum from any start, for hard and soft rows, and never a wrong answer."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from support import paper_problem, random_axes

from mpc.exact import activeset as module
from mpc.exact.activeset import ActiveSet, Side
from mpc.exact.shortcut import Shortcut
from mpc.ocp import Problem, Query
from mpc.paper.condensed import Condensed
from mpc.qp import QP, Solution, kkt_residuals
from mpc.solvers import Method, QPSolver
from mpc.solvers.piqp_backends import PiqpDense
from quadsim.controller import ACCEPTED, SOLVED
from quadsim.state import Array


class Rows:
    """min 1/2 v' P v + c' v over lower <= G v <= upper, some rows with a penalty l1 e + l2 e^2 on their violation e."""

    def __init__(
        self, P: Array, c: Array, G: Array, lower: Array, upper: Array, l1: Array, l2: Array, channels: int = 1
    ) -> None:
        self.P, self.c, self.G, self.lower, self.upper, self.l1, self.l2 = P, c, G, lower, upper, l1, l2
        root = np.linalg.cholesky(P)
        half = scipy.linalg.solve_triangular(root, G.T, lower=True)
        self.free = -scipy.linalg.cho_solve((root, True), c)
        self.R = scipy.linalg.solve_triangular(root, half, lower=True, trans="T")
        self.set = ActiveSet(half.T @ half, l1, l2, channels)

    def solve(self, *starts: Side, most: int = module.MOST_STEPS) -> Solution | None:
        """Of `whole`; None where the method gives up."""
        found = self.set.solve(self.G @ self.free, self.lower, self.upper, starts, most=most)
        if found is None:
            return None
        v, soft, z = self.free - self.R @ found.z, np.isfinite(self.l1), found.z
        np.testing.assert_allclose(found.values, self.G @ v, atol=1e-7 * max(1.0, np.abs(z).max(initial=0.0)))
        values = (self.G @ v)[soft]
        e = np.maximum(np.maximum(values - self.upper[soft], self.lower[soft] - values), 0.0)
        e[np.abs(found.side[soft]) != 2] = 0.0
        z_e = np.minimum(np.abs(z[soft]) - self.l1[soft] - 2.0 * self.l2[soft] * e, 0.0)
        return Solution(
            x=np.concatenate([v, e]),
            y=np.zeros(0),
            z=np.concatenate([z[~soft], np.maximum(z[soft], 0.0), np.minimum(z[soft], 0.0)]),
            z_box=np.concatenate([np.zeros(v.size), z_e]),
            iterations=found.steps,
            active=int(np.count_nonzero(z)),
        )

    @property
    def whole(self) -> QP:
        """The QP in [v; e]: hard rows, then soft ones from above, then from below."""
        soft = np.isfinite(self.l1)
        n, m = self.c.size, int(soft.sum())
        endless = np.full(m, np.inf)
        none, unit = np.zeros((int((~soft).sum()), m)), np.eye(m)
        return QP(
            P=scipy.linalg.block_diag(self.P, 2.0 * np.diag(self.l2[soft])) if m else self.P,
            c=np.concatenate([self.c, self.l1[soft]]),
            A=np.zeros((0, n + m)),
            b=np.zeros(0),
            G=np.vstack(
                [np.hstack([self.G[~soft], none]), np.hstack([self.G[soft], -unit]), np.hstack([self.G[soft], unit])]
            ),
            h_l=np.concatenate([self.lower[~soft], -endless, self.lower[soft]]),
            h_u=np.concatenate([self.upper[~soft], self.upper[soft], endless]),
            x_l=np.concatenate([np.full(n, -np.inf), np.zeros(m)]),
            x_u=np.full(n + m, np.inf),
        )

    def residual(self, solution: Solution) -> float:
        """Its largest KKT residual over the size of its multipliers."""
        return kkt_residuals(self.whole, solution).worst / max(1.0, np.abs(solution.z).max(initial=0.0))


def random_rows(rng: np.random.Generator, *, n: int, rows: int, soft: float, least: float = 0.0) -> Rows:
    """Bounds around the origin, some of them infinite, and penalties of which either part may be zero."""
    factor = rng.normal(size=(n, n))
    lower, upper = -rng.uniform(0.1, 1.0, rows), rng.uniform(0.1, 1.0, rows)
    lower[rng.random(rows) < 0.2] = -np.inf
    upper[(rng.random(rows) < 0.2) & np.isfinite(lower)] = np.inf
    l1 = rng.uniform(0.1, 5.0, rows) * (rng.random(rows) < 0.7)
    l2 = np.maximum(rng.uniform(0.1, 5.0, rows) * (rng.random(rows) < 0.7), least)
    l1[rng.random(rows) >= soft] = np.inf
    return Rows(
        factor @ factor.T + 0.1 * np.eye(n), 3.0 * rng.normal(size=n), rng.normal(size=(rows, n)), lower, upper, l1, l2
    )


def integrator(rng: np.random.Generator, *, steps: int, soft: float) -> Rows:
    """Positions and speeds of a double integrator held within random bounds, some soft, on the way to a far target."""
    speed = np.tril(np.ones((steps, steps)))
    position = speed @ speed
    target = rng.uniform(-200.0, 200.0)
    P = position.T @ position + rng.uniform(1.0, 100.0) * np.eye(steps)
    width = np.tile([rng.uniform(20.0, 150.0), rng.uniform(1.0, 10.0)], steps)
    l1 = np.where(np.tile(rng.random(2), steps) < soft, rng.uniform(0.0, 200.0), np.inf)
    rows = np.stack([position, speed], axis=1).reshape(2 * steps, steps)
    return Rows(P, -position.T @ np.full(steps, target), rows, -width, width, l1, np.full(2 * steps, 5.0), channels=2)


def random_start(rng: np.random.Generator, problem: Rows, share: float) -> Side:
    """Rows taken for active at random; which side and which piece likewise, where there is such a bound and piece."""
    size = problem.lower.size
    side = np.where(rng.random(size) < share, rng.choice([-1, 1], size), 0)
    side[(side > 0) & np.isinf(problem.upper) | (side < 0) & np.isinf(problem.lower)] = 0
    return (side * np.where(np.isfinite(problem.l1) & (rng.random(size) < 0.5), 2, 1)).astype(np.int8)


def nothing(problem: Rows) -> Side:
    return np.zeros(problem.lower.size, np.int8)


@settings(max_examples=300)
@given(
    seed=st.integers(0, 2**32 - 1),
    rows=st.integers(1, 16),
    soft=st.sampled_from([0.0, 0.5, 1.0]),
    share=st.sampled_from([0.0, 0.2, 0.6, 1.0]),
)
def test_it_ends_at_the_optimum_from_any_start(seed: int, rows: int, soft: float, share: float) -> None:
    """The KKT conditions judge.  More rows than the eight variables may be dependent, and it may then give up."""
    rng = np.random.default_rng(seed)
    problem = random_rows(rng, n=8, rows=rows, soft=soft)
    starts = nothing(problem), random_start(rng, problem, share)
    found = [problem.solve(start) for start in starts]
    assert rows > 8 or None not in found
    right = [solution for solution in found if solution is not None]
    for solution in right:
        assert problem.residual(solution) < 1e-6  # of l2 = 0, for which a small one stands in
        np.testing.assert_allclose(solution.x[:8], right[0].x[:8], atol=1e-6)


@pytest.mark.parametrize("soft", [0.0, 0.5, 1.0])
def test_rows_are_active_and_violated_in_random_problems(soft: float) -> None:
    """What the test above rests on."""
    active = violated = 0
    for seed in range(100):
        problem = random_rows(np.random.default_rng(seed), n=8, rows=8, soft=soft)
        found = problem.solve(nothing(problem))
        assert found is not None
        active += found.active > 0
        violated += found.x[8:].max(initial=0.0) > 1e-3
    assert active > 90
    assert (violated > 50) == (soft > 0.0)


@pytest.mark.parametrize("off", [0.0, 1e-7, 1e-3, 1.0])
def test_approximate_multipliers_give_the_active_set(off: float) -> None:
    """Of an interior-point method's, as they are and corrupted: one step suffices where they are good."""
    for seed in range(50):
        rng = np.random.default_rng(seed)
        problem = random_rows(rng, n=8, rows=8, soft=0.5, least=0.1)
        exact = problem.solve(nothing(problem))
        assert exact is not None
        hard = int(np.isinf(problem.l1).sum())
        m = 8 - hard
        z = np.zeros(8)
        z[np.isinf(problem.l1)] = exact.z[:hard]
        z[np.isfinite(problem.l1)] = exact.z[hard : hard + m] + exact.z[hard + m :]
        near = problem.set.near(z + off * rng.normal(size=8), problem.G @ problem.free, problem.lower, problem.upper)
        found = problem.solve(near)
        assert found is not None
        assert problem.residual(found) < 1e-7
        np.testing.assert_allclose(found.x, exact.x, atol=1e-7)
        if off == 0.0:
            assert found.iterations == 1


@settings(max_examples=100)
@given(seed=st.integers(0, 2**32 - 1), soft=st.sampled_from([0.0, 0.5, 1.0]), share=st.sampled_from([0.0, 0.3]))
def test_it_agrees_with_an_interior_point_method(seed: int, soft: float, share: float) -> None:
    """On bounds along the plan of a double integrator, whose active rows are neighbours: the same optimum as PIQP's."""
    problem = integrator(np.random.default_rng(seed), steps=20, soft=soft)
    found = problem.solve(random_start(np.random.default_rng(seed), problem, share))
    backend, qp = PiqpDense(), problem.whole
    backend.setup(qp)
    whole = backend.solve(qp)
    if found is None:
        return
    assert whole.status == SOLVED
    assert problem.residual(found) < 1e-6
    np.testing.assert_allclose(found.x[:20], whole.x[:20], atol=2e-3)


def test_it_is_found_along_a_plan_and_mostly_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the test above rests on; and where all changes at once fail, one at a time succeeds."""
    one_by_one, count = ActiveSet._one_by_one, [0]

    def counted(self: ActiveSet, *arguments: Any) -> Any:
        count[0] += 1
        return one_by_one(self, *arguments)

    monkeypatch.setattr(ActiveSet, "_one_by_one", counted)
    problems = [integrator(np.random.default_rng(seed), steps=20, soft=0.5) for seed in range(60)]
    at_once = [problem.solve(nothing(problem)) for problem in problems]
    solved = [solution for solution in at_once if solution is not None]
    assert len(solved) > 50
    assert count[0] < 20
    assert sum(solution.active > 3 for solution in solved) > 30
    assert sum(solution.x[20:].max(initial=0.0) > 1e-3 for solution in solved) > 10
    monkeypatch.setattr(ActiveSet, "_all_changed", lambda self, trial, bounds, careful: trial.side.copy())
    count[0] = 0
    for problem, first in zip(problems, at_once, strict=True):
        again = problem.solve(nothing(problem))
        if first is not None and again is not None:
            np.testing.assert_allclose(again.x[:20], first.x[:20], atol=1e-7)
    assert count[0] > 50


def test_the_start_with_the_fewest_wrong_rows_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FEW", 0)
    problem = random_rows(np.random.default_rng(3), n=8, rows=8, soft=0.0)
    cold = problem.solve(nothing(problem))
    assert cold is not None
    right = np.sign(cold.z).astype(np.int8)
    wrong = np.where(np.isfinite(problem.upper), 1, -1).astype(np.int8) * (right == 0).astype(np.int8)
    assert np.count_nonzero(right) > 2
    for starts in ((right, wrong), (wrong, right), (nothing(problem), wrong, right)):
        found = problem.solve(*starts)
        assert found is not None
        assert found.iterations == 1
    before = right.copy()
    problem.solve(right)
    np.testing.assert_array_equal(right, before)  # it is not theirs to change


def twice(upper: Array, *, soft: bool = False) -> Rows:
    """The same row twice, with upper bounds of its own each: min 1/2 |v|^2 - 2 v_1."""
    penalty = np.full(2, 0.5 if soft else np.inf)
    G = np.array([[1.0, 0.0], [1.0, 0.0]])
    return Rows(np.eye(2), np.array([-2.0, 0.0]), G, np.full(2, -5.0), upper, penalty, np.full(2, 1.0))


def test_dependent_rows_are_dropped_or_distinguished() -> None:
    """Both active at one bound, no multipliers are the only ones; with bounds apart the tighter row is the active one.

    Soft ones have multipliers that are theirs alone.
    """
    for problem in (twice(np.ones(2)), twice(np.array([1.0, 0.5])), twice(np.ones(2), soft=True)):
        for start in (nothing(problem), np.ones(2, np.int8)):
            found = problem.solve(start)
            assert found is None or problem.residual(found) < 1e-9
    soft = twice(np.ones(2), soft=True)
    found = soft.solve(np.full(2, 2, np.int8))
    assert found is not None
    assert soft.residual(found) < 1e-9


@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.0, 0.5, 1.0]), soft=st.sampled_from([0.0, 0.5]))
def test_rows_that_depend_on_each_other_lead_to_no_wrong_answer(seed: int, share: float, soft: float) -> None:
    """Every row once more, scaled; twelve of them in a space of three."""
    rng = np.random.default_rng(seed)
    problem = random_rows(rng, n=3, rows=6, soft=soft)
    scale = rng.uniform(0.5, 2.0, 6)
    doubled = Rows(
        problem.P,
        problem.c,
        np.concatenate([problem.G, scale[:, None] * problem.G]),
        np.concatenate([problem.lower, scale * problem.lower]),
        np.concatenate([problem.upper, scale * problem.upper]),
        np.tile(problem.l1, 2),
        np.tile(problem.l2, 2),
    )
    found = doubled.solve(random_start(rng, doubled, share))
    assert found is None or doubled.residual(found) < 1e-6


def test_an_infeasible_problem_is_given_up() -> None:
    """X <= 0, y <= 0 and x + y >= 1."""
    endless = np.full(3, np.inf)
    G = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    problem = Rows(
        np.eye(2), np.zeros(2), G, np.array([-5.0, -5.0, 1.0]), np.array([0.0, 0.0, 5.0]), endless, np.zeros(3)
    )
    assert problem.solve(nothing(problem)) is None
    assert problem.solve(np.array([1, 1, -1], np.int8)) is None


def test_steps_are_counted_and_given_up() -> None:
    """Both rows are violated at first, and with both active one multiplier has the wrong sign: one step is too few."""
    G, endless = np.array([[1.0, 0.0], [0.6, 0.8]]), np.full(2, np.inf)
    problem = Rows(np.eye(2), np.array([-2.0, -0.125]), G, -np.ones(2), np.ones(2), endless, np.zeros(2))
    assert problem.solve(nothing(problem), most=1) is None
    found = problem.solve(nothing(problem))
    assert found is not None
    assert found.iterations > 1
    np.testing.assert_allclose(found.z, [1.0, 0.0])


# Whole QPs of controllers


def by_active_set(qp: QP, near: Solution) -> Solution | None:
    """The optimum of a QP without equalities from an approximate one, box and rows alike."""
    n, rows = qp.c.size, np.vstack([np.eye(qp.c.size), np.asarray(qp.G)])
    lower, upper = np.concatenate([qp.x_l, qp.h_l]), np.concatenate([qp.x_u, qp.h_u])
    (bounded,) = np.nonzero(np.isfinite(lower) | np.isfinite(upper))
    hard, P = np.full(bounded.size, np.inf), np.asarray(qp.P)
    problem = Rows(P, qp.c, rows[bounded], lower[bounded], upper[bounded], hard, np.zeros(bounded.size))
    z = np.concatenate([near.z_box, near.z])[bounded]
    start = problem.set.near(z, problem.G @ problem.free, problem.lower, problem.upper)
    found = problem.set.solve(problem.G @ problem.free, problem.lower, problem.upper, [start])
    if found is None:
        return None
    multipliers = np.zeros(len(rows))
    multipliers[bounded] = found.z
    return near._replace(x=problem.free - problem.R @ found.z, z_box=multipliers[:n], z=multipliers[n:])


def certified(qp: QP, solution: Solution) -> Array | None:
    """The optimum x, in extended precision, of the rows that a solution calls active; None where it proves not to be.

    Feasible, with multipliers of the right signs and the gradient they must have, x is the one optimum of a strictly
    convex QP, for any initial active set.
    """
    n, wide = qp.c.size, np.longdouble
    rows = np.vstack([np.eye(n), np.asarray(qp.G)])
    lower, upper = np.concatenate([qp.x_l, qp.h_l]), np.concatenate([qp.x_u, qp.h_u])
    side = np.sign(np.concatenate([solution.z_box, solution.z]))
    active = np.flatnonzero(side)
    if active.size:
        _, size, order = scipy.linalg.qr(rows[active].T, mode="economic", pivoting=True)
        active = active[order[: np.count_nonzero(np.abs(size.diagonal()) > 1e-9 * abs(size[0, 0]))]]
    M, m = rows[active], active.size
    system = np.block([[np.asarray(qp.P), M.T], [M, np.zeros((m, m))]]).astype(wide)
    unit = 1.0 / np.sqrt(np.concatenate([np.diag(qp.P), np.ones(m)]).astype(wide))
    right_side = np.concatenate([-qp.c, np.where(side > 0, upper, lower)[active]]) * unit
    answer = eliminated(system * unit[:, None] * unit, right_side) * unit
    x, multipliers = answer[:n], answer[n:]
    values = rows.astype(wide) @ x
    feasible = np.maximum(values - upper, lower - values).max() < 1e-12
    right = m == 0 or (multipliers * side[active]).min() > -1e-13 * np.abs(multipliers).max()
    return np.asarray(x, dtype=float) if feasible and right else None


def eliminated(A: Any, b: Any) -> Any:
    """A x = b by Gauss, in the numbers' own precision, which LAPACK does not have."""
    A, b = A.copy(), b.copy()
    for i in range(b.size):
        pivot = i + np.argmax(np.abs(A[i:, i]))
        A[[i, pivot]], b[[i, pivot]] = A[[pivot, i]], b[[pivot, i]]
        factors = A[i + 1 :, i] / A[i, i]
        A[i + 1 :, i:] -= np.outer(factors, A[i, i:])
        b[i + 1 :] -= factors * b[i]
    for i in reversed(range(b.size)):
        b[i] = (b[i] - A[i, i + 1 :] @ b[i + 1 :]) / A[i, i]
    return b


def test_the_certificate_is_of_the_optimum_alone() -> None:
    """x^2 + y^2 with x >= 1: 1, 0; not where another row is called active, or none."""
    far = np.full(2, np.inf)
    qp = QP(P=2.0 * np.eye(2), c=np.zeros(2), A=np.zeros((0, 2)), b=np.zeros(0), G=np.array([[1.0, 0.0], [0.0, 1.0]]),
            h_l=np.array([1.0, -1.0]), h_u=far, x_l=-far, x_u=far)  # fmt: skip
    backend = PiqpDense()
    backend.setup(qp)
    solution = backend.solve(qp)
    for z, exact in (([-2.0, 0.0], True), ([0.0, 0.0], False), ([-2.0, -1.0], False)):
        x = certified(qp, solution._replace(z=np.array(z), z_box=np.zeros(2)))
        assert (x is not None) is exact
        if x is not None:
            np.testing.assert_array_equal(x, [1.0, 0.0])


def spread(problem: Problem, rng: np.random.Generator, ratio: float) -> Problem:
    """A problem whose output weights are up to a ratio apart."""
    size = ratio ** rng.uniform(0.0, 0.5, len(problem.objective.Q_y))
    weights = problem.objective.Q_y * size[:, None] * size
    return replace(problem, objective=replace(problem.objective, Q_y=0.5 * (weights + weights.T)))


@pytest.mark.parametrize(("ratio", "room", "off", "exact"), [(1.0, 1.0, 1e-8, 1e-10), (1e9, 10.0, 1e-4, 2e-5)])
def test_whole_qps_are_brought_to_the_optimum(ratio: float, room: float, off: float, exact: float) -> None:
    """Random ones, with weights up to a billion apart: where an end is found, it is certified."""
    found, constrained = [], 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        problem = spread(random_axes(rng, horizon=6, room=room), rng, ratio)
        query = 2.0 * rng.normal(size=7), 2.0 * rng.normal(size=(6, 7)), problem.model.u_bar
        formulation, backend = Condensed(problem), PiqpDense()
        backend.setup(formulation.qp)
        qp = formulation.pose(Query(*query)).qp
        near = backend.solve(qp)
        if near.status != SOLVED or not near.active:
            continue
        constrained += 1
        polished = by_active_set(qp, near)
        if polished is None:
            continue
        x = certified(qp, polished)
        assert x is not None
        found.append((np.abs(near.x - x).max(), np.abs(polished.x - x).max()))
    errors, left = np.array(found).T
    assert errors.size > 0.8 * constrained > 24
    assert errors.max() > off
    assert left.max() < exact


def test_active_constraints_that_depend_on_each_other() -> None:
    """The paper's vehicle commanded to drop 100 m: its rotors slow down by 10 rad/s a step, and then stand still.

    With hover at 200 rad/s the twentieth step ends at zero: that step, those before it and the bound of zero depend on
    each other.  The answer is right, or none, and the solver's stands.
    """
    problem = paper_problem()
    problem = replace(problem, model=replace(problem.model, u_bar=np.full(4, 200.0)))
    state, desired = np.zeros(12), np.zeros((50, 4))
    state[4] = 100.0
    query = state, desired, problem.model.u_bar
    whole = QPSolver("piqp-multistage", problem)
    answer, given = Shortcut(problem, whole).solve(Query(*query)), whole.solve(Query(*query))
    assert answer.status == given.status == SOLVED
    form = Condensed(problem)
    scale = np.abs(answer.certificate()[1].z).max()
    assert kkt_residuals(form.pose(Query(*query)).qp, answer.certificate()[1]).worst < 1e-6 * scale
    np.testing.assert_allclose(answer.plan, given.plan, atol=1e-2)


@pytest.mark.parametrize(("ratio", "exact"), [(1.0, 1e-10), (1e9, 1e-5)])
def test_every_way_ends_at_the_optimum(ratio: float, exact: float) -> None:
    """Without a QP, axis by axis and by the whole QP."""
    errors: dict[Method, list[float]] = {method: [] for method in Method}
    queries = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        problem = spread(random_axes(rng, horizon=6, room=float(rng.choice([1.0, 10.0, 1000.0]))), rng, ratio)
        size = float(rng.choice([0.05, 2.0]))
        query = size * rng.normal(size=7), size * rng.normal(size=(6, 7)), problem.model.u_bar
        answer = Shortcut(problem, QPSolver("piqp-multistage", problem)).solve(Query(*query))
        if answer.status not in ACCEPTED:
            continue
        formulation = Condensed(problem)
        x = certified(formulation.pose(Query(*query)).qp, answer.certificate()[1])
        queries += 1
        if x is not None:
            errors[answer.method].append(np.abs(answer.plan.ravel() - x).max())
    assert min(map(len, errors.values())) > 10
    assert sum(map(len, errors.values())) >= 0.95 * queries
    assert max(map(max, errors.values())) < exact
