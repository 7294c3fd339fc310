"""The tables of a campaign's flights."""

from collections.abc import Callable

import numpy as np
import pyarrow as pa

from scenarios.campaign.campaign_report import group_table, worst_draws_table, worst_table
from scenarios.campaign.statistics import estimate

MakeCampaign = Callable[..., pa.Table]


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
    names = ["mass", "inertia", "noise", "yaw", "lag [s]", "wind [m/s]", "horizon", "solver", "payload"]
    assert [line[0].text for line in grid.lines] == names
    assert all(len(line) == len(grid.head) == 6 for line in grid.lines)
    assert [cell.text.partition(":")[0] for cell in grid.lines[7]][1:4] == ["daqp", "gain", "piqp"]
    assert not group_table(estimate(make_campaign(60, severity=0.0))).lines
    assert not group_table(estimate(make_campaign(60, severity=100.0).slice(0, 0))).lines


def test_the_worst_flights_have_a_table_with_one_command(thousand: pa.Table) -> None:
    summary = estimate(thousand)
    grid = worst_table(summary, "my runs")
    assert grid.head == ("flight", "verdict", "worst margin", "constraint", "flown [s]", "reason")
    assert grid.note.endswith(f"quadsim replay 'my runs' --flight {summary['worst'][0]['flight']}")
    drawn = worst_draws_table(summary)
    assert drawn.head == ("flight", *(line[0].text for line in grid.lines))
    assert not worst_table(estimate(thousand.slice(0, 0)), "a").lines
    assert not worst_draws_table(estimate(thousand.slice(0, 0))).lines
