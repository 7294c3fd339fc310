"""Known conflicts: each culprit is named, by the right amount, and what is suggested makes the QP feasible."""

from __future__ import annotations

import contextlib
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

TILTED = make_state(euler=(math.radians(20.0), 0.0, 0.0))
FENCE = '{ name = "fence", of = ["x", "y"], rows = [[1.0, 1.0]], upper = [6.8] }'
LEAST = '{ name = "least", of = ["speed_1", "speed_2", "speed_3", "speed_4"], rows = [[1, 1, 1, 1]], lower = [780] }'
MOST = '{ name = "most", of = ["speed_1", "speed_2", "speed_3", "speed_4"], rows = [[1, 1, 1, 1]], upper = [760] }'


def moving(name: str, value: float, **place: Any) -> Array:
    state = make_state(**place)
    state[INDEX[name]] = value
    return state


@dataclass(frozen=True, kw_only=True)
class Case:
    """A conflict: the state, the bounds that give way, and those that must be named as blocking."""

    settings: tuple[str, ...] = ()
    state: Array = field(default_factory=lambda: make_state())
    acting: float | None = None
    violated: tuple[str, ...] = ()
    blocking: tuple[str, ...] = ()
    field: str = ""


HORIZON = 20
"""Periods, of 0.05 s."""
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
    """A controller after one call."""

    scenario: Scenario
    vehicle: Vehicle
    controller: Controller
    status: str
    infeasible_period: InfeasiblePeriod | None

    @cached_property
    def found(self) -> dict[str, Any]:
        assert self.infeasible_period is not None
        result = diagnose(self.infeasible_period, self.scenario, self.vehicle)
        assert result is not None
        return result


