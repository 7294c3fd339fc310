"""The robust controller, each part by itself: against the paper's controller, the equations of motion, and symmetry."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy_laws import respond
from numpy_preparation import NonlinearModel, next_state, nonlinear_model
from support import constrained_mpc, derivative, paper_problem, paper_reference, robust_mpc, robust_table

from quadsim.controller import ACCEPTED, SOLVED, UNCONSTRAINED, Phase, StepInputs
from quadsim.mpc.estimate.observer import ObserverSettings
from quadsim.mpc.laws.parts.linear import LinearMPC
from quadsim.mpc.laws.parts.preparation import RobustPreparation
from quadsim.mpc.problem.constraints import Soft
from quadsim.mpc.problem.equilibrium import Trim
from quadsim.mpc.problem.heading import turn_horizontally
from quadsim.mpc.tables.commands import InputWeights
from quadsim.rollout.flown import Flight
from quadsim.sim.effects.rotors import RotorDynamics
from quadsim.state import ANGLE_RATES, INDEX, POSITION, POSITIONS, Array, make_state
from quadsim.vehicle import Vehicle

PERIOD = 0.05
SOFT = Soft(linear=2e5, quadratic=1e4)
EVERYTHING: dict[str, Any] = {
    "soft": SOFT,
    "rotor_lag": 0.03,
    "delay": 0.02,
    "offset_free": ObserverSettings(force_walk=0.25, torque_walk=0.5),
    "heading": True,
    "move_weight": 1.0,
}
"""All optional parts at once."""
HOLD = np.zeros((50, 4))
"""The reference of a vehicle that stays at the origin."""
SET_POINT = [INDEX["x"], INDEX["y"], INDEX["z"], INDEX["yaw"]]
"""The states that have a reference."""


def moving(velocity: tuple[float, float, float], **place: Any) -> Array:
    """A state (12,) with a velocity."""
    state = make_state(**place)
    state[[INDEX["vx"], INDEX["vy"], INDEX["vz"]]] = velocity
    return state


def robust(vehicle: Vehicle, *, horizon: int = 50, weight: float = 0.01, **settings: Any) -> LinearMPC:
    return robust_mpc(vehicle, robust_table(horizon=horizon, input_weights=InputWeights(speed=weight), **settings))


def flown(
    controller: LinearMPC, plant: NonlinearModel, state: Array, reference: Array, periods: int
) -> Iterator[tuple[Array, Array]]:
    """States (12,) at the samples and the commands given there; the plant's commands act the stated delay later."""
    hover = controller.problem.model.u_bar.copy()
    controller.reset(hover)
    x = np.concatenate([state, hover])[: plant.n]  # the rotor speeds are states of a plant with lag alone
    whole_periods, late = divmod(controller.preparation.delay, PERIOD)
    sent = [hover] * (1 + round(whole_periods))  # the first acts, those after it are under way
    for k in range(periods):
        now = StepInputs(time=k * PERIOD, acting=sent[-1])
        command = controller.step(now, x[:12], reference[k + 1 : k + 1 + controller.horizon])
        assert command.status in ACCEPTED
        yield x[:12].copy(), command.speeds
        sent.append(command.speeds)
        previous = sent.pop(0)
        if late > 0.0:
            x = next_state(replace(plant, period=late), x, previous)
        x = next_state(replace(plant, period=PERIOD - late), x, sent[0])


def final_state(controller: LinearMPC, plant: NonlinearModel, state: Array, reference: Array, periods: int) -> Array:
    """The state (12,) at the last sample of a flight."""
    *_, (last, _) = flown(controller, plant, state, reference, periods)
    return last


def preparation_of(controller: LinearMPC) -> RobustPreparation:
    assert isinstance(controller.preparation, RobustPreparation)
    return controller.preparation


def disturbance_of(controller: LinearMPC) -> Array:
    """The estimated force and torque (6,)."""
    disturbance = preparation_of(controller).disturbance
    assert disturbance is not None
    return disturbance


def trim_of(controller: LinearMPC) -> Trim:
    trim = preparation_of(controller).trim
    assert trim is not None
    return trim


