"""Events: names and comparisons, what is not known, and what is refused."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from quadsim.errors import InputError, ParameterError, UnknownNameError
from quadsim.features.campaign.events import parse_event
from quadsim.features.campaign.statistics import judge, least_flights, parse_requirement

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
    with pytest.raises(UnknownNameError, match="'violatoin'"):
        parse_event("violatoin")
    with pytest.raises(UnknownNameError, match=r"'rmse\.z == 0\.5'"):
        parse_event("rmse.z == 0.5")
    event = parse_event("rmse.zz > 1")
    for refuse in (lambda: event.holds(ROW), lambda: event.column(pa.table({"rmse.z": [1.0]}))):
        with pytest.raises(UnknownNameError, match=r"'rmse\.zz'"):
            refuse()
    with pytest.raises(UnknownNameError, match=r"'rmse\.zz'") as raised:
        parse_event("rmse.zz > 1", columns=KINDS)
    assert raised.value.allowed == ("crashed", "iterations.max", "rmse.z"), "those that a number compares with"


@pytest.mark.parametrize("number", ["", "high", "inf"])
def test_a_comparison_needs_a_number(number: str) -> None:
    with pytest.raises(ParameterError, match="finite"):
        parse_event(f"rmse.z > {number}")


def test_text_is_no_number() -> None:
    with pytest.raises(InputError, match="'verdict'"):
        parse_event("verdict > 1").holds(ROW)
    with pytest.raises(InputError, match="'verdict > 1'"):
        parse_event("verdict > 1", columns=KINDS)
    with pytest.raises(InputError, match="'verdict'"):
        parse_event("verdict > 1").column(pa.table({"verdict": pa.array([], pa.string())}))


@pytest.mark.parametrize("column", ["flight", "seed", "failed"])
def test_what_measures_no_flight_is_not_compared(column: str) -> None:
    for columns in (None, {column: pa.int64()}):
        with pytest.raises(InputError, match=f"'{column}'"):
            parse_event(f"{column} >= 1", columns)


def flown(flights: int, violated: int) -> pa.Table:
    happened = [i < violated for i in range(flights)]
    return pa.table({"violated": pa.array(happened, pa.bool_()), "rmse.z": pa.array([0.1] * flights, pa.float64())})


def test_a_requirement_is_read() -> None:
    result = parse_requirement("P(violation) < 0.01 @ 95%")
    assert (result.event.text, result.operation, result.share, result.confidence) == ("violation", "<", 0.01, 0.95)
    result = parse_requirement(" p( rmse.z>0.5 )>=2.5%@99.9 % ")
    assert (result.event.text, result.operation, result.share) == ("rmse.z > 0.5", ">=", 0.025)
    assert result.confidence == pytest.approx(0.999)


@pytest.mark.parametrize(
    "text", ["", "violation < 0.01", "P(violation) < 0.01", "P(violation) = 0.01 @ 95%", "P(violation) < 0.01 @ 0.95"]
)
def test_another_form_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"P\(EVENT\)"):
        parse_requirement(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("P(lost) < 0 @ 95%", "share must be a number from 1e-9 to 0.999999999; got '0'"),
        ("P(lost) < 1 @ 95%", "share must be a number from 1e-9 to 0.999999999; got '1'"),
        ("P(lost) < few @ 95%", "share must be a number from 1e-9 to 0.999999999; got 'few'"),
        ("P(lost) < 100% @ 95%", "share must be from 0.0000001% to 99.9999999%; got '100%'"),
        ("P(lost) < nan @ 95%", "share must be"),
        ("P(lost) < inf @ 95%", "share must be"),
        ("P(lost) < 1e-17 @ 95%", "share must be"),
        ("P(lost) < 1e-9999999999999999999 @ 95%", "share must be"),
        ("P(lost) > 0.99999999999999 @ 95%", "share must be"),
        ("P(lost) < 0.1 @ 100%", "confidence must be from 50% to 99.9999%; got '100%'"),
        ("P(lost) < 0.1 @ 99.99999999%", "confidence must be"),
        ("P(lost) < 0.1 @ 49%", "confidence must be"),
        ("P(lost) < 0.1 @ most%", "confidence must be"),
    ],
)
def test_numbers_out_of_range_are_refused(text: str, message: str) -> None:
    with pytest.raises(ParameterError, match="requirement 'P") as raised:
        parse_requirement(text)
    assert message in str(raised.value)


def test_it_takes_299_clean_flights_for_one_percent() -> None:
    parsed = parse_requirement("P(violation) < 0.01 @ 95%")
    assert least_flights(parsed) == 299  # the rule of three gives 300
    assert not judge(flown(298, 0), parsed).holds
    result = judge(flown(299, 0), parsed)
    assert result.holds
    assert result.bound == pytest.approx(0.00997, abs=1e-5)
    assert result.sentence == (
        "P(violation) < 0.01 @ 95% holds: violation in 0 of 299 flights (0 %), so with 95 % confidence at most 0.997 %."
    )


@given(
    share=st.floats(1e-5, 1.0 - 1e-5),
    confidence=st.floats(50.0, 99.9999),
    operation=st.sampled_from(["<", "<=", ">", ">="]),
)
def test_the_least_number_supports_and_one_less_does_not(share: float, confidence: float, operation: str) -> None:
    parsed = parse_requirement(f"P(violation) {operation} {share!r} @ {confidence!r}%")
    n = least_flights(parsed)
    assert judge(flown(n, 0 if parsed.at_most else n), parsed).holds if n < 1000 else n > 1
    exact = np.log1p(-parsed.confidence) / (np.log1p(-share) if parsed.at_most else np.log(share))
    assert exact - 1e-6 * n <= n <= exact + 1.0 + 1e-6 * n


def test_the_bound_is_one_sided() -> None:
    """4 of 1000: the one-sided bound is 0.91 %, the two-sided interval goes on to 1.02 %."""
    result = judge(flown(1000, 4), parse_requirement("P(violation) < 0.01 @ 95%"))
    one_sided = stats.binomtest(4, 1000, alternative="less").proportion_ci(0.95).high
    two_sided = stats.binomtest(4, 1000).proportion_ci(0.95).high
    assert result.bound == pytest.approx(one_sided)
    assert one_sided < 0.01 < two_sided
    assert result.holds


def test_a_lower_limit_takes_the_lower_bound() -> None:
    parsed = parse_requirement("P(violation) > 0.9 @ 95%")
    assert judge(flown(200, 190), parsed).bound == pytest.approx(
        stats.binomtest(190, 200, alternative="greater").proportion_ci(0.95).low
    )
    assert judge(flown(200, 190), parsed).holds
    assert not judge(flown(200, 182), parsed).holds


def test_a_flight_without_the_number_counts_against_it() -> None:
    table = pa.table({"rmse.z": pa.array([0.1] * 99 + [None])})
    assert judge(table, parse_requirement("P(rmse.z > 0.5) < 0.1 @ 95%")).count == 1


def test_no_flights_support_nothing() -> None:
    for text in ("P(violation) < 0.99 @ 50%", "P(violation) > 0.01 @ 50%"):
        result = judge(flown(0, 0), parse_requirement(text))
        assert not result.holds
        assert "in 0 of 0 flights, so" in result.sentence
