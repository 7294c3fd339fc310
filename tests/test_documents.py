"""The numbers in the documents are today's."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from pkgutil import resolve_name
from types import ModuleType
from typing import Any

import make_cost
import make_numbers as numbers
import matplotlib as mpl
import numpy as np
import pytest
from support import fly_here

from quadsim.report.table import grid_to_markdown
from scenarios.cost import cost_flights
from scenarios.cost.cost_tables import cost_tables
from scenarios.cost.measure import study_cost
from scenarios.cost.study import CandidateTimes, Variation
from scenarios.flight import Flight
from scenarios.loading import load_scenario
from scenarios.run import fly_scenario

ROOT = Path(__file__).resolve().parent.parent
MADE = {"gallery.md"}
"""Pages that `make docs` makes."""
ENTRY_POINTS = {"quadsim.controllers"}
"""Groups of entry points, which are written like modules."""


def test_results_in_the_readme_are_what_the_flights_give(fly_once: Callable[..., Flight]) -> None:
    names = ("paper-unconstrained", "paper-unconstrained-clipped", "paper-constrained")
    table = numbers.markdown(numbers.results({name: fly_once(name) for name in names}))
    for document in ("README.md", "docs/numbers.md"):
        assert table in (ROOT / document).read_text(encoding="utf-8"), f"{document} is out of date: make numbers"


def test_targets_in_the_documents_are_met_and_todays(
    constrained_flight: Flight,
    varied_flights: dict[tuple[float, float], Flight],
    fly_once: Callable[..., Flight],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The flights over L and d/b are those of tests/scenarios/test_paper.py; two seconds do for the two solvers."""
    difference = numbers.solver_difference(2.0)
    assert 0.0 < difference <= 0.01
    monkeypatch.setattr(numbers, "solver_difference", lambda: difference)
    monkeypatch.setattr(numbers, "fly", fly_once)
    variations = [
        Variation(arm_length=arm, drag_to_thrust=drag, outcome=cost_flights._outcome(flight.scenario, flight.log))
        for (arm, drag), flight in varied_flights.items()
    ]
    table = numbers.markdown(numbers.targets(constrained_flight, variations))
    page = (ROOT / "docs/numbers.md").read_text(encoding="utf-8")
    # The last digits of residues near rounding are the processor's; everything else is to be found as it stands.
    stable = [line for line in table.splitlines() if not re.search(r"mjd_transitionFD|differ by|at the end", line)]
    assert [line for line in stable if line not in page] == []


def test_what_constraints_cost_is_what_the_flights_give(
    fly_known: Callable[..., Flight], monkeypatch: pytest.MonkeyPatch
) -> None:
    """All that no clock decides, of the flight and its counterpart; the sweeps are those of `make numbers`.

    What the steps take is made up.
    """
    fly_here(monkeypatch)
    monkeypatch.setattr(cost_flights, "fly_scenario", fly_known)
    steps: dict[str, Any] = {"step_ms": np.ones(1200), "statuses": ("solved",) * 1200, "repeats": 1}
    timed = [CandidateTimes(name=name, **steps) for name in ("gain", "as flown")]
    few = {"tilts": (), "horizons": (), "arm_lengths": (), "drags": (), "timed": timed}
    study = study_cost(load_scenario("paper-constrained"), [load_scenario("paper-unconstrained")], **few)
    flights = {grid.key: grid for grid in cost_tables(study)}["bounds"]
    page = (ROOT / "docs/constraints-cost.md").read_text(encoding="utf-8")
    lines = [line for line in grid_to_markdown(flights).splitlines() if "error at the end" not in line]
    assert [line for line in lines if line not in page] == []
    answers = [
        line for line in numbers.markdown(make_cost.answer(study)).splitlines() if "[m]" in line or "rad/s" in line
    ]
    assert len(answers) == 3
    assert [line for line in answers if line not in page] == []


def test_convergence_in_the_documents_is_what_the_gains_give() -> None:
    assert numbers.markdown(numbers.lqr_convergence()) in (ROOT / "docs/numbers.md").read_text(encoding="utf-8")


def test_the_examples_in_the_page_on_effects_are_a_scenario(tmp_path: Path) -> None:
    page = (ROOT / "docs/effects.md").read_text(encoding="utf-8")
    example, mismatch, events = re.findall(r"```toml\n(.*?)```", page, flags=re.DOTALL)
    (tmp_path / "heavy-hover.toml").write_text(mismatch, encoding="utf-8")
    heavy = fly_scenario(load_scenario(str(tmp_path / "heavy-hover.toml")))
    assert heavy.state["z"][-1] - heavy.reference["z"][-1] == pytest.approx(-0.2, abs=0.01)
    (tmp_path / "gusty.toml").write_text(example + events, encoding="utf-8")
    scenario = load_scenario(str(tmp_path / "gusty.toml"), ["duration=16.0"])
    assert scenario.effects.air is not None
    assert [event.type for event in scenario.events] == ["gust", "push", "setpoint", "controller"]
    log = fly_scenario(scenario).log
    assert log.plant.wind is not None
    assert log.predicted is not None
    assert log.predicted.shape[1] == 30


def test_documents_link_to_files_that_exist() -> None:
    for document in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", document.read_text(encoding="utf-8")):
            if "://" not in target and target not in MADE:
                assert (document.parent / target).exists(), f"{document.name} links to {target}"


def test_pages_of_the_site_link_to_its_pages_alone() -> None:
    """What is in the repository and not on the site is named, not linked."""
    for document in (ROOT / "docs").glob("*.md"):
        assert "](../" not in document.read_text(encoding="utf-8"), document.name


def test_the_site_has_every_page() -> None:
    site = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    pages = {path.name for path in (ROOT / "docs").glob("*.md")} | MADE
    assert set(re.findall(r"[a-z-]+\.md", site)) == pages


@pytest.mark.usefixtures("campaigns_here")
@pytest.mark.parametrize("document", ["../README.md", *sorted(path.name for path in (ROOT / "docs").glob("*.md"))])
def test_python_on_the_pages_runs(document: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The blocks of a page in their order, as the notebook that it is too."""
    mpl.use("Agg")
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs" / document).read_text(encoding="utf-8")
    module = ModuleType("page")
    for block in re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        exec(compile(block, document, "exec"), module.__dict__)


@pytest.mark.parametrize(
    "document", ["CONTRIBUTING.md", "README.md", *sorted(p.name for p in (ROOT / "docs").glob("*.md"))]
)
def test_documents_name_what_exists(document: str) -> None:
    """Every dotted name of a package in backticks is a module, or something in one."""
    page = next(path for path in (ROOT / document, ROOT / "docs" / document) if path.exists())
    named = set(re.findall(r"`((?:mpc|quadsim|scenarios)(?:\.[A-Za-z_]+)+)`", page.read_text(encoding="utf-8")))
    assert document != "equations.md" or len(named) > 40
    for name in sorted(named - ENTRY_POINTS):
        resolve_name(name)
