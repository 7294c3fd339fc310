"""The command line: what each command prints, its exit status, and one message for wrong input."""

from __future__ import annotations

import json
import re
import shutil
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

import quadsim
from quadsim import __version__
from quadsim.assets import vehicle_names
from quadsim.commands.app import app
from quadsim.commands.cli import main
from quadsim.commands.doctor import capabilities
from quadsim.console.results import EXIT_DONE, EXIT_FAILED, EXIT_WRONG_INPUT
from quadsim.core import library, mirror
from quadsim.core.build import LIBRARY
from quadsim.errors import OutputError, RenderingUnavailableError
from quadsim.features.campaign.plan import read_campaign
from quadsim.flight import rundir
from quadsim.mpc.solvers import SOLVERS, solver_entries
from quadsim.mpc.solvers import core as solver
from quadsim.rollout import flown
from quadsim.scenarios.catalogue import campaign_names, scenario_names, variants
from quadsim.scenarios.loading import load_scenario

TABLES = ("--no-video", "--no-recording", "--no-figures")
"""Write the tables of a run and none of its products."""
SHORT = ("--set", "duration=0.5")
SHORT_FILE = 'base = "hover"\nname = "short"\nduration = 0.2\nconstraints = []\n'


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def hover_directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run that holds every constraint."""
    directory = tmp_path_factory.mktemp("runs") / "hover"
    assert main(["run", "hover", *SHORT, *TABLES, "--out", str(directory), "--json"]) == EXIT_DONE
    return directory


def left_in(directory: Path) -> list[str]:
    """The paths of all files and folders below a directory."""
    return sorted(path.relative_to(directory).as_posix() for path in directory.rglob("*"))


# --- list, version, doctor -----------------------------------------------------------------------------------------


def test_list_prints_a_line_for_each_name(capsys: pytest.CaptureFixture[str]) -> None:
    """The words of `quadsim.catalogue()`, though broken at another width."""
    assert main(["list"]) == EXIT_DONE
    printed = capsys.readouterr().out
    assert printed.split() == quadsim.catalogue().text().split()
    described = {line.split()[0] for line in printed.splitlines() if len(line.split()) > 1}
    assert described >= {*scenario_names(), *campaign_names(), *vehicle_names(), *SOLVERS, "constrained"}


def test_list_shows_a_variant_below_its_base() -> None:
    """Names are indented by two spaces, those of variants by four."""
    bases = {}
    base = ""
    for indented, name in re.findall(r"^  (  )?([\w.-]+) ", quadsim.catalogue().text(), re.MULTILINE):
        if indented:
            bases[name] = base
        else:
            base = name
    assert bases == {name: row.base for name, row in variants().items()}


def test_list_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "--json"]) == EXIT_DONE
    listed = json.loads(capsys.readouterr().out)
    of_scenarios = ["scenarios", "groups", "expected"]
    others = ["variants", "campaigns", "vehicles", "controllers", "papers", "solvers"]
    assert list(listed) == of_scenarios + others
    for title in of_scenarios:
        assert list(listed[title]) == scenario_names()
    for name in scenario_names():
        scenario = load_scenario(name)
        assert listed["scenarios"][name] == scenario.description
        assert listed["groups"][name] == scenario.group
        assert listed["expected"][name] == scenario.expect
    assert listed["variants"] == {name: {"base": row.base, "set": row.set} for name, row in variants().items()}
    assert listed["campaigns"] == {name: read_campaign(name)["description"] for name in campaign_names()}
    assert list(listed["campaigns"]) == campaign_names()
    assert list(listed["solvers"]) == list(solver_entries())


def test_without_a_command_it_prints_help_and_fails(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == EXIT_WRONG_INPUT
    printed = capsys.readouterr()
    assert printed.err == ""
    for name in app:
        if not name.startswith("-"):
            assert f"│ {name} " in printed.out


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (["run"], scenario_names),
        (["campaign", "--resume"], campaign_names),
        (["scenario", "--for"], vehicle_names),
    ],
)
def test_a_shell_completes_names_and_paths(
    words: list[str], names: Callable[[], list[str]], here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "mine.toml").touch()
    assert main(["__complete", *words, "mi"]) == EXIT_DONE
    assert {*names(), "mine.toml"} <= set(capsys.readouterr().out.split())


# --- scenario ------------------------------------------------------------------------------------------------------


HEAVY = ("--set", "vehicle.mass=4.2", "--seed", "7")


def test_a_printed_scenario_is_a_scenario_file(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It prints itself again, and what is derived is a comment in it."""
    assert main(["scenario", "hover", *SHORT, *HEAVY]) == EXIT_DONE
    printed = capsys.readouterr()
    assert printed.err == ""
    assert "mass = 4.2" in printed.out
    assert "# inertia = [0.033, 0.033, 0.066]  # derived" in printed.out
    assert "# [s] physics step" in printed.out
    (here / "mine.toml").write_text(printed.out)
    assert main(["scenario", "mine.toml"]) == EXIT_DONE
    assert capsys.readouterr().out == printed.out
    assert load_scenario("mine.toml").seed == 7


