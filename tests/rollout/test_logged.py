"""Signals that a controller logs, and the names of its state."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from support import NO_PRODUCTS

import quadsim
from quadsim.controller import StepInputs
from quadsim.flight.log import COLUMNS
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import Array, State


class Logging:
    """Holds hover, logs the height [m] in each period and the thrust in some."""

    def __init__(self, vehicle: quadsim.Vehicle, period: float, horizon: int, **logged: Any) -> None:
        self.speeds = np.full(4, vehicle.hover_speed + 1.0)
        self.logged = logged

    def step(self, now: StepInputs, state: State, reference: Array) -> Array:
        now.log("height", -1.0)
        now.log("height", state.z, "m")
        if 0.08 < now.time < 0.22:
            now.log("count", round(now.time / 0.05))
        for name, value in self.logged.items():
            now.log(name, value)
        return self.speeds


@pytest.fixture(scope="module")
def hover() -> Scenario:
    return quadsim.load("hover").replace({"duration": 0.3})


def test_what_a_controller_logs_is_a_column_with_gaps(hover: Scenario, tmp_path: Path) -> None:
    flight = quadsim.fly(hover, controller=Logging)
    np.testing.assert_array_equal(flight.logged["height"], flight.state["z"])
    np.testing.assert_array_equal(flight.logged["count"], [math.nan, math.nan, 2.0, 3.0, 4.0, math.nan])
    run = flight.save(tmp_path / "run", **NO_PRODUCTS)
    again = quadsim.read(run)
    assert [*again.logged] == ["height", "count"]
    for name, values in flight.logged.items():
        np.testing.assert_array_equal(again.logged[name], values)
        np.testing.assert_array_equal(flight.to_arrow()[name].to_numpy(), values)
    schema = pq.read_schema(run / "flight.parquet")
    assert schema.field("height").metadata[b"unit"] == b"m"
    assert schema.field("count").metadata[b"unit"] == b"-"
    assert {*schema.names} - COLUMNS == {"height", "count"}
    assert quadsim.check(run).satisfied == flight.satisfied
    swept = quadsim.sweep(hover, {"vehicle.mass": [3.9, 4.0]}, controller=Logging, workers=1)
    assert "aborted" not in swept["verdict"].tolist()


def test_nothing_is_logged_without_a_testbed_and_by_the_laws_that_ship(hover: Scenario) -> None:
    law = Logging(quadsim.load_vehicle("hummingbird"), 0.05, 1)
    law.step(StepInputs(), np.zeros(12).view(State), np.zeros((1, 4)))
    flight = quadsim.fly(hover)
    assert flight.logged == {}
    assert {*flight.to_arrow().column_names} <= COLUMNS


@pytest.mark.parametrize(
    ("name", "value", "problem"),
    [
        ("roll", 1.0, "log.name must be an identifier that is no column of flight.parquet; got 'roll'"),
        ("true_x", 1.0, "log.name must be an identifier that is no column of flight.parquet; got 'true_x'"),
        ("of z", 1.0, "log.name must be an identifier that is no column of flight.parquet; got 'of z'"),
        ("drag", math.inf, "log.drag must be one number, finite or NaN; got inf"),
        ("drag", "1.0", "log.drag must be one number, finite or NaN; got '1.0'"),
        ("drag", np.zeros(2), "log.drag must be one number, finite or NaN; got array([0., 0.])"),
    ],
)
def test_a_signal_that_cannot_be_logged_ends_the_flight(
    hover: Scenario, name: str, value: object, problem: str
) -> None:
    def law(now: StepInputs, state: Array, reference: Array) -> Array:
        if now.time > 0.12:
            now.log(name, value)  # type: ignore[arg-type]
        return np.full(4, 200.0)

    flight = quadsim.fly(hover, controller=law)
    assert (flight.outcome, flight.time.size) == ("aborted", 3)
    assert flight.log.reason is not None
    assert flight.log.reason.endswith(problem)
    assert any("now.log(name, value)" in line for line in flight.log.traceback)


def test_a_logged_signal_is_plotted(hover: Scenario) -> None:
    flight = hover.fly(controller=Logging)
    (axes,) = flight.plot("height")
    assert axes.get_ylabel() == "height [m]"
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), flight.logged["height"])
    with pytest.raises(quadsim.QuadsimError, match="height"):
        flight.plot("heigth")
