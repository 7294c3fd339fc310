"""Observations and actions of an agent: rotor speeds, deviations from hover, or thrust and body rates.

`Actions` turns an action a in [-1, 1] into a command, hover + a (high - hover) for a >= 0 and hover + a (hover - low)
below, and back; `Observations` concatenates state, preview and command.  `environment.py` uses them for one
environment, `fleet.py` for N at once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from quadsim.controller import Command
from quadsim.errors import ParameterError, UnknownNameError
from quadsim.flight.log import ControlLog, columns_of
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.tables.bounded import Bounded
from quadsim.rotation import euler_to_quaternion
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.sim.autopilot import Autopilot, AutopilotSettings
from quadsim.state import REFERENCE_NAMES, REFERENCE_STATES, Array
from quadsim.vehicle import N_ROTORS, Vehicle, span

Action = NDArray[np.floating]

ACTIONS: Final = ("deviations", "rotors", "speeds", "thrust", "rates", "attitude")
AUTOPILOT_ACTIONS: Final = ("rates", "attitude")
"""The actions that are targets of an autopilot."""
PARTS: Final = ("state", "preview", "ahead", "command")
USUAL: Final = ("state", "preview", "command")
DIVERGED: Final = 1e6  # magnitude that the plant takes for divergence
LARGEST_RATES: Final = (6.0, 6.0, 2.0)  # body rates at an action of 1 [rad/s]
FULL_TILT: Final = math.radians(35.0)  # roll and pitch at an action of 1 [rad]
ACTION_ROUNDING: Final = 1e-6  # share of its range by which an action may exceed it, as it may be a float32
GIVEN: Final = "given"
"""Status of a command that no controller computed."""
BANDWIDTH: Final = (20.0, 20.0, 20.0)  # of the autopilot's rate loop, proportional alone [1/s]
INNER_PERIOD: Final = 0.002  # longest time between two calls of the autopilot [s]


class Actions:
    """From actions (4,) to commands and back, within the controller's bounds on rotor speeds or else the vehicle's.

    - `speeds`: rotor speeds [rad/s], as they are.
    - `deviations`, also called `rotors`: in [-1, 1]; 0 is hover, -1 and 1 the lowest and the highest speed, linear on
      either side.
    - `thrust`: in [-1, 1]; the thrust of each rotor, 0 that in hover, -1 and 1 the least and the most, linear on either
      side.
    - `rates`: in [-1, 1]; collective thrust, 0 the weight and -1 and 1 the least and the most that rotors have, and
      body rates as shares of `LARGEST_RATES`, flown by an autopilot.
    - `attitude`: in [-1, 1]; collective thrust as with `rates`, roll and pitch as shares of `FULL_TILT`, and the yaw
      rate as a share of the largest one, flown by the same autopilot.

    Attributes:
        kind: the kind.
        space: of an action.
        scale: what one vehicle's actions are multiples of; those of several can be stacked for `action_commands`.
        numbers: of a command: 4, or 8 with an attitude.

    Raises:
        UnknownNameError: there is no such kind.
        ParameterError: hover is not within the bounds.
    """

    def __init__(self, kind: str, scenario: Scenario, vehicle: Vehicle) -> None:
        if kind not in ACTIONS:
            raise UnknownNameError("action", str(kind), ACTIONS)
        bounds, owner = _speed_bounds(scenario, vehicle)
        low = bounds.u_min
        high = bounds.u_max
        hover = vehicle.hover_speeds
        self.kind = kind
        self.numbers = N_ROTORS
        if kind == "attitude":
            self.numbers = 8
        self.scale: dict[str, Array] = {}
        self._vehicle = vehicle
        self._settings: AutopilotSettings | None = None
        if kind == "speeds":
            self.space = Box(low, high, dtype=np.float64)
            return
        if not (low.max() < hover.min() and hover.max() < high.min()):
            hover_bounds = [float(low[0]), float(high[0])]
            raise ParameterError(owner, "speed", hover_bounds, f"below and above the hover speed, {span(hover)} rad/s")
        self.space = Box(-1.0, 1.0, (N_ROTORS,), dtype=np.float32)
        if kind in AUTOPILOT_ACTIONS:
            self._settings = _rate_loop(scenario.plant.timestep)
            self._speeds = float(low[0]), float(high[0])
            hover = np.array(vehicle.mass * vehicle.gravity)
            low = np.array(vehicle.level_thrust(float(low.max())))
            high = np.array(vehicle.level_thrust(float(high.min())))
            self.scale["half_period"] = np.array(0.5 * scenario.control_period)
        elif kind == "thrust":
            low = vehicle.thrusts(low)
            hover = vehicle.thrusts(hover)
            high = vehicle.thrusts(high)
            linear, quadratic = vehicle.thrust_law
            self.scale |= {"linear": np.array(linear), "quadratic": quadratic}
        self.scale |= {"hover": hover, "down": hover - low, "up": high - hover}

    def autopilot(self) -> Autopilot | None:
        """Return a new autopilot that flies the commands; None where they are rotor speeds."""
        if self._settings is None:
            return None
        return Autopilot(self._vehicle, self._settings, speeds=self._speeds)

    @cached_property
    def _autopilot(self) -> Autopilot | None:
        return self.autopilot()

    def command(self, action: Action, horizon: int, yaw: float = 0.0, *, bounded: bool = True) -> Command:
        """Return the command, a plan of this many rows, for an action at a measured yaw [rad].

        Raises:
            ParameterError: it has another shape than `space`, is not of numbers, or, where it is to be `bounded`, is
                outside `space`.
        """
        numbers = check_action(action, self.space, bounded=bounded)
        scale = {name: values[None] for name, values in self.scale.items()}
        speeds = action_commands(self.kind, scale, numbers[None], np.array([yaw]))[0]
        plan = np.broadcast_to(speeds, (horizon, speeds.size))
        return Command(speeds=speeds, plan=plan, status=GIVEN, inner=self._autopilot)

    @cached_property
    def _holding(self) -> Autopilot | None:
        """The rate loop whose first answer, held for a control period, turns as far as `BANDWIDTH` does within it."""
        if self._settings is None:
            return None
        period = 2.0 * float(self.scale["half_period"])
        gains = tuple((1.0 - math.exp(-bandwidth * period)) / period for bandwidth in BANDWIDTH)
        settings = replace(self._settings, p=gains)
        return Autopilot(self._vehicle, settings, speeds=self._speeds)

    def require_held(self) -> None:
        """Refuse actions that are not rotor speeds to hold, and do not become any by `held_speeds`.

        Raises:
            ParameterError: they are attitudes.
        """
        if self.kind == "attitude":
            allowed = [kind for kind in ACTIONS if kind != "attitude"]
            raise ParameterError(
                "", "action", self.kind, f"one of {', '.join(allowed)}: they become rotor speeds to hold"
            )

    def held_speeds(self, action: Action, body_rates: Array) -> Array:
        """Return the rotor speeds (4,) [rad/s] that an action asks for, if they are to be held for a control period T.

        For `rates`, they give its thrust, and at the period's end the body rates at which its loop arrives: that turns
        from omega to omega_c with the bandwidth b, so it covers a share 1 - exp(-b T), as a constant acceleration of
        (1 - exp(-b T)) / T (omega_c - omega) does.

        Args:
            action: (4,) the action, which may be outside `space`, or NaN; then the speeds are, too.
            body_rates: (3,) measured omega [rad/s].

        Raises:
            ParameterError: the action has another shape than `space`, is not of numbers, or is an attitude.
        """
        self.require_held()
        target = self.command(action, 1, bounded=False).speeds
        if self._holding is None:
            return target
        if not np.isfinite(target).all():
            return np.full(N_ROTORS, np.nan)
        rotors = np.zeros(N_ROTORS)
        level = np.array([1.0, 0.0, 0.0, 0.0])  # neither matters to body rates
        return self._holding.speeds(0.0, target, body_rates, rotors, level)

    def of(self, speeds: Array) -> Action:
        """Return the action that commands rotor speeds (4,) [rad/s]; beyond [-1, 1] where these exceed their bounds.

        Raises:
            ParameterError: actions are not rotor speeds.
        """
        if self.kind in AUTOPILOT_ACTIONS:
            rule = "deviations, speeds or thrust: rotor speeds are no target to hold"
            raise ParameterError("", "action", self.kind, rule)
        if self.kind == "speeds":
            return np.array(speeds, float)
        if self.kind == "thrust":
            amount = self._vehicle.thrusts(speeds)
        else:
            amount = speeds
        deviation = amount - self.scale["hover"]
        largest = np.where(deviation < 0.0, self.scale["down"], self.scale["up"])
        return (deviation / largest).astype(np.float32)


def _speed_bounds(scenario: Scenario, vehicle: Vehicle) -> tuple[ActuatorBounds, str]:
    """Return the controller's bounds on rotor speeds, or else the vehicle's, and whose they are."""
    spec = scenario.controller
    if isinstance(spec, Bounded) and spec.input_bounds is not None:
        return spec.input_bounds.actuators(vehicle), "controller.input_bounds"
    return ActuatorBounds.of_vehicle(vehicle), f"vehicle {vehicle.name}"


def _rate_loop(timestep: float) -> AutopilotSettings:
    """Return the settings of the autopilot of actions: a proportional rate loop, without filter and delay.

    Args:
        timestep: of the physics [s], of which the autopilot's period is a multiple.
    """
    period = max(1, round(INNER_PERIOD / timestep)) * timestep
    none = (0.0, 0.0, 0.0)
    return AutopilotSettings(rate=1.0 / period, p=BANDWIDTH, i=none, d=none, gyro_cutoff=0.0, delay=0.0)


def check_action(action: Action, space: Box, *, bounded: bool = True) -> Array:
    """Return an action, or one for each environment, as float64.

    One that is NaN ends its episode; the others have to be within the space, up to rounding, where they are `bounded`.

    Raises:
        ParameterError: it has another shape than the space, is not of numbers, or is outside.
    """
    if np.shape(action) != space.shape:
        raise ParameterError("", "action", np.shape(action), f"of shape {space.shape}")
    kind = np.asarray(action).dtype
    if kind.kind not in "fiub":
        raise ParameterError("", "action", kind.name, "of numbers")
    numbers = np.array(action, np.float64)
    if not bounded:
        return numbers
    rounding = ACTION_ROUNDING * (space.high - space.low)
    outside = (numbers < space.low - rounding) | (numbers > space.high + rounding)  # False for NaN
    if outside.any():
        first = tuple(np.argwhere(outside)[0].tolist())
        where = "".join(f"[{i}]" for i in first)
        allowed = f"from {space.low[first]:g} to {space.high[first]:g}, the action space (gymnasium's ClipAction clips)"
        raise ParameterError("", f"action{where}", float(numbers[first]), allowed)
    return numbers


def action_commands(kind: str, scale: Mapping[str, Array], actions: Array, yaw: Array) -> Array:
    """Return the commands (N, 4) or (N, 8) of actions (N, 4) of a kind.

    Args:
        kind: of `ACTIONS`.
        scale: what actions are multiples of, of N vehicles or one: `Actions.scale` with an axis before.
        actions: within their space, or NaN.
        yaw: (N,) measured [rad], for `attitude`.
    """
    if kind == "speeds":
        return actions
    if kind in AUTOPILOT_ACTIONS:
        return _targets_of(kind, scale, actions, yaw)
    amounts = scale["hover"] + actions * np.where(actions < 0.0, scale["down"], scale["up"])
    if kind == "thrust":
        return _speeds_of(scale["linear"], scale["quadratic"], amounts)
    return amounts


def _targets_of(kind: str, scale: Mapping[str, Array], actions: Array, yaw: Array) -> Array:
    """Return thrust and body rates (N, 4); with `attitude` (N, 8), the attitude too, at the yaw of the mid-period."""
    share = actions[:, 0]
    thrust = scale["hover"] + np.abs(share) * (np.where(share < 0.0, -scale["down"], scale["up"]))
    if kind == "rates":
        targets = np.empty((len(actions), 4))
        targets[:, 0] = thrust
        targets[:, 1:] = actions[:, 1:] * LARGEST_RATES
        return targets
    turning = actions[:, 3] * LARGEST_RATES[2]
    euler = np.empty((len(actions), 3))
    euler[:, :2] = actions[:, 1:3] * FULL_TILT
    euler[:, 2] = yaw + scale["half_period"] * turning
    targets = np.empty((len(actions), 8))
    targets[:, 0] = thrust
    targets[:, 1:3] = 0.0
    targets[:, 3] = turning
    targets[:, 4:] = euler_to_quaternion(euler)
    return targets


def _speeds_of(linear: Array, quadratic: Array, thrusts: Array) -> Array:
    """Return rotor speeds of thrusts linear w + quadratic w^2 [N], as `quadsim.vehicle.Vehicle.speeds`."""
    linear = linear[:, None]
    root = np.sqrt(np.maximum(np.square(linear) + 4.0 * quadratic * thrusts, 0.0))
    with_linear = 2.0 * thrusts / (linear + root + (linear <= 0.0))  # without cancellation
    otherwise = (root - linear) / (2.0 * quadratic)
    return np.where(linear > 0.0, with_linear, otherwise)


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One entry of the observation: its name, such as `vx`, `x[3]` (three periods ahead) or `u1`, and its unit."""

    name: str
    unit: str


