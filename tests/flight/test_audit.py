"""The audit: signed margins by hand, between samples too, with windows and tolerances."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import small_log

from quadsim.flight.audit import SIGNALS, Finding, Limit, audit, margins_sampled, worst_finding, worst_share
from quadsim.flight.log import FlightLog
from quadsim.state import INDEX

Z = Limit(name="height", signal="z", lower=-1.0, upper=2.0)
SAMPLES = (0.0, 1.0, 1.9)
PLANT = (0.0, 0.5, 1.0, 2.5, 1.9, -1.25, 0.0)
"""Twice per 0.1 s period; beyond the upper bound at t = 0.15 s by 0.5, beyond the lower at t = 0.25 s by 0.25."""


def logged(state_name: str, *, samples: Sequence[float], plant: Sequence[float]) -> FlightLog:
    """A made-up flight where one state is as given, in its own unit, and all else is zero.

    One sample per 0.1 s; plant rows spread evenly, the first at t = 0, the last at the end of the last period.
    """
    steps, rest = divmod(len(plant) - 1, len(samples))
    assert rest == 0, "plant rows must be a whole number per period, plus one"
    log = small_log(len(samples), steps=steps)
    state = np.zeros_like(log.control.state)
    control = replace(log.control, state=state, truth=state, reference=np.zeros_like(log.control.reference))
    flown = replace(log.plant, state=np.zeros_like(log.plant.state))
    control.state[:, INDEX[state_name]] = samples
    flown.state[:, INDEX[state_name]] = plant
    return replace(log, control=control, plant=flown)


def find(log: FlightLog, limit: Limit) -> Finding:
    (finding,) = audit(log, (limit,))
    return finding


def test_margins_are_signed_distances_to_the_nearer_bound() -> None:
    np.testing.assert_array_equal(Z.margin(np.array([-2.0, -1.0, 0.0, 1.5, 2.0, 2.25])), [-1, 0, 1, 0.5, 0, -0.25])


def test_a_peak_between_samples_is_detected() -> None:
    finding = find(logged("z", samples=SAMPLES, plant=PLANT), Z)
    assert finding.peak_sampled == 1.9
    assert finding.worst_margin_sampled == pytest.approx(0.1)
    assert finding.peak_plant == 2.5
    assert finding.worst_margin == -0.5
    assert finding.worst_time == 0.15
    assert finding.time_violated == pytest.approx(0.1)  # two rows of 0.05 s
    assert not finding.satisfied
    assert find(logged("z", samples=SAMPLES, plant=PLANT), replace(Z, upper=math.inf)).worst_margin == -0.25
    assert find(logged("z", samples=SAMPLES, plant=(*PLANT[:-1], math.nan)), Z).verdict == "violated"


@pytest.mark.parametrize(
    ("tolerance", "sampled", "satisfied", "time_violated"),
    [(0.0, 0.0, False, 0.1), (0.3, 0.0, False, 0.05), (0.499, 0.0, False, 0.05), (0.5, 0.0, True, 0.0)],
)
def test_the_verdict_allows_the_tolerance_and_no_more(
    tolerance: float, sampled: float, satisfied: bool, time_violated: float
) -> None:
    limit = replace(Z, tolerance=tolerance, tolerance_sampled=sampled)
    finding = find(logged("z", samples=SAMPLES, plant=PLANT), limit)
    assert finding.satisfied == satisfied
    assert finding.time_violated == pytest.approx(time_violated)
    assert finding.worst_margin == -0.5  # a tolerance changes the verdict, never the margin


@pytest.mark.parametrize(("sampled", "satisfied"), [(0.0, False), (0.099, False), (0.1001, True)])
def test_samples_have_a_tolerance_of_their_own(sampled: float, satisfied: bool) -> None:
    limit = replace(Z, upper=1.8, tolerance=10.0, tolerance_sampled=sampled)
    finding = find(logged("z", samples=SAMPLES, plant=PLANT), limit)
    assert finding.worst_margin_sampled == pytest.approx(-0.1)
    assert finding.satisfied == satisfied
    deciding = (finding.worst_margin, 10.0) if satisfied else (finding.worst_margin_sampled, sampled)
    assert finding.deciding == deciding


@pytest.mark.parametrize(
    ("start", "stop", "peak", "margin"),
    [
        (0.0, 0.1, 0.0, 1.0),  # 0 and 1 are equally near to a bound: the first is reported
        (0.0, 0.15, 2.5, -0.5),  # both ends belong to the window
        (0.15, 0.15, 2.5, -0.5),
        (0.16, 0.24, 1.9, 0.1),
        (0.2, 0.25, -1.25, -0.25),
        (0.26, math.inf, 0.0, 1.0),
    ],
)
def test_a_window_counts_and_nothing_outside_it(start: float, stop: float, peak: float, margin: float) -> None:
    finding = find(logged("z", samples=SAMPLES, plant=PLANT), replace(Z, start=start, stop=stop))
    assert finding.worst_margin == pytest.approx(margin)
    assert finding.peak_plant == peak
    assert np.isfinite(finding.worst_margin_sampled) == (start <= 0.1 or start <= 0.2 <= stop)
    assert finding.satisfied == (margin >= 0.0)


def test_a_window_that_the_flight_never_reached_is_neither_held_nor_violated() -> None:
    finding = find(logged("z", samples=SAMPLES, plant=PLANT), replace(Z, start=9.0))
    assert math.isnan(finding.worst_margin)
    assert math.isnan(finding.peak_plant)
    assert math.isnan(finding.worst_margin_sampled)
    assert finding.time_violated == 0.0
    assert (finding.verdict, finding.satisfied) == ("incomplete", False)
    for signal in SIGNALS:
        assert not find(small_log(0), Limit(name="any", signal=signal, lower=-1e9, upper=1e9)).satisfied


def test_angles_are_limited_in_degrees() -> None:
    log = logged("roll", samples=(0.0, np.radians(4.0)), plant=(0.0, np.radians(4.0), np.radians(5.5)))
    finding = find(log, Limit(name="roll", signal="roll", lower=-5.0, upper=5.0))
    assert finding.limit.unit == "deg"
    assert finding.peak_plant == pytest.approx(5.5)
    assert finding.worst_margin == pytest.approx(-0.5)
    assert finding.worst_margin_sampled == pytest.approx(1.0)


@given(roll=st.floats(-80.0, 80.0), pitch=st.floats(-80.0, 80.0))
def test_tilt_is_the_angle_between_thrust_and_vertical(roll: float, pitch: float) -> None:
    log = small_log(1)
    log.control.truth[0, [6, 8]] = np.radians([roll, pitch])
    expected = math.degrees(math.acos(math.cos(math.radians(roll)) * math.cos(math.radians(pitch))))
    assert SIGNALS["tilt"].sampled(log.control)[0] == pytest.approx(expected)


def test_climb_acceleration_is_the_change_of_the_vertical_velocity() -> None:
    log = small_log(3)
    log.plant.state[:, INDEX["vz"]] = 0.5 * 3.0 * log.plant.t**2  # the acceleration is 3 t
    last = log.plant.t.size - 1
    rows = SIGNALS["climb_acceleration"].finest(log)[1]
    middles = 0.5 * (log.plant.t[1:] + log.plant.t[:-1])
    assert rows[:last] == pytest.approx(3.0 * middles)
    assert math.isnan(rows[last])
    finding = find(log, Limit(name="climb", signal="climb_acceleration", upper=float(3.0 * middles[-1]) - 0.25))
    assert finding.limit.unit == "m/s^2"
    assert finding.worst_margin == pytest.approx(-0.25)
    assert finding.worst_time == log.plant.t[last - 1]
    assert finding.verdict == "violated"


@pytest.mark.parametrize(("axis", "state", "scale"), [("x", 0, 1.0), ("yaw", 10, 180.0 / math.pi)])
def test_errors_are_real_minus_reference_at_the_samples(axis: str, state: int, scale: float) -> None:
    log = small_log(3)
    errors = scale * (log.control.truth[:, state] - log.control.reference[:, {"x": 0, "yaw": 3}[axis]])
    errors = errors if axis == "x" else -np.remainder(180.0 - errors, 360.0) + 180.0
    finding = find(log, Limit(name="error", signal=f"{axis}_error", upper=0.0))
    assert finding.peak_sampled == pytest.approx(errors.max())
    assert math.isnan(finding.peak_plant)  # it has no value there
    assert finding.worst_time == log.control.t[np.argmax(errors)]


def test_every_rotor_must_hold() -> None:
    log = small_log(3)
    log.control.speeds[1, 2] = 260.0
    log.plant.speeds[7, 3] = 255.0
    finding = find(log, Limit(name="speed", signal="speed", lower=0.0, upper=250.0))
    assert finding.peak_sampled == 260.0  # commanded
    assert finding.peak_plant == 255.0  # acting
    np.testing.assert_array_equal(margins_sampled(finding.limit, log), (250.0 - log.control.speeds).min(axis=1))


def test_steps_of_the_command_are_audited_from_the_first_on() -> None:
    log = small_log(3)
    log.control.speeds[:] = log.control.speeds_before + np.array([[6.0], [6.0], [-6.0]])
    finding = find(log, Limit(name="slew", signal="slew", lower=-10.0, upper=5.0))
    np.testing.assert_allclose(margins_sampled(finding.limit, log), [-1.0, 5.0, -2.0])
    assert finding.worst_margin == pytest.approx(-2.0)
    assert finding.worst_time == pytest.approx(0.2)
    assert math.isnan(finding.peak_plant)
    margins = margins_sampled(replace(finding.limit, start=0.1, stop=0.1), log)
    np.testing.assert_allclose(margins, [math.nan, 5.0, math.nan])
    for name in ("x", "slew"):
        always = find(log, Limit(name=name, signal=name, lower=1e8))
        assert always.time_violated == pytest.approx(log.plant.t[-1])


def test_the_worst_finding_is_a_required_one_unless_none_is() -> None:
    log = logged("z", samples=SAMPLES, plant=PLANT)
    tight = replace(Z, name="tight", required=False)
    roomy = replace(Z, name="roomy", lower=-9.0, upper=9.0)
    assert worst_finding(audit(log, (tight, roomy))) == find(log, roomy)
    assert worst_finding(audit(log, (tight, replace(roomy, required=False)))) == find(log, tight)


def test_the_first_of_tied_instants_gives_the_time_and_the_side_of_the_peak() -> None:
    """Whichever of them rounding makes the smallest; the margin itself is the smallest."""
    rng = np.random.default_rng(0)
    for noise in (0.0, *([3e-6 * Z.half_band] * 50)):
        values = np.array([0.5, 1.5, 0.5, -0.5, 1.5, -0.5, 0.5]) + noise * rng.uniform(-1.0, 1.0, 7)
        finding = find(logged("z", samples=(0.5, 0.5, 0.5), plant=values), Z)
        assert finding.worst_time == 0.05
        assert finding.peak_plant == max(values)
        assert finding.worst_margin == Z.margin(values).min()
        assert finding.peak_plant == pytest.approx(1.5, abs=1e-5)


def test_a_margin_that_grows_by_more_than_a_tie_has_a_time_of_its_own() -> None:
    values = [0.5, 1.5, 0.5, -0.5 - 2.0 * Z.tie, 1.5, 0.5, 0.5]
    finding = find(logged("z", samples=(0.5, 0.5, 0.5), plant=values), Z)
    assert finding.worst_time == pytest.approx(0.15)
    assert finding.peak_plant == values[3]


def test_the_peak_is_within_a_tie_of_the_smallest_margin_also_near_the_middle() -> None:
    middle = 0.5
    values = np.full(7, middle)
    values[2] += 0.9 * Z.tie
    values[4] -= 1.8 * Z.tie
    finding = find(logged("z", samples=(middle,) * 3, plant=values), Z)
    assert finding.worst_time == pytest.approx(0.1)
    values[0] += 0.3 * Z.tie
    finding = find(logged("z", samples=(middle,) * 3, plant=values), Z)
    assert finding.worst_margin <= Z.margin(np.array([finding.peak_plant]))[0] <= finding.worst_margin + Z.tie


def test_the_first_of_tied_rotors_gives_the_peak() -> None:
    log = small_log(3)
    log.control.speeds[:] = 200.0
    log.control.speeds[1] = [251.0, 200.0, 251.0 + 1e-6, -1.0]
    finding = find(log, Limit(name="speed", signal="speed", lower=0.0, upper=250.0))
    assert finding.peak_sampled == 251.0
    assert finding.worst_margin_sampled == pytest.approx(-1.0 - 1e-6)


def test_of_tied_findings_the_first_is_the_worst_and_a_violated_one_before_it() -> None:
    log = logged("z", samples=SAMPLES, plant=PLANT)
    hard = replace(Z, tolerance=0.0, tolerance_sampled=0.0, upper=2.5 - 1e-6)
    twins = audit(log, tuple(replace(hard, name=name) for name in ("zeta", "alpha")))
    lenient = replace(hard, name="lenient", tolerance=0.5, upper=2.5 - 2e-6)
    rng = np.random.default_rng(0)
    for noise in (0.0, *([3e-6 * Z.half_band] * 50)):
        shaken = [replace(twin, worst_margin=twin.worst_margin - noise * rng.random()) for twin in twins]
        assert worst_finding(shaken) is shaken[0]
        assert worst_share(shaken) == min(twin.share for twin in shaken)
        (holds,) = audit(log, (lenient,))
        assert holds.satisfied
        assert worst_finding([holds, *shaken]) is shaken[0], "what is violated is no satisfied limit's name"