def test_the_scenario_of_a_run_states_what_its_vehicle_file_says(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It flies again whatever becomes of that file, and it prints itself."""
    assert main(["run", "hover", *SHORT, *HEAVY, *TABLES, "--out", "run"]) == EXIT_DONE
    capsys.readouterr()
    of_run = (here / "run" / "scenario.toml").read_text()
    assert "\ninertia = [0.033, 0.033, 0.066]  # of lopes2011" in of_run
    assert "\nmass = 4.2\n" in of_run
    assert main(["scenario", "run/scenario.toml"]) == EXIT_DONE
    assert capsys.readouterr().out == of_run


def test_the_schema_of_scenarios_is_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenario", "--schema"]) == EXIT_DONE
    assert json.loads(capsys.readouterr().out)["title"] == "A quadsim scenario"


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == EXIT_DONE
    assert capsys.readouterr().out == f"quadsim {__version__}\n"


def test_doctor_times_both_integrators_and_tries_every_solver(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json"]) == EXIT_DONE
    result = json.loads(capsys.readouterr().out)
    assert list(result) == ["machine", "packages", "rendering", "viewer", "many vehicles", "solvers"]
    assert [*result["many vehicles"]] == ["own method", "MuJoCo's step"]
    for line in result["many vehicles"].values():
        steps_per_second, _, _ = line.partition(" steps of 50 ms")
        assert int(steps_per_second) > 100
    assert list(result["solvers"]) == list(solver_entries())
    for name, line in result["solvers"].items():
        if solver_entries()[name].installed:
            assert line.startswith(("works: ", "fails: ")), name
        else:
            assert line.startswith("not installed: "), name
    assert result["solvers"]["core"].startswith("works: ")


def test_without_the_library_doctor_and_a_flight_by_the_core_say_what_compiles_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Past the caches of both functions, which have the library of this process."""
    monkeypatch.setattr(library, "ROOT", tmp_path)
    monkeypatch.setattr(mirror, "load_library", library.load_library.__wrapped__)
    monkeypatch.setattr(solver, "core_library", mirror.core_library.__wrapped__)
    missing = str(tmp_path / LIBRARY)
    line = capabilities()["solvers"]["core"]
    assert line.startswith(missing)
    assert "pip install" in line
    command = ["run", "hover", *TABLES, "--out", str(tmp_path / "run"), "--set", "controller.solver=core"]
    assert main(command) == EXIT_WRONG_INPUT
    assert missing in capsys.readouterr().err


def test_doctor_reports_a_package_that_does_not_work_and_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: object, qp: object) -> None:
        raise RuntimeError("libdaqp.so is of another machine")

    monkeypatch.setattr("quadsim.mpc.solvers.daqp.DaqpDense.setup", broken)
    monkeypatch.setattr("quadsim.commands.doctor._rendering", lambda: 1 / 0)
    checks = capabilities()
    assert checks["solvers"]["daqp"].startswith("fails: RuntimeError: ")
    assert checks["rendering"]["video"].startswith("fails: ZeroDivisionError: ")
    assert checks["solvers"]["piqp-dense"].startswith("works: ")


# --- run -----------------------------------------------------------------------------------------------------------


