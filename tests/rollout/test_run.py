"""Whole runs: equal bytes from equal scenarios, the summary of the contract, and flights that end early."""

from __future__ import annotations

import errno
import tomllib
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import NO_PRODUCTS

from quadsim.assets import vehicle_path
from quadsim.controller import SOLVED, UNCONSTRAINED
from quadsim.flight import rundir
from quadsim.flight.parquet import FLIGHT_FILE, HORIZON_FILE, PLANT_FILE, TIMING_FILE
from quadsim.rollout.flown import Flight
from quadsim.rollout.machine import PACKAGES
from quadsim.rollout.rollout import Rollout
from quadsim.rollout.stored import read_flight
from quadsim.scenarios.loading import load_scenario, parse_scenario
from quadsim.sim import loop

SHORT = "duration=0.5"
UPSIDE = "initial.euler=[60.0, 0.0, 0.0]"
"""A start from which no plan brings roll within its bound: the first QP is infeasible."""


TIMES = {"p50", "p95", "p99", "max"}
CONTRACT = {
    "": {"scenario", "status", "duration", "seed", "versions", "machine", "wall_s"},
    "tracking.rmse": {"x", "y", "z", "yaw"},
    "tracking.max_error": {"x", "y", "z", "yaw"},
    "tracking.final_error": {"x", "y", "z", "yaw"},
    "tracking.overshoot": {"x", "y", "z"},
    "tracking.settling.0": {"channel", "time", "before", "after"},
    "constraints.0": {"name", "unit", "lower", "upper", "tolerance", "satisfied", "time_violated"}
    | {"peak_sampled", "peak_plant", "worst_margin"},
    "control": {"speed_min", "speed_max", "slew_min", "slew_max", "total_variation"},
    "controller": {"name", "solver", "statuses", "fallbacks", "deadline_ms", "deadline_misses"},
    "controller.iterations": {"mean", "max"},
    "controller.solve_ms": TIMES,
    "controller.step_ms": TIMES,
    "wall_s": {"simulate", "total"},
}
"""Tables of the summary, and what each has at least."""


def run(target: Path, *settings: str, name: str = "paper-constrained") -> Flight:
    Rollout(load_scenario(name, settings)).fly().save(target, **NO_PRODUCTS)
    return read_flight(target)


def interrupt_after(periods: int) -> Callable[[str, int, int], None]:
    """A progress report that is Ctrl-C once so many periods are flown."""

    def report(stage: str, done: int, total: int) -> None:
        if stage == "flight" and done == periods:
            raise KeyboardInterrupt

    return report


# --- what a run is -------------------------------------------------------------------------------------------------


def test_equal_scenarios_give_equal_bytes(short_run_directory: Path, tmp_path: Path) -> None:
    again = run(tmp_path / "again", "duration=6.0").directory
    for name in (FLIGHT_FILE, PLANT_FILE, HORIZON_FILE, "scenario.toml"):
        assert (again / name).read_bytes() == (short_run_directory / name).read_bytes(), name
    assert (again / TIMING_FILE).read_bytes() != (short_run_directory / TIMING_FILE).read_bytes()  # a clock's


def test_the_summary_has_every_entry_of_the_contract(short_run: Flight) -> None:
    for path, keys in CONTRACT.items():
        value: Any = short_run.summary
        for key in filter(None, path.split(".")):
            value = value[int(key)] if isinstance(value, list) else value[key]
        assert value.keys() >= keys, path


def test_the_summary_is_that_of_the_flight(short_run: Flight) -> None:
    summary = short_run.summary
    log = short_run.log
    assert (summary["scenario"], summary["status"], summary["reason"]) == ("paper-constrained", "completed", None)
    assert (summary["duration"], summary["seed"]) == (6.0, 0)
    assert summary["controller"]["statuses"] == dict(sorted(Counter(log.control.status).items()))
    assert summary["controller"]["statuses"].keys() == {SOLVED, UNCONSTRAINED}
    assert summary["control"]["speed_max"] == log.control.speeds.max()
    assert summary["tracking"]["final_error"]["z"] == log.control.state[-1, 4] - log.control.reference[-1, 2]
    assert summary["wall_s"]["total"] >= summary["wall_s"]["simulate"] > 0.0
    assert set(summary["versions"]) == {"quadsim", "python", *PACKAGES}
    scenario = tomllib.loads((short_run.directory / "scenario.toml").read_text())
    assert [entry["name"] for entry in summary["constraints"]] == [entry["name"] for entry in scenario["constraints"]]
    assert parse_scenario(scenario).vehicle.mass == summary["vehicle"]["mass"] == 4.0


