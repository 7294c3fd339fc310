"""The fit: on own logs with known truth its intervals hold it, and its gates refuse what a log does not show."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

import quadsim
from quadsim.errors import InputError
from quadsim.features.identify.estimate import Identification, ParameterEstimate
from quadsim.features.identify.fit import identify_records
from quadsim.features.identify.intervals import MAX_AUTOCORRELATION
from quadsim.features.identify.judgement import JudgedFit
from quadsim.features.identify.model import prepare_segment
from quadsim.features.identify.prediction import predict
from quadsim.features.identify.record import Record, to_record
from quadsim.features.identify.rotors import lagged_rotors
from quadsim.features.identify.search import Search, _polynomial
from quadsim.features.identify.series import Column
from quadsim.features.identify.windows import to_world
from quadsim.rollout.flown import Flight
from quadsim.rotation import conjugate, euler_to_body_rates, euler_to_quaternion
from quadsim.sim.airframe import munk_moment
from quadsim.state import ANGLE_RATES, ANGLES, POSITIONS, VELOCITIES, Array
from quadsim.vehicle import Vehicle

pytestmark = pytest.mark.slow("identification")

TRUE = replace(quadsim.load_vehicle("hummingbird"), rotor_rise=0.03, rotor_fall=0.04)
START = replace(
    TRUE,
    thrust_coefficient=1.2 * TRUE.thrust_coefficient,
    inertia=(0.012, 0.005, 0.013),
    drag_to_thrust=0.6 * TRUE.drag_to_thrust,
    rotor_rise=0.02,
    rotor_fall=0.02,
    rotor_inertia=5e-6,
    rotor_drag=None,
    body_drag=None,
)
MOMENTS = {
    **{"rotor_moment": (1.6e-5, 2.4e-5), "inflow_moment": (0.01, 0.018)},
    **{"rate_damping": (0.012, 0.02, 0.006)},
}
"""Of rotors whose discs flap, the less in a climb, and whose drag acts above the centre of mass."""
INFLOW = 1.5e-4
"""Of rotors that lose 4 % of the weight's thrust per m/s of climb."""
SENSORS = {
    "position": {"rate": 100.0, "noise": 0.003},
    "velocity": {"rate": 100.0, "noise": 0.03},
    "attitude": {"rate": 100.0, "noise": 0.3},
    "rates": {"rate": 100.0, "noise": 1.5},
}


@cache
def flown(*, course: str = "figure-eight", torque: float = 0.0, offset: float = 0.0, air: bool = False) -> Flight:
    """Some 16 s at 100 Hz, a figure eight with yaw steps or hover, by geometric control.

    In wind, or in still air that turns the rotors, damps (`MOMENTS`) and costs thrust in a climb (`INFLOW`).
    """
    first = quadsim.scenario(vehicle="hummingbird", course=course, controller="geometric").scenario
    changes: dict[str, Any] = {
        "control_period": 0.01,
        "constraints": [],
        "seed": 3,
        "vehicle.rotor_rise": TRUE.rotor_rise,
        "vehicle.rotor_fall": TRUE.rotor_fall,
        "sensors": SENSORS,
        **(
            {f"vehicle.{name}": [*value] for name, value in MOMENTS.items()} | {"vehicle.inflow": INFLOW}
            if air
            else {"effects.air.wind": [0.8, -0.5, 0.0]}
        ),
    }
    if course == "hover":
        changes["duration"] = 12.0
    else:
        changes["reference.turns"] = 4.0
        changes["events"] = [{"type": "setpoint", "at": 1.6 + 0.8 * i, "yaw": 25.0 * (-1) ** i} for i in range(15)]
    if torque:
        changes["effects.disturbance"] = {"torque_noise": torque}
    if offset:
        changes["effects.load"] = {"mass": 1e-9, "centre_of_mass": [offset, 0.0, 0.0]}
    return quadsim.fly(first.replace(changes), progress=False)


