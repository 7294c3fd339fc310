"""Ground and loss: clearances, the phases of a flight, take-off and touchdown, and when a vehicle is lost."""

from __future__ import annotations

import math

import numpy as np
import pytest

from quadsim.controller import Phase
from quadsim.errors import LostError
from quadsim.flight.phase import (
    AIRBORNE,
    FADING,
    FADING_TIME,
    LARGEST_LEAD,
    LEAD_RATE,
    REST,
    STANDSTILL,
    TOUCH,
    Outline,
    PhaseMonitor,
    TakeoffLead,
    check_loss,
    clearance,
    takeoff_time,
    touchdown,
)
from quadsim.rotation import body_to_world
from quadsim.state import INDEX, POSITION, Array, make_state, tilt

FEET = np.array([[0.2, 0.0, -0.12], [-0.2, 0.0, -0.12], [0.0, 0.2, -0.12], [0.0, -0.2, -0.12]])
RADIUS = 0.01
FLOOR = -0.13
"""At rest on its feet the vehicle's origin is at z = 0."""
HULL = np.array([[0.4, 0.0, 0.03], [-0.4, 0.0, 0.03]])
OUTLINE = Outline(feet=FEET, foot_radius=RADIUS, hull=HULL, floor=FLOOR, disc=0.03)
PERIOD = 0.05


def at(z: float, *, roll: float = 0.0, pitch: float = 0.0) -> Array:
    """A state at rest at height z [m], tilted by roll and pitch [deg]."""
    return make_state(position=(1.0, 2.0, z), euler=(float(np.radians(roll)), float(np.radians(pitch)), 0.7))


def to(z: float) -> Array:
    """A preview of five samples that ends at height z [m]; the first four stay on the ground."""
    preview = np.zeros((5, 4))
    preview[-1, 2] = z
    return preview


def phases(monitor: PhaseMonitor, flight: list[tuple[Array, Array]]) -> list[str]:
    return [monitor.advance(np.zeros(1), state[None], preview).value for state, preview in flight]


@pytest.fixture
def monitor() -> PhaseMonitor:
    return PhaseMonitor(OUTLINE, period=PERIOD)


def test_clearance_level_and_tilted() -> None:
    """Nose down, the front foot sinks by 0.2 sin(pitch), and all rise by 0.12 (1 - cos(pitch))."""
    angle = np.radians(10.0)
    states = np.stack([at(0.0), at(0.5), at(0.5, pitch=10.0)])
    expected = 0.5 - 0.2 * np.sin(angle) - 0.12 * np.cos(angle) - RADIUS - FLOOR
    np.testing.assert_allclose(clearance(states, FEET, RADIUS, FLOOR), [0.0, 0.5, expected], atol=1e-15)


def test_clearance_is_that_of_the_lowest_point() -> None:
    rng = np.random.default_rng(0)
    states = rng.normal(size=(20, 12))
    points = rng.normal(size=(7, 3))
    heights = [state[list(POSITION)] + points @ body_to_world(state[[6, 8, 10]]).T for state in states]
    lowest = np.array([points_world[:, 2].min() for points_world in heights])
    np.testing.assert_allclose(clearance(states, points, 0.1, 0.2), lowest - 0.3, atol=1e-12)


@pytest.mark.parametrize(
    ("roll", "pitch", "expected"), [(0.0, 0.0, 0.0), (30.0, 0.0, 30.0), (0.0, -50.0, 50.0), (180.0, 0.0, 180.0)]
)
def test_tilt_is_the_angle_from_the_vertical(roll: float, pitch: float, expected: float) -> None:
    np.testing.assert_allclose(np.degrees(tilt(at(0.0, roll=roll, pitch=pitch)[None])), [expected], atol=1e-6)


def test_a_flight_from_the_ground_to_the_ground(monitor: PhaseMonitor) -> None:
    ground = to(0.0)
    up = to(1.0)
    flight = [(at(0.0), ground)] * 2 + [(at(0.0), up)] * 2 + [(at(0.04), up), (at(0.06), up), (at(1.0), up)]
    assert phases(monitor, flight) == ["landed"] * 2 + ["armed"] * 3 + ["flying"] * 2
    down = [(at(1.0), ground), (at(0.03), ground)] + [(at(-2e-4), ground)] * 5
    assert phases(monitor, down) == ["flying"] * 5 + ["landed"] * 2
    assert phases(monitor, [(at(0.0), up), (at(0.06), up)]) == ["armed", "flying"]


def test_a_flight_that_starts_in_the_air_flies(monitor: PhaseMonitor) -> None:
    assert phases(monitor, [(at(0.06), to(0.0)), (at(1.0), to(1.0))]) == ["flying"] * 2
    monitor.reset()
    assert phases(monitor, [(at(0.04), to(0.0))]) == ["landed"]