def test_the_audit_sees_the_physics_rate_whatever_the_log_rate(tmp_path: Path) -> None:
    dense, sparse = (run(tmp_path / rate, "duration=2.0", f"log_rate={rate}") for rate in ("1000", "20"))
    assert (dense.log.plant.t.size, sparse.log.plant.t.size) == (2001, 41)
    assert dense.summary["constraints"] == sparse.summary["constraints"]
    margin = min(5.0 - np.abs(np.degrees(dense.log.plant.state[:, 6])))
    assert dense.summary["constraints"][0]["worst_margin"] == pytest.approx(margin)


# --- flights that end early ----------------------------------------------------------------------------------------


def test_a_flight_that_cannot_begin_is_recorded_with_its_reason(tmp_path: Path) -> None:
    flown = run(tmp_path / "run", UPSIDE, "controller.horizon=10")
    reason = "at t = 0.000 s: the solver answered 'primal_infeasible' with no plan to hold"
    assert (flown.summary["status"], flown.summary["reason"]) == ("aborted", reason)
    assert (flown.log.status, flown.log.reason) == ("aborted", reason)
    assert flown.summary["satisfied"] is False
    assert flown.summary["duration"] == 0.0
    assert flown.summary["tracking"] == flown.summary["control"] == {}
    assert (flown.log.control.t.size, flown.log.plant.t.size) == (0, 1)
    assert np.degrees(flown.log.plant.state[0, 6]) == pytest.approx(60.0)
    assert {"scenario.toml", FLIGHT_FILE, TIMING_FILE, PLANT_FILE} == set(flown.summary["files"])


def test_ctrl_c_in_flight_keeps_what_was_flown(short_run: Flight, tmp_path: Path) -> None:
    scenario = load_scenario("paper-constrained", ["duration=6.0"])
    flight = Rollout(scenario).fly(interrupt_after(33))
    flight.save(tmp_path / "run", **NO_PRODUCTS)
    flown = read_flight(tmp_path / "run")
    assert flight.log.interrupted
    assert flown.summary["reason"] == "at t = 1.650 s: interrupted (Ctrl-C)"
    assert flown.log.control.t.size == 33
    assert flown.log.plant.t[-1] == 1.65
    assert rundir.damaged_files(flown.directory, flown.summary) == []
    np.testing.assert_array_equal(flight.log.control.speeds, short_run.log.control.speeds[:33])


# --- nothing is ever half written ----------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_a_run_whose_product_fails_keeps_all_else_and_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    def failing(*_: object) -> None:
        raise error

    monkeypatch.setattr("quadsim.report.flight_figures.write_figures", failing)
    Rollout(load_scenario("hover", [SHORT])).fly().save(tmp_path / "run", video=False)
    summary = rundir.read_summary(tmp_path / "run")
    assert summary["products"].keys() == {"figures", "flight.rrd"}
    assert summary["products"]["figures"].startswith(
        "interrupted" if isinstance(error, KeyboardInterrupt) else "failed: "
    )
    assert rundir.damaged_files(tmp_path / "run", summary) == []
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_defect_of_our_own_is_not_taken_for_a_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only typed flight errors and Ctrl-C become a reason; a bug must be seen, and leave nothing behind."""

    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(loop.Plant, "hold", broken)
    with pytest.raises(ZeroDivisionError):
        run(tmp_path / "new" / "run", SHORT)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("undrawn")
def test_outputs_are_made_as_requested(tmp_path: Path) -> None:
    Rollout(load_scenario("hover", [SHORT])).fly().save(tmp_path / "run", video=False)
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert names == {
        "summary.json", "scenario.toml", FLIGHT_FILE, TIMING_FILE, PLANT_FILE, HORIZON_FILE, "flight.rrd", "figures",
    }  # fmt: skip
    assert list((tmp_path / "run" / "figures").glob("*.png"))
    assert rundir.damaged_files(tmp_path / "run", rundir.read_summary(tmp_path / "run")) == []


def test_a_resolved_scenario_flies_without_its_vehicle_file(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(vehicle_path("lopes2011").read_text().replace('name = "lopes2011"', 'name = "mine"'))
    settings = [f"vehicle.file={file}", "vehicle.mass=4.2", "duration=0.5"]
    first = Rollout(load_scenario("hover", settings)).fly()
    file.unlink()
    again = Rollout(parse_scenario(tomllib.loads(first.scenario.to_toml()))).fly()
    assert again.vehicle == replace(first.vehicle, description="")
    assert again.log.control.speeds.tolist() == first.log.control.speeds.tolist()