def set_estimate(controller: LinearMPC, estimate: Array) -> None:
    """Replace the estimated force and torque (6,)."""
    preparation_of(controller).adopt(None, estimate)


def received(flight: Flight, first: int, periods: int) -> Iterator[tuple[StepInputs, Array, Array]]:
    """What a controller received in successive periods of a flight along the paper's course."""
    log = flight.log.control
    reference = paper_reference(log.t.size + 50)
    acting = np.vstack([log.speeds_before, log.speeds[:-1]])
    for k in range(first, first + periods):
        yield StepInputs(time=log.t[k], acting=acting[k]), log.state[k], reference[k + 1 : k + 51]


@pytest.mark.parametrize(("first", "name", "largest"), [(0, "yaw", 30.0), (180, "pitch", 5.0)])
def test_without_optional_parts_it_is_the_papers_controller(
    constrained_flight: Flight, vehicle: Vehicle, first: int, name: str, largest: float
) -> None:
    """In 100 periods of the turn from 30 deg to 0, and in 100 with the pitch at its bound of 5 deg at times."""
    paper = constrained_mpc(paper_problem())
    ours = robust(vehicle)
    active = 0
    angles = []
    for now, state, reference in received(constrained_flight, first, 100):
        expected = paper.step(now, state, reference)
        command = ours.step(now, state, reference)
        np.testing.assert_allclose(command.speeds, expected.speeds, atol=5e-3)
        active += command.stats.active
        angles.append(math.degrees(state[INDEX[name]]))
    assert active > 100
    assert np.abs(angles).max() == pytest.approx(largest, abs=1e-3)


@pytest.mark.parametrize("parts", [{}, {"soft": SOFT}, EVERYTHING])
def test_the_status_tells_whether_a_constraint_is_active(vehicle: Vehicle, parts: dict[str, Any]) -> None:
    now = StepInputs(acting=np.full(4, vehicle.hover_speed))
    shifted = np.tile([5.0, 0.0, 0.0, 0.0], (50, 1))
    controller = robust(vehicle, **parts)
    for reference, status in ((HOLD, UNCONSTRAINED), (shifted, SOLVED), (HOLD, UNCONSTRAINED)):
        controller.reset(np.full(4, vehicle.hover_speed))
        command = controller.step(now, np.zeros(12), reference)
        assert command.status == status
        assert (command.stats.active > 0) == (status == SOLVED)


# Lag


@pytest.mark.parametrize("delay", [0.02, 0.12])
def test_rotors_are_followed_as_the_plants_own_lag(vehicle: Vehicle, delay: float) -> None:
    """Also through a period whose state is refused, and one on the ground."""
    lag = 0.03
    controller = robust(vehicle, rotor_lag=lag, delay=delay)
    rotors = RotorDynamics(rise=lag, fall=lag)
    speeds = np.full(4, 150.0)
    controller.reset(speeds)
    rng = np.random.default_rng(3)
    for k in range(8):
        acting = 150.0 + 10.0 * rng.normal(size=4)
        state = np.zeros(12)
        phase = Phase.FLYING
        if k == 3:
            state[:] = math.nan
        if k == 5:
            phase = Phase.LANDED
        controller.step(StepInputs(acting=acting, phase=phase), state, HOLD)
        after_a_period, _ = respond(rotors, speeds, acting, np.array([PERIOD]))
        speeds = after_a_period[0]
        np.testing.assert_allclose(preparation_of(controller)._turning, speeds, rtol=1e-12)
    assert np.abs(speeds - acting).max() > 0.1, "they would be followed without a lag, too"


