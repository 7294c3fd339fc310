"""The robust preparation in C, which poses the queries, and the linear law around it, with an optimum and without."""

from __future__ import annotations

import copy
import tomllib
from typing import Any

import numpy as np
import pytest
from numpy_preparation import NumpyPreparation
from support import paper_problem

import quadsim
from quadsim.controller import CORE, FALLBACK, GAIN, Command, Phase, StepInputs
from quadsim.mpc.laws.parts.linear import LinearMPC, NominalPreparation
from quadsim.mpc.laws.parts.numbers import robust_numbers
from quadsim.mpc.laws.parts.preparation import RobustPreparation
from quadsim.mpc.laws.robust import Robust
from quadsim.mpc.solvers.core import Core
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import INDEX, N_STATES, Array, wrapped


def prepared(name: str, changes: dict[str, Any] | None = None) -> RobustPreparation:
    """The preparation of a robust scenario."""
    scenario = quadsim.load(name, changes or {})
    table = scenario.controller
    vehicle = Assembly(scenario).vehicle
    assert isinstance(table, Robust)
    return RobustPreparation(vehicle, table.problem(vehicle, scenario.control_period), table)


# Who solves


def solver(name: str, changes: dict[str, object]) -> str:
    return Assembly(quadsim.load(name, changes)).controller().solver


@pytest.mark.parametrize(
    ("name", "changes", "expected"),
    [
        ("robust", {}, "core"),
        ("robust-lag50", {}, "core"),
        ("robust", {"controller.solver": "core"}, "core"),
        ("robust", {"controller.solver": "piqp"}, "piqp-multistage"),
        ("forest", {}, "piqp-multistage"),
        ("paper-constrained", {}, "piqp-multistage"),
        ("paper-constrained", {"controller.solver": "core"}, "core"),
        ("paper-unconstrained", {}, ""),
    ],
)
def test_who_solves_where_nothing_is_stated(name: str, changes: dict[str, object], expected: str) -> None:
    assert solver(name, changes) == expected
    resolved = Assembly(quadsim.load(name, changes)).resolved.scenario
    again = Scenario.parse(tomllib.loads(resolved.to_toml()))
    assert Assembly(again).controller().solver == expected


def test_a_robust_problem_that_the_core_does_not_take_is_piqps() -> None:
    scenario = quadsim.load("robust", {"controller.horizon": 480, "controller.tightening": None})
    assert isinstance(scenario.controller, Robust)
    problem = scenario.controller.problem(Assembly(scenario).vehicle, scenario.control_period)
    assert scenario.controller.solver_name(problem, None) == "piqp"


def test_a_change_in_flight_resolves_as_it_flew() -> None:
    changes = [{"type": "controller", "at": at, "fields": fields} for at, fields in CHANGES]
    flight = quadsim.fly(quadsim.load("robust", {"duration": 9.2, "events": changes}), progress=False)
    again = quadsim.fly(Scenario.parse(tomllib.loads(flight.scenario.to_toml())), progress=False)
    assert {*flight.log.control.answered_by} >= {"core", "daqp"}
    assert [*again.log.control.answered_by] == [*flight.log.control.answered_by]
    assert np.array_equal(again.command, flight.command)


CHANGES = ((7.0, {"horizon": 45}), (8.2, {"solver": "daqp"}), (8.5, {"horizon": 40}), (8.8, {"solver": "core"}))
BOTH = ("core", "daqp")


@pytest.mark.parametrize("order", [BOTH, BOTH[::-1]])
def test_one_law_takes_over_from_the_other(order: tuple[str, str]) -> None:
    """Heavier than its model and with rotors that lag, the vehicle is not where a law that forgets would have it."""
    first, then = order
    late = {"computation.delay": 0.06, "controller.delay": 0.06, "duration": 6.0, "actual.mass": 4.4}
    late |= {"controller.solver": first}
    event = {"type": "controller", "at": 3.0, "fields": {"solver": then}}
    switched = quadsim.fly(quadsim.load("robust-lag50", late | {"events": [event]}), progress=False)
    stayed = quadsim.fly(quadsim.load("robust-lag50", late), progress=False)
    assert np.abs(switched.log.control.speeds - stayed.log.control.speeds).max() <= 1e-4
    assert np.ptp(stayed.log.control.speeds) > 5.0


# Queries


