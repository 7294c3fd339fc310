"""Margins of output bounds: closed forms, the worst of disturbances, and flights that keep bounds at every instant."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
from numpy_preparation import next_state, nonlinear_model
from support import derivative, paper_problem, paper_reference, robust_mpc, robust_table

from quadsim.controller import ACCEPTED, StepInputs
from quadsim.errors import ParameterError
from quadsim.mpc.estimate.observer import ObserverSettings
from quadsim.mpc.laws.parts.linear import LinearMPC
from quadsim.mpc.problem.constraints import Bounds, Soft
from quadsim.mpc.problem.model import SHORTEST_LAG, discretise
from quadsim.mpc.problem.regulator import observed
from quadsim.mpc.problem.tightening import (
    ERROR_SHARE,
    SPEED_SHARE,
    TighteningSettings,
    between_samples,
    correction,
    disturbed_model,
    growth,
    margins,
)
from quadsim.mpc.tables.commands import InputWeights
from quadsim.rollout.rollout import closed_loop
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.sim.loop import complete
from quadsim.state import INDEX, Array
from quadsim.vehicle import Vehicle

ROOT = Path(__file__).resolve().parents[3]
TILTS = [INDEX["roll"], INDEX["pitch"]]
PERIOD = 0.05
HORIZON = 50
LIMIT = math.radians(5.0)
DOUBLE_INTEGRATOR = (
    np.array([[0.0, 1.0], [0.0, 0.0]]),
    np.array([[0.0], [1.0]]),
    np.array([[1.0, 0.0]]),
    np.array([[0.0], [1.0]]),
)


@cache
def tilt_bounds() -> Bounds:
    bounds = paper_problem().bounds
    assert bounds is not None
    return bounds


def tilt_margins(
    vehicle: Vehicle,
    settings: TighteningSettings | None = None,
    *,
    rotor_lag: float = 0.0,
    delay: float = 0.0,
    estimated: bool = False,
) -> Array:
    settings = TighteningSettings() if settings is None else settings
    return margins(
        vehicle,
        period=PERIOD,
        horizon=HORIZON,
        bounds=tilt_bounds(),
        settings=settings,
        rotor_lag=rotor_lag,
        delay=delay,
        estimated=estimated,
    )


# Closed forms


def test_output_passes_samples_of_a_parabola_by_that_much() -> None:
    t = np.linspace(0.0, PERIOD, 1001)
    assert between_samples(3.0, PERIOD) == pytest.approx((1.5 * t * (PERIOD - t)).max(), rel=1e-9)


@pytest.mark.parametrize("delay", [0.0, 0.02])
def test_uncorrected_error_of_a_double_integrator_grows_with_the_square_of_time(delay: float) -> None:
    A, B, C, E = DOUBLE_INTEGRATOR
    result = growth(A, B, C, 0.7 * E, np.zeros((1, 2)), period=PERIOD, horizon=6, delay=delay)
    times = delay + PERIOD * np.arange(1, 7)
    np.testing.assert_allclose(result[:, 0], 0.7 * times**2 / 2.0, rtol=1e-12)


def test_deadbeat_correction_of_a_double_integrator_ends_the_growth_after_two_periods() -> None:
    A, B, C, E = DOUBLE_INTEGRATOR
    K = np.array([[1.0 / PERIOD**2, 1.5 / PERIOD]])
    result = growth(A, B, C, E, K, period=PERIOD, horizon=5)
    np.testing.assert_allclose(result[:, 0], PERIOD**2 * np.array([0.5, 1.0, 1.0, 1.0, 1.0]), rtol=1e-9)


# The worst of disturbances


def errors(vehicle: Vehicle, w: Array, *, rotor_lag: float, delay: float, substeps: int) -> Array:
    """Roll and pitch (steps, 2, M) of the error, simulated under M courses of the disturbance w (steps, 6, M).

    It is measured at each period's start, predicted over the delay, and answered from then on for a period.
    """
    bounds = tilt_bounds()
    A, B, E = disturbed_model(vehicle, rotor_lag)
    C = np.hstack([bounds.C_c, np.zeros((2, len(A) - 12))])
    T = observed(A, C)
    scaled = C @ T / (ERROR_SHARE * LIMIT)
    K = correction(*discretise(T.T @ A @ T, T.T @ B, PERIOD), scaled, SPEED_SHARE * vehicle.hover_speed) @ T.T
    step = PERIOD / substeps
    late = round(delay / step)
    A_d, inputs = discretise(A, np.hstack([B, E]), step)
    ideal = np.split(inputs, [4], axis=1)[0]
    e = np.zeros((len(A), w.shape[2]))
    acting = np.zeros((4, w.shape[2]))
    under_way = [acting] * (late // substeps)
    outputs = np.empty((len(w), 2, w.shape[2]))
    for i, pushed in enumerate(w):
        if (i - late) % substeps == 0 and under_way:
            acting = under_way.pop(0)
        if i % substeps == 0:
            predicted = e
            coming = [acting, *under_way]
            for j in range(late):
                predicted = A_d @ predicted + ideal @ coming[(j + i - late) // substeps - (i - late) // substeps]
            under_way.append(-K @ predicted)
            if late == 0:
                acting = under_way.pop(0)
        e = A_d @ e + inputs @ np.concatenate([acting, pushed])
        outputs[i] = C @ e
    return outputs


@pytest.mark.parametrize(("rotor_lag", "delay"), [(0.0, 0.0), (0.05, 0.0), (0.0, 0.02), (0.05, 0.05), (0.05, 0.12)])
def test_margins_equal_the_worst_disturbances_effect(vehicle: Vehicle, rotor_lag: float, delay: float) -> None:
    largest = np.repeat([0.5, 0.3], 3)
    substeps = 50
    periods = 10
    about_x = 3
    settings = TighteningSettings(acceleration=0.5, angular_acceleration=0.3, turning=0.0)
    result = tilt_margins(vehicle, settings, rotor_lag=rotor_lag, delay=delay)
    late = round(delay / PERIOD * substeps)
    length = periods * substeps + late

    def respond(w: Array) -> Array:
        return errors(vehicle, w, rotor_lag=rotor_lag, delay=delay, substeps=substeps)

    # What a push during each step does to roll at the end gives the worst course of pushes.
    single = np.zeros((length, 6, length))
    single[range(length), about_x, range(length)] = 1.0
    worst = np.zeros((length, 6, 1))
    worst[:, about_x, 0] = 0.3 * np.sign(respond(single)[-1, 0])
    assert respond(worst)[-1, 0, 0] == pytest.approx(result[periods - 1, 0], rel=2e-3)

    rng = np.random.default_rng(0)
    for hold in (1, 10, substeps, 4 * substeps):
        signs = rng.choice([-1.0, 1.0], (-(-length // hold), 6, 50)).repeat(hold, axis=0)[:length]
        samples = np.abs(respond(largest[:, None] * signs)[late + substeps - 1 :: substeps])
        assert (samples <= result[:periods, :, None] * (1.0 + 1e-9)).all()


# What margins depend on


def test_without_disturbance_only_the_way_between_samples_is_left(vehicle: Vehicle) -> None:
    undisturbed = TighteningSettings(acceleration=0.0, angular_acceleration=0.0, turning=2.0)
    np.testing.assert_allclose(tilt_margins(vehicle, undisturbed), 2.0 * PERIOD**2 / 8.0, rtol=1e-12)


@pytest.mark.parametrize("rotor_lag", [0.0, 0.05])
def test_margins_grow_over_the_horizon_and_saturate(vehicle: Vehicle, rotor_lag: float) -> None:
    result = tilt_margins(vehicle, rotor_lag=rotor_lag)
    assert result.shape == (HORIZON, 2)
    assert (np.diff(result, axis=0) >= 0.0).all()
    np.testing.assert_allclose(result[20], result[-1], rtol=1e-2)
    np.testing.assert_allclose(result[:, 0], result[:, 1], rtol=1e-9)  # roll and pitch are alike


@pytest.mark.parametrize(
    ("rotor_lag", "delay", "first", "last"), [(0.0, 0.0, 0.13, 0.27), (0.05, 0.0, 0.13, 0.51), (0.05, 0.05, 0.34, 0.96)]
)
def test_defaults_draw_the_tilt_in_as_documented(
    vehicle: Vehicle, rotor_lag: float, delay: float, first: float, last: float
) -> None:
    result = np.degrees(tilt_margins(vehicle, rotor_lag=rotor_lag, delay=delay, estimated=True))
    np.testing.assert_allclose(result[0], first, atol=0.005)
    np.testing.assert_allclose(result[-1], last, atol=0.005)
    text = " ".join((ROOT / "docs" / "robust.md").read_text(encoding="utf-8").split())
    assert f"{last:.2f} deg" in text


def test_an_estimate_may_be_wrong_by_twice_the_disturbance(vehicle: Vehicle) -> None:
    between = between_samples(TighteningSettings().turning, PERIOD)
    without, with_one = (tilt_margins(vehicle, rotor_lag=0.05, estimated=known) for known in (False, True))
    np.testing.assert_allclose(with_one - between, 2.0 * (without - between), rtol=1e-12)


def test_wind_draws_in_bounds_of_velocity_and_not_those_of_tilt(vehicle: Vehicle) -> None:
    still = TighteningSettings(acceleration=0.0)
    windy = TighteningSettings(acceleration=1.0)
    np.testing.assert_allclose(tilt_margins(vehicle, windy), tilt_margins(vehicle, still), rtol=1e-9)
    velocity = np.zeros((1, 12))
    velocity[0, INDEX["vx"]] = 1.0
    bounds = replace(tilt_bounds(), C_c=velocity, y_min=np.array([-3.0]), y_max=np.array([3.0]))

    def drawn_in(settings: TighteningSettings) -> Array:
        return margins(vehicle, period=PERIOD, horizon=HORIZON, bounds=bounds, settings=settings)

    first = drawn_in(windy)[0] - drawn_in(still)[0]
    np.testing.assert_allclose(first, PERIOD)  # v = w t before anything answers


@pytest.mark.parametrize(("names", "rotor_lag", "count"), [(("roll",), 0.0, 2), (("roll",), 0.05, 3), (("x",), 0.0, 4)])
def test_outputs_observe_no_more_than_their_own_chain(
    vehicle: Vehicle, names: tuple[str, ...], rotor_lag: float, count: int
) -> None:
    A, _, _ = disturbed_model(vehicle, rotor_lag)
    C = np.zeros((len(names), len(A)))
    C[range(len(names)), [INDEX[name] for name in names]] = 1.0
    basis = observed(A, C)
    assert basis.shape == (len(A), count)
    np.testing.assert_allclose(basis.T @ basis, np.eye(count), atol=1e-12)
    # Nothing outside the basis ever shows in the outputs.
    for t in (0.05, 1.0):
        seen = C @ scipy.linalg.expm(A * t)
        np.testing.assert_allclose(seen @ basis @ basis.T, seen, atol=1e-9)


def test_disturbed_model_is_the_derivative_of_the_nonlinear_one_at_hover(vehicle: Vehicle) -> None:
    model = nonlinear_model(vehicle, PERIOD, rotor_lag=0.03)
    x = np.concatenate([np.zeros(12), np.full(4, vehicle.hover_speed)])
    u = np.full(4, vehicle.hover_speed)
    A, B, E = disturbed_model(vehicle, 0.03)
    h = 1e-4

    def slope(x: Array, u: Array, w: Array) -> Array:
        return derivative(replace(model, acceleration=w[:3], angular_acceleration=w[3:]), x, u)

    point = np.concatenate([x, u, np.zeros(6)])
    columns = []
    for step in h * np.eye(len(point)):
        ahead, behind = (slope(*np.split(q, [16, 20])) for q in (point + step, point - step))
        columns.append((ahead - behind) / (2.0 * h))
    np.testing.assert_allclose(np.hstack([A, B, E]), np.stack(columns, axis=1), atol=1e-5)


# Errors


@pytest.mark.parametrize(("name", "given"), [("angular_acceleration", 20.0), ("turning", 200.0)])
def test_disturbances_too_large_for_the_bounds_are_refused(vehicle: Vehicle, name: str, given: float) -> None:
    """In the file's words and units: the disturbance that takes most, the output, and how much there is."""
    rule = (
        rf"^controller\.tightening\.{name} must be smaller, or the bounds on roll wider: these leave 5 deg on either "
        rf"side of their middle, of which [\d.]+ deg would be given up and at most 2\.5 deg may be; got {given}$"
    )
    with pytest.raises(ParameterError, match=rule):
        tilt_margins(vehicle, TighteningSettings(**{name: given}))


