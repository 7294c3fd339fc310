"""Tightening of output bounds, so that they hold under bounded disturbances and between samples.

The vehicle may differ from its prediction by accelerations w up to a stated bound.  If the prediction uses an estimate
of the disturbance, which stays within the stated bounds, a disturbance that changes sign differs from it by twice the
bounds; w is doubled then.  With the correction -K e towards the plan at each sample, the error e after i periods is
bounded in each output by

    r_i = int_0^d |C e^(A_c s) E| w ds + sum_{j=0}^{i-1} int_0^tau |C (A - B K)^j e^(A_c (s + d)) E| w ds,

the support function of the reachable errors, with d the delay between measuring and acting.  With bounds tightened by
r_i, the plan of one period, shifted and corrected, satisfies those of the next (Chisci, Rossiter and Zappa, 2001,
"Systems with persistent disturbances: predictive control with restricted constraints"; Mayne, Seron and Rakovic, 2005,
"Robust model predictive control of constrained linear systems with bounded disturbances"). Bounds on inputs are not
tightened: near them the correction may lack authority.

Between two samples an output y may exceed both.  It differs from the straight line through them by at most

    max |d2y/dt2| tau^2 / 8,

the error of linear interpolation for any input.

K serves only the outputs, so it acts on the states that they observe.  For roll and pitch these are the angles, their
rates and, with lag, the rotors: a wind moves the vehicle, which the next plan corrects, but not its tilt.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
import scipy.linalg
from annotated_types import doc

from quadsim.errors import ParameterError
from quadsim.fields import NonNegative
from quadsim.mpc.problem.constraints import Bounds
from quadsim.mpc.problem.model import SHORTEST_LAG, continuous_model, discretise
from quadsim.mpc.problem.regulator import lqr, observed
from quadsim.state import INDEX, N_STATES, POSITION, Array, read_only
from quadsim.ties import first_smallest
from quadsim.vehicle import Vehicle

LARGEST_SHARE: Final = 0.5  # largest part of the half-width of an output's bounds to give up
ERROR_SHARE: Final = 0.1  # output error, as a share of that half-width, which the correction answers...
SPEED_SHARE: Final = 0.025
"""...with about this share of the hover speed (Bryson's rule; Bryson and Ho, 1975, "Applied Optimal Control")."""
POSITION_ERROR: Final = 0.05  # [m]

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_ACCELERATED: Final = [INDEX[name] for name in ("vx", "vy", "vz", "roll_rate", "pitch_rate", "yaw_rate")]
_TURNS: Final = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])  # which of them are angular


@dataclass(frozen=True, kw_only=True)
class TighteningSettings:
    """Output bounds tightened to hold under disturbances within stated bounds, and between samples.

    The stated bounds are the same along and about each axis; nothing is guaranteed beyond them.  Model errors, such as
    tilted thrust or a different rotor lag, count as disturbances.  Bounds on inputs alone would allow far more than
    `turning`.
    """

    acceleration: Annotated[
        NonNegative, doc("[m/s^2] bound on a disturbance's acceleration along each axis, world frame")
    ] = 0.5
    angular_acceleration: Annotated[NonNegative, doc("[rad/s^2] bound on its angular acceleration, body frame")] = 0.5
    turning: Annotated[
        NonNegative, doc("[unit of the state/s^2, rad for angles] largest second derivative of an output at its bound")
    ] = 3.0


def margins(
    vehicle: Vehicle,
    *,
    period: float,
    horizon: int,
    bounds: Bounds,
    settings: TighteningSettings,
    rotor_lag: float = 0.0,
    moment: bool = False,
    delay: float = 0.0,
    estimated: bool = False,
) -> Array:
    """Return the tightening of the bounds of each output at each predicted state, (N, n_c), in the output's unit.

    Args:
        vehicle: the modelled vehicle.
        period: tau [s].
        horizon: N.
        bounds: bounds on outputs of the 12 states.
        settings: the stated bounds.
        rotor_lag: rotor time constant in the prediction [s]; 0 for none, else at least `SHORTEST_LAG`.
        moment: whether the model has the air's moment, as in `continuous_model`.
        delay: d [s], between measuring and acting.
        estimated: whether the prediction uses a disturbance estimate, which may err by twice the bounds.

    Raises:
        ParameterError: an output is bounded on one side only, or too narrowly; or the lag is too short.
    """
    if 0.0 < rotor_lag < SHORTEST_LAG:
        raise ParameterError("controller", "rotor_lag", rotor_lag, f"0, or at least {SHORTEST_LAG:g} s")
    half_band = 0.5 * (bounds.y_max - bounds.y_min)
    for i in np.flatnonzero(~np.isfinite(half_band)):
        output = bounds.output(int(i))
        name = output.name
        scale = output.factor
        sides = [scale * float(bounds.y_min[i]), scale * float(bounds.y_max[i])]
        raise ParameterError("controller.output_bounds", name, sides, "finite on both sides, to be tightened")
    A, B, C, E, K = _corrected(
        vehicle, rotor_lag, moment, period, bounds.C_c, ERROR_SHARE * half_band, settings, estimated
    )
    margins = growth(A, B, C, E, K, period=period, horizon=horizon, delay=delay)
    passed = between_samples(settings.turning, period)
    margins += passed
    shares = margins[-1] / half_band
    too_large = np.flatnonzero(shares > LARGEST_SHARE)
    if too_large.size:
        worst = int(too_large[first_smallest(-shares[too_large])])
        turned = growth(A, B, C, E * _TURNS, K, period=period, horizon=horizon, delay=delay)[-1, worst]
        causes = {
            "acceleration": margins[-1, worst] - turned - passed,
            "angular_acceleration": turned,
            "turning": passed,
        }
        sizes = np.array([*causes.values()]) / half_band[worst]
        most = [*causes][first_smallest(-sizes)]
        output = bounds.output(worst)
        name = output.name
        scale = output.factor
        unit = output.unit
        rule = (
            f"smaller, or the bounds on {name} wider: these leave {scale * half_band[worst]:.3g} {unit} on either side "
            f"of their middle, of which {scale * margins[-1, worst]:.3g} {unit} would be given up and at most "
            f"{scale * LARGEST_SHARE * half_band[worst]:.3g} {unit} may be"
        )
        raise ParameterError("controller.tightening", most, getattr(settings, most), rule)
    return read_only(margins)


