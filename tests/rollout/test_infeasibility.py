"""Infeasible QPs and unstable loops: what is to blame is named, by the right amount, and what is suggested helps."""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import constrained_mpc, fly_here

import quadsim
from quadsim import mpc
from quadsim.controller import ACCEPTED, Command, Controller, StepInputs
from quadsim.errors import PlanExhaustedError
from quadsim.mpc.laws.parts.nonlinear_mpc import CONVERGED
from quadsim.mpc.problem.ocp import InfeasiblePeriod
from quadsim.report.flight_sentences import failure_sentences
from quadsim.rollout import infeasibility, remedies
from quadsim.rollout.flown import Flight
from quadsim.rollout.growth import SHORT_PAIR, Growth
from quadsim.rollout.infeasibility import diagnose
from quadsim.rollout.rollout import Rollout
from quadsim.rollout.stability import measure_growth
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.catalogue import FLIGHTS
from quadsim.scenarios.loading import load_scenario, parse_scenario
from quadsim.scenarios.mismatch import unmodelled
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.scenarios.schema.settings import get_field
from quadsim.state import INDEX, Array, make_state
from quadsim.vehicle import Vehicle

pytestmark = pytest.mark.slow("diagnosis")

AUDIT_PAGE = Path(__file__).resolve().parents[2] / "docs" / "audit.md"
"""It shows what diagnoses of these tests say."""
TILTED = make_state(euler=(math.radians(20.0), 0.0, 0.0))
FENCE = '{ name = "fence", of = ["x", "y"], rows = [[1.0, 1.0]], upper = [6.8] }'
LEAST = '{ name = "least", of = ["speed_1", "speed_2", "speed_3", "speed_4"], rows = [[1, 1, 1, 1]], lower = [780] }'
MOST = '{ name = "most", of = ["speed_1", "speed_2", "speed_3", "speed_4"], rows = [[1, 1, 1, 1]], upper = [760] }'


def moving(name: str, value: float, **place: Any) -> Array:
    """A state (12,) with a value of one of its channels."""
    state = make_state(**place)
    state[INDEX[name]] = value
    return state


@dataclass(frozen=True, kw_only=True)
class Case:
    """A conflict.

    Attributes:
        settings: those of the scenario.
        state: the state (12,) at which the controller is called.
        acting: the speed of all rotors that acts then [rad/s]; None: hover.
        violated: the bounds that give way.
        blocking: bounds that must be named as what they give way to.
        field: of the controller, that a suggestion must change.
    """

    settings: tuple[str, ...] = ()
    state: Array = field(default_factory=lambda: make_state())
    acting: float | None = None
    violated: tuple[str, ...] = ()
    blocking: tuple[str, ...] = ()
    field: str = ""


HORIZON = 20
PERIOD = 0.05
CASES = {
    "start beyond the tilt bound": Case(
        state=TILTED, violated=("roll upper",), blocking=("slew lower", "slew upper"), field="output_bounds.roll"
    ),
    "speeds too low to hover": Case(
        settings=("controller.input_bounds.speed=[0.0, 190.0]", "controller.output_bounds.vz=[-0.1, 1.0]"),
        acting=190.0,
        violated=("vz lower",),
        blocking=("speed upper",),
        field="input_bounds.speed",
    ),
    "two polytopes": Case(
        settings=(f"controller.polytopes=[{LEAST}, {MOST}]",),
        violated=("least lower",),
        blocking=("most upper",),
        field="polytopes.least.lower",
    ),
    "falling too fast": Case(
        settings=("controller.output_bounds.vz=[-0.5, 0.5]",),
        state=moving("vz", -2.0),
        violated=("vz lower",),
        blocking=("slew upper",),
        field="output_bounds.vz",
    ),
    "tightened bounds": Case(
        settings=("controller.type=robust", "controller.tightening={}"),
        state=moving("roll_rate", math.radians(9.0), euler=(math.radians(5.5), 0.0, 0.0)),
        violated=("roll upper",),
        blocking=("slew lower", "slew upper"),
        field="output_bounds.roll",
    ),
    "outside the fence": Case(
        settings=(f"controller.polytopes=[{FENCE}]",),
        state=make_state(position=(5.0, 5.0, 0.0)),
        violated=("fence upper",),
        field="polytopes.fence.upper",
    ),
    "the last command outside the bounds": Case(
        acting=290.0, violated=("speed upper",), blocking=("slew lower",), field="input_bounds.slew"
    ),
    "rotors that lag, and a delay": Case(
        settings=("controller.type=robust", "controller.rotor_lag=0.05", "controller.delay=0.02"),
        state=TILTED,
        violated=("roll upper",),
        field="output_bounds.roll",
    ),
    "commands under way": Case(
        settings=("controller.type=robust", "controller.delay=0.12"),
        state=TILTED,
        violated=("roll upper",),
        field="output_bounds.roll",
    ),
}