@pytest.mark.parametrize("noise", [-3e-6, 0.0, 3e-6])
def test_of_outputs_as_narrow_as_each_other_the_first_is_named(vehicle: Vehicle, noise: float) -> None:
    narrow = replace(tilt_bounds(), y_max=np.array([LIMIT, LIMIT * (1.0 - noise)]))
    settings = TighteningSettings(angular_acceleration=20.0)
    with pytest.raises(ParameterError, match="roll"):
        margins(vehicle, period=PERIOD, horizon=HORIZON, bounds=narrow, settings=settings)


def test_the_quickest_rotors_that_are_taken_are_as_good_as_none(vehicle: Vehicle) -> None:
    quickest, none = (tilt_margins(vehicle, rotor_lag=lag) for lag in (SHORTEST_LAG, 0.0))
    np.testing.assert_allclose(quickest, none, rtol=0.01)


def test_bound_on_one_side_only_is_refused(vehicle: Vehicle) -> None:
    bounds = replace(tilt_bounds(), y_max=np.array([LIMIT, np.inf]))
    with pytest.raises(
        ParameterError,
        match=r"output_bounds\.pitch",
    ):
        margins(vehicle, period=PERIOD, horizon=HORIZON, bounds=bounds, settings=TighteningSettings())


# Flights