class Observations:
    """The chosen parts, concatenated, as float64.

    - `state`: the twelve states as measured or estimated, `quadsim.state.STATE_NAMES` [m, m/s, rad, rad/s].
    - `preview`: the filtered reference x, y, z [m], yaw [rad] at t_{k+1} .. t_{k+n}, row by row.
    - `ahead`: the same less the measured x, y, z, yaw: how far, and where to.
    - `command`: u(k-1), the rotor speeds in force [rad/s].

    Attributes:
        layout: an `Entry` for each entry.
        space: up to `DIVERGED`, which no flight passes; what a faulty sensor gives, such as NaN, is not in it.
    """

    def __init__(self, parts: Sequence[str], preview: int) -> None:
        if isinstance(parts, str):
            raise ParameterError("", "observation", parts, 'a list of parts, such as ["state"]')
        if not parts or len(set(parts)) < len(parts):
            raise ParameterError("", "observation", list(parts), f"one or more of {', '.join(PARTS)}, once each")
        for part in parts:
            if part not in PARTS:
                raise UnknownNameError("part of the observation", str(part), PARTS)
        stated = columns_of(ControlLog)
        named = list(zip(REFERENCE_NAMES, stated["reference"].units.values(), strict=True))
        rows = [(f"{name}[{i}]", unit) for i in range(1, preview + 1) for name, unit in named]
        entries = {
            "state": list(stated["state"].units.items()),
            "preview": rows,
            "ahead": [(f"{name} ahead", unit) for name, unit in rows],
            "command": list(stated["speeds"].units.items()),
        }
        self._parts = tuple(parts)
        layout = []
        for part in parts:
            for name, unit in entries[part]:
                layout.append(Entry(name=name, unit=unit))
        self.layout = tuple(layout)
        self.space = Box(-DIVERGED, DIVERGED, (len(self.layout),), dtype=np.float64)

    def of(self, state: Array, preview: Array, command: Array) -> Array:
        """Return the observation of a state (12,), a preview (n, 4) and a command (4,)."""
        return self.of_many(state[None], preview[None], command[None])[0]

    def of_many(self, states: Array, previews: Array, commands: Array) -> Array:
        """Return (N, n_o) observations of states (N, 12), previews (N, n, 4) and commands (N, 4)."""
        count = len(states)
        ahead = previews.shape[1] * len(REFERENCE_STATES)
        observed = np.empty((count, len(self.layout)))
        at = 0
        for part in self._parts:
            if part == "state":
                values = states
            elif part == "command":
                values = commands
            elif part == "preview":
                values = previews.reshape(count, ahead)
            else:
                values = (previews - states[:, None, REFERENCE_STATES]).reshape(count, ahead)
            observed[:, at : at + values.shape[1]] = values
            at += values.shape[1]
        return observed
