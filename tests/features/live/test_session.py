"""What a person does in a session is data: the saved scenario reproduces the flight bit for bit."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_events import HAPPENING, kind, number, vector
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import quadsim.rollout.flight_events
from quadsim.commands.cli import main
from quadsim.console.results import EXIT_DONE, EXIT_FAILED, EXIT_WRONG_INPUT
from quadsim.errors import InputError
from quadsim.features.live.commands import live
from quadsim.features.live.inputs import read_script
from quadsim.features.live.pace import LATE, Pace
from quadsim.features.live.session import STRONGEST, Frame, Session, looping
from quadsim.features.live.tunable_fields import tunable_fields
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.scenarios.schema.writing import plain

WINDY = load_scenario("steady-wind", ["controller.horizon=10"])
ROBUST = load_scenario("robust", ["controller.horizon=10"]).controller
FIELDS = [{"output_weights.x": 20.0}, {"horizon": 8}, plain(load_scenario("robust").controller)]
INPUTS = st.one_of(
    HAPPENING,
    kind("pull", to=vector(2.0)),
    kind("pull"),
    kind("wear", rotor=st.integers(1, 4), loss=number(0.0, 0.2)),
    kind("steer", velocity=vector(1.0)),
    kind("controller", fields=st.sampled_from(FIELDS)),
)
EVERY: list[dict[str, Any]] = [
    {"type": "gust", "velocity": [6.0, 0.0, 0.0], "duration": 1.0},
    {"type": "wind", "velocity": [3.0, 0.0, 0.0]},
    {"type": "mass", "factor": 1.1},
    {"type": "payload_pickup", "mass": 0.05},
    {"type": "rotor_lag", "rise": 0.02},
    {"type": "rotor_loss", "rotor": 1, "loss": 0.1},
    {"type": "stall", "duration": 0.2},
    {"type": "sensor_fault", "sensor": "position", "fault": "nan", "duration": 1.0},
]


@pytest.fixture(scope="module")
def hover() -> Scenario:
    return load_scenario("hover", ["controller.horizon=10"])


@pytest.fixture
def session(hover: Scenario) -> Iterator[Session]:
    session = Session(hover)
    yield session
    session.close()


def flown(session: Session, periods: int) -> list[Frame]:
    return [session.advance() for _ in range(periods)]


def same_bits(session: Session, which: int = 0) -> bool:
    flight = session.flights[which].flight()
    again = Rollout(flight.scenario).fly()
    return np.array_equal(again.log.plant.state, flight.log.plant.state) and np.array_equal(
        again.command, flight.command
    )


@pytest.mark.slow("live")
@settings(max_examples=8, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 20), INPUTS), max_size=12))
def test_a_saved_session_flies_to_the_same_bits(given: list[tuple[int, dict[str, Any]]]) -> None:
    scenario = WINDY
    session = Session(scenario, ROBUST)
    try:
        for k in range(24):
            for at, table in given:
                if at == k:
                    session.submit(table, subject=table["type"])
            if session.reason is None:
                session.advance()
        assume(session.k)  # else a controller was lost in its first period
        assert same_bits(session)
        assert same_bits(session, 1)
    finally:
        session.close()


def test_a_pull_moves_the_vehicle_and_ends(session: Session) -> None:
    flown(session, 5)
    session.submit({"type": "pull", "to": [50.0, 0.0, 1.0]}, subject="pull")
    pulled = flown(session, 20)
    weight = session.flights[0].vehicle.mass * session.flights[0].vehicle.gravity
    assert np.linalg.norm(pulled[0].pull) == pytest.approx(STRONGEST * weight, rel=1e-3)
    session.submit({"type": "pull"}, subject="pull")
    assert not flown(session, 1)[0].pull.any()
    assert session.flight().state["x"].max() > 0.05


def test_of_one_subject_the_last_input_counts(session: Session) -> None:
    for x in (1.0, 2.0, 3.0):
        session.submit({"type": "setpoint", "x": x}, subject="setpoint")
    flown(session, 2)
    points = [event for event in session.flight().scenario.events if event.type == "setpoint"]
    assert [event.x for event in points] == [3.0]


def test_what_is_refused_is_reported_and_changes_nothing(session: Session) -> None:
    flown(session, 2)
    before = session.flight().scenario.events
    for table, message in (
        ({"type": "wear", "rotor": 5, "loss": 0.1}, "rotor"),
        ({"type": "wear", "rotor": True, "loss": 0.1}, "input.rotor must be a whole number >= 1 and <= 4; got True"),
        ({"type": "pull", "to": [float("nan"), 0.0, 0.0]}, "to.0"),
        ({"type": "pull", "too": [0.0, 0.0, 1.0]}, "input.too is not a field"),
        ({"type": "steer", "velocity": "north"}, "input.velocity must be a list of 3 numbers; got 'north'"),
        ({"type": "controller", "fields": {"horizon": 0}}, "horizon"),
        ({"type": "nonsense"}, "nonsense"),
        ({}, "type"),
    ):
        session.submit(table)
        (refusal,) = session.advance().refused
        assert message in refusal
    assert session.flight().scenario.events == before


def test_what_cannot_be_held_any_more_is_released_and_reported_once(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(quadsim.rollout.flight_events, "MOST_EVENTS", 20)
    session.submit({"type": "pull", "to": [0.3, 0.0, 1.0]})
    session.submit({"type": "wear", "rotor": 2, "loss": 0.02})
    (refusal,) = [refusal for frame in flown(session, 30) for refusal in frame.refused]
    assert "20 or fewer" in refusal
    assert session.reason is None
    assert same_bits(session)


def test_a_second_vehicle_feels_the_same(hover: Scenario) -> None:
    session = Session(hover, ROBUST)
    flown(session, 3)
    session.submit({"type": "pull", "to": [3.0, 0.0, 1.0]})
    flown(session, 10)
    pushes = [
        [event for event in session.flights[i].flight().scenario.events if event.type == "push"] for i in range(2)
    ]
    session.close()
    assert len(pushes[0]) > 5
    assert pushes[0] == pushes[1]


def test_a_reset_begins_anew(session: Session) -> None:
    flown(session, 4)
    session.submit({"type": "payload_pickup", "mass": 0.1})
    session.reset()
    assert session.k == 0
    flown(session, 1)
    assert not [event for event in session.flight().scenario.events if event.type == "payload_pickup"]


def test_disturbances_are_what_the_scenario_and_its_events_say_now_and_a_person_adds_to_them() -> None:
    """Before the flight, after an event of the file, after inputs, and again after a reset."""
    rotors = {"rise": 0.0125, "fall": 0.02, "efficiency": [1.0, 0.9, 1.0, 1.0]}
    events = [
        {"type": "wind", "at": 0.1, "velocity": [2.0, -1.0, 0.5]},
        {"type": "rotor_loss", "at": 0.1, "rotor": 3, "loss": 0.2, "duration": 0.1},
    ]
    air = {"effects.air.wind": [4.0, 0.0, 0.5], "effects.load": {"mass_factor": 1.2}}
    scenario = load_scenario("playground").replace({**air, "effects.rotors": rotors, "events": events})
    session = Session(scenario)
    start = session.disturbances
    assert (start.wind, start.mass_factor, start.lag) == ((4.0, 0.0, 0.5), 1.2, (0.0125, 0.02))
    assert start.loss == pytest.approx([0.0, 0.1, 0.0, 0.0])
    flown(session, 2)
    assert session.disturbances.wind == (2.0, -1.0, 0.5)
    assert session.disturbances.loss == pytest.approx([0.0, 0.1, 0.2, 0.0])
    session.submit({"type": "wear", "rotor": 2, "loss": 0.5})
    session.submit({"type": "mass", "factor": 0.9})
    session.submit({"type": "rotor_lag", "rise": 0.03, "fall": 0.04})
    (frame,) = flown(session, 1)
    assert frame.health == pytest.approx([1.0, 0.45, 0.8, 1.0])  # of the period's end
    flown(session, 1)
    now = session.disturbances
    assert (now.wind, now.mass_factor, now.lag) == ((2.0, -1.0, 0.5), 0.9, (0.03, 0.04))
    assert now.loss == pytest.approx([0.0, 0.55, 0.0, 0.0])
    assert now.worn == pytest.approx([0.0, 0.1, 0.0, 0.0])
    session.reset()
    assert session.disturbances.wind == start.wind
    assert (session.disturbances.loss == start.loss).all()
    session.close()


def test_a_lost_flight_ends_the_session_with_its_reason(session: Session) -> None:
    for rotor in range(1, 5):
        session.submit({"type": "wear", "rotor": rotor, "loss": 1.0})
    while session.reason is None and session.k < 400:
        session.advance()
    assert "lost" in (session.reason or "")
    with pytest.raises(InputError, match="ended"):
        session.advance()
    assert session.flight().outcome == "lost"
    assert same_bits(session)


def test_tunable_fields_have_units_and_limits() -> None:
    result = {field.path: field for field in tunable_fields(load_scenario("robust").controller)}
    assert result["horizon"].minimum == 1
    assert result["output_bounds.roll"].value == (-5.0, 5.0)
    assert "[m/s]" in result["offset_free.velocity_noise"].about
    assert "type" not in result


class Clock:
    """Time that passes when it is waited for, and some more."""

    def __init__(self, extra: float) -> None:
        self.now = 0.0
        self.extra = extra

    def __call__(self) -> float:
        self.now += self.extra
        return self.now


class Nobody:
    """Looks at nothing."""

    def show(self, frame: Frame, factor: float) -> None:
        self.factor = factor

    def pose(self, frame: Frame, share: float) -> None:
        pass

    def ended(self, reason: str | None) -> None:
        pass


def test_a_slow_machine_flies_every_period_and_reports_its_speed(session: Session) -> None:
    pace = Pace(Clock(LATE))
    view = Nobody()
    frames: list[int] = []
    pace.drive(session, view, until=lambda frame: frames.append(frame.k) or frame.k == 9)  # type: ignore[func-returns-value]
    assert frames == [*range(10)]
    assert view.factor < 0.2


def test_paused_it_flies_single_periods(session: Session) -> None:
    pace = Pace()
    pace.paused = True
    pace.single()
    pace.single()
    pace.order(lambda session: None)
    pace.drive(session, Nobody(), until=lambda frame: frame.k == 1)
    assert session.k == 2


@pytest.mark.slow("live")
@pytest.mark.usefixtures("undrawn")
def test_the_script_on_the_page_is_saved_as_a_run_that_flies_to_the_same_bytes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "live.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    script = tmp_path / "script.toml"
    saved = tmp_path / "saved"
    again = tmp_path / "again"
    script.write_text(text, encoding="utf-8")
    assert read_script(script).inputs
    assert main(["live", "robust", "--script", str(script), "--out", str(saved)]) == EXIT_DONE
    assert "refused" not in "".join(capsys.readouterr())
    main(["run", str(saved / "scenario.toml"), "--out", str(again), "--no-video", "--no-recording", "--no-figures"])
    for table in ("flight.parquet", "plant.parquet"):
        assert (saved / table).read_bytes() == (again / table).read_bytes()


@pytest.mark.parametrize(
    ("text", "refusal"),
    [
        ("duration = 0", "duration must be a number >= 1e-06"),
        ("duration = 1\ninputs = [{ at = 2.0 }]", "inputs.0.at must be below duration"),
        ("duration = 1\ninputs = 3", "inputs must be a list"),
        ("duration = 1\nspeed = 3", "speed is not a field"),
        (
            "duration = 1\ninputs = [{ at = 0.0, type = 'pull' }, { at = 0.0, type = 'wear', rotor = 5, loss = 0.1 }]",
            r"script.toml: inputs.1.rotor must be a whole number >= 1 and <= 4; got 5",
        ),
        ("duration = 1\ninputs = [{ at = 0.0, type = 'setpoint', X = 1.0 }]", "inputs.0.X is not a field"),
        ("duration = 1\ninputs = [{ at = 0.0, type = 'nonsense' }]", "inputs.0.type must be one of"),
        ("duration = ", "is not valid TOML"),
    ],
)
def test_a_script_that_is_none_is_refused(tmp_path: Path, text: str, refusal: str) -> None:
    path = tmp_path / "script.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=refusal):
        read_script(path)


@pytest.mark.slow("live")
def test_an_input_that_is_refused_in_flight_is_named_with_its_time_and_status_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A wind cannot push a vehicle whose file states no drag; the session goes on."""
    script = tmp_path / "script.toml"
    out = tmp_path / "run"
    wind = "{ at = 0.12, type = 'wind', velocity = [1.0, 0.0, 0.0] }"
    push = "{ at = 0.2, type = 'push', duration = 0.3, force = [0.0, 15.0, 0.0] }"
    script.write_text(f"duration = 1.0\ninputs = [{push}, {wind}]", encoding="utf-8")
    assert main(["live", "hover", "--script", str(script), "--out", str(out)]) == EXIT_FAILED
    printed = capsys.readouterr()
    (refused, *_) = printed.err.splitlines()
    assert f"{script}: inputs.1 at t = 0.150 s: effects.air.rotor_drag " in refused
    assert str(out) in printed.out