WIND = "effects.air={rotor_drag=3e-4, wind=[1.0, 0.0, 0.0]}"
PUSH = "effects.disturbance={force=[0.3, 0.2, 0.0], torque=[0.0099, -0.0099, 0.003]}"  # 0.3 rad/s^2 of roll and pitch
_LOSSES = ((10.3, 1, 0.4), (11.2, 3, 0.6), (12.0, 1, 1.2), (13.0, 3, 0.8))
CHANGING = "events=[{}]".format(  # 0.27 rad/s^2 of pitch each, to either side
    ", ".join(
        f'{{type="rotor_loss", at={at}, rotor={rotor}, loss=0.003, duration={lasts}}}' for at, rotor, lasts in _LOSSES
    )
)
LAG = 0.05
LAGGING = (f"effects.rotors.rise={LAG}", f"effects.rotors.fall={LAG}")


def robust(vehicle: Vehicle, drawn_in: Array | None, *, rotor_lag: float = 0.0, delay: float = 0.0) -> LinearMPC:
    """The paper's optimisation with every part."""
    table = robust_table(
        horizon=HORIZON,
        input_weights=InputWeights(speed=0.1),
        soft=Soft(linear=1e8, quadratic=1e4),
        rotor_lag=rotor_lag,
        delay=delay,
        offset_free=ObserverSettings(),
        heading=True,
        move_weight=20.0,
    )
    problem = table.problem(vehicle, PERIOD)
    assert problem.bounds is not None
    return robust_mpc(vehicle, table, replace(problem, bounds=replace(problem.bounds, margins=drawn_in)))


