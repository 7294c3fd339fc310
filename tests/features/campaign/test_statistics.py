"""Intervals and tests of a campaign against closed forms, published numbers, scipy, and simulation."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from scipy import stats

from quadsim.errors import InputError, ParameterError
from quadsim.features.campaign.campaign_report import driver_sentence, driver_table, event_table, verdict_sentence
from quadsim.features.campaign.paired import compare_pairs
from quadsim.features.campaign.statistics import (
    Dependence,
    dependence,
    estimate,
    holm,
    judge,
    lower_bounds,
    mcnemar,
    paired_difference,
    parameters,
    parse_requirement,
    proportion,
    ranking,
    upper_bounds,
    worst_flight,
)
from quadsim.flight.audit import Limit


@pytest.mark.parametrize(("count", "trials"), [(0, 1), (1, 1), (0, 20), (3, 20), (37, 1000), (999, 1000), (10, 10)])
def test_the_interval_is_that_of_scipy(count: int, trials: int) -> None:
    result = proportion(count, trials)
    exact = stats.binomtest(count, trials).proportion_ci(0.95, method="exact")
    assert (result["lower"], result["upper"]) == pytest.approx((exact.low, exact.high), abs=1e-9)
    one_sided = stats.binomtest(count, trials, alternative="less").proportion_ci(0.95, method="exact")
    assert result["upper_one_sided"] == pytest.approx(one_sided.high, abs=1e-9)
    from_below = stats.binomtest(count, trials, alternative="greater").proportion_ci(0.9, method="exact")
    assert lower_bounds(count, trials, 0.9) == pytest.approx(from_below.low, abs=1e-9)
    assert result["share"] == count / trials


def test_bounds_in_closed_form() -> None:
    assert upper_bounds(0, 299, 0.95) == pytest.approx(1.0 - 0.05 ** (1.0 / 299.0), rel=1e-12)
    assert lower_bounds(50, 50, 0.99) == pytest.approx(0.01 ** (1.0 / 50.0), rel=1e-12)
    assert upper_bounds(50, 50) == 1.0
    assert lower_bounds(0, 50) == 0.0
    nothing = proportion(0, 0)
    assert nothing["share"] is None
    assert (nothing["lower"], nothing["upper"], nothing["upper_one_sided"]) == (0.0, 1.0, 1.0)


@pytest.mark.parametrize("p", [0.002, 0.03, 0.2, 0.5, 0.97])
@pytest.mark.parametrize("n", [5, 40, 400])
def test_bounds_have_their_nominal_coverage(n: int, p: float) -> None:
    """The probability of a bound on the right side of p, summed over every possible count."""
    counts = np.arange(n + 1.0)
    probabilities = stats.binom.pmf(counts, n, p)
    trials = np.full(n + 1, float(n))
    for confidence in (0.9, 0.95, 0.99):
        is_above = upper_bounds(counts, trials, confidence) >= p
        is_below = lower_bounds(counts, trials, confidence) <= p
        assert probabilities[is_above].sum() >= confidence - 1e-12
        assert probabilities[is_below].sum() >= confidence - 1e-12


def test_intervals_cover_simulated_campaigns() -> None:
    rng = np.random.default_rng(1)
    intervals = [proportion(int(count), 300) for count in rng.binomial(300, 0.04, 2000)]
    covered = [interval["lower"] <= 0.04 <= interval["upper"] for interval in intervals]
    assert 0.95 <= np.mean(covered) < 0.985


def test_holm_gives_the_numbers_of_r() -> None:
    """Of `p.adjust(p, "holm")`; in closed form, no number is above 1."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.5, 0.6]) == [1.0, 1.0]
    assert holm([]) == []


def test_holm_keeps_the_chance_of_a_false_find() -> None:
    """Of any among nine tests of which none has an effect: 5 %."""
    p = np.random.default_rng(3).uniform(size=(4000, 9))
    false_finds = [min(holm(list(row))) < 0.05 for row in p]
    assert np.mean(false_finds) == pytest.approx(0.05, abs=0.012)


