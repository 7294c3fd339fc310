"""The gate: what it reads, when it holds, and how many flights it takes."""

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from quadsim.errors import InputError, ParameterError, UnknownNameError
from scenarios.campaign.statistics import judge, least_flights, parse_requirement


def flown(flights: int, violated: int) -> pa.Table:
    happened = [i < violated for i in range(flights)]
    return pa.table({"violated": pa.array(happened, pa.bool_()), "rmse.z": pa.array([0.1] * flights, pa.float64())})


def test_a_requirement_is_read() -> None:
    found = parse_requirement("P(violation) < 0.01 @ 95%")
    assert (found.event.text, found.operation, found.share, found.confidence) == ("violation", "<", 0.01, 0.95)
    found = parse_requirement(" p( rmse.z>0.5 )>=2.5%@99.9 % ")
    assert (found.event.text, found.operation, found.share) == ("rmse.z > 0.5", ">=", 0.025)
    assert found.confidence == pytest.approx(0.999)


@pytest.mark.parametrize(
    "text", ["", "violation < 0.01", "P(violation) < 0.01", "P(violation) = 0.01 @ 95%", "P(violation) < 0.01 @ 0.95"]
)
def test_another_form_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"must read P\(EVENT\) OP SHARE @ CONFIDENCE%.*'P\(violation\) < 0.01 @ 95%'"):
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


def test_an_unknown_event_is_refused() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'violation'"):
        parse_requirement("P(violaton) < 0.1 @ 95%")
    with pytest.raises(UnknownNameError, match=r"no column named 'rmse\.q'"):
        judge(flown(10, 0), parse_requirement("P(rmse.q > 1) < 0.1 @ 95%"))


def test_it_takes_299_clean_flights_for_one_percent() -> None:
    parsed = parse_requirement("P(violation) < 0.01 @ 95%")
    assert least_flights(parsed) == 299  # the rule of three gives 300
    assert not judge(flown(298, 0), parsed).holds
    found = judge(flown(299, 0), parsed)
    assert found.holds
    assert found.bound == pytest.approx(0.00997, abs=1e-5)
    assert found.sentence == (
        "P(violation) < 0.01 @ 95% holds: violation in 0 of 299 flights (0 %), so with 95 % confidence at most 0.997 %."
    )


@pytest.mark.parametrize(
    "text", ["P(lost) < 0.5 @ 50%", "P(lost) <= 0.5 @ 50%", "P(lost) < 0.2 @ 90%", "P(lost) > 0.9 @ 99%"]
)
def test_the_least_number_is_the_least(text: str) -> None:
    parsed = parse_requirement(text)
    found = least_flights(parsed)

    def enough(n: int) -> bool:
        side = "less" if parsed.at_most else "greater"
        interval = stats.binomtest(0 if parsed.at_most else n, n, alternative=side).proportion_ci(parsed.confidence)
        return parsed.supported_by(interval.high if parsed.at_most else interval.low)

    assert enough(found)
    assert found == 1 or not enough(found - 1)


@pytest.mark.parametrize(
    "text",
    [
        "P(violation) < 1e-9 @ 99.9999%",
        "P(violation) > 0.999999999 @ 99.9999%",
        "P(violated) >= 99.9999999% @ 99.9999%",
    ],
)
def test_the_largest_requirement_is_reported(text: str) -> None:
    parsed = parse_requirement(text)
    assert least_flights(parsed) == pytest.approx(6.0 * np.log(10.0) * 1e9, rel=1e-6)
    assert "It takes more than 1,000,000,000 flights, " in judge(flown(3, 0), parsed).sentence


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


def test_too_few_flights_are_reported() -> None:
    found = judge(flown(100, 0), parse_requirement("P(violation) < 0.01 @ 95%"))
    assert not found.holds
    assert found.sentence == (
        "P(violation) < 0.01 @ 95% does not hold: violation in 0 of 100 flights (0 %), so with 95 % confidence at most "
        "2.95 %. It takes at least 299 flights, none of them with that event."
    )
    found = judge(flown(20, 20), parse_requirement("P(rmse.z < 0.5) > 0.9 @ 95%"))
    assert found.sentence.endswith("at least 86.1 %. It takes at least 29 flights, all of them with that event.")


def test_many_flights_with_too_many_events_are_not_reported_as_too_few() -> None:
    found = judge(flown(1000, 12), parse_requirement("P(violation) < 0.01 @ 95%"))
    assert not found.holds
    assert found.sentence.endswith("violation in 12 of 1000 flights (1.2 %), so with 95 % confidence at most 1.94 %.")


def test_the_bound_is_one_sided() -> None:
    """4 of 1000: the one-sided bound is 0.91 %, the two-sided interval goes on to 1.02 %."""
    found = judge(flown(1000, 4), parse_requirement("P(violation) < 0.01 @ 95%"))
    one_sided = stats.binomtest(4, 1000, alternative="less").proportion_ci(0.95).high
    two_sided = stats.binomtest(4, 1000).proportion_ci(0.95).high
    assert found.bound == pytest.approx(one_sided)
    assert one_sided < 0.01 < two_sided
    assert found.holds


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
        found = judge(flown(0, 0), parse_requirement(text))
        assert not found.holds
        assert "in 0 of 0 flights, so" in found.sentence


def test_a_judgement_is_plain_data() -> None:
    found = judge(flown(299, 0), parse_requirement("P(violation) < 0.01 @ 95%")).to_json()
    assert found["holds"] is True
    assert found["requirement"]["event"] == "violation"
    assert found["sentence"].startswith("P(violation) < 0.01 @ 95% holds")
