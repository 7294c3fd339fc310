"""Nonlinear MPC: its optimum against an independent solver, flights at any attitude, bounds, refusals."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize
from support import advance_nodes

from quadsim.assets import vehicle_path
from quadsim.controller import ACCEPTED, NOT_CONVERGED, OPTIMAL, Command, Phase, StepInputs
from quadsim.errors import ParameterError
from quadsim.motion import Motion
from quadsim.mpc.estimate.observer import ObserverSettings
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.laws.nonlinear import Nonlinear, Weights
from quadsim.mpc.laws.parts.nonlinear_law import WIDTH_OF_MOTION, put_motion
from quadsim.mpc.laws.parts.nonlinear_mpc import CONVERGED, STEP_TOLERANCE, NonlinearMPC
from quadsim.mpc.laws.parts.nonlinear_problem import inputs_to_commands
from quadsim.mpc.problem.constraints import Constraint
from quadsim.mpc.problem.rigidbody import N_BODY, Inputs, P, Q, V, W, rigid_body, thrust_axis
from quadsim.rollout.conflicts import find_conflict
from quadsim.rotation import multiply, quaternion_to_euler
from quadsim.state import INDEX, N_STATES, POSITIONS, VELOCITIES, Array
from quadsim.vehicle import load_vehicle

VEHICLE = load_vehicle(vehicle_path("hummingbird"))
PERIOD = 0.02
HOVER = np.full(4, VEHICLE.hover_speed)
ERRORS = ("error-state", "difference")


def law(
    bounds: ActuatorBounds | None = None, constraints: tuple[Constraint, ...] = (), **settings: Any
) -> NonlinearMPC:
    """Of nodes of two periods; the horizon is in nodes."""
    nodes = settings.pop("horizon", 10)
    tolerance = settings.pop("tolerance", STEP_TOLERANCE)
    made = Nonlinear(horizon=2 * nodes, node=2.0 * PERIOD, **settings)
    return NonlinearMPC(
        VEHICLE, period=PERIOD, settings=made, bounds=bounds, constraints=constraints, tolerance=tolerance
    )


def call(
    controller: NonlinearMPC, x: Array, time: float = 0.0, reference: Array | None = None, **moment: Any
) -> Command:
    """The answer at a state (13,)."""
    state = np.zeros(N_STATES)
    state[POSITIONS] = x[P]
    state[VELOCITIES] = x[V]
    preview = np.zeros((controller.horizon, 4)) if reference is None else reference
    return controller.step(StepInputs(time=time, attitude=x[Q], body_rates=x[W], **moment), state, preview)


def at_rest(q: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)) -> Array:
    x = np.zeros(N_BODY)
    x[Q] = np.array(q) / np.linalg.norm(q)
    return x


def fly(controller: NonlinearMPC, x: Array, seconds: float, motion: Motion | None = None, **plant: Any) -> Array:
    """States (K + 1, 13) of a flight in the model's own equations, of a disturbed or another vehicle by `plant`."""
    model = rigid_body(VEHICLE, PERIOD, substeps=10, inputs=Inputs.SPEED, **plant)
    states = [x]
    controller.reset(HOVER)
    for k in range(round(seconds / PERIOD)):
        following = None if motion is None else motion.after(k)
        command = call(controller, states[-1], k * PERIOD, motion=following)
        assert command.status in ACCEPTED
        x = advance_nodes(model, states[-1], command.speeds / VEHICLE.speed_max)
        x[Q] /= np.linalg.norm(x[Q])
        states.append(x)
    return np.array(states)


def still(samples: int, attitude: Array, position: Array | None = None) -> Motion:
    """A motion of samples of attitude (K, 4), with hover thrust."""
    nothing = np.zeros((samples, 3))
    thrusts = np.full((samples, 4), VEHICLE.mass * VEHICLE.gravity / 4.0)
    where = nothing if position is None else position
    return Motion(
        position=where, velocity=nothing, acceleration=nothing, attitude=attitude, body_rates=nothing, thrusts=thrusts
    )


# --- convergence of its SQP ----------------------------------------------------------------------------------------


