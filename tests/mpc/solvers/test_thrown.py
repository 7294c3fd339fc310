"""Thrown states, many beyond any bound: what PIQP calls solved is the optimum, and what it gives up has no answer.

Each answer is judged from the definition of the problem alone: plans are rolled out, and a linear program or a dense QP
of probed matrices says whether there is an answer and what it is (`ocp_peer`).
"""

from __future__ import annotations

import numpy as np
import ocp_peer
import pytest
from support import paper_problem

from quadsim.controller import SOLVED
from quadsim.mpc.problem.ocp import Problem, Query
from quadsim.mpc.solvers import QPSolver

HORIZON = 10
STATES = 31
SIZES = np.array([1.0, 0.5, 1.0, 0.5, 1.0, 0.5, 0.03, 0.1, 0.03, 0.1, 0.3, 0.3])
"""Standard deviations of thrown states [m, m/s, rad, rad/s]."""
PROBLEMS: dict[str, tuple[str, list[str]]] = {
    "hard": ("paper-constrained", []),
    "terminal": ("paper-constrained", ["controller.terminal=lqr"]),
    "climb": ("paper-constrained", ["controller.output_bounds.vz=[-1.0, 1.0]"]),
    "heavy": ("paper-constrained-heavy", []),
    "lag": ("paper-constrained-lag20", []),
    "polytopes": ("polytopes", []),
    "soft": ("robust", []),
    "soft-lag": ("robust-lag50", []),
    "hummingbird": ("hummingbird-figure-eight", []),
    "crazyflie": ("crazyflie-steps", []),
    "figure-eight": ("figure-eight", []),
    "waypoints": ("waypoints", []),
    "worn-rotor": ("worn-rotor-hard-bounds", []),
}
ALWAYS_FEASIBLE = ("soft", "soft-lag", "hummingbird", "crazyflie")
"""Problems whose bounds on states are soft, or none of whose thrown states is beyond them; of the others, some are."""


def thrown(rng: np.random.Generator, problem: Problem) -> Query:
    """A state off hover, a set-point some metres away, and a command before that rotors may have had."""
    size = rng.choice([0.1, 0.5, 2.0])
    before = problem.model.u_bar * rng.uniform(0.97, 1.03, 4)
    state = np.zeros(problem.model.n)
    state[:12] = size * SIZES * rng.normal(size=12)
    state[12:] = before[: state.size - 12]
    point = size * rng.normal(size=4) * [3.0, 3.0, 2.0, 0.5]
    return Query(state, problem.desired(np.tile(point, (problem.horizon, 1))), before)


@pytest.mark.parametrize("name", PROBLEMS)
def test_what_is_called_solved_is_the_optimum(name: str) -> None:
    scenario, settings = PROBLEMS[name]
    problem = paper_problem(scenario, *settings, f"controller.horizon={HORIZON}")
    solver = QPSolver("piqp-multistage", problem)
    rng = np.random.default_rng(67)
    without = 0
    for _ in range(STATES):
        query = thrown(rng, problem)
        given = ocp_peer.period(problem, *query[:3])
        answer = solver.solve(query)
        least = ocp_peer.least_violation(problem, given)
        assert least is not None
        if answer.status != SOLVED:
            assert least > 1e-6
            without += 1
            continue
        assert least < 1e-6
        expected = ocp_peer.optimum(problem, given)
        assert expected.solution.status == SOLVED
        hard = [part for part in problem.every_constraint if part.penalty is None]
        assert max(ocp_peer.violation(part, given, answer.plan).max() for part in hard) < 1e-6
        least_cost = ocp_peer.cost(problem, given, expected.plan)
        assert ocp_peer.cost(problem, given, answer.plan) < least_cost + 1e-6 * max(1.0, least_cost)
        np.testing.assert_allclose(answer.plan[0], expected.plan[0], rtol=0.0, atol=1e-2)
    assert (without == 0) == (name in ALWAYS_FEASIBLE)
    assert without < STATES // 2
