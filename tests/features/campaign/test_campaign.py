"""Whole campaigns of short flights: the same results whoever flies them, nothing lost, and wrong uses refused."""

from __future__ import annotations

import html
import json
import os
import re
import shutil
import subprocess
import sys
import time as clock
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import tomlkit

from quadsim.errors import InputError, OutputError
from quadsim.features.campaign import campaign, store
from quadsim.features.campaign.campaign import CampaignProgress, compare_replay, recorded_flight
from quadsim.features.campaign.campaign import CampaignResult as Result
from quadsim.features.campaign.campaign_file import Choice
from quadsim.features.campaign.events import parse_event
from quadsim.features.campaign.plan import Plan, load_plan
from quadsim.features.campaign.rows import TIMES, read_table
from quadsim.features.campaign.store import read_manifest
from quadsim.outputs import SUMMARY_FILE, Growing, digest_of
from quadsim.rollout.machine import processor_name
from quadsim.rollout.many import Row
from quadsim.rollout.rollout import Rollout

pytestmark = pytest.mark.slow("campaigns")

CAMPAIGN: dict[str, Any] = {
    "name": "little",
    "scenario": "hover",
    "flights": 12,
    "seed": 4,
    "failure": ["lost", "max_error.z > 0.2"],
    "set": {"duration": 0.5, "constraints": [], "controller": {"horizon": 4}},
    "vary": [
        {"name": "mass", "fields": ["effects.load.mass_factor"], "distribution": "uniform", "low": 0.5, "high": 1.5}
    ],
}


@dataclass
class Alone:
    """Flies a campaign in this process.

    Attributes:
        backwards: whether the last flight is the first that is flown.
        stops_after: the number of flights after which it is interrupted.
    """

    backwards: bool = False
    stops_after: int | None = None

    def fly(self, plan: Plan, flights: Sequence[int]) -> Generator[Row, None, None]:
        if self.backwards:
            flights = flights[::-1]
        for count, flight in enumerate(flights):
            if count == self.stops_after:
                raise KeyboardInterrupt
            yield plan.fly(flight)


def fly_campaign(plan: Plan, directory: Path, by: Alone | int, *, report: bool = False, **options: Any) -> Result:
    """Fly a campaign in this process, or by so many workers."""
    if isinstance(by, int):
        return campaign.fly_campaign(plan, directory, workers=by, report=report, **options)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Plan, "fly_all", lambda plan, flights, **_: by.fly(plan, [*flights]))
        return campaign.fly_campaign(plan, directory, workers=None, report=report, **options)


def make_plan(directory: Path, **changes: Any) -> Plan:
    """The plan of a file in the directory: `CAMPAIGN` with other fields."""
    path = directory / "little.toml"
    path.write_text(tomlkit.dumps({**CAMPAIGN, **changes}), encoding="utf-8")
    return load_plan(str(path))


