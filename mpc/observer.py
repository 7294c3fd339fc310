"""What the model does not explain: a force and a torque, estimated from how the vehicle moved.

Forces act along world x and y, and along the thrust axis: another mass, worn rotors or thinner air change what thrust
does, wherever it points.  Torques about the body's axes are proportional to thrust, as those of a worn rotor or of an
offset centre of mass are.  Each of these three velocities and of the three body rates has a scalar disturbance of its
own, an acceleration d that stays as it is but for a random walk,

    v(k+1) = v(k) + model + tau_s d(k) + w_v,    d(k+1) = d(k) + w_d,    measured: v(k) + noise,

estimated by the steady-state Kalman filter of that pair.  With the estimate in the prediction and in the steady state
that the controller aims at, tracking has no steady error (Maeder, Borrelli & Morari 2009, "Linear offset-free Model
Predictive Control"; Pannocchia & Rawlings 2003).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
import scipy.linalg
from annotated_types import doc

from quadsim.fields import Positive
from quadsim.rotation import body_rates_of
from quadsim.state import ANGLES, VELOCITIES, Array

UPRIGHT: Final = 0.1
"""Smallest vertical part of the thrust axis from which on a change of vertical speed is attributed to thrust."""


@dataclass(frozen=True, kw_only=True)
class ObserverSettings:
    """Unmodelled force and torque: estimated, predicted and compensated.

    How much of a surprise is noise, and how fast disturbances change: only ratios matter.  At a period of 50 ms the
    defaults have nine tenths of a step of the force within 2.4 s and of the torque within 1.25 s: well below the
    bandwidth of the loop, so that rotors which lag otherwise than stated do not make the two fight.
    """

    velocity_noise: Annotated[Positive, doc("[m/s] of a measured velocity")] = 0.05
    rate_noise: Annotated[Positive, doc("[rad/s] of a measured body rate")] = 0.05
    velocity_walk: Annotated[Positive, doc("[m/s] change of a velocity in a period that is no lasting force")] = 0.05
    rate_walk: Annotated[Positive, doc("[rad/s] the same of a body rate")] = 0.05
    force_walk: Annotated[Positive, doc("[m/s^2] change of the force's acceleration in a period")] = 0.1
    torque_walk: Annotated[Positive, doc("[rad/s^2] change of the torque's angular acceleration in a period")] = 0.2
    largest_force: Annotated[Positive, doc("[m/s^2] larger estimates are clipped")] = 5.0
    largest_torque: Annotated[Positive, doc("[rad/s^2] larger estimates are clipped")] = 30.0


def observer_gain(period: float, *, noise: float, walk: float, change: float) -> tuple[float, float]:
    """Gains (of v, of d) of the steady-state Kalman filter of one pair, on the surprise in v.

    Standard deviations are of what is measured (`noise`), of w_v (`walk`) and of w_d (`change`).
    """
    A, C = np.array([[1.0, period], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    P = scipy.linalg.solve_discrete_are(A.T, C.T, np.diag([walk**2, change**2]), np.array([[noise**2]]))
    gain = (P @ C.T / (C @ P @ C.T + noise**2)).ravel()
    return float(gain[0]), float(gain[1])


class DisturbanceObserver:
    """The six filters, an evolving state.

    What is predicted starts from what was measured a period ago, so that the estimate of v itself is not stored: noise
    of a measurement enters twice, with opposite signs, and the gains are those for twice its variance.
    """

    def __init__(self, settings: ObserverSettings, period: float) -> None:
        doubled = math.sqrt(2.0)
        _, force = observer_gain(
            period, noise=doubled * settings.velocity_noise, walk=settings.velocity_walk, change=settings.force_walk
        )
        _, torque = observer_gain(
            period, noise=doubled * settings.rate_noise, walk=settings.rate_walk, change=settings.torque_walk
        )
        self.gain = np.repeat([force, torque], 3)  # (6,) on the surprise in velocities and rates [1/s]
        self.largest = np.repeat([settings.largest_force, settings.largest_torque], 3)
        self.reset()

    def reset(self) -> None:
        """Forget: nothing disturbs."""
        self.estimate = np.zeros(6)
        """(6,) acceleration along world x and y and along thrust [m/s^2], and angular acceleration, body, while thrust
        holds the weight [rad/s^2]."""

    def adopt(self, estimate: Array) -> None:
        """Go on from an estimate (6,)."""
        self.estimate = np.minimum(np.maximum(estimate, -self.largest), self.largest)

    def update(self, measured: Array, predicted: Array) -> None:
        """Take note of a measured state (12,) and of what was predicted for it (12,), disturbances included."""
        now, then = measured.tolist(), predicted.tolist()
        axis, rates, expected_rates = thrust_axis(now), body_rates_of(now), body_rates_of(then)
        x, y, z = (a - b for a, b in zip(now[VELOCITIES], then[VELOCITIES], strict=True))
        along = z / max(axis[2], UPRIGHT)
        velocity = x - along * axis[0], y - along * axis[1], along
        self.learn([*velocity, *(a - b for a, b in zip(rates, expected_rates, strict=True))])

    def learn(self, surprise: Sequence[float] | Array) -> None:
        """Take note of by how much three velocities and three body rates (6,) are other than predicted."""
        estimate = self.estimate + self.gain * surprise
        self.estimate = np.minimum(np.maximum(estimate, -self.largest), self.largest)


def thrust_axis(state: Sequence[float]) -> tuple[float, float, float]:
    """(3,) unit vector along which rotors push, in the world frame, of a state (12,)."""
    roll, pitch, yaw = state[ANGLES]
    ahead, left = math.cos(roll) * math.sin(pitch), -math.sin(roll)
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return cosine * ahead - sine * left, sine * ahead + cosine * left, math.cos(roll) * math.cos(pitch)