def position_margins(
    vehicle: Vehicle,
    *,
    period: float,
    horizon: int,
    settings: TighteningSettings,
    rotor_lag: float = 0.0,
    moment: bool = False,
    delay: float = 0.0,
    estimated: bool = False,
) -> Array:
    """Return the tightening of half-spaces along x, y and z at each predicted state, (N, 3) [m].

    The correction weights an error of `POSITION_ERROR` like one of `ERROR_SHARE` of an output's half-width.  Arguments
    and errors as in `margins`.
    """
    rows = np.eye(N_STATES)[list(POSITION)]
    sizes = np.full(3, POSITION_ERROR)
    A, B, C, E, K = _corrected(vehicle, rotor_lag, moment, period, rows, sizes, settings, estimated)
    return read_only(growth(A, B, C, E, K, period=period, horizon=horizon, delay=delay))


def _corrected(
    vehicle: Vehicle,
    rotor_lag: float,
    moment: bool,
    period: float,
    rows: Array,
    sizes: Array,
    settings: TighteningSettings,
    estimated: bool,
) -> tuple[Array, ...]:
    """Return A, B, C, E of the states that the rows (n_c, 12) observe, and K, which weights errors (n_c,) equally."""
    A, B, E = disturbed_model(vehicle, rotor_lag, moment=moment)
    C = np.hstack([rows, np.zeros((len(rows), len(A) - N_STATES))])
    basis = observed(A, C)
    A = basis.T @ A @ basis
    B = basis.T @ B
    C = C @ basis
    E = basis.T @ E
    K = correction(*discretise(A, B, period), C / sizes[:, None], SPEED_SHARE * vehicle.hover_speed)
    largest = np.repeat([settings.acceleration, settings.angular_acceleration], 3)
    if estimated:  # a disturbance that changes sign differs from its estimate by twice the bounds
        largest = 2.0 * largest
    return A, B, C, E * largest, K


def between_samples(acceleration: float, period: float) -> float:
    """Return how far an output with at most this second derivative exceeds two samples that are `period` [s] apart."""
    return acceleration * period**2 / 8.0


def growth(
    A: Array, B: Array, C: Array, E: Array, K: Array, *, period: float, horizon: int, delay: float = 0.0
) -> Array:
    """Return r_1 .. r_N (N, n_c) for dx/dt = A x + B u + E w, |w| <= 1 per component, u = -K x(k) held, outputs C x.

    Period tau and delay d [s]; see the module.
    """
    A_d, B_d = discretise(A, B, period)
    closed = A_d - B_d @ K
    growth_in_delay = _absolute_integral(C, _transitions(A, 0.0, delay), E, delay)
    transitions = _transitions(A, delay, delay + period)
    terms = np.empty((horizon, len(C)))
    seen = C
    for j in range(horizon):
        terms[j] = _absolute_integral(seen, transitions, E, period)
        seen = seen @ closed
    return np.asarray(growth_in_delay + np.cumsum(terms, axis=0))


def disturbed_model(vehicle: Vehicle, rotor_lag: float, *, moment: bool = False) -> tuple[Array, Array, Array]:
    """(n, n), (n, 4) and (n, 6): dx/dt = A x + B u + E w at hover, with 12 states, or 16 with rotor lag [s].

    w is acceleration along the axes and angular acceleration about them.
    """
    A, B = continuous_model(vehicle, rotor_lag, moment=moment)
    E = np.zeros((len(A), len(_ACCELERATED)))
    E[_ACCELERATED, range(len(_ACCELERATED))] = 1.0
    return A, B, E


def correction(A: Array, B: Array, C: Array, size: float) -> Array:
    """K (nu, n) of the discrete LQR that weights outputs C x relative to inputs over `size`."""
    return lqr(A, B, C.T @ C, np.eye(B.shape[1]) / size**2)


def _transitions(A: Array, start: float, stop: float) -> Array:
    """(q, n, n) e^(A s) at the nodes of the Gauss-Legendre rule between two instants [s]."""
    instants = start + 0.5 * (stop - start) * (_NODES + 1.0)
    return np.asarray(scipy.linalg.expm(A * instants[:, None, None]))


def _absolute_integral(C: Array, transitions: Array, E: Array, duration: float) -> Array:
    """(n_c,) of int |C e^(A s) E| ds, summed over the components of w, from e^(A s) at the nodes."""
    return np.asarray(0.5 * duration * np.einsum("q,qij->i", _WEIGHTS, np.abs(C @ transitions @ E)))