# Offset-free tracking


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_rest_under_a_disturbance_is_an_equilibrium(vehicle: Vehicle, yaw: float) -> None:
    """Of the plant, and of the controller: at rest at its set-point, it commands what holds it there."""
    controller = robust(vehicle, rotor_lag=0.03, heading=True, offset_free=ObserverSettings())
    estimate = np.array([0.4, -0.3, 0.5, 0.5, -0.3, 0.1])
    set_estimate(controller, estimate)
    force, torque = np.split(disturbance_of(controller), 2)
    model = nonlinear_model(vehicle, PERIOD, rotor_lag=0.03)
    model = replace(model, acceleration=force, angular_acceleration=torque)
    trim = trim_of(controller)
    speeds = trim.speeds
    rest = turn_horizontally(trim.state(yaw, model.n), np.array(yaw))
    rest[INDEX["yaw"]] = yaw
    np.testing.assert_allclose(derivative(model, rest, speeds), 0.0, atol=1e-9)
    controller.reset(speeds)  # which forgets the estimate
    set_estimate(controller, estimate)
    reference = np.tile([0.0, 0.0, 0.0, yaw], (50, 1))
    command = controller.step(StepInputs(acting=speeds), rest[:12], reference)
    np.testing.assert_allclose(command.speeds, speeds, atol=1e-4)


def test_constant_forces_torques_and_mass_leave_no_steady_error(vehicle: Vehicle) -> None:
    """Without the observer, they do."""
    force = np.array([0.3, -0.2, 0.25])
    torque = np.array([0.5, -0.3, 0.1])
    reference = np.tile([0.0, 0.0, 0.0, 0.5], (240, 1))
    settings = EVERYTHING | {"rotor_lag": 0.0, "delay": 0.0, "horizon": 25}
    disturbed = replace(nonlinear_model(vehicle, PERIOD), acceleration=force, angular_acceleration=torque)
    heavy = nonlinear_model(replace(vehicle, mass=1.1 * vehicle.mass), PERIOD)
    start = make_state(euler=(0.0, 0.0, 0.5))
    controller = robust(vehicle, **settings)
    end = final_state(controller, disturbed, start, reference, 200)
    np.testing.assert_allclose(end[SET_POINT], reference[0], atol=1e-3)
    np.testing.assert_allclose(disturbance_of(controller), np.concatenate([force, torque]), atol=1e-3)
    end = final_state(controller, heavy, start, reference, 200)
    np.testing.assert_allclose(end[SET_POINT], reference[0], atol=1e-3)
    without = robust(vehicle, **settings | {"offset_free": None})
    end = final_state(without, disturbed, start, reference, 40)
    assert np.abs(end[POSITIONS]).max() > 0.05


@pytest.mark.parametrize("delay", [0.02, 0.1, 0.12])
def test_stated_mismatch_is_not_attributed_to_a_disturbance(vehicle: Vehicle, delay: float) -> None:
    """The observer expects what lag, delay and tilt do to the state."""
    plant = nonlinear_model(vehicle, PERIOD, rotor_lag=0.03)
    controller = robust(vehicle, **{**EVERYTHING, "delay": delay})
    start = moving((0.3, -0.2, 0.1), euler=(0.05, -0.03, 2.0))
    moved = [state for state, _ in flown(controller, plant, start, np.zeros((80, 4)), 20)]
    np.testing.assert_allclose(disturbance_of(controller), 0.0, atol=1e-4)
    assert np.abs(np.diff(moved, axis=0)[:, ANGLE_RATES]).max() > 0.05


@pytest.mark.slow("robust")
@pytest.mark.parametrize("factor", [0.7, pytest.param(1.3, marks=pytest.mark.representative("robust"))])
def test_a_wrong_mass_is_no_force_sideways(vehicle: Vehicle, factor: float) -> None:
    """On a course that tilts the vehicle forward and back: at rest a wrong mass acts along the vertical alone."""
    heavy = nonlinear_model(replace(vehicle, mass=factor * vehicle.mass), PERIOD)
    reference = np.zeros((200, 4))
    reference[60:120, 0] = 2.0
    controller = robust(vehicle, weight=0.1, soft=SOFT, offset_free=ObserverSettings(), move_weight=20.0)
    set_estimate(controller, np.zeros(6))
    tilts = []
    sideways = []
    for state, _ in flown(controller, heavy, make_state(), reference, 150):
        tilts.append(abs(state[INDEX["pitch"]]))
        sideways.append(np.abs(disturbance_of(controller)[:2]).max())
    assert max(tilts) > math.radians(3.0)
    assert max(sideways) < 0.02
    assert disturbance_of(controller)[2] == pytest.approx(vehicle.gravity * (1.0 - factor), abs=0.05)


