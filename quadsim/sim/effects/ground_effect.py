"""Thrust near the ground."""

from __future__ import annotations

from typing import Final

LOWEST_RATIO: Final = 0.5
"""Lowest height of a rotor, in rotor radii, for which the formula is used: below, the thrust grows no further."""


def thrust_ratio(height: float, radius: float) -> float:
    """Thrust of a hovering rotor near the ground over its thrust far from it, at the same power.

        T / T_inf = 1 / (1 - (R / (4 z))^2)

    The ground acts as an image of the rotor below it, whose outflow slows the inflow: I. C. Cheeseman, W. E. Bennett,
    "The Effect of the Ground on a Helicopter Rotor in Forward Flight", ARC R&M 3021, 1955.  Singular at z = R/4 and
    good for z > R/2 alone (J. G. Leishman, "Principles of Helicopter Aerodynamics", Sec. 5.8): lower heights are taken
    for z = R/2, where the ratio is 4/3.  Left out are forward speed, which weakens the effect, and what neighbouring
    rotors add to it; the ratio is applied at equal rotor speeds, as simulators commonly do.

    Args:
        height: z, of the rotor above the ground [m]; may be negative in a crash.
        radius: R, of the rotor [m]; positive.
    """
    image = 0.25 * radius / max(height, LOWEST_RATIO * radius)
    return 1.0 / (1.0 - image * image)
