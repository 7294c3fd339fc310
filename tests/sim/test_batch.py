"""Vehicles flown together: the bits of single flights, margins as the audit has them, and each its own end."""

from __future__ import annotations

import math

import numpy as np
import pytest

import quadsim
from quadsim.core.inner import CompiledLoop
from quadsim.flight.audit import SIGNALS, Limit
from quadsim.rollout.rollout import Rollout
from quadsim.sim.autopilot import Autopilot
from quadsim.sim.batch import PlantBatch
from quadsim.sim.effects import Disturbance, Effects, Push, ThrustNoise, push_changes
from quadsim.sim.effects.rotors import LagChange, RotorDynamics
from quadsim.sim.effects.wind import Air, WindField
from quadsim.sim.margins import Margins
from quadsim.sim.physics import one_period
from quadsim.sim.plant import Plant
from quadsim.state import Array, make_state

VEHICLE = quadsim.load_vehicle("hummingbird")
STEPS = 50
PERIODS = 12


def pushing(time: float, state: Array) -> Array:
    """A force of the user, which the state turns round."""
    return np.array([0.1 * math.sin(time), -0.2 * state[0], 0.0, 0.0, 0.0, 1e-4])


def make_plant(kind: int) -> Plant:
    """One of several vehicles: still air or wind, noise, events within periods, a user's force, both integrators."""
    lag = Effects(rotors=RotorDynamics(rise=0.03, fall=0.05, inertia=0.0))
    rng = np.random.default_rng(kind)
    if kind == 0:
        return Plant(VEHICLE, integrator="rk4", limit_speeds=True)
    if kind == 1:
        return Plant(VEHICLE, effects=lag, limit_speeds=True)
    if kind == 2:
        noisy = Effects(thrust_noise=ThrustNoise(loss=0.05, deviation=0.1), disturbance=Disturbance(force_noise=0.02))
        return Plant(VEHICLE, effects=noisy, integrator="rk4", rng=rng)
    if kind == 3:
        air = Effects(air=Air(rotor_drag=1e-5, wind=(1.0, 0.5, 0.0))).resolved(VEHICLE)
        wind = WindField(mean=(1.0, 0.5, 0.0), timestep=1e-3, rng=rng)
        return Plant(VEHICLE, effects=air, wind=wind)
    push = Push(at=0.1234, duration=0.2, force=(0.5, 0.0, 0.1), point=(0.05, 0.0, 0.0))
    changes = [*push_changes([push]), LagChange(at=0.33, rise=0.05, fall=0.05)]
    if kind == 4:
        return Plant(VEHICLE, effects=lag, changes=changes, integrator="rk4")
    return Plant(VEHICLE, effects=lag, changes=changes, forces=(pushing,))


KINDS = 6


def start_of(place: int) -> Array:
    return make_state(position=(0.1 * place, 0.0, 1.0), euler=(0.05, -0.1, 0.3 * place))


def make_loop(place: int) -> CompiledLoop | None:
    return Autopilot(VEHICLE) if place % 2 else None


def command_of(place: int, period: int) -> Array:
    """A target of the autopilot, or speeds."""
    turn = 0.5 * math.sin(place + period)
    if place % 2:
        return np.array([VEHICLE.mass * VEHICLE.gravity * (1.0 + 0.1 * turn), turn, -turn, 0.2])
    speeds: Array = VEHICLE.hover_speeds * (1.0 + 0.02 * turn * np.array([1.0, -1.0, 0.5, 0.0]))
    return speeds


def single(place: int) -> Array:
    """(PERIODS, STEPS, 14) MuJoCo's states of a flight by itself."""
    with make_plant(place % KINDS) as plant:
        plant.reset(start_of(place), VEHICLE.hover_speeds)
        loop = make_loop(place)
        rows = []
        for period in range(PERIODS):
            command = command_of(place, period)
            struct = None if loop is None else loop.engage(command, plant.speeds)
            if struct is not None:
                struct.stride = 1
            plant.begin(STEPS)
            plant.hold(command, STEPS, loop=struct)
            rows.append(plant.flown["physics"].copy())
        return np.stack(rows)


def flown_together(places: int, threads: int) -> Array:
    """(places, PERIODS, STEPS, 14) the same of flights together."""
    batch = PlantBatch(places, steps=STEPS, threads=threads)
    for place in range(places):
        batch.put(place, make_plant(place % KINDS), start_of(place), VEHICLE.hover_speeds, loop=make_loop(place))
    rows = np.empty((places, PERIODS, STEPS, 14))
    for period in range(PERIODS):
        commands = np.stack([command_of(place, period) for place in range(places)])
        assert batch.fly(commands) == {}
        for place in range(places):
            rows[place, period] = batch.flown(place)["physics"]
    batch.close()
    return rows


def test_flights_together_have_the_bits_of_single_ones_for_any_number_of_threads() -> None:
    places = 2 * KINDS
    alone = np.stack([single(place) for place in range(places)])
    for threads in (1, 2, 5, 20):
        assert np.array_equal(flown_together(places, threads), alone)
    assert np.array_equal(flown_together(3, 1), alone[:3])