def test_its_residual_is_that_of_the_plan_that_is_commanded() -> None:
    """States predicted by the QP against the model rolled out from each, which one step from hover does not follow."""
    controller = law(horizon=20)
    x0 = at_rest((0.0, 1.0, 0.0, 0.0))
    command = call(controller, x0)
    plan = controller.stored_plan
    assert plan is not None
    states, inputs = plan
    np.testing.assert_allclose(inputs_to_commands(controller.model, VEHICLE, inputs)[0], command.plan[0])
    np.testing.assert_array_equal(states[0], x0)
    result = np.abs(states[1:] - advance_nodes(controller.model, states[:-1], inputs)).max()
    assert command.stats.sqp_defect == pytest.approx(result, rel=1e-9)
    assert command.stats.sqp_defect > CONVERGED
    assert command.stats.sqp_step > 1.0
    assert command.status == NOT_CONVERGED
    assert command.status in ACCEPTED - OPTIMAL
    assert command.fallback == 0


def test_more_iterations_converge_where_one_does_not() -> None:
    x0 = at_rest((0.0, 1.0, 0.0, 0.0))
    once = law(horizon=20)
    often = law(horizon=20, iterations=50)
    command = call(often, x0)
    assert command.stats.sqp_defect < 1e-6
    assert command.status in OPTIMAL
    assert often.infeasible_period is None
    for k in range(3):  # the first period that did not converge is kept, and is solved again as it was posed
        call(once, x0, k * PERIOD)
    kept = once.infeasible_period
    assert kept is not None
    assert kept.converges is not None
    assert (kept.time, kept.status) == (0.0, NOT_CONVERGED)
    assert [kept.converges(count) for count in (1, 50)] == [False, True]


def test_an_infeasible_qp_takes_precedence_over_an_unconverged_sqp() -> None:
    controller = law(horizon=20, body_rate=math.degrees(1.0))
    call(controller, at_rest((0.0, 1.0, 0.0, 0.0)))
    spinning = at_rest()
    spinning[W] = 50.0
    refused = call(controller, spinning, PERIOD)
    assert math.isnan(refused.stats.sqp_defect)
    assert controller.infeasible_period is not None
    assert controller.infeasible_period.status == refused.status not in ACCEPTED


# --- its optimum ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", ERRORS)
@pytest.mark.parametrize("inputs", [Inputs.THRUST, Inputs.SPEED])
def test_converged_it_is_the_optimum_of_an_independent_solver(error: str, inputs: Inputs) -> None:
    """SLSQP on the nonlinear problem from its definition: rolled out, no QP, no derivative of ours."""
    weights = Weights(position=(10.0, 8.0, 12.0), attitude=2.0, velocity=0.5, body_rates=0.05, input=0.02, move=0.01)
    controller = law(
        horizon=4, iterations=100, tolerance=1e-9, inputs=inputs, attitude_error=error, weights=weights, terminal=3.0
    )
    x0 = at_rest((0.98, 0.15, -0.1, 0.05))
    x0[P] = (0.2, -0.1, -0.8)
    x0[V] = (0.5, 0.2, -0.4)
    x0[W] = (0.3, -0.5, 0.2)
    command = call(controller, x0)
    model = rigid_body(VEHICLE, 2 * PERIOD, inputs=inputs)
    hover = model.shares(np.full(4, VEHICLE.mass * VEHICLE.gravity / 4.0))

    def costs(flat: Array) -> Array:
        """(K,) of K sequences of inputs (K, 16), rolled out at once."""
        u = flat.reshape(-1, 4, 4)
        x = np.tile(x0, (len(flat), 1))
        total = np.zeros(len(flat))
        for i in range(4):
            x = advance_nodes(model, x, u[:, i])
            turned = x[:, Q] - [1, 0, 0, 0] if error == "difference" else 2.0 * x[:, 4:7]
            stage = np.square(x[:, P]) @ weights.position + weights.attitude * np.square(turned).sum(axis=1)
            stage += (
                np.square(x[:, V]).sum(axis=1) * weights.velocity + np.square(x[:, W]).sum(axis=1) * weights.body_rates
            )
            before = hover if i == 0 else u[:, i - 1]
            total += (3.0 if i == 3 else 1.0) * stage
            total += weights.input * np.square(u[:, i] - hover).sum(axis=1)
            total += weights.move * np.square(u[:, i] - before).sum(axis=1)
        return total

    def cost(flat: Array) -> float:
        return float(costs(flat[None])[0])

    def gradient(flat: Array) -> Array:
        """By central differences."""
        steps = 1e-6 * np.eye(16)
        return (costs(flat + steps) - costs(flat - steps)) / 2e-6

    result = minimize(
        cost,
        np.tile(hover, 4),
        jac=gradient,
        method="SLSQP",
        bounds=[(0.0, 1.0)] * 16,
        options={"ftol": 1e-15, "maxiter": 500},
    )
    ours = model.shares(VEHICLE.thrust_coefficient * np.square(command.plan[::2]))
    assert cost(ours.ravel()) <= result.fun * (1.0 + 1e-9)
    np.testing.assert_allclose(ours, result.x.reshape(4, 4), atol=1e-4)
    assert ours.min() < 1e-6 or ours.max() > 1.0 - 1e-6  # a bound is active


