"""The multipliers of a strictly convex QP's rows, from the active set of a similar QP.

Of min 1/2 v' P v + c' v over lower <= G v <= upper, the optimum is v = v_free - P^-1 G' z, so that the rows' values are

    y = G v_free - S z,    S = G P^-1 G'.

The multipliers z, positive at upper bounds and negative at lower ones, maximise the dual function

    z' G v_free - 1/2 z' S z - sum_i psi_i(z_i),

psi_i(z) = upper_i z for z > 0 and lower_i z for z < 0, to which a soft row of penalty l1 e + l2 e^2 adds
(|z| - l1)^2 / (4 l2) beyond l1: concave, and quadratic between the kinks.  Maximised over the rows that are active with
the pieces they are on, which is one linear system; a row whose multiplier would pass a kink stops there and changes its
piece, a row that is violated joins, the worst first.  Each step raises the dual function, so that the method ends
(Goldfarb and Idnani, Mathematical Programming 27, 1983, is the same for hard rows).  It starts where the last period's
active set says, and ends at the optimum itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from quadsim.state import Array, Indices

FEASIBLE: Final = 1e-9
"""Violation of a bound that is taken for rounding, in the row's unit."""
DEPENDENT: Final = 1e-12
"""Share of an active row's S_ii that other active rows leave over, below which it is taken for their combination."""
LEAST_QUADRATIC: Final = 1e-9
"""Share of l1 that stands in for a quadratic penalty of zero."""
ROUNDING: Final = 1e-12
"""Share of l1 by which a multiplier may pass it."""
FEW: Final = 8
"""Wrong rows of a start with which no other one is looked at."""
ROUNDED: Final = 1e-6
"""Share of l1 by which an approximate multiplier of a violated row may stay below it."""
AT_ONCE: Final = 2
"""Steps, the first ones, in which all rows that are wrong change, not the worst alone."""
MOST_STEPS: Final = 60

Side = NDArray[np.int8]
"""Of each row: 0 where it is inactive, 1 or -1 at its upper or lower bound, 2 or -2 where it is violated."""


class Active(NamedTuple):
    """Multipliers at the optimum.

    Attributes:
        z: (rows,).
        values: (rows,) y.
        side: (rows,).
        steps: how many it took.
    """

    z: Array
    values: Array
    side: Side
    steps: int


