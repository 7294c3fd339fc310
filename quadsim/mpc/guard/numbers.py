"""The numbers of the fallback contract, which `quadsim/mpc/c/quadsim_guard.c` flies by.

Completion is by a Kalman filter on the hover model, whose process noise is an acceleration, constant over a period and
white from one to the next (Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation",
2001, Sec.  6.3.2).
Level hover is the LQR of the infinite horizon on the same model (`HoverGain`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from quadsim.controller import LARGEST_SPEED
from quadsim.mpc.estimate.disturbance import SAME_TIME
from quadsim.mpc.estimate.observer import LONGEST_SPAN
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.guard.settings import FallbackSettings
from quadsim.mpc.problem.heading import slope
from quadsim.mpc.problem.model import LinearModel
from quadsim.mpc.problem.regulator import lqr
from quadsim.mpc.solvers.core_tables import NO_BOUND
from quadsim.state import INDEX, REFERENCE_STATES, Array, by_group, read_only
from quadsim.vehicle import N_ROTORS

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

ACCEPTABLE: Final = by_group(0.5, 1.0, 0.2, 1.0)  # [m], [m/s], [rad], also for yaw, [rad/s]
ACCEPTABLE_ACCELERATION: Final = (2.0, 8.0, 8.0, 2.0)  # along z [m/s^2], about x, y and z [rad/s^2]
LARGEST_CLIMB: Final = 2.0
"""Largest acceleration along z [m/s^2] that height errors demand beyond the trim: rotors keep the range that levels the
vehicle."""
LARGEST_TURN: Final = 2.0  # the same for yaw [rad/s^2]
MOST_PERIODS: Final = 2**30 - 1
"""Most periods that a time of the fallback contract has in C."""
_ROUNDING: Final = 1e-9  # [s] of times that are multiples of the period

_SIDEWAYS: Final = [INDEX[name] for name in ("x", "vx", "y", "vy")]
_TILTS: Final = [INDEX["roll"], INDEX["pitch"]]
_ROLL_PITCH: Final = [1, 2]  # rows of an acceleration (4,)


@dataclass(frozen=True, kw_only=True)
class HoverGain:
    """The LQR of hover: acceleration = -gain e, change of commands = inverse acceleration.

    It holds in the heading frame, where the model at zero yaw holds for any yaw.  The weights follow Bryson's rule
    (Bryson and Ho, "Applied Optimal Control", 1975, Sec.  5.2), one over the square of the largest acceptable value,
    for states and for the *accelerations* that inputs cause, not for rotor speeds: the closed loop is then the same for
    every vehicle.
    """

    gain: Array  # (4, 12) K, for errors in the heading frame
    slope: Array  # (4, 4) S, from commands to accelerations along z and about x, y, z
    inverse: Array  # (4, 4) of S
    lean: Array  # (2, 4) tilt that an error of x, vx, y, vy demands: roll, pitch

    @classmethod
    def of_model(cls, model: LinearModel) -> HoverGain:
        """Compute the gain of a model of level hover."""
        there = slope(model)
        inverse = np.asarray(np.linalg.inv(there), float)
        pushed = model.B @ inverse  # xi(k+1) = A xi(k) + pushed acceleration
        Q = np.diag(ACCEPTABLE**-2.0)
        R = np.diag(np.array(ACCEPTABLE_ACCELERATION) ** -2.0)
        gain = lqr(model.A, pushed, Q, R)
        rows = gain[_ROLL_PITCH]
        lean = np.asarray(np.linalg.solve(rows[:, _TILTS], rows[:, _SIDEWAYS]), float)
        return cls(gain=read_only(gain), slope=read_only(there), inverse=read_only(inverse), lean=read_only(lean))


def acceleration_noise(period: float, sigma: float) -> Array:
    """(2, 2) covariance of a coordinate and its rate after a period of an acceleration with deviation `sigma`.

    It is g g' sigma^2 with g = [tau^2 / 2, tau].
    """
    gain = np.array([0.5 * period**2, period])
    return sigma**2 * np.outer(gain, gain)


def fallback_numbers(
    model: LinearModel, bounds: ActuatorBounds | None, settings: FallbackSettings
) -> dict[str, int | float | Array]:
    """Return the members of a `quadsim_fallback`.

    Args:
        model: of level hover.
        bounds: on commands; None for none.
        settings: the table, with the tilt that its controller's bounds leave.
    """
    period = model.period
    hover = HoverGain.of_model(model)
    assert settings.tilt is not None
    process = [acceleration_noise(period, sigma)[np.triu_indices(2)] for sigma in ACCELERATION]
    most = step_most = np.full(N_ROTORS, NO_BOUND)
    least = step_least = -most
    if bounds is not None:
        least = np.clip(bounds.u_min, -NO_BOUND, NO_BOUND)
        most = np.clip(bounds.u_max, -NO_BOUND, NO_BOUND)
        step_least = np.clip(bounds.delta_min, -NO_BOUND, NO_BOUND)
        step_most = np.clip(bounds.delta_max, -NO_BOUND, NO_BOUND)
    return {
        "targets": int(model.targets),
        "plan_age": _periods(settings.plan_age + _ROUNDING, period),
        "hover_periods": min(math.ceil((settings.hover - _ROUNDING) / period), MOST_PERIODS),
        "unseen": _periods(settings.unseen, period),
        "compared": _periods(LONGEST_SPAN + SAME_TIME, period),
        "sink": settings.sink,
        "sunk": settings.sink * period,
        "settled": settings.settled,
        "tilt": math.radians(settings.tilt),
        "climb": LARGEST_CLIMB,
        "turn": LARGEST_TURN,
        "largest_command": LARGEST_SPEED,
        "largest_reference": PLAUSIBLE_REFERENCE,
        "distance": settings.distance,
        "upright": UPRIGHT,
        "plausible": PLAUSIBLE,
        "unmoved": UNMOVED,
        "noise": NOISE**2,
        "unknown": UNKNOWN**2,
        "process": np.concatenate(process),
        "hover": model.u_bar,
        "least": least,
        "most": most,
        "step_least": step_least,
        "step_most": step_most,
        "A": model.A,
        "B": model.B,
        "gain": hover.gain,
        "lean": hover.lean,
        "slope": hover.slope[0],
        "inverse": hover.inverse,
    }


def _periods(time: float, period: float) -> int:
    """Return the most periods that last no longer than a time [s]."""
    count = math.floor(time / period)
    for most in (count + 1, count):
        if most * period <= time:
            return min(most, MOST_PERIODS)
    return min(count - 1, MOST_PERIODS)
