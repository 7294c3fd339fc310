"""The numbers in the documents are today's."""

from __future__ import annotations

import re
from pathlib import Path

import make_numbers as numbers

from scenarios.runner import Flight

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
    table = numbers.markdown(numbers.targets(constrained_flight, numbers.sensitivity()))
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    # The last digits of residues near rounding are the processor's; everything else is to be found as it stands.
    stable = [line for line in table.splitlines() if not re.search(r"mjd_transitionFD|differ by|at the end", line)]
    assert [line for line in stable if line not in readme] == []


def test_convergence_in_the_documents_is_what_the_gains_give() -> None:
    assert numbers.markdown(numbers.lqr_convergence()) in (ROOT / "docs/numbers.md").read_text(encoding="utf-8")


def test_documents_link_to_files_that_exist() -> None:
    for document in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", document.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (document.parent / target).exists(), f"{document.name} links to {target}"
