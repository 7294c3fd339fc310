"""Controller parameters from a vehicle's parameters: the bandwidth w of x and y, and the weights that give it.

w = min(1 / (`LAG_RATIO` (T + tau / 2)), 0.5 sqrt(alpha / tilt), `FASTEST_LOOP`), with lag T, period tau, angular
acceleration alpha in reserve (`authority.py`); speed_weight = x_weight (g beta)^2 / w^8, beta the angular acceleration
per rotor speed.  Each function states its rule and its source.  `first_scenario.py` writes the result as a file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import scipy.linalg

from quadsim.errors import ParameterError
from quadsim.features.design.authority import Authority, control_authority
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
LONGEST: Final = 2.0  # longest delay that `delay_margin` tries [s]
_HALVINGS: Final = 14
LimitedBy = Literal["lag", "torque", "period"]
"""What limits the bandwidth: the rotors' lag, the torque in reserve, or the shortest period."""
MOVE_RATIO: Final = 4.0  # frequency at which changes of rotor speeds cost as much as these, over w


@dataclass(frozen=True, kw_only=True)
class Design:
    """A linear MPC for a vehicle: the numbers of `[controller] type = "robust"`."""

    authority: Authority  # of the vehicle, from which they follow
    period: float  # tau [s]
    horizon: int  # N [periods]
    tilt: float  # bound on roll and on pitch [rad]
    tilt_stated: bool  # whether it was stated; otherwise it is by rule
    bandwidth: float  # w of x and y [rad/s]
    limited_by: LimitedBy  # what keeps w from being larger
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
    """Return the numbers for a vehicle.

    Horizon: `HORIZON_TIMES` / w, in which the loop's own motion has died out.  Changes of rotor speeds cost as much as
    the speeds themselves at `MOVE_RATIO` w.

    Level speed: that at which a tilt grows by Munk's moment at the rate w.  A pole p > 0 requires a bandwidth above
    p M / (M - 1), M the peak of the complementary sensitivity (Skogestad and Postlethwaite, "Multivariable Feedback
    Control", 2005, Sec. 5.9): w = p is where no peak is large enough; at 60 % of that speed M is 2.5 or more.  Without
    lag the Butterworth pattern itself is stable up to p = 2^(1/4) w (Hurwitz).

    Args:
        vehicle: its parameters.
        tilt: tilt bound [deg] that replaces that of the rules.

    Raises:
        ParameterError: hover leaves no thrust or no torque in reserve, or the rotors do not carry the weight at this
            tilt.
    """
    authority = control_authority(vehicle)
    _require_reserves(vehicle, authority)
    if tilt is None:
        bound = _tilt_bound(authority)
    else:
        bound = _stated_tilt(authority, tilt)
    bandwidth, limited_by, period = _bandwidth(authority, bound)
    height = min(HEIGHT_RATIO * bandwidth, math.sqrt(min(authority.climb, authority.sink) / HEIGHT_STEP))
    heading = min(HEADING_RATIO * bandwidth, math.sqrt(authority.turning[2] / HEADING_STEP))
    deviation = vehicle.gravity * math.tan(bound) / bandwidth**2
    weights, speed_weight = _weights(vehicle, deviation, bandwidth, height, heading)
    if authority.munk:
        fastest = bandwidth / authority.munk
    else:
        fastest = math.inf
    return Design(
        authority=authority,
        period=period,
        horizon=math.ceil(HORIZON_TIMES / (bandwidth * period)),
        tilt=bound,
        tilt_stated=tilt is not None,
        bandwidth=bandwidth,
        limited_by=limited_by,
        height=height,
        heading=heading,
        deviation=deviation,
        weights=weights,
        speed_weight=speed_weight,
        move_weight=speed_weight / (MOVE_RATIO * bandwidth * period) ** 2,
        slew=_slew(vehicle, period),
        fastest=fastest,
    )


def _require_reserves(vehicle: Vehicle, authority: Authority) -> None:
    """Refuse a vehicle whose hover leaves no thrust or no torque to control it with."""
    if min(authority.climb, authority.sink, *authority.turning) >= LEAST_RESERVE:
        return
    smaller = first_smallest([authority.climb, authority.sink], TIE_SHARE * vehicle.gravity)
    side = ("speed_max", "speed_min")[smaller]
    rule = f"further from its hover speed, {vehicle.hover_speed:.4g} rad/s, or nothing is left to control it with"
    raise ParameterError("vehicle", side, getattr(vehicle, side), rule)


