"""The ground: what is believed of a vehicle whose feet stand, which its rotor speeds alone would have fall.

The ground carries what the rotors do not, so nothing moves: p, q and the gyro's bias stay, v = 0 and omega = 0, which
is a zero-velocity update (Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems", 2nd
ed. 2013, Sec. 15.3) at every step.  Legs that give and slide a little leave v and omega white: sigma at any instant,
forgotten after tau, so that position and attitude walk randomly with densities sigma sqrt(tau).
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from quadsim.sim.estimation.estimate import (
    ATTITUDE,
    GYRO_BIAS,
    MEAN_RATES,
    N_ERRORS,
    POSITION,
    RATES,
    VELOCITY,
    Estimate,
)
from quadsim.sim.estimation.prediction import Drive, MotionModel
from quadsim.state import Array, read_only

STILL_VELOCITY: Final = 0.1
"""Standard deviation of the velocity of a vehicle that stands, per axis [m/s]; also of one that its ground cushion has
lifted before the believed thrust could."""
STILL_RATE: Final = math.radians(0.5)
"""The same of its body rates [rad/s]: as much as a MEMS gyro's noise, so that standing is worth a sample of it."""
STILL_TIME: Final = 0.01
"""Time tau after which these velocities and rates are forgotten [s]."""


def _blocks() -> tuple[Array, Array, Array]:
    kept, variance, walk = np.ones(N_ERRORS), np.zeros(N_ERRORS), np.zeros(N_ERRORS)
    kept[VELOCITY] = kept[RATES] = 0.0
    variance[VELOCITY], variance[RATES] = STILL_VELOCITY**2, STILL_RATE**2
    walk[POSITION], walk[ATTITUDE] = STILL_TIME * STILL_VELOCITY**2, STILL_TIME * STILL_RATE**2
    return read_only(np.outer(kept, kept)), read_only(np.diag(variance)), read_only(np.diag(walk))


_KEPT, _VARIANCE, _WALK = _blocks()
"""(15, 15) each: 1 where neither velocity nor rates have a part and else 0; their variance; the growth of the rest."""


def lifts(model: MotionModel, driven: Drive) -> bool:
    """Whether rotors lift a vehicle off the ground: their thrust exceeds its weight, U > m g."""
    return driven.acceleration > model.gravity


def stand(model: MotionModel, estimate: Estimate, duration: float) -> Estimate:
    """The estimate some time later of a vehicle that stands.

    Args:
        model: the believed vehicle.
        estimate: what is believed now; of velocity and rates nothing is kept.
        duration: h [s].
    """
    mean = estimate.mean.copy()
    mean[VELOCITY] = mean[MEAN_RATES] = 0.0
    covariance = _KEPT * estimate.covariance + _VARIANCE + duration * _WALK
    covariance[GYRO_BIAS, GYRO_BIAS] += duration * model.noise[0][GYRO_BIAS, GYRO_BIAS]
    return Estimate(mean=mean, covariance=covariance)
