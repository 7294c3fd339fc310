"""What the constrained controller was asked in the paper's flight."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from mpc.problem import Problem
from quadsim.state import Array
from scenarios.build import build_problem
from scenarios.loading import load_scenario
from scenarios.queries import recorded
from scenarios.runner import fly_scenario

SCENARIO: Final = "paper-constrained"


@dataclass(frozen=True, kw_only=True)
class Query:
    """One control period's.

    Attributes:
        state: (12,) xi(k).
        desired: (N, n_r) y_d(k+1) .. y_d(k+N).
        u_before: (4,) u(k-1) [rad/s].
        status: what the controller answered.
    """

    state: Array
    desired: Array
    u_before: Array
    status: str


def record() -> tuple[Problem, tuple[Query, ...]]:
    """Fly the scenario; the optimisation, and every period's query."""
    flight = fly_scenario(load_scenario(SCENARIO))
    problem = build_problem(flight.scenario, flight.vehicle)
    asked = recorded(flight.scenario, flight.log.control, problem.horizon)
    statuses = flight.log.control.status
    desired = problem.objective.desired(asked.reference)
    queries = tuple(
        Query(state=state, desired=desired[k + 1 : k + 1 + problem.horizon], u_before=u_before, status=status)
        for k, (state, u_before, status) in enumerate(zip(asked.state, asked.speeds_before, statuses, strict=True))
    )
    return problem, queries
