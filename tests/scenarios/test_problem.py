"""`quadsim.problem`: the controller's QP in numpy arrays, solved by another solver."""

from __future__ import annotations

import daqp
import numpy as np
import pytest

import quadsim
from quadsim.controller import StepInputs
from quadsim.errors import InputError, ParameterError
from quadsim.mpc.problem.ocp import CondensedQP
from quadsim.state import REFERENCE_NAMES, Array


def solved(qp: CondensedQP) -> Array:
    upper = np.concatenate([qp.x_max, qp.upper])
    lower = np.concatenate([qp.x_min, qp.lower])
    x, _, flag, _ = daqp.solve(qp.H, qp.f, qp.A, upper, lower)
    assert flag == 1
    return np.asarray(x)


def test_another_solver_gives_the_paper_s_commands() -> None:
    scenario = quadsim.load("paper-constrained").replace({"duration": 12.0})
    flight = quadsim.fly(scenario)
    problem = quadsim.problem(scenario)
    control = flight.log.control
    reference = np.stack([flight.reference[name] for name in REFERENCE_NAMES], axis=1)
    active = np.flatnonzero(control.active[1 : -problem.horizon - 1]) + 1
    assert active.size > 20
    for k in active[:: active.size // 10]:
        preview = reference[k + 1 : k + 1 + problem.horizon]
        qp = problem.qp(control.state[k], preview, flight.command[k - 1])
        x = solved(qp)
        np.testing.assert_allclose(x[:4], flight.command[k], rtol=0.0, atol=1e-3)
        np.testing.assert_array_equal(problem.condensed().inputs(x)[0], x[:4])
        assert np.array_equal(qp.H, problem.condensed().cost.H)
        assert (x > qp.x_min - 1e-6).all()


@pytest.mark.parametrize("roll", [0.0, 0.15])
@pytest.mark.parametrize("name", ["robust", "robust-lag50"])
def test_the_problem_of_the_robust_controller_has_its_slacks_and_tightened_bounds(name: str, roll: float) -> None:
    scenario = quadsim.load(name, {"controller.fallback.enabled": False})
    problem = quadsim.problem(scenario)
    law = quadsim.make_controller(scenario)
    state = np.zeros(12)
    preview = np.tile([5.0, 1.0, 0.5, 0.0], (problem.horizon, 1))
    state[6] = roll
    before = problem.model.u_bar.copy()
    law.reset(before)
    command = law.step(StepInputs(), state, preview)
    qp = problem.qp(state, preview, before)
    assert problem.model.n == (16 if name == "robust-lag50" else 12)
    outputs = problem.rows.upper[:, problem.rows.soft]
    assert (outputs < np.radians(5.0)).all()
    assert (np.diff(outputs, axis=0) <= 0.0).all()
    x = solved(qp)
    np.testing.assert_allclose(x[:4], command.speeds, rtol=0.0, atol=1e-3)
    slacks = problem.condensed().slacks(x)
    assert slacks.size == problem.horizon * problem.rows.slacks.size > 0
    assert slacks.max() == pytest.approx(command.stats.slack, abs=1e-5)
    assert (command.stats.slack > 0.01) == (roll > 0.0)


def test_without_constraints_the_optimum_is_a_linear_system_and_the_law_s_command() -> None:
    problem = quadsim.problem("paper-unconstrained")
    law = quadsim.make_controller("paper-unconstrained")
    state = np.linspace(-0.1, 0.1, 12)
    preview = np.tile([1.0, 2.0, 3.0, 0.1], (problem.horizon, 1))
    qp = problem.qp(state, preview, problem.model.u_bar)
    assert qp.A.shape == (0, 4 * problem.horizon)
    assert np.isinf([qp.x_min, qp.x_max]).all()
    law.reset(problem.model.u_bar)
    command = law.step(StepInputs(), state, preview)
    np.testing.assert_allclose(np.linalg.solve(qp.H, -qp.f)[:4], command.speeds, rtol=1e-6)


def test_other_controllers_and_other_shapes_are_refused() -> None:
    for law in ("pid", "lqr", "geometric"):
        with pytest.raises(InputError, match="type"):
            quadsim.problem(quadsim.load("hover").replace({"controller": law}))
    problem = quadsim.problem("paper-constrained")
    good = {"state": np.zeros(12), "reference": np.zeros((50, 4)), "u_before": np.zeros(4)}
    for name, shape in {"state": (13,), "reference": (4,), "u_before": (3,)}.items():
        with pytest.raises(ParameterError, match=name):
            problem.qp(**{**good, name: np.zeros(shape)})
