"""What several test modules build."""

from __future__ import annotations

import numpy as np

from mpc.model import LinearModel
from mpc.problem import Bounds, Objective, Problem
from quadsim.state import Array
from scenarios.build import build_problem, build_reference, build_vehicle
from scenarios.spec import load_scenario


def paper_problem(name: str = "paper-constrained", *settings: str) -> Problem:
    """The optimisation of one of the paper's scenarios."""
    scenario = load_scenario(name, settings)
    return build_problem(scenario, build_vehicle(scenario))


def paper_reference(samples: int) -> Array:
    """The paper's filtered reference."""
    return build_reference(load_scenario("paper-constrained"), samples)


def random_problem(rng: np.random.Generator, *, horizon: int, n: int = 3, nu: int = 2, n_c: int = 1) -> Problem:
    """A stable system with random weights and bounds; the state order is nobody's."""
    A = rng.normal(size=(n, n))
    A *= 0.95 / max(abs(np.linalg.eigvals(A)).max(), 1e-3)
    model = LinearModel(A=A, B=rng.normal(size=(n, nu)), u_bar=rng.normal(size=nu), period=0.1)
    objective = Objective(C_r=np.eye(n), Q_y=_random_definite(rng, n), Q_u=_random_definite(rng, nu))
    bounds = Bounds(
        C_c=rng.normal(size=(n_c, n)),
        y_min=-rng.uniform(0.5, 5.0, n_c),
        y_max=rng.uniform(0.5, 5.0, n_c),
        delta_min=-rng.uniform(0.1, 2.0, nu),
        delta_max=rng.uniform(0.1, 2.0, nu),
        u_min=model.u_bar - rng.uniform(0.1, 3.0, nu),
        u_max=model.u_bar + rng.uniform(0.1, 3.0, nu),
    )
    return Problem(model=model, horizon=horizon, objective=objective, bounds=bounds)


def _random_definite(rng: np.random.Generator, size: int) -> Array:
    factor = rng.normal(size=(size, size))
    matrix = factor @ factor.T + 0.1 * np.eye(size)
    return 0.5 * (matrix + matrix.T)
