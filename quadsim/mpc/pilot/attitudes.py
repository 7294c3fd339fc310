"""Attitudes as commands: the body rates that a law asks for, as the attitude whose error makes an autopilot turn so.

An autopilot that holds an attitude q_c commands the body rates omega_c = 2 vec(q* q_c) / tau_a, axis by axis, with the
measured attitude q.  A law that wants omega_c now therefore commands

    q_c = q (s, tau_a omega_c / 2),    s = sqrt(1 - |tau_a omega_c / 2|^2),

and predicts that omega_c shrinks as the body turns towards it (`quadsim.mpc.problem.rigidbody`).  An error of more than
180 deg does not exist: a vector part longer than 1 is shortened to 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from quadsim.controller import ATTITUDE, TARGET_SIZES
from quadsim.rotation import conjugate, multiply
from quadsim.state import Array


class AttitudeTargets:
    """Turns thrust and body rates (4,) into targets of an attitude (8,), and back.

    Attributes:
        attitude_lag: (3,) tau_a about body x, y, z [s].
    """

    def __init__(self, attitude_lag: Sequence[float]) -> None:
        self.attitude_lag = np.array(attitude_lag, float)

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
        return target

    def command(self, target: Array, attitude: Array) -> Array:
        """Return the thrust and the body rates (4,) that a target (8,) commands at a measured attitude wxyz (4,)."""
        error = multiply(conjugate(attitude), target[4:])
        if error[0] < 0.0:  # the shorter way
            error = -error
        command = np.empty(TARGET_SIZES[ATTITUDE] // 2)
        command[0] = target[0]
        command[1:] = target[1:4] + 2.0 * error[1:] / self.attitude_lag
        return command
