"""`quadsim check RUN`: audited again from the tables, and every contradiction reported."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import quadsim
from quadsim.commands.cli import main
from quadsim.console.results import EXIT_DONE, EXIT_FAILED, EXIT_WRONG_INPUT
from quadsim.errors import FileError, InputError
from quadsim.flight import rundir
from quadsim.flight.parquet import FLIGHT_FILE, PLANT_FILE, TIMING_FILE
from quadsim.rollout.flown import Flight
from quadsim.rollout.reaudit import _in_force, reaudit
from quadsim.scenarios.assembly import Assembly

TABLES = ("--no-video", "--no-recording", "--no-figures")
SHORT = ("--set", "duration=0.5")
Change = Callable[[dict[str, Any]], None]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with a run that holds its constraints and one that does not."""
    here = tmp_path_factory.mktemp("runs")
    assert main(["run", "hover", *SHORT, *TABLES, "--json", "--out", str(here / "good")]) == EXIT_DONE
    broken = ("--set", "constraints.speed.upper=150.0")
    assert main(["run", "hover", *SHORT, *TABLES, *broken, "--json", "--out", str(here / "bad")]) == EXIT_FAILED
    return here


@pytest.fixture
def runs(flown: Path, tmp_path: Path) -> Path:
    """Copies of the two, to tamper with."""
    return shutil.copytree(flown, tmp_path / "runs")


def rewrite(run: Path, change: Change) -> None:
    """Change a run's summary as an editor would."""
    path = run / rundir.SUMMARY_FILE
    summary = json.loads(path.read_text())
    change(summary)
    path.write_text(json.dumps(summary, indent=2))


def rehash(run: Path, name: str) -> None:
    """Put the hash of a changed file into the summary, as one who tampers with two files would."""
    digest = "sha256:" + hashlib.sha256((run / name).read_bytes()).hexdigest()
    rewrite(run, lambda summary: summary["files"].update({name: digest}))


