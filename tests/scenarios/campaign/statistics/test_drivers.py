"""What the outcome depends on: found where it was put in, and not where there is nothing, and reported in words."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from scenarios.campaign.report.campaign_tables import driver_table, split_table
from scenarios.campaign.report.campaign_text import campaign_sentences
from scenarios.campaign.statistics import estimates
from scenarios.campaign.statistics.estimates import estimate, parameters

MakeCampaign = Callable[..., pa.Table]


def flown(draws: dict[str, Any], margin: np.ndarray, lost: np.ndarray | None = None) -> pa.Table:
    """Flights of such draws and margins; those below 0 violated and failed, and some were lost."""
    lost = np.zeros(margin.size, bool) if lost is None else lost
    bad = (margin < 0.0) | lost
    verdicts = np.where(lost, "lost", np.where(bad, "violated", "satisfied")).tolist()
    n = margin.size
    return pa.table(
        {
            **{"flight": list(range(n)), "verdict": verdicts, "reason": pa.nulls(n, pa.string())},
            **{"failed": bad, "violated": bad, "crashed": np.zeros(n, bool), "duration": np.ones(n)},
            **{"worst_margin": margin, "worst_constraint": ["roll"] * n},
            **{f"draw.{name}": values for name, values in draws.items()},
        }
    )


def bowl(n: int, seed: int) -> pa.Table:
    rng = np.random.default_rng(seed)
    draws = {name: rng.uniform(0.8, 1.2, n) for name in ("mass", "inertia", "lag", "wind")}
    return flown(draws, 0.6 - 3.0 * np.abs(draws["mass"] - 1.0) + 0.1 * rng.normal(size=n))


@pytest.mark.parametrize("n", [40, 200, 1000])
def test_harm_at_both_ends_is_reported(n: int) -> None:
    """The margin falls with the distance of the mass from 1: a rank correlation alone found nothing."""
    summary = estimate(bowl(n, 4))
    found = summary["parameters"]["mass"]["worst_margin"]
    assert found["p_holm"] > 0.05
    assert found["p_xi_holm"] < 0.05
    sentences = campaign_sentences(summary)
    expected = next(one for one in sentences if one.startswith("The worst margin depends on mass (xi 0."))
    assert "highest near 1" in expected or "highest near 0.9" in expected
    assert expected.endswith("without rising or falling throughout: Chatterjee's xi, p-value after Holm's correction.")
    assert not any("beyond chance" in one and one.startswith("The worst margin depends on no") for one in sentences)
    line = driver_table(summary).lines[0]
    assert (line[0].text, line[1].mark, line[3].mark) == ("mass", "", "best")


def test_both_measures_and_thresholds_are_corrected_together() -> None:
    found = parameters(bowl(400, 5))
    entries = [
        (parameter[outcome], key)
        for parameter in found.values()
        for outcome in ("worst_margin", "failed")
        for key in ("p", "p_xi")
    ]
    entries += [(parameter["splits"]["failure"], "p") for parameter in found.values()]
    assert len(entries) == 4 * 2 * 2 + 4, "violation is failure here, and none was lost"
    least, key = min(entries, key=lambda entry: entry[0][entry[1]])
    assert least[f"{key}_holm"] == pytest.approx(20 * least[key])


def test_noise_is_taken_for_a_driver_in_one_campaign_of_twenty_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over 60 campaigns in which nothing matters: any claim, of any measure, varied parameter, outcome or threshold."""
    for name in ("_turn", "_groups"):  # which claim nothing, and take half of the time
        monkeypatch.setattr(estimates, name, lambda *_: None)
    rng = np.random.default_rng(6)
    claims = 0
    for _ in range(60):
        n = 60
        draws = {name: rng.uniform(size=n) for name in ("mass", "lag", "wind", "noise")} | {
            "horizon": rng.integers(0, 5, n)
        }
        table = flown(draws, 0.3 + rng.standard_cauchy(n) * 0.2, lost=rng.random(n) < 0.05)
        found = parameters(table)
        corrected = [
            parameter[outcome][key]
            for parameter in found.values()
            for outcome in ("worst_margin", "failed")
            for key in ("p_holm", "p_xi_holm")
        ]
        corrected += [split["p_holm"] for parameter in found.values() for split in parameter["splits"].values()]
        claims += min(corrected) < 0.05
    assert claims / 60 < 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / 60)


