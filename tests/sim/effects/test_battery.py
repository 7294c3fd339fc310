"""The battery against closed forms: charge, voltage, energy, and the thrust that a voltage leaves."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy_laws import discharge, open_circuit

from quadsim.assets import vehicle_path
from quadsim.sim.effects import Disturbance, Effects, ThrustNoise
from quadsim.sim.effects.battery import EFFICIENCY, Battery
from quadsim.sim.effects.load import PayloadPickup
from quadsim.sim.effects.rotors import RotorChange, RotorDynamics
from quadsim.sim.physics import Integrator
from quadsim.sim.plant import Plant
from quadsim.state import N_STATES, Array
from quadsim.vehicle import Vehicle, load_vehicle

SMALL = Battery(
    cells=4, capacity=0.01, resistance=0.05, hover_current=40.0, idle_current=0.5, reference_voltage=16.0, charge=0.9
)
TIMESTEP = 1e-3


def discharged(battery: Battery, demand: float, steps: int) -> tuple[Array, float]:
    """Voltage and charge (steps, 2) under a constant demand, and the charge after it."""
    return discharge(battery, battery.charge, [demand] * steps, TIMESTEP)


def currents(battery: Battery, charges: Array) -> Array:
    """The charge that left in each step, as a current [A]."""
    drawn: Array = -np.diff(charges) * 3600.0 * battery.capacity / TIMESTEP
    return drawn


def test_a_constant_current_drains_linearly_and_ends_at_zero() -> None:
    idle = replace(SMALL, idle_current=4.0)
    rows, charge = discharged(idle, 0.0, 5000)
    np.testing.assert_allclose(rows[:, 1], 0.9 - 4.0 * TIMESTEP * np.arange(5000) / 36.0, rtol=1e-12)
    assert charge == pytest.approx(0.9 - 20.0 / 36.0)
    rows, charge = discharged(idle, 0.0, 20_000)
    assert charge == rows[-1, 1] == 0.0
    assert rows[-1, 0] == pytest.approx(4.0 * 3.27 - 0.05 * 4.0), "an empty battery keeps its last voltage"


@pytest.mark.parametrize("resistance", [0.0, 1e-6, 0.05, 2.0])
@pytest.mark.parametrize("demand", [0.0, 0.3, 1.0, 5.0])
def test_the_voltage_is_that_of_the_current_it_drives(resistance: float, demand: float) -> None:
    """V = E(s) - R i with i = i_hover (V / V0)^2 demand + i_idle, to rounding; ds/dt = -i / (3600 Q)."""
    battery = replace(SMALL, resistance=resistance)
    rows, last = discharged(battery, demand, 100)
    voltage, charge = rows.T
    current = 40.0 * (voltage / 16.0) ** 2 * demand + 0.5
    at_rest = np.array([open_circuit(battery, each) for each in charge])
    np.testing.assert_allclose(voltage, at_rest - resistance * current, rtol=1e-13)
    np.testing.assert_allclose(currents(battery, np.append(charge, last)), current, rtol=1e-7)


def test_the_energy_of_the_cells_goes_to_rotors_electronics_and_heat() -> None:
    """Sum of E i dt, the table's integral over the charge by Riemann sums, is that of P + V i_idle + R i^2."""
    demands = 1.0 + 0.5 * np.sin(0.01 * np.arange(500))
    rows, last = discharge(SMALL, 0.9, demands.tolist(), TIMESTEP)
    voltage, charge = rows.T
    current = 40.0 * (voltage / 16.0) ** 2 * demands + 0.5
    shaft = 40.0 * 16.0 * demands * (voltage / 16.0) ** 3  # torque times speed, (V / V0)^2 times V / V0
    np.testing.assert_allclose(charge[0] - last, current.sum() * TIMESTEP / 36.0, rtol=1e-12)
    at_rest = np.array([open_circuit(SMALL, each) for each in charge])
    left = (at_rest * current).sum() - (shaft + voltage * 0.5 + 0.05 * current**2).sum()
    assert abs(left) < 1e-12 * (at_rest * current).sum()


def test_the_curve_is_linear_between_its_points() -> None:
    battery = replace(SMALL, cells=2, curve=((0.0, 3.0), (0.5, 3.8), (1.0, 4.0)))
    points = np.linspace(0.0, 1.0, 41)
    expected = 2.0 * np.interp(points, [0.0, 0.5, 1.0], [3.0, 3.8, 4.0])
    np.testing.assert_allclose([open_circuit(battery, point) for point in points], expected, rtol=1e-14)


def test_momentum_theory_gives_the_current_of_hover() -> None:
    """The ideal power of an actuator disc, T v with v = sqrt(T / (2 rho A)) and T a quarter of the weight, per disc."""
    hummingbird = load_vehicle(vehicle_path("hummingbird"))
    resolved = Battery(cells=3, capacity=2.1).resolved(hummingbird)
    assert hummingbird.rotor_radius is not None
    thrust = 0.25 * hummingbird.mass * hummingbird.gravity
    disc = math.pi * hummingbird.rotor_radius**2
    power = 4.0 * thrust * math.sqrt(thrust / (2.0 * 1.225 * disc)) / EFFICIENCY
    assert resolved.reference_voltage == pytest.approx(12.6)
    assert resolved.hover_current == pytest.approx(power / 12.6)
    assert resolved.resolved(hummingbird) == resolved


def fallen(vehicle: Vehicle, effects: Effects, speeds: Array, integrator: Integrator = "mujoco") -> tuple[Array, Array]:
    """(200,) vertical acceleration [m/s^2] and (200, 2) battery while commands hold."""
    with Plant(vehicle, effects=effects, integrator=integrator) as plant:
        flown = plant.advance(speeds, 200)
    return np.diff(flown["physics"][:, 10], prepend=0.0) / TIMESTEP, flown["battery"]