def test_run_prints_the_verdict_before_it_makes_products_and_what_to_open_at_its_end(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With --json, it prints the summary alone, when the products are made."""
    printed_before: list[str] = []
    add_products = flown.add_products

    def observed(*arguments: Any, **options: Any) -> flown.Flight:
        printed_before.append(capsys.readouterr().out)
        assert rundir.read_summary(here / "runs" / "hover")["verdict"] == "satisfied"
        return add_products(*arguments, **options)

    monkeypatch.setattr(flown, "add_products", observed)
    assert main(["run", "hover", *SHORT, "--no-video", "--no-figures"]) == EXIT_DONE
    assert printed_before[0].startswith("hover ")
    written, view_command, plot_command = capsys.readouterr().out.splitlines()
    assert written.endswith("runs/hover")
    assert view_command == "quadsim view runs/hover"
    program, *arguments = plot_command.split()
    assert program == "quadsim"
    assert main(arguments) == EXIT_DONE
    assert (here / "hover.pdf").is_file()
    capsys.readouterr()
    assert main(["run", "hover", *SHORT, "--no-video", "--no-figures", "--json"]) == EXIT_DONE
    assert printed_before[1] == ""
    assert json.loads(capsys.readouterr().out)["products"] == {"flight.rrd": "made"}


def test_a_signal_named_like_a_run_is_pointed_to_its_option(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "hover", *SHORT, *TABLES]) == EXIT_DONE
    capsys.readouterr()
    assert main(["plot", "runs/hover", "z", "--out", "z.pdf"]) == EXIT_WRONG_INPUT
    error = capsys.readouterr().err
    assert error.startswith("quadsim: z: is not a run directory; signals are named behind --signals")
    listed = error.partition("(there are: ")[2].rstrip(")\n").split(", ")
    for name in ("x_error", "z", "command", "step_ms", "margin.roll"):
        assert name in listed
    assert main(["plot", "nowhere", "--out", "z.pdf"]) == EXIT_WRONG_INPUT
    assert "--signals" not in capsys.readouterr().err, "the first is a run"


def test_settings_and_seed_reach_the_flight(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = ["--set", "controller.horizon=12", "--set", "vehicle.mass=4.2", "--seed", "9"]
    assert main(["run", "hover", *SHORT, *TABLES, *settings, "--json"]) == EXIT_DONE
    printed = capsys.readouterr()
    assert printed.err == ""
    summary = json.loads(printed.out)
    assert summary == rundir.read_summary(here / "runs" / "hover")
    assert summary["controller"]["horizon"] == 12
    assert summary["vehicle"]["mass"] == 4.2
    assert summary["seed"] == 9


def test_a_violated_constraint_that_is_not_required_is_status_0(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = ["--set", "constraints.speed.upper=150.0", "--set", "constraints.speed.required=false"]
    assert main(["run", "hover", *SHORT, *TABLES, *settings, "--json"]) == EXIT_DONE
    summary = json.loads(capsys.readouterr().out)
    (speed,) = [constraint for constraint in summary["constraints"] if constraint["name"] == "speed"]
    assert not speed["satisfied"]


def test_a_flight_without_constraints_is_unaudited() -> None:
    flight = quadsim.load("hover", {"duration": 0.5, "constraints": []}).fly(controller=lambda *_: [192.8] * 4)
    assert (flight.outcome, flight.audit) == ("unaudited", ())


VIOLATED = ["--set", "constraints.speed.upper=150.0"]
LOST = ["--set", "initial.euler=[60.0, 0.0, 0.0]"]


@pytest.mark.slow("commands")
@pytest.mark.parametrize(
    ("settings", "expect", "as_expected"),
    [
        ([], "violated", False),
        (VIOLATED, "satisfied", False),
        (VIOLATED, "violated", True),
        (VIOLATED, "lost", False),
        (LOST, "satisfied", False),
        (LOST, "lost", True),
    ],
)
def test_the_outcome_is_compared_with_what_the_scenario_expects(
    here: Path, capsys: pytest.CaptureFixture[str], settings: list[str], expect: str, as_expected: bool
) -> None:
    """The exit status tells whether the constraints held, whatever was expected."""
    status = EXIT_FAILED if settings else EXIT_DONE
    assert main(["check", "hover", *SHORT, *settings, "--set", f"expect={expect}", "--json"]) == status
    summary = json.loads(capsys.readouterr().out)
    assert summary["group"] == "courses"
    assert (summary["expected"], summary["as_expected"]) == (expect, as_expected)


# --- check ---------------------------------------------------------------------------------------------------------


def test_check_flies_a_scenario_and_writes_nothing(here: Path) -> None:
    assert main(["check", "hover", *SHORT]) == EXIT_DONE
    assert main(["check", "hover", *SHORT, *VIOLATED]) == EXIT_FAILED
    assert left_in(here) == []


def test_check_writes_its_verdicts_as_junit(
    hover_directory: Path, short_run_directory: Path, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A test for the flight and for each constraint; those whose window the flight ends before are skipped."""
    for directory, tests, skipped in ((hover_directory, 8, 0), (short_run_directory, 9, 4)):
        main(["check", str(directory), "--junit", "verdicts.xml"])
        suite = ElementTree.parse("verdicts.xml").getroot()
        stated = [int(suite.get(key, "")) for key in ("tests", "failures", "skipped")]
        assert stated == [tests, 0, skipped]
        cases = suite.findall("testcase")
        assert len(cases) == tests
        assert len(suite.findall("testcase/skipped")) == skipped
        assert [case.get("name") for case in cases[:3]] == ["flight", "roll", "pitch"]
        assert "5 deg" in suite.findtext("testcase[@name='roll']/system-out", "")
    assert left_in(here) == ["verdicts.xml"]


@pytest.mark.usefixtures("undrawn")
def test_compare_leaves_out_what_it_is_told_to_and_names_its_columns(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "short.toml").write_text(SHORT_FILE)
    named = ["--name", "A", "--name", "B"]
    assert main(["compare", "short.toml", "short.toml", *named, "--out", "page", *TABLES, "--json"]) == EXIT_DONE
    assert set(json.loads(capsys.readouterr().out)[0]["values"]) == {"A", "B"}
    assert sorted(path.name for path in (here / "page-runs").iterdir()) == ["short", "short-2"]
    kept = {path.name for path in (here / "page-runs" / "short").iterdir()}
    assert {"summary.json", "flight.parquet"} <= kept
    assert not kept & {"flight.mp4", "flight.rrd", "figures"}
    assert ">A</h3>" in (here / "page" / "index.html").read_text()


@pytest.mark.usefixtures("undrawn")
def test_the_page_is_there_before_its_films_which_are_added_to_it(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second film fails: its run says so, and the page has the first one alone."""
    (here / "short.toml").write_text(SHORT_FILE)
    page = here / "page" / "index.html"
    pages: list[str] = []
    printed: list[str] = []
    rates: list[int | None] = []

    def render(_: object, path: Path, *, progress: Any, fps: int | None) -> None:
        pages.append(page.read_text())
        printed.append(capsys.readouterr().out)
        rates.append(fps)
        if len(pages) == 2:
            raise OutputError(path, "the disk is full")
        path.write_bytes(b"film")

    monkeypatch.setattr("quadsim.report.film.video.render_video", render)
    monkeypatch.setattr("quadsim.report.film.video.rendering_backend", lambda: "egl")
    films_alone = ["--no-recording", "--no-figures", "--fps", "12"]
    assert main(["compare", "short.toml", "short.toml", "--out", "page", *films_alone]) == EXIT_DONE
    assert len(pages) == 2
    for page_before in pages:
        assert page_before == pages[0]
        assert "<video" not in page_before
    assert "constraint" in printed[0]
    assert printed[1] == ""
    assert rates == [12, 12]
    assert page.read_text().count("<video") == 1
    done = capsys.readouterr()
    assert done.out.splitlines()[-1] == "open page/index.html"
    assert "flight.mp4 failed: " in done.err
    first = rundir.read_summary(here / "page-runs" / "short")["products"]
    second = rundir.read_summary(here / "page-runs" / "short-2")["products"]
    assert first["flight.mp4"] == "made"
    assert "the disk is full" in second["flight.mp4"]


@pytest.mark.usefixtures("undrawn")
def test_stored_runs_are_filmed_for_a_comparison_only_if_asked_for_and_where_they_have_no_film(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("first", "second"):
        (here / f"{name}.toml").write_text(SHORT_FILE.replace("short", name))
    filmed: list[str] = []

    def render(flight: Any, path: Path, **_: Any) -> None:
        filmed.append(flight.name)
        path.write_bytes(b"film")

    monkeypatch.setattr("quadsim.report.film.video.render_video", render)
    monkeypatch.setattr("quadsim.report.film.video.rendering_backend", lambda: "egl")
    assert main(["run", "first.toml", "--out", "first", "--no-recording", "--no-figures"]) == EXIT_DONE
    assert main(["run", "second.toml", "--out", "second", *TABLES]) == EXIT_DONE
    assert filmed == ["first"]
    assert main(["compare", "first", "second", "--out", "page"]) == EXIT_DONE
    assert filmed == ["first"]
    assert main(["compare", "first", "second", "--out", "page", "--overwrite", "--video"]) == EXIT_DONE
    assert filmed == ["first", "second"]
    assert (here / "page" / "index.html").read_text().count("<video") == 2


@pytest.mark.slow("commands")
def test_compare_prints_markdown(hover_directory: Path, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", str(hover_directory), "--out", "page", "--markdown"]) == EXIT_DONE
    assert capsys.readouterr().out.startswith("| ")


# --- wrong input: status 2, one message, no traceback, nothing made ------------------------------------------------

RUN = ["run", "hover", *SHORT, *TABLES]
WRONG: dict[str, tuple[list[str], str]] = {
    "an option without its value": (["export", "hover"], "--out"),
    "a film of a comparison that writes nothing": (["compare", "hover", "gust", "--video"], "--video"),
    "two flights to replay": (["replay", "gone", "--worst", "--flight", "3"], "--flight"),
    "one scenario of two": (["compare", "hover", "nope", "--out", "page"], "'nope'"),
    "a directory": (["run", "folder"], "folder"),
    "out below a file": ([*RUN, "--out", "file/run"], "/file"),
    "out is a file": ([*RUN, "--out", "file"], "file"),
    "out is no run": ([*RUN, "--out", "folder"], "folder"),
    "out cannot be written": ([*RUN, "--out", "/proc/quadsim/run"], "/proc/quadsim/run"),
    "out has too long a name": ([*RUN, "--out", "x" * 300], "File name too long"),
    "check of no run": (["check", "folder"], "folder"),
    "junit below a file": (["check", "hover", *SHORT, "--junit", "file/v.xml"], "/file/v.xml"),
    "junit is a folder": (["check", "hover", *SHORT, "--junit", "folder"], "/folder"),
    "video of nothing": (["video", "gone"], "gone"),
    "view of a run without one": (["view", "folder"], "flight.rrd"),
}
"""Lines that could leave something behind, and what their message names."""


@pytest.mark.parametrize(("arguments", "named"), WRONG.values(), ids=WRONG)
def test_wrong_input_is_status_2_with_one_message_and_leaves_nothing(
    here: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], named: str
) -> None:
    (here / "folder").mkdir()
    (here / "folder" / "theirs.txt").write_text("theirs")
    (here / "file").write_text("mine")
    before = left_in(here)
    assert main(arguments) == EXIT_WRONG_INPUT
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("quadsim: ")
    assert named in printed.err
    assert len(printed.err.splitlines()) == 1
    assert left_in(here) == before


def test_a_film_asked_for_by_name_is_refused_before_anything_is_flown_where_nothing_renders(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def nothing_renders() -> str:
        raise RenderingUnavailableError({"egl": "no libEGL", "osmesa": "no libOSMesa"})

    def flown(*_: object) -> None:
        pytest.fail("it must not be flown")

    monkeypatch.setattr("quadsim.report.film.video.rendering_backend", nothing_renders)
    with monkeypatch.context() as grounded:
        grounded.setattr("quadsim.rollout.rollout.Rollout.fly", flown)
        assert main(["run", "hover", "--video"]) == EXIT_WRONG_INPUT
    printed = capsys.readouterr()
    for word in ("libEGL", "libOSMesa", "--no-video"):
        assert word in printed.err
    assert left_in(here) == []
    assert main(["run", "hover", *SHORT, "--no-recording", "--no-figures", "--json"]) == EXIT_DONE
    assert "no libEGL" in rundir.read_summary(here / "runs" / "hover")["products"]["flight.mp4"]


def test_a_full_disk_is_status_2_and_leaves_nothing(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    total = 2**30
    free = 2**20
    full = shutil._ntuple_diskusage(total, total - free, free)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: full)
    assert main([*RUN, "--out", "new/run"]) == EXIT_WRONG_INPUT
    assert f"{here.resolve()}/new/run" in capsys.readouterr().err
    assert left_in(here) == []


@pytest.mark.parametrize("command", [["check"], ["live", "hover", "--script"]])
def test_a_file_that_is_nested_too_deep_is_refused_before_it_takes_memory(
    command: list[str], here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    nested_tables = ".".join(["a"] * 40_000) + " = 1"
    nested_lists = "inputs = " + "[" * 500 + "]" * 500
    for text in (nested_tables, nested_lists):
        (here / "deep.toml").write_text(text)
        tracemalloc.start()
        try:
            assert main([*command, "deep.toml"]) == EXIT_WRONG_INPUT
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert peak < 50e6
        assert "deep.toml" in capsys.readouterr().err