def test_a_run_as_it_was_written_is_checked_and_its_verdict_made_again(
    flown: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, status in (("good", EXIT_DONE), ("bad", EXIT_FAILED)):
        assert main(["check", str(flown / name)]) == status
        output = capsys.readouterr()
        assert "audited again from the tables, 200 rows per second: as recorded" in output.out
        assert output.err == ""
        assert main(["check", str(flown / name), "--json"]) == status
        printed = json.loads(capsys.readouterr().out)
        assert printed.pop("reaudit")["satisfied"] is (status == EXIT_DONE)
        assert printed == rundir.read_summary(flown / name)


def all_well(summary: dict[str, Any]) -> None:
    """What a careful liar writes."""
    summary["satisfied"] = summary["as_expected"] = True
    summary["verdict"] = "satisfied"
    for entry in summary["constraints"]:
        if not entry["satisfied"]:
            entry |= {
                "satisfied": True,
                "verdict": "satisfied",
                "time_violated": 0.0,
                "worst_margin": 5.0,
                "worst_margin_sampled": 5.0,
            }
            entry["peak_plant"] = entry["peak_sampled"] = entry["upper"] - 5.0


def loosened(summary: dict[str, Any]) -> None:
    all_well(summary)
    for entry in summary["constraints"]:
        entry["required"] = False


def none(summary: dict[str, Any]) -> None:
    summary |= {"constraints": [], "satisfied": True, "as_expected": True}


LIES: dict[str, tuple[Change, str]] = {
    "all well": (all_well, "speed: worst_margin_sampled is recorded as 5.0, and the tables give -42.8"),
    "not required": (loosened, "required is recorded as False, and is True in the scenario"),
    "no constraints": (none, "the constraints recorded are none, and the scenario's roll, pitch"),
    "satisfied alone": (lambda summary: summary.update(satisfied=True), "satisfied is recorded as True"),
    "longer": (lambda summary: summary.update(duration=60.0), "duration is recorded as 60.0, and the run's files give"),
    "another": (lambda summary: summary.update(scenario="paper"), "scenario is recorded as 'paper'"),
    "expected": (lambda summary: summary.update(expected="violated"), "expected is recorded as 'violated'"),
}


@pytest.mark.parametrize(("change", "message"), LIES.values(), ids=LIES)
def test_a_verdict_that_the_tables_do_not_give_is_reported(
    runs: Path, change: Change, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    rewrite(runs / "bad", change)
    for command in (["check"], ["compare", "--out", str(runs / "page")], ["video"]):
        assert main([*command[:1], str(runs / "bad"), *command[1:]]) == EXIT_WRONG_INPUT
        output = capsys.readouterr()
        assert message in output.err
        assert output.err.count("\n") == 1
    assert not (runs / "page").exists()


def put(run: Path, name: str, column: str, change: Callable[[Any], Any]) -> None:
    """Change a column of a table, and its hash, as one does who makes a mistake in writing it."""
    table = pq.read_table(run / name)
    values = change(table[column].to_numpy().copy())
    i = table.column_names.index(column)
    field = table.schema.field(column)
    pq.write_table(table.set_column(i, field, pa.array(values, field.type)), run / name)
    rehash(run, name)


def with_nan(values: Any) -> Any:
    values[3] = math.nan
    return values


@pytest.mark.parametrize(
    ("name", "column", "change", "message"),
    [
        (FLIGHT_FILE, "x", lambda x: x + 0.5, r"x at t = 0 s differs between flight\.parquet and plant\.parquet"),
        (PLANT_FILE, "y", with_nan, r"y at t = 0\.015 s of plant\.parquet is no finite number"),
        (FLIGHT_FILE, "u2", with_nan, r"u2 at t = 0\.15 s of flight\.parquet is no finite number"),
        (PLANT_FILE, "w3", lambda w: w + 1.0, r"w3 at t = 0 s of plant\.parquet is not the speed that flight"),
        (FLIGHT_FILE, "t", lambda t: t * 1.01, r"flight\.parquet does not have the 10 times k \* 0\.05 s"),
        (PLANT_FILE, "t", lambda t: t + 0.001, r"plant\.parquet does not have the 101 times k \* 0\.005 s"),
    ],
)
def test_tables_that_contradict_each_other_are_reported(
    runs: Path, name: str, column: str, change: Callable[[Any], Any], message: str
) -> None:
    put(runs / "good", name, column, change)
    with pytest.raises(FileError, match=message):
        reaudit(runs / "good")


@pytest.mark.slow("reaudit")
@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("slow-solver", {}),
        ("slow-solver", {"computation.delay": 0.12}),
        ("slow-solver", {"computation": {"delay": 0.06, "jitter": 0.03, "plan": False}}),
        ("robust", {"computation": {"delay": 0.06, "jitter": 0.03}, "controller.delay": 0.06}),
        pytest.param("stalled-solver", {"computation": {"delay": 0.06}}, marks=pytest.mark.representative("reaudit")),
    ],
)
def test_commands_are_followed_to_when_they_act(name: str, changes: dict[str, Any], tmp_path: Path) -> None:
    """Late, missed, held, bridged by a plan: plant.parquet has what flight.parquet commands, when it acts."""
    scenario = quadsim.load(name, {"log_rate": 1000.0, **changes}).replace({"duration": 2.5})
    flight = quadsim.fly(scenario, progress=False)
    flight.save(tmp_path / "run", video=False, recording=False, figures=False)
    assert reaudit(tmp_path / "run").summary["scenario"] == name
    control = flight.log.control
    plant = flight.log.plant
    speeds, known = _in_force(scenario, control, np.arange(plant.t.size - 1))
    np.testing.assert_array_equal(speeds[known], plant.speeds[:-1][known])
    assert 0.5 < known.mean() <= 1.0
    assert known.all() == (name != "robust")  # whose plan goes on while a command is late
    assert np.abs(np.repeat(control.speeds, 50, axis=0) - plant.speeds[:-1]).max() > 0.1

    def early(w: Any) -> Any:
        return np.append(w[1:], w[-1])

    put(tmp_path / "run", PLANT_FILE, "w1", early)
    with pytest.raises(FileError, match=r"plant\.parquet"):
        reaudit(tmp_path / "run")


