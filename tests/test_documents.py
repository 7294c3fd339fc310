"""The numbers in the documents are today's."""

from __future__ import annotations

import re
from pathlib import Path

import make_cost
import make_numbers as numbers

from quadsim.report.table import grid_to_markdown
from scenarios.cost.cost_tables import cost_tables
from scenarios.cost.measure import fly_variations, study_cost
from scenarios.loading import load_scenario
from scenarios.run import Flight, fly_scenario

ROOT = Path(__file__).resolve().parent.parent


def test_results_in_the_readme_are_what_the_flights_give(
    constrained_flight: Flight, unconstrained_flight: Flight
) -> None:
    flights = {
        "paper-unconstrained": unconstrained_flight,
        "paper-unconstrained-clipped": numbers.fly("paper-unconstrained-clipped"),
        "paper-constrained": constrained_flight,
    }
    table = numbers.markdown(numbers.results(flights))
    for document in ("README.md", "docs/numbers.md"):
        assert table in (ROOT / document).read_text(encoding="utf-8"), f"{document} is out of date: make numbers"


def test_targets_in_the_readme_are_met_and_todays(constrained_flight: Flight) -> None:
    variations = fly_variations(load_scenario("paper-constrained"))
    table = numbers.markdown(numbers.targets(constrained_flight, variations))
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    # The last digits of residues near rounding are the processor's; everything else is to be found as it stands.
    stable = [line for line in table.splitlines() if not re.search(r"mjd_transitionFD|differ by|at the end", line)]
    assert [line for line in stable if line not in readme] == []


def test_what_constraints_cost_is_what_the_flights_give() -> None:
    """All that no clock decides, of the flight and its counterpart; the sweeps are those of `make numbers`."""
    few = {"tilts": (), "horizons": (), "arm_lengths": (), "drags": (), "solvers": ()}
    study = study_cost(load_scenario("paper-constrained"), [load_scenario("paper-unconstrained")], **few)
    flights = {grid.key: grid for grid in cost_tables(study)}["bounds"]
    page, readme = (ROOT / name for name in ("docs/constraints-cost.md", "README.md"))
    lines = [line for line in grid_to_markdown(flights).splitlines() if "error at the end" not in line]
    assert [line for line in lines if line not in page.read_text(encoding="utf-8")] == []
    answers = [
        line for line in numbers.markdown(make_cost.answer(study)).splitlines() if "[m]" in line or "rad/s" in line
    ]
    assert len(answers) == 3
    assert [line for line in answers if line not in readme.read_text(encoding="utf-8")] == []


def test_convergence_in_the_documents_is_what_the_gains_give() -> None:
    assert numbers.markdown(numbers.lqr_convergence()) in (ROOT / "docs/numbers.md").read_text(encoding="utf-8")


def test_the_readme_has_the_table_of_the_verification_page() -> None:
    """tests/peers holds the page to what is measured."""
    readme, page = ((ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "docs/verification.md"))
    table = readme.partition("<!-- verification: made by `make verification` -->")[2].partition("<!-- ")[0].strip()
    assert table.startswith("| check | peer | measured | allowed |")
    assert table in page


def test_the_example_in_the_page_on_effects_is_a_scenario(tmp_path: Path) -> None:
    page = (ROOT / "docs/effects.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```toml\n(.*?)```", page, flags=re.DOTALL)
    (tmp_path / "gusty.toml").write_text(example, encoding="utf-8")
    scenario = load_scenario(str(tmp_path / "gusty.toml"), ["duration=16.0"])
    assert scenario.effects.air is not None
    assert fly_scenario(scenario).log.plant.wind is not None


def test_documents_link_to_files_that_exist() -> None:
    for document in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", document.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (document.parent / target).exists(), f"{document.name} links to {target}"
