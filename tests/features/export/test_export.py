"""`quadsim export` without a compiler: what is written, its numbers, and what is refused."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg

import quadsim
from quadsim.commands.cli import main
from quadsim.errors import ExportError, OutputError, ParameterError
from quadsim.features.export.exporter import FACTS, c_controller, export, exported_law, memory_sentence
from quadsim.features.export.record import record
from quadsim.mpc.export.ctext import CText
from quadsim.mpc.export.geometric import CGeometric
from quadsim.mpc.export.nonlinear import NONLINEAR_FILES
from quadsim.mpc.export.source import BODY_FILES, CORE_FILES, DATA_FILE
from quadsim.mpc.forms.condensing import Condensed
from quadsim.mpc.problem.ocp import Query
from quadsim.mpc.solvers import Method
from quadsim.mpc.solvers.core import Core
from quadsim.mpc.solvers.core_tables import AxisTables, tables
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.catalogue import read_catalogue
from quadsim.scenarios.loading import load_scenario
from quadsim.state import REFERENCE_STATES, Array

pytestmark = pytest.mark.slow("export")

SHORT = {"duration": 1.0}
NUMBER = re.compile(r"(?<![\w.])-?(\d[\d.e+-]*)\b(?!F?\])")
NOT_EXPORTED = {
    "geometric": "it is 'geometric'",
    "avoidance": "half-spaces around obstacles",
}


def test_every_problem_of_the_library_that_qualifies_is_exported() -> None:
    exported = 0
    refused = {}
    seen = set()
    for name in read_catalogue().scenarios:
        scenario = load_scenario(name)
        key = repr(scenario.controller), repr(asdict(Assembly(scenario).vehicle)), bool(scenario.obstacles)
        if key in seen:
            continue
        seen.add(key)
        try:
            _, data = c_controller(scenario).files[DATA_FILE].split("static const", 1)
        except ExportError as error:
            refused[name] = error.reason
            continue
        exported += 1
        assert data.isascii()
        assert not re.search(r"\b(nan|inf)\b", data)
    assert exported >= 8
    expected = {"paper-constrained", "paper-unconstrained", "robust", "crazyflie-steps", "nonlinear", "autopilot"}
    assert not expected & set(refused)
    for reason in refused.values():
        assert any(text in reason for text in NOT_EXPORTED.values())


@pytest.mark.parametrize("horizon", [1, 10, 20, 100])
def test_any_horizon_is_exported(horizon: int) -> None:
    controller = c_controller(load_scenario("paper-constrained", [f"controller.horizon={horizon}"]), "float")
    assert f"#define QUADSIM_HORIZON {horizon} " in controller.files[DATA_FILE]
    assert f"#define QUADSIM_MEMORY {controller.reals} " in controller.files[DATA_FILE]


def test_the_core_is_exported_byte_for_byte(tmp_path: Path) -> None:
    directory = quadsim.export(quadsim.load("hover", SHORT), tmp_path / "c")
    root = Path(__file__).parents[3]
    folder = root / "quadsim" / "mpc" / "c"
    laws = {*CORE_FILES, *NONLINEAR_FILES, *CGeometric.law_files}
    assert {path.name for path in folder.iterdir()} == laws
    for name in CORE_FILES:
        assert (directory / name).read_bytes() == (folder / name).read_bytes()
    for name in BODY_FILES:
        assert (directory / name).read_bytes() == (root / "quadsim" / "core" / name).read_bytes()


def test_the_same_export_twice_is_the_same_bytes(tmp_path: Path) -> None:
    scenario = quadsim.load("robust", SHORT)
    for name in ("one", "two"):
        quadsim.export(scenario, tmp_path / name)
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes(), path.name


@pytest.mark.representative("export")
def test_both_precisions_have_the_same_numbers() -> None:
    double, single = (
        c_controller(load_scenario("hover"), precision).files[DATA_FILE] for precision in ("double", "float")
    )
    numbers = [text[text.index("static const") :].split() for text in (double, single)]
    assert [re.sub(r"(\d)F\b", r"\1", word) for word in numbers[1]] == numbers[0]


def test_capacity_is_as_requested_and_its_reach_is_stated(tmp_path: Path) -> None:
    """More rows take more memory and reach farther."""
    facts = []
    for rows in (40, 128):
        directory = quadsim.export(quadsim.load("paper-constrained", SHORT), tmp_path / str(rows), rows=rows)
        facts.append(json.loads((directory / FACTS).read_text()))
        assert f".capacity = {rows + 1}," in (directory / DATA_FILE).read_text()
        assert memory_sentence(facts[-1]) in (directory / "README.md").read_text().lower()
    few, many = facts
    assert few["memory_bytes"] < many["memory_bytes"]
    assert 0.0 < few["reach"]["distance"] < many["reach"]["distance"]
    for reach in (few["reach"], many["reach"]):
        assert 0 < reach["lost"] <= 200
        assert 200 <= reach["feasible"] <= reach["drawn"]


def test_an_export_is_complete_and_replaces_an_earlier_one_on_request(tmp_path: Path) -> None:
    scenario = quadsim.load("hover", SHORT)
    directory = quadsim.export(scenario, tmp_path / "c")
    with pytest.raises(OutputError, match="empty"):
        quadsim.export(scenario, directory)
    assert quadsim.export(scenario, directory, overwrite=True) == directory
    names = {path.name for path in directory.iterdir()}
    assert {
        *CORE_FILES,
        *BODY_FILES,
        DATA_FILE,
        FACTS,
        "vectors.h",
        "vectors.c",
        "main.c",
        "Makefile",
        "README.md",
        "LICENSE",
    } <= names
    assert f"#define QUADSIM_VECTORS {scenario.periods}" in (directory / "vectors.h").read_text()
    (directory / "main.o").write_text("built")
    with pytest.raises(OutputError, match=r"main\.o"):
        quadsim.export(scenario, directory, overwrite=True)


def test_the_licence_is_the_project_s() -> None:
    root = Path(__file__).parents[3]
    assert (root / "quadsim/mpc/export/c/LICENSE").read_text() == (root / "LICENSE").read_text()


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("torrente-loop8-flatness", NOT_EXPORTED["geometric"]),
        ("corridor", NOT_EXPORTED["avoidance"]),
        ("pillar", NOT_EXPORTED["avoidance"]),
    ],
)
def test_unexportable_controllers_are_refused_with_a_reason(
    name: str, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", name, "--out", str(tmp_path / "c")]) == 2
    message = capsys.readouterr().err
    assert reason in message
    assert message.count("\n") == 1
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize(("option", "value"), [("precision", "half"), ("target", "z80"), ("rows", 0)])
def test_unknown_options_are_refused(option: str, value: object, tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=f"--{option}"):
        export("hover", tmp_path / "c", **{option: value})


def test_a_problem_with_too_many_numbers_is_refused() -> None:
    with pytest.raises(ParameterError, match="1048576"):
        _ = c_controller(load_scenario("paper-constrained", ["controller.horizon=900"])).files


@pytest.mark.representative("export")
@pytest.mark.parametrize(
    ("value", "text"), [(1.5, "1.5"), (-0.1, "-0.1"), (1e-39, "0.0"), (-5e-324, "0.0"), (1.2e-38, "1.2e-38")]
)
def test_numbers_are_exact_and_never_denormal(value: float, text: str) -> None:
    assert CText("double").number(value) == text
    assert CText("float").number(value) == f"{text}F"


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nan_and_infinity_are_refused(value: float) -> None:
    with pytest.raises(ValueError, match="in C"):
        CText("double").number(value)


def optimum(axis: AxisTables, start: Array, reference: Array) -> Array:
    """W (N, m) by the passes that the C makes."""
    N = len(axis.K)
    n = len(axis.B)
    pull = np.array([(axis.W if i < N - 1 else axis.W_end) @ row[axis.regulated] for i, row in enumerate(reference)])
    w = np.empty((N, axis.inputs))
    slope = pull[-1].reshape(n)
    for i in reversed(range(N)):
        w[i] = axis.inverse[i] @ axis.B.T @ slope
        if i:
            slope = pull[i - 1] + axis.closed_loop[i].T @ slope
    x = start
    for i in range(N):
        k = w[i].copy()
        w[i] -= axis.K[i] @ x
        x = axis.closed_loop[i] @ x + axis.B @ k
    return w


@pytest.mark.representative("export")
@pytest.mark.parametrize("settings", [[], ["controller.terminal=lqr"], ["controller.horizon=10"]])
def test_dynamic_programming_finds_the_free_optimum(settings: list[str]) -> None:
    scenario = load_scenario("paper-constrained", settings)
    problem = Assembly(scenario).problem()
    result = tables(problem)
    rng = np.random.default_rng(0)
    state = rng.normal(size=12)
    reference = rng.normal(size=(problem.horizon, 4))
    query = Query(1e-6 * state, problem.desired(1e-6 * reference), problem.model.u_bar)
    answer = Core(problem).solve(query)
    assert answer.method is Method.FREE
    desired = result.T_inverse @ (answer.plan[0] - problem.model.u_bar) / 1e-6
    for axis in result.axes:
        w = optimum(axis, state[axis.states], reference)
        np.testing.assert_allclose(
            w[0], desired[axis.first_input : axis.first_input + axis.inputs], rtol=1e-6, atol=1e-6
        )


@pytest.mark.representative("export")
@pytest.mark.parametrize("name", ["paper-constrained", "robust", "polytopes"])
def test_responses_are_those_of_the_condensed_problem(name: str) -> None:
    scenario = load_scenario(name, ["controller.horizon=8"])
    problem = exported_law(scenario).problem
    result = tables(problem)
    form = Condensed(problem)
    N = problem.horizon
    m = len(result.rows)
    inputs = N * problem.model.nu
    rows = form._values.of_inputs  # of the general rows; those of single inputs are a box
    H_inverse = np.linalg.inv(np.asarray(form.cost.H))
    general = {key: i for i, key in enumerate(zip(*_keys(form._rows), strict=True))}
    for r, row in enumerate(result.rows):
        if row.axis >= 0 and not row.terms:
            G = rows[:, general[_key(problem.rows.C[r], problem.rows.D[r], problem.rows.E[r])]].reshape(N, inputs)
            size = np.sqrt(np.einsum("ij,jk,ik->i", G, H_inverse, G))
            np.testing.assert_allclose(1.0 / result.scale[:, r], size, rtol=1e-6)
    assert m == problem.rows.l1.size


def _key(*rows: Array) -> tuple[bytes, ...]:
    return tuple(np.ascontiguousarray(row).tobytes() for row in rows)


def _keys(rows: object) -> list[list[bytes]]:
    return [[np.ascontiguousarray(row).tobytes() for row in getattr(rows, name)] for name in ("C", "D", "E")]


@pytest.mark.representative("export")
def test_inputs_fall_into_axes_without_loss() -> None:
    """Also where some inputs move nothing that costs."""
    scenario = load_scenario("paper-constrained")
    law = exported_law(scenario.replace({"controller.output_weights": {"x": 10.0, "y": 10.0, "z": 100.0}}))
    result = tables(law.problem)
    H = result.T.T @ law.problem.objective.Q_u @ result.T
    np.testing.assert_allclose(H, scipy.linalg.block_diag(*np.diag(H)), atol=1e-12)
    np.testing.assert_allclose(result.T @ result.T_inverse, np.eye(4), atol=1e-12)


def test_recorded_windows_are_of_one_path() -> None:
    recording = record(load_scenario("figure-eight", ["duration=2.0"]))
    assert recording.path.shape == (len(recording.state) + 50 - 1, len(REFERENCE_STATES))
    assert recording.command.shape == recording.acting.shape == (40, 4)
    np.testing.assert_allclose(recording.acting[1:], recording.command[:-1])