def test_mcnemar_in_closed_form() -> None:
    assert mcnemar(0, 0) == 1.0
    assert mcnemar(0, 6) == pytest.approx(2.0 / 2**6)
    assert mcnemar(5, 15) == pytest.approx(2.0 * sum(math.comb(20, k) for k in range(6)) / 2**20)
    assert mcnemar(15, 5) == mcnemar(5, 15)


def test_paired_difference_is_that_of_scipy() -> None:
    rng = np.random.default_rng(5)
    a = rng.normal(size=60)
    b = a + 0.3 + 0.5 * rng.normal(size=60)
    result = paired_difference(a, b)
    interval = stats.ttest_rel(b, a).confidence_interval(0.95)
    assert (result.mean, result.lower, result.upper) == pytest.approx((np.mean(b - a), interval.low, interval.high))


def test_intervals_of_a_paired_difference_cover_its_mean() -> None:
    """In nearly 95 % of the cases: of a skewed distribution, the t interval is a little short."""
    rng = np.random.default_rng(6)
    covered = 0
    for _ in range(600):
        difference = paired_difference(np.zeros(40), rng.exponential(size=40))
        assert difference.lower is not None
        assert difference.upper is not None
        covered += difference.lower <= 1.0 <= difference.upper
    assert 0.89 < covered / 600 < 0.97


def test_a_paired_difference_of_few_pairs_has_no_interval_and_one_of_equal_values_has_no_width() -> None:
    none = paired_difference(np.empty(0), np.empty(0))
    assert (none.pairs, none.mean, none.lower) == (0, None, None)
    one = paired_difference(np.array([1.0]), np.array([3.0]))
    assert (one.mean, one.lower) == (2.0, None)
    same = paired_difference(np.ones(30), np.ones(30))
    assert (same.mean, same.lower, same.upper) == (0.0, 0.0, 0.0)


def related(x: np.ndarray, y: np.ndarray) -> Dependence | None:
    """`dependence` with the same random numbers each time."""
    return dependence(x, y, np.random.default_rng(0))


def test_rank_correlation_is_that_of_scipy() -> None:
    rng = np.random.default_rng(2)
    x = rng.normal(size=200)
    y = np.round(rng.normal(size=200), 1) + 0.2 * x
    result = related(x, y)
    expected = stats.spearmanr(x, y)
    assert result is not None
    assert (result.rho, result.p, result.flights) == pytest.approx((expected.statistic, expected.pvalue, 200), rel=1e-9)


def test_numbers_that_do_not_vary_and_fewer_than_ten_pairs_are_not_tested() -> None:
    x = np.arange(20.0)
    assert related(x, np.zeros(20)) is None
    assert related(np.zeros(20), x) is None
    assert related(x, np.full(20, np.nan)) is None
    assert related(x[:9], x[:9]) is None
    assert related(x[:10], x[:10]) is not None


def test_pairs_with_a_missing_number_are_left_out() -> None:
    x = np.arange(20.0)
    result = related(np.append(x, np.nan), np.append(-x, 3.0))
    assert result is not None
    assert (result.rho, result.flights) == (pytest.approx(-1.0), 20)


def test_lost_flights_rank_below_all_others() -> None:
    """Their margin is -inf; a pair beside them lacks a number."""
    x = np.arange(20.0)
    falling = -x
    falling[18:] = -np.inf
    result = related(np.append(x, np.nan), np.append(falling, 3.0))
    assert result is not None
    assert result.rho < -0.99
    assert result.flights == 20


