"""The rules that a first scenario follows, against closed loops."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from first_flights import vehicles

from quadsim.controller import StepInputs
from quadsim.errors import ParameterError
from quadsim.features.design.authority import control_authority
from quadsim.features.design.courses_by_rule import SHARE, largest_eight
from quadsim.features.design.first_scenario import first_scenario
from quadsim.features.design.rules import FASTEST_LOOP, PERIOD_SHARE, delay_margin, design_for, gain, is_stable
from quadsim.mpc.laws.parts.builders import build
from quadsim.mpc.problem.model import continuous_model, discretise
from quadsim.scenarios.loading import parse_scenario
from quadsim.sim.effects import Effects
from quadsim.sim.effects.wind import Air
from quadsim.sim.plant import Plant
from quadsim.state import INDEX, N_STATES, make_state
from quadsim.vehicle import N_ROTORS, VEHICLE_UNITS, Vehicle

ALL = vehicles()
EVERY = pytest.mark.parametrize("vehicle", ALL, ids=lambda vehicle: vehicle.name)


@pytest.mark.representative("first flights")
@EVERY
def test_the_loop_stands_a_third_of_its_time_constant_of_more_delay(vehicle: Vehicle) -> None:
    """The bound by lag then leaves 0.8 (T + tau / 2), whatever the vehicle."""
    tuning = design_for(vehicle)
    margin = delay_margin(vehicle, tuning)
    assert margin * tuning.bandwidth == pytest.approx(1.0 / 3.0, rel=0.05)
    assert margin > 0.75 * (tuning.authority.lag + 0.5 * tuning.period)


@pytest.mark.slow("first flights")
@pytest.mark.parametrize("vehicle", ALL, ids=lambda vehicle: vehicle.name)
@pytest.mark.parametrize("law", ["pid", "geometric"])
def test_a_baselines_loop_tolerates_a_quarter_to_three_quarters_of_that_delay(vehicle: Vehicle, law: str) -> None:
    """Its gain K (4, n + 4) by differences at hover, of the law that a first scenario has."""
    numbers = {name: value for name in VEHICLE_UNITS if (value := getattr(vehicle, name)) is not None}
    data = first_scenario(vehicle, vehicle.name, law=law).to_data() | {"vehicle": {"file": vehicle.name, **numbers}}
    scenario = parse_scenario(data)
    tuning = design_for(vehicle)
    step = 1e-5
    K = np.zeros_like(gain(vehicle, tuning))
    for i in range(N_STATES):
        state = np.zeros(N_STATES)
        answers = []
        for state[i] in (step, -step):
            controller = build(scenario.controller, vehicle, tuning.period)
            answers.append(controller.step(StepInputs(), state, np.zeros((controller.horizon, 4))).speeds)
        K[:, i] = (answers[1] - answers[0]) / (2.0 * step)
    margin = delay_margin(vehicle, tuning)
    assert is_stable(vehicle, tuning, K, 0.25 * margin)
    assert not is_stable(vehicle, tuning, K, 0.8 * margin)


@EVERY
def test_period_horizon_and_bandwidth_go_together(vehicle: Vehicle) -> None:
    tuning = design_for(vehicle)
    assert tuning.bandwidth <= FASTEST_LOOP
    assert tuning.bandwidth * tuning.period <= PERIOD_SHARE
    assert 30 <= tuning.horizon <= 60
    assert 0.0 < tuning.tilt < tuning.authority.steady_tilt


def test_weights_make_a_butterworth_pattern_of_the_stated_bandwidth() -> None:
    """Without lag and the cost of moves, at a short period: four poles of x at radius w, two of z, two of yaw."""
    vehicle = next(each for each in ALL if each.name == "lopes2011")
    tuning = replace(design_for(vehicle), period=0.001, move_weight=1e-12)
    K = gain(vehicle, tuning)[:, :12]
    A, B = discretise(*continuous_model(vehicle), tuning.period)
    closed = A - B @ K
    for names, radius in (
        (("x", "vx", "pitch", "pitch_rate"), tuning.bandwidth),
        (("z", "vz"), tuning.height),
        (("yaw", "yaw_rate"), tuning.heading),
    ):
        chosen = [INDEX[name] for name in names]
        poles = np.log(np.linalg.eigvals(closed[np.ix_(chosen, chosen)])) / tuning.period
        np.testing.assert_allclose(np.abs(poles), radius, rtol=0.02)
        n = len(chosen)
        expected = np.sort([math.sin(math.pi * (2 * k + 1) / (2 * n)) for k in range(n)])
        np.testing.assert_allclose(np.sort(-poles.real / radius), expected, rtol=0.03)


def test_a_tilt_grows_in_the_air_by_munks_moment() -> None:
    """In a level glide at 8 m/s, rotors at hover: the plant's own pitch, against exp(p t) + exp(-p t) over 2."""
    vehicle = next(each for each in ALL if each.name == "random-16")
    rate = 8.0 * control_authority(vehicle).munk
    tilt = 1e-3
    with Plant(vehicle, effects=Effects(air=Air(body_drag=vehicle.body_drag))) as plant:
        start = make_state(position=(0.0, 0.0, 500.0), euler=(0.0, tilt, 0.0))
        start[INDEX["vx"]] = 8.0
        plant.reset(start)
        plant.advance(plant.vehicle.hover_speeds, 200)
        state = plant.state()
    assert state[INDEX["pitch"]] == pytest.approx(tilt * math.cosh(0.2 * rate), rel=0.02)


