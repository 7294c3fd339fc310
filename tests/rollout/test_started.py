"""A flight that is flown period by period: the batch flight's bits, and those of its own scenario flown again."""

from __future__ import annotations

import tomllib
from typing import Any

import numpy as np
import pytest
from drawn_events import HAPPENING, kind
from hypothesis import given, settings
from hypothesis import strategies as st

import quadsim
from quadsim.errors import CommandError, FlightError, InputError
from quadsim.rollout.flight_events import prepared
from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.scenario import Scenario

PERIODS = 12
SCENARIOS = {
    "robust": [
        "controller.horizon=12",
        "controller.tightening.acceleration=0.05",
        "effects={air={rotor_drag=3e-4, wind=[2.0, 0.0, 0.0], turbulence={wind_speed_20ft=5.0}}}",
        "effects.disturbance={force_noise=0.05}",
        "computation={delay=0.02, jitter=0.01}",
        "lost.distance=false",
    ],
    "paper-constrained": ["controller.horizon=10", "controller.fallback={}"],
    "motion-capture": [],
    "nonlinear": [],
    "take-off-and-landing": [],
}


FIELDS = st.sampled_from(
    [
        {"output_weights.x": 40.0},
        {"output_weights": {"z": 300.0}},
        {"weights.position": 30.0},
        {"horizon": 8},
        {"horizon": 20},
        {"type": "pid"},
        {"type": "geometric", "horizon": 12},
        {"input_bounds.slew": [-40.0, 40.0]},
        {"fallback.enabled": False},
        {"delay": 0.01},
        {"solver": "piqp-dense"},
    ]
)


INPUT = HAPPENING | kind("controller", fields=FIELDS)
INPUTS = st.lists(st.tuples(st.integers(0, PERIODS - 1), st.booleans(), INPUT), max_size=14)


def cut(name: str) -> Scenario:
    """A scenario as long as the sessions below, of which the library's events are left."""
    scenario = load_scenario(name, SCENARIOS[name])
    return scenario.altered(duration=round(PERIODS * scenario.control_period, 9))


def assert_same_bits(one: Flight, other: Flight) -> None:
    for table in ("control", "plant"):
        for name, result in vars(getattr(one.log, table)).items():
            desired = getattr(getattr(other.log, table), name)
            assert type(result) is type(desired), name
            if isinstance(result, np.ndarray):
                np.testing.assert_array_equal(result, desired, err_msg=name)
            else:
                assert result == desired, name
    assert one.log.reason == other.log.reason
    if one.log.predicted is None:
        assert other.log.predicted is None
    else:
        np.testing.assert_array_equal(one.log.predicted, other.log.predicted)


def written_and_read(scenario: Scenario) -> Scenario:
    return Scenario.parse(tomllib.loads(scenario.to_toml()))


@pytest.mark.representative("by hand")
@pytest.mark.parametrize("name", SCENARIOS)
def test_periods_by_hand_are_the_batch_flight(name: str) -> None:
    scenario = cut(name)
    with Rollout(scenario) as started:
        while not started.done:
            assert started.step().observation.k == started.k - 1
        stepped = started.flight()
    flown = Rollout(scenario).fly()
    assert_same_bits(stepped, flown)
    assert stepped.scenario == flown.scenario


@pytest.mark.slow("by hand")
@settings(max_examples=25)
@given(name=st.sampled_from([*SCENARIOS]), inputs=INPUTS)
def test_what_was_applied_flies_again_to_the_bit(name: str, inputs: list[tuple[int, bool, dict[str, Any]]]) -> None:
    """Inputs of every kind at any period, before it is observed or after; what is refused changes nothing."""
    applied = 0
    with Rollout(cut(name), live=True) as started:
        try:
            for k in range(PERIODS):
                for _, observed, event in (each for each in inputs if each[0] == k):
                    if observed:
                        assert started.observation.k == k
                    before = started.scenario
                    try:
                        result = started.apply(event)
                    except InputError:
                        assert started.scenario is before
                    else:
                        applied += 1
                        assert result.at >= k * before.control_period - 1e-9
                started.step()
        except FlightError:
            assert started.done
        flight = started.flight()
    assert len(flight.scenario.events) <= applied + len(prepared(Assembly(cut(name))).events)
    assert_same_bits(flight, Rollout(written_and_read(flight.scenario)).fly())


