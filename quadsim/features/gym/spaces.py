"""Observations and actions of an agent: rotor speeds, deviations from hover, or thrust and body rates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from quadsim.controller import Command
from quadsim.errors import ParameterError, UnknownNameError
from quadsim.flight.log import ControlLog, columns_of
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.tables.bounded import Bounded
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.sim.autopilot import Autopilot, AutopilotSettings
from quadsim.state import REFERENCE_NAMES, REFERENCE_STATES, Array
from quadsim.vehicle import N_ROTORS, Vehicle, span

Action = NDArray[np.floating]

ACTIONS: Final = ("deviations", "speeds", "rates")
PARTS: Final = ("state", "preview", "ahead", "command")
USUAL: Final = ("state", "preview", "command")
DIVERGED: Final = 1e6  # magnitude that the plant takes for divergence
LARGEST_RATES: Final = (6.0, 6.0, 2.0)  # body rates at an action of 1 [rad/s]
GIVEN: Final = "given"
"""Status of a command that no controller computed."""
BANDWIDTH: Final = (20.0, 20.0, 20.0)  # of the autopilot's rate loop, proportional alone [1/s]
INNER_PERIOD: Final = 0.002  # longest time between two calls of the autopilot [s]


class Actions:
    """From actions (4,) to commands and back, within the controller's bounds on rotor speeds or else the vehicle's.

    - `speeds`: rotor speeds [rad/s], as they are.
    - `deviations`: in [-1, 1]; 0 is hover, -1 and 1 the lowest and the highest speed, linear on either side.
    - `rates`: in [-1, 1]; collective thrust, 0 the weight and -1 and 1 the least and the most that rotors have, and
      body rates as shares of `LARGEST_RATES`, flown by an autopilot.

    Raises:
        UnknownNameError: there is no such kind.
        ParameterError: the bounds leave no room around hover.
    """

    def __init__(self, kind: str, scenario: Scenario, vehicle: Vehicle) -> None:
        if kind not in ACTIONS:
            raise UnknownNameError("action", str(kind), ACTIONS)
        spec = scenario.controller
        if isinstance(spec, Bounded):
            bounds, owner = spec.input_bounds.actuators(vehicle), "controller.input_bounds"
        else:
            bounds, owner = ActuatorBounds.of_vehicle(vehicle), f"vehicle {vehicle.name}"
        low, high, hover = bounds.u_min, bounds.u_max, vehicle.hover_speeds
        self._kind = kind
        if kind == "speeds":
            self.space = Box(low, high, dtype=np.float64)
            return
        if not (low.max() < hover.min() and hover.max() < high.min()):
            hover_bounds = [float(low[0]), float(high[0])]
            raise ParameterError(owner, "speed", hover_bounds, f"below and above the hover speed, {span(hover)} rad/s")
        self.space = Box(-1.0, 1.0, (N_ROTORS,), dtype=np.float32)
        self._hover, self._down, self._up = hover, hover - low, high - hover
        if kind == "rates":
            timestep = scenario.plant.timestep
            rate = 1.0 / (max(1, round(INNER_PERIOD / timestep)) * timestep)
            speeds = (float(low[0]), float(high[0]))
            self._autopilot = _rate_loop(vehicle, BANDWIDTH, rate, speeds)
            self._holding = _rate_loop(vehicle, _held_gains(scenario.control_period), rate, speeds)
            self._weight = vehicle.mass * vehicle.gravity
            self._thrusts = [vehicle.level_thrust(float(speed)) for speed in (low.max(), high.min())]

    def command(self, action: Action, horizon: int) -> Command:
        """The command, a plan of this many rows, for an action.

        Raises:
            ParameterError: it has another shape than `space`, or is not of numbers.
        """
        if np.shape(action) != self.space.shape:
            raise ParameterError("", "action", np.shape(action), f"of shape {self.space.shape}")
        kind = np.asarray(action).dtype
        if kind.kind not in "fiub":
            raise ParameterError("", "action", kind.name, "of numbers")
        speeds, inner = np.array(action, np.float64), None
        if self._kind == "rates":
            inner, thrust = self._autopilot, float(speeds[0])
            collective = self._weight + abs(thrust) * (self._thrusts[thrust > 0.0] - self._weight)
            speeds = np.append(collective, speeds[1:] * LARGEST_RATES)
        elif self._kind == "deviations":
            speeds = self._hover + speeds * np.where(speeds < 0.0, self._down, self._up)
        plan = np.broadcast_to(speeds, (horizon, N_ROTORS))
        return Command(speeds=speeds, plan=plan, status=GIVEN, inner=inner)

    def held_speeds(self, action: Action, body_rates: Array) -> Array:
        """Return the rotor speeds (4,) [rad/s] that an action asks for, if they are to be held for a control period T.

        For `rates`, they give its thrust, and at the period's end the body rates at which its loop arrives: that turns
        from omega to omega_c with the bandwidth b, so it covers a share 1 - exp(-b T), and a constant acceleration of
        (1 - exp(-b T)) / T (omega_c - omega) covers the same.

        Args:
            action: (4,) the action.
            body_rates: (3,) measured omega [rad/s].

        Raises:
            ParameterError: see `command`.
        """
        command = self.command(action, 1)
        if command.inner is None:
            return command.speeds
        if not np.isfinite(command.speeds).all():
            return np.full(N_ROTORS, np.nan)
        rotors, level = np.zeros(N_ROTORS), np.array([1.0, 0.0, 0.0, 0.0])  # a rate loop uses neither
        return self._holding.speeds(0.0, command.speeds, body_rates, rotors, level)

    def of(self, speeds: Array) -> Action:
        """The action that commands rotor speeds (4,) [rad/s]; beyond [-1, 1] where these are beyond their bounds.

        Raises:
            ParameterError: actions are not rotor speeds.
        """
        if self._kind == "rates":
            rule = "deviations or speeds: rotor speeds are no thrust and rates to hold"
            raise ParameterError("", "action", "rates", rule)
        if self._kind == "speeds":
            return np.array(speeds, float)
        deviation = speeds - self._hover
        return (deviation / np.where(deviation < 0.0, self._down, self._up)).astype(np.float32)


def _rate_loop(vehicle: Vehicle, gains: tuple[float, ...], rate: float, speeds: tuple[float, float]) -> Autopilot:
    """Return a proportional rate loop, about body x, y, z [1/s], without filter and delay, within rotor speeds."""
    none = (0.0, 0.0, 0.0)
    settings = AutopilotSettings(rate=rate, p=gains, i=none, d=none, gyro_cutoff=0.0, delay=0.0)
    return Autopilot(vehicle, settings, speeds=speeds)


def _held_gains(period: float) -> tuple[float, ...]:
    """Return the gains [1/s] whose first answer, held for a period [s], turns as far as `BANDWIDTH` does within it."""
    return tuple((1.0 - math.exp(-bandwidth * period)) / period for bandwidth in BANDWIDTH)


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
        self.layout = tuple(Entry(name=name, unit=unit) for part in parts for name, unit in entries[part])
        self.space = Box(-DIVERGED, DIVERGED, (len(self.layout),), dtype=np.float64)

    def of(self, state: Array, preview: Array, command: Array) -> Array:
        """The observation of a state (12,), a preview (n, 4) and a command (4,)."""
        ahead = preview - state[list(REFERENCE_STATES)]
        values = {"state": state, "preview": preview.ravel(), "ahead": ahead.ravel(), "command": command}
        return np.concatenate([values[part] for part in self._parts])
