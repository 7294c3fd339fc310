"""Attitudes as commands: of the body rates that a controller asks for, the attitude whose error gives these rates.

An autopilot that holds an attitude q_c commands the body rates omega_c = 2 vec(q* q_c) / tau_a, axis by axis, with the
measured attitude q.  A controller that wants omega_c now therefore commands

    q_c = q (s, tau_a omega_c / 2),    s = sqrt(1 - |tau_a omega_c / 2|^2),

and predicts that omega_c shrinks as the body turns towards it (`quadsim.mpc.problem.rigidbody`).  An error of more than
180 deg does not exist: a vector part longer than 1 is shortened to 1.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np

from quadsim.controller import ATTITUDE, RATES, TARGET_SIZES
from quadsim.rotation import conjugate, multiply
from quadsim.state import Array

REMEMBERED: Final = 16
"""Commands of which it is known what the controller asked for; more are never under way in a flight that goes on."""


class AttitudeTargets:
    """Turns thrust and body rates (4,) into targets of an attitude (8,), and back.

    Attributes:
        attitude_lag: (3,) tau_a about body x, y, z [s].
    """

    def __init__(self, attitude_lag: Sequence[float]) -> None:
        self.attitude_lag = np.array(attitude_lag, float)
        self._sent: deque[tuple[Array, Array]] = deque(maxlen=REMEMBERED)

    def reset(self) -> None:
        """Forget what was commanded."""
        self._sent.clear()

    def target(self, command: Array, attitude: Array) -> Array:
        """Return T, p, q, r, w, x, y, z (8,) of a command T, p, q, r (4,) at a measured attitude wxyz (4,).

        No body rates are fed forward: p, q, r of the target are 0.
        """
        vector = 0.5 * self.attitude_lag * command[1:]
        length = math.sqrt(float(vector @ vector))
        if length > 1.0:
            vector = vector / length
        scalar = math.sqrt(max(1.0 - float(vector @ vector), 0.0))
        target = np.zeros(TARGET_SIZES[ATTITUDE])
        target[0] = command[0]
        target[4:] = multiply(attitude, np.array([scalar, *vector]))
        self._sent.append((target, command.copy()))
        return target

    def command(self, target: Array, attitude: Array) -> Array:
        """Return the thrust and the body rates (4,) that a target (8,) stands for.

        Of a target of its own these are what the controller asked for when it was commanded; of another's, what the
        target commands at a measured attitude wxyz (4,).
        """
        for sent, command in reversed(self._sent):
            if np.array_equal(sent, target):
                return command.copy()
        error = multiply(conjugate(attitude), target[4:])
        if error[0] < 0.0:  # the shorter way
            error = -error
        command = np.empty(TARGET_SIZES[RATES])
        command[0] = target[0]
        command[1:] = target[1:4] + 2.0 * error[1:] / self.attitude_lag
        return command
