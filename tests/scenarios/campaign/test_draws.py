"""What is drawn has the distribution that the file requires, and depends on seed and flight number alone."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from scenarios.campaign.campaign_file import CampaignFile, Draws
from scenarios.campaign.plan import parse_campaign

SAMPLINGS = ("random", "latin_hypercube", "sobol", "halton")


def campaign(*vary: dict[str, Any], flights: int = 400, seed: int = 1, sampling: str = "random") -> CampaignFile:
    entries = [{"name": f"p{i}", "fields": [f"vehicle.inertia.{i}"], **entry} for i, entry in enumerate(vary)]
    data = {"name": "c", "scenario": "hover", "flights": flights, "seed": seed, "sampling": sampling, "vary": entries}
    return parse_campaign(data, source="test")


def column(spec: CampaignFile, name: str = "p0") -> list[Any]:
    draws = Draws(spec)
    return [draws.values(flight)[name] for flight in range(spec.flights)]


UNIFORM = {"distribution": "uniform", "low": 2.0, "high": 5.0}
LOG_UNIFORM = {"distribution": "log_uniform", "low": 0.1, "high": 10.0}
NORMAL = {"distribution": "normal", "mean": 3.0, "deviation": 0.5}
CUT = NORMAL | {"low": 2.8, "high": 4.0}


@pytest.mark.parametrize("sampling", SAMPLINGS)
@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        (UNIFORM, stats.uniform(2.0, 3.0)),
        (LOG_UNIFORM, stats.loguniform(0.1, 10.0)),
        (NORMAL, stats.norm(3.0, 0.5)),
        (CUT, stats.truncnorm(-0.4, 2.0, loc=3.0, scale=0.5)),
    ],
    ids=["uniform", "log_uniform", "normal", "cut"],
)
def test_draws_have_their_distribution(sampling: str, entry: dict[str, Any], expected: Any) -> None:
    values = column(campaign(entry, UNIFORM, sampling=sampling))
    assert stats.kstest(values, expected.cdf).pvalue > 0.01


@pytest.mark.parametrize("sampling", SAMPLINGS[1:])
def test_spread_draws_are_more_even_than_random_ones(sampling: str) -> None:
    spec = campaign(UNIFORM, LOG_UNIFORM, sampling=sampling, flights=256)
    counts, _ = np.histogram(column(spec), bins=16, range=(2.0, 5.0))
    assert counts.max() - counts.min() <= 2  # 16 each; random ones scatter by four


def test_weights_set_how_often_a_value_is_chosen() -> None:
    choice = {"distribution": "choice", "values": ["a", "b", "c"], "weights": [1.0, 0.0, 3.0]}
    values = column(campaign(choice, flights=2000))
    assert values.count("b") == 0
    assert stats.binomtest(values.count("c"), 2000, 0.75).pvalue > 0.01


def test_grids_make_every_combination_equally_often() -> None:
    first = {"distribution": "grid", "values": [1.0, 2.0]}
    second = {"distribution": "grid", "values": ["x", "y", "z"]}
    spec = campaign(first, UNIFORM, second, flights=12)
    draws = Draws(spec)
    cells = [(values["p0"], values["p2"]) for values in map(draws.values, range(12))]
    assert cells[:6] == list(itertools.product([1.0, 2.0], ["x", "y", "z"]))
    assert cells[6:] == cells[:6]
    assert len(set(column(spec, "p1"))) == 12


def test_integers_are_equally_often_each_whole_number_of_their_range() -> None:
    spec = campaign({"distribution": "integer", "low": -1, "high": 3}, flights=2000)
    values = column(spec)
    assert {type(value) for value in values} == {int}
    assert sorted(set(values)) == list(range(-1, 4))
    assert stats.chisquare(np.bincount(np.add(values, 1))).pvalue > 0.01
    assert spec.vary[0].extremes() == [-1, 3]


@given(flight=st.integers(0, 10**6), seed=st.integers(0, 2**63 - 1))
def test_a_flight_has_the_seed_of_its_number_and_the_campaigns(flight: int, seed: int) -> None:
    spec = campaign(UNIFORM, flights=1, seed=seed)
    word = np.random.SeedSequence([seed, flight]).generate_state(1, np.uint64)[0]
    assert Draws(spec).seed(flight) == int(word) >> 1


@pytest.mark.parametrize("sampling", ["random", "sobol", "halton"])
def test_more_flights_leave_the_first_ones_as_they_were(sampling: str) -> None:
    few, many = (campaign(UNIFORM, NORMAL, sampling=sampling, flights=n) for n in (16, 64))
    assert [Draws(few).values(k) for k in range(16)] == [Draws(many).values(k) for k in range(16)]


@given(share=st.floats(0.0, 1.0, exclude_max=True))
@pytest.mark.parametrize("entry", [UNIFORM, LOG_UNIFORM, CUT], ids=["uniform", "log_uniform", "cut"])
def test_values_lie_between_the_extremes_that_are_checked_beforehand(entry: dict[str, Any], share: float) -> None:
    vary = campaign(entry).vary[0]
    low, high = vary.extremes()
    value = vary.quantile(share)
    assert isinstance(low, float)
    assert isinstance(high, float)
    assert isinstance(value, float)
    assert low * (1 - 1e-12) <= value <= high * (1 + 1e-12)


def test_extremes_of_a_distribution_without_ends_are_far_out() -> None:
    low, high = campaign(NORMAL).vary[0].extremes()
    assert [low, high] == pytest.approx([3.0 - 0.5 * 3.09, 3.0 + 0.5 * 3.09], abs=1e-3)
