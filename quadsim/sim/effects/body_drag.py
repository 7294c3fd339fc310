"""The ellipsoid in place of the body for drag: its semi-axes, and its added mass."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quadsim.state import Array


def semi_axes(areas: Sequence[float]) -> Array:
    """(3,) semi-axes r [m] of the ellipsoid whose projected areas (3,) [m^2] are given: pi r_y r_z = A_x and so on."""
    ax, ay, az = areas
    return np.sqrt(np.array([ay * az / (np.pi * ax), ax * az / (np.pi * ay), ax * ay / (np.pi * az)]))


def added_mass(areas: Sequence[float], density: float) -> Array:
    """(3,) mass of air [kg] that moves along with the ellipsoid in each of its axes.

    m_i = rho V alpha_i / (2 - alpha_i), alpha_i = r_x r_y r_z times the integral from 0 to infinity of
    dl / ((r_i^2 + l) sqrt((r_x^2 + l)(r_y^2 + l)(r_z^2 + l))), 2/3 of Carlson's R_D (Lamb, "Hydrodynamics", 1932,
    Secs. 114 and 121).

    Args:
        areas: projected ones along its axes [m^2].
        density: of the air [kg/m^3].
    """
    from scipy.special import elliprd  # whose package takes a while to load, and what draws the vehicle needs none

    r = semi_axes(areas)
    squares, product = np.square(r), float(np.prod(r))
    alpha = 2.0 / 3.0 * product * elliprd(np.roll(squares, -1), np.roll(squares, -2), squares)
    return np.asarray(density * 4.0 / 3.0 * np.pi * product * alpha / (2.0 - alpha))