def test_the_real_time_iteration_comes_to_the_same_optimum_at_a_state_that_stays() -> None:
    x = at_rest((0.95, 0.2, 0.1, 0.0))
    x[P] = 0.3, 0.0, -0.2
    exact = call(law(iterations=50, tolerance=1e-11), x)
    one = law(shift=False)
    for _ in range(40):
        command = call(one, x, acting=HOVER)
    np.testing.assert_allclose(command.plan, exact.plan, atol=1e-3 * VEHICLE.speed_max)


def test_a_quaternion_and_its_opposite_are_one_attitude() -> None:
    x = at_rest((0.9, 0.3, -0.2, 0.1))
    other = x.copy()
    other[Q] *= -1.0
    np.testing.assert_allclose(call(law(), other).speeds, call(law(), x).speeds, rtol=1e-9)


# --- any attitude --------------------------------------------------------------------------------------------------


@pytest.mark.slow("nonlinear")
@pytest.mark.parametrize("q", [(0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.05, 0.7, 0.7, 0.1)])
def test_upside_down_it_turns_over_and_comes_back(q: tuple[float, ...]) -> None:
    states = fly(law(horizon=20), at_rest(q), 3.0)
    assert np.linalg.norm(states[-1, P]) < 0.02
    assert thrust_axis(states[-1, Q])[2] > 0.999
    assert np.abs(states[:, P]).max() < 2.0


@pytest.mark.representative("nonlinear")
def test_a_flip_is_flown_through() -> None:
    """A whole turn about body x in 0.6 s, one second in; the quaternion comes back with the other sign."""
    t = PERIOD * np.arange(225)
    angle = math.tau * np.clip((t - 1.0) / 0.6, 0.0, 1.0)
    motion = still(t.size, np.stack([np.cos(angle / 2), np.sin(angle / 2), 0 * t, 0 * t], axis=1))
    rates = np.zeros((t.size, 3))
    rates[:, 0] = np.gradient(angle, PERIOD)
    heavy = Weights(position=5.0, attitude=20.0, velocity=0.5, body_rates=0.05, input=0.1)
    states = fly(law(horizon=20, weights=heavy), at_rest(), 4.5, replace(motion, body_rates=rates))
    up = thrust_axis(states[:, Q])[:, 2]
    assert up.min() < -0.9
    assert states[-1, 3] < -0.99  # one whole turn on
    np.testing.assert_allclose(states[-1, P], 0.0, atol=0.05)
    assert np.linalg.norm(states[:, P], axis=1).max() < 4.0


# --- references ----------------------------------------------------------------------------------------------------


def test_rows_past_the_end_of_a_motion_repeat_the_last() -> None:
    spread = np.tile(np.arange(21.0)[:, None], (1, 4))
    motion = Motion(
        position=spread[:, :3], velocity=spread[:, :3], acceleration=spread[:, :3], attitude=spread,
        body_rates=spread[:, :3], thrusts=spread,
    )  # fmt: skip
    rows = np.zeros((6, WIDTH_OF_MOTION))
    for k, samples in (
        (0, [0, 1, 2, 3, 4, 5]),
        (15, [15, 16, 17, 18, 19, 20]),
        (17, [17, 18, 19, 20, 20, 20]),
        (20, [20] * 6),
    ):
        put_motion(motion.after(k), rows)
        np.testing.assert_array_equal(rows, np.tile(np.array(samples)[:, None], (1, WIDTH_OF_MOTION)))


def test_nodes_of_a_preview_have_its_velocity_and_its_yaw() -> None:
    controller = law(horizon=4)
    rows = np.arange(1, 9)[:, None] * [0.1, 0.0, -0.05, 0.2]
    call(controller, at_rest(), reference=rows)
    _, _, states, thrusts = controller.asked
    np.testing.assert_allclose(states[:, 0], [0.0, 0.2, 0.4, 0.6, 0.8], atol=1e-12)
    np.testing.assert_allclose(states[:, V], np.tile([5.0, 0.0, -2.5], (5, 1)), atol=1e-9)
    np.testing.assert_allclose(states[:, 12], 10.0)
    np.testing.assert_allclose(states[2, Q], [math.cos(0.4), 0.0, 0.0, math.sin(0.4)])
    np.testing.assert_allclose(thrusts, VEHICLE.mass * VEHICLE.gravity / 4.0)