@pytest.mark.parametrize("name", [FLIGHT_FILE, PLANT_FILE, TIMING_FILE, rundir.SCENARIO_FILE, "horizon.parquet"])
def test_a_changed_file_is_reported(flown: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    run = shutil.copytree(flown / "good", tmp_path / "run")
    (run / name).write_bytes((run / name).read_bytes() + b"#")
    assert main(["check", str(run)]) == EXIT_WRONG_INPUT
    assert f"{name} is not the file that was written" in capsys.readouterr().err


def test_a_run_of_a_solver_that_was_removed_says_so(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenario = runs / "good" / rundir.SCENARIO_FILE
    text = scenario.read_text()
    assert text.count('# solver = "piqp"') == 1
    scenario.write_text(text.replace('# solver = "piqp"', 'solver = "piqp-multistage-1"'))
    rehash(runs / "good", rundir.SCENARIO_FILE)
    message = "controller.solver: the solver 'piqp-multistage-1' was removed: use 'piqp-multistage'"
    with pytest.raises(InputError, match=message):
        quadsim.read(runs / "good")
    for command in ("check", "plot"):
        capsys.readouterr()
        assert main([command, str(runs / "good")]) == EXIT_WRONG_INPUT
        assert message in capsys.readouterr().err


def test_a_plant_that_goes_further_than_the_recorded_margin_shows(runs: Path) -> None:
    """The tables are at 200 Hz and the audit at 1 kHz: the recorded margin may be the smaller one, never the larger."""
    run = runs / "good"

    def change(roll: Any) -> Any:
        roll[55] = 0.05  # 2.9 deg, within the bounds, and between two control periods
        return roll

    put(run, PLANT_FILE, "roll", change)
    with pytest.raises(FileError, match=r"roll: worst_margin .* 2\.13"):
        reaudit(run)


def test_a_margin_between_the_rows_is_believed(flown: Path, tmp_path: Path) -> None:
    """A worse one than the tables show is no lie: there are four physics steps between two rows."""
    run = shutil.copytree(flown / "good", tmp_path / "run")

    def worse(summary: dict[str, Any]) -> None:
        entry = next(entry for entry in summary["constraints"] if entry["name"] == "roll")
        entry |= {"worst_margin": 4.0, "peak_plant": 1.0}

    rewrite(run, worse)
    assert reaudit(run).satisfied


@pytest.mark.slow("reaudit")
@pytest.mark.parametrize("rate", [1000.0, 1.0])
@pytest.mark.parametrize("name", ["nan-position", "hard-landing", "lost-rotor"])
def test_what_a_run_records_is_what_its_tables_give(
    name: str, rate: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fly_once: Callable[..., Flight]
) -> None:
    """Flights that end early, crash, or lack measurements: at any log rate the tables never contradict the record.

    Each is flown once: a log holds the plant at the physics rate, whatever the rate of its file.
    """
    flight = fly_once(name)
    scenario = flight.scenario.altered(log_rate=rate)
    monkeypatch.setattr(
        "quadsim.rollout.rollout.Rollout.fly",
        lambda *_, **__: replace(flight, scenario=scenario, assembly=Assembly(scenario)),
    )
    out = str(tmp_path / "run")
    status = main(["run", name, "--set", f"log_rate={rate}", *TABLES, "--json", "--out", out])
    assert main(["check", out]) == status
    again = reaudit(Path(out))
    for finding, entry in zip(again.findings, again.summary["constraints"], strict=True):
        recorded = entry["worst_margin"]
        assert recorded is None or math.isnan(finding.worst_margin) or recorded <= finding.worst_margin + 1e-6
        if rate == 1000.0 and recorded is not None:
            assert recorded == finding.worst_margin


STUCK = (
    "controller.fallback={}",
    'controller.polytopes=[{name = "left", of = ["x"], rows = [[1.0]], upper = [-0.5], required = false}]',
    "controller.output_bounds.x=[-0.1, 0.1]",
)


@pytest.fixture(scope="module")
def stuck(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight that holds every required constraint, and whose QP never has an answer."""
    target = tmp_path_factory.mktemp("stuck") / "run"
    options = [option for setting in STUCK for option in ("--set", setting)]
    assert main(["run", "hover", *SHORT, *TABLES, *options, "--json", "--out", str(target)]) == EXIT_FAILED
    return target


def test_permanent_fallback_is_no_success_and_reports_why(stuck: Path, capsys: pytest.CaptureFixture[str]) -> None:
    summary = rundir.read_summary(stuck)
    assert all(entry["satisfied"] for entry in summary["constraints"] if entry["required"])
    assert (summary["satisfied"], summary["as_expected"], summary["controller"]["unrecovered"]) == (False, False, 10)
    assert main(["check", str(stuck), "--junit", str(stuck.parent / "verdicts.xml")]) == EXIT_FAILED
    output = capsys.readouterr().out
    assert "completed, but in permanent fallback; violated, not required: " in output
    assert "10 periods in fallback, never recovered\n" in output
    assert "cannot hold together: left upper at +0.05 s .. +2.50 s by " in output
    assert "flown until 0.5 s, no change prevents it: controller." in " ".join(output.split())
    assert 'message="completed; 10 periods in fallback, never recovered; no answer at t = 0.00 s' in (
        stuck.parent / "verdicts.xml"
    ).read_text(encoding="utf-8")
    assert main(["check", str(stuck), "--json"]) == EXIT_FAILED
    printed = json.loads(capsys.readouterr().out)
    assert printed["diagnosis"] == summary["diagnosis"]
    assert printed["diagnosis"]["conflict"][0]["name"] == "left"
    assert printed["reaudit"]["satisfied"] is False