@pytest.fixture(scope="session")
def file(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A hover with a short horizon; its file names no solver, so that its controller may be another."""
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
    acting = np.full(4, vehicle.hover_speed if case.acting is None else case.acting)
    controller.reset(acting)
    status = "plan_exhausted_error"
    with contextlib.suppress(PlanExhaustedError):
        status = controller.step(StepInputs(acting=acting), case.state, np.zeros((controller.horizon, 4))).status
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
    return {f"{entry['name']} {entry['side']}" for entry in entries}


def violated(diagnosis: dict[str, Any]) -> list[dict[str, Any]]:
    """The bounds of the conflict that give way."""
    return [entry for entry in diagnosis["conflict"] if entry["by"]]


def blocking(diagnosis: dict[str, Any]) -> list[dict[str, Any]]:
    """The bounds of the conflict that are kept."""
    return [entry for entry in diagnosis["conflict"] if not entry["by"]]


def setting(field: str, value: object) -> str:
    """As it is given to `--set`."""
    if isinstance(value, dict):
        entries = ", ".join(f"{name} = {number}" for name, number in value.items())
        return f"{field}={{{entries}}}"
    return f"{field}={json.dumps(value)}"


@pytest.mark.representative("diagnosis")
@pytest.mark.parametrize("name", CASES)
def test_each_culprit_is_named_and_each_suggestion_makes_it_feasible(name: str, file: str) -> None:
    case = CASES[name]
    queried = query_cached(file, name)
    assert queried.status not in ACCEPTED
    result = queried.found
    assert result["feasible"] is False
    assert names(violated(result)) == set(case.violated)
    assert names(blocking(result)) >= set(case.blocking)
    for part in (*case.violated, *case.blocking):
        word, side = part.split()
        assert re.search(rf"\b{word}\b[^;]*\b{side}\b", result["sentence"])
    at_once = [suggestion["settings"] for suggestion in result["suggestions"] if suggestion["after"] is None]
    assert any({*settings} == {f"controller.{case.field}"} for settings in at_once)
    for settings in at_once:
        changed = [setting(name, value) for name, value in settings.items()]
        assert query_case(file, case, *changed).status in ACCEPTED, changed


@pytest.mark.parametrize("noise", [-3e-6, 0.0, 3e-6])
def test_bounds_that_give_way_alike_stand_in_the_order_of_the_file(noise: float, file: str) -> None:
    """As far beyond the bound on roll as on pitch, but for rounding."""
    bound = math.radians(5.0)
    state = make_state(euler=(1.2 * bound, (1.2 + noise) * bound, 0.0))
    first, second = violated(query_case(file, Case(state=state)).found)
    assert (first["name"], first["side"]) == ("roll", "upper")
    assert (second["name"], second["side"]) == ("pitch", "upper")


@pytest.mark.parametrize("name", CASES)
def test_a_little_less_than_the_smallest_bound_is_not_enough(name: str, file: str) -> None:
    """The suggestion is rounded up by a hundredth of the change at most."""
    case = CASES[name]
    queried = query_cached(file, name)
    stated = tomllib.loads(queried.scenario.to_toml())
    tried = 0
    for suggestion in queried.found["suggestions"]:
        (path, value), *others = suggestion["settings"].items()
        if others or not isinstance(value, list):
            continue
        less = [old + 0.97 * (new - old) for old, new in zip(get_field(stated, path), value, strict=True)]
        assert query_case(file, case, setting(path, less)).status not in ACCEPTED
        tried += 1
    assert tried


def entry_of(queried: Queried, name: str) -> dict[str, Any]:
    """The violated bound of a name."""
    (entry,) = [entry for entry in violated(queried.found) if entry["name"] == name]
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
    after_a_period = 20.0 + math.degrees(float(steps @ of_roll))
    entry = entry_of(query_cached(file, "start beyond the tilt bound"), "roll")
    assert entry["by"] == pytest.approx(after_a_period - 5.0, abs=1e-6)
    assert (entry["start"], entry["unit"]) == (0.05, "deg")
    delayed = entry_of(query_cached(file, "rotors that lag, and a delay"), "roll")
    assert delayed["start"] == 0.07  # delay and period


def test_a_fall_is_beyond_its_bound_while_the_rotors_speed_up(file: str, model: mpc.LinearModel) -> None:
    lift = float(model.B[INDEX["vz"]].sum())  # of vz in a period, per rad/s of all rotors
    velocity = -2.0 + lift * np.cumsum(5.0 * np.arange(1, HORIZON + 1))
    entry = entry_of(query_cached(file, "falling too fast"), "vz")
    assert entry["by"] == pytest.approx(-0.5 - velocity[0], abs=1e-6)
    assert entry["start"] == 0.05
    assert entry["stop"] == pytest.approx(0.05 * np.count_nonzero(velocity < -0.5))


def test_sinking_at_a_bounded_speed_is_beyond_its_bound_in_the_end(file: str, model: mpc.LinearModel) -> None:
    lift = float(model.B[INDEX["vz"]].sum())
    velocity = lift * (190.0 - float(model.u_bar[0])) * np.arange(1, HORIZON + 1)
    entry = entry_of(query_cached(file, "speeds too low to hover"), "vz")
    assert entry["by"] == pytest.approx(-0.1 - velocity[-1], abs=1e-6)
    assert entry["start"] == pytest.approx(0.05 * (1 + np.count_nonzero(velocity >= -0.1)))
    assert entry["stop"] == 0.05 * HORIZON


def test_a_command_is_beyond_its_bound_until_its_steps_bring_it_back(file: str) -> None:
    """From 290 to 250 rad/s in steps of 10, the first of which is that of the period itself."""
    entry = entry_of(query_cached(file, "the last command outside the bounds"), "speed")
    assert (entry["by"], entry["start"], entry["stop"]) == (pytest.approx(30.0), 0.0, 0.1)
    assert entry["rotors"] == [1, 2, 3, 4]


def test_the_fallback_is_suggested_with_the_time_after_which_it_helps(file: str, model: mpc.LinearModel) -> None:
    """The contract itself flies the model from there, and the optimum is accepted again in that period."""
    case = CASES["start beyond the tilt bound"]
    queried = query_case(file, case)
    suggestions = queried.found["suggestions"]
    (suggested,) = [suggestion for suggestion in suggestions if "controller.fallback" in suggestion["settings"]]
    guarded = query_case(file, case, "controller.fallback={}").controller
    assert guarded.guard is not None
    state = case.state
    acting = np.full(4, queried.vehicle.hover_speed)
    guarded.reset(acting)
    for k in range(50):
        command = guarded.step(StepInputs(time=0.05 * k, acting=acting), state, np.zeros((HORIZON, 4)))
        if command.status in ACCEPTED:
            break
        state = model.A @ state + model.B @ (command.speeds - model.u_bar)
        acting = command.speeds
    assert suggested["after"] == pytest.approx(0.05 * k)
    assert k > 0


def test_a_solver_that_fails_where_all_constraints_can_hold_is_distinguished(file: str) -> None:
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
    """Upside down the real-time iteration tumbles; every QP is solved, and the plans follow no dynamics."""
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
    text = (Path(__file__).resolve().parents[2] / "docs" / "audit.md").read_text(encoding="utf-8")
    assert f"{result['sentence']}\n{result['advice']}\n" in text
    helped = quadsim.fly(tumble.replace(result["suggestions"][0]["settings"]))
    assert helped.summary["controller"]["statuses"].get("not_converged", 0) == 0
    last = slice(-20, None)  # one sample of a tumble may be level
    assert np.abs(helped.state["roll"][last]).max() < 0.1 < np.abs(flight.state["roll"][last]).max()


def test_a_satisfied_flight_is_not_diagnosed_for_a_period_that_did_not_converge(
    fly_once: Callable[..., Flight],
) -> None:
    flight = fly_once("inverted-start")
    assert 0 < flight.log.control.status.count("not_converged") < 20
    assert flight.outcome == "satisfied"
    assert flight.diagnosis is None


class OwnMPC:
    """A controller of the user, with the period that it could not solve."""

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
    """Fly a change without the code under test: a robust controller has no field `solver`."""
    data = tomllib.loads(flight.scenario.to_toml())
    if "controller.type" in settings:
        data["controller"].pop("solver", None)
    for path, value in settings.items():
        *tables, name = path.split(".")
        place = data
        for table in tables:
            place = place[table]
        place[name] = value
    data |= {"duration": until, "expect": "satisfied"}
    return quadsim.fly(parse_scenario(data), progress=False)


def test_what_is_advised_keeps_the_flight_and_what_is_not_would_not_have() -> None:
    """Each change gives the period an answer, but without the lag the next ones have none."""
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
    text = (Path(__file__).resolve().parents[2] / "docs" / "audit.md").read_text(encoding="utf-8")
    assert f"{result['sentence']}\n{result['advice']}\n" in text


@pytest.mark.parametrize(("speed", "note"), [([0.0, 150.0], "150"), ([200.0, 250.0], "at least 200")])
def test_a_bound_that_excludes_hover_is_named_first_and_moved_past_hover(speed: list[float], note: str) -> None:
    """The smallest bound with an answer, 183 rad/s, would fall: hover needs 192.8."""
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


def test_hover_is_noted_before_the_flight(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bounds = {"speed": [0.0, 150.0], "slew": [-10.0, 10.0]}
    scenario = quadsim.load("hover", {"controller": {"type": "pid", "input_bounds": bounds}, "duration": 0.1})
    with caplog.at_level("INFO", logger="quadsim"):
        quadsim.run(scenario, out=tmp_path / "run", progress=False, video=False, recording=False, figures=False)
    assert [note for note in caplog.messages if "192.8 rad/s" in note and "150" in note]


def test_a_start_beyond_a_bound_is_advised_on_by_how_it_returns(file: str) -> None:
    tilted = load_scenario(file, ["initial.euler=[10.0, 0.0, 0.0]", "duration=3.0"])
    result = quadsim.fly(tilted, progress=False).diagnosis
    assert result is not None
    assert result["suggestions"]
    for change in result["suggestions"]:
        assert "roll" in change["violated"]


def test_the_flights_of_a_diagnosis_are_not_diagnosed_and_are_few(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    flights: list[float | None] = []
    explain = infeasibility.diagnose
    fly = Rollout.fly

    def explained(*given: Any) -> dict[str, Any] | None:
        calls.append(1)
        return explain(*given)

    def counted(rollout: Rollout, *given: Any, **options: Any) -> Flight:
        flights.append(options.get("until"))
        return fly(rollout, *given, **options)

    tilted = quadsim.load("hover").replace({"duration": 0.4, "initial.euler": [20.0, 0.0, 0.0]})
    first, second = (quadsim.fly(tilted, progress=False) for _ in range(2))
    monkeypatch.setattr(infeasibility, "diagnose", explained)
    monkeypatch.setattr(Rollout, "fly", counted)
    assert json.dumps(first.diagnosis) == json.dumps(first.summary["diagnosis"]) == json.dumps(second.diagnosis)
    assert len(calls) == 2
    assert set(flights) == {0.4}
    assert 2 <= len(flights) <= 2 * remedies.MOST_FLOWN


def test_nobody_but_the_summary_of_one_flight_pays_for_advice(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Numbers, pictures and campaigns do not; Ctrl-C in the flights of the advice loses nothing."""
    changes = {"duration": 0.4, "initial.euler": [20.0, 0.0, 0.0], "controller.fallback": {}}
    tilted = quadsim.load("hover", changes)
    asked: list[int] = []

    def interrupted(*_: object) -> None:
        asked.append(1)
        raise KeyboardInterrupt

    monkeypatch.setattr(remedies, "tried", interrupted)
    flight = quadsim.fly(tilted, progress=False)
    assert flight.metrics["speed_max"] > 0.0
    assert flight.small_plot() is not None
    assert flight._repr_html_()
    fly_here(monkeypatch)
    sweep = quadsim.sweep(tilted, {"vehicle.mass": [4.0, 4.1]}, progress=False)
    assert len(sweep.table) == 2
    assert not asked
    _, products_may_follow = flight.write_tables(tmp_path / "run")
    assert not products_may_follow
    assert asked == [1]
    read = quadsim.read(tmp_path / "run")
    assert read.diagnosis is not None
    assert read.diagnosis["sentence"]


def test_what_cannot_be_flown_again_is_advised_as_not_flown(monkeypatch: pytest.MonkeyPatch) -> None:
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
def test_a_heading_that_the_model_lacks_is_the_first_that_is_tried_and_helps(
    name: str, changes: dict[str, Any], others: dict[str, Any]
) -> None:
    """The QP has no answer because the model steers in the wrong direction: no bound is to blame."""
    flight = quadsim.fly(load_scenario(name).replace(changes | {"constraints": [], "duration": 14.0}), progress=False)
    diagnosis = flight.summary["diagnosis"]
    turning = {"controller.type": "robust", "controller.soft": {}, "controller.heading": True}
    assert diagnosis["suggestions"][0]["settings"] == turning | others
    assert turning in [change["settings"] for change in diagnosis["suggestions"]]
    assert diagnosis["advice"].startswith("to try, each flown until")
    assert "controller.heading = true" in diagnosis["advice"]


# --- what the model lacks --------------------------------------------------------------------------------------------

UNAUDITED = {"constraints": [], "duration": 14.0}
LACKING: dict[str, tuple[str, dict[str, Any], str, dict[str, Any]]] = {  # scenario, changes, what lacks, its field
    "backwards": (
        "hummingbird-real-rotors",
        {
            "reference": BACKWARDS,
            "initial": {"position": [0.0, 0.0, 1.0], "euler": [0.0, 0.0, -174.0]},
            "constraints": [],
            "duration": 14.0,
        },
        "a heading of -178.5 deg",
        {"controller.type": "robust", "controller.heading": True},
    ),
    "turn and step": (
        "hummingbird-figure-eight",
        {"reference": TURN_AND_STEP, "constraints": [], "duration": 14.0},
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
    stated = measure_growth(scenario, heading=loop["heading"], longest=SHORT_PAIR)
    assert loop["unstable"]
    assert loop["rate"] == stated.rate > 0.5
    without = {entry["lacks"]: entry for entry in loop["without"]}
    assert [text for text, entry in without.items() if not entry["unstable"]] == [lacks]
    assert without[lacks]["rate"] < -0.2
    known = [entry for entry in loop["with"] if not entry["unstable"]]
    assert [entry["settings"] for entry in known] == [settings]
    assert known[0]["rate"] < -0.2
    assert f"without {lacks} it shrinks at {-without[lacks]['rate']:.3g} 1/s" in loop["sentence"]
    for path in settings:
        assert path == "controller.type" or f"{path} = " in loop["sentence"]
    advised = [change["settings"] for change in diagnosis["suggestions"]]
    assert any(settings.items() <= change.items() for change in advised)
    assert loop["sentence"] in failure_sentences(flight)
    if case == "late geometric":
        text = (Path(__file__).resolve().parents[2] / "docs" / "audit.md").read_text(encoding="utf-8")
        assert f"{diagnosis['sentence']}\n{loop['sentence']}\n{diagnosis['advice']}\n" in text


def test_a_change_with_which_a_push_still_grows_is_not_advised() -> None:
    """Rotors that lag are lacking, too; to know them alone helps for some seconds only."""
    name, changes, _, _ = LACKING["late nonlinear"]
    diagnosis = quadsim.fly(load_scenario(name).replace(changes), progress=False).diagnosis
    assert diagnosis is not None
    lag = {"controller.rotor_lag": 0.0125}
    reasons = [change["why"] for change in diagnosis["rejected"] if change["settings"] == lag]
    assert len(reasons) == 1
    assert reasons[0].startswith("in hover a push still grows at ")


def test_a_stable_loop_is_not_taken_apart() -> None:
    """Its lag is why the QP has no answer, but in hover a push shrinks."""
    flight = lagging()
    diagnosis = flight.diagnosis
    assert diagnosis is not None
    loop = diagnosis["loop"]
    assert not loop["unstable"]
    assert loop["rate"] < 0.0
    assert loop["without"] == []
    assert loop["with"] == []
    assert "sentence" not in loop


def test_a_lost_flight_whose_model_lacks_nothing_or_is_not_known_is_not_explained() -> None:
    delayed = {"controller": "geometric", "computation": {"delay": 0.12}, "constraints": []}
    late = load_scenario("hummingbird-real-rotors").replace(delayed)
    fallen = quadsim.fly(late, controller=lambda now, state, reference: [0.0] * 4, progress=False)
    assert fallen.outcome == "lost"
    assert fallen.diagnosis is None
    spinning = {"controller": "pid", "initial.body_rates": [2000.0, 0.0, 0.0], "constraints": [], "duration": 2.0}
    tumbled = quadsim.fly(load_scenario("hover").replace(spinning), progress=False)
    assert tumbled.outcome == "lost"
    assert tumbled.diagnosis is None


def test_few_pairs_are_flown_however_much_the_model_lacks() -> None:
    actual = {"mass": 0.8, "inertia": [0.008, 0.008, 0.013], "thrust_coefficient": 9e-6, "drag_to_thrust": 0.02}
    changes = {"computation": {"delay": 0.1}, "actual": actual}
    assembly = Assembly(load_scenario("hummingbird-real-rotors").replace(changes))
    assert len(unmodelled(assembly)) > remedies.MOST_PAIRS
    asked: list[float] = []

    def growing(scenario: Scenario, heading: float) -> Growth:
        asked.append(heading)
        return Growth(rate=1.0, left=100.0, time=5.0)

    report = remedies._loop_report(assembly, growing)
    assert len(asked) == 2 * remedies.MOST_PAIRS + 2
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