@pytest.mark.parametrize("integrator", ["mujoco", "rk4"])
@pytest.mark.parametrize("exponent", [0.0, 1.5, 2.0])
@pytest.mark.parametrize("by_step", [False, True])
def test_thrust_has_the_factor_of_the_voltage(
    vehicle: Vehicle, integrator: Integrator, exponent: float, by_step: bool
) -> None:
    battery = replace(SMALL, exponent=exponent)
    nothing = Disturbance() if by_step else None
    speeds = np.full(4, 1.1 * vehicle.hover_speed)
    climb, recorded = fallen(vehicle, Effects(battery=battery, disturbance=nothing), speeds, integrator)
    factor = (recorded[:, 0] / 16.0) ** exponent
    np.testing.assert_allclose(climb, vehicle.gravity * (1.1**2 * factor - 1.0), atol=1e-9)
    assert recorded[0, 1] == 0.9
    assert recorded[-1, 1] < 0.8


def test_a_weak_rotor_draws_its_share_and_its_torque_sags_with_its_thrust(vehicle: Vehicle) -> None:
    effects = Effects(battery=SMALL, rotors=RotorDynamics(efficiency=(1.0, 0.0, 0.0, 0.0)))
    with Plant(vehicle, effects=effects) as plant:
        flown = plant.advance(plant.vehicle.hover_speeds, 1)
    expected, _ = discharged(SMALL, 0.25, 1)
    np.testing.assert_allclose(flown["battery"], expected, rtol=1e-14)
    b = vehicle.thrust_coefficient
    d = vehicle.drag_to_thrust * vehicle.thrust_coefficient
    factor = (expected[0, 0] / 16.0) ** 2
    spin = vehicle.rotor_spins[0]
    rate = spin * d / b * factor * 0.25 * vehicle.mass * vehicle.gravity / vehicle.inertia[2] * TIMESTEP
    assert flown["physics"][0, 13] == pytest.approx(rate, rel=1e-6)


@pytest.mark.parametrize(
    "curve", [((0.0, 3.0), (0.5, 3.8), (0.87, 3.9), (0.88, 4.1), (1.0, 4.2)), ((0.0, 3.5), (1.0, 4.2))]
)
def test_the_battery_of_the_plant_is_that_battery(vehicle: Vehicle, curve: tuple[tuple[float, float], ...]) -> None:
    """From 0.9 to empty, over the points of its curve, as commands change."""
    battery = replace(SMALL, capacity=0.001, curve=curve)
    commands = vehicle.hover_speed * np.random.default_rng(5).uniform(0.5, 1.4, (40, 4))
    share = np.array([1.0, 0.8, 1.0, 0.5])
    with Plant(vehicle, effects=Effects(battery=battery, rotors=RotorDynamics(efficiency=tuple(share)))) as plant:
        flown = np.concatenate([plant.advance(command, 5) for command in commands])
    demands = np.repeat((share * (commands / vehicle.hover_speed) ** 3).mean(axis=1), 5)
    expected, last = discharge(battery, 0.9, demands.tolist(), TIMESTEP)
    np.testing.assert_allclose(flown["battery"], expected, rtol=1e-12, atol=1e-15)
    assert last == 0.0
    thrust = share * vehicle.thrust_coefficient * np.repeat(commands, 5, axis=0) ** 2
    np.testing.assert_allclose(flown["thrust"], thrust.sum(axis=1) * (expected[:, 0] / 16.0) ** 2, rtol=1e-12)


@pytest.mark.parametrize("lag", [None, 0.02])
@pytest.mark.parametrize("noise", [None, ThrustNoise(loss=0.1, deviation=0.05)])
@pytest.mark.parametrize("disturbance", [None, Disturbance(force=(0.1, 0.0, 0.0), force_noise=0.01)])
def test_a_flight_does_not_depend_on_how_its_holds_are_cut(
    vehicle: Vehicle, lag: float | None, noise: ThrustNoise | None, disturbance: Disturbance | None
) -> None:
    """50 steps, 5 x 10 and 50 x 1, through a payload and a weak rotor: bit for bit."""
    effects = Effects(battery=SMALL, rotors=RotorDynamics(rise=lag), thrust_noise=noise, disturbance=disturbance)
    changes = (RotorChange(at=0.012, rotor=2, efficiency=0.9), PayloadPickup(at=0.021, mass=0.3))
    speeds = np.array([1.1, 1.05, 1.1, 1.05]) * vehicle.hover_speed
    flights = []
    with Plant(vehicle, effects=effects, changes=changes) as plant:
        for parts in (1, 5, 50):
            plant.reset(np.zeros(N_STATES))
            flown = np.concatenate([plant.advance(speeds, 50 // parts) for _ in range(parts)])
            flights.append(np.hstack([flown["physics"], flown["battery"]]))
    for flight in flights[1:]:
        np.testing.assert_array_equal(flight, flights[0])


def test_without_a_battery_nothing_is_recorded_and_at_its_reference_voltage_nothing_changes(vehicle: Vehicle) -> None:
    ideal = Battery(cells=1, capacity=1e6, hover_current=1.0, reference_voltage=4.0, curve=((0.0, 4.0), (1.0, 4.0)))
    segments = []
    for battery in (None, ideal):
        with Plant(vehicle, effects=Effects(battery=battery)) as plant:
            segments.append(plant.advance(1.02 * plant.vehicle.hover_speeds, 100))
    assert "battery" not in (segments[0].dtype.names or ())
    np.testing.assert_array_equal(segments[0]["physics"], segments[1]["physics"])
    assert segments[1]["physics"][-1, 3] > 0.0