# --- disturbances --------------------------------------------------------------------------------------------------


DISTURBANCE = {"acceleration": np.array([0.25, -0.1, 0.2]), "angular_acceleration": np.array([0.5, -0.25, 0.1])}


@pytest.mark.slow("nonlinear")
def test_a_constant_disturbance_leaves_no_error_with_the_observer_and_one_without() -> None:
    quick = ObserverSettings(velocity_noise=0.01, velocity_walk=0.01, rate_noise=0.02)
    with_it, without = (
        fly(law(offset_free=observer), at_rest(), seconds, **DISTURBANCE)
        for observer, seconds in ((quick, 9.0), (None, 2.0))
    )
    assert np.linalg.norm(with_it[-1, P]) < 2e-3
    assert np.linalg.norm(without[-1, P]) > 0.02


@pytest.mark.slow("nonlinear")
def test_known_drag_is_balanced() -> None:
    """A straight flight at 4 m/s."""
    t = PERIOD * np.arange(250)
    position = np.stack([4.0 * t, 0 * t, 0 * t], axis=1)
    motion = replace(still(250, np.tile([1.0, 0, 0, 0], (250, 1)), position), velocity=np.tile([4.0, 0, 0], (250, 1)))
    drag = {"drag": (0.2, 0.2, 0.0), "quadratic_drag": (0.05, 0.05, 0.05)}
    start = at_rest()
    start[V] = 4.0, 0.0, 0.0
    known, unknown = (
        fly(law(**settings), start, seconds, motion, **{name: np.array(value) for name, value in drag.items()})
        for settings, seconds in ((drag, 4.0), ({}, 2.0))
    )
    assert np.linalg.norm(known[-1, P] - position[200]) < 2e-3
    assert np.linalg.norm(unknown[-1, P] - position[100]) > 0.1


# --- bounds --------------------------------------------------------------------------------------------------------


def furthest(states: Array) -> tuple[float, float]:
    """Largest tilt [deg] and largest body rate [rad/s]."""
    return float(np.degrees(np.arccos(thrust_axis(states[:, Q])[:, 2]).max())), float(np.abs(states[:, W]).max())


@pytest.mark.representative("nonlinear")
def test_tilt_and_body_rates_are_bounded() -> None:
    x = at_rest()
    x[P] = 3.0, -3.0, 0.0
    gentle = Weights(position=2.0, velocity=0.5, attitude=0.5, body_rates=0.2)
    free, quick = furthest(fly(law(weights=gentle, horizon=20), x, 2.0))
    held, _ = furthest(fly(law(weights=gentle, horizon=20, tilt=15.0), x, 2.0))
    assert free > 25.0
    assert 12.0 < held < 15.6
    _, slow = furthest(fly(law(weights=gentle, horizon=20, body_rate=math.degrees(1.0)), x, 2.0))
    assert quick > 1.5
    assert slow < 1.02


def test_velocities_and_slews_are_bounded() -> None:
    x = at_rest()
    x[P] = 4.0, 0.0, 0.0
    row = np.zeros((1, N_STATES))
    row[0, INDEX["vx"]] = 1.0
    fence = Constraint(name="slow", lower=np.array([-1.0]), upper=np.array([1.0]), C=row)
    bounds = ActuatorBounds.alike((0.0, VEHICLE.speed_max), (-60.0, 60.0))
    controller = law(bounds, (fence,), inputs=Inputs.SPEED, horizon=20)
    states = fly(controller, x, 3.0)
    assert -1.02 < states[:, 7].min() < -0.9
    first = call(law(bounds, (fence,), inputs=Inputs.SPEED, horizon=20), x, acting=HOVER)
    assert np.abs(first.speeds - HOVER).max() <= 60.0 + 1e-6
    assert np.abs(first.speeds - HOVER).max() > 59.0


def test_rows_not_linear_in_the_model_are_refused() -> None:
    angle = np.zeros((1, N_STATES))
    speed = np.array([[1.0, 0.0, 0.0, 0.0]])
    angle[0, INDEX["roll"]] = 1.0
    one = {"name": "mine", "lower": np.array([-1.0]), "upper": np.array([1.0])}
    with pytest.raises(ParameterError, match=r"controller\.mine"):
        law(constraints=(Constraint(C=angle, **one),))
    with pytest.raises(ParameterError, match=r"controller\.mine"):
        law(constraints=(Constraint(D=speed, **one),))
    with pytest.raises(ParameterError, match=r"controller\.input_bounds\.slew"):
        law(ActuatorBounds.alike((0.0, 800.0), (-60.0, 60.0)))