def test_a_take_off_called_off_on_the_ground(monitor: PhaseMonitor) -> None:
    assert phases(monitor, [(at(0.0), to(1.0)), (at(0.0), to(0.0))]) == ["armed", "landed"]


def test_small_rises_require_no_take_off(monitor: PhaseMonitor) -> None:
    assert phases(monitor, [(at(0.0), to(0.049)), (at(0.0), to(0.051))]) == ["landed", "armed"]


def test_a_touch_while_the_reference_is_in_the_air_is_no_landing(monitor: PhaseMonitor) -> None:
    assert set(phases(monitor, [(at(1.0), to(1.0))] + [(at(0.0), to(1.0))] * 20)) == {"flying"}


def test_bounces_start_the_time_of_rest_anew(monitor: PhaseMonitor) -> None:
    ground = to(0.0)
    bouncing = [(at(1.0), ground)] + ([(at(0.0), ground)] * 3 + [(at(0.01), ground)]) * 4
    assert set(phases(monitor, bouncing)) == {"flying"}
    assert phases(monitor, [(at(0.0), ground)] * 4) == ["flying"] * 3 + ["landed"]


@pytest.mark.parametrize(("period", "samples"), [(0.05, 4), (0.1, 2), (0.03, 7), (0.5, 1)])
def test_rest_is_counted_in_whole_periods(period: float, samples: int) -> None:
    monitor = PhaseMonitor(OUTLINE, period=period)
    flight = [(at(1.0), to(0.0))] + [(at(0.0), to(0.0))] * samples
    assert phases(monitor, flight) == ["flying"] * samples + ["landed"]
    assert samples == np.ceil(REST / period - 1e-9)


@pytest.mark.parametrize("before", [at(0.0), at(1.0)])
def test_a_hull_that_touches_is_a_crash_for_good(monitor: PhaseMonitor, before: Array) -> None:
    """Rolled over, it lies on its rotors."""
    assert monitor.advance(np.zeros(1), before[None], to(1.0)) is not Phase.CRASHED
    upside_down = at(FLOOR + 0.03, roll=180.0)
    assert phases(monitor, [(upside_down, to(1.0)), (at(1.0), to(1.0)), (at(0.0), to(0.0))]) == ["crashed"] * 3
    monitor.reset()
    assert monitor.advance(np.zeros(1), before[None], to(0.0)) is not Phase.CRASHED


@pytest.mark.parametrize(("roll", "crashed"), [(59.0, False), (61.0, True), (-61.0, True)])
def test_feet_that_touch_at_a_steep_tilt_are_a_crash(roll: float, crashed: bool) -> None:
    """A hull of one point in the middle leaves the verdict to feet and tilt."""
    outline = Outline(feet=FEET, foot_radius=RADIUS, hull=np.array([[0.0, 0.0, 0.5]]), floor=FLOOR, disc=0.03)
    state = at(0.0, roll=roll)
    state[INDEX["z"]] -= clearance(state[None], FEET, RADIUS, FLOOR)[0]
    touching = state
    free = state + np.eye(12)[INDEX["z"]]
    assert (
        PhaseMonitor(outline, period=PERIOD).advance(np.zeros(1), touching[None], to(1.0)) is Phase.CRASHED
    ) is crashed
    assert PhaseMonitor(outline, period=PERIOD).advance(np.zeros(1), free[None], to(1.0)) is Phase.FLYING


def test_the_resting_height_follows_from_the_outline() -> None:
    """On a floor 10 m up, a reference at 10.04 m of the origin stays on the ground."""
    raised = Outline(feet=FEET, foot_radius=RADIUS, hull=OUTLINE.hull, floor=FLOOR + 10.0, disc=0.03)
    monitor = PhaseMonitor(raised, period=PERIOD)
    assert phases(monitor, [(at(10.0), to(10.04)), (at(10.0), to(10.06))]) == ["landed", "armed"]


def hop(peak: float) -> tuple[Array, Array, Array]:
    """Times, states and clearances of a ballistic hop at 1 kHz from 0.5 s on, moving 0.3, -0.4 m/s along the ground."""
    t = np.arange(2001) * 1e-3
    up = np.sqrt(2.0 * 9.81 * peak)
    since = np.clip(t - 0.5, 0.0, 2.0 * up / 9.81)
    inside = (since > 0.0) & (since < 2.0 * up / 9.81)
    states = np.tile(at(0.0, pitch=3.0), (t.size, 1))
    states[:, INDEX["z"]] = up * since - 4.905 * since**2
    states[:, INDEX["vz"]] = np.where(inside, up - 9.81 * since, 0.0)
    states[inside, INDEX["vx"]] = 0.3
    states[inside, INDEX["vy"]] = -0.4
    return t, states, states[:, INDEX["z"]].copy()


