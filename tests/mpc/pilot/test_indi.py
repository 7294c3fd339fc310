"""INDI in an inner loop: nothing where the model holds, and torques that it does not know made up for."""

from __future__ import annotations

import math

import numpy as np
import pytest

from quadsim.controller import Phase, StepInputs
from quadsim.errors import CommandError
from quadsim.flight.log import FlightLog
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.laws.geometric import Geometric, GeometricController
from quadsim.mpc.pilot.allocation import allocate, make_allocation
from quadsim.mpc.pilot.indi import INDISettings, TorqueIncrement
from quadsim.mpc.pilot.pilot import Pilot
from quadsim.sim.effects import Disturbance, Effects
from quadsim.sim.effects.rotors import RotorDynamics
from quadsim.sim.loop import fly
from quadsim.sim.plant import Plant
from quadsim.state import INDEX, Array, make_state
from quadsim.vehicle import Vehicle

STEP = 0.002
OFFSET = (0.3, -0.2, 0.05)  # [N m]
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def turn(vehicle: Vehicle, torque: Array, duration: float, cutoff: float = 30.0) -> tuple[Array, Array]:
    """Rates after a while of constant commands, with the inner loop and as the model has it; exact but for Euler."""
    J = np.array(vehicle.inertia)
    M = vehicle.allocation
    loop = TorqueIncrement(vehicle, INDISettings(cutoff=cutoff), ActuatorBounds.of_vehicle(vehicle))
    commanded = vehicle.hover_speed + np.array([1.0, -0.5, -0.5, 0.5])
    rates = np.array([0.4, 0.2, -0.3])
    modelled = np.array([0.4, 0.2, -0.3])
    rotors = commanded
    for k in range(round(duration / STEP)):
        rotors = loop.speeds(k * STEP, commanded, rates, rotors, LEVEL)
        for _ in range(20):
            rates = rates + STEP / 20 * ((M @ rotors**2)[1:] + torque - np.cross(rates, J * rates)) / J
            modelled = modelled + STEP / 20 * ((M @ commanded**2)[1:] - np.cross(modelled, J * modelled)) / J
    return rates, modelled


def test_a_vehicle_as_modelled_flies_the_commanded_speeds(vehicle: Vehicle) -> None:
    rates, modelled = turn(vehicle, np.zeros(3), 0.5)
    np.testing.assert_allclose(rates, modelled, atol=1e-3 * np.abs(modelled).max())


def test_an_unknown_torque_is_made_up_for_within_the_filter_s_time(vehicle: Vehicle) -> None:
    """What is left is the rate gained before the filter follows: torque / J times its delay, 2 zeta / omega."""
    torque = np.array(OFFSET)
    delay = math.sqrt(2.0) / (2.0 * math.pi * 30.0)
    rates, modelled = turn(vehicle, torque, 0.3)
    gained = torque / np.array(vehicle.inertia) * (delay + STEP)
    np.testing.assert_allclose(rates - modelled, gained, rtol=0.3, atol=0.01 * np.abs(gained).max())
    later, modelled_later = turn(vehicle, torque, 0.5)
    np.testing.assert_allclose(later - modelled_later, rates - modelled, atol=0.1 * np.abs(gained).max())


def flown(vehicle: Vehicle, effects: Effects, settings: INDISettings | None, periods: int = 50) -> FlightLog:
    law = GeometricController(vehicle, 0.05, Geometric())
    inner = None if settings is None else TorqueIncrement(vehicle, settings, law.bounds)
    controller = Pilot(law, vehicle, inner=inner)
    with Plant(vehicle, effects=effects, limit_speeds=True) as plant:
        return fly(
            plant,
            controller,
            np.tile([0.0, 0.0, 5.0, 0.0], (periods + law.horizon, 1)),
            initial_state=make_state(position=(0.0, 0.0, 5.0)),
            initial_speeds=plant.vehicle.hover_speeds,
            periods=periods,
            steps_per_period=50,
        )


@pytest.mark.parametrize("rotors", [None, RotorDynamics(rise=0.02, fall=0.02)])
def test_a_constant_torque_moves_a_hovering_vehicle_a_tenth_as_far(
    vehicle: Vehicle, rotors: RotorDynamics | None
) -> None:
    effects = Effects(disturbance=Disturbance(torque=OFFSET), rotors=rotors)
    paths = [
        log.control.truth[:, [INDEX["x"], INDEX["y"]]]
        for log in (flown(vehicle, effects, None), flown(vehicle, effects, INDISettings()))
    ]
    alone, aided = (np.linalg.norm(path, axis=1).max() for path in paths)
    assert aided < 0.1 * alone


