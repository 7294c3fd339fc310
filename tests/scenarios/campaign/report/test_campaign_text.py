"""The sentences on a campaign's flights, for tables small enough to derive them by hand."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from scipy import stats

from scenarios.campaign.report.campaign_tables import (
    driver_table,
    group_table,
    level_tables,
    worst_draws_table,
    worst_table,
)
from scenarios.campaign.report.campaign_text import campaign_sentences
from scenarios.campaign.statistics.estimates import estimate
from scenarios.campaign.statistics.wording import listing

MakeCampaign = Callable[..., pa.Table]


def flown(verdicts: dict[str, int], held: dict[str, int], margin: float | None = 1.0) -> dict[str, Any]:
    """The summary of given numbers of flights by verdict, and by constraint held."""
    verdict = [name for name, count in verdicts.items() for _ in range(count)]
    n = len(verdict)
    bad = [name != "satisfied" for name in verdict]
    columns: dict[str, Any] = {
        **{"flight": list(range(n)), "verdict": verdict, "reason": pa.nulls(n, pa.string())},
        **{"failed": bad, "violated": bad, "crashed": [False] * n, "duration": [9.0] * n},
        **{"worst_margin": pa.array([margin] * n, pa.float64()), "worst_constraint": ["hold_x"] * n},
    }
    for name, count in held.items():
        columns |= {f"margin.{name}": [0.1] * n, f"satisfied.{name}": [i < count for i in range(n)]}
    return estimate(pa.table(columns))


def test_outcomes_are_counted_in_words() -> None:
    sentences = campaign_sentences(flown({"violated": 5, "lost": 35}, {}))
    assert sentences[0] == "Of 40 flights, 5 violated a required constraint, 35 were lost."
    sentences = campaign_sentences(flown({"satisfied": 1, "lost": 1, "error": 1}, {}))
    assert sentences[0] == "Of 3 flights, 1 held every required constraint, 1 was lost, 1 raised an error."
    assert campaign_sentences(flown({"lost": 1}, {}))[0] == "Of 1 flight, 1 was lost."
    assert campaign_sentences(flown({"lost": 4}, {}))[0] == "All 4 flights were lost."


def test_a_high_share_is_bounded_from_below() -> None:
    lowest = stats.binomtest(40, 40, alternative="greater").proportion_ci(0.95).low
    assert f"With 95 % confidence, at least {100 * lowest:.1f} % fail" in campaign_sentences(flown({"lost": 40}, {}))[1]
    highest = stats.binomtest(0, 40, alternative="less").proportion_ci(0.95).high
    assert f"at most {100 * highest:.1f} % fail" in campaign_sentences(flown({"satisfied": 40}, {}))[1]


def test_constraints_that_fail_equally_often_are_named() -> None:
    sentences = campaign_sentences(flown({"lost": 40}, {"x": 5, "y": 5, "roll": 30}))
    assert any(one.startswith("What most often does not hold is x and y, each in 87.5 % (95 %: ") for one in sentences)
    sentences = campaign_sentences(flown({"lost": 40}, {"x": 4, "y": 5, "roll": 30}))
    assert any(one.startswith("What most often does not hold is x, in 90.0 % (95 %: ") for one in sentences)


def test_a_list_of_names_ends_in_a_count() -> None:
    found = [listing("abcdef"[:n], most=4) for n in (1, 2, 4, 5)]
    assert found == ["a", "a and b", "a, b, c and d", "a, b, c and 2 others"]


@pytest.mark.parametrize(
    ("verdict", "margin", "text"),
    [
        ("lost", 1.0, "lost before any required constraint was violated."),
        ("lost", -1.0, "lost, with a worst margin of -1 (hold_x)."),
        ("lost", None, "lost."),
        ("violated", 1.0, "violated, with a worst margin of 1 (hold_x)."),
    ],
)
def test_the_worst_flight_is_reported(verdict: str, margin: float | None, text: str) -> None:
    assert campaign_sentences(flown({verdict: 2}, {}, margin))[-1] == f"The worst flight is number 0: {text}"


def test_failures_over_a_drawn_number_are_those_of_its_fifths(thousand: pa.Table) -> None:
    found = estimate(thousand)["parameters"]["wind"]["groups"]
    wind, failed = (np.array(thousand[name].to_pylist(), float) for name in ("draw.wind", "failed"))
    assert [group["flights"] for group in found] == [200] * 5
    assert found[0]["low"] == wind.min()
    assert found[-1]["high"] == wind.max()
    for group, after in zip(found, [*found[1:], None], strict=True):
        inside = (wind >= group["low"]) & (wind <= group["high"])
        assert group["count"] == failed[inside].sum()
        assert after is None or group["high"] < after["low"]
    assert found[-1]["share"] > found[0]["share"]


def test_few_values_are_groups_of_their_own_and_few_flights_none(thousand: pa.Table) -> None:
    i = thousand.column_names.index("draw.horizon")
    horizons = pa.array([20 + 10 * (k % 3) for k in range(1000)])
    found = estimate(thousand.set_column(i, "draw.horizon", horizons))["parameters"]["horizon"]["groups"]
    assert [(group["low"], group["high"], group["flights"]) for group in found] == [
        *((20.0, 20.0, 334), (30.0, 30.0, 333), (40.0, 40.0, 333))
    ]
    assert len(estimate(thousand.slice(0, 30))["parameters"]["mass"]["groups"]) == 3
    assert estimate(thousand.slice(0, 11))["parameters"]["mass"]["groups"] == []


def test_groups_are_shown_where_some_fail_and_some_do_not(make_campaign: MakeCampaign, thousand: pa.Table) -> None:
    grid = group_table(estimate(thousand))
    assert [line[0].text for line in grid.lines] == [
        "mass",
        "inertia",
        "noise",
        "yaw",
        "lag [s]",
        "wind [m/s]",
        "horizon",
    ]
    assert all(len(line) == len(grid.head) == 6 for line in grid.lines)
    assert not group_table(estimate(make_campaign(60, severity=0.0))).lines
    assert not group_table(estimate(make_campaign(60, severity=100.0).slice(0, 0))).lines


def test_tables_show_the_units_of_what_is_drawn(thousand: pa.Table) -> None:
    summary = estimate(thousand)
    for grid in (driver_table(summary), worst_draws_table(summary)):
        assert {"wind [m/s]", "lag [s]", "mass"} <= {line[0].text for line in grid.lines}
    kinds = thousand.schema.field("draw.solver").with_metadata({"unit": "kind"})
    i = thousand.column_names.index("draw.solver")
    assert "Failures by solver [kind]" in {
        grid.title for grid in level_tables(estimate(thousand.set_column(i, kinds, thousand["draw.solver"])))
    }


def test_the_worst_flights_have_a_table_with_one_command(thousand: pa.Table) -> None:
    summary = estimate(thousand)
    grid = worst_table(summary, "my runs")
    assert grid.head == ("flight", "verdict", "worst margin", "constraint", "flown [s]", "reason")
    assert grid.note.endswith(f"quadsim replay 'my runs' --flight {summary['worst'][0]['flight']}")
    drawn = worst_draws_table(summary)
    assert drawn.head == ("flight", *(line[0].text for line in grid.lines))
    assert not worst_table(estimate(thousand.slice(0, 0)), "a").lines
    assert not worst_draws_table(estimate(thousand.slice(0, 0))).lines