def test_take_off_and_touchdown_of_a_ballistic_hop() -> None:
    """It falls from 0.8 m to within a touch of the ground: v^2 = 2 g (0.8 m - TOUCH), to a step's 0.01 m/s."""
    t, states, clearances = hop(0.8)
    expected = np.sqrt(2.0 * 9.81 * (0.8 - TOUCH))
    start = 0.5
    rise = np.sqrt(2.0 * 9.81 * 0.8)
    result = touchdown(t, states, clearances)
    assert result is not None
    assert result["time"] == pytest.approx(start + (rise + expected) / 9.81, abs=1.01e-3)
    assert result["speed"] == pytest.approx(expected, abs=0.01)
    assert result["horizontal_speed"] == pytest.approx(0.5, abs=1e-12)
    assert result["tilt"] == pytest.approx(3.0, abs=1e-6)
    airborne = start + (rise - np.sqrt(rise**2 - 2.0 * 9.81 * AIRBORNE)) / 9.81
    assert takeoff_time(t, clearances) == pytest.approx(airborne, abs=1.01e-3)


def test_a_hop_too_low_to_fly_is_neither() -> None:
    t, states, clearances = hop(0.9 * AIRBORNE)
    assert touchdown(t, states, clearances) is None
    assert takeoff_time(t, clearances) is None


def test_a_flight_that_ends_in_the_air_has_no_touchdown_and_one_from_the_air_no_take_off() -> None:
    t, states, clearances = hop(0.8)
    highest = int(clearances.argmax())
    assert touchdown(t[:highest], states[:highest], clearances[:highest]) is None
    assert takeoff_time(t[highest:], clearances[highest:]) is None
    assert touchdown(t[highest:], states[highest:], clearances[highest:]) == touchdown(t, states, clearances)


def test_a_bounce_on_the_hull_within_a_period_is_a_crash() -> None:
    """It touched between two samples and is clear again at the second."""
    path = np.stack([at(z, roll=180.0) for z in (0.5, -0.1, 0.5)])
    assert PhaseMonitor(OUTLINE, period=PERIOD).advance(np.zeros(len(path)), path, to(1.0)) is Phase.CRASHED
    assert PhaseMonitor(OUTLINE, period=PERIOD).advance(np.zeros(len(path) - 2), path[2:], to(1.0)) is Phase.FLYING


LIMITS = {"tilt": 120.0, "distance": 100.0, "depth": 50.0, "speed": 30.0}


def state(**values: float) -> Array:
    """A state at the origin, level and at rest, but for what is given."""
    made = make_state()
    for name, value in values.items():
        made[INDEX[name]] = value
    return made


def loss(now: Array, *, limits: dict[str, float] = LIMITS, reference: Array | None = None, lowest: float = 0.0) -> str:
    """Which criterion is met; empty for none."""
    try:
        check_loss(limits, 1.5, now, np.zeros(4) if reference is None else reference, lowest)
    except LostError as error:
        return error.criterion
    return ""


@pytest.mark.parametrize(
    ("within", "beyond", "criterion"),
    [
        ({"roll": math.radians(119.9)}, {"roll": math.radians(-120.1)}, "tilt"),
        ({"roll": math.radians(180.0), "pitch": math.radians(119.0)}, {"pitch": math.radians(120.1)}, "tilt"),
        ({"x": 60.0, "y": -79.9}, {"x": -60.0, "y": 80.1}, "distance"),
        ({"z": 99.9}, {"z": 100.1}, "distance"),
        ({"z": -49.9}, {"z": -50.1}, "depth"),
        ({"vx": 10.0, "vy": -20.0, "vz": 19.9}, {"vx": 10.0, "vy": -20.0, "vz": -20.1}, "speed"),
    ],
)
def test_a_criterion_is_met_beyond_its_limit_and_never_where_it_is_off(
    within: dict[str, float], beyond: dict[str, float], criterion: str
) -> None:
    assert loss(state(**within)) == ""
    assert loss(state(**beyond)) == criterion
    assert loss(state(**beyond), limits={}) == ""
    limits = {name: limit for name, limit in LIMITS.items() if name != criterion}
    assert loss(state(**beyond), limits=limits) == ""


def test_distance_is_from_the_reference_and_depth_below_the_lowest_it_has_been() -> None:
    far = np.array([500.0, 0.0, 0.0, 0.0])
    assert loss(state(x=450.0), reference=far) == ""
    assert loss(state(x=0.0), reference=far) == "distance"
    assert loss(state(z=-90.0), lowest=-60.0) == ""


def test_the_reason_names_which_criterion_its_value_its_limit_and_the_time() -> None:
    with pytest.raises(LostError) as caught:
        check_loss(LIMITS, 1.5, state(roll=math.radians(131.0)), np.zeros(4), 0.0)
    reason = "at t = 1.500 s: lost: the thrust axis is tilted by 131 deg, beyond lost.tilt = 120 deg"
    assert str(caught.value) == reason
    assert (caught.value.criterion, caught.value.limit, caught.value.time) == ("tilt", 120.0, 1.5)
    assert caught.value.value == pytest.approx(131.0)