@pytest.mark.slow("robust")
def test_the_effect_of_a_worn_rotor_is_predicted_at_any_thrust(vehicle: Vehicle) -> None:
    """Its torque grows with the thrust; the estimate, which is that of hover, stays while the vehicle climbs."""
    worn = nonlinear_model(vehicle, PERIOD)
    worn = replace(worn, effectiveness=worn.effectiveness * [1.0, 0.8, 1.0, 1.0])
    reference = np.zeros((260, 4))
    reference[180:, 2] = 10.0  # a step of the height that the horizon shows from period 130 on
    settings: dict[str, Any] = {"soft": SOFT, "offset_free": ObserverSettings()}
    controller = robust(vehicle, weight=0.1, heading=True, **settings)
    torques = []
    thrusts = []
    for k, (_, speeds) in enumerate(flown(controller, worn, make_state(), reference, 200)):
        if k >= 140:  # the estimate has converged
            estimate = preparation_of(controller).memory.estimate
            assert estimate is not None
            torques.append(estimate[3])
            thrusts.append(np.sum(speeds**2) / np.sum(trim_of(controller).speeds ** 2))
    assert np.ptp(thrusts) > 0.5
    assert np.ptp(torques) < 0.05 * np.mean(torques)


def test_nothing_is_learned_on_the_ground_or_from_what_is_no_number(vehicle: Vehicle) -> None:
    """A period teaches by what the one before it predicted; the landing forgets what was learned."""
    controller = robust(vehicle, **EVERYTHING)
    acting = np.full(4, vehicle.hover_speed)
    pushed = moving((0.0, 0.0, 0.2))
    periods = (
        (np.zeros(12), Phase.ARMED),
        (pushed, Phase.FLYING),
        (np.full(12, math.nan), Phase.FLYING),
        (pushed, Phase.FLYING),
    )
    for k, (state, phase) in enumerate(periods):
        controller.step(StepInputs(time=k * PERIOD, acting=acting, phase=phase), state, HOLD)
        np.testing.assert_array_equal(disturbance_of(controller), 0.0)
    controller.step(StepInputs(time=4 * PERIOD, acting=acting), np.zeros(12), HOLD)
    assert disturbance_of(controller)[2] < -0.1  # a fall from 0.2 m/s to 0
    controller.step(StepInputs(time=5 * PERIOD, acting=acting, phase=Phase.LANDED), pushed, HOLD)
    np.testing.assert_array_equal(disturbance_of(controller), 0.0)


@pytest.mark.parametrize("gap", [0, 2, 40])
def test_the_observer_skips_pauses(vehicle: Vehicle, gap: int) -> None:
    """What was predicted for a period later is compared with no other instant."""
    controller = robust(vehicle, **EVERYTHING)
    acting = np.full(4, vehicle.hover_speed)
    controller.step(StepInputs(time=1.0, acting=acting), np.zeros(12), HOLD)
    controller.step(StepInputs(time=1.0 + gap * PERIOD, acting=acting), moving((0.0, 0.0, 0.2)), HOLD)
    np.testing.assert_array_equal(disturbance_of(controller), 0.0)


