"""Controller parameters from a vehicle's parameters: bandwidths, and the weights that give them.

1. *Bandwidth.*  From rotor speeds to a place there are four integrators.  The optimum of q x^2 + r u^2 on them is a
   Butterworth pattern of radius w (Anderson and Moore, "Optimal Control", 1990, Sec. 5.4), with
   w^8 = (g beta)^2 q / r and beta the angular acceleration per rotor speed; of two integrators, w^4 = beta^2 q / r.
   w is the smallest of
   - 1 / (`LAG_RATIO` (T + tau / 2)), T the rotors' time constant and tau the period: the loop then stands about
     0.8 (T + tau / 2) more delay than it knows of (`delay_margin`; the tests measure it);
   - 0.5 sqrt(alpha / tilt), alpha the angular acceleration in reserve: the largest tilt is reached and left within
     2 sqrt(tilt / alpha) = 1 / w;
   - `FASTEST_LOOP`, so that a period of 10 ms or more is enough.
2. *Period*: the longest with tau w <= `PERIOD_SHARE`, 40 samples in each period of the loop's own motion (Astroem and
   Wittenmark, "Computer-Controlled Systems", 1997, recommend 15 to 60).
3. *Horizon*: `HORIZON_TIMES` / w, in which the loop's own motion has died out.
4. *Weights* by Bryson's rule, 1 / (largest accepted deviation)^2 (Bryson and Ho, "Applied Optimal Control", 1975): the
   place deviates by what the tilt bound itself would answer, g tan(tilt) / w^2; the rotor speed's weight follows from
   w by 1., those of height and heading likewise from theirs.  Changes of rotor speeds cost as much as the speeds
   themselves at `MOVE_RATIO` w.
5. *Level speed*: that at which a tilt grows by Munk's moment at the rate w.  A pole p > 0 requires a bandwidth above
   p M / (M - 1), M the peak of the complementary sensitivity (Skogestad and Postlethwaite, "Multivariable Feedback
   Control", 2005, Sec. 5.9): w = p is where no peak is large enough; at 60 % of that speed M is 2.5 or more.  Without
   lag the Butterworth pattern itself is stable up to p = 2^(1/4) w (Hurwitz).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import scipy.linalg

from quadsim.errors import ParameterError
from quadsim.features.design.authority import Authority, authority
from quadsim.mpc.problem.model import continuous_model, discretise
from quadsim.state import INDEX, Array
from quadsim.ties import TIE_SHARE, first_smallest
from quadsim.vehicle import N_ROTORS, Vehicle

PERIODS: Final = (0.05, 0.04, 0.025, 0.02, 0.01)
"""Control periods to choose from [s], whole multiples of the physics step."""
LAG_RATIO: Final = 2.5  # 1 / w over the lag and half a period
FASTEST_LOOP: Final = 6.0  # largest bandwidth [rad/s]
STEEPEST: Final = math.radians(40.0)
"""Largest tilt bound [rad]: at hover the model takes tan(tilt) for tilt, 20 % less at 40 deg."""
LEAST_TILT = 1.0
LARGEST_TILT = 80.0
"""Range of a tilt bound that replaces that of the rules [deg]."""
THRUST_SHARE: Final = 0.85  # share of the thrust that holds the vehicle at the tilt bound; the rest is for torques
PERIOD_SHARE: Final = 0.16  # largest w tau
HORIZON_TIMES: Final = 5.0  # horizon times w
HEIGHT_RATIO: Final = 1.5  # bandwidth of height over that of the place: two integrators less
HEIGHT_STEP: Final = 0.25  # deviation of the height that the whole reserve of thrust answers [m]
HEADING_RATIO: Final = 0.7  # bandwidth of the heading over that of the place
HEADING_STEP: Final = 0.5  # deviation of the heading that the whole torque in reserve answers [rad]
LEAST_RESERVE: Final = 1e-6
"""Smallest reserve of acceleration [m/s^2] and angular acceleration [rad/s^2] for which a design exists."""
LONGEST: Final = 2.0  # delays beyond are not looked for [s]
_HALVINGS: Final = 14
MOVE_RATIO: Final = 4.0  # frequency at which changes of rotor speeds cost as much as these, over w


@dataclass(frozen=True, kw_only=True)
class Design:
    """Numbers of `[controller] type = "robust"` for a vehicle."""

    authority: Authority  # what they follow from
    period: float  # tau [s]
    horizon: int  # N [periods]
    tilt: float  # bound on roll and on pitch [rad]
    tilt_stated: bool  # whether somebody gave it; else it is by rule
    bandwidth: float  # w of x and y [rad/s]
    limited_by: Literal["lag", "torque", "period"]  # what w is the limit of
    height: float  # bandwidth of z [rad/s]
    heading: float  # bandwidth of yaw [rad/s]
    deviation: float  # accepted of x and y [m]
    weights: tuple[float, float, float]  # of x and y [1/m^2], z [1/m^2] and yaw [1/rad^2]
    speed_weight: float  # of a rotor's speed [s^2/rad^2]
    move_weight: float  # of its change from period to period [s^2/rad^2]
    slew: tuple[float, float]  # largest changes of a command from one period to the next, down and up [rad/s]
    fastest: float  # level speed [m/s] at which Munk's moment outruns the loop; infinite without body drag

    @property
    def acceleration(self) -> float:
        """Largest level acceleration within the tilt bound, over that of gravity [-]."""
        return math.tan(self.tilt)


def design_for(vehicle: Vehicle, tilt: float | None = None) -> Design:
    """The numbers for a vehicle; see the module.  A tilt bound [deg] replaces that of the rules.

    Raises:
        ParameterError: hover leaves no thrust or no torque in reserve, or the rotors do not carry the weight at this
            tilt.
    """
    can = authority(vehicle)
    if min(can.climb, can.sink, *can.turning) < LEAST_RESERVE:
        rule = f"further from its hover speed, {vehicle.hover_speed:.4g} rad/s, or nothing is left to control it with"
        side = ("speed_max", "speed_min")[first_smallest([can.climb, can.sink], TIE_SHARE * vehicle.gravity)]
        raise ParameterError("vehicle", side, getattr(vehicle, side), rule)
    if tilt is None:
        bound = _tilt_bound(can)
    else:
        bound = _stated_tilt(can, tilt)
    bandwidth, limited_by, period = _bandwidth(can, bound)
    height = min(HEIGHT_RATIO * bandwidth, math.sqrt(min(can.climb, can.sink) / HEIGHT_STEP))
    heading = min(HEADING_RATIO * bandwidth, math.sqrt(can.turning[2] / HEADING_STEP))
    _, B = continuous_model(vehicle)
    lift, roll, pitch, yaw = (
        float(np.linalg.norm(B[INDEX[name]])) for name in ("vz", "roll_rate", "pitch_rate", "yaw_rate")
    )
    deviation = vehicle.gravity * math.tan(bound) / bandwidth**2
    place = deviation**-2.0
    speed = place * (vehicle.gravity * min(roll, pitch)) ** 2 / bandwidth**8
    return Design(
        authority=can,
        period=period,
        horizon=math.ceil(HORIZON_TIMES / (bandwidth * period)),
        tilt=bound,
        tilt_stated=tilt is not None,
        bandwidth=bandwidth,
        limited_by=limited_by,
        height=height,
        heading=heading,
        deviation=deviation,
        weights=(place, speed * height**4 / lift**2, speed * heading**4 / yaw**2),
        speed_weight=speed,
        move_weight=speed / (MOVE_RATIO * bandwidth * period) ** 2,
        slew=(
            -(float(vehicle.hover_speeds.min()) - vehicle.speed_min) * _reached(period, vehicle.rotor_fall),
            (vehicle.speed_max - float(vehicle.hover_speeds.max())) * _reached(period, vehicle.rotor_rise),
        ),
        fastest=bandwidth / can.munk if can.munk else math.inf,
    )


def _tilt_bound(can: Authority) -> float:
    """The tilt bound [rad] by rule; a vehicle that barely hovers keeps a third of the tilt that it can hold."""
    held = math.acos(min(1.0, 1.0 / (THRUST_SHARE * can.thrust_to_weight)))
    return max(min(STEEPEST, held), can.steady_tilt / 3.0)


def _stated_tilt(can: Authority, tilt: float) -> float:
    """A tilt bound [deg] in radians, if the vehicle can hold it."""
    steady = math.degrees(can.steady_tilt)
    if not LEAST_TILT <= tilt <= min(steady, LARGEST_TILT):
        if steady < LARGEST_TILT:
            most = f"{steady:.3g}, up to where the rotors carry the weight"
        else:
            most = f"{LARGEST_TILT:g}"
        raise ParameterError("", "--tilt", tilt, f"between {LEAST_TILT:g} and {most} [deg]")
    return math.radians(tilt)


def _bandwidth(can: Authority, tilt: float) -> tuple[float, Literal["lag", "torque", "period"], float]:
    """The bandwidth w [rad/s], what limits it, and the period [s]."""
    for period in PERIODS:
        limits: dict[Literal["lag", "torque", "period"], float] = {
            "lag": 1.0 / (LAG_RATIO * (can.lag + 0.5 * period)),
            "torque": 0.5 * math.sqrt(min(can.turning[:2]) / tilt),
            "period": FASTEST_LOOP,
        }
        bandwidth = min(limits.values())
        if bandwidth * period <= PERIOD_SHARE:
            break
    limited_by = [*limits][first_smallest([*limits.values()], TIE_SHARE * bandwidth)]
    return bandwidth, limited_by, period


def _reached(period: float, lag: float | None) -> float:
    """Share of a step that a rotor's speed makes in a period."""
    if lag is None:
        return 1.0
    return 1.0 - math.exp(-period / lag)


