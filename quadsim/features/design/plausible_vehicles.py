"""Random vehicles as one might build them, from 30 g to 25 kg: tests and benchmarks judge designs by them.

Thrust to weight and lag are drawn over their whole range, whatever the mass.  Sizes follow the mass, as those of
vehicles that fly do; each further number is drawn about what its source or the three shipped vehicles have.
"""

from __future__ import annotations

import math

import numpy as np

from quadsim.vehicle import N_ROTORS, Vehicle

LIGHTEST = 0.03
HEAVIEST = 25.0
"""[kg]"""
LEAST_RATIO = 1.6
MOST_RATIO = 6.0
"""Thrust to weight."""
QUICKEST = 0.01
SLOWEST = 0.12
"""Time constant of the rotors [s]."""


def plausible_vehicles(count: int, seed: int) -> list[Vehicle]:
    """Return vehicles spread evenly over the logarithm of mass, thrust to weight and lag (a Latin hypercube)."""
    rng = np.random.default_rng(seed)
    columns = []
    for _ in range(3):
        strata = rng.permutation(count)
        within = rng.random(count)
        columns.append((strata + within) / count)
    shares = np.stack(columns, axis=1)
    vehicles = []
    for i, row in enumerate(shares.tolist()):
        vehicles.append(_vehicle(f"random-{i + 1:02d}", row, rng, cross=i % 2 == 0))
    return vehicles


def _vehicle(name: str, shares: list[float], rng: np.random.Generator, *, cross: bool) -> Vehicle:
    """Return a vehicle with three given shares of the ranges; its other numbers are drawn.

    Arms grow with m^0.375: the Crazyflie has 46 mm, the paper's vehicle 300 mm.  J = k m L^2 with k from 0.1 to 0.35:
    the shipped ones have 0.09 to 0.34.  Propellers' tips move at 60 to 130 m/s; a propeller's reaction torque over its
    thrust is 0.12 to 0.25 of its radius.  Drag slows by 0.1 to 0.3 of the speed per second.

    Args:
        name: of the vehicle.
        shares: 0 to 1, of the ranges of mass, thrust to weight and lag.
        rng: draws everything else.
        cross: whether it is an X, with arms between the axes; otherwise a plus.
    """
    mass = _between(LIGHTEST, HEAVIEST, shares[0])
    ratio = _between(LEAST_RATIO, MOST_RATIO, shares[1])
    lag = _between(QUICKEST, SLOWEST, shares[2])
    gravity = 9.81
    arm = 0.178 * mass**0.375 * rng.uniform(0.85, 1.15)
    radius = arm * rng.uniform(0.4, 0.6)
    ixx = rng.uniform(0.1, 0.35) * mass * arm**2
    iyy = ixx * rng.uniform(0.9, 1.15)
    izz = (ixx + iyy) * rng.uniform(0.75, 0.95)
    speed_max = rng.uniform(60.0, 130.0) / radius
    hover = speed_max / math.sqrt(ratio)
    if cross:
        shape = "X"
        azimuths = (-45.0, -135.0, 135.0, 45.0)
        spins = (-1, 1, -1, 1)
    else:
        shape = "plus"
        azimuths = (0.0, -90.0, 180.0, 90.0)
        spins = (1, -1, 1, -1)
    return Vehicle(
        name=name,
        description=f"{shape}, drawn at random",
        mass=mass,
        gravity=gravity,
        inertia=(ixx, iyy, izz),
        arm_length=arm,
        rotor_azimuths=azimuths,
        rotor_spins=spins,
        thrust_coefficient=mass * gravity / (N_ROTORS * hover**2),
        drag_to_thrust=radius * rng.uniform(0.12, 0.25),
        speed_min=0.0,
        speed_max=speed_max,
        rotor_rise=lag,
        rotor_fall=min(lag * rng.uniform(1.0, 1.6), SLOWEST),
        rotor_inertia=mass * radius**2 * rng.uniform(0.5e-3, 1.5e-3),
        rotor_radius=radius,
        rotor_drag=mass * rng.uniform(0.1, 0.3) / (N_ROTORS * hover),
        body_drag=(0.25 * arm**2, 0.25 * arm**2, 0.5 * arm**2),
    )


def _between(least: float, most: float, share: float) -> float:
    """Return the number at a share of the way between two positive ones, in its logarithm."""
    return float(least * (most / least) ** share)