@pytest.mark.parametrize(("predicted", "learned"), [(0, True), (4, True), (5, False), (30, False)])
def test_predicted_states_do_not_update_the_observer(vehicle: Vehicle, predicted: int, learned: bool) -> None:
    """From the next measurement it learns if at most 4 states were predicted; after a longer outage it restarts.

    `unseen` has the periods since a channel was measured.
    """
    controller = robust(vehicle, **EVERYTHING)
    acting = np.full(4, vehicle.hover_speed)
    measured = np.zeros(12)
    vx_predicted = np.zeros(12)
    vx_predicted[INDEX["vx"]] = 1.0
    times = PERIOD * np.arange(predicted + 3)
    controller.step(StepInputs(time=times[0], acting=acting, unseen=measured), np.zeros(12), HOLD)
    for time in times[1 : predicted + 1]:
        controller.step(StepInputs(time=time, acting=acting, unseen=vx_predicted), moving((0.3, 0.0, 0.0)), HOLD)
        np.testing.assert_array_equal(disturbance_of(controller), 0.0)
    controller.step(StepInputs(time=times[-2], acting=acting, unseen=measured), moving((0.1, 0.0, 0.0)), HOLD)
    assert disturbance_of(controller).any() == learned
    before = disturbance_of(controller)
    controller.step(StepInputs(time=times[-1], acting=acting, unseen=measured), np.zeros(12), HOLD)
    assert np.abs(disturbance_of(controller) - before).max() > 0.0


def test_a_position_that_is_predicted_hides_no_disturbance(vehicle: Vehicle) -> None:
    controller = robust(vehicle, **EVERYTHING)
    acting = np.full(4, vehicle.hover_speed)
    unseen = np.zeros(12)
    unseen[list(POSITION)] = 7.0
    for k, speed in enumerate((0.0, 0.2)):
        controller.step(StepInputs(time=k * PERIOD, acting=acting, unseen=unseen), moving((0.0, 0.0, speed)), HOLD)
    assert disturbance_of(controller)[2] > 0.1


def test_predictions_and_trim_are_those_of_the_estimated_disturbance(vehicle: Vehicle) -> None:
    controller = robust(vehicle, offset_free=ObserverSettings(), heading=True)
    np.testing.assert_allclose(trim_of(controller).speeds, vehicle.hover_speed, rtol=1e-12)
    estimate = np.array([0.0, 0.0, -2.9, 0.5, 0.0, 0.0])
    set_estimate(controller, estimate)
    controller.reset(trim_of(controller).speeds)  # which forgets the estimate
    set_estimate(controller, estimate)
    plan = np.tile(trim_of(controller).speeds, (1, 50, 1))
    np.testing.assert_allclose(controller.predict(np.zeros((1, 12)), plan), 0.0, atol=1e-9)
    assert trim_of(controller).speeds.min() > vehicle.hover_speed + 15.0
    controller.reset(np.full(4, vehicle.hover_speed))
    np.testing.assert_allclose(trim_of(controller).speeds, vehicle.hover_speed, rtol=1e-12)


# Heading


def turned_state(state: Array, turn: float) -> Array:
    """States (..., 12) in a world that is turned about the vertical by an angle [rad]."""
    turned = turn_horizontally(state, np.full(state.shape[:-1], turn))
    turned[..., INDEX["yaw"]] += turn
    return turned


def test_a_flight_turned_about_the_vertical_is_the_same_flight(vehicle: Vehicle) -> None:
    """With a side force and a torque to learn, lag, delay and a yaw that turns on the way."""
    turn = 2.5
    plant = nonlinear_model(vehicle, PERIOD, rotor_lag=0.03)
    plant = replace(plant, angular_acceleration=np.array([0.5, -0.3, 0.1]))
    start = moving((0.1, 0.3, 0.0), position=(0.4, -0.2, 0.1), euler=(0.02, -0.03, -0.2))
    course = np.zeros((80, 4))
    course[:, 0] = 0.02 * np.arange(80)
    course[:, 3] = np.minimum(0.02 * np.arange(80), 0.6)
    turned_course = course.copy()
    turned_course[:, 0] = math.cos(turn) * course[:, 0]
    turned_course[:, 1] = math.sin(turn) * course[:, 0]
    turned_course[:, 3] += turn
    force = np.array([0.3, -0.2, 0.1])
    turned_force = turned_state(make_state(position=tuple(force)), turn)[list(POSITION)]

    def flight(x: Array, reference: Array, acceleration: Array) -> tuple[Array, Array]:
        controller = robust(vehicle, **EVERYTHING)
        pushed = replace(plant, acceleration=acceleration)
        states, commands = zip(*flown(controller, pushed, x, reference, 30), strict=True)
        return np.array(states), np.array(commands)

    states, commands = flight(start, course, force)
    turned_states, turned_commands = flight(turned_state(start, turn), turned_course, turned_force)
    np.testing.assert_allclose(turned_state(turned_states, -turn), states, atol=1e-6)
    np.testing.assert_allclose(turned_commands, commands, atol=1e-2)


