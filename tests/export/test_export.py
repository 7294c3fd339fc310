"""`quadsim export` without a compiler: what is written, its numbers, and what is refused."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg

import quadsim
from mpc.core.axes import axes
from mpc.core.tables import AxisTables, tables
from mpc.exact.free import FreeOptimum
from mpc.export.ctext import number
from mpc.export.source import DATA, HEADER, SOURCE
from mpc.paper.condensed import Condensed
from quadsim.errors import ExportError, OutputError, ParameterError
from quadsim.state import REFERENCE_STATES, Array
from scenarios.build import build_problem
from scenarios.catalogue import read_catalogue
from scenarios.cli import main
from scenarios.export.exporter import controller_files, export, exported_law
from scenarios.export.record import record
from scenarios.loading import load_scenario
from scenarios.parts.vehicle import build_vehicle

SHORT = {"duration": 1.0}
NUMBER = re.compile(r"R\(([^)]*)\)")
NOT_EXPORTED = {
    "nonlinear": "it is 'nonlinear'",
    "geometric": "it is 'geometric'",
    "avoidance": "half-spaces around obstacles",
}


def test_every_problem_of_the_library_that_qualifies_is_exported() -> None:
    exported, refused, seen = 0, {}, set()
    for name in read_catalogue().scenarios:
        scenario = load_scenario(name)
        key = scenario.controller.model_dump_json(), repr(build_vehicle(scenario)), bool(scenario.obstacles)
        if key in seen:
            continue
        seen.add(key)
        try:
            files = controller_files(scenario, "double")
        except ExportError as error:
            refused[name] = error.reason
            continue
        exported += 1
        sizes = [abs(float(text)) for text in NUMBER.findall(files[DATA])]
        assert all(size == 0.0 or 1.2e-38 <= size <= 1e30 for size in sizes)
        assert files[DATA].isascii()
        assert not re.search(r"\b(nan|inf)\b", files[DATA])
    assert exported >= 8
    assert not {"paper-constrained", "paper-unconstrained", "robust", "robust-lag50", "crazyflie-steps"} & set(refused)
    for reason in refused.values():
        assert any(text in reason for text in NOT_EXPORTED.values())


@pytest.mark.parametrize("horizon", [1, 10, 20, 100])
def test_any_horizon_is_exported(horizon: int) -> None:
    files = controller_files(load_scenario("paper-constrained", [f"controller.horizon={horizon}"]), "float")
    assert f"#define QUADSIM_HORIZON {horizon} " in files[HEADER]


def test_the_same_export_twice_is_the_same_bytes(tmp_path: Path) -> None:
    scenario = quadsim.load("robust", SHORT)
    for name in ("one", "two"):
        quadsim.export(scenario, tmp_path / name)
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes(), path.name


def test_both_precisions_have_the_same_numbers() -> None:
    double, single = (controller_files(load_scenario("hover"), precision) for precision in ("double", "float"))
    assert double[DATA] == single[DATA]
    assert double[SOURCE] == single[SOURCE]
    assert "typedef double quadsim_real;" in double[HEADER]
    assert "typedef float quadsim_real;" in single[HEADER]


def test_an_export_is_complete_and_replaces_an_earlier_one_on_request(tmp_path: Path) -> None:
    scenario = quadsim.load("hover", SHORT)
    directory = quadsim.export(scenario, tmp_path / "c")
    with pytest.raises(OutputError, match="it is not empty"):
        quadsim.export(scenario, directory)
    assert quadsim.export(scenario, directory, overwrite=True) == directory
    names = {path.name for path in directory.iterdir()}
    assert {HEADER, SOURCE, DATA, "vectors.h", "vectors.c", "main.c", "Makefile", "README.md", "LICENSE"} <= names
    assert f"#define QUADSIM_VECTORS {scenario.periods}" in (directory / "vectors.h").read_text()
    (directory / "main.o").write_text("built")
    with pytest.raises(OutputError, match=r"does not list main\.o; move that away first$"):
        quadsim.export(scenario, directory, overwrite=True)


def test_the_licence_is_the_project_s() -> None:
    root = Path(__file__).parent.parent.parent
    assert (root / "mpc/export/c/LICENSE").read_text() == (root / "LICENSE").read_text()


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("nonlinear", NOT_EXPORTED["nonlinear"]),
        ("torrente-loop8-flatness", NOT_EXPORTED["geometric"]),
        ("corridor", NOT_EXPORTED["nonlinear"]),
        ("pillar", NOT_EXPORTED["avoidance"]),
    ],
)
def test_what_cannot_be_exported_is_refused_with_its_reason(
    name: str, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", name, "--out", str(tmp_path / "c")]) == 2
    message = capsys.readouterr().err
    assert message.startswith("quadsim: this scenario's controller cannot be exported: ")
    assert reason in message
    assert message.count("\n") == 1
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize(("option", "value"), [("precision", "half"), ("target", "z80")])
def test_unknown_options_are_refused(option: str, value: str, tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=f"--{option} must be one of .*got '{value}'"):
        export("hover", tmp_path / "c", **{option: value})


def test_a_problem_with_too_many_numbers_is_refused() -> None:
    with pytest.raises(ParameterError, match="at most 1048576 numbers"):
        controller_files(load_scenario("paper-constrained", ["controller.horizon=900"]), "double")


@pytest.mark.parametrize(
    ("value", "text"),
    [(1.5, "R(1.5)"), (-0.1, "-R(0.1)"), (1e-39, "R(0.0)"), (-5e-324, "R(0.0)"), (1.2e-38, "R(1.2e-38)")],
)
def test_numbers_are_exact_and_none_is_denormal(value: float, text: str) -> None:
    assert number(value) == text


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_none_are_refused(value: float) -> None:
    with pytest.raises(ValueError, match="no place in C"):
        number(value)


def optimum(axis: AxisTables, start: Array, reference: Array) -> Array:
    """W (N, m) by the passes that the C makes."""
    N, n = len(axis.K), len(axis.B)
    pull = np.array([(axis.W if i < N - 1 else axis.W_end) @ row[axis.targets] for i, row in enumerate(reference)])
    w, slope = np.empty((N, axis.inputs)), pull[-1].reshape(n)
    for i in reversed(range(N)):
        w[i] = axis.inverse[i] @ axis.B.T @ slope
        if i:
            slope = pull[i - 1] + axis.closed[i].T @ slope
    x = start
    for i in range(N):
        k = w[i].copy()
        w[i] -= axis.K[i] @ x
        x = axis.closed[i] @ x + axis.B @ k
    return w


@pytest.mark.parametrize("settings", [[], ["controller.terminal=lqr"], ["controller.horizon=10"]])
def test_dynamic_programming_finds_the_free_optimum(settings: list[str]) -> None:
    scenario = load_scenario("paper-constrained", settings)
    problem = build_problem(scenario, build_vehicle(scenario))
    found, rng = tables(problem), np.random.default_rng(0)
    state, reference = rng.normal(size=12), rng.normal(size=(problem.horizon, 4))
    free = FreeOptimum(problem, axes(problem))
    wanted = free.at(state, problem.objective.desired(reference), np.zeros(4))[free.inputs]
    for axis in found.axes:
        w = optimum(axis, state[axis.states], reference)
        np.testing.assert_allclose(w[:, 0], wanted[axis.first], atol=1e-9)


@pytest.mark.parametrize("name", ["paper-constrained", "robust", "polytopes"])
def test_responses_are_those_of_the_condensed_problem(name: str) -> None:
    scenario = load_scenario(name, ["controller.horizon=8"])
    problem = exported_law(scenario).problem
    found, form = tables(problem), Condensed(problem)
    N, m = problem.horizon, len(found.rows)
    inputs = N * problem.model.nu
    rows = form._values.of_inputs  # of the general rows; those of single inputs are a box
    H_inverse = np.linalg.inv(np.asarray(form.cost.H))
    general = {key: i for i, key in enumerate(zip(*_keys(form._rows), strict=True))}
    for r, row in enumerate(found.rows):
        if row.axis >= 0 and not row.terms:
            G = rows[:, general[_key(problem.rows.C[r], problem.rows.D[r], problem.rows.E[r])]].reshape(N, inputs)
            size = np.sqrt(np.einsum("ij,jk,ik->i", G, H_inverse, G))
            np.testing.assert_allclose(1.0 / found.scale[:, r], size, rtol=1e-6)
    assert m == problem.rows.l1.size


def _key(*rows: Array) -> tuple[bytes, ...]:
    return tuple(np.ascontiguousarray(row).tobytes() for row in rows)


def _keys(rows: object) -> list[list[bytes]]:
    return [[np.ascontiguousarray(row).tobytes() for row in getattr(rows, name)] for name in ("C", "D", "E")]


def test_inputs_fall_into_axes_without_loss() -> None:
    """Also where some inputs move nothing that costs."""
    scenario = load_scenario("paper-constrained")
    law = exported_law(scenario.replace({"controller.output_weights": {"x": 10.0, "y": 10.0, "z": 100.0}}))
    found = tables(law.problem)
    H = found.T.T @ law.problem.objective.Q_u @ found.T
    np.testing.assert_allclose(H, scipy.linalg.block_diag(*np.diag(H)), atol=1e-12)
    np.testing.assert_allclose(found.T @ found.T_inverse, np.eye(4), atol=1e-12)


def test_recorded_windows_are_of_one_path() -> None:
    recording = record(load_scenario("figure-eight", ["duration=2.0"]))
    assert recording.path.shape == (len(recording.state) + 50 - 1, len(REFERENCE_STATES))
    assert recording.command.shape == recording.acting.shape == (40, 4)
    np.testing.assert_allclose(recording.acting[1:], recording.command[:-1])
