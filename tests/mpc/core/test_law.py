"""`controller.compiled`: the library's law flies in place of Python's step."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

import quadsim
from mpc.codegen.source import CController
from mpc.core.law import CompiledMPC
from mpc.core.numbers import robust_numbers
from quadsim.controller import CORE, FALLBACK, GAIN, Command, Phase, StepInputs
from quadsim.errors import ExportError
from quadsim.state import INDEX, N_STATES, Array
from scenarios.export.exporter import exported_law

COMPILED = {"controller.compiled": True}
FLIGHTS = (
    *("paper-constrained", "paper-unconstrained", "robust", "robust-lag50", "crazyflie-steps", "figure-eight"),
    *("take-off-and-landing", "motion-capture"),
)


@pytest.mark.slow("core")
@pytest.mark.parametrize(
    ("name", "changes"),
    [
        pytest.param(FLIGHTS[0], {"duration": 10.0}, marks=pytest.mark.witness("core")),
        *[(name, {}) for name in FLIGHTS],
    ],
)
def test_a_compiled_flight_is_the_flight(name: str, changes: dict[str, float]) -> None:
    scenario = quadsim.load(name, changes)
    by_python = scenario if name == "paper-unconstrained" else scenario.replace({"controller.solver": "core"})
    python, c = (quadsim.fly(each, progress=False) for each in (by_python, scenario.replace(COMPILED)))
    assert c.summary["controller"]["solver"] == "compiled"
    assert c.satisfied == python.satisfied
    for key in ("statuses", "fallbacks"):
        assert c.summary["controller"][key] == python.summary["controller"][key]
    # what the exact optima differ by, and what a flight of a minute makes of that
    assert np.abs(c.log.control.speeds - python.log.control.speeds).max() <= 1e-5
    assert c.log.control.active.sum() == pytest.approx(python.log.control.active.sum(), rel=0.05)
    assert c.log.control.slack == pytest.approx(python.log.control.slack, abs=1e-6)


@pytest.mark.parametrize("delay", [0.06, 0.12])
def test_a_compiled_law_predicts_through_the_commands_under_way(delay: float) -> None:
    """The vehicle is heavier than its model and its rotors lag, so the observer learns through the delay too."""
    late = {"computation.delay": delay, "controller.delay": delay, "duration": 4.0}
    scenario = quadsim.load("robust-lag50", late).replace({"actual.mass": 4.4})
    python, c = (
        quadsim.fly(scenario.replace(law), progress=False) for law in ({"controller.solver": "core"}, COMPILED)
    )
    assert c.summary["controller"]["statuses"] == python.summary["controller"]["statuses"]
    assert np.abs(c.log.control.speeds - python.log.control.speeds).max() <= 1e-5
    assert np.ptp(c.log.control.speeds) > 5.0
    law = exported_law(scenario)
    mpc = CompiledMPC(law)
    assert mpc._memory.size == CController(law=law, asked=mpc._shared.problem.struct.room - 1).reals


def test_without_an_optimum_it_answers_as_on_the_target() -> None:
    flight = quadsim.fly(quadsim.load("paper-constrained-lag20", COMPILED), progress=False)
    assert {"clipped", "shifted"} & set(flight.summary["controller"]["statuses"])
    assert max(flight.log.control.fallback) >= 1


@pytest.fixture(params=["paper-constrained", "robust"])
def mpc(request: pytest.FixtureRequest) -> CompiledMPC:
    return CompiledMPC(exported_law(quadsim.load(request.param)))


def ask(mpc: CompiledMPC, k: int, state: Array, speeds: Array | None = None) -> Command:
    """Its answer in period k with a reference 1 m to the side."""
    reference = np.tile([1.0, 0.0, 0.0, 0.0], (mpc.horizon, 1))
    return mpc.step(StepInputs(time=k * mpc.problem.model.period, phase=Phase.FLYING, acting=speeds), state, reference)


def states(count: int, seed: int) -> Array:
    return 0.02 * np.random.default_rng(seed).standard_normal((count, N_STATES))


def answers(mpc: CompiledMPC, seed: int) -> list[Array]:
    mpc.reset(mpc.problem.model.u_bar)
    return [ask(mpc, k, state).plan for k, state in enumerate(states(8, seed))]


def test_a_reset_forgets_all(mpc: CompiledMPC) -> None:
    first = answers(mpc, seed=1)
    answers(mpc, seed=2)
    assert np.array_equal(answers(mpc, seed=1), first)


def test_controllers_share_no_mutable_state(mpc: CompiledMPC) -> None:
    alone = [answers(mpc, seed) for seed in range(5)]
    law = exported_law(quadsim.load(mpc.name.replace("constrained", "paper-constrained")))
    many = [CompiledMPC(law) for _ in alone]
    together = [[ask(each, k, states(8, seed)[k]).plan for seed, each in enumerate(many)] for k in range(8)]
    assert np.array_equal(np.swapaxes(together, 0, 1), alone)


def test_the_answerer_is_reported(mpc: CompiledMPC) -> None:
    hover = mpc.problem.model.u_bar
    at_rest, target = np.zeros(N_STATES), np.zeros((mpc.horizon, 4))
    free = mpc.step(StepInputs(time=0.0, phase=Phase.FLYING), at_rest, target)
    assert (free.status, free.answered_by, free.stats.active) == ("unconstrained", GAIN, 0)
    assert free.speeds == pytest.approx(hover)
    far = ask(mpc, 1, at_rest)
    assert (far.status, far.answered_by, far.fallback) == ("solved", CORE, 0)
    assert far.stats.active > 0


def test_without_an_optimum_the_last_plan_is_flown_to_its_end() -> None:
    # a row of states and inputs, with which there is no optimum axis by axis
    mixed = {"name": "mixed", "of": ["roll", "speed_1"], "rows": [[1.0, 1.0]], "upper": [1e4]}
    scenario = quadsim.load("paper-constrained", {"controller.horizon": 10, "controller.polytopes": [mixed]})
    mpc = CompiledMPC(exported_law(scenario))
    planned, tumbled = ask(mpc, 0, np.zeros(N_STATES)), np.zeros(N_STATES)
    tumbled[INDEX["roll"]] = 1.0  # beyond a hard bound
    for k in range(1, 10):
        result = ask(mpc, k, tumbled)
        assert (result.status, result.answered_by, result.fallback) == ("shifted", FALLBACK, 2)
        assert result.speeds == pytest.approx(planned.plan[k], abs=1e-9)
    after = ask(mpc, 10, tumbled)
    assert (after.status, after.fallback) == ("before", 3)
    assert np.array_equal(after.speeds, result.speeds)
    assert ask(mpc, 11, np.zeros(N_STATES)).fallback == 0
    mpc.reset(planned.speeds)
    assert ask(mpc, 0, tumbled).status == "before"


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, 1e300])
def test_numbers_out_of_hand_are_answered_with_the_command_in_force(mpc: CompiledMPC, wrong: float) -> None:
    hover, state = mpc.problem.model.u_bar, np.zeros(N_STATES)
    for name in INDEX:
        broken = state.copy()
        broken[INDEX[name]] = wrong
        mpc.reset(hover)
        result = ask(mpc, 0, broken)
        assert result.fallback >= 1
        assert np.isfinite(result.speeds).all()
        assert np.isfinite(result.plan).all()
    mpc.reset(hover)
    result = ask(mpc, 0, state, np.array([wrong, *hover[1:]]))
    assert np.isfinite(result.speeds).all()
    if not np.isfinite(wrong):
        assert result.status == "before"
        assert np.array_equal(result.speeds, hover)
    assert ask(mpc, 1, state, hover).fallback == 0


def test_a_disturbance_is_learned_in_flight_alone_and_from_what_is_measured() -> None:
    law, predicted = exported_law(quadsim.load("robust")), np.zeros(N_STATES)
    predicted[INDEX["vz"]] = 1.0
    for phase, unseen, learned in (
        (Phase.FLYING, np.zeros(N_STATES), True),
        (Phase.ARMED, None, False),
        (Phase.FLYING, predicted, False),
    ):
        mpc = CompiledMPC(law)
        for k in range(3):
            falling = np.zeros(N_STATES)
            falling[INDEX["vz"]] = -0.1 * k
            now = StepInputs(time=k * law.problem.model.period, phase=phase, unseen=unseen)
            mpc.step(now, falling, np.zeros((mpc.horizon, 4)))
        assert (mpc.trim.speeds.mean() > mpc.problem.model.u_bar.mean() + 1.0) == learned


def test_the_largest_violation_of_a_soft_bound_is_reported_on_either_side() -> None:
    """Tilted by 0.2 rad where 0.087 are allowed, it takes more than a period to come back."""
    mpc, slacks = CompiledMPC(exported_law(quadsim.load("robust"))), []
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
    first, again = CompiledMPC(law), CompiledMPC(exported_law(quadsim.load("robust")))
    other = CompiledMPC(replace(law, vehicle=replace(law.vehicle, mass=0.9 * law.vehicle.mass)))
    assert first._shared is again._shared
    assert first._shared is not other._shared


def test_the_struct_has_all_numbers_in_place() -> None:
    law = exported_law(quadsim.load("robust-lag50"))
    mpc = CompiledMPC(law)
    for name, value in robust_numbers(law, mpc._shared.problem.tables.modes).items():
        assert np.array_equal(np.ravel(value), np.ravel(getattr(mpc._shared._robust, name)))


def test_copying_is_refused(mpc: CompiledMPC) -> None:
    with pytest.raises(TypeError, match="cannot be copied or pickled"):
        copy.deepcopy(mpc)


def test_unexportable_controllers_cannot_be_compiled() -> None:
    with pytest.raises(ExportError, match="half-spaces around obstacles"):
        quadsim.fly(quadsim.load("pillar", COMPILED), progress=False)
