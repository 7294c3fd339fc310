"""The optimum without constraints, axis by axis.  Eq. (22)."""

from __future__ import annotations

from typing import Final

import numpy as np
import scipy.linalg

from mpc.exact.axes import Axis
from mpc.ocp import Problem
from quadsim.state import Array

ROUNDING: Final = 1e-4
"""Error of an input held throughout, whose gain is known to be one, above which the gains are not
exact."""


class FreeOptimum:
    """Eq. (22) axis by axis, the optimal sequences without constraints, and the rows' C x that they lead to.

    Both are affine in the axis's deviations from rest, of the state, y_d and, where changes cost something, u(k-1),

        [w_opt; C x] = W [dx; dy; dw],

    so that products with small matrices give them.  For the paper's problem they have a quarter of the entries of the
    one matrix without axes, which a processor's caches feel, above all those that two processors share.

    Args:
        problem: the whole.
        parts: its axes.

    Attributes:
        inputs: for each axis, its rows of w.
        outputs: likewise, of y.

    Raises:
        numpy.linalg.LinAlgError: a Hessian is so ill-conditioned that the gains are not exact.
    """

    def __init__(self, problem: Problem, parts: list[Axis]) -> None:
        N, n, n_r, nu = problem.horizon, problem.model.n, problem.objective.C_r.shape[0], problem.model.nu
        self._moves = problem.objective.Q_d is not None
        self.inputs = _blocks([axis.T.shape[1] for axis in parts])
        self.outputs = _blocks([axis.outputs.size for axis in parts])
        self._w, self._y = np.empty((self.inputs[-1].stop, N)), np.empty((self.outputs[-1].stop, N))
        columns = np.arange(n + N * n_r + (nu if self._moves else 0))
        wanted, before = columns[n : n + N * n_r].reshape(N, n_r), columns[n + N * n_r :]
        self._query = np.empty(columns.size)
        order = [
            np.concatenate([axis.states, wanted[:, axis.regulated].ravel(), before[own]])
            for axis, own in zip(parts, self.inputs, strict=True)
        ]
        self._to_axes = np.concatenate([axis.T_inverse for axis in parts]) if self._moves else np.zeros((0, nu))
        self._order, self._given = np.concatenate(order), np.empty(sum(part.size for part in order))
        self._products: list[tuple[Array, Array, Array]] = []
        """Matrix, what it is multiplied with, where that goes: views."""
        givens = zip(parts, _blocks([part.size for part in order]), self.inputs, self.outputs, strict=True)
        for axis, given, inputs, outputs in givens:
            of_inputs, of_outputs = _maps(axis, problem.rows.C[np.ix_(axis.outputs, axis.states)])
            self._products.append((of_inputs, self._given[given], self._w[inputs].reshape(-1)))
            if axis.outputs.size:
                self._products.append((of_outputs, self._given[given], self._y[outputs].reshape(-1)))

    def at(self, dx: Array, dy: Array, du: Array) -> tuple[Array, Array]:
        """Inputs (m, N) and rows' C x (n_c, N) of all axes, for deviations (n,), (N, n_r), (nu,); reused."""
        if self._moves:
            np.concatenate((dx, dy, self._to_axes @ du), axis=None, out=self._query)
        else:
            np.concatenate((dx, dy), axis=None, out=self._query)
        self._query.take(self._order, out=self._given, mode="clip")  # a mode that takes no copy
        for matrix, given, found in self._products:
            np.dot(matrix, given, out=found)
        return self._w, self._y


def _maps(axis: Axis, C: Array) -> tuple[Array, Array]:
    """W of one axis, for its inputs (m N, columns) and outputs (n_c N, ...), each channel's N steps together."""
    problem, maps, terms = axis.problem, axis.maps, axis.cost
    N, model = problem.horizon, problem.model
    factor = scipy.linalg.cho_factor(terms.H)
    hold = np.tile(np.eye(model.nu), (N, 1))
    if not np.abs(scipy.linalg.cho_solve(factor, terms.H @ hold) - hold).max() < ROUNDING:
        raise np.linalg.LinAlgError("the Hessian is too ill-conditioned")
    slopes = [terms.F_x, terms.F_y, *([terms.F_d] if problem.objective.Q_d is not None else [])]
    inputs = -scipy.linalg.cho_solve(factor, np.hstack(slopes))
    states = maps.Psi @ inputs
    states[:, : model.n] += maps.Phi
    return _by_channel(inputs.reshape(N, model.nu, -1)), _by_channel(C @ states.reshape(N, model.n, -1))


def _by_channel(steps: Array) -> Array:
    """(channels N, columns) of (N, channels, columns)."""
    return np.ascontiguousarray(steps.transpose(1, 0, 2)).reshape(-1, steps.shape[2])


def _blocks(sizes: list[int]) -> list[slice]:
    """Neighbouring ranges of these sizes."""
    ends = np.cumsum(sizes).tolist()
    return [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]