def peak_tilt(vehicle: Vehicle, *sets: str, tight: bool = True, rotor_lag: float = 0.0) -> float:
    """Largest roll or pitch [rad] over the paper's first 13.5 s, at the physics rate."""
    scenario = load_scenario("paper-constrained", ["duration=13.5", *sets])
    drawn_in = tilt_margins(vehicle, rotor_lag=rotor_lag, estimated=True) if tight else None
    controller = robust(vehicle, drawn_in, rotor_lag=rotor_lag)
    assembly = Assembly(scenario)
    reference = assembly.reference(scenario.periods + HORIZON)
    with assembly.plant() as plant:
        loop = closed_loop(assembly, plant, controller, reference, navigation=None)
        complete(loop, periods=scenario.periods)
        log = loop.log()
    assert log.reason is None
    assert len(log.plant.t) > 13_499  # each physics step
    tilts = np.abs(log.plant.state[:, [INDEX["roll"], INDEX["pitch"]]])
    turning = np.abs(np.gradient(log.plant.state[:, [INDEX["roll_rate"], INDEX["pitch_rate"]]], log.plant.t, axis=0))
    assert turning[tilts > 0.9 * LIMIT].max() <= TighteningSettings().turning
    return float(tilts.max())


@pytest.mark.slow("tightening")
def test_without_margins_the_tilt_passes_its_bound(vehicle: Vehicle) -> None:
    assert peak_tilt(vehicle, CHANGING, tight=False) > LIMIT


