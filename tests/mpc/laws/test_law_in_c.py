"""A law in C: it flies as the law in Python does, with an optimum and without."""

from __future__ import annotations

import copy
import tomllib
from dataclasses import replace

import numpy as np
import pytest

import quadsim
from quadsim.controller import CORE, FALLBACK, GAIN, Command, Phase, StepInputs
from quadsim.errors import ExportError, InputError
from quadsim.features.export.exporter import exported_law
from quadsim.mpc.export.source import CController
from quadsim.mpc.laws.parts.compiled import CompiledPreparation, CompiledSolver
from quadsim.mpc.laws.parts.linear import LinearMPC
from quadsim.mpc.laws.parts.numbers import robust_numbers
from quadsim.mpc.laws.parts.preparation import RobustPreparation
from quadsim.rollout.flown import Flight
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import INDEX, N_STATES, Array, wrapped

COMPILED = {"controller.compiled": True}
PYTHON = {"controller.compiled": False, "controller.solver": CORE}
FLIGHTS = (
    *("paper-constrained", "paper-unconstrained", "robust", "robust-lag50", "crazyflie-steps", "figure-eight"),
    *("take-off-and-landing", "motion-capture"),
)


def both(scenario: Scenario) -> tuple[Flight, Flight]:
    """Its flight by the law in Python, with the core as solver, and by the law in C."""
    by_python = {"controller.compiled": False} if scenario.controller.type == "unconstrained" else PYTHON
    python, c = (quadsim.fly(scenario.replace(law), progress=False) for law in (by_python, COMPILED))
    assert c.solver == "compiled"
    return python, c


def why(flight: Flight) -> str | None:
    """The sentence about its first QP without an answer; its remedies, which are flown, have tests of their own."""
    diagnosis = flight.numbers["diagnosis"]
    return None if diagnosis is None else diagnosis["sentence"]


@pytest.mark.slow("core")
@pytest.mark.parametrize(
    ("name", "changes"),
    [
        pytest.param(FLIGHTS[0], {"duration": 10.0}, marks=pytest.mark.witness("core")),
        *[(name, {}) for name in FLIGHTS],
    ],
)
def test_a_compiled_flight_is_the_flight(name: str, changes: dict[str, float]) -> None:
    python, c = both(quadsim.load(name, changes))
    assert c.satisfied == python.satisfied
    for key in ("statuses", "fallbacks"):
        assert c.summary["controller"][key] == python.summary["controller"][key]
    # what the exact optima differ by, and what a flight of a minute makes of that
    assert np.abs(c.log.control.speeds - python.log.control.speeds).max() <= 1e-5
    assert c.log.control.active.sum() == pytest.approx(python.log.control.active.sum(), rel=0.05)
    assert c.log.control.slack == pytest.approx(python.log.control.slack, abs=1e-6)


# A hard bound that is lost on the way: no plan, a plan that is shifted to its end, and then hover.
HARD = {
    "duration": 6.0,
    "controller.soft.linear": 1e8,
    "controller.polytopes": [{"name": "ceiling", "of": ["vz"], "rows": [[1.0]], "upper": [0.4]}],
}
FAILURES = {
    "pushed beyond a hard bound": HARD
    | {"events": [{"type": "push", "at": 3.0, "duration": 0.5, "force": [0, 0, 25]}]},
    "infeasible from the start": HARD | {"initial.velocity": [0.0, 0.0, 2.0]},
    "late commands": HARD | {"initial.velocity": [0.0, 0.0, 1.0], "computation.delay": 0.06, "controller.delay": 0.06},
    "a lost sensor": {
        "duration": 7.0,
        "events": [{"type": "sensor_fault", "at": 2.0, "duration": 3.0, "sensor": "position", "fault": "nan"}],
    },
}


@pytest.mark.parametrize("failure", FAILURES)
def test_without_an_optimum_both_fall_back_alike(failure: str) -> None:
    python, c = both(quadsim.load("robust", FAILURES[failure]))
    control, expected = c.log.control, python.log.control
    assert max(control.fallback) >= 1
    assert [*control.fallback] == [*expected.fallback]
    assert [*control.status] == [*expected.status]
    assert [*control.answered_by] == [*expected.answered_by]
    assert control.speeds == pytest.approx(expected.speeds, abs=1e-5)
    assert why(c) == why(python)
    assert c.outcome == python.outcome


