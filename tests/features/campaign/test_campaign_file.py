"""Campaign files: what is read from them, the scenario of each flight, and what is refused before anything flies."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomlkit
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from quadsim.errors import FileError, InputError, UnknownNameError
from quadsim.features.campaign.campaign_file import CampaignFile, Draws
from quadsim.features.campaign.plan import Plan, load_plan, parse_campaign, plan_differences
from quadsim.scenarios.catalogue import campaign_names, campaign_path
from quadsim.scenarios.loading import load_scenario

MASS = {"name": "mass", "fields": ["effects.load.mass_factor"], "distribution": "uniform", "low": 0.9, "high": 1.1}
BASE: dict[str, Any] = {"name": "c", "scenario": "hover", "flights": 3, "vary": [MASS]}


def write(directory: Path, data: dict[str, Any], name: str = "campaign.toml") -> Path:
    path = directory / name
    path.write_text(tomlkit.dumps(data), encoding="utf-8")
    return path


def plan(directory: Path, **changes: Any) -> Plan:
    data = {key: value for key, value in {**BASE, **changes}.items() if value is not None}
    return load_plan(str(write(directory, data)))


def varied(**changes: Any) -> list[dict[str, Any]]:
    return [{key: value for key, value in {**MASS, **changes}.items() if value is not None}]


# --- what is flown -------------------------------------------------------------------------------------------------


def test_each_flight_has_its_own_name_seed_and_values(tmp_path: Path) -> None:
    made = plan(tmp_path)
    scenarios = [made.of(flight) for flight in range(3)]
    assert [each.name for each in scenarios] == ["c-0", "c-1", "c-2"]
    assert len({each.seed for each in scenarios}) == 3
    factors = [each.effects.load.mass_factor for each in scenarios if each.effects.load is not None]
    assert len(set(factors)) == 3
    assert all(0.9 <= factor <= 1.1 for factor in factors)
    assert [made.identity(flight)["draw.mass"] for flight in range(3)] == factors


def test_campaigns_differ_in_fields_of_the_scenario_and_of_what_is_drawn(tmp_path: Path) -> None:
    """A drag three times as large is not the same draws, though every drawn value is the same."""
    air = {"rotor_drag": 1e-4, "wind": [0.0, 0.0, 0.0]}
    wind = {"name": "wind", "fields": ["effects.air.wind.0"], "distribution": "uniform", "low": 0.0, "high": 1.0}
    first = plan(tmp_path, set={"effects": {"air": air}, "duration": 2.0}, vary=[MASS, wind])
    changed = {**air, "rotor_drag": 3e-4, "wind": [0.5, 0.0, 0.2]}
    second = plan(
        tmp_path, set={"effects": {"air": changed}, "duration": 2.0}, vary=[*varied(high=1.2), wind], name="d"
    )
    assert plan_differences(first, first) == ()
    assert plan_differences(first, second) == (
        ("effects.air.rotor_drag", 1e-4, 3e-4),
        ("effects.air.wind.2", 0.0, 0.2),
        ("vary.mass.high", 1.1, 1.2),
    )
    alone = plan(tmp_path, set={"effects": {"air": air}, "duration": 2.0})
    assert ("vary.wind.low", 0.0, None) in plan_differences(first, alone)


def test_a_flight_s_description_says_what_was_changed_and_drawn(tmp_path: Path) -> None:
    made = plan(tmp_path, set={"duration": 2.0, "effects": {"load": {"mass_factor": 1.0}}})
    drawn = made.identity(1)["draw.mass"]
    text = load_scenario("hover").description
    changed = f"{text} (changed: duration = 2; effects.load.mass_factor = {drawn:.6g})"
    assert made.of(1).description == changed


def test_one_value_goes_to_all_of_its_fields_and_relative_ones_multiply(tmp_path: Path) -> None:
    vary = varied(
        low=0.9,
        high=0.99,
        fields=["vehicle.arm_length", "vehicle.inertia.2", "controller.output_weights.x"],
        relative=True,
        name="size",
    )
    made = plan(tmp_path, vary=vary, scenario="paper-constrained")
    base = made.scenario
    flown = made.of(1)
    factor = made.identity(1)["draw.size"]
    assert base.vehicle.arm_length is not None
    assert base.vehicle.inertia is not None
    assert flown.vehicle.arm_length == pytest.approx(factor * base.vehicle.arm_length)
    assert flown.vehicle.inertia == pytest.approx([*base.vehicle.inertia[:2], factor * base.vehicle.inertia[2]])


def test_set_is_merged_over_the_scenario_and_the_command_line_comes_last(tmp_path: Path) -> None:
    over = {"duration": 2.0, "constraints": [{"name": "yaw", "signal": "yaw", "upper": 3.0}]}
    made = load_plan(str(write(tmp_path, {**BASE, "set": over})), ["duration=3.0"], flights=7, seed=5)
    assert (made.scenario.duration, made.spec.flights, made.spec.seed) == (3.0, 7, 5)
    names = [constraint.name for constraint in made.scenario.constraints]
    assert "yaw" in names
    assert len(names) > 1


def test_a_campaign_file_holds_only_what_differs_from_its_base(tmp_path: Path) -> None:
    write(tmp_path, BASE, "first.toml")
    heavier = {"base": "first.toml", "name": "heavier", "vary": [{"name": "mass", "high": 1.5}]}
    made = load_plan(str(write(tmp_path, heavier)))
    assert made.spec.name == "heavier"
    assert [(entry.name, getattr(entry, "low", None), getattr(entry, "high", None)) for entry in made.spec.vary] == [
        ("mass", 0.9, 1.5)
    ]


def test_the_resolved_file_is_the_same_campaign(tmp_path: Path) -> None:
    made = plan(tmp_path, sampling="sobol", failure=["lost", "rmse.z > 0.5"])
    (tmp_path / "again.toml").write_text(made.spec.to_toml(), encoding="utf-8")
    assert load_plan(str(tmp_path / "again.toml")).spec == made.spec


@pytest.mark.slow("campaigns")
@pytest.mark.parametrize("name", campaign_names())
def test_every_campaign_that_ships_can_be_flown(name: str) -> None:
    made = load_plan(name)
    assert made.spec.name == name
    assert made.of(0) != made.of(1)


def test_campaigns_on_the_same_draws_differ_in_their_controller_alone() -> None:
    paper = load_plan("paper-robustness")
    robust = load_plan("paper-robustness-robust")
    assert [paper.identity(k) for k in range(20)] == [robust.identity(k) for k in range(20)]
    other = {name: getattr(paper.of(3), name) for name in ("controller", "name", "description")}
    assert robust.of(3).altered(**other) == paper.of(3)
    assert {field.partition(".")[0] for field, *_ in plan_differences(paper, robust)} == {"controller"}


def test_the_campaigns_on_a_battery_differ_in_what_the_observer_estimates() -> None:
    force = load_plan("battery")
    scale = load_plan("battery-thrust-scale")
    assert [force.identity(k) for k in range(20)] == [scale.identity(k) for k in range(20)]
    assert [field for field, *_ in plan_differences(force, scale)] == ["controller.disturbance.thrust_scale"]


def test_the_nominal_campaign_is_of_small_errors_at_the_papers_own_tolerance() -> None:
    """Its controller, its bounds and its tolerance at them; lag to 8 ms, mass within 5 %, perfect sensors."""
    nominal = load_plan("paper-nominal")
    paper = load_scenario("paper-constrained")
    assert nominal.scenario.controller == paper.replace({"controller.solver": "core"}).controller
    assert nominal.scenario.sensors == paper.sensors
    tilts = {limit.name: limit for limit in paper.constraints if limit.name in ("roll", "pitch", "speed", "slew")}
    assert {limit.name: limit for limit in nominal.scenario.constraints if limit.name in tilts} == tilts
    drawn = [nominal.draws.values(flight) for flight in range(50)]
    assert all(0.0 < values["lag"] <= 0.008 and abs(values["mass"] - 1.0) <= 0.05 for values in drawn)
    assert nominal.spec.flights == 1000


# --- what is refused -----------------------------------------------------------------------------------------------


def test_what_cannot_be_is_refused(tmp_path: Path) -> None:
    path = str(write(tmp_path, BASE))
    for setting, rule in (
        ("effects.load.mass_factor=1.2", "mass draws effects.load.mass_factor"),
        ("seed=7", "--seed"),
    ):
        with pytest.raises(InputError, match=rule):
            load_plan(path, [setting])
    with pytest.raises(FileError, match="campaign"):
        load_plan(str(tmp_path / "gone.toml"))
    with pytest.raises(UnknownNameError, match="'paper-robustnes'"):
        campaign_path("paper-robustnes")


def test_a_base_in_another_folder_brings_its_scenario(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    write(tmp_path, {"base": "hover", "name": "mine", "duration": 1.0}, "mine.toml")
    write(tmp_path, {**BASE, "scenario": "mine.toml"}, "first.toml")
    derived = write(tmp_path / "sub", {"base": "../first.toml", "name": "second"}, "second.toml")
    assert load_plan(str(derived)).scenario.duration == 1.0


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


@pytest.mark.slow("statistics")
@pytest.mark.parametrize("sampling", SAMPLINGS)
@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        (UNIFORM, stats.uniform(2.0, 3.0)),
        pytest.param(LOG_UNIFORM, stats.loguniform(0.1, 10.0), marks=pytest.mark.representative("statistics")),
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
