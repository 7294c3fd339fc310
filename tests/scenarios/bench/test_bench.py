"""`quadsim bench`: fair turns, honest judgement, complete tables, and refusals that name what is wrong."""

from __future__ import annotations

import importlib.util
import json
import math
import time as clock
from dataclasses import replace
from pathlib import Path
from typing import Any

import make_cost
import numpy as np
import pytest

from mpc.solvers import SOLVERS, Method
from quadsim.errors import InputError, ParameterError, RenderingUnavailableError
from quadsim.report.film.video import rendering_backend, worker_count
from scenarios.bench.bench_results import Growth, RenderProfile, SolverBench
from scenarios.bench.bench_tables import flight_tables, render_tables, solver_tables, solver_targets
from scenarios.bench.campaigns import bench_campaign, campaign_tables
from scenarios.bench.candidates import Entry, StepCandidate, entries, judge, reference_optima
from scenarios.bench.flight import bench_flight
from scenarios.bench.queries import flight_between, recorded
from scenarios.bench.solvers import bench_solvers
from scenarios.bench.timing import Stopwatch, in_turns, segments, time_in_turns, time_python
from scenarios.build import build_problem
from scenarios.cli import main
from scenarios.commands import EXIT_DONE, EXIT_WRONG_INPUT
from scenarios.flight import Flight
from scenarios.loading import load_scenario
from scenarios.parts.vehicle import build_vehicle

SHORT = ("duration=3.0", "controller.horizon=10")
BENCHED = ("duration=1.5", "controller.horizon=10")
FILES = {"bench.json", "solvers.md", "solvers.png", "solvers.svg"}


class Answering:
    """Records its queries, and takes time to answer them."""

    def __init__(self, name: str, diary: list[tuple[str, int]], seconds: float = 0.0) -> None:
        self.name, self.diary, self.seconds = name, diary, seconds

    def prepare(self, period: int) -> None:
        self.diary.append((self.name, period))

    def answer(self) -> None:
        clock.sleep(self.seconds)


@pytest.fixture(scope="module")
def bench() -> SolverBench:
    """A bench of two solvers, small in every respect."""
    return bench_solvers(
        load_scenario("paper-constrained", BENCHED),
        repeats=2,
        horizons=(5, 20, 24, 30),
        solvers=("piqp-multistage", "daqp"),
    )


def test_turns_are_random_and_every_question_is_put_to_all() -> None:
    diary: list[tuple[str, int]] = []
    laps = time_in_turns(
        {name: Answering(name, diary) for name in "abc"},
        segments(100, 1),
        between=lambda: None,
        repeats=3,
        rng=np.random.default_rng(1),
    )
    assert {name: lap.ms.shape for name, lap in laps.items()} == dict.fromkeys("abc", (3, 100))
    turns = [entry for i, (entry, period) in enumerate(diary) if i % 21 == 0]  # each turn: a lead-in and 20 periods
    rounds = {tuple(turns[i : i + 3]) for i in range(0, len(turns), 3)}
    assert all(sorted(order) == ["a", "b", "c"] for order in rounds)
    assert len(rounds) > 3
    queried = [period for name, period in diary if name == "a"]
    assert queried[:22] == [0, *range(20), 19]  # then the next segment, from the period before it
    assert len(queried) == 3 * 5 * 21


def test_stretches_cover_a_flight_or_an_even_part_of_it() -> None:
    assert [period for segment in segments(50, 1) for period in segment] == list(range(50))
    assert segments(130, 3) == [range(20), range(60, 80), range(120, 130)]


def test_slow_entrants_race_once_and_hopeless_ones_leave() -> None:
    diary: list[tuple[str, int]] = []
    candidates = {"quick": Answering("quick", diary), "slow": Answering("slow", diary, 0.002)}
    rng = np.random.default_rng(0)
    once = time_in_turns(candidates, [range(10)], between=lambda: None, repeats=3, rng=rng, longest_pass=0.01)
    assert (once["quick"].ms.shape[0], once["slow"].ms.shape[0]) == (3, 1)
    assert once["slow"].ms.min() >= 2.0
    assert list(time_in_turns(candidates, [range(10)], between=lambda: None, repeats=2, rng=rng, patience=0.01)) == [
        "quick"
    ]


