"""A flight's row, and rows as a table."""

from __future__ import annotations

import math
from dataclasses import replace

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quadsim.flight.audit import Finding, Limit, audit
from quadsim.flight.rundir import Run
from scenarios.campaign.rows import (
    flown_row,
    make_schema,
    make_table,
    split_times,
    unit_of,
    worst_margin,
)

ROLL = Limit(name="roll", signal="roll", lower=-5.0, upper=5.0, tolerance=0.5)
MARGINS = st.floats(-20.0, 20.0, width=32)
SPEED = Limit(name="speed", signal="speed", lower=0.0, upper=250.0)


def finding(limit: Limit, margin: float, sampled: float | None = None) -> Finding:
    return Finding(
        limit=limit,
        peak_sampled=0.0,
        peak_plant=0.0,
        worst_margin_sampled=margin if sampled is None else sampled,
        worst_margin=margin,
        worst_time=0.0,
        time_violated=0.0,
    )


def test_a_row_follows_the_schema(short_run: Run) -> None:
    schema = make_schema({"mass": (pa.float64(), "kg"), "kind": (pa.string(), "-")}, short_run.limits)
    row = flown_row(
        short_run.log, audit(short_run.log, short_run.limits), verdict="violated", wall_s=1.5, machine="x86"
    )
    known = {"flight", "seed", "draw.mass", "draw.kind", "failed"}
    assert {*row} | known == {*schema.names}
    table = make_table([{**row, "flight": 2, "seed": 1, "failed": True}], schema)
    assert table.schema == schema
    assert table["duration"].to_pylist() == [6.0]
    assert table["draw.mass"].to_pylist() == [None]
    units = {name: unit_of(table, name) for name in ("margin.roll", "rmse.x", "verdict", "draw.mass", "draw.kind")}
    assert units == {"margin.roll": "deg", "rmse.x": "m", "verdict": "-", "draw.mass": "kg", "draw.kind": "-"}


def test_a_row_agrees_with_the_summary(short_run: Run) -> None:
    row = flown_row(
        short_run.log, audit(short_run.log, short_run.limits), verdict="satisfied", wall_s=0.0, machine="x86"
    )
    summary = short_run.summary
    assert row["rmse.z"] == summary["tracking"]["rmse"]["z"]
    assert row["slew_max"] == summary["control"]["slew_max"]
    assert row["iterations.max"] == summary["controller"]["iterations"]["max"]
    assert row["unsolved_periods"] == 0
    assert row["margin.arrival_x"] is None, "a window that was not reached"
    assert row["satisfied.arrival_x"] is None, "neither held nor violated"


def test_rows_are_sorted_and_clock_times_stand_apart(short_run: Run) -> None:
    schema = make_schema({}, short_run.limits)
    rows = [{"flight": k, "seed": k, "failed": False, "wall_s": 1.0} for k in (2, 0, 1)]
    flights, times = split_times(make_table(rows, schema))
    assert flights["flight"].to_pylist() == [0, 1, 2]
    assert times.column_names == ["flight", "machine", "wall_s", "step_p50_ms", "step_p99_ms"]
    assert not {"machine", "wall_s", "step_p50_ms"} & {*flights.column_names}


@pytest.mark.parametrize(
    ("findings", "expected"),
    [
        ([], (None, None)),
        ([finding(ROLL, 4.5, 5.0)], (1.0, "roll")),
        ([finding(ROLL, -0.5, 0.0)], (0.0, "roll")),
        ([finding(ROLL, 0.0, -0.5)], (-0.1, "roll")),
        ([finding(ROLL, 4.5, math.nan)], (1.0, "roll")),
        ([finding(replace(ROLL, tolerance_sampled=0.25), 0.0, -0.5)], (-0.05, "roll")),
        ([finding(ROLL, -3.0, -2.0)], (-0.5, "roll")),
        ([finding(replace(ROLL, required=False), -3.0)], (None, None)),
        ([finding(ROLL, math.nan)], (None, None)),
        ([finding(ROLL, 4.5, 5.0), finding(SPEED, 0.0)], (1.0, "roll")),
        ([finding(ROLL, 4.5, 5.0), finding(SPEED, -12.5)], (-0.1, "speed")),
        ([finding(replace(ROLL, lower=-math.inf), -3.0, -2.5)], (-0.5, "roll")),
        ([finding(replace(ROLL, lower=-math.inf, upper=0.0), -3.0, -2.5)], (-2.5, "roll")),
    ],
)
def test_the_worst_margin_is_a_share_of_half_the_band(
    findings: list[Finding], expected: tuple[float | None, str | None]
) -> None:
    share, name = worst_margin(findings)
    assert name == expected[1]
    assert share == (None if expected[0] is None else pytest.approx(expected[0]))


@given(
    margin=MARGINS,
    sampled=MARGINS | st.just(math.nan),
    tolerances=st.tuples(*[st.floats(0.0, 5.0, width=32)] * 2),
    signal=st.sampled_from(["roll", "speed"]),
    lower=st.sampled_from([-5.0, -math.inf]),
)
def test_the_worst_margin_is_negative_where_a_constraint_that_was_reached_did_not_hold(
    margin: float, sampled: float, tolerances: tuple[float, float], signal: str, lower: float
) -> None:
    inner, outer = sorted(tolerances)
    limit = Limit(name="a", signal=signal, lower=lower, upper=5.0, tolerance=outer, tolerance_sampled=inner)
    found = finding(limit, margin, sampled)
    share, _ = worst_margin([found])
    assert (share is not None and share < 0.0) is not found.satisfied


def test_text_that_is_no_unicode_is_stored() -> None:
    schema = make_schema({"kind": (pa.string(), "-")}, [])
    rows = [{"flight": 0, "draw.kind": "\udc80", "reason": "no file a\udcff \u00e4\n"}]
    table = make_table(rows, schema)
    assert table.select(["draw.kind", "reason"]).to_pylist() == [
        {"draw.kind": "\\udc80", "reason": "no file a\\udcff \u00e4\n"}
    ]
