"""A flight is one record: nothing that it holds is read back, and a directory read is the flight that was written."""

from __future__ import annotations

import cProfile
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import NO_PRODUCTS

import quadsim
from quadsim.commands.cli import main
from quadsim.errors import InputError
from quadsim.flight.parquet import read_parquet
from quadsim.flight.rundir import finding_from_json, limit_from_json, limit_to_json, read_json
from quadsim.outputs import to_json
from quadsim.report.film import video
from quadsim.rollout.flown import Flight
from quadsim.rollout.stored import read_flight
from quadsim.scenarios.assembly import Assembly

SHORT = {"duration": 0.5}
STUCK = {
    **SHORT,
    "controller.fallback": {},
    "controller.polytopes": [{"name": "left", "of": ["x"], "rows": [[1.0]], "upper": [-0.5], "required": False}],
    "controller.output_bounds.x": [-0.1, 0.1],
}
READING = (read_json, limit_from_json, finding_from_json, read_parquet)
"""What translates files back."""


def counted(work: Callable[[], object]) -> Callable[[Callable[..., Any]], int]:
    """Do some work; return a function that says how often it called another one."""
    profile = cProfile.Profile()
    profile.runcall(work)
    calls = {entry.code: entry.callcount for entry in profile.getstats()}
    return lambda function: calls.get(function.__code__, 0)


def run(scenario: Any, out: Path, changes: Any = SHORT, **options: Any) -> Flight:
    return quadsim.run(scenario, out=out, changes=changes, progress=False, **NO_PRODUCTS, **options)


@pytest.mark.usefixtures("undrawn")
def test_the_process_that_flew_builds_once_and_reads_nothing_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def film(run: object, shot: object, path: Path, *_: object) -> str:
        path.write_bytes(b"film")
        return "none"

    monkeypatch.setattr(video, "_film", film)
    out = tmp_path / "run"
    calls = counted(lambda: main(["run", "hover", "--set", "duration=0.5", "--out", str(out)]))
    assert "every required constraint holds" in capsys.readouterr().out
    assert {"flight.mp4", "flight.rrd", "plant.parquet"} <= {path.name for path in out.iterdir()}
    summary = json.loads((out / "summary.json").read_text())
    assert calls(Assembly.__init__) == 1
    assert [calls(function) for function in READING] == [0, 0, 0, 0]
    assert calls(limit_to_json) == len(summary["constraints"]), "each finding is written once"


def test_a_flight_shows_itself_whatever_became_of_its_directory(tmp_path: Path) -> None:
    place = tmp_path / "run"
    one = run("hover", place)
    before = one.text(), one.to_json(), one.exit_status
    never = {"name": "other", "constraints": [{"name": "never", "signal": "z", "lower": 5.0}]}
    other = run("hover", place, {**SHORT, **never}, overwrite=True)
    assert other.exit_status == 1
    assert "a required constraint is violated: never" in other.text()
    assert (one.text(), one.to_json(), one.exit_status) == before
    assert one.outcome == "satisfied"
    shutil.rmtree(place)
    assert (one.text(), one.to_json(), one.exit_status) == before


@pytest.mark.parametrize(("name", "changes"), [("hover", SHORT), ("hover", STUCK), ("lost-rotor", {"duration": 4.0})])
def test_what_is_read_is_the_flight_that_was_written(name: str, changes: dict[str, Any], tmp_path: Path) -> None:
    flown = run(name, tmp_path / "run", changes)
    written = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert json.loads(to_json(flown.to_json())) == written
    assert set(written["files"]) == {path.name for path in (tmp_path / "run").iterdir()} - {"summary.json"}
    read = quadsim.read(tmp_path / "run")
    assert read.to_json() == written
    assert read.text() == flown.text()
    assert repr(read) == repr(flown)
    numbers = [[vars(finding) for finding in flight.findings] for flight in (read, flown)]
    assert repr(numbers[0]) == repr(numbers[1]), "numbers are the same bits; a margin that is none is NaN"
    assert (read.outcome, read.exit_status, read.scenario) == (flown.outcome, flown.exit_status, flown.scenario)
    assert read.verdicts() == flown.verdicts()
    assert (read.vehicle, read.actual, read.limits) == (flown.vehicle, flown.actual, flown.limits)
    stored = flown.as_stored()
    np.testing.assert_array_equal(read.log.plant.state, stored.log.plant.state)
    np.testing.assert_array_equal(read.log.control.truth, stored.log.control.truth)
    assert (read.diagnosis is None) == (changes is SHORT)


def test_a_check_of_a_run_is_its_flight_with_the_new_audit(tmp_path: Path) -> None:
    run("hover", tmp_path / "run")
    (tmp_path / "run" / "note.txt").write_text("mine")
    checked = quadsim.check(tmp_path / "run")
    assert isinstance(checked, Flight)
    assert checked.notes == ("not of this run: note.txt",)
    assert checked.checked is not None
    assert checked.checked.again is not None
    assert [finding.limit for finding in checked.checked.again] == [*checked.limits]
    assert checked.to_json()["reaudit"]["notes"] == [*checked.notes]
    last = "audited again from the tables, 200 rows per second: as recorded"
    assert checked.text().splitlines()[-1] == last, "a check writes nothing"
    assert quadsim.read(tmp_path / "run").notes == ()
    unaudited = {**SHORT, "constraints": [], "controller": {"type": "pid"}}
    flown = run("hover", tmp_path / "unaudited", unaudited)
    assert (flown.outcome, flown.exit_status) == ("unaudited", 0)
    assert quadsim.check(tmp_path / "unaudited").exit_status == 1, "nothing shows that it holds"


@pytest.mark.usefixtures("undrawn")
def test_a_comparison_reads_a_directory_once_and_no_flight_that_it_holds(tmp_path: Path) -> None:
    one = run("hover", tmp_path / "one")
    two = quadsim.fly("hover", progress=False)
    three = quadsim.load("hover", {**SHORT, "controller": {"type": "pid"}})

    def compare() -> None:
        results.append(quadsim.compare(one, two, three, out=tmp_path / "page", progress=False, **NO_PRODUCTS))

    results: list[Any] = []
    calls = counted(compare)
    assert [calls(function) for function in READING] == [0, 0, 0, 0]
    (compared,) = results
    before = compared.text(), compared.to_json(), repr(compared)
    shutil.rmtree(tmp_path / "one")
    assert (compared.text(), compared.to_json(), repr(compared)) == before
    places = [tmp_path / "page-runs" / name for name in ("hover", "hover-2")]
    calls = counted(lambda: quadsim.compare(*places, progress=False))
    assert calls(read_flight) == 2
    assert calls(read_json) == 4, "whether it is a run of this version, and its form"


def test_a_run_of_an_earlier_version_that_states_who_compiles_is_read(tmp_path: Path) -> None:
    """It flew as it would now; to fly it anew, its file must do without."""
    event = {"type": "controller", "at": 0.2, "fields": {"horizon": 45}}
    run("robust", tmp_path / "run", SHORT | {"events": [event]})
    tables = read_flight(tmp_path / "run").scenario.tables
    file = tmp_path / "run" / "scenario.toml"
    text = file.read_text()
    stated = text.replace("[controller]\n", "[controller]\ncompiled = true\n", 1)
    stated = stated.replace("\nhorizon = 45\n", "\nhorizon = 45\ncompiled = false\n", 1)
    assert stated.count("compiled =") == 2
    file.write_text(stated)
    assert read_flight(tmp_path / "run").scenario.tables == tables
    with pytest.raises(InputError, match=r"controller\.compiled must be left out, as it went \(C .*; got True"):
        quadsim.load(file)
