"""Which weights have a regulator, and who answers: the same where A and B differ in their last digits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from support import paper_problem

from quadsim.errors import ParameterError
from quadsim.mpc.forms.condensing import LARGEST_CONDITION, Condensed, FreeOptimum
from quadsim.mpc.laws.lqr import lqr_gain
from quadsim.mpc.problem.ocp import Problem, Query, lqr_terminal_weight
from quadsim.mpc.problem.regulator import stabilising, undetected
from quadsim.state import STATE_NAMES, Array


def nudged(problem: Problem, count: int = 20) -> Iterator[Problem]:
    """The problem with every entry of A and B moved by one unit in the last place, or not."""
    rng = np.random.default_rng(0)

    def moved(matrix: Array) -> Array:
        return np.asarray(np.nextafter(matrix, matrix + rng.choice([-1.0, 0.0, 1.0], matrix.shape)))

    for _ in range(count):
        model = replace(problem.model, A=moved(problem.model.A), B=moved(problem.model.B))
        yield replace(problem, model=model)


def weighted(weights: str) -> Problem:
    return paper_problem("paper-constrained", f"controller.output_weights={weights}")


def refusals(problem: Problem) -> set[str]:
    """What is said of the problem and of each that differs from it by rounding; empty where one is accepted."""
    texts = set()
    for other in (problem, *nudged(problem)):
        for regulator in (lqr_terminal_weight, lqr_gain):
            try:
                regulator(other.model, other.objective)
            except ParameterError as error:
                texts.add(f"{error.name}: {error.rule}")
            else:
                texts.add("accepted")
    return texts


@pytest.mark.parametrize(
    ("weights", "adrift"),
    [
        ("{x=1.0, y=1.0, z=1.0}", "yaw, yaw_rate"),
        ("{x=1.0, z=1.0, yaw=1.0}", "y, vy, roll, roll_rate"),
        ("{z=1.0}", "x, vx, y, vy, roll, roll_rate, pitch, pitch_rate, yaw, yaw_rate"),
        ("{vx=1.0, vy=1.0, vz=1.0, yaw=1.0}", "x, y, z"),
    ],
)
def test_states_that_nothing_weighted_shows_are_named(weights: str, adrift: str) -> None:
    hidden = f"nothing weighted shows {adrift}, which would not come to rest"
    assert refusals(weighted(weights)) == {
        f"terminal: left out, or weights on all of x, y, z and yaw: {hidden}",
        f"output_weights: such that every unweighted state comes to rest: weigh x, y, z and yaw; {hidden}",
    }


def test_a_weight_that_rounding_swallows_is_refused() -> None:
    """Files state no weight below 1e-12; a problem of one's own may."""
    problem = weighted("{x=1.0, y=1.0, z=1.0, yaw=1.0}")
    weights = problem.objective.Q_y.copy()
    shows_yaw = problem.objective.C_r[:, STATE_NAMES.index("yaw")] != 0.0
    weights[np.ix_(shows_yaw, shows_yaw)] = 1e-20
    assert refusals(replace(problem, objective=replace(problem.objective, Q_y=weights))) == {
        "terminal: left out, or weights on all of x, y, z and yaw: with these weights nothing brings yaw, yaw_rate to "
        "rest",
        "output_weights: such that every unweighted state comes to rest: weigh x, y, z and yaw; with these weights "
        "nothing brings yaw, yaw_rate to rest",
    }


@pytest.mark.parametrize("yaw", [1.0, 1e-6, 1e-12])
def test_a_small_weight_is_accepted(yaw: float) -> None:
    assert refusals(weighted(f"{{x=1.0, y=1.0, z=1.0, yaw={yaw}}}")) == {"accepted"}


def test_a_hidden_state_that_comes_to_rest_is_accepted() -> None:
    A = np.diag([1.0, 0.9])
    C = np.array([[1.0, 0.0]])
    P, K = stabilising(A, np.array([[1.0], [0.0]]), C, np.eye(1), np.eye(1))
    p = 0.5 * (1.0 + np.sqrt(5.0))  # of p = 1 + p - p^2 / (1 + p)
    np.testing.assert_allclose(P, np.diag([p, 0.0]), atol=1e-12)
    np.testing.assert_allclose(K, [[p / (1.0 + p), 0.0]], atol=1e-12)
    assert undetected(A, C).size == 0
    assert undetected(np.diag([1.0, 1.0]), C).tolist() == [1]


def test_only_what_is_hidden_and_moves_is_named() -> None:
    """Of three hidden states behind a rotation, one decays."""
    A = scipy.linalg.block_diag([[0.5]], [[1.0, 0.1], [0.0, 1.0]], [[0.8]])
    assert undetected(A, np.eye(4)[:1]).tolist() == [1, 2]
    with pytest.raises(ValueError, match="swing, spin"):
        stabilising(A, np.eye(4), np.eye(4)[:1], np.eye(1), np.eye(4), ("at", "swing", "spin", "lag"))


def test_states_of_any_number_have_names() -> None:
    A = np.eye(18)
    with pytest.raises(ValueError, match=f"nothing weighted shows {STATE_NAMES[1]}, .*, rotor 4, state 17, state 18, "):
        stabilising(A, np.eye(18), np.eye(18)[:1], np.eye(1), np.eye(18))


@pytest.mark.parametrize(
    ("weight", "usable"), [(1.0, True), (1e-5, True), (3e-9, False), (1.5e-9, False), (1e-12, False)]
)
def test_the_condition_number_decides_whether_the_free_optimum_answers(weight: float, usable: bool) -> None:
    """The weights of the inputs make the condition; 1.5e-9 was on either side by rounding."""
    problem = paper_problem()
    objective = replace(problem.objective, Q_u=weight * np.eye(4))
    problem = replace(problem, objective=objective)
    condition = np.linalg.cond(Condensed.of(problem).cost.H, 1)
    assert (condition < 0.1 * LARGEST_CONDITION) if usable else (condition > 10.0 * LARGEST_CONDITION)
    at_rest = Query(np.zeros(12), np.zeros((50, 4)), problem.model.u_bar)
    for other in (problem, *nudged(problem, 8)):
        free = FreeOptimum.of(other)
        assert (free is not None) == usable
        assert free is None or free.solve(at_rest) is not None


def test_every_condition_of_the_library_is_far_from_the_limit() -> None:
    """A factor of a thousand or more; see `LARGEST_CONDITION`."""
    for name in ("paper-constrained", "robust", "polytopes", "crazyflie-steps", "hummingbird-figure-eight"):
        assert np.linalg.cond(Condensed.of(paper_problem(name)).cost.H, 1) < 1e-3 * LARGEST_CONDITION, name