def test_the_papers_plan_is_held_to_its_end_and_diagnosed() -> None:
    python, c = both(quadsim.load("paper-constrained-lag20"))
    assert c.log.reason == python.log.reason
    assert "after holding the last plan" in (c.log.reason or "")
    assert [*c.log.control.fallback] == [*python.log.control.fallback]
    assert why(c) == why(python) is not None


def solver(name: str, changes: dict[str, object]) -> str:
    return Assembly(quadsim.load(name, changes)).controller().solver


@pytest.mark.parametrize(
    ("name", "changes", "expected"),
    [
        ("robust", {}, "compiled"),
        ("robust-lag50", {}, "compiled"),
        ("robust", {"controller.solver": "core"}, "compiled"),
        ("robust", {"controller.solver": "piqp"}, "piqp-multistage"),
        ("robust", {"controller.compiled": False}, "piqp-multistage"),
        ("robust", PYTHON, "core"),
        ("forest", {}, "piqp-multistage"),
        ("paper-constrained", {}, "piqp-multistage"),
        ("paper-constrained", {"controller.solver": "core"}, "core"),
        ("paper-constrained", COMPILED, "compiled"),
        ("paper-unconstrained", {}, ""),
    ],
)
def test_who_flies_where_nothing_is_stated(name: str, changes: dict[str, object], expected: str) -> None:
    assert solver(name, changes) == expected
    resolved = Assembly(quadsim.load(name, changes)).resolved.scenario
    assert resolved.controller.compiled is (expected == "compiled")
    again = Scenario.parse(tomllib.loads(resolved.to_toml()))
    assert Assembly(again).controller().solver == expected


def test_a_change_in_flight_resolves_as_it_flew() -> None:
    changes = [{"type": "controller", "at": at, "fields": fields} for at, fields in CHANGES]
    flight = quadsim.fly(quadsim.load("robust", {"duration": 9.2, "events": changes}), progress=False)
    again = quadsim.fly(Scenario.parse(tomllib.loads(flight.scenario.to_toml())), progress=False)
    assert {*flight.log.control.answered_by} >= {"core", "daqp"}
    assert [*again.log.control.answered_by] == [*flight.log.control.answered_by]
    assert np.array_equal(again.command, flight.command)


CHANGES = ((7.0, {"horizon": 45}), (8.2, {"solver": "daqp"}), (8.5, {"horizon": 40}), (8.8, {"solver": "core"}))


def test_a_solver_beside_the_law_in_c_is_refused() -> None:
    with pytest.raises(InputError, match="solver"):
        quadsim.load("robust", COMPILED | {"controller.solver": "piqp"})


@pytest.mark.parametrize("order", [(PYTHON, COMPILED), (COMPILED, PYTHON)])
def test_one_law_takes_over_from_the_other(order: tuple[dict[str, object], dict[str, object]]) -> None:
    """Heavier than its model and with rotors that lag, the vehicle is not where a law that forgets would have it."""
    late = {"computation.delay": 0.06, "controller.delay": 0.06, "duration": 6.0, "actual.mass": 4.4}
    first, then = order
    fields = {name.removeprefix("controller."): value for name, value in then.items()}
    fields |= {"solver": "core"}
    event = {"type": "controller", "at": 3.0, "fields": fields}
    switched = quadsim.fly(quadsim.load("robust-lag50", late | first | {"events": [event]}), progress=False)
    stayed = quadsim.fly(
        quadsim.load("robust-lag50", late | first | {"events": [event | {"fields": {"horizon": 50}}]}), progress=False
    )
    assert np.abs(switched.log.control.speeds - stayed.log.control.speeds).max() <= 1e-5
    assert np.ptp(stayed.log.control.speeds) > 5.0


@pytest.mark.parametrize("delay", [0.06, 0.12])
def test_a_compiled_law_predicts_through_the_commands_under_way(delay: float) -> None:
    """The vehicle is heavier than its model and its rotors lag, so the observer learns through the delay too."""
    late = {"computation.delay": delay, "controller.delay": delay, "duration": 4.0}
    scenario = quadsim.load("robust-lag50", late).replace({"actual.mass": 4.4})
    python, c = both(scenario)
    assert c.summary["controller"]["statuses"] == python.summary["controller"]["statuses"]
    assert np.abs(c.log.control.speeds - python.log.control.speeds).max() <= 1e-5
    assert np.ptp(c.log.control.speeds) > 5.0
    law = exported_law(scenario)
    mpc = CompiledPreparation(law)
    assert mpc._memory.size == CController(law=law, asked=mpc._shared.problem.struct.room - 1).reals