def test_the_log_has_the_law_s_commands_and_the_speeds_that_rotors_had(vehicle: Vehicle) -> None:
    log = flown(vehicle, Effects(disturbance=Disturbance(torque=OFFSET)), INDISettings(rate=200.0), periods=20)
    within = log.plant.speeds[500:550]
    np.testing.assert_array_equal(within[0::5], within[4::5])
    assert len(np.unique(within[:, 0])) > 5
    desired = (vehicle.allocation @ within[-1] ** 2 - vehicle.allocation @ log.control.speeds[10] ** 2)[1:]
    np.testing.assert_allclose(desired, -np.array(OFFSET), atol=0.05 * max(OFFSET))


def test_an_undisturbed_flight_is_nearly_the_one_without(vehicle: Vehicle) -> None:
    alone, aided = (flown(vehicle, Effects(), settings, periods=20) for settings in (None, INDISettings()))
    np.testing.assert_allclose(aided.control.truth, alone.control.truth, atol=1e-9)


def test_on_the_ground_there_is_no_inner_loop(vehicle: Vehicle) -> None:
    law = GeometricController(vehicle, 0.05, Geometric())
    controller = Pilot(law, vehicle, inner=TorqueIncrement(vehicle, INDISettings(), law.bounds))
    preview = np.zeros((law.horizon, 4))
    assert controller.step(StepInputs(phase=Phase.LANDED), make_state(), preview).inner is None
    assert controller.step(StepInputs(), make_state(), preview).inner is not None
    assert (controller.name, controller.horizon, controller.infeasible_period) == ("geometric", 10, None)


def test_a_rate_that_is_no_whole_number_of_steps_ends_the_flight(vehicle: Vehicle) -> None:
    """A scenario with such a rate is refused when it is read."""
    log = flown(vehicle, Effects(), INDISettings(rate=300.0), periods=1)
    assert log.aborted
    assert "controller.inner.rate must be such that 1 / rate is a whole multiple" in str(log.reason)


def test_a_command_that_is_no_number_is_refused(vehicle: Vehicle) -> None:
    """The allocation makes no numbers of it."""
    inner = TorqueIncrement(vehicle, INDISettings(rate=1000.0), ActuatorBounds.of_vehicle(vehicle))
    with Plant(vehicle) as plant:
        struct = inner.engage(np.array([math.nan, 200.0, 200.0, 200.0]), plant.speeds)
        assert struct is not None
        struct.stride = 1
        plant.begin(1)
        with pytest.raises(CommandError, match="finite"):
            plant.hold(np.zeros(4), 1, loop=struct)


def test_it_answers_as_its_equations_do(vehicle: Vehicle) -> None:
    """A torque tau(u) + y; y'' = omega^2 (missed - y) - 2 zeta omega y', implicit, with missed at the middle rates."""
    rng = np.random.default_rng(1)
    J = np.array(vehicle.inertia)
    omega = 2.0 * math.pi * 30.0
    bounds = ActuatorBounds.of_vehicle(vehicle)
    loop = TorqueIncrement(vehicle, INDISettings(cutoff=30.0), bounds)
    filtered = np.zeros(3)
    slope = np.zeros(3)
    last = None
    for k in range(100):
        commanded, rotors = vehicle.hover_speed + rng.uniform(-10.0, 10.0, (2, 4))
        rates = rng.normal(size=3)
        if last is not None:
            middle = 0.5 * (rates + last)
            missed = (vehicle.allocation @ rotors**2)[1:] - J * (rates - last) / STEP - np.cross(middle, J * middle)
            damped = 1.0 + math.sqrt(2.0) * omega * STEP + (omega * STEP) ** 2
            slope = (slope + STEP * omega**2 * (missed - filtered)) / damped
            filtered = filtered + STEP * slope
        last = rates
        wrench = vehicle.allocation @ commanded**2 + np.concatenate([[0.0], filtered])
        expected = allocate(make_allocation(vehicle), wrench, bounds.u_min, bounds.u_max)
        answer = loop.speeds(k * STEP, commanded, rates, rotors, LEVEL)
        np.testing.assert_allclose(answer, expected, rtol=1e-9)
