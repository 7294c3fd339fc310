"""Where a controller's model contradicts the flight: what it predicted for a period later, against what was flown.

Compared are the changes over each control period of the states that a command drives, velocities and Euler rates, by
their correlation and their standard deviations (`_error_of`).  `quadsim.rollout.flown` has the sentence in a summary.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from quadsim.controller import MISSED, Phase
from quadsim.flight.log import ControlLog
from quadsim.state import INDEX, STATE_UNITS, Array, shown_unit, tilt

WRONG_ERROR: Final = 2.0  # least mean square of the error of a wrong model, over that of predicting no change
LEAST_CORRELATION: Final = 0.9  # least magnitude of the correlation of changes that belong together
FEWEST_PERIODS: Final = 5  # compared periods in which a change must be predicted
SMALLEST_ACCELERATION: Final = 0.2  # predicted accelerations below it do not count [m/s^2, rad/s^2]
STEEPEST_COMPARED: Final = 45.0  # tilt up to which periods are compared [deg]: beyond it, Euler rates are no axes
LONGEST_DELAY: Final = 0.5  # share of a period by which a command may be late: a later one acts in the next period
_MOTIONS: Final = {
    "vx": ("moves", "along x"),
    "vy": ("moves", "along y"),
    "vz": ("moves", "along z"),
    "roll_rate": ("turns", "about x"),
    "pitch_rate": ("turns", "about y"),
    "yaw_rate": ("turns", "about z"),
}


@dataclass(frozen=True, kw_only=True)
class ModelError:
    """A state that a model gets wrong.

    Attributes:
        state: its name.
        unit: of the changes.
        time: start of the first period in which the change was predicted wrongly [s].
        predicted: predicted change in this period.
        flown: flown change in this period.
        correlation: of predicted and flown changes over the flight.
        ratio: of their standard deviations, predicted over flown.
    """

    state: str
    unit: str
    time: float
    predicted: float
    flown: float
    correlation: float
    ratio: float

    @property
    def sentence(self) -> str:
        """What is wrong, after `your model` or the like."""
        verb, axis = _MOTIONS[self.state]
        if self.correlation > 0.0:
            what = f"{verb} {self.ratio:.2g} times as much as the vehicle {axis}"
        else:
            what = f"{verb} the wrong way {axis}"
        unit, scale = shown_unit(self.unit)
        return (
            f"{what}: in the period from {self.time:.4g} s it predicted {scale * self.predicted:+.2g}, "
            f"flown {scale * self.flown:+.2g} {unit}"
        )


def model_errors(log: ControlLog, foreseen: Array | None) -> list[ModelError]:
    """Return the states that a model gets wrong, in the order in which it does.

    Args:
        log: the flight.
        foreseen: (K, 12) states predicted in each period for the next one, NaN in periods without a prediction; None
            if there was none.
    """
    if foreseen is None or log.t.size <= FEWEST_PERIODS:
        return []
    compared = _compared(log, foreseen)
    if np.count_nonzero(compared) < FEWEST_PERIODS:
        return []
    period = float(log.t[1] - log.t[0])
    times = log.t[:-1][compared]
    errors = []
    for state in _MOTIONS:
        i = INDEX[state]
        predicted = (foreseen[:-1, i] - log.state[:-1, i])[compared]
        flown = np.diff(log.truth[:, i])[compared]
        error = _error_of(state, times, predicted, flown, smallest=SMALLEST_ACCELERATION * period)
        if error is not None:
            errors.append(error)
    return sorted(errors, key=lambda error: error.time)


def model_report(log: ControlLog, foreseen: Array | None, owner: str) -> dict[str, Any] | None:
    """Return `sentence` and `states` of what a model gets wrong; None if it gets nothing wrong.

    Args:
        log: the flight.
        foreseen: as of `model_errors`.
        owner: whose model it is, as `your model`.
    """
    errors = model_errors(log, foreseen)
    if not errors:
        return None
    states = [vars(error) for error in errors]
    return {"sentence": f"{owner} {errors[0].sentence}", "states": states}


def _compared(log: ControlLog, foreseen: Array) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return (K - 1,) in which periods the command acts at once, in the air, near level, with a prediction."""
    period = float(log.t[1] - log.t[0])
    in_air = np.array([phase == Phase.FLYING for phase in log.phase])
    arrived = np.array([status != MISSED for status in log.status])
    in_time = (log.delay < LONGEST_DELAY * period) & arrived
    level = np.degrees(tilt(log.truth)) <= STEEPEST_COMPARED
    predicted = np.isfinite(foreseen).all(axis=1) & np.isfinite(log.state).all(axis=1)
    starts = in_air & in_time & level & predicted
    ends = in_air & level & np.isfinite(log.truth).all(axis=1)
    return np.asarray(starts[:-1] & ends[1:])


def _error_of(state: str, times: Array, predicted: Array, flown: Array, *, smallest: float) -> ModelError | None:
    """Return how the model gets a state wrong, from changes (M,) at times (M,) [s]; None if it does not.

    With sigma_p and sigma_f the standard deviations of the predicted and the flown changes, rho their correlation and
    s = sigma_p / sigma_f, the mean square of the error is

        E = 1 - 2 rho s + s^2    [of that of the flown changes; 1: a prediction of no change].

    The model is wrong where E is at least `WRONG_ERROR` though the two belong together, |rho| at least
    `LEAST_CORRELATION`.  Wind, wear and pushes that a model does not know add to the flown changes, and noise to the
    predicted ones: they lower |rho|, or shift the means, which do not count.  A reversed sign has rho = -1 and E = 4.
    """
    sigma_predicted = float(predicted.std())
    sigma_flown = float(flown.std())
    large = np.abs(predicted) >= smallest
    if sigma_predicted < smallest or sigma_flown == 0.0 or np.count_nonzero(large) < FEWEST_PERIODS:
        return None
    covariance = float(np.mean((predicted - predicted.mean()) * (flown - flown.mean())))
    correlation = covariance / (sigma_predicted * sigma_flown)
    ratio = sigma_predicted / sigma_flown
    mean_square = 1.0 - 2.0 * correlation * ratio + ratio**2
    if abs(correlation) < LEAST_CORRELATION or mean_square < WRONG_ERROR:
        return None
    wrong = large & (np.abs(predicted - flown) > np.abs(flown))
    if not wrong.any():
        return None
    first = int(np.argmax(wrong))
    return ModelError(
        state=state,
        unit=STATE_UNITS[INDEX[state]],
        time=float(times[first]),
        predicted=float(predicted[first]),
        flown=float(flown[first]),
        correlation=correlation,
        ratio=ratio,
    )