class ActiveSet:
    """Finds the multipliers of QPs that differ in their vectors alone.

    Args:
        S: (rows, rows) G P^-1 G'.
        l1: (rows,) linear penalty; infinite of hard rows.
        l2: (rows,) quadratic penalty of soft rows.
    """

    def __init__(self, S: Array, l1: Array, l2: Array) -> None:
        self._S, self._l1 = np.ascontiguousarray(S), l1
        self._soft, self._least_l1 = bool(np.isfinite(l1).any()), float(l1.min(initial=np.inf))
        self._compliance = 0.5 / np.maximum(l2, LEAST_QUADRATIC * np.maximum(l1, 1.0))

    def solve(
        self, free: Array, lower: Array, upper: Array, starts: Sequence[Side], *, most: int = MOST_STEPS
    ) -> Active | None:
        """The multipliers at the optimum.

        Args:
            free: (rows,) G v_free.
            lower: (rows,) bounds, below the upper ones; infinite where there is none.
            upper: (rows,) likewise.
            starts: active sets; the one with the fewest wrong rows is the start.
            most: steps after which the search is given up.

        Returns:
            None where it was.
        """
        side, z = starts[0], np.zeros_like(free)
        active = side.nonzero()[0]
        target = self._optimum(active, side[active], free, lower, upper)
        fewest = self._wrong(active, target, side, free, lower, upper)
        for start in starts[1:]:
            if fewest <= FEW:
                break
            also = start.nonzero()[0]
            found = self._optimum(also, start[also], free, lower, upper)
            wrong = self._wrong(also, found, start, free, lower, upper)
            if wrong < fewest:
                side, active, target, fewest = start, also, found, wrong
        side = side.copy()
        for step in range(1, most + 1):
            if step > 1:
                active = side.nonzero()[0]
                target = self._optimum(active, side[active], free, lower, upper)
            if target is None:
                if not self._release_dependent(z, active, side, free, lower, upper):
                    return None
                continue
            if step == 1:
                z[active] = np.where(target * side[active] > 0.0, target, 0.0)
            if self._stop_at_kinks(z, target, active, side, at_once=step <= AT_ONCE):
                continue
            z[active] = target
            values = free - target @ self._S[active]
            if not self._join(values, lower, upper, side, at_once=step <= AT_ONCE):
                return self._accepted(active, side, free, lower, upper, step)
        return None

    def _accepted(
        self, active: Indices, side: Side, free: Array, lower: Array, upper: Array, steps: int
    ) -> Active | None:
        """The optimum of the right active set, as exact as can be; None where rows are too nearly dependent."""
        target = self._refined(active, side[active], free, lower, upper)
        if target is None:
            return None
        z = np.zeros_like(free)
        z[active] = target
        values = free - target @ self._S[active]
        bound = np.where(side[active] > 0, upper[active], lower[active])
        apart = np.abs(values[active] - bound)[np.abs(side[active]) == 1]
        return None if (apart > FEASIBLE).any() else Active(z=z, values=values, side=side, steps=steps)

    def near(self, z: Array, free: Array, lower: Array, upper: Array) -> Side:
        """The active set that approximate multipliers (rows,) tell of: those that outweigh the distance to a bound."""
        values, reach = free - self._S @ z, z * self._S.diagonal()
        side = (reach > upper - values).astype(np.int8) - (-reach > values - lower)
        return np.where(np.abs(z) > (1.0 - ROUNDED) * self._l1, 2 * side, side).astype(np.int8) if self._soft else side

    def _optimum(self, active: Indices, side: Side, free: Array, lower: Array, upper: Array) -> Array | None:
        """The multipliers of active rows, on the pieces of psi that they are on; None where rows are dependent."""
        if not active.size:
            return np.zeros(0)
        K, excess = self._system(active, side, free, lower, upper)
        _, target, failed = lapack.dposv(K, excess, lower=1)
        return None if failed else np.asarray(target)

    def _system(self, active: Indices, side: Side, free: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
        """K z = excess of active rows, on the pieces of psi that they are on."""
        K = self._S.take(active, axis=0).take(active, axis=1)
        excess = free[active] - np.where(side > 0, upper[active], lower[active])
        if self._soft:
            (violated,) = (np.abs(side) == 2).nonzero()
            rows = active[violated]
            K[violated, violated] += self._compliance[rows]
            excess[violated] += np.sign(side[violated]) * self._l1[rows] * self._compliance[rows]
        return K, excess

    def _refined(self, active: Indices, side: Side, free: Array, lower: Array, upper: Array) -> Array | None:
        """The optimum with a step of iterative refinement; None where rows are too nearly dependent."""
        if not active.size:
            return np.zeros(0)
        K, excess = self._system(active, side, free, lower, upper)
        factor, target, failed = lapack.dposv(K, excess)
        if failed or (factor.diagonal() ** 2 < DEPENDENT * K.diagonal()).any():
            return None
        return np.asarray(target + lapack.dpotrs(factor, excess - K @ target)[0])

    def _release_dependent(
        self, z: Array, active: Indices, side: Side, free: Array, lower: Array, upper: Array
    ) -> bool:
        """Where active rows are dependent, move along what that leaves open until one stops; whether one did.

        The dual function is linear along it.  If none stops, no point satisfies all rows.
        """
        K, excess = self._system(active, side[active], free, lower, upper)
        factor, failed = lapack.dpotrf(K)
        if not failed:
            return False
        k = failed - 1  # depends on those before it
        direction = np.zeros(active.size)
        direction[k] = 1.0
        if k:  # before a row of nothing there may be none
            direction[:k] = -lapack.dpotrs(factor[:k, :k], K[:k, k])[0]
        if direction @ excess < 0.0:
            direction = -direction
        sign, here = np.sign(side[active]), z[active]
        inwards = sign * direction < -ROUNDING * np.abs(direction).max()
        share = np.full(active.size, np.inf)
        share[inwards] = (sign * here)[inwards] / -(sign * direction)[inwards]
        first = int(share.argmin())
        if not np.isfinite(share[first]):
            return False
        z[active] = here + share[first] * direction
        z[active[first]] = 0.0
        side[active[first]] = 0
        return True

    def _stop_at_kinks(self, z: Array, target: Array, active: Indices, side: Side, *, at_once: bool) -> bool:
        """Move multipliers to the target, as far as all stay on their pieces; whether some did not."""
        pieces = side[active]
        sign, here = np.sign(pieces), z[active]
        size = sign * target
        stops = leaving = size < 0.0
        kink = np.zeros_like(target)
        if self._soft and (size.max(initial=0.0) > self._least_l1 or (pieces != sign).any()):
            l1, violated = self._l1[active], pieces != sign
            beyond = np.where(violated, l1 - size, size - l1) > ROUNDING * l1
            leaving = leaving & ~violated
            kink[beyond] = (sign * l1)[beyond]
            stops = leaving | beyond
        if not stops.any():
            return False
        if at_once:
            z[active] = np.where(stops, kink, target)
        else:
            share = np.ones_like(target)
            way = (target - here)[stops]
            share[stops] = np.maximum((kink - here)[stops] / np.where(way == 0.0, np.inf, way), 0.0)
            least = share.min()
            stops = stops & (share <= least)
            z[active] = np.where(stops, kink, here + least * (target - here))
        left, changed = active[stops & leaving], active[stops & ~leaving]
        side[left] = 0
        side[changed] = np.where(np.abs(side[changed]) == 1, 2 * side[changed], side[changed] // 2)
        return True

    def _join(self, values: Array, lower: Array, upper: Array, side: Side, *, at_once: bool) -> bool:
        """Make violated rows active; whether there were some."""
        above, below = values - upper, lower - values
        over = np.where(side == 0, np.maximum(above, below), 0.0)
        worst = int(over.argmax())
        if not over[worst] > FEASIBLE:
            return False
        rows = (over > FEASIBLE).nonzero()[0] if at_once else np.array([worst])
        side[rows] = np.where(above[rows] > below[rows], 1, -1)
        return True

    def _wrong(self, active: Indices, target: Array | None, side: Side, free: Array, lower: Array, upper: Array) -> int:
        """How many rows have a multiplier of the wrong sign at the optimum of an active set, or would have to join."""
        if target is None:
            return free.size
        values = free - target @ self._S[active]
        outside = (values - upper > FEASIBLE) | (lower - values > FEASIBLE)
        outside[active] = target * side[active] < 0.0
        return int(np.count_nonzero(outside))
