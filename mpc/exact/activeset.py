"""The multipliers of a strictly convex QP's rows, from the active set of a similar QP.

Of min 1/2 v' P v + c' v over lower <= G v <= upper, the optimum is v = v_free - P^-1 G' z, so that the rows' values are

    y = G v_free - S z,    S = G P^-1 G'.

The multipliers z, positive at upper bounds and negative at lower ones, maximise the dual function

    z' G v_free - 1/2 z' S z - sum_i psi_i(z_i),

psi_i(z) = upper_i z for z > 0 and lower_i z for z < 0, to which a soft row of penalty l1 e + l2 e^2 adds
(|z| - l1)^2 / (4 l2) beyond l1: concave, and quadratic between the kinks.  Where the active rows and the pieces they
are on are known, its maximum is one linear system.  Two methods find them, one after the other:

1. the primal-dual active set method (Hintermueller, Ito and Kunisch, SIAM J. Optim. 13(3), 2003), a Newton method for
   the optimality conditions: all rows that break one change at once, a row that is violated more than the same row a
   step earlier and later standing for its neighbours.  It takes a few steps and may go in circles; then
2. the dual method of Goldfarb and Idnani (Mathematical Programming 27, 1983), from the set with the fewest wrong rows:
   a row whose multiplier would pass a kink stops there and changes its piece, a row that is violated joins, the worst
   first.  Each step raises the dual function, so that the method ends.

Both end at the optimum itself.
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
"""Share of l1 that replaces a quadratic penalty of zero."""
ROUNDING: Final = 1e-12
"""Share of l1 by which a multiplier may pass it."""
FEW: Final = 8
"""Wrong rows of a start with which no other one is tried."""
ROUNDED: Final = 1e-6
"""Share of l1 by which an approximate multiplier of a violated row may stay below it."""
CAREFUL: Final = 4
"""First steps in which, where most rows are active, only the worst of many with a wrong multiplier leaves."""
FEW_LEAVING: Final = 3
"""Rows that are not many."""
MOST_DEPENDENT: Final = 1
"""Sets of dependent rows after which the search is given up: it leads from one to the next."""
MOST_STEPS: Final = 50
"""Steps of either method."""

Side = NDArray[np.int8]
"""Of each row: 0 where it is inactive, 1 or -1 at its upper or lower bound, 2 or -2 where it is violated."""
_SIGN: Final = np.array([0.0, 1.0, 1.0, -1.0, -1.0])
"""Of a `Side`, by which it can be indexed."""


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


class _Trial(NamedTuple):
    """The maximum of the dual function on given pieces, and what breaks the optimality conditions there.

    Attributes:
        side: (all rows,) the pieces.
        active: (k,) rows that have a multiplier.
        rows: (k, all rows) of S; of the last trial alone.
        factor: (k, k) lower Cholesky factor of the system.
        excess: (k,) its right side.
        z: (k,) its solution.
        fall: (all rows,) S z.
        pieces: (k,) that the multipliers would be on.
        over: (all rows,) violation of inactive rows.
        joining: (all rows,) which of them are violated.
        wrong: how many rows break the conditions.
        violated: whether any row is taken to be violated.
        failed: the first active row that depends on those before it, counted from 1; 0 for none.
    """

    side: Side
    active: Indices
    rows: Array
    factor: Array
    excess: Array
    z: Array
    fall: Array
    pieces: Side
    over: Array
    joining: NDArray[np.bool_]
    wrong: int
    violated: bool
    failed: int


class ActiveSet:
    """Finds the multipliers of QPs that differ in their vectors alone.

    Args:
        S: (rows, rows) G P^-1 G'.
        l1: (rows,) linear penalty; infinite of hard rows.
        l2: (rows,) quadratic penalty of soft rows.
        channels: rows of one step; the same rows of the next one follow.
    """

    def __init__(self, S: Array, l1: Array, l2: Array, channels: int) -> None:
        self._S, self._l1, self._channels = np.ascontiguousarray(S), l1, channels
        self._soft, self._least_l1 = bool(np.isfinite(l1).any()), float(l1.min(initial=np.inf))
        compliance = 0.5 / np.maximum(l2, LEAST_QUADRATIC * np.maximum(l1, 1.0))
        self._compliance = np.where(np.isfinite(l1), compliance, 0.0)
        self._least, self._most = l1 * (1.0 - ROUNDING), l1 * (1.0 + ROUNDING)
        self._offset = np.where(np.isfinite(l1), l1, 0.0) * self._compliance
        self._smallest = DEPENDENT * self._S.diagonal()
        self._bounds, self._room = np.zeros((5, l1.size)), np.empty_like(self._S)

    def solve(
        self, free: Array, lower: Array, upper: Array, starts: Sequence[Side], *, most: int = MOST_STEPS
    ) -> Active | None:
        """The multipliers at the optimum.

        Args:
            free: (rows,) G v_free.
            lower: (rows,) bounds, below the upper ones; infinite where there is none.
            upper: (rows,) likewise.
            starts: active sets; the first, or one with less than half as many wrong rows, is the start.
            most: steps of each method after which it is given up.

        Returns:
            None where both were.
        """
        bounds = self._bounds
        np.subtract(free, upper, out=bounds[1])
        np.subtract(free, lower, out=bounds[-1])
        if self._soft:
            np.add(bounds[1], self._offset, out=bounds[2])
            np.subtract(bounds[-1], self._offset, out=bounds[-2])
        trial = self._trial(starts[0], bounds)
        for start in starts[1:]:
            if trial.wrong <= FEW:
                break
            other = self._trial(start, bounds)
            if 2 * other.wrong < trial.wrong:
                trial = other
        best, fewest, seen, dependent = trial.side, trial.wrong, set(), 0
        for step in range(1, most + 1):
            if not trial.wrong:
                return self._accepted(trial, free, step)
            dependent += trial.failed > 0
            if dependent > MOST_DEPENDENT:
                return None
            if trial.wrong < fewest:
                best, fewest = trial.side, trial.wrong
            side = self._all_changed(trial, bounds, careful=step <= CAREFUL)
            if (key := side.tobytes()) in seen:
                break
            seen.add(key)
            trial = self._trial(side, bounds)
        return self._one_by_one(best.copy(), free, bounds, step, most)

    def _trial(self, side: Side, bounds: Array) -> _Trial:
        """The maximum of the dual function on the pieces given by a side."""
        active = side.nonzero()[0]
        pieces = taken = side.take(active)
        rows = self._S.take(active, 0, self._room[: active.size], "clip")  # a mode that takes no copy
        factor = rows.take(active, 1).T
        excess = z = bounds[taken, active]
        entries = taken.tobytes() if self._soft else b""
        violated = b"\x02" in entries or b"\xfe" in entries  # 2 or -2
        if active.size:
            if violated:
                beyond = (np.abs(taken) == 2).nonzero()[0]
                factor[beyond, beyond] += self._compliance[active[beyond]]
            factor, z, failed = lapack.dposv(factor, excess, lower=1, overwrite_a=1)
            if failed:
                none = np.zeros(0)
                return _Trial(
                    side, active, rows, factor, excess, z, none, taken, none, none > 0.0, side.size, violated, failed
                )
            pieces = self._pieces(active, taken, z, violated=violated)
        fall = np.dot(z, rows)
        over = np.maximum(bounds[1] - fall, fall - bounds[-1])
        over[active] = 0.0
        joining = over > FEASIBLE
        wrong = int(np.count_nonzero(joining))
        if pieces is not taken:
            wrong += int(np.count_nonzero(pieces != taken))
        return _Trial(side, active, rows, factor, excess, z, fall, pieces, over, joining, wrong, violated, 0)

    def _pieces(self, active: Indices, pieces: Side, z: Array, *, violated: bool) -> Side:
        """The pieces that multipliers (k,) of active rows would be on, next to those they were taken to be on."""
        size = z * pieces
        if not violated and size[size.argmax()] <= self._least_l1:
            return pieces if size[size.argmin()] >= 0.0 else pieces * (size >= 0.0)
        sign = np.sign(pieces)
        size, outside = z * sign, pieces != sign
        beyond = size > np.where(outside, self._least[active], self._most[active])
        return sign * (outside | (size >= 0.0)) * (1 + beyond)

    def _all_changed(self, trial: _Trial, bounds: Array, *, careful: bool) -> Side:
        """The pieces with all that is wrong changed, but for violated rows next to one that is violated more.

        Between active rows one too many makes the others' multipliers alternate in sign: then it is released alone.
        """
        side = trial.side.copy()
        if trial.failed:
            side[trial.active[trial.failed - 1]] = 0
            return side
        side[trial.active] = trial.pieces
        dense = 2 * trial.active.size > side.size
        if careful and dense and (leaving := (trial.pieces == 0).nonzero()[0]).size > FEW_LEAVING:
            stay = np.delete(leaving, np.abs(trial.z[leaving]).argmax())
            side[trial.active[stay]] = trial.side[trial.active[stay]]
        over, joining, later = trial.over, trial.joining.copy(), self._channels
        grows = over[later:] > over[:-later]
        joining[:-later] &= ~grows
        joining[later:] &= grows
        rows = joining.nonzero()[0]
        side[rows] = 2 * (bounds[1].take(rows) > trial.fall.take(rows)) - 1
        return side

    def _one_by_one(self, side: Side, free: Array, bounds: Array, before: int, most: int) -> Active | None:
        """The multipliers by the dual method, from an active set, which is changed; None where it is given up."""
        z = np.zeros_like(free)
        for step in range(before + 1, before + most + 1):
            trial = self._trial(side, bounds)
            active = trial.active
            if step == before + 1:  # the first multipliers are those next to their pieces' maximum
                sign, violated, l1 = np.sign(side[active]), np.abs(side[active]) == 2, self._l1[active]
                size = np.clip(sign * trial.z, np.where(violated, l1, 0.0), np.where(violated, np.inf, l1))
                z[active], side[active] = sign * size, trial.pieces
                if (z[active] != trial.z).any():
                    continue
            if trial.failed:
                return None
            stops = (trial.pieces != side[active]).nonzero()[0]
            if stops.size:  # as far as all stay on their pieces
                rows = active[stops]
                kink = np.where(trial.pieces[stops] == 0, 0.0, np.sign(side[rows]) * self._l1[rows])
                step = (trial.z - z[active])[stops]
                share = np.maximum((kink - z[rows]) / np.where(step == 0.0, np.inf, step), 0.0)
                least = share.min()
                z[active] += least * (trial.z - z[active])
                first = share <= least
                z[rows[first]], side[rows[first]] = kink[first], trial.pieces[stops[first]]
                continue
            if not trial.wrong:
                return self._accepted(trial, free, step)
            z[active] = trial.z
            worst = int(trial.over.argmax())
            side[worst] = 1 if bounds[1, worst] > trial.fall[worst] else -1
        return None

    def _accepted(self, trial: _Trial, free: Array, steps: int) -> Active | None:
        """The optimum of the right active set, refined once; None where rows are too nearly dependent."""
        active, z, fall = trial.active, np.zeros(free.size), trial.fall
        if active.size:
            if np.count_nonzero(trial.factor.diagonal() ** 2 < self._smallest[active]):
                return None
            left = trial.excess - fall[active]
            if trial.violated:
                violated = np.abs(trial.pieces) == 2
                left -= violated * self._compliance[active] * trial.z
            refined = trial.z + lapack.dpotrs(trial.factor, left, lower=1)[0]
            fall = np.dot(refined, trial.rows)
            apart = np.abs(trial.excess - fall[active])
            if trial.violated:
                apart[violated] = 0.0
            if not apart[apart.argmax()] <= FEASIBLE:
                return None
            z[active] = refined
        return Active(z=z, values=free - fall, side=trial.side, steps=steps)

    def near(self, z: Array, free: Array, lower: Array, upper: Array) -> Side:
        """The active set that approximate multipliers (rows,) indicate: those that outweigh the distance to a bound."""
        values, reach = free - self._S @ z, z * self._S.diagonal()
        side = (reach > upper - values).astype(np.int8) - (-reach > values - lower)
        return np.where(np.abs(z) > (1.0 - ROUNDED) * self._l1, 2 * side, side).astype(np.int8) if self._soft else side
