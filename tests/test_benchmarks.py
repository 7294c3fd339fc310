"""Each benchmark from end to end with `--quick`: a table, and records with the numbers that the documents show."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from quadsim.errors import RenderingUnavailableError
from quadsim.report.film.video import rendering_backend

pytestmark = pytest.mark.slow("benchmarks")

ROOT = Path(__file__).parent.parent


def script(*command: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *command], cwd=ROOT, capture_output=True, text=True)


def quick(name: str, tmp_path: Path, *options: str) -> list[dict[str, Any]]:
    """The records of a benchmark, whose table has to show each."""
    file = tmp_path / f"{name}.json"
    done = script(f"benchmarks/{name}.py", "--quick", *options, "--json", file)
    assert done.returncode == 0, done.stderr
    written = json.loads(file.read_text())
    assert written["machine"]
    records: list[dict[str, Any]] = written["records"]
    for record in records:
        assert next(iter(record.values())) in done.stdout
    return records


def test_solvers_agree_on_the_optimum(tmp_path: Path) -> None:
    records = {(record["scenario"], record["solver"]): record for record in quick("solvers", tmp_path)}
    names = ["piqp-multistage", "piqp-dense", "daqp", "core"]
    for record in (records[scenario, name] for scenario in ("paper-constrained", "robust") for name in names):
        assert not record["failures"]
        assert record["largest_difference_rad_s"] < 1e-3
        assert 0.0 < record["p50_ms"] <= record["p99_ms"] <= record["max_ms"]


@pytest.mark.representative("benchmarks")
def test_two_solvers_of_one_scenario_have_a_record_each(tmp_path: Path) -> None:
    names = ["piqp-multistage", "piqp-dense"]
    records = quick("solvers", tmp_path, "--scenario", "paper-constrained", "--solvers", *names)
    assert [record["solver"] for record in records] == names
    assert not any(record["failures"] for record in records)


def test_flights_with_and_without_their_controllers(tmp_path: Path) -> None:
    *flights, step, sample = quick("flight", tmp_path)
    for record in flights:
        assert 0.0 < record["without_the_controller_ms_per_s"] < record["whole_ms_per_s"]
        assert record["whole_us_per_step"] > 0.2 * step["whole_us_per_step"]
    assert sample["whole_us_per_step"] < 20.0


def test_nonlinear_steps_alone_in_flight_and_beside_acados(tmp_path: Path) -> None:
    records = quick("nonlinear", tmp_path)
    flights, cases = ([record for record in records if first in record] for first in ("flight", "case"))
    for record in flights:
        assert 0.0 < record["C_p50_ms"] <= record["C_p99_ms"]
        assert record["C_p50_ms"] < record["step_p50_ms"]
        assert record["KKT_worst"] < 1e-6
    assert max(record["most_active"] for record in flights) > 60
    assert len(cases) == 3
    for record in cases:
        assert 0.0 < record["C_p50_ms"] <= record["C_p99_ms"]
        assert record.get("inputs_differ", 0.0) < 1e-3  # of acados, where it is installed
    assert cases[0].get("p50_ratio", 0.0) < 0.5


def test_a_film_has_its_frames(tmp_path: Path) -> None:
    try:
        rendering_backend()
    except RenderingUnavailableError as error:
        pytest.skip(str(error))
    (record,) = quick("film", tmp_path)
    assert record["frames"] == 15
    assert 0.0 < record["start_s"] <= record["whole_s"]


def test_campaigns_by_one_worker_and_two(tmp_path: Path) -> None:
    records = quick("campaign", tmp_path)
    single = [record for record in records if "processor_ms" in record]
    ways = [(record["integrator"], record["flown_by"]) for record in single]
    assert ways == [(integrator, way) for integrator in ("mujoco", "rk4") for way in ("core", "loop")]
    assert all(record["processor_ms"] > 0.0 for record in single)
    records = records[: -len(single)]
    cases = [(solver, workers) for workers in (1, 2, 2) for solver in ("piqp", "core")]
    assert [(record["solver"], record["workers"]) for record in records] == cases
    assert all(record["flight_s"] > 0.0 and 0.0 <= record["not_flying_%"] < 100.0 for record in records)


def test_the_heavier_vehicle_ends_farther_away(tmp_path: Path) -> None:
    flights = {(record["controller"], record["condition"]): record for record in quick("mismatch", tmp_path)}
    assert {condition for _, condition in flights} == {"nominal", "mass +30 %"}
    for controller in ("paper", "PID"):
        assert flights[controller, "mass +30 %"]["end_error"] > 2.0 * flights[controller, "nominal"]["end_error"]


def test_a_pid_that_knows_the_moment_of_the_air_holds_what_another_does_not(tmp_path: Path) -> None:
    flights = {(record["course"], record["moment"]): record for record in quick("moment", tmp_path)}
    for course in ("step", "figure-eight"):
        assert flights[course, "with"]["outcome"] == "satisfied"
        assert flights[course, "with"]["largest"] < 0.6 * flights[course, "without"]["largest"]


def test_nonlinear_mpc_follows_where_lqr_does_not(tmp_path: Path) -> None:
    errors = {record["controller"]: record["error"] for record in quick("speed", tmp_path)}
    assert errors["nonlinear"] < 0.2 * errors["LQR"]
    assert (tmp_path / "speed.png").is_file()


def test_rates_fly_as_rotor_speeds_do(tmp_path: Path) -> None:
    records = {record["controller"]: record for record in quick("interfaces", tmp_path)}
    assert not any(record["lost"] for record in records.values())
    assert records["rates 20 Hz"]["circle"] < 1.5 * records["rotors 20 Hz"]["circle"]
    for record in records.values():
        assert record["circle"] < record["steps"]
        assert record["p50_ms"] <= record["p99_ms"] <= record["max_ms"]
    assert (tmp_path / "interfaces.png").is_file()


def test_the_identified_file_flies_as_the_true_one_does(tmp_path: Path) -> None:
    start, identified, true = quick("identification", tmp_path)
    assert identified["passed"] > 0.7 * identified["sought"]
    assert not any((identified["failed"], identified["violated"], true["violated"]))
    for guess, found, right in zip(*(record["errors_%"] for record in (start, identified, true)), strict=True):
        assert found == pytest.approx(right, rel=0.2)
        assert guess is None or guess > 2.0 * right
    assert (tmp_path / "identification.png").is_file()


def test_the_interval_of_a_hover_s_thrust_holds_the_truth(tmp_path: Path) -> None:
    records = {record["parameter"]: record for record in quick("intervals", tmp_path)}
    assert (records["thrust_coefficient"]["passed"], records["thrust_coefficient"]["inside"]) == (1, 1)
    assert records["drag_to_thrust"]["passed"] == 0


def test_intervals_goes_on_from_the_answers_that_it_kept(tmp_path: Path) -> None:
    """A log that raised counts as failed; a line that was cut off is none; nothing is flown again."""
    estimate = {"passed": True, "inside": True, "error": 0.01}
    kept = [
        {"condition": "hover", "seed": 700, "answer": {"thrust_coefficient": estimate}},
        {"condition": "hover", "seed": 701, "answer": {"verdict": "error", "reason": "it raised"}},
    ]
    answers = tmp_path / "answers.jsonl"
    answers.write_text("\n".join(map(json.dumps, kept)) + '\n{"condition": "ho')
    code = (
        "import sys; sys.path[:0] = ['benchmarks']; import intervals; intervals.CONDITIONS = {'hover': {}}; "
        "intervals.main()"
    )
    file = tmp_path / "out.json"
    done = script("-c", code, "--seed", "700", "--vehicles", "2", "--answers", answers, "--json", file)
    assert done.returncode == 0, done.stderr
    (record,) = json.loads(file.read_text())["records"]
    assert (record["logs"], record["failed"], record["passed"], record["inside"]) == (2, 1, 1, 1)


def test_the_margins_of_lqr_are_on_both_sides(tmp_path: Path) -> None:
    (record,) = quick("stability", tmp_path)
    assert (record["law"], record["heading [deg]"]) == ("lqr", "< -180 .. > 180")
    assert 50.0 < float(record["delay [ms]"]) < 100.0


def test_each_law_takes_what_it_has_of_each_vehicle_s_scenario() -> None:
    code = (
        "import sys; sys.path[:0] = ['benchmarks']; import quadsim; from stability import LAWS, SCENARIOS, with_law; "
        "scenarios = [quadsim.load(name) for name in SCENARIOS.values()]; "
        "tables = [(law, with_law(each, law).tables['controller']) for each in scenarios for law in LAWS]; "
        "print([law for law, table in tables if 'output_weights' in table])"
    )
    done = script("-c", code)
    assert done.returncode == 0, done.stderr
    assert ast.literal_eval(done.stdout) == 3 * ["unconstrained", "constrained", "robust", "lqr"]


def test_wrong_input_is_one_message(tmp_path: Path) -> None:
    done = script("benchmarks/solvers.py", "--scenario", "hover-pid", "--json", tmp_path / "out.json")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "out.json").exists()


def test_the_example_of_what_constraints_cost_runs(tmp_path: Path) -> None:
    picture = tmp_path / "cost.png"
    done = script("examples/constraint_cost.py", picture, "2.0")
    assert done.returncode == 0, done.stderr
    assert "inf" in done.stdout
    assert picture.is_file()


def test_moments_that_each_suit_the_log_make_a_body_together() -> None:
    """Within their intervals, those of this noisy log would not: no moment exceeds the sum of the others."""
    log = "import sys; sys.path[:0] = ['benchmarks']; import intervals; print(intervals.identify(%s))"
    done = script("-c", log % "('torque 0.01, eight', 5901)")
    assert done.returncode == 0, done.stderr
    assert "inertia_z" in done.stdout


def test_many_environments_at_once_take_a_fraction_of_a_single_ones_time(tmp_path: Path) -> None:
    rates = {record["environment"]: record["steps_per_cpu_s"] for record in quick("batch", tmp_path)}
    assert rates["own method"] > 4.0 * rates["one environment, own method"]
    assert rates["own method"] > 3.0 * rates["MuJoCo's step"] > 0.0
