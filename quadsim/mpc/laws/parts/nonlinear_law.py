"""What a nonlinear controller is told, as `quadsim_nonlinear.c` takes it: measured states and references."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from quadsim.controller import StepInputs
from quadsim.motion import Motion
from quadsim.mpc.problem.rigidbody import N_BODY
from quadsim.state import N_STATES, Array
from quadsim.vehicle import N_ROTORS

WIDTH_OF_MOTION: Final = N_BODY + N_ROTORS
"""Numbers in a row of a motion: position, quaternion, velocity, body rates, thrusts."""


def measured_state(now: StepInputs, state: Array) -> Array:
    """(19,) a state, quaternion and body rates as an exported controller takes them; NaN for what is not measured."""
    measured = np.full(N_STATES + 7, math.nan)
    measured[:N_STATES] = state
    if now.attitude is not None:
        measured[N_STATES : N_STATES + 4] = now.attitude
    if now.body_rates is not None:
        measured[N_STATES + 4 :] = now.body_rates
    return measured


def reference_rows(now: StepInputs, reference: Array, rows: int) -> Array:
    """(M, 17) so many samples of a period's motion, of 0 its reference (N, 4), as an exported controller takes them."""
    if rows == 0 or now.motion is None:
        return reference
    samples = np.zeros((rows, WIDTH_OF_MOTION))
    put_motion(now.motion, samples)
    return samples


def put_motion(motion: Motion, rows: Array) -> None:
    """Write the samples of a motion from now on into rows (M, 17); past the end the last."""
    count = min(len(motion), len(rows))
    parts = (motion.position, motion.attitude, motion.velocity, motion.body_rates)
    first = 0
    for part in parts:
        rows[:count, first : first + part.shape[1]] = part[:count]
        first += part.shape[1]
    rows[:count, first:] = motion.thrusts[:count]
    rows[count:] = rows[count - 1]