def _weights(
    vehicle: Vehicle, deviation: float, bandwidth: float, height: float, heading: float
) -> tuple[tuple[float, float, float], float]:
    """Return the weights of position, height and heading, and that of a rotor's speed [s^2/rad^2].

    Bryson's rule, 1 / (largest accepted deviation)^2 (Bryson and Ho, "Applied Optimal Control", 1975): the position
    deviates by what the tilt bound itself would answer, g tan(tilt) / w^2.

    From rotor speeds to x there are four integrators.  The optimum of q x^2 + r u^2 on them is a Butterworth pattern
    of radius w (Anderson and Moore, "Optimal Control", 1990, Sec. 5.4), with w^8 = (g beta)^2 q / r and beta the
    angular acceleration per rotor speed; of two integrators, w^4 = beta^2 q / r.

    Args:
        vehicle: its model at hover.
        deviation: accepted of x and y [m].
        bandwidth: of x and y [rad/s].
        height: bandwidth of z [rad/s].
        heading: bandwidth of yaw [rad/s].
    """
    _, B = continuous_model(vehicle)
    lift = float(np.linalg.norm(B[INDEX["vz"]]))
    roll = float(np.linalg.norm(B[INDEX["roll_rate"]]))
    pitch = float(np.linalg.norm(B[INDEX["pitch_rate"]]))
    yaw = float(np.linalg.norm(B[INDEX["yaw_rate"]]))
    position_weight = deviation**-2.0
    speed_weight = position_weight * (vehicle.gravity * min(roll, pitch)) ** 2 / bandwidth**8
    height_weight = speed_weight * height**4 / lift**2
    heading_weight = speed_weight * heading**4 / yaw**2
    return (position_weight, height_weight, heading_weight), speed_weight


def _slew(vehicle: Vehicle, period: float) -> tuple[float, float]:
    """Return the largest steps of a rotor's command from hover, down and up [rad/s]: what it reaches in a period."""
    below = float(vehicle.hover_speeds.min()) - vehicle.speed_min
    above = vehicle.speed_max - float(vehicle.hover_speeds.max())
    return -below * _reached(period, vehicle.rotor_fall), above * _reached(period, vehicle.rotor_rise)


def _tilt_bound(authority: Authority) -> float:
    """Return the tilt bound [rad] by rule; a vehicle that barely hovers keeps a third of the tilt that it can hold."""
    held = math.acos(min(1.0, 1.0 / (THRUST_SHARE * authority.thrust_to_weight)))
    return max(min(STEEPEST, held), authority.steady_tilt / 3.0)


def _stated_tilt(authority: Authority, tilt: float) -> float:
    """Return a stated tilt bound [deg] in radians, if the vehicle can hold it."""
    steady = math.degrees(authority.steady_tilt)
    if not LEAST_TILT <= tilt <= min(steady, LARGEST_TILT):
        if steady < LARGEST_TILT:
            most = f"{steady:.3g}, up to where the rotors carry the weight"
        else:
            most = f"{LARGEST_TILT:g}"
        raise ParameterError("", "--tilt", tilt, f"between {LEAST_TILT:g} and {most} [deg]")
    return math.radians(tilt)


def _bandwidth(authority: Authority, tilt: float) -> tuple[float, LimitedBy, float]:
    """Return the bandwidth w [rad/s], what limits it, and the period tau [s].

    w is the smallest of
    - 1 / (`LAG_RATIO` (T + tau / 2)), T the rotors' time constant: the loop then tolerates about 0.8 (T + tau / 2) of
      delay beyond the modelled one (`delay_margin`; the tests measure it);
    - 0.5 sqrt(alpha / tilt), alpha the angular acceleration in reserve: the largest tilt is reached and left within
      2 sqrt(tilt / alpha) = 1 / w;
    - `FASTEST_LOOP`, so that a period of 10 ms or more is enough.

    The period is the longest with w tau <= `PERIOD_SHARE`, 40 samples in each period of the loop's own motion (Astroem
    and Wittenmark, "Computer-Controlled Systems", 1997, recommend 15 to 60).
    """
    for period in PERIODS:
        limits: dict[LimitedBy, float] = {
            "lag": 1.0 / (LAG_RATIO * (authority.lag + 0.5 * period)),
            "torque": 0.5 * math.sqrt(min(authority.turning[:2]) / tilt),
            "period": FASTEST_LOOP,
        }
        bandwidth = min(limits.values())
        if bandwidth * period <= PERIOD_SHARE:
            break
    limited_by = [*limits][first_smallest([*limits.values()], TIE_SHARE * bandwidth)]
    return bandwidth, limited_by, period