def record_of(flight: Flight, name: str = "log") -> Record:
    """What its sensors and its commands say."""
    log = flight.log.control
    angles = log.state[:, ANGLES]
    return Record(
        name=name,
        t=log.t,
        position=log.state[:, POSITIONS],
        velocity=log.state[:, VELOCITIES],
        attitude=euler_to_quaternion(angles),
        rates=euler_to_body_rates(angles, log.state[:, ANGLE_RATES]),
        commands=log.speeds,
    )


def identify(record: Record, start: Vehicle = START, *, wind: bool = True) -> Identification:
    return identify_records([record], [[slice(0, len(record.t))]], start, wind=wind)


@cache
def of_the_eight() -> Identification:
    return identify(record_of(flown()))


def by_name(found: Identification) -> dict[str, ParameterEstimate]:
    return {estimate.name: estimate for estimate in found.estimates}


def truth(**others: float) -> dict[str, float]:
    inertia = {f"inertia_{axis}": value for axis, value in zip("xyz", TRUE.inertia, strict=True)}
    drag = {"body_drag": (TRUE.body_drag or (0.0,))[0]}
    still = {f"{name}_{axis}": 0.0 for name, of in MOMENTS.items() for axis in "xyz"[: len(of)]}
    still |= {"inflow": 0.0}
    still |= dict(zip(("inflow_moment_x", "inflow_moment_y"), munk_moment(TRUE.body_drag or (), 1.225), strict=True))
    none = dict.fromkeys(("delay", "lateness", "offset_x", "offset_y"), 0.0)
    return {**vars(TRUE), **none, **still, **inertia, **drag, **others}


def wrong(found: Identification, **others: float) -> list[str]:
    """Names of the parameters that pass their gates without holding the truth."""
    true = truth(**others)
    return [e.name for e in found.estimates if not e.refused and not e.low <= true[e.name] <= e.high]


def test_rotors_lag_as_the_plant_s_do() -> None:
    log = flown().log
    rotors = lagged_rotors(log.control.speeds, 0.01, rise=0.03, fall=0.04, delay=0.0)
    stride = (len(log.plant.t) - 1) // len(log.control.t)
    settled = slice(100, len(log.control.t))  # they begin at another speed
    assert rotors.speeds[settled] == pytest.approx(log.plant.speeds[::stride][settled], abs=1e-9)
    middles = 0.5 * (log.plant.speeds[1:] + log.plant.speeds[:-1]).reshape(-1, stride, 4)
    assert rotors.mean[100:] == pytest.approx(middles.mean(axis=1)[100:-1], rel=1e-3)
    assert rotors.square[100:] == pytest.approx(np.square(middles).mean(axis=1)[100:-1], rel=3e-3)


@pytest.mark.representative("identification")
@pytest.mark.parametrize("delay", [0.004, 0.01, 0.013, -0.01])
def test_a_delay_shifts_what_rotors_do(delay: float) -> None:
    commands = 450.0 + 50.0 * np.random.default_rng(0).standard_normal((60, 4))
    fine = np.repeat(commands, 10, axis=0)
    shifted = fine[np.clip(np.arange(len(fine)) - round(1000.0 * delay), 0, len(fine) - 1)]
    late = lagged_rotors(commands, 0.01, rise=0.03, fall=0.04, delay=delay)
    assert late.speeds[30:-5] == pytest.approx(
        lagged_rotors(shifted, 0.001, rise=0.03, fall=0.04, delay=0.0).speeds[::10][30:-5], rel=1e-4
    )


@pytest.mark.representative("identification")
def test_a_polynomial_of_reflection_coefficients_is_stable_and_complete() -> None:
    assert _polynomial(np.array([0.5, -0.3])) == pytest.approx([1.0, 0.5 * 0.7, -0.3])
    for reflections in np.random.default_rng(0).uniform(-1.0, 1.0, (50, 4)):
        assert np.abs(np.roots(_polynomial(reflections))).max() < 1.0