def bowl(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A margin that falls on both sides of a mass of 1."""
    rng = np.random.default_rng(seed)
    mass = rng.uniform(0.8, 1.2, n)
    return mass, 0.9 - 3.0 * np.abs(mass - 1.0) + 0.1 * rng.normal(size=n)


@pytest.mark.parametrize("n", [30, 60, 1000])
def test_harm_at_both_ends_is_seen_by_xi_alone(n: int) -> None:
    mass, margin = bowl(n, 1)
    result = related(mass, margin)
    assert result is not None
    assert result.p > 0.05
    assert result.p_xi < 0.002
    assert result.xi > 0.25


def test_xi_is_that_of_scipy_with_its_asymptotic_distribution() -> None:
    x, y = bowl(300, 2)
    result = related(x, y)
    expected = stats.chatterjeexi(x, y)
    assert result is not None
    assert (result.xi, result.p_xi, result.flights) == (expected.statistic, expected.pvalue, 300)


def test_an_event_that_depends_on_a_number_is_found() -> None:
    """It happens where the mass is far from 1, on either side; the test is that of Kolmogorov and Smirnov."""
    mass, _ = bowl(200, 3)
    far = np.abs(mass - 1.0) > 0.15
    result = related(mass, far * 1.0)
    assert result is not None
    assert result.p_xi == stats.ks_2samp(mass[far], mass[~far]).pvalue
    assert result.p_xi < 1e-6


def test_a_rare_event_that_happens_by_chance_is_not_found() -> None:
    """In 3 of 200 flights, of which two are neighbours: xi's own test would take it for a dependence."""
    x = np.arange(200.0)
    happened = np.isin(x, (50.0, 51.0, 140.0)) * 1.0
    result = related(x, happened)
    assert result is not None
    assert result.p_xi > 0.05
    assert stats.chatterjeexi(x, happened).pvalue < 0.05


def largest_share(runs: int) -> float:
    """The share of runs with p below 0.05 that chance alone does not exceed: 5 % and three standard deviations."""
    return 0.05 + 3.0 * math.sqrt(0.05 * 0.95 / runs)


@pytest.mark.slow("statistics")
def test_the_p_value_of_xi_has_its_nominal_level() -> None:
    """Of few and many pairs, of numbers and rare events, varied over many values and over four."""
    rng = np.random.default_rng(3)

    def four_values(size: int) -> np.ndarray:
        return rng.integers(0, 4, size) * 1.0

    def rare_events(size: int) -> np.ndarray:
        return (rng.random(size) < 0.1) * 1.0

    sizes = ((15, 30), (60, 100), (300, 60))
    for (n, runs), draw_y, draw_x in product(sizes, (rng.standard_normal, rare_events), (rng.random, four_values)):
        p = []
        for _ in range(runs):
            result = dependence(draw_x(n), draw_y(n), rng)
            if result is not None:  # else no such event happened
                p.append(result.p_xi)
        assert np.mean(np.array(p) < 0.05) < largest_share(len(p)), (n, len(p))


MakeCampaign = Callable[..., pa.Table]
UNSEEN = ("incomplete", "unaudited", "died", "timeout", "memory")
"""Verdicts that no flight of `small` has; events have the same names."""


def with_columns(table: pa.Table, columns: dict[str, list[Any]]) -> pa.Table:
    """A table with other values in some columns."""
    for name, values in columns.items():
        place = table.column_names.index(name)
        field = table.schema.field(place)
        table = table.set_column(place, field, pa.array(values, field.type))
    return table


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
    result = estimate(small)
    assert result["flights"] == 8
    unseen = dict.fromkeys(UNSEEN, 0)
    assert result["verdicts"] == {"satisfied": 3, "violated": 2, "lost": 2, "error": 1} | unseen
    counts = {name: event["count"] for name, event in result["events"].items()}
    assert counts == {"failure": 6, "violation": 5, "lost": 2, "crash": 1, "error": 1} | unseen
    assert [line[0].text for line in event_table(result).lines] == ["failure", "violation", "lost", "crash", "error"]
    failure = result["events"]["failure"]
    exact = stats.binomtest(6, 8).proportion_ci(0.95)
    assert (failure["share"], failure["lower"], failure["upper"]) == pytest.approx((0.75, exact.low, exact.high))


def test_metrics_are_those_of_the_flights_that_have_them(small: pa.Table) -> None:
    result = estimate(small)["metrics"]
    assert list(result) == ["duration", "rmse.x", "worst_margin"]
    values = np.array([0.1, 0.2, 0.3, 5.0, 0.4, 6.0, 0.9])
    assert result["rmse.x"]["flights"] == 7
    assert result["rmse.x"]["mean"] == pytest.approx(values.mean())
    assert result["rmse.x"]["sd"] == pytest.approx(values.std(ddof=1))
    assert result["rmse.x"]["p95"] == pytest.approx(np.percentile(values, 95))
    assert (result["rmse.x"]["min"], result["rmse.x"]["max"]) == (0.1, 6.0)


def test_a_constraint_that_lost_flights_did_not_reach_did_not_hold(small: pa.Table) -> None:
    roll = estimate(small)["constraints"]["roll"]
    assert (roll["not_satisfied"]["count"], roll["not_satisfied"]["flights"]) == (5, 8)
    assert (roll["worst_margin"], roll["worst_flight"]) == (-15.0, 3)


def test_incomplete_flights_are_neither_failures_nor_successes(small: pa.Table) -> None:
    """Flights 0 and 2 ended before the window of `roll`."""
    verdicts = small["verdict"].to_pylist()
    held = small["satisfied.roll"].to_pylist()
    for flight in (0, 2):
        verdicts[flight] = "incomplete"
        held[flight] = None
    table = with_columns(small, {"verdict": verdicts, "satisfied.roll": held})
    before = estimate(small)
    result = estimate(table)
    assert (result["flights"], result["verdicts"]["incomplete"]) == (8, 2)
    for event in ("failure", "violation"):
        assert result["events"][event]["flights"] == 6
        assert result["events"][event]["count"] == before["events"][event]["count"]
    assert result["events"]["lost"] == before["events"]["lost"]
    assert result["constraints"]["roll"]["not_satisfied"]["flights"] == 6
    assert judge(table, parse_requirement("P(violation) < 0.99 @ 95%")).flights == 6
    assert verdict_sentence(result).startswith("6 of 6 ")
    assert "2 incomplete" in verdict_sentence(result)


def test_a_campaign_of_incomplete_flights_reports_no_failure_and_no_success(small: pa.Table) -> None:
    columns: dict[str, list[Any]] = {
        "verdict": ["incomplete"] * 8,
        "failed": [False] * 8,
        "violated": [False] * 8,
        "satisfied.roll": [None] * 8,
    }
    table = with_columns(small, columns)
    result = estimate(table)
    assert verdict_sentence(result).startswith("0 of 0 ")
    assert result["events"]["failure"]["flights"] == 0
    assert result["constraints"]["roll"]["not_satisfied"]["flights"] == 0
    assert not judge(table, parse_requirement("P(violation) < 0.99 @ 95%")).holds
    with pytest.raises(InputError, match="pair"):
        compare_pairs(table, table, ("one", "other"))


@pytest.fixture
def six(thousand: pa.Table) -> pa.Table:
    """Six flights whose constraints hold, not in the order of their numbers."""
    columns: dict[str, list[Any]] = {"verdict": ["satisfied"] * 6, "failed": [False] * 6, "flight": [5, 1, 4, 2, 3, 0]}
    return with_columns(thousand.slice(0, 6), columns)


def ranked(flights: pa.Table) -> list[int]:
    """The numbers of the flights, the worst first."""
    return np.array(flights["flight"])[ranking(flights)].tolist()


def test_margins_that_differ_by_rounding_rank_by_the_numbers_of_their_flights(six: pa.Table) -> None:
    """As those of a wind from either side: 1, 3 and 4 have the same margin, and so have 0 and 2."""
    rng = np.random.default_rng(0)
    limits = (Limit(name="roll", signal="roll", lower=-5.0, upper=5.0),)
    for _ in range(20):
        margins = np.array([0.9, 0.2, 0.2, 0.5, 0.2, 0.5]) + 3e-6 * rng.uniform(-1.0, 1.0, 6)
        table = with_columns(six, {"worst_margin": margins.tolist(), "margin.roll": (5.0 * margins).tolist()})
        assert ranked(table) == [1, 3, 4, 0, 2, 5]
        assert worst_flight(table) == 1
        roll = estimate(table, limits)["constraints"]["roll"]
        assert roll["worst_flight"] == 1
        assert roll["worst_margin"] == 5.0 * margins.min()


def test_errors_that_differ_by_rounding_rank_by_the_numbers_of_their_flights(six: pa.Table) -> None:
    """Flights without margins."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        columns: dict[str, list[Any]] = {"worst_margin": [None] * 6}
        for axis in "xyz":
            errors = np.array([1.0, 3.0, 3.0, 2.0, 3.0, 2.0]) * (1.0 + 3e-6 * rng.uniform(-1.0, 1.0, 6))
            columns[f"rmse.{axis}"] = errors.tolist()
        assert ranked(with_columns(six, columns)) == [1, 3, 4, 0, 2, 5]


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
    free = with_columns(small, {"worst_margin": [None] * 8, "failed": [False] * 8}).take([0, 2, 7])
    assert worst_flight(free) == 7


def test_no_flight_is_no_worst(small: pa.Table) -> None:
    with pytest.raises(ParameterError, match=r"campaign\.flights"):
        worst_flight(small.slice(0, 0))


def test_a_lost_flight_without_margin_ranks_below_all(small: pa.Table) -> None:
    """Of the flights twice, as fewer than ten are not tested."""
    result = estimate(pa.concat_tables([small, small]))["parameters"]["mass"]["worst_margin"]
    mass = [1.0, 1.3, 1.1, 1.5, 1.4, 1.6, 0.9]
    margin = [0.5, -0.1, 0.2, -3.0, -0.4, -1e9, 0.8]
    expected = stats.spearmanr(2 * mass, 2 * margin).statistic
    assert result["rho"] == pytest.approx(expected)
    assert result["flights"] == 14


def test_what_is_drawn_from_names_has_shares(small: pa.Table) -> None:
    result = estimate(small)["parameters"]["kind"]
    assert result["kind"] == "name"
    a, b = (result["levels"][level] for level in "ab")
    assert (a["count"], a["flights"]) == (2, 4)
    assert (b["count"], b["flights"]) == (4, 4)


def test_drivers_are_those_that_were_put_in(thousand: pa.Table) -> None:
    result = estimate(thousand)["parameters"]
    tested = {name: entry["worst_margin"] for name, entry in result.items() if entry["kind"] == "number"}
    assert {name for name, test in tested.items() if test["p_holm"] < 0.05} == {"mass", "wind"}
    assert tested["wind"]["rho"] < tested["mass"]["rho"] < -0.3
    for test in tested.values():
        assert test["p"] <= test["p_holm"]
    assert result["wind"]["failed"]["rho"] > 0.1
    assert set(result["payload"]["levels"]) == {"false", "true"}


def test_nothing_goes_with_what_never_happens(make_campaign: MakeCampaign) -> None:
    result = estimate(make_campaign(40, severity=0.0))
    assert result["events"]["failure"]["count"] == 0
    for entry in result["parameters"].values():
        if entry["kind"] == "number":
            assert entry["failed"] is None


@pytest.mark.parametrize("flights", [0, 1, 2, 5])
def test_campaigns_of_few_flights_are_strict_json(make_campaign: MakeCampaign, flights: int) -> None:
    table = make_campaign(flights)
    result = estimate(table)
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert result["flights"] == flights
    assert len(result["worst"]) == flights


def test_the_summary_of_a_thousand_is_strict_json(thousand: pa.Table) -> None:
    result = estimate(thousand)
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert len(result["worst"]) == 10
    assert result["metrics"]["rmse.x"]["unit"] == "m"
    for name in result["metrics"]:
        assert not name.startswith(("draw.", "margin.", "time_violated.", "seed"))


def flown(draws: dict[str, Any], margin: np.ndarray, lost: np.ndarray | None = None) -> pa.Table:
    """Flights of such draws and margins; those below 0 violated and failed, and so did those that were lost."""
    n = margin.size
    if lost is None:
        lost = np.zeros(n, bool)
    bad = (margin < 0.0) | lost
    verdict = np.full(n, "satisfied")
    verdict[bad] = "violated"
    verdict[lost] = "lost"
    columns = {
        "flight": list(range(n)),
        "verdict": verdict.tolist(),
        "reason": pa.nulls(n, pa.string()),
        "failed": bad,
        "violated": bad,
        "crashed": np.zeros(n, bool),
        "duration": np.ones(n),
        "worst_margin": margin,
        "worst_constraint": ["roll"] * n,
    }
    return pa.table(columns | {f"draw.{name}": values for name, values in draws.items()})


def bowl_table(n: int, seed: int) -> pa.Table:
    """Flights whose margin falls on both sides of a mass of 1 and depends on no other draw."""
    rng = np.random.default_rng(seed)
    draws = {name: rng.uniform(0.8, 1.2, n) for name in ("mass", "inertia", "lag", "wind")}
    margin = 0.6 - 3.0 * np.abs(draws["mass"] - 1.0) + 0.1 * rng.normal(size=n)
    return flown(draws, margin)


@pytest.mark.parametrize("n", [40, 200, 1000])
def test_harm_at_both_ends_is_reported(n: int) -> None:
    """The margin falls with the distance of the mass from 1: a rank correlation alone finds nothing."""
    summary = estimate(bowl_table(n, 4))
    result = summary["parameters"]["mass"]["worst_margin"]
    assert result["p_holm"] > 0.05
    assert result["p_xi_holm"] < 0.05
    assert "mass (rho " in driver_sentence(summary)
    name, rho, _, xi = driver_table(summary).lines[0][:4]
    assert (name.text, rho.mark, xi.mark) == ("mass", "", "best")


def outcomes(result: dict[str, Any]) -> list[dict[str, Any]]:
    """The tests of all varied parameters with the margin and with failure."""
    return [parameter[outcome] for parameter in result.values() for outcome in ("worst_margin", "failed")]


def test_both_measures_are_corrected_together() -> None:
    tests = outcomes(parameters(bowl_table(400, 5)))
    assert len(tests) == 4 * 2
    pairs = [(test["p"], test["p_holm"]) for test in tests]
    pairs += [(test["p_xi"], test["p_xi_holm"]) for test in tests]
    least, corrected = min(pairs)
    assert least > 0.0
    assert corrected == pytest.approx(16 * least, rel=1e-9, abs=0.0)  # Holm: the least of 16, by their number


@pytest.mark.slow("statistics")
def test_noise_is_taken_for_a_driver_in_one_campaign_of_twenty_at_most() -> None:
    """Of 60 campaigns in which nothing matters, counted are those with any claim at all."""
    rng = np.random.default_rng(6)
    campaigns = 60
    claims = 0
    n = 60
    for _ in range(campaigns):
        draws = {name: rng.uniform(size=n) for name in ("mass", "lag", "wind", "noise")}
        draws["horizon"] = rng.integers(0, 5, n)
        table = flown(draws, 0.3 + rng.standard_cauchy(n) * 0.2, lost=rng.random(n) < 0.05)
        tests = outcomes(parameters(table))
        claims += any(test["p_holm"] < 0.05 or test["p_xi_holm"] < 0.05 for test in tests)
    assert claims / campaigns < largest_share(campaigns)


def test_without_drivers_none_is_reported(make_campaign: MakeCampaign) -> None:
    assert "depends on no varied parameter" in driver_sentence(estimate(make_campaign(40, severity=0.0)))


def test_the_same_table_gives_the_same_numbers(thousand: pa.Table) -> None:
    assert parameters(thousand) == parameters(thousand)
