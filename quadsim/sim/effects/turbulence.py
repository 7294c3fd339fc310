"""Continuous turbulence: the Dryden spectra of MIL-F-8785C at low altitude, sampled exactly.

The turbulence is a frozen field (Taylor's hypothesis) that the mean wind carries past the vehicle at the airspeed V:
a wave number Omega [rad/m] is met at the frequency V Omega / (2 pi) [Hz].  Its spectra are one-sided, and integrate to
sigma^2 over Omega > 0 (Sec. 3.7.1.2):

    Phi_u = sigma_u^2 (2 L_u / pi) / (1 + (L_u Omega)^2)
    Phi_v = sigma_v^2 (L_v / pi) (1 + 3 (L_v Omega)^2) / (1 + (L_v Omega)^2)^2,    Phi_w likewise

which are those of white noise of unit intensity behind the filters, with tau = L / V,

    H_u(s) = sigma_u sqrt(2 tau_u) / (1 + tau_u s)
    H_v(s) = sigma_v sqrt(tau_v) (1 + sqrt(3) tau_v s) / (1 + tau_v s)^2,           H_w likewise

and belong to the autocovariances sigma_u^2 exp(-|t| / tau_u) and sigma_v^2 (1 - |t| / (2 tau_v)) exp(-|t| / tau_v).

The rotational gusts p, q, r of the specification stand for the change of the field over a wing span.  They are left
out: a quadrotor is much smaller than the scale lengths.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from annotated_types import Ge, Le, doc

from quadsim.core.mirror import core_library
from quadsim.state import Array

LOWEST_HEIGHT = 3.048
HIGHEST_HEIGHT = 304.8
"""Heights [m] between which the low-altitude model holds: 10 and 1000 ft (Figs. 10 and 11)."""
SLOWEST_AIRSPEED = 0.01
FASTEST_AIRSPEED = 200.0
"""[m/s] at which turbulence may pass; at the slower one, it takes hours."""
_METRES_PER_FOOT: Final = 0.3048
_BLOCK: Final = 4096
"""Samples made at a time: their number is fixed, so that it makes no difference how many are drawn at once."""
_OUTPUT: Final = np.array([[1.0, *2 * [math.sqrt(1.5)]], [0.0, *2 * [(1.0 - math.sqrt(3.0)) / math.sqrt(2.0)]]])
"""(2, 3) what the states a and b of `discretise_filters` give to u, v, w at unit sigma; from partial fractions of H."""


@dataclass(frozen=True, kw_only=True)
class Dryden:
    """Dryden turbulence at low altitude; see `quadsim.sim.effects.turbulence`.

    MIL-F-8785C, Sec. 3.7.3.4; the order of axes is u, v, w: along the mean wind, across it and horizontal, vertical.
    Turbulence is light, moderate and severe at a mean wind of 15, 30 and 45 knots (7.7, 15.4 and 23.2 m/s, Fig. 9).
    """

    altitude: Annotated[
        float, Ge(LOWEST_HEIGHT), Le(HIGHEST_HEIGHT), doc("[m] above the ground, for the scale lengths")
    ] = 10.0
    wind_speed_20ft: Annotated[
        float,
        Ge(0.0),
        Le(100.0),
        doc("[m/s] mean wind 6.1 m above the ground, for the intensities; 7.7 is light, 15.4 moderate"),
    ]
    airspeed: Annotated[
        Annotated[float, Ge(SLOWEST_AIRSPEED), Le(FASTEST_AIRSPEED)] | None,
        doc("[m/s] speed at which the turbulence passes the vehicle; absent: the mean wind's speed"),
    ] = None

    @property
    def lengths(self) -> Array:
        """(3,) scale lengths [m]: L_u = L_v = h / (0.177 + 0.000823 h)^1.2 and L_w = h, there in feet."""
        horizontal = self.altitude / self._height_term**1.2
        return np.array([horizontal, horizontal, self.altitude])

    @property
    def intensities(self) -> Array:
        """(3,) standard deviations [m/s]: sigma_w = 0.1 W20, sigma_u = sigma_v = sigma_w / (0.177 + 0.000823 h)^0.4."""
        vertical = 0.1 * self.wind_speed_20ft
        horizontal = vertical / self._height_term**0.4
        return np.array([horizontal, horizontal, vertical])

    @property
    def _height_term(self) -> float:
        return 0.177 + 0.000823 * self.altitude / _METRES_PER_FOOT


class Turbulence:
    """The turbulence that passes a vehicle, an evolving state; stationary from its first sample on.

    It draws from a child of `rng`, so that others may draw from that at any time.
    """

    def __init__(self, dryden: Dryden, *, timestep: float, rng: np.random.Generator) -> None:
        assert dryden.airspeed is not None, "resolved"
        self._intensities = dryden.intensities
        self._steps = [discretise_filters(timestep * dryden.airspeed / length) for length in dryden.lengths]
        (self._rng,) = rng.spawn(1)
        self._initial = self._rng.bit_generator.state
        self.reset()

    def reset(self) -> None:
        """Rewind: the same turbulence again."""
        self._rng.bit_generator.state = self._initial
        first, second = self._rng.standard_normal((2, 3))
        self._state = np.stack([first, 0.5 * (first + second)])  # of the stationary covariance [[1, 1/2], [1/2, 1/2]]
        self._block = np.empty((0, 3))
        self._used = 0

    def advance(self, steps: int) -> Array:
        """(steps, 3) the next samples of u, v, w [m/s]."""
        samples = np.empty((steps, 3))
        made = 0
        while made < steps:
            if self._used == len(self._block):
                self._block = self._next_block()
                self._used = 0
            taken = min(steps - made, len(self._block) - self._used)
            samples[made : made + taken] = self._block[self._used : self._used + taken]
            self._used = self._used + taken
            made = made + taken
        return samples

    def _next_block(self) -> Array:
        noise = self._rng.standard_normal((3, 2, _BLOCK))
        block = np.empty((_BLOCK, 3))
        for axis, (transition, factor) in enumerate(self._steps):
            before = self._state[:, axis]
            drive_a, drive_b = factor @ noise[axis]
            a = first_order(transition[0, 0], drive_a, before[0])
            drive_b += transition[1, 0] * np.concatenate([before[:1], a[:-1]])
            b = first_order(transition[1, 1], drive_b, before[1])
            block[:, axis] = self._intensities[axis] * (_OUTPUT[0, axis] * a + _OUTPUT[1, axis] * b)
            self._state[:, axis] = a[-1], b[-1]
        return block


def discretise_filters(ratio: float) -> tuple[Array, Array]:
    """One exact time step of the filters' states a and b, which are the same for all axes but for their time.

    White noise n of unit intensity drives, in the time s = t / tau,

        da/ds = -a + sqrt(2) n,    db/ds = a - b

    of which u / sigma_u = a and v / sigma_v = sqrt(3/2) a + (1 - sqrt(3)) / sqrt(2) b.  What the noise adds over a step
    has the covariance (Van Loan's integral, in closed form)

        Q = [[P(1, 2 r), P(2, 2 r) / 2], [P(2, 2 r) / 2, P(3, 2 r) / 2]]

    with P the regularised lower incomplete gamma function, which keeps all its digits where r is small.

    Args:
        ratio: r, the step divided by tau = L / V; positive.

    Returns:
        (2, 2) transition of (a, b), and (2, 2) lower triangular factor of Q: what to multiply independent standard
        normal numbers with.
    """
    from scipy.special import gammainc

    transition = math.exp(-ratio) * np.array([[1.0, 0.0], [ratio, 1.0]])
    q_aa, q_ab, q_bb = gammainc([1.0, 2.0, 3.0], 2.0 * ratio) * [1.0, 0.5, 0.5]
    return transition, np.linalg.cholesky(np.array([[q_aa, q_ab], [q_ab, q_bb]]))


def first_order(pole: float, drive: Array, before: float) -> Array:
    """y(k) = pole y(k-1) + drive(k), from y = `before` on; compiled, as scipy.signal takes a second to load."""
    samples = np.array(drive, order="C")
    core_library().quadsim_first_order(pole, before, len(samples), samples.ctypes.data)
    return samples
