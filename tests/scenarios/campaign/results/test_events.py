"""Events: names and comparisons, what is not known, and what is refused."""

import numpy as np
import pyarrow as pa
import pytest

from quadsim.errors import InputError, ParameterError, UnknownNameError
from scenarios.campaign.events import parse_event

ROW = {
    **{"failed": False, "violated": True, "crashed": False, "verdict": "lost"},
    **{"rmse.z": 0.4, "margin.roll-rate": -1.0, "iterations.max": 12, "gone": None},
}
KINDS = {"rmse.z": pa.float64(), "iterations.max": pa.int64(), "crashed": pa.bool_(), "verdict": pa.string()}


@pytest.mark.parametrize(
    ("text", "name", "holds"),
    [
        ("failure", "failure", False),
        ("violated", "violation", True),
        ("lost", "lost", True),
        ("crashed", "crash", False),
        (" error ", "error", False),
        ("rmse.z > 0.4", "rmse.z > 0.4", False),
        ("rmse.z>=0.4", "rmse.z >= 0.4", True),
        ("rmse.z  <=  .4", "rmse.z <= 0.4", True),
        ("margin.roll-rate < -0.5", "margin.roll-rate < -0.5", True),
        ("iterations.max > 11.5", "iterations.max > 11.5", True),
        ("violated > 0.5", "violated > 0.5", True),
    ],
)
def test_an_event_is_read_and_reported(text: str, name: str, holds: bool) -> None:
    event = parse_event(text)
    assert event.text == name
    assert event.holds(ROW) is holds
    assert parse_event(event.text) == event


@pytest.mark.parametrize("operation", ["<", "<=", ">", ">="])
def test_what_is_not_known_holds(operation: str) -> None:
    event = parse_event(f"gone {operation} 0")
    assert event.holds(ROW)
    assert event.holds({"gone": float("nan")})
    assert parse_event("violation").holds({"violated": None})


def test_a_column_is_every_row() -> None:
    table = pa.table({"verdict": ["lost", "error", "satisfied"], "rmse.z": pa.array([0.1, None, 0.7])})
    for text in ("lost", "error", "rmse.z > 0.5", "rmse.z <= 0.5"):
        event = parse_event(text)
        assert event.column(table).tolist() == [event.holds(row) for row in table.to_pylist()]
    assert parse_event("rmse.z > 0.5").column(table).tolist() == [False, True, True]
    empty = parse_event("lost").column(table.slice(0, 0))
    assert (empty.dtype, empty.size) == (np.dtype(bool), 0)


def test_an_unknown_event_or_column_names_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match=r"no event named 'violatoin'; did you mean 'violation'\?.*COLUMN OP"):
        parse_event("violatoin")
    with pytest.raises(UnknownNameError, match=r"no event named 'rmse\.z == 0\.5'"):
        parse_event("rmse.z == 0.5")
    event = parse_event("rmse.zz > 1")
    for refuse in (lambda: event.holds(ROW), lambda: event.column(pa.table({"rmse.z": [1.0]}))):
        with pytest.raises(UnknownNameError, match=r"no column named 'rmse\.zz'"):
            refuse()
    with pytest.raises(UnknownNameError, match=r"no column named 'rmse.zz'; did you mean 'rmse.z'\?") as raised:
        parse_event("rmse.zz > 1", columns=KINDS)
    assert raised.value.allowed == ("crashed", "iterations.max", "rmse.z"), "those that a number compares with"


@pytest.mark.parametrize("number", ["", "high", "inf"])
def test_a_comparison_needs_a_number(number: str) -> None:
    with pytest.raises(ParameterError, match="must be a finite number"):
        parse_event(f"rmse.z > {number}")


def test_text_is_no_number() -> None:
    with pytest.raises(InputError, match="the column 'verdict' holds text"):
        parse_event("verdict > 1").holds(ROW)
    with pytest.raises(InputError, match="event 'verdict > 1' compares with a number; the column 'verdict' holds"):
        parse_event("verdict > 1", columns=KINDS)
    with pytest.raises(InputError, match="the column 'verdict' holds text"):
        parse_event("verdict > 1").column(pa.table({"verdict": pa.array([], pa.string())}))


@pytest.mark.parametrize("column", ["flight", "seed", "failed"])
def test_what_measures_no_flight_is_not_compared(column: str) -> None:
    for columns in (None, {column: pa.int64()}):
        with pytest.raises(InputError, match=f"must compare a column that measures a flight.*'{column}' does not"):
            parse_event(f"{column} >= 1", columns)