def test_far_from_its_yaw_the_vehicle_is_commanded_a_part_of_the_turn_at_once(vehicle: Vehicle) -> None:
    """A yaw that is nearly half a turn away demands no more than the largest turn does, at once or by a jump."""
    far, near, jumping, returning = (HOLD.copy() for _ in range(4))
    far[:, 3] = 3.0
    near[:, 3] = 0.02
    jumping[0, 3] = 0.02
    jumping[1:, 3] = -3.0
    returning[0, 3] = 0.02
    controller = robust(vehicle, heading=True, weight=0.1, largest_turn=math.degrees(0.02))

    def commanded(reference: Array) -> Array:
        controller.reset(np.full(4, vehicle.hover_speed))
        return controller.step(StepInputs(), np.zeros(12), reference).plan

    np.testing.assert_allclose(commanded(far), commanded(near), atol=1e-9)
    np.testing.assert_allclose(commanded(jumping), commanded(returning), atol=1e-9)
    assert 0.1 < np.abs(commanded(near)[0] - vehicle.hover_speed).max() < 4.0  # not at the bound on its step


# Delay


@pytest.mark.parametrize("delay", [0.02, PERIOD, 0.06, 0.12])
@pytest.mark.parametrize("rotor_lag", [0.0, 0.03])
def test_a_delay_is_answered_from_where_the_vehicle_will_be(vehicle: Vehicle, delay: float, rotor_lag: float) -> None:
    """As by a controller without delay that is called at that instant, after the commands under way have acted."""
    model = nonlinear_model(vehicle, PERIOD, rotor_lag=rotor_lag or None)
    state = moving((0.5, 0.0, 0.2), position=(0.3, -0.2, 0.1), euler=(0.02, -0.03, 0.4))
    before = np.full(4, vehicle.hover_speed)
    acting = before + np.array([1.0, -2.0, 3.0, -1.0])
    velocity = np.array([1.0, 0.5, 0.2, 0.1])  # of the reference, so that its instants count as well
    late = robust(vehicle, delay=delay, rotor_lag=rotor_lag, heading=True)
    late.reset(before)
    command = late.step(StepInputs(acting=acting), state, PERIOD * np.arange(50.0)[:, None] * velocity)
    whole_periods = math.ceil(delay / PERIOD - 1e-9) - 1
    rest = delay - whole_periods * PERIOD
    under_way = [*[before] * whole_periods, acting]  # the first acts for the rest of the delay, the others a period
    durations = [rest, *[PERIOD] * whole_periods]
    rotors = acting
    if rotor_lag:
        since = PERIOD - rest  # the first acts
        rotors = under_way[0] + (before - under_way[0]) * math.exp(-since / rotor_lag)
    there = np.concatenate([state, rotors])[: model.n]
    for duration, speeds in zip(durations, under_way, strict=True):
        there = next_state(replace(model, period=duration), there, speeds)
    prompt = robust(vehicle, rotor_lag=rotor_lag, heading=True)
    prompt.reset(before)
    periods_later = np.minimum(np.arange(50.0) + delay / PERIOD, 49.0)  # the last row of a reference is held
    expected = prompt.step(StepInputs(acting=acting), there[:12], PERIOD * periods_later[:, None] * velocity)
    np.testing.assert_allclose(command.speeds, expected.speeds, atol=1e-3)


# Statuses