@pytest.mark.slow("live")
def test_a_finished_run_is_flown_on_unless_check_refuses_it_and_none_of_its_code_is_imported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    law = tmp_path / "law_of_run.py"
    run = tmp_path / "run"
    script = tmp_path / "script.toml"
    law.write_text("import numpy as np\ndef held(now, state, reference):\n    return np.full(4, 192.8)\n")
    (tmp_path / "mine.toml").write_text(
        'base = "hover"\nname = "mine"\nduration = 0.2\nconstraints = []\ncontroller = "law_of_run:held"\n'
    )
    script.write_text("duration = 0.4", encoding="utf-8")
    outputs = ("--no-video", "--no-recording", "--no-figures")
    assert main(["run", str(tmp_path / "mine.toml"), *outputs, "--out", str(run)]) == EXIT_DONE
    capsys.readouterr()
    command = ["live", str(run), "--script", str(script)]
    assert main([*command, "--out", str(tmp_path / "on")]) == EXIT_DONE
    assert f"quadsim: imported law_of_run from {law}\n" in capsys.readouterr().err
    assert load_scenario(str(tmp_path / "on" / "scenario.toml")).duration == 0.4
    summary = (run / "summary.json").read_text()
    (run / "summary.json").write_text(summary.replace('"duration": 0.2', '"duration": 0.3'))
    assert main([*command, "--out", str(tmp_path / "refused")]) == EXIT_WRONG_INPUT
    assert "imported" not in capsys.readouterr().err
    assert not (tmp_path / "refused").exists()