def test_a_shorter_flight_keeps_what_it_was_compiled_for() -> None:
    """The payload of 4 s, which is not in a flight of 1 s, changes the last bits of its first second."""
    scenario = load_scenario("payload-pickup", ["events=[{type='payload_pickup', at=4.0, mass=0.4}]"])
    with Rollout(scenario) as started:
        while started.k < 20:
            started.step()
        flight = started.flight()
    assert flight.scenario.duration == 1.0
    assert [event.type for event in flight.scenario.events] == ["mass"]
    assert_same_bits(flight, Rollout(flight.scenario).fly())


def test_a_flight_goes_on_beyond_its_scenario() -> None:
    scenario = cut("robust")
    with Rollout(scenario, live=True) as started:
        while started.k < 2 * PERIODS:
            started.step()
            if started.k == PERIODS:
                assert started.done
                started.apply({"type": "push", "duration": 0.1, "force": [1.0, 0.0, 0.0]})
        flight = started.flight()
    assert flight.scenario.periods == 2 * PERIODS
    assert_same_bits(flight, Rollout(flight.scenario).fly())


def test_a_controller_built_elsewhere_takes_over_as_one_built_here() -> None:
    with Rollout(cut("robust"), live=True) as one, Rollout(cut("robust"), live=True) as other:
        fields = {"output_weights.x": 40.0}
        successor = one.successor(fields)
        for started, ready in ((one, successor), (other, None)):
            for k in range(PERIODS):
                if k == 5:
                    started.apply({"type": "controller", "fields": fields}, ready)
                started.step()
            assert (started.loop.controller is successor.controller) == (started is one)
        assert_same_bits(one.flight(), other.flight())


def test_a_flight_refuses_what_it_was_not_started_for() -> None:
    with Rollout(load_scenario("hover")) as started:
        for event in ({"type": "push", "duration": 0.1, "force": [1, 0, 0]}, {"type": "mass", "factor": 1.1}):
            with pytest.raises(InputError, match=r"event\.type"):
                started.apply(event)
        with pytest.raises(InputError, match="wind"):
            started.apply({"type": "wind", "velocity": [1, 0, 0]})
        with pytest.raises(InputError, match=r"events\.0\.force"):
            started.apply({"type": "push", "duration": 0.1})
        with pytest.raises(InputError, match=r"events\.0\.fields: .*horizon .* 0"):
            started.apply({"type": "controller", "fields": {"horizon": 0}})
        assert not started.scenario.events


def test_given_commands_fly_instead_of_the_controller() -> None:
    with Rollout(load_scenario("hover")) as started:
        for _ in range(10):
            sample = started.step(np.full(4, 215.0))
        assert sample.step_s == 0.0
        assert sample.velocity[-1, 2] > 0.1  # [m/s] upwards: hover takes less
        with pytest.raises(CommandError):
            started.step(np.full(4, np.nan))
        with pytest.raises(InputError, match=r"0\.500 s"):
            started.step()
        assert started.flight().outcome == "lost"
    with pytest.raises(InputError, match="closed"):
        started.step()


def test_margins_of_a_period_are_those_of_the_audit() -> None:
    """The smallest of all periods' is the audit's, and each is that of its rows at the physics rate."""
    scenario = load_scenario("paper-constrained", ["duration=4.0"])
    result: list[dict[str, float]] = []
    with Rollout(scenario) as started:
        while not started.done:
            sample = started.step()
            result.append(started.margins())
            beyond = started.violations(sample)
            for limit in started.limits:
                margin = result[-1][limit.name]
                assert beyond[limit.name] == (-np.inf if np.isnan(margin) else -limit.tolerances[0] - margin)
        flight = started.flight()
    for finding in flight.findings:
        per_period = np.array([margins[finding.limit.name] for margins in result])
        np.testing.assert_array_equal(np.nanmin([*per_period, np.inf]), np.nanmin([finding.worst_margin, np.inf]))
        starts = flight.margins[finding.limit.name]
        if finding.limit.source.plant is None:
            np.testing.assert_array_equal(per_period, starts)
        else:  # the end of a period is the begin of the next
            assert (per_period <= starts + 1e-12).all()
            assert (per_period[:-1] >= np.minimum(starts[:-1], starts[1:]) - 1e-12).all()


def test_without_a_record_there_is_no_log() -> None:
    with Rollout(load_scenario("hover"), recorded=False) as started:
        started.step()
        assert set(started.margins()) == {limit.name for limit in started.limits}
        with pytest.raises(InputError, match="recorded"):
            started.flight()


def test_a_closed_flight_has_no_observation() -> None:
    flight = quadsim.start("hover")
    flight.step()
    flight.close()
    with pytest.raises(InputError, match="the flight is closed"):
        _ = flight.observation
