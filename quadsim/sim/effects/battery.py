"""A battery that sags under load and runs down, and the thrust that its voltage leaves."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Final

from annotated_types import Ge, Le, Len, doc

from quadsim.errors import ParameterError
from quadsim.fields import Fraction, NonNegative, Pair, Positive, filled
from quadsim.sim.effects.wind import SEA_LEVEL_DENSITY
from quadsim.vehicle import N_ROTORS, Vehicle

LIPO: Final = ((0.0, 3.27), (0.05, 3.61), (0.1, 3.69), (0.5, 3.84), (0.6, 3.87), (0.8, 4.02), (1.0, 4.2))
"""Charge [-] and voltage at rest [V] of a lithium-polymer cell; within 15 mV of https://blog.ampow.com/lipo-voltage-chart."""
EFFICIENCY: Final = 0.5
"""Our choice: ideal power in hover over battery power, figure of merit 0.6 to 0.7 times motor and ESC 0.8.

A Crazyflie's brushed motors have some 0.14: 250 mAh last 7 minutes."""


@dataclass(frozen=True, kw_only=True)
class Battery:
    """A battery with internal resistance R that drives rotors by throttle; see `quadsim.sim.effects.battery`.

    A rotor commanded to w is given the throttle that holds w at the voltage V0; at V it turns at w V / V0, so that its
    thrust and reaction torque have the factor (V / V0)^n, n = 2.  Torque times speed is power, hence the current

        i = i_hover (V / V0)^2 sum_i e_i (w_i / w_hover)^3 / 4 + i_idle,  V = E(s) - R i,  ds/dt = -i / (3600 Q),

    with e_i the rotor's share of thrust left and w_hover of the vehicle as it took off.  V is the positive root of this
    quadratic, never below 0; the current is that of n = 2.  Each physics step holds the charge s of its start, and an
    empty battery keeps its E(0).

    An ESC that regulates speed would lose its largest speed only: not modelled.  Rotor drag, rotor inertia and the
    logged rotor speeds are those of w.
    """

    cells: Annotated[int, Ge(1), Le(1000), doc("[-] cells in series")]
    capacity: Annotated[Positive, doc("[A h] Q, from full to empty")]
    resistance: Annotated[NonNegative, doc("[ohm] R, of the whole battery with its wires")] = 0.0
    charge: Annotated[Fraction, doc("[-] state of charge at the start")] = 1.0
    curve: Annotated[
        tuple[Pair, ...],
        Len(2, 1000),
        doc("[-, V] charge and open-circuit voltage of one cell, linear in between; absent: a LiPo cell"),
    ] = LIPO
    hover_current: Annotated[
        Positive | None,
        doc("[A] i_hover, of the whole vehicle; absent: by momentum theory at half the ideal efficiency, rotor_radius"),
    ] = None
    idle_current: Annotated[NonNegative, doc("[A] i_idle, of the electronics")] = 0.0
    reference_voltage: Annotated[
        Annotated[float, Ge(0.01), Le(1e6)] | None,
        doc("[V] V0, at which the vehicle's thrust_coefficient holds; absent: full, without load"),
    ] = None
    exponent: Annotated[float, Ge(0.0), Le(10.0), doc("[-] n, of thrust over voltage")] = 2.0

    def resolved(self, vehicle: Vehicle) -> Battery:
        """Fill in reference voltage and hover current, of momentum theory: P = T^1.5 / sqrt(2 rho 4 pi R^2).

        Raises:
            ParameterError: the curve is impossible, or the current needs a rotor radius.
        """
        charges = [charge for charge, _ in self.curve]
        voltages = [voltage for _, voltage in self.curve]
        rises = all(low < high for low, high in pairwise(charges))
        if not rises or (charges[0], charges[-1]) != (0.0, 1.0) or min(voltages) <= 0.0:
            rule = "pairs of a charge that rises from 0 to 1 and a voltage above 0"
            raise ParameterError("effects.battery", "curve", [*map(list, self.curve)], rule)
        battery = filled(self, reference_voltage=self.cells * self.curve[-1][1])
        if self.hover_current is not None:
            return battery
        if vehicle.rotor_radius is None:
            rule = f"given, as the vehicle {vehicle.name!r} states no rotor_radius"
            raise ParameterError("effects.battery", "hover_current", None, rule)
        discs = N_ROTORS * math.pi * vehicle.rotor_radius**2
        power = (vehicle.mass * vehicle.gravity) ** 1.5 / math.sqrt(2.0 * SEA_LEVEL_DENSITY * discs)
        assert battery.reference_voltage is not None
        return filled(battery, hover_current=power / EFFICIENCY / battery.reference_voltage)