def _reached(period: float, lag: float | None) -> float:
    """Return the share of a step that a rotor's speed makes in a period, 1 - exp(-tau / T)."""
    if lag is None:
        return 1.0
    return 1.0 - math.exp(-period / lag)


def gain(vehicle: Vehicle, design: Design) -> Array:
    """Return K (4, n + 4) of u = -K [x; u(k-1)], deviations from hover: the weights' optimum over an infinite horizon.

    Changes of inputs are part of the cost, so the last input is a state; n is 12, or 16 with rotors that lag.
    """
    A_c, B_c = continuous_model(vehicle, vehicle.rotor_rise or 0.0)
    A, B = discretise(A_c, B_c, design.period)
    n = len(A)
    Q = np.zeros((n, n))
    position, height, heading = design.weights
    for name, weight in (("x", position), ("y", position), ("z", height), ("yaw", heading)):
        Q[INDEX[name], INDEX[name]] = weight
    D = design.move_weight * np.eye(N_ROTORS)
    R = design.speed_weight * np.eye(N_ROTORS)
    A = scipy.linalg.block_diag(A, np.zeros((N_ROTORS, N_ROTORS)))
    B = np.vstack([B, np.eye(N_ROTORS)])
    cross = np.vstack([np.zeros((n, N_ROTORS)), -D])
    P = scipy.linalg.solve_discrete_are(A, B, scipy.linalg.block_diag(Q, D), R + D, s=cross)
    return np.asarray(np.linalg.solve(R + D + B.T @ P @ B, B.T @ P @ A + cross.T))


def is_stable(vehicle: Vehicle, design: Design, K: Array, delay: float) -> bool:
    """Return whether the loop of a gain is stable with a delay [s] of the commands beyond the modelled one."""
    A_c, B_c = continuous_model(vehicle, vehicle.rotor_rise or 0.0)
    n = len(A_c)
    period = design.period
    whole_periods = int(delay / period + 1e-9)
    remainder = max(delay - whole_periods * period, 0.0)
    A, _ = discretise(A_c, B_c, period)
    A_rest, B_newer = discretise(A_c, B_c, period - remainder)
    _, B_start = discretise(A_c, B_c, remainder)
    B_older = A_rest @ B_start
    # States: x, u(k-1) .. u(k-m-1), m the whole periods; u(k-m-1) acts during the remainder, then u(k-m).
    size = n + N_ROTORS * (whole_periods + 1)
    closed = np.zeros((size, size))
    entry = np.zeros((size, N_ROTORS))
    closed[:n, :n] = A
    closed[:n, size - N_ROTORS :] = B_older
    if whole_periods == 0:
        entry[:n] = B_newer
    else:
        closed[:n, size - 2 * N_ROTORS : size - N_ROTORS] += B_newer
    entry[n : n + N_ROTORS] = np.eye(N_ROTORS)
    closed[n + N_ROTORS :, n : size - N_ROTORS] = np.eye(N_ROTORS * whole_periods)
    closed[:, : n + N_ROTORS] -= entry @ K
    return float(np.abs(np.linalg.eigvals(closed)).max()) < 1.0


def delay_margin(vehicle: Vehicle, design: Design) -> float:
    """Return the longest delay [s] beyond the modelled one with which the loop is stable, by bisection."""
    K = gain(vehicle, design)
    low = 0.0
    high = 1e-3
    while high < LONGEST and is_stable(vehicle, design, K, high):
        low = high
        high = 1.5 * high
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if is_stable(vehicle, design, K, middle):
            low = middle
        else:
            high = middle
    return low