def gain(vehicle: Vehicle, tuning: Design) -> Array:
    """K (4, n + 4) of u = -K [x; u(k-1)], deviations from hover: the weights' optimum over an infinite horizon.

    Changes of inputs are part of the cost, so the last input is a state; n is 12, or 16 with rotors that lag.
    """
    A, B = discretise(*continuous_model(vehicle, vehicle.rotor_rise or 0.0), tuning.period)
    n = len(A)
    Q = np.zeros((n, n))
    place, height, heading = tuning.weights
    for name, weight in (("x", place), ("y", place), ("z", height), ("yaw", heading)):
        Q[INDEX[name], INDEX[name]] = weight
    D = tuning.move_weight * np.eye(N_ROTORS)
    R = tuning.speed_weight * np.eye(N_ROTORS)
    A = scipy.linalg.block_diag(A, np.zeros((N_ROTORS, N_ROTORS)))
    B = np.vstack([B, np.eye(N_ROTORS)])
    cross = np.vstack([np.zeros((n, N_ROTORS)), -D])
    P = scipy.linalg.solve_discrete_are(A, B, scipy.linalg.block_diag(Q, D), R + D, s=cross)
    return np.asarray(np.linalg.solve(R + D + B.T @ P @ B, B.T @ P @ A + cross.T))