def test_states_and_commands_are_those_of_the_plant() -> None:
    batch = PlantBatch(2, steps=STEPS)
    for place in range(2):
        batch.put(place, make_plant(0), start_of(place), VEHICLE.hover_speeds, loop=make_loop(1))
    turning = np.tile([VEHICLE.mass * VEHICLE.gravity, 0.0, 0.0, 2.0], (2, 1))
    for _ in range(60):  # a whole turn
        batch.fly(turning)
        for place in range(2):
            assert np.array_equal(batch.state[place], batch.plant(place).state())
            assert np.array_equal(batch.acting[place], batch.flown(place)["commands"][-1])
    assert batch.state[0, 10] > 5.0
    batch.close()


def test_what_ends_one_flight_ends_no_other() -> None:
    batch = PlantBatch(4, steps=STEPS, threads=2)
    for place in range(4):
        batch.put(place, make_plant(place % 2), start_of(place), VEHICLE.hover_speeds)
    commands = np.tile(VEHICLE.hover_speeds, (4, 1))
    commands[1, 2] = np.nan
    commands[2] = 9e5  # 1e10 N: no speed limit there
    batch.put(2, Plant(VEHICLE, integrator="rk4"), start_of(2), VEHICLE.hover_speeds)
    ended = batch.fly(commands)
    assert sorted(ended) == [1, 2]
    assert "not finite" in str(ended[1])
    assert "diverged" in str(ended[2])
    flying = np.array([True, False, False, True])
    assert batch.fly(np.tile(VEHICLE.hover_speeds, (4, 1)), flying) == {}
    assert [batch.plant(place).time for place in (0, 3)] == pytest.approx([0.1, 0.1])
    assert batch.plant(1).time == 0.0
    batch.put(2, make_plant(0), start_of(0), VEHICLE.hover_speeds)
    assert batch.fly(np.tile(VEHICLE.hover_speeds, (4, 1)), ~flying) == {}
    assert np.isfinite(batch.state).all()
    batch.close()


def of_every_signal() -> list[Limit]:
    """Limits of all signals but the climb acceleration, which Python computes from the velocities of a log."""
    names = SIGNALS.keys() - {"climb_acceleration"}
    limits = [Limit(name=name, signal=name, lower=-0.5, upper=2.0) for name in SIGNALS if name in names]
    limits.append(Limit(name="sum", signal="sum", terms={"x": 1.0, "yaw_rate": 0.5, "speed_2": -0.1}, upper=3.0))
    limits.append(Limit(name="window", signal="z", upper=1.0, start=0.2, stop=0.33))
    limits.append(Limit(name="later", signal="slew", upper=1.0, start=0.5))
    return limits


@pytest.mark.parametrize("name", ["motion-capture", "autopilot", "hummingbird-figure-eight"])
def test_the_cores_margins_are_the_audits(name: str) -> None:
    """Of every signal, in every period of a flight."""
    limits = of_every_signal()
    scenario = quadsim.load(name).replace({"duration": 1.0})
    with Rollout(scenario) as flight:
        timestep = scenario.plant.timestep
        margins = Margins(limits, timestep)
        assert margins.compiled
        while not flight.done:
            period = flight.step()
            log = one_period(period, timestep)
            smallest, at_end = margins.of_period(period)
            for i, limit in enumerate(limits):
                t, values = limit.source.finest(log)
                expected = np.where(limit.holds_at(t), limit.margin(values), np.inf)
                expected = np.where(np.isnan(expected), np.inf, expected)  # a thrust that nobody demands
                expected = expected if limit.source.plant is None else expected[1:]
                assert smallest[i] == pytest.approx(expected.min(), rel=1e-12, abs=1e-9), limit.name
                assert at_end[i] == pytest.approx(expected[-1], rel=1e-12, abs=1e-9), limit.name


def test_margins_of_a_batch_are_those_of_its_flights() -> None:
    """A place's own limits, with reference and measured state as they are given."""
    limits = of_every_signal()
    margins = Margins(limits, 1e-3)
    batch = PlantBatch(3, steps=STEPS, limits=len(limits))
    for place in range(3):
        loop = make_loop(place)
        batch.put(place, make_plant(place), start_of(place), VEHICLE.hover_speeds, loop=loop, margins=margins)
    signal = [limit.signal for limit in limits]
    assert batch.smallest[1, signal.index("z")] == pytest.approx(1.0)
    assert np.isinf(batch.smallest[:, signal.index("slew")]).all()
    for period in range(4):
        batch.reference[:] = 0.1 * period
        batch.measured[:] = batch.state + 0.01
        before = batch.state.copy()
        acting = batch.acting.copy()
        batch.fly(np.stack([command_of(place, period) for place in range(3)]))
        heights = np.stack([batch.flown(place)["physics"][:, 3] for place in range(3)])
        expected = np.minimum(heights + 0.5, 2.0 - heights)
        assert np.array_equal(batch.smallest[:, signal.index("z")], expected.min(axis=1))
        assert np.array_equal(batch.at_end[:, signal.index("z")], expected[:, -1])
        error = before[:, 0] - 0.1 * period
        assert batch.smallest[:, signal.index("x_error")] == pytest.approx(np.minimum(error + 0.5, 2.0 - error))
        assert batch.smallest[:, signal.index("x_estimate_error")] == pytest.approx(0.51)
        slews = batch.acting - acting
        worst = np.minimum(slews + 0.5, 2.0 - slews).min(axis=1)
        assert np.array_equal(batch.smallest[:, signal.index("slew")], worst)
        assert np.isinf(batch.smallest[:, signal.index("thrust")]).tolist() == [True, False, True]
    batch.close()
