"""A check that does not hold, and a page that is out of date, are reported."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from peers.checks import Check, outdated, versioned

CHECK = Check(what="position", peer="pytest", measured=2e-5, allowed=1e-3, unit="m")


@pytest.mark.parametrize(("measured", "holds"), [(1e-3, True), (1.1e-3, False), (math.nan, False), (math.inf, False)])
def test_a_check_holds_up_to_what_is_allowed(measured: float, holds: bool) -> None:
    assert replace(CHECK, measured=measured).holds is holds


def test_a_page_with_a_row_of_todays_magnitude_is_up_to_date() -> None:
    assert CHECK.row == ("position", versioned("pytest"), "2.0e-05 m", "1e-03 m")
    assert outdated(CHECK.row, "| position | " + versioned("pytest") + " | 9.0e-05 m | 1e-03 m |\n") is None


@pytest.mark.parametrize("change", [{"what": "attitude"}, {"peer": "ruff"}, {"allowed": 1e-4}, {"unit": "rad"}])
def test_a_page_with_another_row_is_out_of_date(change: dict[str, object]) -> None:
    page = "| " + " | ".join(CHECK.row) + " |\n"
    assert outdated(CHECK.row, page) is None
    assert "has no row like" in str(outdated(replace(CHECK, **change).row, page))
    assert "it states position" in str(outdated(replace(CHECK, measured=3e-4).row, page))