def test_a_flight_goes_on_between_questions_and_is_not_timed() -> None:
    """Each question is answered after the plant has flown a period, as in flight, and reported by its median."""
    diary: list[tuple[str, int]] = []

    class Noted(Answering):
        def answer(self) -> None:
            self.diary.append(("answer", -1))
            clock.sleep(0.001)

    def between() -> None:
        diary.append(("between", -1))
        clock.sleep(0.02)

    laps = time_in_turns(
        {"a": Noted("a", diary)}, [range(3)], between=between, repeats=3, rng=np.random.default_rng(0)
    )["a"]
    assert [name for name, _ in diary[2:]][:6] == ["a", "between", "answer"] * 2
    assert [name for name, _ in diary].count("between") == 9
    assert 1.0 <= laps.ms.min() < 20.0
    np.testing.assert_array_equal(laps.median, np.sort(laps.ms, axis=0)[1])


def test_calls_are_watched_until_they_are_forgotten() -> None:
    diary: list[tuple[str, int]] = []
    slept, idle, watch = Answering("a", diary, 0.002), Answering("b", diary), Stopwatch()
    watch.watch(slept, "answer", "answers")
    watch.watch(idle, "answer", "never")
    assert in_turns({"a": slept.answer, "b": lambda: slept.prepare(3)}, 2) == {"a": [None] * 2, "b": [None] * 2}
    assert diary == [("a", 3)] * 2
    assert len(watch.laps["answers"]) == 2
    assert 0.004 <= watch.totals()["answers"] <= watch.elapsed
    assert watch.totals().keys() == {"answers"}
    watch.clear()
    slept.answer()
    assert len(watch.laps["answers"]) == 1


def test_a_python_command_is_timed_or_reports_what_is_wrong(tmp_path: Path) -> None:
    found = time_python("-c", "import time; time.sleep(0.05); print('done')", tree=tmp_path)
    assert (found.output, found.wall_s > 0.05) == ("done\n", True)
    assert found.processor_s > 0.0
    with pytest.raises(SystemExit, match="no such thing"):
        time_python("-c", "import sys; print('no such thing', file=sys.stderr); sys.exit(2)", tree=tmp_path)


def test_between_steps_the_plant_flies_a_period() -> None:
    scenario = load_scenario("paper-constrained", SHORT)
    with flight_between(scenario, build_vehicle(scenario)) as between:
        started = clock.perf_counter()
        between()
        between()
        assert clock.perf_counter() - started > 2 * 50 * 1e-6  # a Runge-Kutta step of MuJoCo's takes some microseconds


def test_a_time_stands_in_all_tables_once(bench: SolverBench) -> None:
    """Growth at the flight's own horizon is not measured again, nor are the steps in the study of cost."""
    flown = bench_solvers(
        load_scenario("paper-constrained", BENCHED), repeats=1, horizons=(10,), solvers=("piqp-multistage",)
    )
    alone, growth = flown.candidates[1], {each.name: each for each in flown.growth if not each.kind}
    assert growth[alone.name].p50 == (alone.quantiles["p50"],)
    assert growth[alone.name].p99 == (alone.quantiles["p99"],)
    gain, shown, qp = make_cost.timed(bench)
    assert (gain.name, shown.name, qp.name) == ("unconstrained gain", "constrained, as flown", "QP by piqp-multistage")
    assert bench.gain_ms is not None
    assert gain.step_ms.size == shown.step_ms.size == 30
    np.testing.assert_array_equal(shown.step_ms, bench.default.step_ms)
    np.testing.assert_array_equal(qp.step_ms, bench.candidates[1].step_ms)
    assert np.count_nonzero(shown.shortcut) == bench.default.statuses["unconstrained"]
    assert np.median(gain.step_ms) < np.median(qp.step_ms)


def test_the_median_of_the_repeats_and_the_longest_of_all(bench: SolverBench) -> None:
    for candidate in bench.candidates:
        assert candidate.step_ms.shape == (30,)
        assert candidate.raw_max_ms >= candidate.quantiles["max"] >= candidate.quantiles["p50"] > 0.0
        assert candidate.repeats == 2


def test_candidates_are_the_default_each_solver_alone_and_daqp_both_ways(bench: SolverBench) -> None:
    names = [candidate.name for candidate in bench.candidates]
    assert names == ["piqp-multistage + shortcut", "piqp-multistage", "daqp", "daqp + shortcut"]
    assert [sum(candidate.statuses.values()) for candidate in bench.candidates] == [30] * 4
    assert bench.candidates[1].statuses == {"solved": 30}
    assert bench.default.statuses.keys() <= {"solved", "unconstrained"}