def test_an_eight_with_yaw_steps_gives_all_but_the_body_s_drag() -> None:
    found = of_the_eight()
    assert not wrong(found)
    refused = [e.name for e in found.estimates if e.refused]
    assert {name for name in refused if not name.startswith("rate_damping")} <= {"body_drag", "inflow"}
    known = by_name(found)
    for name, most in {"thrust_coefficient": 0.01, "inertia_x": 0.02, "inertia_y": 0.03, "rotor_rise": 0.1}.items():
        assert known[name].high / known[name].low - 1.0 < 2.0 * most
    assert found.vehicle.inertia == (known["inertia_x"].value, known["inertia_y"].value, known["inertia_z"].value)
    assert found.vehicle.body_drag is None
    assert max(found.whiteness.values()) < 0.15


def test_a_torque_that_the_loop_answers_does_not_bias_the_estimate() -> None:
    found = identify(record_of(flown(torque=0.01)))
    assert not wrong(found)
    assert not by_name(found)["inertia_x"].refused


def test_moments_of_the_air_and_damping_are_found_and_stated() -> None:
    """The same flight without them in the model, by a start that has none, is no vehicle that predicts."""
    found = identify(record_of(flown(air=True)), wind=False)
    moments = {f"{name}_{axis}": v for name, of in MOMENTS.items() for axis, v in zip("xyz", of, strict=False)}
    assert not wrong(found, **moments, inflow=INFLOW)
    known = by_name(found)
    assert not known["inflow"].refused
    assert known["inflow"].high - known["inflow"].low < 0.5 * INFLOW
    assert found.vehicle.inflow == pytest.approx(INFLOW, rel=0.15)
    turned = [f"{name}_{axis}" for name in ("inertia", "rotor_moment", "inflow_moment") for axis in "xy"]
    assert not [name for name in turned if known[name].refused]
    assert found.vehicle.rotor_moment == pytest.approx(MOMENTS["rotor_moment"], rel=0.1)
    assert found.vehicle.inflow_moment == pytest.approx(MOMENTS["inflow_moment"], rel=0.2)


def test_hover_refuses_yaw_and_drag_and_says_what_to_fly() -> None:
    found = identify(record_of(flown(course="hover")))
    assert not wrong(found)
    known = by_name(found)
    assert not known["thrust_coefficient"].refused
    for name in ("inertia_z", "drag_to_thrust", "rotor_inertia", "rotor_drag"):
        assert known[name].refused.startswith(("not excited", "rests on a rule of thumb"))
        assert known[name].advice
    kept = found.vehicle
    assert (kept.inertia[2], kept.rotor_inertia) == (START.inertia[2], START.rotor_inertia)
    assert kept.rotor_drag == pytest.approx(TRUE.rotor_drag, rel=0.7)  # which the start lacks: a rough one is better


def test_the_gate_judges_the_final_interval() -> None:
    """What a later search moves far is not identified."""
    record = record_of(flown())
    search = Search([prepare_segment(record, 0)], START, wind=False)
    search.run()
    judgement = JudgedFit(search, {})
    assert not judgement.estimates["inertia_x"].refused
    assert judgement.refuse_moved(search) == {}
    moved = Search(search.segments, START, wind=False)
    moved.adopt(search)
    moved.x[[number.name for number in search.free].index("inertia_x")] += 0.4
    held = judgement.refuse_moved(moved)
    assert "inertia_x" not in held  # the log contradicts the start
    refused = judgement.estimates["inertia_x"]
    assert refused.refused.startswith("not excited: the interval is +-")
    assert refused.advice
    assert refused.low < search.free[1].value(search.x[1]) < refused.high


@pytest.mark.parametrize("late", [1, -1])
def test_commands_that_are_logged_late_or_early_are_seen_as_a_delay(late: int) -> None:
    record = record_of(flown())
    assert record.commands is not None
    shifted = record.commands[np.clip(np.arange(len(record.t)) - late, 0, len(record.t) - 1)]
    found = identify(replace(record, commands=shifted))
    assert not wrong(found, delay=-0.01 * late)
    assert by_name(found)["delay"].value == pytest.approx(-0.01 * late, abs=1e-3)


