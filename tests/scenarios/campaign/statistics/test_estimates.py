"""The summary against numbers worked out by hand or by another route."""

import json
from collections.abc import Callable

import numpy as np
import pyarrow as pa
import pytest
from scipy import stats

from quadsim.errors import InputError, ParameterError
from scenarios.campaign.campaign_report import event_table, verdict_sentence
from scenarios.campaign.paired import compare
from scenarios.campaign.statistics import estimate, judge, parse_requirement, ranking, worst_flight

MakeCampaign = Callable[..., pa.Table]
NONE = ("incomplete", "died", "timeout", "memory")


def with_column(table: pa.Table, name: str, values: list[object]) -> pa.Table:
    i = table.column_names.index(name)
    return table.set_column(i, table.schema.field(i), pa.array(values, table.schema.field(i).type))


@pytest.fixture(scope="module")
def small() -> pa.Table:
    """Eight flights: satisfied but for 3 and 6 lost, 1 and 5 violated, 4 an error; flight 7 failed by a metric."""
    return pa.table(
        {
            "flight": list(range(8)),
            "verdict": ["satisfied", "violated", "satisfied", "lost", "error", "violated", "lost", "satisfied"],
            "reason": [None, None, None, "gone", "raised", None, "gone", None],
            "failed": [False, True, False, True, True, True, True, True],
            "violated": [False, True, False, True, True, True, True, False],
            "crashed": [False, False, False, True, False, False, False, False],
            "duration": [9.0, 9.0, 9.0, 2.0, None, 9.0, 1.0, 9.0],
            "rmse.x": [0.1, 0.2, 0.3, 5.0, None, 0.4, 6.0, 0.9],
            "worst_margin": [0.5, -0.1, 0.2, -3.0, None, -0.4, None, 0.8],
            "worst_constraint": ["roll", "roll", "roll", "roll", None, "roll", None, "roll"],
            "margin.roll": [2.5, -0.5, 1.0, -15.0, None, -2.0, None, 4.0],
            "satisfied.roll": [True, False, True, False, None, False, False, True],
            "draw.mass": [1.0, 1.3, 1.1, 1.5, 1.2, 1.4, 1.6, 0.9],
            "draw.kind": ["a", "b", "a", "b", "b", "a", "b", "a"],
        }
    )


def test_events_and_verdicts_are_counted(small: pa.Table) -> None:
    found = estimate(small)
    assert found["flights"] == 8
    assert found["verdicts"] == {"satisfied": 3, "violated": 2, "lost": 2, "error": 1} | dict.fromkeys(NONE, 0)
    counts = {name: event["count"] for name, event in found["events"].items()}
    expected = {"failure": 6, "violation": 5, "lost": 2, "crash": 1, "error": 1} | dict.fromkeys(NONE, 0)
    assert counts == expected
    assert [line[0].text for line in event_table(found).lines] == ["failure", "violation", "lost", "crash", "error"]
    failure = found["events"]["failure"]
    exact = stats.binomtest(6, 8).proportion_ci(0.95)
    assert (failure["share"], failure["lower"], failure["upper"]) == pytest.approx((0.75, exact.low, exact.high))


def test_metrics_are_those_of_the_flights_that_have_them(small: pa.Table) -> None:
    found = estimate(small)["metrics"]
    assert list(found) == ["duration", "rmse.x", "worst_margin"]
    values = np.array([0.1, 0.2, 0.3, 5.0, 0.4, 6.0, 0.9])
    assert found["rmse.x"]["flights"] == 7
    assert found["rmse.x"]["mean"] == pytest.approx(values.mean())
    assert found["rmse.x"]["sd"] == pytest.approx(values.std(ddof=1))
    assert found["rmse.x"]["p95"] == pytest.approx(np.percentile(values, 95))
    assert (found["rmse.x"]["min"], found["rmse.x"]["max"]) == (0.1, 6.0)


def test_a_constraint_that_lost_flights_did_not_reach_did_not_hold(small: pa.Table) -> None:
    roll = estimate(small)["constraints"]["roll"]
    assert (roll["not_satisfied"]["count"], roll["not_satisfied"]["flights"]) == (5, 8)
    assert (roll["worst_margin"], roll["worst_flight"]) == (-15.0, 3)


def test_incomplete_flights_are_neither_failures_nor_successes(small: pa.Table) -> None:
    """Flights 0 and 2 ended before the window of `roll`."""
    verdicts = ["incomplete" if i in (0, 2) else value for i, value in enumerate(small["verdict"].to_pylist())]
    held = [None if i in (0, 2) else value for i, value in enumerate(small["satisfied.roll"].to_pylist())]
    table = with_column(with_column(small, "verdict", verdicts), "satisfied.roll", held)
    found, before = estimate(table), estimate(small)
    assert (found["flights"], found["verdicts"]["incomplete"]) == (8, 2)
    for event in ("failure", "violation"):
        assert found["events"][event]["flights"] == 6
        assert found["events"][event]["count"] == before["events"][event]["count"]
    assert found["events"]["lost"] == before["events"]["lost"]
    assert found["constraints"]["roll"]["not_satisfied"]["flights"] == 6
    assert judge(table, parse_requirement("P(violation) < 0.99 @ 95%")).flights == 6
    assert verdict_sentence(found).startswith("6 of 6 flights failed")
    assert verdict_sentence(found).endswith("; 2 incomplete flights not counted")