MOVING = {"x": 10.0, "y": 10.0, "z": 100.0, "yaw": 100.0, "vx": 5.0, "vy": 6.0, "vz": 7.0, "yaw_rate": 8.0}
AIR: dict[str, Any] = {
    **{"controller.moment": True, "vehicle.rotor_moment": [2e-4, -3e-4], "vehicle.inflow_moment": [0.03, -0.04]},
    **{"vehicle.rate_damping": [0.1, 0.2, 0.3], "vehicle.inflow": 3e-3},
}
PARTS: dict[str, dict[str, Any]] = {
    "late through two commands": {"controller.delay": 0.12},
    "late by a period": {"controller.delay": 0.05},
    "late within a period": {"controller.delay": 0.03, "controller.rotor_lag": 0.0},
    "no part": {"controller.rotor_lag": 0.0, "controller.heading": False, "controller.offset_free": None},
    "velocities": {"controller.output_weights": MOVING, "controller.delay": 0.12, "controller.heading": False},
    "velocities, along the heading": {"controller.output_weights": MOVING, "controller.delay": 0.08},
    "velocities over two periods": {"controller.output_weights": MOVING, "controller.horizon": 2},
    "the air": AIR,
    "the air, late and without heading": AIR | {"controller.delay": 0.08, "controller.heading": False},
    "turns that are cut": {"controller.largest_turn": 2.0},
}


@pytest.mark.parametrize("parts", PARTS)
def test_queries_are_those_of_numpy(parts: str) -> None:
    """In the air, on the ground and up again, through commands under way, a pause and states that are predicted."""
    changes: dict[str, Any] = {"controller.tightening": None} | PARTS[parts]
    preparation = prepared("robust-lag50", changes | {"computation.delay": changes.get("controller.delay", 0.0)})
    scenario = quadsim.load("robust-lag50", changes | {"computation.delay": changes.get("controller.delay", 0.0)})
    assert isinstance(scenario.controller, Robust)
    twin = NumpyPreparation(Assembly(scenario).vehicle, preparation.problem, scenario.controller)
    rng = np.random.default_rng(3)
    time = 0.0
    hover = preparation.problem.model.u_bar
    period = preparation.problem.model.period
    unseen = np.zeros(N_STATES)
    unseen[INDEX["vz"]] = 1.0
    if twin.observer is not None:
        twin.estimate = np.array([0.1, -0.2, 0.3, 0.01, 0.02, -0.03])
        preparation.adopt(None, twin.estimate)
    for k in range(40):
        time += 3.0 * period if k == 30 else period
        phase = Phase.LANDED if k in (10, 11) else Phase.ARMED if k == 12 else Phase.FLYING
        predicted = k in (20, 21)
        now = StepInputs(time=time, phase=phase, unseen=unseen if predicted else None)
        state = 0.1 * rng.standard_normal(N_STATES)
        acting = hover + rng.uniform(-5.0, 5.0, 4)
        reference = np.cumsum(0.05 * rng.standard_normal((preparation.problem.horizon, 4)), axis=0)
        reference[:, 3] = wrapped(reference[:, 3] + 3.1)  # across the half turn
        if phase is Phase.LANDED:
            preparation.stand(now, acting)
            twin.stand(acting)
            continue
        flying = phase is Phase.FLYING
        query = preparation.prepare(now, state, reference, acting)
        learns = flying and not predicted and k != 30 and k != 0
        expected = twin.prepare(state, reference, acting, flying=flying, learns=learns)
        assert query is not None
        assert query.equilibrium is not None
        assert expected.equilibrium is not None
        np.testing.assert_allclose(query.state, expected.state, rtol=0.0, atol=1e-11)
        np.testing.assert_allclose(query.desired, expected.desired, rtol=0.0, atol=1e-11)
        np.testing.assert_array_equal(query.u_before, acting)
        np.testing.assert_allclose(query.equilibrium.u, expected.equilibrium.u, rtol=0.0, atol=1e-10)
        there = [INDEX["roll"], INDEX["pitch"], *range(N_STATES, query.state.size)]  # the place of rest is any
        np.testing.assert_allclose(query.equilibrium.x[there], expected.equilibrium.x[there], rtol=0.0, atol=1e-10)
        np.testing.assert_allclose(preparation.trim.speeds, twin.trim.speeds, rtol=0.0, atol=1e-10)
        assert (preparation.memory.ahead is None) == (twin.ahead is None)
    assert preparation.problem.model.n == (N_STATES if changes.get("controller.rotor_lag") == 0.0 else N_STATES + 4)
    assert (np.abs(twin.estimate).max() > 0.1) == (twin.observer is not None)


# The law


@pytest.fixture(params=["paper-constrained", "robust"])
def mpc(request: pytest.FixtureRequest) -> LinearMPC:
    return law_by_core(request.param)


def law_by_core(name: str) -> LinearMPC:
    if name == "paper-constrained":
        problem = paper_problem()
        return LinearMPC(NominalPreparation(problem), Core(problem), name=name)
    preparation = prepared(name)
    return LinearMPC(preparation, Core(preparation.problem), name=name)


def ask(mpc: LinearMPC, k: int, state: Array, speeds: Array | None = None) -> Command:
    """Its answer in period k with a reference 1 m to the side."""
    reference = np.tile([1.0, 0.0, 0.0, 0.0], (mpc.horizon, 1))
    return mpc.step(StepInputs(time=k * mpc.problem.model.period, phase=Phase.FLYING, acting=speeds), state, reference)