def throttled(record: Record) -> tuple[Array, Array]:
    """Throttle and voltage that give the record's commands, by 0.3 u + 0.7 u^2 of full thrust at 15 V, over V^2."""
    assert record.commands is not None
    voltage = np.linspace(16.0, 14.0, len(record.t))
    share = np.square(record.commands / START.speed_max) / np.square(voltage / voltage.mean())[:, None]
    return (np.sqrt(0.3**2 + 4.0 * 0.7 * share) - 0.3) / (2.0 * 0.7), voltage


def test_throttle_alone_shows_thrust_only_for_the_highest_speed_as_kept() -> None:
    record = record_of(flown())
    throttle, _ = throttled(record)
    start = replace(START, speed_max=1.3 * START.speed_max)
    found = identify(replace(record, commands=None, throttle=throttle), start)
    assert len(wrong(found, throttle_curve=0.7)) <= 1  # of 17 intervals of 95 %
    known = by_name(found)
    for name in ("thrust_coefficient", "rotor_inertia", "rotor_drag"):
        assert "1089.4 rad/s" in known[name].refused
    assert "voltage_exponent" not in known
    full = found.vehicle.thrust_coefficient * start.speed_max**2
    assert full == pytest.approx(TRUE.thrust_coefficient * START.speed_max**2, rel=0.15)


def test_a_lag_that_nothing_shows_takes_the_inertia_with_it() -> None:
    """A hover of which 4 s are logged: without the rotors' speeds they cannot be distinguished."""
    record = record_of(flown(course="hover"))
    found = identify_records([record], [[slice(0, 420)]], START, wind=True)
    known = by_name(found)
    assert not wrong(found)
    lags = [known[name].refused for name in ("rotor_rise", "rotor_fall")]
    assert any(lags) == all(known[f"inertia_{axis}"].refused for axis in "xyz")


def test_measured_speeds_take_the_place_of_commands() -> None:
    record = record_of(flown())
    assert record.commands is not None
    rotors = lagged_rotors(record.commands, 0.01, rise=0.03, fall=0.04, delay=0.0)
    speeds = rotors.speeds + np.random.default_rng(0).standard_normal(rotors.speeds.shape)
    alone = identify(replace(record, commands=None, speeds=speeds))
    assert not wrong(alone)
    assert "not their commands" in by_name(alone)["rotor_rise"].refused


def test_throttle_and_speeds_give_the_rotors_answer_and_then_the_forces() -> None:
    """The speeds are those of a battery that sags, of which the forces know nothing."""
    record = record_of(flown())
    throttle, voltage = throttled(record)
    assert record.commands is not None
    rotors = lagged_rotors(record.commands, 0.01, rise=0.03, fall=0.04, delay=0.0)
    found = identify(replace(record, commands=None, throttle=throttle, voltage=voltage, speeds=rotors.speeds))
    assert not wrong(found, throttle_curve=0.7, voltage_exponent=2.0)
    known = by_name(found)
    names = ("rotor_rise", "rotor_fall", "throttle_curve", "voltage_exponent", "thrust_coefficient", "inertia_x")
    assert not [name for name in names if known[name].refused]
    assert found.vehicle.rotor_fall == pytest.approx(0.04, rel=0.03)
    assert found.voltage == pytest.approx(15.0)


