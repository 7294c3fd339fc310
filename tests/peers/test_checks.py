"""A check that does not hold is reported."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from peers.checks import Check, versioned

CHECK = Check(what="position", peer="pytest", measured=2e-5, allowed=1e-3, unit="m")


@pytest.mark.parametrize(("measured", "holds"), [(1e-3, True), (1.1e-3, False), (math.nan, False), (math.inf, False)])
def test_a_check_holds_up_to_what_is_allowed(measured: float, holds: bool) -> None:
    assert replace(CHECK, measured=measured).holds is holds


def test_a_row_names_the_peers_version() -> None:
    assert CHECK.row == ("position", versioned("pytest"), "2.0e-05 m", "1e-03 m")