def states(count: int, seed: int) -> Array:
    return 0.02 * np.random.default_rng(seed).standard_normal((count, N_STATES))


def answers(mpc: LinearMPC, seed: int) -> list[Array]:
    mpc.reset(mpc.problem.model.u_bar)
    return [ask(mpc, k, state).plan for k, state in enumerate(states(8, seed))]


def test_a_reset_forgets_all(mpc: LinearMPC) -> None:
    first = answers(mpc, seed=1)
    answers(mpc, seed=2)
    assert np.array_equal(answers(mpc, seed=1), first)


def test_controllers_share_no_mutable_state(mpc: LinearMPC) -> None:
    alone = [answers(mpc, seed) for seed in range(5)]
    many = [law_by_core(mpc.name) for _ in alone]
    together = [[ask(each, k, states(8, seed)[k]).plan for seed, each in enumerate(many)] for k in range(8)]
    assert np.array_equal(np.swapaxes(together, 0, 1), alone)


def test_the_answerer_is_reported(mpc: LinearMPC) -> None:
    hover = mpc.problem.model.u_bar
    at_rest = np.zeros(N_STATES)
    target = np.zeros((mpc.horizon, 4))
    free = mpc.step(StepInputs(time=0.0, phase=Phase.FLYING), at_rest, target)
    assert (free.status, free.answered_by, free.stats.active) == ("unconstrained", GAIN, 0)
    assert free.speeds == pytest.approx(hover)
    far = ask(mpc, 1, at_rest)
    assert (far.status, far.answered_by, far.fallback) == ("solved", CORE, 0)
    assert far.stats.active > 0


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, 1e300])
def test_numbers_out_of_hand_are_refused_with_the_command_in_force(mpc: LinearMPC, wrong: float) -> None:
    hover = mpc.problem.model.u_bar
    state = np.zeros(N_STATES)
    for name in INDEX:
        broken = state.copy()
        broken[INDEX[name]] = wrong
        mpc.reset(hover)
        result = ask(mpc, 0, broken)
        assert result.answered_by == FALLBACK
        assert np.array_equal(result.plan, np.tile(hover, (mpc.horizon, 1)))
    assert ask(mpc, 1, state, hover).answered_by != FALLBACK


def test_a_disturbance_is_learned_in_flight_alone_and_from_what_is_measured() -> None:
    predicted = np.zeros(N_STATES)
    predicted[INDEX["vz"]] = 1.0
    for phase, unseen, learned in (
        (Phase.FLYING, np.zeros(N_STATES), True),
        (Phase.ARMED, None, False),
        (Phase.FLYING, predicted, False),
    ):
        mpc = law_by_core("robust")
        for k in range(3):
            falling = np.zeros(N_STATES)
            falling[INDEX["vz"]] = -0.1 * k
            now = StepInputs(time=k * mpc.problem.model.period, phase=phase, unseen=unseen)
            mpc.step(now, falling, np.zeros((mpc.horizon, 4)))
        assert mpc.trim is not None
        assert (mpc.trim.speeds.mean() > mpc.problem.model.u_bar.mean() + 1.0) == learned


def test_the_largest_violation_of_a_soft_bound_is_reported_on_either_side() -> None:
    """Tilted by 0.2 rad where 0.087 are allowed, it takes more than a period to come back."""
    mpc = law_by_core("robust")
    slacks = []
    for side in (-1.0, 1.0):
        mpc.reset(mpc.problem.model.u_bar)
        tilted = np.zeros(N_STATES)
        tilted[INDEX["roll"]] = 0.2 * side
        command = mpc.step(StepInputs(time=0.0, phase=Phase.FLYING), tilted, np.zeros((mpc.horizon, 4)))
        slacks.append(command.stats.slack)
    assert slacks[0] == pytest.approx(slacks[1], rel=1e-6)
    assert 0.08 < slacks[0] < 0.2 - np.radians(5.0) + 0.01


def test_the_structs_have_all_numbers_in_place() -> None:
    scenario = quadsim.load("robust-lag50")
    preparation = prepared("robust-lag50")
    vehicle = Assembly(scenario).vehicle
    assert isinstance(scenario.controller, Robust)
    for name, value in robust_numbers(scenario.controller, vehicle, scenario.control_period).items():
        assert np.array_equal(np.ravel(value), np.ravel(getattr(preparation._robust, name)))


@pytest.mark.parametrize("kind", [RobustPreparation, Core])
def test_copying_is_refused(kind: type[RobustPreparation | Core]) -> None:
    preparation = prepared("robust")
    native = preparation if kind is RobustPreparation else Core(preparation.problem)
    with pytest.raises(TypeError, match="pickled"):
        copy.deepcopy(native)
