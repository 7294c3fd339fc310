"""What flies a vehicle: a controller, the fallback contract around it, and the faster loop that flies its commands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quadsim.controller import (
    GROUNDED,
    ROTORS,
    Adopting,
    AutopilotLoop,
    Command,
    Commanding,
    Controller,
    CoreController,
    Diagnosable,
    Foreseeing,
    InCore,
    Predicting,
    Settling,
    StepInputs,
    stopped,
    takes_targets,
)
from quadsim.core.inner import CompiledLoop
from quadsim.core.mirror import Struct
from quadsim.mpc.guard.contract import Guard
from quadsim.mpc.pilot.attitudes import AttitudeTargets
from quadsim.mpc.pilot.indi import TorqueIncrement
from quadsim.rotation import euler_to_quaternion
from quadsim.state import ANGLES, Array
from quadsim.vehicle import Vehicle


class Pilot:
    """A controller, with or without the fallback contract around it, and with or without an inner loop.

    An inner loop corrects the rotor speeds that the controller commands (`quadsim.mpc.pilot.indi.TorqueIncrement`), or
    is an autopilot. The controller then commands targets: `speeds` a row, thrust [N] and body rates [rad/s] (4,),
    perhaps with an attitude (8,), `plan` such rows; `now.acting` and `reset` give it the target in force. To the flight
    the pilot is
    the inner loop then: it passes calls on to the autopilot, and so knows the target in force whenever commands come
    late.  With `attitudes` the controller and the contract know thrust and body rates, `plan` has them, and what is
    commanded are the attitudes whose errors make the autopilot turn so.

    Attributes:
        law: the controller.
        guard: the fallback contract; None for none.
        inner: the inner loop; None where the rotors hold each command.
        attitudes: what makes attitudes of the law's body rates; None where the law's commands are flown as they are.

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> from quadsim import mpc
        >>> vehicle = quadsim.load_vehicle("hummingbird")
        >>> law = mpc.Nonlinear().law(vehicle, 0.05)
        >>> pilot = mpc.Pilot(law, vehicle)
        >>> pilot.step(quadsim.StepInputs(), np.zeros(12), np.zeros((law.horizon, 4))).status
        'unconstrained'
    """

    def __init__(
        self,
        law: Controller,
        vehicle: Vehicle,
        *,
        guard: Guard | None = None,
        inner: TorqueIncrement | AutopilotLoop | None = None,
        attitudes: AttitudeTargets | None = None,
    ) -> None:
        self.law = law
        self.guard = guard
        self.inner = inner
        self.attitudes = attitudes
        self.takes_targets = takes_targets(inner)
        self.rate = 0.0
        if inner is not None:
            self.rate = inner.rate
        self._hover = np.array([vehicle.mass * vehicle.gravity, 0.0, 0.0, 0.0])
        self._slowest = np.full(4, vehicle.speed_min)
        # the target in force; whether the autopilot is to be reset
        self._target = self._hover
        self._fresh = True
        # Body rates at which it starts then, with the rotors as they turn [rad/s]; None from the ground: as at hover.
        self._rates: Array | None = np.zeros(3)

    def __repr__(self) -> str:
        parts = [f"horizon {self.horizon}"]
        if self.solver:
            parts.append(self.solver)
        if self.guard is not None:
            parts.append("with fallback")
        if self.takes_targets:
            parts.append("flown by an autopilot")
        return f"<Pilot of {self.name}: {', '.join(parts)}>"

    @property
    def name(self) -> str:
        """Short name of the controller."""
        return self.law.name

    @property
    def solver(self) -> str:
        """Name of the controller's QP solver; empty for a closed form."""
        return self.law.solver

    @property
    def horizon(self) -> int:
        """N of the controller."""
        return self.law.horizon

    @property
    def commands(self) -> str:
        """What the controller commands: rotor speeds, or the targets of an autopilot by name."""
        if isinstance(self.law, Commanding):
            return self.law.commands
        return ROTORS

    @property
    def infeasible_period(self) -> object:
        """The controller's first period since `reset` whose QP had no answer; None if there is none."""
        if isinstance(self.law, Diagnosable):
            return self.law.infeasible_period
        return None

    def reset(self, speeds: Array) -> None:
        """Restart after the command u(-1) (4,) [rad/s], at rest unless `begin` follows.

        The target before the first is hover.
        """
        self._target = self._hover
        self._fresh = True
        self._rates = np.zeros(3)
        if self.attitudes is not None:
            self.attitudes.reset()
        if self.takes_targets:
            before = self._hover.copy()
        else:
            before = speeds
        if self.guard is not None:
            before = self.guard.reset(before)
        self.law.reset(before)
        if isinstance(self.inner, TorqueIncrement):
            self.inner.reset()

    def begin(self, rates: Array) -> None:
        """Let the autopilot start, after a reset, on a vehicle that turns at body rates (3,) [rad/s]."""
        self._rates = rates.copy()

    def adopt(self, previous: object) -> None:
        """Take over what the previous pilot's controller, contract and inner loop know; a vehicle has one autopilot."""
        if not isinstance(previous, Pilot):
            if isinstance(self.law, Adopting):
                self.law.adopt(previous)
            return
        before = previous
        if isinstance(self.law, Adopting):
            self.law.adopt(before.law)
        if self.guard is not None and before.guard is not None:
            self.guard.adopt(before.guard, self.horizon)
        if isinstance(self.inner, TorqueIncrement):
            if isinstance(before.inner, TorqueIncrement):
                self.inner.adopt(before.inner)
        elif self.inner is not None and isinstance(before.inner, type(self.inner)):
            self.inner = before.inner
            self._target = before._target
            self._fresh = before._fresh

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """Return the controller's or the contract's command, with its inner loop; that is off on the ground."""
        if self.takes_targets:
            now = replace(now, acting=self._acting(now, state))
        if self.guard is None:
            command = self.law.step(now, state, reference)
        else:
            command = self.guard.step(self.law, now, state, reference)
        if self.inner is None:
            return command
        if now.phase not in GROUNDED:
            if self.attitudes is not None:
                target = self.attitudes.target(command.speeds, self._attitude(now, state))
                command = replace(command, speeds=target)
            if self.takes_targets:
                return replace(command, inner=self)
            return replace(command, inner=self.inner)
        if isinstance(self.inner, TorqueIncrement):
            self.inner.reset()
            return command
        self._target = self._hover
        self._fresh = True
        self._rates = None
        return stopped(self._slowest.copy(), self.horizon, now.phase)

    def _acting(self, now: StepInputs, state: Array) -> Array:
        """Return the target in force as the controller knows targets."""
        if self.attitudes is None or self._target.size == self._hover.size:
            return self._target
        return self.attitudes.command(self._target, self._attitude(now, state))

    def _attitude(self, now: StepInputs, state: Array) -> Array:
        """Return the measured attitude (4,); where none is measured, the one that the contract predicts."""
        if now.attitude is not None and np.isfinite(now.attitude).all():
            return now.attitude
        angles = state[ANGLES]
        if self.guard is not None and not np.isfinite(angles).all():
            angles = self.guard.state[ANGLES]
        return euler_to_quaternion(angles)

    def engage(self, command: Array, rotors: Array) -> Struct | None:
        """Let a target fly from now on, at rotor speeds (4,) [rad/s]; the autopilot is reset before its first.

        Returns:
            the autopilot's struct, where the core answers for it; None: `speeds` is to be asked.
        """
        assert self.inner is not None
        if self._fresh:
            self.inner.reset()
            if self._rates is not None and isinstance(self.inner, Settling):
                self.inner.settle(self._rates, rotors)
        self._target = command
        self._fresh = False
        if isinstance(self.inner, CompiledLoop):
            return self.inner.engage(command, rotors)
        return None

    def speeds(self, time: float, commanded: Array, rates: Array, rotors: Array, attitude: Array) -> Array:
        """See `quadsim.controller.InnerLoop`."""
        self.engage(commanded, rotors)
        assert self.inner is not None
        return self.inner.speeds(time, commanded, rates, rotors, attitude)

    def in_core(self) -> CoreController | None:
        """Return controller and contract in the core, for a flight of their own; None where they are not C's alone."""
        if self.guard is None or self.inner is not None or not isinstance(self.law, InCore):
            return None
        return self.law.in_core(self.guard.numbers)

    def predict(self, states: Array, plans: Array) -> Array | None:
        """See `quadsim.controller.Predicting`."""
        if self.guard is not None:
            return self.guard.predict(self.law, states, plans)
        if isinstance(self.law, Predicting):
            return self.law.predict(states, plans)
        return None

    def foresee(self, states: Array, commands: Array) -> Array | None:
        """See `quadsim.controller.Foreseeing`."""
        if isinstance(self.law, Foreseeing):
            return self.law.foresee(states, commands)
        return None