@pytest.mark.parametrize("value", [math.nan, math.inf, -1e6, 1e200])
def test_impossible_numbers_are_refused_and_forgotten(vehicle: Vehicle, value: float) -> None:
    acting = np.full(4, vehicle.hover_speed)
    controller = robust(vehicle, **EVERYTHING)
    for channel in (1, 4, 7, 8, 11):
        controller.reset(acting)
        controller.step(StepInputs(acting=acting), np.zeros(12), HOLD)
        corrupted = np.zeros(12)
        corrupted[channel] = value
        command = controller.step(StepInputs(acting=acting), corrupted, HOLD)
        assert command.status not in ACCEPTED
        np.testing.assert_array_equal(command.plan, np.tile(acting, (50, 1)))
        after = controller.step(StepInputs(acting=acting), np.zeros(12), HOLD)
        assert after.status in ACCEPTED
        assert np.isfinite(disturbance_of(controller)).all()
    wrong = HOLD.copy()
    wrong[7, 2] = value
    assert controller.step(StepInputs(acting=acting), np.zeros(12), wrong).status == "invalid_data"


@pytest.mark.parametrize("delay", [0.0, 0.02])
def test_overflow_has_no_side_effects(vehicle: Vehicle, delay: float) -> None:
    """Rates of 1000 rad/s, as a faulty sensor may report, overflow within a period of integration."""
    acting = np.full(4, vehicle.hover_speed)
    controller = robust(vehicle, **{**EVERYTHING, "delay": delay})
    for channel in (7, 9, 11):
        spun = np.zeros(12)
        spun[channel] = 1e3
        spun[INDEX["pitch"]] = 1.5
        for state in (np.zeros(12), spun, np.zeros(12)):
            last = controller.step(StepInputs(acting=acting), state, HOLD)
        assert last.status in ACCEPTED
        assert np.isfinite(disturbance_of(controller)).all()


def test_without_a_solution_the_command_in_force_is_held(vehicle: Vehicle) -> None:
    controller = robust(vehicle)
    acting = np.full(4, 120.0)
    tilted = make_state(euler=(math.radians(30.0), 0.0, 0.0))
    command = controller.step(StepInputs(acting=acting), tilted, HOLD)
    assert command.status in {"primal_infeasible", "max_iterations", "numerics"}
    assert command.stats.active == 0
    np.testing.assert_array_equal(command.plan, np.tile(acting, (50, 1)))
    assert controller.step(StepInputs(acting=acting), np.zeros(12), HOLD).status in ACCEPTED


@pytest.mark.parametrize("phase", [Phase.LANDED, Phase.CRASHED])
def test_on_the_ground_rotors_are_stopped_as_fast_as_allowed(vehicle: Vehicle, phase: Phase) -> None:
    controller = robust(vehicle, **EVERYTHING)
    controller.reset(np.full(4, 15.0))
    stops = [controller.step(StepInputs(phase=phase), np.zeros(12), HOLD) for _ in range(3)]
    assert {command.status for command in stops} == {str(phase)}
    assert [command.speeds.tolist() for command in stops] == [[5.0] * 4, [0.0] * 4, [0.0] * 4]  # by 10 rad/s


def test_the_last_command_acts_by_default(vehicle: Vehicle) -> None:
    given = robust(vehicle, **EVERYTHING)
    without = robust(vehicle, **EVERYTHING)
    state = make_state(position=(0.0, 0.0, -3.0))
    acting = np.full(4, vehicle.hover_speed)
    for controller in (given, without):
        controller.reset(acting)
    for _ in range(4):
        expected = given.step(StepInputs(acting=acting), state, HOLD)
        np.testing.assert_array_equal(without.step(StepInputs(), state, HOLD).speeds, expected.speeds)
        assert np.all(expected.speeds <= acting + 5.0)
        acting = expected.speeds
    assert acting.min() > vehicle.hover_speed + 10.0


def test_reset_restarts(vehicle: Vehicle) -> None:
    controller = robust(vehicle, **EVERYTHING)
    plant = replace(nonlinear_model(vehicle, PERIOD), acceleration=np.array([0.3, 0.0, 0.2]))
    start = make_state(position=(0.2, 0.0, 0.0))
    reference = np.zeros((60, 4))
    first = [speeds for _, speeds in flown(controller, plant, start, reference, 6)]
    again = [speeds for _, speeds in flown(controller, plant, start, reference, 6)]
    np.testing.assert_allclose(again, first, atol=1e-6)