def test_answers_are_judged_by_an_optimum_in_closed_form(bench: SolverBench) -> None:
    assert bench.reference_kkt < 1e-6
    for candidate in bench.candidates:
        assert candidate.failures == 0
        assert candidate.input_error is not None
        assert candidate.input_error < (1e-6 if candidate.solver == "daqp" else 5e-3)
        assert candidate.kkt is not None
        assert candidate.kkt < 1e-3


def test_wrong_answers_and_failures_are_seen(constrained_flight: Flight) -> None:
    scenario = load_scenario("paper-constrained", SHORT)
    problem = build_problem(scenario, build_vehicle(scenario))
    queries = recorded(scenario, constrained_flight.log.control, problem.horizon)
    periods = range(4)
    reference = reference_optima(problem, queries, periods)
    candidate = StepCandidate(entries("piqp-multistage", ["daqp"])[1], problem, queries)
    for period in periods:
        candidate.prepare(period)
        candidate.answer()
    assert judge(candidate, queries, periods, reference)["failures"] == 0

    command, answer = candidate.answers[1]
    assert command is not None
    assert answer is not None
    point = answer.certificate()[1]
    candidate.answers[1] = (replace(command, speeds=command.speeds + 1.0), answer)
    off = answer._replace(solution=answer.solution._replace(x=point.x + 1.0))
    candidate.answers[2] = (candidate.answers[2][0], off)
    candidate.answers[3] = (None, answer._replace(solution=answer.solution._replace(status="numerics")))
    verdict = judge(candidate, queries, periods, reference)
    assert verdict["input_error"] == pytest.approx(1.0, abs=1e-3)
    assert verdict["kkt"] is not None
    assert verdict["kkt"] > 0.5
    assert verdict["failures"] == 1
    assert verdict["statuses"] == {"numerics": 1, "solved": 3}


def test_growth_is_fitted_over_the_long_horizons() -> None:
    growth = Growth(name="a", horizons=(10, 20, 40, 80), p50=(9.0, 2.0, 4.0, 8.0), p99=(9.0, 4.0, 16.0, 64.0))
    assert growth.exponent("p50") == pytest.approx(1.0)
    assert growth.exponent("p99") == pytest.approx(2.0)
    assert replace(growth, horizons=(5, 10, 20, 40)).exponent("p50") is None  # two points fit anything


def test_growth_covers_all_candidates_and_horizons(bench: SolverBench) -> None:
    assert {growth.name for growth in bench.growth} == {candidate.name for candidate in bench.candidates}
    for candidate in bench.candidates:
        kinds = {growth.kind for growth in bench.growth if growth.name == candidate.name}
        assert kinds <= (set(Method) if candidate.shortcut else {""})
    for growth in bench.growth:
        assert growth.horizons == (5, 20, 24, 30)
        assert all(0.0 < p50 <= p99 for p50, p99 in zip(growth.p50, growth.p99, strict=True))
        assert growth.exponent("p99") is not None


def test_tables_are_complete(bench: SolverBench) -> None:
    candidates, growth, stages, targets = solver_tables(bench)
    assert [line[0].text.removesuffix(" (default)") for line in candidates.lines] == [c.name for c in bench.candidates]
    for grid in (candidates, growth, stages, targets):
        assert {len(line) for line in grid.lines} == {len(grid.head)}
        assert all(cell.text for line in grid.lines for cell in line)
    assert {line[0].text for line in stages.lines} >= {"condensed, dense", "1", "5 (default)", "25"}
    assert candidates.lines[0][6].text == "1"  # p99, as a ratio to itself


def test_targets_compare_with_other_solvers_only(bench: SolverBench) -> None:
    slow = replace(bench.candidates[2], step_ms=np.full(30, 1e3))
    default = replace(bench.default, step_ms=np.full(30, 0.01))
    won = replace(bench, candidates=(default, bench.candidates[1], slow))
    verdicts = {target.what: target for target in solver_targets(won)}
    assert verdicts["default, p99 below every other solver's"].met
    assert "daqp" in verdicts["default, p99 below every other solver's"].required
    lost = replace(won, candidates=(replace(default, step_ms=np.full(30, 2e3), failures=1), *won.candidates[1:]))
    missed = {target.what for target in solver_targets(lost) if not target.met}
    assert missed >= {"default, p50", "default, p99", "default, max below every other solver's"}
    assert "default, periods without an optimum" in missed
    paper = replace(won, candidates=(default, replace(slow, solver="qpoases")))
    ratio = next(target for target in solver_targets(paper) if "qpOASES" in target.what)
    assert ratio.met
    assert float(ratio.measured) == pytest.approx(1e5)


