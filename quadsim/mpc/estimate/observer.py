"""The disturbance observer: a force and a torque that the model omits, estimated from the measured motion.

Forces act along world x and y, and along the thrust axis: a different mass, worn rotors or thinner air scale the thrust
in any direction. Torques about the body axes are proportional to thrust, like those of a worn rotor or an offset centre
of mass. Each of these three velocities and three body rates has its own scalar disturbance, an acceleration d that
follows a random walk,

    v(k+1) = v(k) + model + tau_s d(k) + w_v,    d(k+1) = d(k) + w_d,    measured: v(k) + noise,

and the steady-state Kalman filter of this pair estimates it. With the estimate in the prediction and in the target
equilibrium, tracking has no steady-state error (Maeder, Borrelli & Morari 2009, "Linear offset-free Model
Predictive Control"; Pannocchia & Rawlings 2003).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Final, Protocol, runtime_checkable

import numpy as np
import scipy.linalg
from annotated_types import doc

from quadsim.fields import Positive
from quadsim.state import Array

LEAST_UPRIGHT: Final = 0.1
"""Smallest vertical component of the thrust axis at which changes of vertical speed are attributed to thrust."""
LONGEST_SPAN: Final = 0.25
"""Longest time between two measured states [s] that the observer compares; a sensor of 4 Hz."""


@dataclass(frozen=True, kw_only=True)
class ObserverSettings:
    """Settings of the disturbance observer: unmodelled force and torque are estimated, predicted and compensated.

    The numbers state how much of an innovation is noise and how fast disturbances change; only their ratios matter. At
    a period of 50 ms, the default estimates reach 90 % of a step of the force within 2.4 s and of the torque within
    1.25 s. That is well below the bandwidth of the loop, so that an error in the stated rotor lag does not make the two
    interact.
    """

    velocity_noise: Annotated[Positive, doc("[m/s] of a measured velocity")] = 0.05
    rate_noise: Annotated[Positive, doc("[rad/s] of a measured body rate")] = 0.05
    velocity_walk: Annotated[Positive, doc("[m/s] change of a velocity per period that no lasting force causes")] = 0.05
    rate_walk: Annotated[Positive, doc("[rad/s] as velocity_walk, for a body rate")] = 0.05
    force_walk: Annotated[Positive, doc("[m/s^2] change of the force's acceleration per period")] = 0.1
    torque_walk: Annotated[Positive, doc("[rad/s^2] change of the torque's angular acceleration per period")] = 0.2
    largest_force: Annotated[Positive, doc("[m/s^2] larger estimates are clipped")] = 5.0
    largest_torque: Annotated[Positive, doc("[rad/s^2] larger estimates are clipped")] = 30.0


@runtime_checkable
class Observing(Protocol):
    """A controller that estimates the disturbance."""

    @property
    def disturbance(self) -> Array | None:
        """(6,) accelerations [m/s^2] and angular accelerations [rad/s^2]; None where it estimates none."""
        ...


def disturbance_of(law: object) -> Array | None:
    """Return (6,) the disturbance that a controller estimates; None if it estimates none."""
    if isinstance(law, Observing):
        return law.disturbance
    return None


def observer_gain(period: float, *, noise: float, walk: float, change: float) -> tuple[float, float]:
    """Return the gains (on v, on d) of the steady-state Kalman filter of one pair, per innovation of v.

    `noise`, `walk` and `change` are the standard deviations of the measurement, w_v and w_d.
    """
    A = np.array([[1.0, period], [0.0, 1.0]])
    C = np.array([[1.0, 0.0]])
    P = scipy.linalg.solve_discrete_are(A.T, C.T, np.diag([walk**2, change**2]), np.array([[noise**2]]))
    gain = (P @ C.T / (C @ P @ C.T + noise**2)).ravel()
    return float(gain[0]), float(gain[1])


class DisturbanceObserver:
    """The numbers of the six filters, which C runs (`update_disturbance` of quadsim_math.h).

    Predictions start from the last measurement, so the estimate of v need not be stored. Measurement noise then enters
    twice, with opposite signs, and the gains are those for twice its variance.

    Estimated are accelerations [m/s^2], in a linear controller along world x, y and the thrust and in a nonlinear one
    along world x, y, z, and angular accelerations [rad/s^2] about the body axes.

    Attributes:
        gain: (6,) per innovation of velocities and body rates [1/s].
        largest: (6,) magnitudes to which estimates are clipped [m/s^2], [rad/s^2].
    """

    def __init__(self, settings: ObserverSettings, period: float) -> None:
        doubled = math.sqrt(2.0)
        _, force = observer_gain(
            period, noise=doubled * settings.velocity_noise, walk=settings.velocity_walk, change=settings.force_walk
        )
        _, torque = observer_gain(
            period, noise=doubled * settings.rate_noise, walk=settings.rate_walk, change=settings.torque_walk
        )
        self.gain = np.repeat([force, torque], 3)
        self.largest = np.repeat([settings.largest_force, settings.largest_torque], 3)
