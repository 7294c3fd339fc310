"""A law that commands an autopilot: thrust and body rates, or thrust and attitude, in place of rotor speeds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from mpc.handover import hand_over, within
from quadsim.controller import GROUNDED, AutopilotLoop, Command, StepInputs, stopped
from quadsim.state import Array
from quadsim.vehicle import Vehicle


class Piloted:
    """A law in the space of targets, and the autopilot that flies them.

    The law's commands are targets: `speeds` a row, thrust [N] and body rates [rad/s] (4,), perhaps with an attitude
    (8,); `plan` such rows; `now.acting` and `reset` give it the target in force. To the flight it is an inner loop as
    well: it passes calls on to the autopilot, and so knows the target in force whenever commands come late.

    Attributes:
        inner: the law.
        autopilot: an inner loop that takes targets.
    """

    takes_targets = True

    def __init__(self, law: Any, autopilot: AutopilotLoop, vehicle: Vehicle) -> None:
        self.inner, self.autopilot, self.rate = law, autopilot, autopilot.rate
        self.name, self.solver, self.horizon = law.name, law.solver, law.horizon
        self._hover = np.array([vehicle.mass * vehicle.gravity, 0.0, 0.0, 0.0])
        self._slowest = np.full(4, vehicle.speed_min)
        self._target, self._fresh = self._hover, True  # the autopilot is reset before its first call
        # Body rates at which it starts then, with the rotors as they turn [rad/s]; None from the ground: as at hover.
        self._rates: Array | None = np.zeros(3)
        if hasattr(law, "predict"):
            self.predict = law.predict

    def reset(self, speeds: Array) -> None:
        """Restart, at rest unless `begin` follows; the target before the first is hover."""
        self._target, self._fresh, self._rates = self._hover, True, np.zeros(3)
        self.inner.reset(self._hover.copy())

    def begin(self, rates: Array) -> None:
        """Let the autopilot start, after a reset, on a vehicle that turns at body rates (3,) [rad/s]."""
        self._rates = rates.copy()

    def adopt(self, previous: object) -> None:
        """Take over the previous law, and its autopilot: a vehicle has one."""
        hand_over(self.inner, previous)
        law = within(previous, Piloted)
        if law is not None and isinstance(law.autopilot, type(self.autopilot)):
            self.autopilot, self._target, self._fresh = law.autopilot, law._target, law._fresh

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """Return the law's target, to be flown by the autopilot; on the ground the rotors stop."""
        command: Command = self.inner.step(replace(now, acting=self._target), state, reference)
        if now.phase in GROUNDED:
            self._target, self._fresh, self._rates = self._hover, True, None
            return stopped(self._slowest.copy(), self.horizon, now.phase)
        return replace(command, inner=self)

    def speeds(self, time: float, commanded: Array, rates: Array, rotors: Array, attitude: Array) -> Array:
        """See `quadsim.controller.InnerLoop`."""
        if self._fresh:
            self.autopilot.reset()
            if self._rates is not None and hasattr(self.autopilot, "settle"):
                self.autopilot.settle(self._rates, rotors)
        self._target, self._fresh = commanded, False
        return self.autopilot.speeds(time, commanded, rates, rotors, attitude)

    @property
    def infeasible_period(self) -> object:
        """The law's first period since `reset` whose QP had no answer; None if there is none."""
        return getattr(self.inner, "infeasible_period", None)
