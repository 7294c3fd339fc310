"""A campaign judged by other tolerances, from the margins in its table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from quadsim.errors import InputError
from quadsim.features.campaign.events import parse_event
from quadsim.features.campaign.reaudit import judged_by
from quadsim.features.campaign.rows import null, numbers
from quadsim.flight.audit import Limit

ROLL = Limit(name="roll", signal="roll", lower=-5.0, upper=5.0, tolerance=0.05)
SLEW = Limit(name="slew", signal="slew", lower=-6.0, upper=6.0, required=False)
FAILURE = [parse_event("violated")]


def test_a_wider_tolerance_forgives_the_flights_within_it(thousand: pa.Table) -> None:
    wide = replace(ROLL, tolerance=0.3)
    judged = judged_by([wide, SLEW], [ROLL, SLEW], thousand, FAILURE)
    margin = numbers(thousand, "margin.roll")
    known = ~null(thousand, "satisfied.roll")
    assert np.array_equal(numbers(judged, "satisfied.roll")[known] == 1.0, margin[known] >= -0.3)
    before = np.array(thousand["verdict"].to_pylist())
    after = np.array(judged["verdict"].to_pylist())
    forgiven = (before == "violated") & (margin >= -0.3)
    assert forgiven.any()
    assert set(after[forgiven]) == {"satisfied"}
    assert np.array_equal(after[before == "lost"], before[before == "lost"])
    assert np.array_equal(numbers(judged, "failed"), numbers(judged, "violated"))


def test_a_constraint_that_no_flight_reached_stays_unknown(thousand: pa.Table) -> None:
    """The column has no value then, of which Arrow would make one without a type."""
    flights = thousand.slice(0, 10)
    place = flights.column_names.index("satisfied.slew")
    unreached = flights.set_column(place, flights.schema.field(place), pa.nulls(10, pa.bool_()))
    judged = judged_by([ROLL, SLEW], [ROLL, SLEW], unreached, FAILURE)
    assert judged["satisfied.slew"].type == pa.bool_()
    assert null(judged, "satisfied.slew").all()


def test_other_bounds_are_refused(thousand: pa.Table) -> None:
    with pytest.raises(InputError, match="fly it again with the same"):
        judged_by([replace(ROLL, upper=4.0), SLEW], [ROLL, SLEW], thousand, FAILURE)