def test_a_course_that_ends_starts_again_and_is_saved_as_it_was_flown() -> None:
    there = {"type": "waypoints", "speed": 2.0, "points": [{"position": [0.5, 0.0, 1.0]}]}
    arrival = {"name": "arrival", "signal": "x_error", "lower": -0.5, "upper": 0.5, "start": 0.4}
    scenario = load_scenario("hover", ["controller.horizon=10"]).replace(
        {"reference": there, "duration": 0.5, "constraints": [arrival]}
    )
    session = Session(scenario)
    frames = flown(session, 25)
    x = [frame.samples[0].observation.reference[0] for frame in frames if frame.samples[0] is not None]
    assert x[5] == pytest.approx(0.5)
    assert x[:11] == pytest.approx(x[20:9:-1]), "there and back"
    assert x[20:25] == pytest.approx(x[:5]), "and there again"
    assert "arrival" in [limit.name for limit in session.limits if limit.stop == 0.5], "it was at the first round's end"
    assert session.flight().scenario.reference.repeat == 0.5
    assert same_bits(session)
    session.reset()
    assert [limit.stop for limit in session.limits if limit.name == "arrival"] == [math.inf]
    session.close()


@pytest.mark.parametrize("name", ["hover", "autopilot"])
def test_a_course_that_does_not_move_or_has_velocities_stays_as_it_is(name: str) -> None:
    scenario = load_scenario(name)
    assert looping(scenario) is scenario