@pytest.mark.parametrize(("level", "noun", "verb"), [(0.5, "failures", "failed"), (-0.5, "losses", "were lost")])
def test_losses_above_75_ms_of_lag_are_reported(level: float, noun: str, verb: str) -> None:
    """Where nothing else fails, and where all others fail too."""
    rng = np.random.default_rng(7)
    lag = np.append(rng.uniform(0.0, 0.0745, 36), [0.0756, 0.077, 0.078, 0.079])
    draws = {"mass": rng.uniform(0.8, 1.2, 40), "lag": lag}
    table = flown(draws, rng.normal(level, 0.1, 40), lost=lag > 0.075)
    i = table.column_names.index("draw.lag")
    table = table.set_column(i, pa.field("draw.lag", pa.float64(), metadata={"unit": "s"}), table["draw.lag"])
    summary = estimate(table)
    sentences = " ".join(campaign_sentences(summary))
    assert (
        f"All 4 {noun} are above lag = 0.075 s: 4 of 4 flights {verb} there (100 %; 95 %: 39.8 to 100 %), and 0 of 36 "
        "up to it (0 %; 95 %: 0 to 9.7 %); p < 0.001, corrected for the choice of the threshold and for all tests."
        in sentences
    )
    lines = [[cell.text for cell in line] for line in split_table(summary).lines]
    assert lines[-1][1:4] == ["lag > 0.075 s", "0 of 36 (0 %)", "0 to 9.7 %"]


def test_failures_below_a_threshold_are_reported() -> None:
    rng = np.random.default_rng(8)
    height = rng.uniform(size=300)
    table = flown({"height": height}, np.where(height < 0.2, -1.0, 1.0) * rng.uniform(0.1, 1.0, 300))
    failed = np.count_nonzero(height < 0.2)
    sentences = " ".join(campaign_sentences(estimate(table)))
    expected = f"All {failed} failures are up to height = 0.2: {failed} of {failed} flights failed there"
    assert expected in sentences
    assert f"and 0 of {300 - failed} above it (0 %;" in sentences


def test_one_flight_is_worded_in_the_singular() -> None:
    x = np.arange(9000.0)
    summary = estimate(flown({"mass": x}, np.ones(9000), lost=x == 8999))
    assert any(
        one.startswith("The one flight that failed is above mass = 8998: 1 of 1 flights failed there")
        for one in campaign_sentences(summary)
    )


def test_a_threshold_alone_is_no_nothing() -> None:
    """Failures crowd at the end of a range, where neither measure sees them: not a find and none in one list."""
    x = np.arange(300.0)
    failed = np.isin(x, [*range(0, 140, 14), *range(280, 300, 2)])
    summary = estimate(flown({"mass": x}, np.where(failed, -0.1, 1.0)))
    found = summary["parameters"]["mass"]["failed"]
    assert min(found["p_holm"], found["p_xi_holm"]) > 0.05
    sentences = campaign_sentences(summary)
    assert sum(one.startswith("Failures cluster above mass = 279") for one in sentences) == 1
    assert not any(one.startswith("Failure depends on no varied parameter") for one in sentences)


def test_without_drivers_none_is_reported(make_campaign: MakeCampaign) -> None:
    sentences = campaign_sentences(estimate(make_campaign(40, severity=0.0)))
    expected = "The worst margin depends on no varied parameter beyond chance (rank correlation, and Chatterjee's xi"
    assert sum(one.startswith(expected) for one in sentences) == 1
    assert not split_table(estimate(make_campaign(40, severity=0.0))).lines


def test_the_same_table_gives_the_same_numbers(thousand: pa.Table) -> None:
    assert parameters(thousand) == parameters(thousand)
