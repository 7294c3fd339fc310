"""Results in a notebook: each cell of a running kernel has one output, and wrong input a message of its own."""

from __future__ import annotations

from typing import Any

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")

SETUP = """
%matplotlib inline
import quadsim
hover = quadsim.load("hover").replace({"duration": 0.5})
flight = quadsim.fly(hover, progress=False)
pid = quadsim.fly(hover.replace({"controller": {"type": "pid"}}), progress=False)
compared = quadsim.compare(flight, pid, names=["mpc", "pid"], progress=False)
"""
ONE_OUTPUT = {
    "hover": "Scenario hover",
    "flight": "Flight hover",
    "compared": "FlightComparison of 2 flights",
    "compared.show()": "outcome",
    "quadsim.catalogue()": "scenarios: paper",
    "quadsim.load_vehicle('hummingbird')": "Vehicle hummingbird",
    "quadsim.problem(hover)": "Problem: 12 states",
    "quadsim.feasibility(hover)": "Feasibility",
    "flight.audit": "Finding roll: holds",
    "quadsim.start(hover)": "Rollout hover: 0.00 of 0.5 s",
    "quadsim.make_controller(hover)": "Pilot of constrained",
    "quadsim.sweep(hover, {'controller.horizon': [10, 20]}, workers=1, progress=False)": "sweep of hover",
    "flight.plot('z', 'roll')": "Figure",
}


@pytest.fixture(scope="module")
def cells(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The outputs of each cell, by its code."""
    wrong = "hover.replace({'controller.horizn': 3})"
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code) for code in (SETUP, *ONE_OUTPUT, wrong)])
    folder = tmp_path_factory.mktemp("notebook")
    resources = {"metadata": {"path": str(folder)}}
    client = nbclient.NotebookClient(notebook, resources=resources, allow_errors=True, coalesce_streams=True)
    client.execute()
    return {cell.source: cell.outputs for cell in notebook.cells}


def test_flights_without_progress_leave_no_output(cells: dict[str, Any]) -> None:
    assert cells[SETUP] == []


@pytest.mark.parametrize("code", ONE_OUTPUT)
def test_a_bare_result_appears_once(code: str, cells: dict[str, Any]) -> None:
    (output,) = cells[code]
    if output.output_type == "stream":
        assert ONE_OUTPUT[code] in output.text
    else:
        assert ONE_OUTPUT[code] in output.data["text/plain"]
        assert " object at 0x" not in output.data["text/plain"]


def test_tables_are_monospaced(cells: dict[str, Any]) -> None:
    (output,) = cells["compared"]
    assert "monospace" in output.data["text/html"]


def test_a_wrong_field_has_its_own_traceback_alone(cells: dict[str, Any]) -> None:
    (output,) = cells["hover.replace({'controller.horizn': 3})"]
    assert output.ename == "ScenarioError"
    traceback = "\n".join(output.traceback)
    assert "did you mean 'horizon'" in traceback
    assert "direct cause" not in traceback
    assert "During handling" not in traceback
