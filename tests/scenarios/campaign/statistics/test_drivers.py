"""What the outcome depends on: found where it was put in, and not where there is nothing."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from scenarios.campaign.campaign_report import driver_sentence, driver_table
from scenarios.campaign.statistics import estimate, parameters

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
    assert driver_sentence(summary).startswith("The worst margin depends on mass (rho ")
    line = driver_table(summary).lines[0]
    assert (line[0].text, line[1].mark, line[3].mark) == ("mass", "", "best")


def test_both_measures_are_corrected_together() -> None:
    found = parameters(bowl(400, 5))
    entries = [
        (parameter[outcome], key)
        for parameter in found.values()
        for outcome in ("worst_margin", "failed")
        for key in ("p", "p_xi")
    ]
    assert len(entries) == 4 * 2 * 2
    least, key = min(entries, key=lambda entry: entry[0][entry[1]])
    assert least[f"{key}_holm"] == pytest.approx(16 * least[key])


def test_noise_is_taken_for_a_driver_in_one_campaign_of_twenty_at_most() -> None:
    """Over 60 campaigns in which nothing matters: any claim, of any measure, varied parameter or outcome."""
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
        claims += min(corrected) < 0.05
    assert claims / 60 < 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / 60)


def test_without_drivers_none_is_reported(make_campaign: MakeCampaign) -> None:
    expected = "The worst margin depends on no varied parameter beyond chance."
    assert driver_sentence(estimate(make_campaign(40, severity=0.0))) == expected


def test_the_same_table_gives_the_same_numbers(thousand: pa.Table) -> None:
    assert parameters(thousand) == parameters(thousand)