@pytest.mark.usefixtures("coarse")
def test_a_bench_is_written_whole_and_replaced_only_by_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "bench"
    short = ["--set", "duration=2.0", "--set", "controller.horizon=10", "--repeats", "1"]
    command = ["bench", "solvers", *short, "--solver", "daqp", "--horizons", "5", "--out", str(target)]
    assert main(command) == EXIT_DONE
    assert "daqp + shortcut" in capsys.readouterr().out
    assert {path.name for path in target.iterdir()} == {*FILES, "summary.json"}
    saved = json.loads((target / "bench.json").read_text())
    assert saved["asked"] == len(saved["contenders"][0]["step_ms_by_period"]) == 40
    assert saved["machine"]["cores"] >= 1
    assert "piqp" in saved["versions"]
    assert "| piqp-multistage + shortcut (default) |" in (target / "solvers.md").read_text()
    assert (target / "solvers.png").read_bytes().startswith(b"\x89PNG")
    assert main([*command, "--stride", "2", "--json"]) == EXIT_DONE
    assert json.loads(capsys.readouterr().out)["asked"] == 20

    (target / "mine.txt").write_text("not to be lost")
    assert main(command) == EXIT_WRONG_INPUT
    assert "its summary.json does not list mine.txt; move that away first" in capsys.readouterr().err
    assert {path.name for path in target.iterdir()} == {*FILES, "summary.json", "mine.txt"}


def test_a_solver_that_is_not_installed_is_named_and_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "casadi" else real(name))
    scenario = load_scenario("paper-constrained", ["duration=1.0", "controller.horizon=5"])
    found = bench_solvers(scenario, repeats=1, horizons=(), solvers=("piqp-dense", "qpoases"))
    assert found.left_out == {"qpoases": "not installed: pip install 'quadsim[solvers]'"}
    assert {candidate.solver for candidate in found.candidates} == {"piqp-multistage", "piqp-dense"}
    assert "Left out: qpoases, not installed" in solver_tables(found)[0].note
    assert found.growth == ()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["solvers", "--solver", "piqp"], "no solver named 'piqp'"),
        (["solvers", "--repeats", "0"], "--repeats must be at least 1; got 0"),
        (["solvers", "--stride", "0"], "--stride must be at least 1; got 0"),
        (["solvers", "--horizons", "0,10"], "--horizons must be between 1 and 1000 each"),
        (["solvers", "--scenario", "paper-unconstrained"], "paper-unconstrained is flown without a QP"),
        (["solvers", "--scenario", "paper"], "no scenario named 'paper'"),
        (["flight", "--repeats", "0"], "--repeats must be at least 1; got 0"),
        (["flight", "--set", "duration=-1"], "duration must be > 0"),
        (["render", "--workers", "0"], "--workers must be at least 1; got 0"),
        (["render", "--seconds", "0"], "--seconds must be finite, and at least one control period"),
    ],
)
def test_wrong_input_is_named(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["bench", *arguments]) == EXIT_WRONG_INPUT
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_horizons_that_are_no_numbers_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["bench", "solvers", "--horizons", "ten"])
    assert "argument --horizons: must be whole numbers between commas, or none; got 'ten'" in capsys.readouterr().err


def test_a_flight_without_a_period_cannot_be_timed() -> None:
    scenario = load_scenario("paper-constrained", [*SHORT, "initial.euler=[80.0, 0.0, 0.0]"])
    with pytest.raises(InputError, match="not one period was flown"):
        bench_solvers(scenario, repeats=1, horizons=())


def test_the_pieces_of_a_flight_add_up() -> None:
    profile = bench_flight(load_scenario("paper-constrained", SHORT), repeats=2)
    assert profile.solver == "piqp-multistage"
    assert (profile.duration, len(profile.wall_s)) == (pytest.approx(3.0), 2)
    assert all(seconds > 0.0 for seconds in profile.pieces.values())
    whole = sum(profile.pieces.values())
    assert 0.2 * profile.median < whole < 5.0 * profile.median + 0.5  # flown once: one stall of the machine is in it
    assert profile.pieces["physics"] > profile.pieces["measurement"]
    assert profile.to_json()["best_s"] == min(profile.wall_s)
    table, targets = flight_tables(profile)
    assert len(table.lines) == len(profile.pieces) + 5
    assert targets.lines[0][-1].text in {"met", "missed"}