@pytest.fixture
def plan(tmp_path: Path) -> Plan:
    return make_plan(tmp_path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """The campaign of `plan`, flown to its end without a report; nobody changes its directory."""
    here = tmp_path_factory.mktemp("whole")
    return fly_campaign(make_plan(here), here / "c", Alone())


@pytest.fixture(scope="module")
def by_two(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """The same, flown by two processes."""
    here = tmp_path_factory.mktemp("two")
    return fly_campaign(make_plan(here), here / "c", 2)


@pytest.fixture
def flown(whole: Result, tmp_path: Path) -> Path:
    """A copy of the directory of `whole`, to continue or to tamper with."""
    return Path(shutil.copytree(whole.directory, tmp_path / "c"))


def content(result: Result) -> tuple[bytes, bytes]:
    """The bytes of the flights and of the summary, which depend on no clock and no machine."""
    flights = result.directory / "flights.parquet"
    summary = result.directory / SUMMARY_FILE
    return flights.read_bytes(), summary.read_bytes()


@pytest.mark.representative("campaigns")
def test_results_are_the_same_bytes_with_any_worker(plan: Plan, whole: Result, by_two: Result, tmp_path: Path) -> None:
    backwards = fly_campaign(plan, tmp_path / "backwards", Alone(backwards=True))
    by_one = fly_campaign(plan, tmp_path / "one", 1)
    for result in (backwards, by_one, by_two):
        assert content(result) == content(whole)
    assert whole.table.num_rows == 12
    assert {*whole.table["failed"].to_pylist()} == {True, False}


def test_the_summary_with_a_report_is_the_same_bytes_by_one_worker_and_by_two(plan: Plan, tmp_path: Path) -> None:
    """The page names its directory, the manifest and the clock times their session: none of these has a hash."""
    by_one = fly_campaign(plan, tmp_path / "by-1", 1, report=True)
    by_two = fly_campaign(plan, tmp_path / "by-2", 2, report=True)
    assert content(by_one) == content(by_two)
    summary = json.loads((by_one.directory / SUMMARY_FILE).read_text())
    assert set(summary["files"]) == {"campaign.png", "campaign.toml", "flights.parquet", "scenario.toml"}
    again = fly_campaign(plan, by_one.directory, 2, overwrite=True)
    assert again.table.equals(by_one.table)


def test_what_was_flown_stays_and_the_rest_follows(plan: Plan, whole: Result, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        fly_campaign(plan, tmp_path / "again", Alone(backwards=True, stops_after=5))
    manifest = read_manifest(tmp_path / "again")
    assert (manifest["status"], manifest["flown"]) == ("interrupted", 5)
    seen: list[CampaignProgress] = []
    resumed = fly_campaign(plan, tmp_path / "again", Alone(), resume=True, watch=seen.append)
    assert [progress.flown for progress in seen] == [6, 7, 8, 9, 10, 11, 12]
    assert content(resumed) == content(whole)
    assert [session["flights"] for session in resumed.manifest["sessions"]] == [5, 7]


def test_resuming_a_finished_campaign_flies_nothing(plan: Plan, whole: Result, flown: Path) -> None:
    assert content(fly_campaign(plan, flown, Alone(stops_after=0), resume=True)) == content(whole)


def test_more_flights_may_follow(flown: Path, tmp_path: Path) -> None:
    more = make_plan(tmp_path, flights=15)
    grown = fly_campaign(more, flown, Alone(), resume=True)
    at_once = fly_campaign(more, tmp_path / "d", Alone())
    assert content(grown) == content(at_once)
    assert (grown.manifest["flights"], grown.manifest["flown"]) == (15, 15)


CONTROLLER = """
import ctypes, os, signal, sys, time

class Mine:
    warm = []

    def __init__(self, vehicle, period, horizon, kind="calm"):
        self.speeds = [vehicle.hover_speed] * 4
        self.kind = kind

    def step(self, now, state, reference):
        if self.kind == "warms":
            self.warm.append(1)
            return [speed + 0.1 * len(self.warm) for speed in self.speeds]
        if self.kind == "sleeps":
            time.sleep(0.03)
        if self.kind == "raises":
            raise ZeroDivisionError("of its\\n\\x1b own")
        if self.kind == "dies":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.kind == "hangs":
            ctypes.PyDLL(None).sleep(1000)
        if self.kind == "takes memory":
            bytearray(1 << 33)
        return self.speeds
"""
"""A controller of the user's; `kind` is what it does beside hovering."""


CLIMBING = """
def law(now, state, reference):
    return [202.0] * 4
"""
"""A controller of the user's that climbs, ever faster; hover is at 192.8 rad/s."""


def plan_of_kinds(directory: Path, *kinds: str, **changes: Any) -> Plan:
    """A flight for each kind of the controller."""
    module = f"mine_{abs(hash(directory))}"  # a process imports a module of one name from one directory only
    (directory / f"{module}.py").write_text(CONTROLLER, encoding="utf-8")
    varied = {"name": "kind", "fields": ["controller.settings.kind"], "distribution": "grid", "values": [*kinds]}
    controller = {"type": f"{module}:Mine", "settings": {"kind": "calm"}, "folder": "."}
    settings = {"duration": 0.5, "constraints": [], "controller": controller}
    fields = {"vary": [varied], "flights": len(kinds), "set": settings}
    return make_plan(directory, **(fields | changes))


def test_a_flight_that_leaves_its_course_counts_as_lost(tmp_path: Path) -> None:
    (tmp_path / "climbing.py").write_text(CLIMBING, encoding="utf-8")
    limits = {"name": "limit", "fields": ["lost.departure"], "distribution": "grid", "values": [90.0, 4.0]}
    controller = {"type": "climbing:law", "horizon": 1, "folder": "."}
    settings = {"duration": 6.0, "constraints": [], "lost": {"departure": 4.0}, "controller": controller}
    plan = make_plan(tmp_path, vary=[limits], flights=2, set=settings)
    result = fly_campaign(plan, tmp_path / "c", Alone())
    assert result.table["verdict"].to_pylist() == ["unaudited", "lost"]
    none, departed = result.table["reason"].to_pylist()
    assert none is None
    assert "beyond lost.departure = 4 m" in departed
    assert result.table["status"].to_pylist() == ["completed", "completed"]
    assert result.summary["events"]["lost"]["count"] == 1


def test_a_bad_flight_is_a_row_with_its_verdict_and_reason(tmp_path: Path) -> None:
    kinds = ("calm", "raises", "dies", "hangs", "takes memory")
    plan = plan_of_kinds(tmp_path, *kinds, limits={"flight": 4.0, "memory": 500.0}, failure=["violated"])
    result = fly_campaign(plan, tmp_path / "c", 2, report=True)
    table = result.table
    assert table["verdict"].to_pylist() == ["unaudited", "error", "died", "timeout", "memory"]
    assert table["failed"].to_pylist() == [False, True, True, True, True]
    none, raised, died, hung, memory = table["reason"].to_pylist()
    assert none is None
    assert raised.endswith("ZeroDivisionError: of its"), "the first line of what was raised"
    assert "signal 9" in died
    assert "4 s" in hung
    assert "MemoryError" in memory
    events = result.summary["events"]
    assert events["failure"]["count"] == 4
    assert events["died"]["count"] == 1
    assert events["lost"]["count"] == 0
    page = (result.directory / "index.html").read_text(encoding="utf-8")
    for reason in (died, hung, memory):
        assert reason in page


def test_flights_of_a_users_controller_do_not_change_each_other(tmp_path: Path) -> None:
    """A list of the class grows with every step: a second flight in the same process would differ."""
    plan = plan_of_kinds(tmp_path, "warms", vary=CAMPAIGN["vary"], flights=6)
    by_one = fly_campaign(plan, tmp_path / "by-1", 1)
    by_two = fly_campaign(plan, tmp_path / "by-2", 2)
    assert content(by_one) == content(by_two)
    first_only = plan_of_kinds(tmp_path, "warms", vary=CAMPAIGN["vary"], flights=1)
    first = fly_campaign(first_only, tmp_path / "a", 1)
    assert by_one.table["rmse.z"][0] == first.table["rmse.z"][0]


def test_code_of_the_user_is_known_in_the_scenario_and_in_what_is_varied(tmp_path: Path) -> None:
    assert plan_of_kinds(tmp_path, "calm").flies_user_code
    plan = make_plan(tmp_path)
    assert not plan.flies_user_code
    drawn = Choice(name="law", fields=["controller"], distribution="choice", values=["mine:Mine"])
    drawing = replace(plan, spec=replace(plan.spec, vary=[drawn]))
    assert drawing.flies_user_code


def test_a_campaign_that_is_killed_resumes_to_the_same_bytes(tmp_path: Path) -> None:
    """Three times by SIGKILL, each time as soon as it has stored a part more."""
    plan = plan_of_kinds(tmp_path, "sleeps", vary=CAMPAIGN["vary"], flights=16)
    stores_often = "from quadsim.features.campaign import store; store.FLUSH_S = 0.2"
    program = f"{stores_often}; from quadsim.commands.cli import main; main()"
    options = ("little.toml", "--out", "c", "--workers", "2", "--no-report", "--resume")
    command = [sys.executable, "-c", program, "campaign", *options]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    parts = tmp_path / "c" / "parts"
    for stored_before in range(3):
        process = subprocess.Popen(command, cwd=tmp_path, env=environment)
        while len(list(parts.glob("*"))) <= stored_before:
            assert process.poll() is None, "it ended before another part was stored"
            clock.sleep(0.02)
        process.kill()
        process.wait()
    assert not (tmp_path / "c" / SUMMARY_FILE).exists()
    subprocess.run(command, cwd=tmp_path, env=environment, check=True)
    again = fly_campaign(plan, tmp_path / "whole", 2)
    for name in ("flights.parquet", SUMMARY_FILE):
        assert (tmp_path / "c" / name).read_bytes() == (again.directory / name).read_bytes()


def test_it_stops_when_the_interval_is_narrow_enough_at_the_same_flight_whoever_flies_it(tmp_path: Path) -> None:
    plan = make_plan(tmp_path, flights=40)
    by_one = fly_campaign(plan, tmp_path / "one", Alone(), until_width=0.5)
    by_two = fly_campaign(plan, tmp_path / "two", 2, until_width=0.5)
    assert content(by_one) == content(by_two)
    assert by_one.table.num_rows in (10, 20, 30)
    assert by_one.manifest["status"] == "stopped"
    share = by_one.summary["events"]["failure"]
    assert share["upper"] - share["lower"] <= 0.5
    resumed = fly_campaign(plan, tmp_path / "one", Alone(), resume=True)
    assert (resumed.table.num_rows, resumed.manifest["status"]) == (40, "complete")


@pytest.mark.usefixtures("undrawn")
def test_a_manifest_states_what_was_flown(plan: Plan, tmp_path: Path) -> None:
    result = fly_campaign(plan, tmp_path / "c", Alone(), report=True)
    manifest = read_manifest(result.directory)
    assert manifest == result.manifest
    assert (manifest["name"], manifest["status"], manifest["flights"]) == ("little", "complete", 12)
    assert manifest["files"] == {"timing.parquet": digest_of(result.directory / "timing.parquet")}
    assert manifest["versions"]["mujoco"]
    assert manifest["code"].startswith("sha256:")
    assert manifest["machines"] == {processor_name(): 12}
    summary = json.loads((result.directory / SUMMARY_FILE).read_text())
    assert {"campaign.toml", "scenario.toml", "flights.parquet"} <= set(summary["files"])
    assert summary["unhashed"] == ["index.html", "manifest.json", "timing.parquet"]
    assert read_table(result.directory / "flights.parquet").equals(result.table)


@pytest.mark.usefixtures("undrawn")
def test_the_page_counts_the_flights_that_fail_by_the_definition_it_states(plan: Plan, tmp_path: Path) -> None:
    result = fly_campaign(plan, tmp_path / "c", Alone(), report=True)
    page = html.unescape((result.directory / "index.html").read_text(encoding="utf-8"))
    assert "12 of 12 " in page
    assert '<a href="summary.json">' in page
    (definition,) = re.findall(r"Counted as failure: (.*?) m\.", page)  # the unit of the last event's number
    events = [parse_event(text) for text in definition.split(", ")]
    failed = 0
    for row in result.table.to_pylist():
        failed += any(event.holds(row) for event in events)
    assert 0 < failed < 12
    assert f">{failed} of 12 " in page


# --- what is refused -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"seed": 5}, "seed"),
        ({"flights": 11}, "flights"),
        ({"failure": ["lost"]}, "failure"),
        ({"set": {"duration": 1.0, "constraints": []}}, "scenario"),
        ({"vary": []}, "vary"),
    ],
)
def test_another_campaign_does_not_go_on_with_it(
    flown: Path, tmp_path: Path, changes: dict[str, Any], named: str
) -> None:
    other = make_plan(tmp_path, **changes)
    with pytest.raises(InputError, match=f"its {named} "):
        fly_campaign(other, flown, Alone(), resume=True)
    with pytest.raises(OutputError, match="--resume"):
        fly_campaign(other, flown, Alone())


def test_a_latin_hypercube_does_not_grow(tmp_path: Path) -> None:
    fly_campaign(make_plan(tmp_path, sampling="latin_hypercube"), tmp_path / "c", Alone())
    more = make_plan(tmp_path, sampling="latin_hypercube", flights=15)
    with pytest.raises(InputError, match="latin_hypercube"):
        fly_campaign(more, tmp_path / "c", Alone(), resume=True)


def test_other_code_does_not_go_on_with_it(
    plan: Plan, flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store, "code_digest", lambda: "sha256:other")
    with pytest.raises(InputError, match=r"\(code\)"):
        fly_campaign(make_plan(tmp_path, flights=13), flown, Alone(), resume=True)
    complete = fly_campaign(plan, flown, Alone(), resume=True)
    assert complete.manifest["code"] != "sha256:other", "no flight is missing: the code that flew them stays stated"


def test_another_controller_of_the_user_does_not_go_on_with_it(tmp_path: Path) -> None:
    code = "def law(now, state, reference):\n    return [{speed}] * 4\n"
    settings = {"duration": 0.5, "constraints": [], "controller": "hovers:law"}
    (tmp_path / "hovers.py").write_text(code.format(speed=192.8), encoding="utf-8")
    fly_campaign(make_plan(tmp_path, set=settings, flights=2), tmp_path / "c", Alone())
    (tmp_path / "hovers.py").write_text(code.format(speed=193.8), encoding="utf-8")
    more = make_plan(tmp_path, set=settings, flights=3)
    with pytest.raises(InputError, match=r"\(controller\)"):
        fly_campaign(more, tmp_path / "c", Alone(), resume=True)


def test_a_narrow_interval_does_not_take_flights_away(plan: Plan, flown: Path) -> None:
    with pytest.raises(InputError, match="--until-width"):
        fly_campaign(plan, flown, Alone(), resume=True, until_width=0.7)
    assert read_table(flown / "flights.parquet").num_rows == 12


def test_grids_are_gone_through_in_whole_turns(tmp_path: Path) -> None:
    grid = {"name": "turn", "fields": ["initial.euler.2"], "distribution": "grid", "values": [0.0, 1.0, 2.0]}
    plan = make_plan(tmp_path, flights=60, vary=[grid], failure=["lost"])
    result = fly_campaign(plan, tmp_path / "c", Alone(), until_width=0.3)
    drawn = result.table["draw.turn"].to_pylist()
    for value in (0.0, 1.0, 2.0):
        assert drawn.count(value) == 10


@pytest.mark.parametrize("dies_after", ["manifest.json", "campaign.toml"])
def test_dying_while_it_grows_locks_nothing_out(
    flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dies_after: str
) -> None:
    more = make_plan(tmp_path, flights=15)
    write = Growing.write

    def write_and_die(self: Growing, files: Mapping[str, bytes]) -> None:
        write(self, files)
        if dies_after in files:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Growing, "write", write_and_die)
        with pytest.raises(KeyboardInterrupt):
            fly_campaign(more, flown, Alone(), resume=True)
    assert fly_campaign(more, flown, Alone(), resume=True).table.num_rows == 15


