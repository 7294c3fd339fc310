"""The mixer: exact where it can be, yaw limited first, always within bounds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear
from uneven import uneven

from quadsim.assets import vehicle_path
from quadsim.mpc.pilot.allocation import Allocation, allocate, make_allocation, thrust_to_command
from quadsim.vehicle import load_vehicle

VEHICLES = {name: load_vehicle(vehicle_path(name)) for name in ("lopes2011", "hummingbird", "crazyflie2")}
VEHICLES["uneven"] = uneven()
ALLOCATIONS = {name: make_allocation(vehicle) for name, vehicle in VEHICLES.items()}
NAMES = st.sampled_from(sorted(VEHICLES))
SHARES = st.lists(st.floats(0.0, 1.0), min_size=4, max_size=4).map(np.array)


def box(name: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Bounds as slews leave them: around some command, within the rotors' range, sometimes without any width."""
    vehicle = VEHICLES[name]
    rng = np.random.default_rng(seed)
    before = rng.uniform(vehicle.speed_min, vehicle.speed_max, 4)
    width = rng.choice([0.0, 0.05, 0.5, 2.0]) * vehicle.hover_speed
    return tuple(np.clip(before + side * width, vehicle.speed_min, vehicle.speed_max) for side in (-1.0, 1.0))


def missed(allocation: Allocation, wrench: np.ndarray, speeds: np.ndarray) -> np.ndarray:
    """What of a wrench is not given, in units of what one rotor at hover gives."""
    return (allocation.M @ speeds**2 - wrench) / allocation.scale


@given(name=NAMES, shares=SHARES)
def test_a_wrench_that_can_be_given_is(name: str, shares: np.ndarray) -> None:
    vehicle = VEHICLES[name]
    allocation = ALLOCATIONS[name]
    speeds = shares * vehicle.speed_max
    answer = allocate(allocation, allocation.M @ speeds**2, np.zeros(4), np.full(4, vehicle.speed_max))
    np.testing.assert_allclose(answer**2, speeds**2, atol=1e-9 * vehicle.speed_max**2)


@given(name=NAMES, shares=SHARES, yaw=st.floats(-20.0, 20.0), seed=st.integers(0, 10**6))
def test_thrust_roll_and_pitch_have_priority_over_yaw(name: str, shares: np.ndarray, yaw: float, seed: int) -> None:
    """Of a point within the bounds, with another yaw torque demanded than it gives."""
    allocation = ALLOCATIONS[name]
    lower, upper = box(name, seed)
    possible = np.sqrt(lower**2 + shares * (upper**2 - lower**2))
    wrench = allocation.M @ possible**2
    wrench[3] = yaw * allocation.scale[3]
    speeds = allocate(allocation, wrench, lower, upper)
    error = missed(allocation, wrench, speeds)
    np.testing.assert_allclose(error[:3], 0.0, atol=1e-5)
    assert abs(error[3]) <= abs(missed(allocation, wrench, possible)[3]) + 1e-2


@settings(max_examples=50)
@given(name=NAMES, seed=st.integers(0, 10**6), size=st.sampled_from([1.0, 10.0, 1e4]))
def test_for_any_demand_the_speeds_are_finite_and_within_bounds(name: str, seed: int, size: float) -> None:
    allocation = ALLOCATIONS[name]
    lower, upper = box(name, seed)
    wrench = size * np.random.default_rng(seed).normal(size=4) * allocation.scale
    speeds = allocate(allocation, wrench, lower, upper)
    assert np.isfinite(speeds).all()
    assert (speeds >= lower).all()
    assert (speeds <= upper).all()


@pytest.mark.parametrize("name", sorted(VEHICLES))
def test_torque_for_roll_goes_before_thrust_that_cannot_be_had(name: str) -> None:
    """More thrust than there is, or less than none: the collective moves to where the roll torque fits."""
    vehicle = VEHICLES[name]
    allocation = ALLOCATIONS[name]
    bounds = np.zeros(4), np.full(4, vehicle.speed_max)
    for thrust in (20.0, -5.0):
        wrench = np.array([thrust, 0.5, 0.0, 0.0]) * allocation.scale
        error = missed(allocation, wrench, allocate(allocation, wrench, *bounds))
        assert abs(error[1]) < 0.02
        assert abs(error[2]) < 0.02
        assert abs(error[0]) > 1.0


@given(largest=st.floats(0.1, 1e3), ratio=st.floats(0.5, 20.0), share=st.floats(0.5, 1.0))
def test_the_thrust_that_is_commanded_carries_the_weight_wherever_the_rotors_do(
    largest: float, ratio: float, share: float
) -> None:
    weight = largest / ratio
    commanded = thrust_to_command(largest, weight, share)
    assert commanded <= largest
    assert commanded >= min(largest, weight)
    if ratio > 1.0:
        assert commanded - weight >= (0.5 - 1e-9) * (largest - weight)
    if share * largest >= 0.5 * (weight + largest):
        assert commanded == share * largest


@settings(max_examples=100)
@given(name=NAMES, seed=st.integers(0, 10**6), size=st.sampled_from([0.5, 3.0, 30.0]))
def test_where_roll_and_pitch_do_not_fit_it_is_the_weighted_least_squares(name: str, seed: int, size: float) -> None:
    """Against scipy's bounded-variable solver, with the thrust first clipped to its range."""
    allocation, (lower, upper) = ALLOCATIONS[name], box(name, seed)
    wrench = size * np.random.default_rng(seed).normal(size=4) * allocation.scale
    answer = allocate(allocation, wrench, lower, upper)
    if np.abs(missed(allocation, wrench, answer)[:3]).max() < 1e-6:
        return  # it fits, at most with less yaw
    weights = np.array([30.0, 1000.0, 1000.0, 1.0]) / allocation.scale
    unit = float(upper.max()) ** 2
    low = lower**2
    high = np.maximum(upper**2, lower**2 + 1e-9 * unit)
    wrench[0] = np.clip(wrench[0], allocation.M[0] @ low, allocation.M[0] @ high)
    best = lsq_linear(
        weights[:, None] * allocation.M * unit, weights * wrench, (low / unit, high / unit), method="bvls", tol=1e-14
    )
    cost = 0.5 * float(np.square(weights * (allocation.M @ answer**2 - wrench)).sum())
    assert cost <= best.cost * (1.0 + 1e-6) + 1e-9
