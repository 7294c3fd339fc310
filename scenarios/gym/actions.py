"""What an agent's actions are: rotor speeds, deviations from hover, or thrust and body rates; all become commands."""

from __future__ import annotations

from typing import Final, Literal, Protocol, get_args

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from mpc.answer import ActuatorBounds
from mpc.body_rates import STATUS, BodyRateLoop
from quadsim.controller import Command
from quadsim.errors import ParameterError, UnknownNameError
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS, Vehicle
from scenarios.parts.controllers import make_bounds
from scenarios.schema.optimisation import BoundedSpec
from scenarios.schema.scenario import Scenario

ActionKind = Literal["deviations", "speeds", "rates"]
Action = NDArray[np.floating]

LARGEST_RATES: Final = (6.0, 6.0, 2.0)  # body rates at an action of 1 [rad/s]
BANDWIDTH: Final = 20.0  # of the body rate loop [1/s]
INNER_PERIOD: Final = 0.002  # longest time between two calls of the body rate loop [s]


class Actions(Protocol):
    """From actions to commands and back."""

    space: Box

    def command(self, action: Action, body_rates: Array | None, horizon: int) -> Command:
        """The command, a plan of this many rows, for an action (4,) at body rates (3,) [rad/s], if these are known."""
        ...

    def of(self, speeds: Array) -> Action:
        """The action (4,) that commands rotor speeds (4,) [rad/s].

        Raises:
            ParameterError: actions are not rotor speeds.
        """
        ...


class RotorSpeeds:
    """Four rotor speeds [rad/s], as they are."""

    def __init__(self, bounds: ActuatorBounds) -> None:
        self.space = Box(bounds.u_min, bounds.u_max, dtype=np.float64)

    def command(self, action: Action, body_rates: Array | None, horizon: int) -> Command:
        """See `Actions`."""
        return _held(np.asarray(action, float), horizon)

    def of(self, speeds: Array) -> Action:
        """See `Actions`."""
        return np.array(speeds, float)


class Deviations:
    """Four numbers in [-1, 1]: 0 is hover, -1 and 1 the lowest and the highest speed, linear on either side."""

    def __init__(self, bounds: ActuatorBounds, hover: float) -> None:
        self.space = Box(-1.0, 1.0, (N_ROTORS,), dtype=np.float32)
        self._hover, self._down, self._up = hover, hover - bounds.u_min, bounds.u_max - hover

    def command(self, action: Action, body_rates: Array | None, horizon: int) -> Command:
        """See `Actions`."""
        shares = np.asarray(action, np.float64)
        return _held(self._hover + shares * np.where(shares < 0.0, self._down, self._up), horizon)

    def of(self, speeds: Array) -> Action:
        """See `Actions`; beyond [-1, 1] where the speeds are beyond their bounds."""
        deviation = speeds - self._hover
        return (deviation / np.where(deviation < 0.0, self._down, self._up)).astype(np.float32)


class ThrustAndRates:
    """Collective thrust and body rates in [-1, 1], flown by an inner loop.

    Thrust 0 is the weight, -1 and 1 the least and the most that rotors have; rates are shares of `LARGEST_RATES`.
    """

    def __init__(self, bounds: ActuatorBounds, vehicle: Vehicle, timestep: float) -> None:
        self.space = Box(-1.0, 1.0, (N_ROTORS,), dtype=np.float32)
        rate = 1.0 / (max(1, round(INNER_PERIOD / timestep)) * timestep)
        self._loop = BodyRateLoop(vehicle, rate=rate, bandwidth=BANDWIDTH, bounds=bounds)
        weight = vehicle.mass * vehicle.gravity
        least, most = (vehicle.thrust_coefficient * float(np.sum(ends**2)) for ends in (bounds.u_min, bounds.u_max))
        self._weight, self._down, self._up = weight, weight - least, most - weight

    def command(self, action: Action, body_rates: Array | None, horizon: int) -> Command:
        """See `Actions`."""
        thrust, *rates = np.asarray(action, float).tolist()
        self._loop.thrust = self._weight + thrust * (self._down if thrust < 0.0 else self._up)
        self._loop.rates = np.multiply(rates, LARGEST_RATES)
        return self._loop.command(np.zeros(3) if body_rates is None else body_rates, horizon)

    def of(self, speeds: Array) -> Action:
        """See `Actions`."""
        raise ParameterError(
            "", "action", "rates", "deviations or speeds: rotor speeds are no thrust and rates to hold"
        )


def make_actions(kind: str, scenario: Scenario, vehicle: Vehicle) -> Actions:
    """The actions of a kind, within the controller's bounds on rotor speeds, or else the vehicle's.

    Raises:
        UnknownNameError: there is no such kind.
        ParameterError: the bounds leave no room around hover.
    """
    if kind not in get_args(ActionKind):
        raise UnknownNameError("action", str(kind), get_args(ActionKind))
    spec = scenario.controller
    if isinstance(spec, BoundedSpec):
        bounds, owner = ActuatorBounds.of(make_bounds(spec)), "controller.input_bounds"
    else:
        bounds, owner = ActuatorBounds.of_vehicle(vehicle), f"vehicle {vehicle.name}"
    if kind == "speeds":
        return RotorSpeeds(bounds)
    hover = vehicle.hover_speed
    if not (bounds.u_min.max() < hover < bounds.u_max.min()):
        given = [float(bounds.u_min[0]), float(bounds.u_max[0])]
        raise ParameterError(owner, "speed", given, f"below and above the hover speed, {hover:.4g} rad/s")
    if kind == "deviations":
        return Deviations(bounds, hover)
    return ThrustAndRates(bounds, vehicle, scenario.plant.timestep)


def _held(speeds: Array, horizon: int) -> Command:
    return Command(speeds=speeds, plan=np.broadcast_to(speeds, (horizon, N_ROTORS)), status=STATUS)