def test_a_minute_of_film_follows_from_a_short_one() -> None:
    profile = RenderProfile(
        scenario="hover", backend="egl", width=1280, height=720, fps=30, frames=60, workers=2, wall_s=3.0, start_s=1.5,
        machine={},
    )  # fmt: skip
    assert profile.frame_ms == pytest.approx(25.0)
    assert profile.film_s(60.0) == pytest.approx(1.5 + 45.0)
    assert render_tables(profile)[1].lines[0][-1].text == "met"
    assert [line[-1].text for line in render_tables(replace(profile, wall_s=5.0))[1].lines] == ["missed"]


@pytest.mark.usefixtures("cheap_benchmarks")
def test_bench_render_films_and_reports(capsys: pytest.CaptureFixture[str]) -> None:
    try:
        rendering_backend()
    except RenderingUnavailableError as error:
        pytest.skip(str(error))
    assert main(["bench", "render", "--seconds", "0.2", "--set", "controller.horizon=5", "--json"]) == EXIT_DONE
    reported = json.loads(capsys.readouterr().out)
    assert (reported["frames"], reported["workers"], reported["fps"]) == (worker_count(6) * 6, 1, 30)
    assert 0.0 < reported["start_s"] < reported["wall_s"]
    assert math.isfinite(reported["film_of_60_s"])


def test_bench_flight_prints_json_alone(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [
        "bench",
        "flight",
        "--set",
        "duration=1.0",
        "--set",
        "controller.horizon=5",
        "--repeats",
        "1",
        "--json",
    ]
    assert main(arguments) == EXIT_DONE
    reported = json.loads(capsys.readouterr().out)
    assert reported["duration"] == pytest.approx(1.0)
    assert reported["pieces"].keys() >= {"physics", "measurement", "log and loop"}


def test_every_solver_has_a_place_in_the_bench() -> None:
    installed = [name for name, entry in SOLVERS.items() if entry.installed]
    default = Entry(solver="piqp-multistage", shortcut=True)
    assert {entry.solver for entry in entries(default, tuple(SOLVERS))} == set(installed)
    assert entries(default._replace(shortcut=False), ["piqp-multistage"]) == [default._replace(shortcut=False)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["flight", "--set", "initial.euler=[80,0,0]"], "a flight that is lost cannot be timed"),
        (["render", "--seconds", "inf"], "--seconds must be finite"),
    ],
)
def test_what_cannot_be_timed_is_refused(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", *arguments]) == EXIT_WRONG_INPUT
    assert message in capsys.readouterr().err


# --- campaigns -----------------------------------------------------------------------------------------------------


def test_what_a_campaign_costs_is_measured_and_reported() -> None:
    reported: list[tuple[int, int]] = []
    profile = bench_campaign(
        load_scenario("hover", ["duration=0.5", "controller.horizon=10"]),
        flights=3,
        rounds=1,
        sizes=(2, 4),
        progress=lambda stage, done, total: reported.append((done, total)),
    )
    assert reported == [(1, 4), (2, 4), (3, 4), (4, 4)]
    one, two = profile.rounds[0]
    assert (one.flights, one.workers, two.flights, two.workers) == (3, 1, 6, 2)
    for run in (one, two, *profile.growing):
        assert 0.0 < run.busy_s < run.workers * run.wall_s
        assert run.bytes > 1000
        assert 0.0 < run.overhead < 1.0
    assert [run.flights for run in profile.growing] == [2, 4]
    rounds, growth, targets = campaign_tables(profile)
    assert (len(rounds.lines), len(growth.lines), len(targets.lines)) == (2, 2, 4)
    assert len(campaign_tables(replace(profile, growing=()))) == 2
    slower = replace(one, wall_s=2.0 * one.wall_s)
    assert replace(profile, rounds=((slower, two), *profile.rounds)).per_core_hour == pytest.approx(2700.0 * one.rate)
    assert one.flight_s == pytest.approx(one.busy_s / 3)


@pytest.mark.parametrize("options", [{"flights": 0}, {"rounds": 0}, {"sizes": (0, 3)}])
def test_a_campaign_of_nothing_is_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ParameterError, match=rf"--{next(iter(options))} must be at least 1; got 0"):
        bench_campaign(load_scenario("hover"), **options)