def is_stable(vehicle: Vehicle, tuning: Design, K: Array, delay: float) -> bool:
    """Whether the loop of a gain is stable where commands act some time [s] later than it knows of."""
    A_c, B_c = continuous_model(vehicle, vehicle.rotor_rise or 0.0)
    n = len(A_c)
    period = tuning.period
    whole = int(delay / period + 1e-9)
    late = max(delay - whole * period, 0.0)
    A, _ = discretise(A_c, B_c, period)
    rest, newer = discretise(A_c, B_c, period - late)
    older = rest @ discretise(A_c, B_c, late)[1]
    # States: x, u(k-1) .. u(k-whole-1); u(k-whole-1) acts until `late`, then u(k-whole).
    size = n + N_ROTORS * (whole + 1)
    closed = np.zeros((size, size))
    entry = np.zeros((size, N_ROTORS))
    closed[:n, :n] = A
    closed[:n, size - N_ROTORS :] = older
    if whole == 0:
        entry[:n] = newer
    else:
        closed[:n, size - 2 * N_ROTORS : size - N_ROTORS] += newer
    entry[n : n + N_ROTORS] = np.eye(N_ROTORS)
    closed[n + N_ROTORS :, n : size - N_ROTORS] = np.eye(N_ROTORS * whole)
    closed[:, : n + N_ROTORS] -= entry @ K
    return float(np.abs(np.linalg.eigvals(closed)).max()) < 1.0


def delay_margin(vehicle: Vehicle, tuning: Design) -> float:
    """Shortest delay [s] beyond what the model knows of at which the loop is no longer stable, to a thousandth."""
    K = gain(vehicle, tuning)
    low = 0.0
    high = 1e-3
    while high < LONGEST and is_stable(vehicle, tuning, K, high):
        low = high
        high = 1.5 * high
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if is_stable(vehicle, tuning, K, middle):
            low, high = (middle, high)
        else:
            low, high = (low, middle)
    return low