MOVING = {"x": 10.0, "y": 10.0, "z": 100.0, "yaw": 100.0, "vx": 5.0, "vy": 6.0, "vz": 7.0, "yaw_rate": 8.0}
WEIGHTED = {
    "places": {},
    "velocities": {"controller.output_weights": MOVING},
    "velocities, along the heading": {"controller.output_weights": MOVING, "controller.heading": True},
    "velocities over two periods": {"controller.output_weights": MOVING, "controller.horizon": 2, "delay": 0.08},
}


@pytest.mark.parametrize("weighted", WEIGHTED)
def test_both_preparations_pose_the_same_queries_and_remember_the_same(weighted: str) -> None:
    """In the air, on the ground and up again, through commands under way, a pause and states that are predicted."""
    changes = dict(WEIGHTED[weighted])
    delay = changes.pop("delay", 0.12)
    late = {"controller.delay": delay, "computation.delay": delay}
    scenario = quadsim.load("robust-lag50", late | changes)
    law = exported_law(scenario)
    assert law.settings is not None
    twins = RobustPreparation(law.vehicle, law.problem, law.settings), CompiledPreparation(law)
    rng, time = np.random.default_rng(3), 0.0
    hover, period = law.problem.model.u_bar, law.problem.model.period
    unseen = np.zeros(N_STATES)
    unseen[INDEX["vz"]] = 1.0
    for twin in twins:
        twin.reset(hover)
        twin.adopt(None, np.array([0.1, -0.2, 0.3, 0.01, 0.02, -0.03]))
    for k in range(40):
        time += 3.0 * period if k == 30 else period
        phase = Phase.LANDED if k in (10, 11) else Phase.ARMED if k == 12 else Phase.FLYING
        now = StepInputs(time=time, phase=phase, unseen=unseen if k in (20, 21) else None)
        state, acting = 0.1 * rng.standard_normal(N_STATES), hover + rng.uniform(-5.0, 5.0, 4)
        reference = np.cumsum(0.05 * rng.standard_normal((law.problem.horizon, 4)), axis=0)
        reference[:, 3] = wrapped(reference[:, 3] + 3.1)  # across the half turn
        if phase is Phase.LANDED:
            for twin in twins:
                twin.stand(now, acting)
        else:
            python, c = (twin.prepare(now, state, reference, acting) for twin in twins)
            assert python is not None
            assert python.equilibrium is not None
            assert c is not None
            assert c.equilibrium is not None
            assert c.state == pytest.approx(python.state, abs=1e-11)
            assert c.desired == pytest.approx(python.desired, abs=1e-11)
            assert c.equilibrium.u == pytest.approx(python.equilibrium.u, abs=1e-9)
            there = [INDEX["roll"], INDEX["pitch"], *range(N_STATES, 16)]  # the place of rest is any
            assert c.equilibrium.x[there] == pytest.approx(python.equilibrium.x[there], abs=1e-9)
        expected, remembered = (twin.memory for twin in twins)
        assert expected is not None
        assert remembered is not None
        assert (remembered.ahead is None) == (expected.ahead is None)
        for name in ("rotors", "turning", "estimate", "ahead"):
            value = getattr(expected, name)
            assert value is None or getattr(remembered, name) == pytest.approx(value, abs=1e-11)
        assert np.array(remembered.sent) == pytest.approx(np.array(expected.sent[-len(remembered.sent) :]))
        assert twins[1].disturbance == pytest.approx(twins[0].disturbance, abs=1e-9)


@pytest.fixture(params=["paper-constrained", "robust"])
def mpc(request: pytest.FixtureRequest) -> LinearMPC:
    return law_in_c(request.param)


def law_in_c(name: str) -> LinearMPC:
    preparation = CompiledPreparation(exported_law(quadsim.load(name)))
    return LinearMPC(preparation, CompiledSolver(preparation), name=name)


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
    many = [law_in_c(mpc.name) for _ in alone]
    together = [[ask(each, k, states(8, seed)[k]).plan for seed, each in enumerate(many)] for k in range(8)]
    assert np.array_equal(np.swapaxes(together, 0, 1), alone)