@dataclass(frozen=True, kw_only=True)
class Queried:
    """A controller after one call, and the diagnosis of that period."""

    scenario: Scenario
    vehicle: Vehicle
    controller: Controller
    status: str
    infeasible_period: InfeasiblePeriod | None

    @cached_property
    def diagnosis(self) -> dict[str, Any]:
        assert self.infeasible_period is not None
        result = diagnose(self.infeasible_period, self.scenario, self.vehicle)
        assert result is not None
        return result


@pytest.fixture(scope="session")
def file(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A file of a hover with a short horizon; it names no solver, so that its controller may be another."""
    text = (FLIGHTS / "hover.toml").read_text(encoding="utf-8")
    short = text.replace("horizon = 50 ", f"horizon = {HORIZON} ")
    assert short != text
    path = tmp_path_factory.mktemp("diagnosis") / "hover.toml"
    path.write_text(short, encoding="utf-8")
    return str(path)


def query_case(file: str, case: Case, *more: str) -> Queried:
    """Have the case's controller step once, without a simulator."""
    scenario = load_scenario(file, [*case.settings, *more])
    vehicle = Assembly(scenario).vehicle
    controller = Assembly(scenario).controller()
    acting = np.full(4, vehicle.hover_speed)
    if case.acting is not None:
        acting[:] = case.acting
    controller.reset(acting)
    try:
        status = controller.step(StepInputs(acting=acting), case.state, np.zeros((controller.horizon, 4))).status
    except PlanExhaustedError:
        status = "plan_exhausted_error"
    return Queried(
        scenario=scenario,
        vehicle=vehicle,
        controller=controller,
        status=status,
        infeasible_period=getattr(controller, "infeasible_period", None),
    )


@cache
def query_cached(file: str, name: str) -> Queried:
    """One of `CASES`, for all tests that only look at the answer."""
    return query_case(file, CASES[name])


def names(entries: list[dict[str, Any]]) -> set[str]:
    """The names of bounds with their sides, as a `Case` has them."""
    return {f"{entry['name']} {entry['side']}" for entry in entries}


def violated(diagnosis: dict[str, Any]) -> list[dict[str, Any]]:
    """The bounds of the conflict that give way."""
    return [entry for entry in diagnosis["conflict"] if entry["by"]]


def blocking(diagnosis: dict[str, Any]) -> list[dict[str, Any]]:
    """The bounds of the conflict that are kept."""
    return [entry for entry in diagnosis["conflict"] if not entry["by"]]


def setting(field: str, value: object) -> str:
    """A field and its value as they are given to `--set`."""
    if isinstance(value, dict):
        entries = ", ".join(f"{name} = {number}" for name, number in value.items())
        return f"{field}={{{entries}}}"
    return f"{field}={json.dumps(value)}"


@pytest.mark.representative("diagnosis")
@pytest.mark.parametrize("name", CASES)
def test_each_culprit_is_named_and_each_suggestion_makes_it_feasible(name: str, file: str) -> None:
    """Each that helps in the period itself; those of a fallback help some periods later."""
    case = CASES[name]
    queried = query_cached(file, name)
    assert queried.status not in ACCEPTED
    result = queried.diagnosis
    assert result["feasible"] is False
    assert names(violated(result)) == set(case.violated)
    assert names(blocking(result)) >= set(case.blocking)
    for bound in (*case.violated, *case.blocking):
        word, side = bound.split()
        assert re.search(rf"\b{word}\b[^;]*\b{side}\b", result["sentence"])
    at_once = [suggestion["settings"] for suggestion in result["suggestions"] if suggestion["after"] is None]
    assert any({*settings} == {f"controller.{case.field}"} for settings in at_once)
    for settings in at_once:
        changed = [setting(path, value) for path, value in settings.items()]
        assert query_case(file, case, *changed).status in ACCEPTED, changed


@pytest.mark.parametrize("noise", [-3e-6, 0.0, 3e-6])
def test_bounds_that_give_way_alike_stand_in_the_order_of_the_file(noise: float, file: str) -> None:
    """As far beyond the bound on roll as on pitch, but for rounding."""
    bound = math.radians(5.0)
    state = make_state(euler=(1.2 * bound, (1.2 + noise) * bound, 0.0))
    first, second = violated(query_case(file, Case(state=state)).diagnosis)
    assert (first["name"], first["side"]) == ("roll", "upper")
    assert (second["name"], second["side"]) == ("pitch", "upper")


@pytest.mark.parametrize("name", CASES)
def test_a_little_less_than_the_smallest_bound_is_not_enough(name: str, file: str) -> None:
    """97 % of the change: the suggestion is rounded up by a hundredth of it at most."""
    case = CASES[name]
    queried = query_cached(file, name)
    stated = tomllib.loads(queried.scenario.to_toml())
    bounds = []
    for suggestion in queried.diagnosis["suggestions"]:
        settings = suggestion["settings"]
        for path, value in settings.items():
            if len(settings) == 1 and isinstance(value, list):
                bounds.append((path, value))
    assert bounds
    for path, new in bounds:
        old = np.array(get_field(stated, path))
        less = old + 0.97 * (np.array(new) - old)
        assert query_case(file, case, setting(path, less.tolist())).status not in ACCEPTED


def entry_of(queried: Queried, name: str) -> dict[str, Any]:
    """The violated bound of a name."""
    (entry,) = [entry for entry in violated(queried.diagnosis) if entry["name"] == name]
    return entry


@pytest.fixture
def model(file: str) -> mpc.LinearModel:
    """The model of all cases but those with lag or delay."""
    queried = query_cached(file, "start beyond the tilt bound")
    assert queried.infeasible_period is not None
    return queried.infeasible_period.problem.model


def test_a_tilt_is_beyond_its_bound_by_what_one_step_of_the_rotors_leaves(file: str, model: mpc.LinearModel) -> None:
    """The bounds on steps are -10 and 5 rad/s."""
    of_roll = model.B[INDEX["roll"]]
    steps = np.where(of_roll > 0.0, -10.0, 5.0)
    after_a_period = 20.0 + math.degrees(float(steps @ of_roll))  # at least [deg]
    entry = entry_of(query_cached(file, "start beyond the tilt bound"), "roll")
    assert entry["by"] == pytest.approx(after_a_period - 5.0, abs=1e-6)
    assert (entry["start"], entry["unit"]) == (PERIOD, "deg")
    delayed = entry_of(query_cached(file, "rotors that lag, and a delay"), "roll")
    assert delayed["start"] == 0.07  # delay and period


def test_a_fall_is_beyond_its_bound_while_the_rotors_speed_up(file: str, model: mpc.LinearModel) -> None:
    """By at most 5 rad/s in a period."""
    lift = float(model.B[INDEX["vz"]].sum())  # of vz in a period, per rad/s of all rotors
    velocity = -2.0 + lift * np.cumsum(5.0 * np.arange(1, HORIZON + 1))
    entry = entry_of(query_cached(file, "falling too fast"), "vz")
    assert entry["by"] == pytest.approx(-0.5 - velocity[0], abs=1e-6)
    assert entry["start"] == PERIOD
    assert entry["stop"] == pytest.approx(PERIOD * np.count_nonzero(velocity < -0.5))


def test_sinking_at_a_bounded_speed_is_beyond_its_bound_in_the_end(file: str, model: mpc.LinearModel) -> None:
    """190 rad/s at most, where hover needs more: the velocity falls from 0 in equal steps."""
    lift = float(model.B[INDEX["vz"]].sum())
    velocity = lift * (190.0 - float(model.u_bar[0])) * np.arange(1, HORIZON + 1)
    entry = entry_of(query_cached(file, "speeds too low to hover"), "vz")
    assert entry["by"] == pytest.approx(-0.1 - velocity[-1], abs=1e-6)
    assert entry["start"] == pytest.approx(PERIOD * (1 + np.count_nonzero(velocity >= -0.1)))
    assert entry["stop"] == PERIOD * HORIZON


def test_a_command_is_beyond_its_bound_until_its_steps_bring_it_back(file: str) -> None:
    """From 290 to 250 rad/s in steps of 10, the first in the period itself: by 30 at first, by 10 in the last one."""
    entry = entry_of(query_cached(file, "the last command outside the bounds"), "speed")
    assert (entry["by"], entry["start"], entry["stop"]) == (pytest.approx(30.0), 0.0, 0.1)
    assert entry["rotors"] == [1, 2, 3, 4]


def test_the_fallback_is_suggested_with_the_time_after_which_it_helps(file: str, model: mpc.LinearModel) -> None:
    """The controller with its fallback flies the model from there until it accepts an optimum again."""
    case = CASES["start beyond the tilt bound"]
    queried = query_case(file, case)
    suggestions = queried.diagnosis["suggestions"]
    (suggested,) = [suggestion for suggestion in suggestions if "controller.fallback" in suggestion["settings"]]
    guarded = query_case(file, case, "controller.fallback={}").controller
    assert guarded.guard is not None
    state = case.state
    acting = np.full(4, queried.vehicle.hover_speed)
    guarded.reset(acting)
    for k in range(50):
        command = guarded.step(StepInputs(time=PERIOD * k, acting=acting), state, np.zeros((HORIZON, 4)))
        if command.status in ACCEPTED:
            break
        state = model.A @ state + model.B @ (command.speeds - model.u_bar)
        acting = command.speeds
    assert command.status in ACCEPTED
    assert k > 0
    assert suggested["after"] == pytest.approx(PERIOD * k)


def test_a_solver_that_fails_where_all_constraints_can_hold_is_distinguished(file: str) -> None:
    """Made from an infeasible period, whose state is replaced by level hover."""
    queried = query_case(file, CASES["start beyond the tilt bound"], "controller.output_bounds.roll=[-90.0, 90.0]")
    assert queried.infeasible_period is None
    period = query_cached(file, "start beyond the tilt bound").infeasible_period
    assert period is not None
    level = period.query._replace(state=make_state())
    failed = InfeasiblePeriod(problem=period.problem, query=level, status="max_iterations", time=1.0)
    result = diagnose(failed, queried.scenario, queried.vehicle)
    assert result is not None
    assert result["feasible"]
    assert (result["conflict"], result["suggestions"], result["advice"]) == ([], [], "")


def test_a_flight_whose_sqp_does_not_converge_says_so_and_what_helps() -> None:
    """Upside down: every QP is solved, but the plans do not follow the dynamics, and the vehicle tumbles."""
    changes = {
        "initial.euler": [180.0, 0.0, 0.0],
        "lost.tilt": False,
        "control_period": 0.02,
        "controller.horizon": 40,
        "duration": 1.5,
    }
    tumble = quadsim.load("nonlinear", changes)
    flight = quadsim.fly(tumble)
    summary = flight.summary
    assert summary["controller"]["statuses"] == {"not_converged": 75}
    assert summary["controller"]["fallbacks"] == {"0": 75}
    assert flight.log.control.sqp is not None
    assert flight.log.control.sqp[:, 0].min() > CONVERGED
    result = flight.diagnosis
    assert result is not None
    assert (result["time"], result["status"]) == (0.0, "not_converged")
    assert result["feasible"]
    assert result["conflict"] == []
    text = AUDIT_PAGE.read_text(encoding="utf-8")
    assert f"{result['sentence']}\n{result['advice']}\n" in text
    helped = quadsim.fly(tumble.replace(result["suggestions"][0]["settings"]))
    assert helped.summary["controller"]["statuses"].get("not_converged", 0) == 0
    last = slice(-20, None)  # one sample of a tumble may be level
    assert np.abs(helped.state["roll"][last]).max() < 0.1
    assert np.abs(flight.state["roll"][last]).max() > 0.1


def test_a_satisfied_flight_is_not_diagnosed_for_a_period_that_did_not_converge(
    fly_once: Callable[..., Flight],
) -> None:
    flight = fly_once("inverted-start")
    assert 0 < flight.log.control.status.count("not_converged") < 20
    assert flight.outcome == "satisfied"
    assert flight.diagnosis is None


class OwnMPC:
    """A controller of the user: the constrained one whose only bound is on roll, with the period it could not solve.

    Args:
        vehicle: what it flies.
        period: control period [s].
        horizon: N.
        largest: bound on roll [deg].
    """

    def __init__(self, vehicle: Vehicle, period: float, horizon: int, largest: float = 2.0) -> None:
        law = load_scenario("paper-constrained").controller.law(vehicle, period)
        assert isinstance(law, mpc.LinearMPC)
        roll = mpc.Bounds(
            C_c=np.eye(12)[[INDEX["roll"]]],
            y_min=np.radians([-largest]),
            y_max=np.radians([largest]),
            delta_min=np.full(4, -10.0),
            delta_max=np.full(4, 5.0),
            u_min=np.zeros(4),
            u_max=np.full(4, 250.0),
        )
        self.problem = replace(law.problem, horizon=horizon, bounds=roll)
        self.inner = constrained_mpc(self.problem)
        self.infeasible_period: InfeasiblePeriod | None = None

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        try:
            return self.inner.step(now, state, reference)
        finally:
            self.infeasible_period = self.inner.infeasible_period


def test_a_controller_of_the_user_is_diagnosed_in_the_words_of_its_problem() -> None:
    tilted = load_scenario("hover", ["duration=0.5", "initial.euler=[10.0, 0.0, 0.0]"])
    flight = quadsim.fly(tilted, controller=OwnMPC)
    result = flight.diagnosis
    assert result is not None
    entry = result["conflict"][0]
    assert (entry["name"], entry["side"], entry["unit"]) == ("roll", "upper", "deg")
    assert (entry["field"], entry["rotors"], entry["start"]) == ("", [], 0.05)
    assert re.search(r"roll upper .*\d deg", result["advice"])
    enough = quadsim.fly(tilted, controller=partial(OwnMPC, largest=12.0))
    assert enough.diagnosis is None


# --- advice is flown before it is given ------------------------------------------------------------------------------


@cache
def lagging() -> Flight:
    """A hard bound on pitch, and rotors with a lag that the prediction lacks."""
    return quadsim.fly(quadsim.load("paper-constrained-lag20"), progress=False)


def flown_with(flight: Flight, settings: dict[str, Any], until: float) -> Flight:
    """Fly a flight's scenario with a change, without the code under test."""
    data = tomllib.loads(flight.scenario.to_toml())
    if "controller.type" in settings:
        data["controller"].pop("solver", None)  # which a robust controller does not have
    for path, value in settings.items():
        *tables, name = path.split(".")
        holder = data
        for table in tables:
            holder = holder[table]
        holder[name] = value
    data |= {"duration": until, "expect": "satisfied"}
    return quadsim.fly(parse_scenario(data), progress=False)


def test_what_is_advised_keeps_the_flight_and_what_is_not_would_not_have() -> None:
    """Each of them gives the period an answer, but those that do not state the lag give later periods none."""
    flight = lagging()
    result = flight.diagnosis
    assert result is not None
    assert flight.outcome == "lost"
    until = round(result["time"] + remedies.AFTER, 9)
    (helping,) = result["suggestions"]
    assert helping["settings"] == {"controller.type": "robust", "controller.soft": {}, "controller.rotor_lag": 0.02}
    helped = flown_with(flight, helping["settings"], until)
    assert (helped.outcome, helped.infeasible_period) == ("incomplete", None)  # it holds the windows that it reaches
    refused = {next(iter(change["settings"])) for change in result["rejected"]}
    assert {"controller.output_bounds.pitch", "controller.input_bounds.slew"} <= refused
    for change in result["rejected"]:
        if not change["settings"].keys() & {"controller.type", "controller.fallback"}:
            failed = flown_with(flight, change["settings"], until)
            assert failed.outcome == "lost"
            assert change["why"] == f"lost at t = {failed.time.size * 0.05:.4g} s"
    assert f" {until:.4g} s: controller.type = " in result["advice"]
    text = AUDIT_PAGE.read_text(encoding="utf-8")
    assert f"{result['sentence']}\n{result['advice']}\n" in text


@pytest.mark.parametrize(("speed", "note"), [([0.0, 150.0], "150"), ([200.0, 250.0], "at least 200")])
def test_a_bound_that_excludes_hover_is_named_first_and_moved_past_hover(speed: list[float], note: str) -> None:
    """The smallest bound with which the QP has an answer is 183 rad/s, but the vehicle hovers at 192.8."""
    bounded = quadsim.load("hover").replace({"controller.input_bounds.speed": speed, "constraints": []})
    (first,) = quadsim.feasibility(bounded).notes
    assert "192.8 rad/s" in first
    assert note in first
    result = quadsim.fly(bounded, progress=False).diagnosis
    assert result is not None
    assert result["sentence"].startswith(first)
    (change,) = result["suggestions"]
    lower, upper = change["settings"]["controller.input_bounds.speed"]
    assert lower < 192.8 < upper
    helped = quadsim.fly(bounded.replace(change["settings"]), progress=False)
    assert helped.outcome == "satisfied"
    assert np.abs(helped.state["z"] - helped.reference["z"]).max() < 1e-6


def test_a_bound_that_excludes_hover_is_noted_in_the_log_of_a_run(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bounds = {"speed": [0.0, 150.0], "slew": [-10.0, 10.0]}
    scenario = quadsim.load("hover", {"controller": {"type": "pid", "input_bounds": bounds}, "duration": 0.1})
    with caplog.at_level("INFO", logger="quadsim"):
        quadsim.run(scenario, out=tmp_path / "run", progress=False, video=False, recording=False, figures=False)
    assert [note for note in caplog.messages if "192.8 rad/s" in note and "150" in note]


def test_advice_for_a_start_beyond_a_bound_says_that_the_flight_violates_it(file: str) -> None:
    tilted = load_scenario(file, ["initial.euler=[10.0, 0.0, 0.0]", "duration=3.0"])
    result = quadsim.fly(tilted, progress=False).diagnosis
    assert result is not None
    assert result["suggestions"]
    for change in result["suggestions"]:
        assert "roll" in change["violated"]


def test_the_flights_of_a_diagnosis_are_not_diagnosed_and_are_few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two flights of a scenario have the same diagnosis, each made once."""
    diagnosed = 0
    flown_until: list[float | None] = []
    diagnose_period = infeasibility.diagnose
    fly = Rollout.fly

    def counted(*arguments: Any) -> dict[str, Any] | None:
        nonlocal diagnosed
        diagnosed += 1
        return diagnose_period(*arguments)

    def noted(rollout: Rollout, *arguments: Any, **options: Any) -> Flight:
        flown_until.append(options.get("until"))
        return fly(rollout, *arguments, **options)

    tilted = quadsim.load("hover").replace({"duration": 0.4, "initial.euler": [20.0, 0.0, 0.0]})
    first = quadsim.fly(tilted, progress=False)
    second = quadsim.fly(tilted, progress=False)
    monkeypatch.setattr(infeasibility, "diagnose", counted)
    monkeypatch.setattr(Rollout, "fly", noted)
    diagnosis = json.dumps(first.diagnosis)
    assert json.dumps(first.summary["diagnosis"]) == diagnosis
    assert json.dumps(second.diagnosis) == diagnosis
    assert diagnosed == 2
    assert set(flown_until) == {0.4}
    assert 2 <= len(flown_until) <= 2 * remedies.MOST_FLOWN


def test_nobody_but_the_summary_of_one_flight_pays_for_advice(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Numbers, pictures and sweeps do not; Ctrl-C in the flights of the advice loses the advice alone."""
    changes = {"duration": 0.4, "initial.euler": [20.0, 0.0, 0.0], "controller.fallback": {}}
    tilted = quadsim.load("hover", changes)
    advised = 0

    def interrupted(*_: object) -> None:
        nonlocal advised
        advised += 1
        raise KeyboardInterrupt

    monkeypatch.setattr(remedies, "tried", interrupted)
    flight = quadsim.fly(tilted, progress=False)
    assert flight.metrics["speed_max"] > 0.0
    assert flight.small_plot() is not None
    assert flight._repr_html_()
    fly_here(monkeypatch)
    sweep = quadsim.sweep(tilted, {"vehicle.mass": [4.0, 4.1]}, progress=False)
    assert len(sweep.table) == 2
    assert advised == 0
    _, products_may_follow = flight.write_tables(tmp_path / "run")
    assert not products_may_follow
    assert advised == 1
    read = quadsim.read(tmp_path / "run")
    assert read.diagnosis is not None
    assert read.diagnosis["sentence"]


def test_advice_that_cannot_be_tried_in_flight_is_marked_as_not_flown(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a force of the caller's, a controller that changes on the way, or a period too late in the flight."""
    tilted = quadsim.load("hover").replace({"duration": 0.2, "initial.euler": [20.0, 0.0, 0.0]})
    pushed = quadsim.fly(tilted, forces=[lambda time, state: np.zeros(6)], progress=False)
    assert pushed.diagnosis is not None
    assert "not flown" in pushed.diagnosis["advice"]
    event = {"type": "controller", "at": 0.0, "fields": {"output_bounds.roll": [-4.0, 4.0]}}
    changed = quadsim.fly(tilted.replace({"events": [event]}), progress=False)
    assert changed.diagnosis is not None
    assert "not flown" in changed.diagnosis["advice"]
    monkeypatch.setattr(remedies, "LONGEST_TRIAL", 0.1)
    late = quadsim.fly(tilted, progress=False).diagnosis
    assert late is not None
    assert "not flown" in late["advice"]


TURN_AND_STEP = {
    "type": "steps",
    "response_time": 1.5,
    "yaw": [{"start": 1.0, "stop": 20.0, "value": 90.0}],
    "x": [{"start": 5.0, "stop": 20.0, "value": 1.0}],
}
BACKWARDS = {
    "type": "waypoints",
    "response_time": 1.0,
    "speed": 0.8,
    "points": [
        {"position": [2.0, 0.0, 1.0], "yaw": -174.0, "hold": 1.0},
        {"position": [2.0, 2.0, 1.0], "yaw": 172.0, "hold": 1.0},
        {"position": [0.0, 2.0, 1.0], "yaw": -170.0},
    ],
}


@pytest.mark.parametrize(
    ("name", "changes", "others"),
    [
        ("hummingbird-figure-eight", {"reference": TURN_AND_STEP}, {}),
        (
            "hummingbird-real-rotors",
            {"reference": BACKWARDS, "initial": {"position": [0.0, 0.0, 1.0], "euler": [0.0, 0.0, -174.0]}},
            {"controller.rotor_lag": 0.0125},
        ),
    ],
)
def test_a_heading_that_the_model_lacks_is_the_first_suggestion(
    name: str, changes: dict[str, Any], others: dict[str, Any]
) -> None:
    """And helps: the QP has no answer because the model steers in the wrong direction, and no bound is to blame."""
    flight = quadsim.fly(load_scenario(name).replace(changes | {"constraints": [], "duration": 14.0}), progress=False)
    diagnosis = flight.summary["diagnosis"]
    turning = {"controller.type": "robust", "controller.soft": {}, "controller.heading": True}
    suggested = [change["settings"] for change in diagnosis["suggestions"]]
    assert suggested[0] == turning | others
    assert turning in suggested
    assert diagnosis["advice"].startswith("to try, each flown until")
    assert "controller.heading = true" in diagnosis["advice"]


# --- what the model lacks --------------------------------------------------------------------------------------------

UNAUDITED = {"constraints": [], "duration": 14.0}
Lacking = tuple[str, dict[str, Any], str, dict[str, Any]]
"""A scenario, changes of it, what the model lacks in the diagnosis, and the settings by which it knows it."""
LACKING: dict[str, Lacking] = {
    "backwards": (
        "hummingbird-real-rotors",
        {
            "reference": BACKWARDS,
            "initial": {"position": [0.0, 0.0, 1.0], "euler": [0.0, 0.0, -174.0]},
            **UNAUDITED,
        },
        "a heading of -178.5 deg",
        {"controller.type": "robust", "controller.heading": True},
    ),
    "turn and step": (
        "hummingbird-figure-eight",
        {"reference": TURN_AND_STEP, **UNAUDITED},
        "a heading of 90 deg",
        {"controller.type": "robust", "controller.heading": True},
    ),
    "turned hover": (
        "paper-constrained",
        {
            "reference": {"type": "yaw_turns", "turns": [{"start": 0.0, "yaw": 60.0, "rate": 30.0}]},
            "initial": {"position": [0.0, 0.0, 1.0], "euler": [0.0, 0.0, 60.0]},
            "events": [{"type": "push", "at": 1.0, "duration": 0.2, "force": [4.0, 0.0, 0.0]}],
            "constraints": [],
            "duration": 20.0,
        },
        "a heading of 60 deg",
        {"controller.type": "robust", "controller.heading": True},
    ),
    "late nonlinear": (
        "hummingbird-real-rotors",
        {"controller": "nonlinear", "computation": {"delay": 0.03}, **UNAUDITED},
        "commands 30 ms late",
        {"controller.delay": 0.03},
    ),
    "late geometric": (
        "hummingbird-real-rotors",
        {"controller": "geometric", "computation": {"delay": 0.12}, **UNAUDITED},
        "commands 120 ms late",
        {"controller.delay": 0.12},
    ),
    "late lqr": (
        "hummingbird-real-rotors",
        {"controller": "lqr", "computation": {"delay": 0.12}, **UNAUDITED},
        "commands 120 ms late",
        {"controller.type": "nonlinear", "controller.rotor_lag": 0.0125, "controller.delay": 0.12},
    ),
}


@pytest.mark.parametrize("case", LACKING)
def test_what_the_model_lacks_is_named_with_the_growth_without_it_and_with_its_field(case: str) -> None:
    """Each is the only one to blame: taken away alone, or known alone, it makes the loop stable."""
    name, changes, lacks, settings = LACKING[case]
    scenario = load_scenario(name).replace(changes)
    flight = quadsim.fly(scenario, progress=False)
    assert flight.outcome == "lost"
    diagnosis = flight.summary["diagnosis"]
    loop = diagnosis["loop"]
    measured = measure_growth(scenario, heading=loop["heading"], longest=SHORT_PAIR)
    assert loop["unstable"]
    assert loop["rate"] == measured.rate
    assert measured.rate > 0.5
    (without,) = [entry for entry in loop["without"] if not entry["unstable"]]
    assert without["lacks"] == lacks
    assert without["rate"] < -0.2
    (known,) = [entry for entry in loop["with"] if not entry["unstable"]]
    assert known["settings"] == settings
    assert known["rate"] < -0.2
    assert f"without {lacks} it shrinks at {-without['rate']:.3g} 1/s" in loop["sentence"]
    for path in settings.keys() - {"controller.type"}:
        assert f"{path} = " in loop["sentence"]
    advised = [change["settings"] for change in diagnosis["suggestions"]]
    assert any(settings.items() <= change.items() for change in advised)
    assert loop["sentence"] in failure_sentences(flight)
    if case == "late geometric":
        text = AUDIT_PAGE.read_text(encoding="utf-8")
        assert f"{diagnosis['sentence']}\n{loop['sentence']}\n{diagnosis['advice']}\n" in text


def test_a_change_with_which_a_push_still_grows_is_not_advised() -> None:
    """The model lacks the lag of the rotors, too, but to know that alone does not make the loop stable."""
    name, changes, _, _ = LACKING["late nonlinear"]
    diagnosis = quadsim.fly(load_scenario(name).replace(changes), progress=False).diagnosis
    assert diagnosis is not None
    lag = {"controller.rotor_lag": 0.0125}
    (reason,) = [change["why"] for change in diagnosis["rejected"] if change["settings"] == lag]
    assert reason.startswith("in hover a push still grows at ")


def test_a_stable_loop_is_not_taken_apart() -> None:
    """The QP has no answer because the model lacks the lag, but in hover a push shrinks."""
    flight = lagging()
    diagnosis = flight.diagnosis
    assert diagnosis is not None
    loop = diagnosis["loop"]
    assert not loop["unstable"]
    assert loop["rate"] < 0.0
    assert loop["without"] == []
    assert loop["with"] == []
    assert "sentence" not in loop


def test_a_lost_flight_of_a_function_of_the_user_is_not_explained() -> None:
    """Its model is not known, though commands are late."""
    delayed = {"controller": "geometric", "computation": {"delay": 0.12}, "constraints": []}
    late = load_scenario("hummingbird-real-rotors").replace(delayed)
    fallen = quadsim.fly(late, controller=lambda now, state, reference: [0.0] * 4, progress=False)
    assert fallen.outcome == "lost"
    assert fallen.diagnosis is None


def test_a_lost_flight_whose_model_lacks_nothing_is_not_explained() -> None:
    spinning = {"controller": "pid", "initial.body_rates": [2000.0, 0.0, 0.0], "constraints": [], "duration": 2.0}
    tumbled = quadsim.fly(load_scenario("hover").replace(spinning), progress=False)
    assert tumbled.outcome == "lost"
    assert tumbled.diagnosis is None


def test_few_pairs_are_flown_however_much_the_model_lacks() -> None:
    actual = {"mass": 0.8, "inertia": [0.008, 0.008, 0.013], "thrust_coefficient": 9e-6, "drag_to_thrust": 0.02}
    changes = {"computation": {"delay": 0.1}, "actual": actual}
    assembly = Assembly(load_scenario("hummingbird-real-rotors").replace(changes))
    assert len(unmodelled(assembly)) > remedies.MOST_PAIRS
    pairs = 0

    def growing(scenario: Scenario, heading: float) -> Growth:
        nonlocal pairs
        pairs += 1
        return Growth(rate=1.0, left=100.0, time=5.0)

    report = remedies._loop_report(assembly, growing)
    assert pairs == 2 * remedies.MOST_PAIRS + 2  # those, the loop as it is, and all changes together
    assert report["sentence"].endswith("nothing of what the model lacks, taken away or set, changes that")


def test_wind_that_a_nonlinear_law_could_estimate_is_tried() -> None:
    storm = {"linear_drag": [0.3, 0.3, 0.3], "wind": [14.0, 3.0, 0.0]}
    scenario = load_scenario("hummingbird-figure-eight").replace({"controller": "nonlinear", "effects.air": storm})
    diagnosis = quadsim.fly(scenario, progress=False).diagnosis
    assert diagnosis is not None
    observed = {"controller.disturbance": {}}
    assert observed in [change["settings"] for change in diagnosis["suggestions"]]
    stable = [entry["settings"] for entry in diagnosis["loop"]["with"] if not entry["unstable"]]
    assert stable == [observed]
    assert "; without wind it shrinks at" in diagnosis["loop"]["sentence"]