# --- what a controller must stand ----------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [math.nan, math.inf, 1e7])
def test_invalid_numbers_are_refused_without_side_effects(number: float) -> None:
    controller = law()
    fresh = law()
    wrong = at_rest()
    wrong[0] = number
    command = call(controller, wrong)
    assert command.status == "invalid_data"
    np.testing.assert_array_equal(command.speeds, HOVER)
    np.testing.assert_array_equal(call(controller, at_rest()).speeds, call(fresh, at_rest()).speeds)
    assert controller.infeasible_period is None


def test_without_attitude_in_the_moment_it_is_taken_from_the_state() -> None:
    state = np.zeros(N_STATES)
    state[INDEX["roll"]] = 0.3
    state[INDEX["pitch_rate"]] = 0.4
    reference = np.zeros((20, 4))
    x = at_rest((math.cos(0.15), math.sin(0.15), 0.0, 0.0))
    # d(pitch)/dt = q cos(roll) - r sin(roll) alone, and no yaw rate
    x[W] = 0.0, 0.4 * math.cos(0.3), -0.4 * math.sin(0.3)
    np.testing.assert_allclose(law().step(StepInputs(), state, reference).speeds, call(law(), x).speeds, rtol=1e-9)


def test_an_infeasible_problem_is_reported_with_its_query() -> None:
    row = np.zeros((1, N_STATES))
    row[0, INDEX["x"]] = 1.0
    fence = Constraint(name="fence", lower=np.array([5.0]), upper=np.array([6.0]), C=row)
    controller = law(constraints=(fence,))
    command = call(controller, at_rest())
    assert command.status not in ACCEPTED
    np.testing.assert_array_equal(command.speeds, HOVER)
    assert controller.infeasible_period is not None
    conflict = find_conflict(controller.infeasible_period)
    assert conflict is not None
    names = [part.name for part in controller.problem.every_constraint]
    assert {names[side.place] for side in conflict.violated} == {"fence"}


def test_grounded_rotors_stop() -> None:
    command = call(law(), at_rest(), phase=Phase.LANDED)
    assert command.status == "landed"
    assert (command.speeds == VEHICLE.speed_min).all()


@pytest.mark.parametrize("observer", [None, ObserverSettings()])
def test_predictions_match_the_model(observer: ObserverSettings | None) -> None:
    """With the disturbance that is estimated: here the vehicle stays where it should have risen."""
    controller = law(offset_free=observer)
    x = at_rest((0.9, 0.3, 0.0, 0.1))
    for k in range(3):
        command = call(controller, x, k * PERIOD)
    result = np.zeros(6) if observer is None else controller.disturbance
    assert result.any() == (observer is not None)
    state = np.zeros((1, N_STATES))
    state[0, 6::2] = quaternion_to_euler(x[Q])
    predicted = controller.predict(state, command.plan[None])
    disturbed = {"acceleration": result[:3], "angular_acceleration": result[3:]}
    model = rigid_body(VEHICLE, PERIOD, inputs=Inputs.SPEED, **disturbed)
    for i in range(command.plan.shape[0]):
        x = advance_nodes(model, x, command.plan[i] / VEHICLE.speed_max)
        x[Q] /= np.linalg.norm(x[Q])
        np.testing.assert_allclose(predicted[0, i, POSITIONS], x[P], atol=1e-9)


def test_turning_the_world_about_the_vertical_turns_the_answer_with_it() -> None:
    """Position, velocity and attitude turned by one yaw, and the reference's yaw too: the same rotor speeds."""
    x = at_rest((0.9, 0.3, -0.2, 0.1))
    x[P] = (0.5, -0.2, 0.3)
    x[V] = (0.1, 0.4, 0.0)
    even = Weights(position=10.0, velocity=0.3)
    plain = call(law(weights=even), x)
    yaw = 2.0
    turn = np.array([[math.cos(yaw), -math.sin(yaw), 0.0], [math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    other = x.copy()
    other[P] = turn @ x[P]
    other[V] = turn @ x[V]
    other[Q] = multiply(np.array([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]), x[Q])
    reference = np.zeros((20, 4))
    reference[:, 3] = yaw
    np.testing.assert_allclose(call(law(weights=even), other, reference=reference).speeds, plain.speeds, rtol=1e-9)