def pushed(lead: TakeoffLead, periods: int, *, more: float = 0.0, thrust: float = 1.0, climb: float = 0.0) -> float:
    """The lead after some periods on the ground, the thrust growing by a share of the first in each."""
    for k in range(periods):
        lead.push(0.0, climb, thrust * (1.0 + more * k))
    return lead.lead


WAITING = round(STANDSTILL / PERIOD)


def test_the_lead_grows_once_the_thrust_no_longer_rises() -> None:
    assert pushed(TakeoffLead(PERIOD), 100, more=0.02) == 0.0  # a law that spins up by itself
    assert pushed(TakeoffLead(PERIOD), 100, climb=0.1) == 0.0  # or rises
    lead = TakeoffLead(PERIOD)
    assert pushed(lead, WAITING + 1) == 0.0  # the first period has more thrust than none
    for k in range(20):
        assert lead.push(0.0, 0.0, 1.0 + 0.02 * (k + 1)) == pytest.approx((k + 1) * LEAD_RATE * PERIOD)
    assert lead.push(0.0, 0.1, 2.0) == pytest.approx(20 * LEAD_RATE * PERIOD)  # it rises: enough


def test_the_lead_is_bounded_and_waits_for_thrust_that_does_not_follow() -> None:
    lead = TakeoffLead(PERIOD)
    pushed(lead, WAITING + 1)
    saturated = pushed(lead, 1000)
    assert saturated == pytest.approx(LEAD_RATE * STANDSTILL, abs=2 * LEAD_RATE * PERIOD)
    assert pushed(lead, 1000, thrust=1.1, more=0.05) == LARGEST_LEAD


def test_the_lead_fades_with_the_climb_and_never_grows_in_the_air() -> None:
    slow = TakeoffLead(PERIOD)
    course = 2.0
    pushed(slow, WAITING + 1)
    first = pushed(slow, 20, thrust=1.1, more=0.02)
    assert [slow.fade(0.0, course), slow.fade(-0.1, course)] == [first, first]
    heights = np.linspace(0.0, FADING, 400)  # 20 s, slower than the time constant
    leads = [slow.fade(float(z), course) for z in heights]
    np.testing.assert_allclose(leads[:-20], first * (1.0 - heights[:-20] / FADING), atol=1e-9)
    assert slow.fade(0.0, course) == slow.lead < 0.05 * first
    assert slow.fade(0.2, 0.1) < 0.05 * first  # beyond its course
    fast = TakeoffLead(PERIOD)
    pushed(fast, WAITING + 1)
    first = pushed(fast, 20, thrust=1.1, more=0.02)
    steps = [fast.fade(1.0, course) for _ in range(round(FADING_TIME / PERIOD))]
    assert steps[-1] == pytest.approx(first * np.exp(-1.0))  # no jump where it shoots up
    assert [fast.fade(1.0, course) for _ in range(400)][-1] == 0.0


def test_only_a_level_vehicle_under_its_course_is_raised(monitor: PhaseMonitor) -> None:
    def raised(state: Array, course: float, periods: int = 60) -> float:
        lead = 0.0
        for k in range(periods):
            monitor.advance(np.zeros(1), state[None], to(1.0))
            lead = monitor.lead(state, course, 1.0 + 0.02 * max(k - WAITING - 1, 0))
        return lead

    assert raised(at(0.0), 0.0) == 0.0  # the course is up at the end of the preview, and not yet now
    assert raised(at(0.0, roll=11.0), 1.0) == 0.0
    assert raised(at(0.0), 1.0) > 1.0
    monitor.advance(np.zeros(1), at(0.0)[None], to(0.0))
    assert monitor.advance(np.zeros(1), at(0.0)[None], to(1.0)) is Phase.ARMED
    assert monitor.lead(at(0.0), 1.0, 9.0) == 0.0  # a take-off that was called off is forgotten
    assert PhaseMonitor(None, period=PERIOD).lead(at(0.0), 1.0, 1.0) == 0.0


def test_a_vehicle_that_has_sunk_to_the_ground_is_raised_again(monitor: PhaseMonitor) -> None:
    phases(monitor, [(at(1.0), to(1.0))])
    leads = []
    for k in range(60):
        assert monitor.advance(np.zeros(1), at(0.0)[None], to(1.0)) is Phase.FLYING
        leads.append(monitor.lead(at(0.0), 1.0, 1.0 + 0.02 * max(k - 2 * WAITING, 0)))
    assert leads[WAITING] == 0.0
    assert leads[-1] > 0.5