@pytest.mark.usefixtures("undrawn")
def test_a_report_of_fewer_flights_is_removed(plan: Plan, tmp_path: Path) -> None:
    fly_campaign(plan, tmp_path / "c", Alone(), report=True)
    fly_campaign(make_plan(tmp_path, flights=14), tmp_path / "c", Alone(), resume=True)
    assert not (tmp_path / "c" / "index.html").exists()


# --- replay --------------------------------------------------------------------------------------------------------


def test_a_replayed_flight_gives_the_campaigns_numbers(by_two: Result) -> None:
    worst = recorded_flight(by_two.directory, None)
    assert worst.number == by_two.summary["worst"][0]["flight"]
    for number in (None, 0, 7):
        recorded = recorded_flight(by_two.directory, number)
        flight = Rollout(recorded.scenario).fly()
        assert compare_replay(flight, recorded).differing == []
        assert flight.log.control.t.size == 10


def test_a_replay_names_the_columns_that_differ(whole: Result) -> None:
    recorded = recorded_flight(whole.directory, 3)
    altered = replace(recorded, row={**recorded.row, "rmse.z": 0.0, "draw.mass": 0.0, "gone": 1.0})
    flight = Rollout(altered.scenario).fly()
    assert sorted(compare_replay(flight, altered).differing) == ["draw.mass", "gone", "rmse.z"]