def test_a_figure_eight_keeps_below_the_speed_at_which_the_air_turns_the_vehicle() -> None:
    """Its speed, by the course that is flown, is 60 % of that at which p = w; else its acceleration is that of tilt."""
    for vehicle in [each for each in ALL if each.name == "random-16"] + ALL[::3]:
        tuning = design_for(vehicle)
        reference = first_scenario(vehicle, vehicle.name, course="figure-eight").to_data()["reference"]
        speed = math.sqrt(0.5) * reference["length"] * math.tau / reference["period"]
        assert speed <= 1.01 * SHARE * tuning.fastest
        ends = largest_eight(vehicle, tuning)[1]
        assert ends == ("speed" if vehicle.name == "random-16" else "tilt")
        if ends == "speed":
            assert speed == pytest.approx(SHARE * tuning.fastest, rel=0.01)
    assert control_authority(next(each for each in ALL if each.name == "lopes2011")).munk == 0.0


def test_a_delay_margin_is_where_a_simulated_loop_begins_to_grow() -> None:
    vehicle = next(each for each in ALL if each.name == "hummingbird")
    tuning = design_for(vehicle)
    K = gain(vehicle, tuning)
    margin = delay_margin(vehicle, tuning)
    step = 1e-3
    A, B = discretise(*continuous_model(vehicle, vehicle.rotor_rise or 0.0), step)

    def grows(delay: float) -> bool:
        x = np.zeros(len(A))
        acting = np.zeros(N_ROTORS)
        waiting = []
        x[INDEX["x"]] = 1.0
        last = np.zeros(N_ROTORS)
        peaks = []
        for i in range(8000):
            if i % round(tuning.period / step) == 0:
                last = -K @ np.concatenate([x, last])
                waiting.append((i + round(delay / step), last))
            while waiting and waiting[0][0] <= i:
                acting = waiting.pop(0)[1]
            x = A @ x + B @ acting
            peaks.append(abs(x[INDEX["pitch"]]))
        return max(peaks[6000:]) > max(peaks[2000:4000])

    assert is_stable(vehicle, tuning, K, 0.0)
    assert not grows(0.9 * margin)
    assert grows(1.1 * margin)


def test_a_vehicle_with_nothing_in_reserve_is_refused_and_one_with_little_is_not() -> None:
    vehicle = next(each for each in ALL if each.name == "hummingbird")
    with pytest.raises(ParameterError, match=r"vehicle\.speed_max"):
        design_for(replace(vehicle, speed_max=vehicle.hover_speed))
    little = design_for(replace(vehicle, speed_max=1.02 * vehicle.hover_speed))
    assert little.tilt == pytest.approx(little.authority.steady_tilt / 3.0)
    assert delay_margin(vehicle, little) > 0.0
