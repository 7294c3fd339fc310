"""State completion: a whole state from one whose measured channels are partly missing.

A channel is missing if it is not finite, implausibly large, or frozen.  It is replaced by its conditional mean given
the available channels: the hover model, linearised about the estimated equilibrium (`quadsim.mpc.problem.equilibrium`),
predicts the state under the command in force, and a Kalman filter corrects it with the available channels as its only
measurements (Simon, "Optimal State Estimation", 2006, Sec.  5.1). The process noise is an acceleration, constant over a
period and white from one to the next (Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and
Navigation", 2001, Sec.  6.3.2). Available channels pass unchanged, so a complete measurement is not altered.

A group of three channels is frozen if it repeats the last period's numbers bit by bit although the prediction has moved
away from them.  A sensor slower than the controller repeats its numbers between samples; they are predicted then.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from quadsim.controller import StepInputs
from quadsim.mpc.problem.equilibrium import Trim
from quadsim.mpc.problem.heading import advance, turn
from quadsim.mpc.problem.model import LinearModel
from quadsim.rotation import body_rates_of
from quadsim.state import (
    ANGLE_RATES,
    ANGLES,
    EULER,
    EULER_RATE,
    INDEX,
    N_STATES,
    POSITION,
    REFERENCE_STATES,
    VELOCITY,
    Array,
    all_true,
    by_group,
    read_only,
)

Flags = NDArray[np.bool_]

_GROUPS: Final = tuple(np.array(group) for group in (POSITION, VELOCITY, EULER, EULER_RATE))
_ANGLES, _RATES = _GROUPS[2:]
_TURNING: Final = np.array(EULER + EULER_RATE)
_NO_RATES: Final = (math.nan, math.nan, math.nan)


PLAUSIBLE: Final = by_group(1e5, 1e3, 1e5, 1e3)
"""Largest magnitudes accepted as measurements [m, m/s, rad, rad/s]; a yaw counts its turns."""
PLAUSIBLE_REFERENCE: Final = float(PLAUSIBLE[list(REFERENCE_STATES)].min())
"""Largest magnitudes accepted in references x, y, z [m], yaw [rad]."""
UNMOVED: Final = by_group(1e-3, 5e-3, 1e-3, 2e-2)
"""Distance of the prediction from repeated numbers above which these count as frozen [same]."""
UPRIGHT: Final = 1.4
"""Pitch [rad] up to which implausible Euler rates indicate a fault of the measurement, not the singularity."""
NOISE: Final = by_group(0.01, 0.02, 0.005, 0.02)  # standard deviations of measured channels [same]
ACCELERATION: Final = (1.0, 2.0)  # standard deviations of unmodelled accelerations [m/s^2, rad/s^2]
UNKNOWN: Final = by_group(100.0, 10.0, 1.0, 1.0)
"""Standard deviations before the first measurement [m, m/s, rad, rad/s]."""


def completed_inputs(now: StepInputs, acting: Array, unseen: Array, known: Array) -> StepInputs:
    """Return a step's inputs with the command in force (4,), for the state `known` (12,) of ages `unseen` (12,).

    Attitude and body rates are omitted where those of the state are predicted.  Near a pitch of 90 deg, Euler rates are
    implausibly large, but body rates are not.
    """
    attitude = None if unseen[ANGLES].any() else now.attitude
    turned = unseen[ANGLE_RATES].any() and abs(float(known[INDEX["pitch"]])) < UPRIGHT
    rates = None if turned else now.body_rates
    return replace(now, acting=acting, unseen=unseen, attitude=attitude, body_rates=rates)


class StateCompletion:
    """Completes one state per control period.

    `unseen` (12,) is the number of periods since each channel was last measured; infinite before the first measurement.
    """

    def __init__(self, model: LinearModel) -> None:
        self._model = model
        self._measured_covariance = read_only(np.diag(NOISE**2))
        self._process = read_only(acceleration_noise(model.period))
        self.reset()

    def reset(self) -> None:
        """Restart without measurements: assume rest, level, at the origin."""
        self._state = np.zeros(N_STATES)
        self._covariance: Array = np.diag(UNKNOWN**2)
        self._last = np.full(N_STATES, np.nan)
        self._last_body_rates = _NO_RATES
        self.unseen = np.full(N_STATES, np.inf)

    def adopt(self, other: StateCompletion) -> None:
        """Take over the state of another completion."""
        self._state, self._covariance, self.unseen = other._state, other._covariance, other.unseen
        self._last, self._last_body_rates = other._last, other._last_body_rates

    def complete(self, measured: Array, acting: Array, trim: Trim, *, free: bool = True) -> Array:
        """Return the complete state (12,) now.

        Args:
            measured: (12,), in part perhaps not finite; another shape counts as no measurement.
            acting: (4,) rotor speeds in force since the last state [rad/s].
            trim: the equilibrium of the vehicle.
            free: whether the vehicle flies, as the model assumes; otherwise no channel counts as frozen.
        """
        if np.shape(measured) != (N_STATES,):
            measured = np.full(N_STATES, np.nan)
        seen = np.abs(measured) <= PLAUSIBLE  # false for NaN
        repeated = self._repeats(measured, seen)
        if all_true(seen) and not (free and np.count_nonzero(repeated)):
            return self._take(measured)
        predicted = advance(self._model, self._state, acting, trim)
        if free:
            distant = np.abs(predicted - measured) > UNMOVED
            for group in _GROUPS:
                seen[group] &= not (repeated[group].all() and distant[group].any())
            if seen.all():
                return self._take(measured)
        self._correct(predicted, measured, seen)
        self.unseen = np.where(seen, 0.0, self.unseen + 1.0)
        return self._state.copy()

    def _take(self, measured: Array) -> Array:
        self._state = np.array(measured, float)
        self._covariance = self._measured_covariance
        self.unseen = np.zeros(N_STATES)
        return self._state.copy()

    def _repeats(self, measured: Array, seen: Flags) -> Flags:
        """(12,) whether a channel repeats the numbers of the previous period.

        Body rates, which a gyro measures, are compared too: Euler rates change with the attitude.
        """
        repeated, last = np.asarray(measured == self._last), self._last_body_rates
        body_rates = body_rates_of(measured.tolist()) if all_true(seen) or seen[_TURNING].all() else _NO_RATES
        if all(abs(rate - old) <= 1e-12 + 1e-9 * abs(rate) for rate, old in zip(body_rates, last, strict=True)):
            repeated[_RATES] = True
        self._last, self._last_body_rates = np.array(measured, float), body_rates
        return repeated

    def _correct(self, predicted: Array, measured: Array, seen: Flags) -> None:
        T = turn(float(self._state[INDEX["yaw"]]))
        A = T @ self._model.A @ T.T
        P = A @ self._covariance @ A.T + self._process
        there = np.flatnonzero(seen)
        innovation = measured[there] - predicted[there]
        rows = P[there]
        S = rows[:, there] + self._measured_covariance[np.ix_(there, there)]
        K = np.linalg.solve(S, rows).T
        self._state = predicted + K @ innovation
        self._state[there] = measured[there]
        np.clip(self._state, -PLAUSIBLE, PLAUSIBLE, out=self._state)
        P = P - K @ rows
        self._covariance = 0.5 * (P + P.T)


def acceleration_noise(period: float) -> Array:
    """(12, 12) g g' sigma^2 with g = [tau^2 / 2, tau] for each of the six pairs of a coordinate and its rate."""
    Q = np.zeros((N_STATES, N_STATES))
    gain = np.array([0.5 * period**2, period])
    for first in range(0, N_STATES, 2):
        sigma = ACCELERATION[first >= EULER[0]]
        Q[first : first + 2, first : first + 2] = sigma**2 * np.outer(gain, gain)
    return Q