def test_a_replay_by_other_code_is_noted(whole: Result, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "code_digest", lambda: "sha256:other")
    (note,) = recorded_flight(whole.directory, 3).notes
    assert "other code" in note


def test_a_campaign_whose_files_were_changed_is_not_replayed(flown: Path) -> None:
    timing = flown / "timing.parquet"
    content_before = timing.read_bytes()
    timing.write_bytes(b"")
    with pytest.raises(InputError, match=r"timing\.parquet"):
        recorded_flight(flown, 0)
    timing.write_bytes(content_before)
    scenario = flown / "scenario.toml"
    scenario.write_text(scenario.read_text().replace("duration = 0.5", "duration = 0.6"))
    with pytest.raises(InputError, match=r"scenario\.toml"):
        recorded_flight(flown, 0)


def test_rows_of_flights_in_the_core_are_those_of_the_loop() -> None:
    """But for the clock times that they took."""
    plan = load_plan("paper-robustness-robust", ["duration=2"])
    for flight in (0, 1):
        assert Rollout(plan.of(flight)).core_law is not None
        row = plan.fly(flight)
        of_loop = plan.row_of(flight, Rollout(plan.of(flight)).fly())
        for name in of_loop.keys() - {*TIMES}:
            assert row[name] == of_loop[name], name
        assert row["machine"] == of_loop["machine"]
