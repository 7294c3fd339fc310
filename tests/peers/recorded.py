"""What the constrained controller was given in the paper's flight."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from quadsim.mpc.problem import ocp
from quadsim.mpc.problem.ocp import Problem
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.state import Array

SCENARIO: Final = "paper-constrained"


@dataclass(frozen=True, kw_only=True)
class Query:
    """One control period's."""

    state: Array  # (12,) xi(k)
    desired: Array  # (N, n_r) y_d(k+1) .. y_d(k+N)
    u_before: Array  # (4,) u(k-1) [rad/s]
    status: str  # how the controller found its answer
    speeds: Array  # (4,) the answer, u(k) [rad/s]

    @property
    def posed(self) -> ocp.Query:
        """What is to be solved."""
        return ocp.Query(self.state, self.desired, self.u_before)


def record() -> tuple[Problem, tuple[Query, ...]]:
    """Fly the scenario; the optimisation, and every period's query."""
    flight = Rollout(load_scenario(SCENARIO)).fly()
    log = flight.log.control
    problem = Assembly(flight.scenario).problem()
    reference = Assembly(flight.scenario).reference(log.t.size + problem.horizon)
    desired = problem.desired(reference)
    before = np.vstack([log.speeds_before, log.speeds[:-1]])
    queries = tuple(
        Query(
            state=log.state[k],
            desired=desired[k + 1 : k + 1 + problem.horizon],
            u_before=before[k],
            status=log.status[k],
            speeds=log.speeds[k],
        )
        for k in range(log.t.size)
    )
    return problem, queries