def test_the_answerer_is_reported(mpc: LinearMPC) -> None:
    hover = mpc.problem.model.u_bar
    at_rest, target = np.zeros(N_STATES), np.zeros((mpc.horizon, 4))
    free = mpc.step(StepInputs(time=0.0, phase=Phase.FLYING), at_rest, target)
    assert (free.status, free.answered_by, free.stats.active) == ("unconstrained", GAIN, 0)
    assert free.speeds == pytest.approx(hover)
    far = ask(mpc, 1, at_rest)
    assert (far.status, far.answered_by, far.fallback) == ("solved", CORE, 0)
    assert far.stats.active > 0


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, 1e300])
def test_numbers_out_of_hand_are_refused_with_the_command_in_force(mpc: LinearMPC, wrong: float) -> None:
    hover, state = mpc.problem.model.u_bar, np.zeros(N_STATES)
    for name in INDEX:
        broken = state.copy()
        broken[INDEX[name]] = wrong
        mpc.reset(hover)
        result = ask(mpc, 0, broken)
        assert result.answered_by == FALLBACK
        assert np.array_equal(result.plan, np.tile(hover, (mpc.horizon, 1)))
    assert ask(mpc, 1, state, hover).answered_by != FALLBACK


def test_a_disturbance_is_learned_in_flight_alone_and_from_what_is_measured() -> None:
    law, predicted = exported_law(quadsim.load("robust")), np.zeros(N_STATES)
    predicted[INDEX["vz"]] = 1.0
    for phase, unseen, learned in (
        (Phase.FLYING, np.zeros(N_STATES), True),
        (Phase.ARMED, None, False),
        (Phase.FLYING, predicted, False),
    ):
        preparation = CompiledPreparation(law)
        mpc = LinearMPC(preparation, CompiledSolver(preparation), name="robust")
        for k in range(3):
            falling = np.zeros(N_STATES)
            falling[INDEX["vz"]] = -0.1 * k
            now = StepInputs(time=k * law.problem.model.period, phase=phase, unseen=unseen)
            mpc.step(now, falling, np.zeros((mpc.horizon, 4)))
        assert mpc.trim is not None
        assert (mpc.trim.speeds.mean() > mpc.problem.model.u_bar.mean() + 1.0) == learned


def test_the_largest_violation_of_a_soft_bound_is_reported_on_either_side() -> None:
    """Tilted by 0.2 rad where 0.087 are allowed, it takes more than a period to come back."""
    preparation, slacks = CompiledPreparation(exported_law(quadsim.load("robust"))), []
    mpc = LinearMPC(preparation, CompiledSolver(preparation), name="robust")
    for side in (-1.0, 1.0):
        mpc.reset(mpc.problem.model.u_bar)
        tilted = np.zeros(N_STATES)
        tilted[INDEX["roll"]] = 0.2 * side
        command = mpc.step(StepInputs(time=0.0, phase=Phase.FLYING), tilted, np.zeros((mpc.horizon, 4)))
        slacks.append(command.stats.slack)
    assert slacks[0] == pytest.approx(slacks[1], rel=1e-6)
    assert 0.08 < slacks[0] < 0.2 - np.radians(5.0) + 0.01


def test_equal_laws_share_their_numbers() -> None:
    law = exported_law(quadsim.load("robust"))
    first, again = CompiledPreparation(law), CompiledPreparation(exported_law(quadsim.load("robust")))
    other = CompiledPreparation(replace(law, vehicle=replace(law.vehicle, mass=0.9 * law.vehicle.mass)))
    assert first._shared is again._shared
    assert first._shared is not other._shared


def test_the_struct_has_all_numbers_in_place() -> None:
    law = exported_law(quadsim.load("robust-lag50"))
    mpc = CompiledPreparation(law)
    for name, value in robust_numbers(law, mpc._shared.problem.tables.modes).items():
        assert np.array_equal(np.ravel(value), np.ravel(getattr(mpc._shared.robust, name)))


def test_copying_is_refused(mpc: LinearMPC) -> None:
    with pytest.raises(TypeError, match="pickled"):
        copy.deepcopy(mpc)


def test_unexportable_controllers_cannot_be_compiled() -> None:
    with pytest.raises(ExportError, match="obstacles"):
        quadsim.fly(quadsim.load("pillar", COMPILED), progress=False)