def test_an_accelerometer_takes_the_place_of_velocity() -> None:
    """Its noise is that of a cheap one."""
    flight = flown(air=True)
    record = record_of(flight)
    log = flight.log
    stride = (len(log.plant.t) - 1) // len(log.control.t)
    state = log.plant.state
    step = log.plant.t[1] - log.plant.t[0]
    change = np.gradient(state[:, VELOCITIES], step, axis=0)[:-1:stride]
    change[:, 2] += TRUE.gravity
    force = to_world(conjugate(euler_to_quaternion(state[:-1:stride, ANGLES])), change)
    force += 0.1 * np.random.default_rng(0).standard_normal(force.shape)
    fields = ("attitude", "rates", "commands")
    series = {name: Column(t=record.t, values=np.asarray(getattr(record, name))) for name in fields}
    read = to_record("imu", series | {"specific_force": Column(t=record.t, values=force)})
    assert read.inertial
    (note,) = read.notes
    assert note.startswith("imu: no velocity is logged")
    found = identify(read)
    moments = {f"{name}_{axis}": v for name, of in MOMENTS.items() for axis, v in zip("xyz", of, strict=False)}
    assert not wrong(found, **moments, inflow=INFLOW)
    known = by_name(found)
    assert not [name for name in ("thrust_coefficient", "inertia_x", "inertia_y") if known[name].refused]
    errors = predict([read], [[slice(100, 900)]], found, START).errors["identified"]
    assert np.isnan(errors[:, :2]).all()
    assert np.isfinite(errors[:, 2:]).all()
    for corrupted, why in ((force / 9.81, "likely in g"), (-force, "likely z points down")):
        with pytest.raises(InputError, match=why):
            to_record("imu", series | {"specific_force": Column(t=record.t, values=corrupted)})


def test_two_logs_are_fitted_together_and_narrow_the_intervals() -> None:
    whole = record_of(flown())
    half = len(whole.t) // 2
    spans = [slice(0, half), slice(half, len(whole.t))]
    both = identify_records([whole], [spans], START, wind=True)
    first = identify_records([whole], [spans[:1]], START, wind=True)
    assert not wrong(both)
    assert not wrong(first)
    width = [by_name(found)["inertia_x"].high / by_name(found)["inertia_x"].low for found in (both, first)]
    assert width[0] < width[1]
    without = replace(whole, name="other", commands=None, speeds=whole.commands)
    with pytest.raises(InputError, match="log, other"):
        identify_records([whole, without], [spans, spans], START)


def test_noise_that_is_not_modelled_widens_the_interval() -> None:
    record = record_of(flown())
    n = np.arange(len(record.t))
    ringing = 0.5 * np.sin(2.0 * np.pi * 7.0 * record.period * n) * (1.0 + 0.5 * np.sin(0.05 * n))
    rates = record.rates + lfilter([0.2], [1.0, -0.8], ringing)[:, None] * [1.0, 0.0, 0.0]
    found = identify(replace(record, rates=rates))
    assert not wrong(found)
    ringing_width, width = (
        known["inertia_x"].high - known["inertia_x"].low for known in map(by_name, (found, of_the_eight()))
    )
    assert found.whiteness["roll"] > MAX_AUTOCORRELATION > of_the_eight().whiteness["roll"]
    assert ringing_width > width


def test_a_log_without_noise_gives_what_is_right() -> None:
    """Its innovations are tiny and far from white; they are what interpolation leaves."""
    log = flown(air=True).log
    stride = (len(log.plant.t) - 1) // len(log.control.t)
    state = log.plant.state[:-1:stride]
    record = replace(
        record_of(flown(air=True)),
        position=state[:, POSITIONS],
        velocity=state[:, VELOCITIES],
        attitude=euler_to_quaternion(state[:, ANGLES]),
        rates=euler_to_body_rates(state[:, ANGLES], state[:, ANGLE_RATES]),
    )
    found = identify(record, wind=False)
    moments = {f"{name}_{axis}": v for name, of in MOMENTS.items() for axis, v in zip("xyz", of, strict=False)}
    assert not wrong(found, **moments, inflow=INFLOW)
    known = by_name(found)
    for name in ("thrust_coefficient", "inertia_x", "inertia_y", "rotor_moment_x", "rotor_moment_y"):
        assert not known[name].refused
    assert found.vehicle.thrust_coefficient == pytest.approx(TRUE.thrust_coefficient, rel=2e-3)