@pytest.mark.slow("tightening")
@pytest.mark.parametrize(
    ("sets", "rotor_lag"),
    [
        pytest.param((), 0.0, id="nominal", marks=pytest.mark.representative("tightening")),
        pytest.param((WIND, PUSH, *LAGGING), LAG, id="wind, push and lag"),
        pytest.param((CHANGING,), 0.0, id="changing"),
    ],
)
def test_with_margins_the_tilt_stays_within_its_bound_at_every_instant(
    vehicle: Vehicle, sets: tuple[str, ...], rotor_lag: float
) -> None:
    peak = peak_tilt(vehicle, *sets, rotor_lag=rotor_lag)
    assert peak <= LIMIT
    assert peak > 0.9 * LIMIT  # and is not bought by staying far away


STATED = TighteningSettings()
Course = Callable[[float, Array], Array]
"""Disturbance (6,) at a time [s], for the tilts (2,) that there are [rad]."""


def alternating(period: float, acceleration: float) -> Course:
    """As large as stated about roll and pitch, with a sign that changes twice in so many seconds."""

    def course(t: float, tilts: Array) -> Array:
        sign = 1.0 if t % period < 0.5 * period else -1.0
        return sign * np.array([acceleration, acceleration, 0.0, *2 * [STATED.angular_acceleration], 0.0])

    return course


def outward(t: float, tilts: Array) -> Array:
    """As large as stated, and always towards more tilt."""
    return np.concatenate([np.zeros(3), STATED.angular_acceleration * np.sign(tilts), np.zeros(1)])


def pushed_tilt(vehicle: Vehicle, course: Course, *, rotor_lag: float, delay: float, estimated: bool) -> float:
    """Largest roll or pitch [rad] of the nonlinear model over six seconds under a disturbance, every 2 ms.

    Its rotors lag, and its commands are late, as the controller knows.
    """
    substeps = 25
    drawn_in = tilt_margins(vehicle, rotor_lag=rotor_lag, delay=delay, estimated=estimated)
    controller = robust(vehicle, drawn_in, rotor_lag=rotor_lag, delay=delay)
    plant = nonlinear_model(vehicle, PERIOD / substeps, substeps=1, rotor_lag=rotor_lag or None)
    reference = paper_reference(120 + HORIZON)
    acting = np.full(4, vehicle.hover_speed)
    controller.reset(acting)
    x = np.concatenate([np.zeros(12), acting])[: plant.n]
    peak = 0.0
    for k in range(120):
        command = controller.step(
            StepInputs(time=k * PERIOD, acting=acting), x[:12], reference[k + 1 : k + 1 + HORIZON]
        )
        assert command.status in ACCEPTED
        for i in range(substeps):
            w = course((k + i / substeps) * PERIOD, x[TILTS])
            late = i < round(delay / plant.period)
            pushed = replace(plant, acceleration=w[:3], angular_acceleration=w[3:])
            x = next_state(pushed, x, acting if late else command.speeds)
            peak = max(peak, float(np.abs(x[TILTS]).max()))
        acting = command.speeds
    return peak


TURNS = alternating(3.0, 0.0)
ALL = alternating(6.0, STATED.acceleration)


@pytest.mark.slow("tightening")
@pytest.mark.parametrize(
    ("course", "rotor_lag", "delay"),
    [
        pytest.param(TURNS, 0.0, 0.0, marks=pytest.mark.representative("tightening")),
        (TURNS, LAG, 0.05),
        (ALL, 0.0, 0.05),
        (ALL, LAG, 0.05),
        (outward, LAG, 0.0),
        (outward, LAG, 0.05),
    ],
)
def test_no_disturbance_within_the_stated_bounds_tilts_it_further(
    vehicle: Vehicle, course: Course, rotor_lag: float, delay: float
) -> None:
    peak = pushed_tilt(vehicle, course, rotor_lag=rotor_lag, delay=delay, estimated=True)
    assert 0.9 * LIMIT < peak <= LIMIT


@pytest.mark.slow("tightening")
def test_margins_for_the_disturbance_alone_do_not_cover_a_wrong_estimate(vehicle: Vehicle) -> None:
    assert pushed_tilt(vehicle, ALL, rotor_lag=LAG, delay=0.05, estimated=False) > 1.01 * LIMIT