def test_constraints_on_the_course_end_once_a_person_steers() -> None:
    session = Session(load_scenario("robust", ["controller.horizon=10"]))
    flown(session, 3)
    assert {"arrival_x", "roll"} <= {limit.name for limit in session.limits}
    session.submit({"type": "setpoint", "z": 2.0})
    flown(session, 3)
    names = {limit.name for limit in session.limits}
    assert "roll" in names
    assert not any(name.startswith("arrival") for name in names)
    assert {finding.limit.name for finding in session.flight().findings} == names
    assert same_bits(session)
    assert {limit.name for limit in Rollout(session.flight().scenario).limits} == names
    session.close()


def test_a_running_constraint_on_the_course_ends_where_a_person_steers(session: Session) -> None:
    flown(session, 4)
    session.submit({"type": "setpoint", "z": 1.5})
    flown(session, 10)
    hold = next(finding for finding in session.flight().findings if finding.limit.name == "hold_z")
    assert hold.limit.stop == pytest.approx(4 * session.period)
    assert hold.satisfied


@pytest.mark.slow("live")
def test_the_scenario_made_for_sessions_can_have_every_input_and_withstands_a_broken_rotor() -> None:
    assert inspect.signature(live).parameters["scenario"].default == "playground"
    session = Session(load_scenario("playground"))
    assert not any(session.refusals(EVERY))
    session.submit({"type": "wear", "rotor": 1, "loss": 0.4})
    flown(session, 160)
    assert session.reason is None
    assert (
        abs(session.flights[0].loop.last.observation.reference[2] - session.flights[0].loop.last.position[-1, 2]) < 0.05
    )
    session.close()


def test_what_a_scenario_cannot_have_is_refused_with_the_reason_before_the_flight(session: Session) -> None:
    reasons = dict(zip([table["type"] for table in EVERY], session.refusals(EVERY), strict=True))
    assert "drag" in reasons["gust"]
    assert not any(reason for kind, reason in reasons.items() if kind not in ("gust", "wind"))
    assert session.k == 0


@pytest.mark.parametrize(
    ("bounds", "given"), [({"output_bounds.roll": [-5.0, -1.0]}, "[-5"), ({"input_bounds.speed": [0.0, 100.0]}, "[0")]
)
def test_bounds_that_exclude_hover_are_refused(session: Session, bounds: dict[str, Any], given: str) -> None:
    with pytest.raises(InputError, match=r"a range that contains .*, as in hover; got " + re.escape(given)):
        session.successor(bounds)
    assert session.successor({"output_bounds.roll": [-1.0, 5.0]})