def test_a_campaign_of_incomplete_flights_reports_no_failure_and_no_success(small: pa.Table) -> None:
    table = with_column(with_column(small, "verdict", ["incomplete"] * 8), "failed", [False] * 8)
    table = with_column(with_column(table, "violated", [False] * 8), "satisfied.roll", [None] * 8)
    found = estimate(table)
    assert verdict_sentence(found) == "0 of 0 flights failed; 8 incomplete flights not counted"
    assert found["events"]["failure"]["flights"] == found["constraints"]["roll"]["not_satisfied"]["flights"] == 0
    assert not judge(table, parse_requirement("P(violation) < 0.99 @ 95%")).holds
    with pytest.raises(InputError, match="no pair of flights of which both reached every required constraint"):
        compare(table, table, ("one", "other"))


def test_the_worst_flights_come_first(small: pa.Table) -> None:
    assert ranking(small).tolist() == [3, 6, 4, 5, 1, 7, 2, 0]
    assert worst_flight(small) == 3
    worst = estimate(small)["worst"]
    assert [flight["flight"] for flight in worst] == [3, 6, 4, 5, 1, 7, 2, 0]
    assert worst[0]["draws"] == {"mass": 1.5, "kind": "b"}
    assert worst[1]["worst_margin"] is None


def test_equal_flights_come_in_the_order_of_their_numbers(small: pa.Table) -> None:
    same = pa.concat_tables([small.slice(0, 1)] * 3).set_column(0, "flight", pa.array([12, 5, 30]))
    assert worst_flight(same) == 5


def test_without_margins_the_largest_error_is_the_worst(small: pa.Table) -> None:
    free = with_column(small, "worst_margin", [None] * 8).take([0, 2, 7])
    free = with_column(free, "failed", [False] * 3)
    assert worst_flight(free) == 7


def test_no_flight_is_no_worst(small: pa.Table) -> None:
    with pytest.raises(ParameterError, match=r"campaign\.flights must be at least one"):
        worst_flight(small.slice(0, 0))


def test_a_lost_flight_without_margin_ranks_below_all(small: pa.Table) -> None:
    found = estimate(small)["parameters"]["mass"]["worst_margin"]
    mass = [1.0, 1.3, 1.1, 1.5, 1.4, 1.6, 0.9]
    expected = stats.spearmanr(mass, [0.5, -0.1, 0.2, -3.0, -0.4, -1e9, 0.8]).statistic
    assert found["rho"] == pytest.approx(expected)
    assert found["flights"] == 7


def test_what_is_drawn_from_names_has_shares(small: pa.Table) -> None:
    found = estimate(small)["parameters"]["kind"]
    assert found["kind"] == "name"
    assert {level: (share["count"], share["flights"]) for level, share in found["levels"].items()} == {
        "a": (2, 4),
        "b": (4, 4),
    }


def test_drivers_are_those_that_were_put_in(thousand: pa.Table) -> None:
    found = estimate(thousand)["parameters"]
    tested = {name: entry["worst_margin"] for name, entry in found.items() if entry["kind"] == "number"}
    assert {name for name, one in tested.items() if one["p_holm"] < 0.05} == {"mass", "wind"}
    assert tested["wind"]["rho"] < tested["mass"]["rho"] < -0.3
    assert all(one["p"] <= one["p_holm"] for one in tested.values())
    assert found["wind"]["failed"]["rho"] > 0.1
    assert set(found["payload"]["levels"]) == {"false", "true"}


def test_nothing_goes_with_what_never_happens(make_campaign: MakeCampaign) -> None:
    found = estimate(make_campaign(40, severity=0.0))
    assert found["events"]["failure"]["count"] == 0
    assert all(entry["failed"] is None for entry in found["parameters"].values() if entry["kind"] == "number")


@pytest.mark.parametrize("flights", [0, 1, 2, 5])
def test_campaigns_of_few_flights_are_strict_json(make_campaign: MakeCampaign, flights: int) -> None:
    table = make_campaign(flights)
    found = estimate(table)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["flights"] == flights
    assert len(found["worst"]) == flights


def test_the_summary_of_a_thousand_is_strict_json(thousand: pa.Table) -> None:
    found = estimate(thousand)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert len(found["worst"]) == 10
    assert found["metrics"]["rmse.x"]["unit"] == "m"
    assert not [name for name in found["metrics"] if name.startswith(("draw.", "margin.", "time_violated.", "seed"))]
