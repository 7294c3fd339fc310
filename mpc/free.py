"""The optimum without constraints, axis by axis.  Eq. (22)."""

from __future__ import annotations

from typing import Final

import numpy as np

from mpc.axes import Axis
from mpc.condensed import require_bounds
from mpc.prediction import prediction
from mpc.problem import Problem
from mpc.unconstrained import sequence_gains
from quadsim.state import Array

ROUNDING: Final = 1e-4
"""Error of L_N, whose value is known, beyond which rounding is taken to have spoilt the gains.  It multiplies the whole
speed; that of K_N multiplies deviations, a hundredth of it."""


class FreeOptimum:
    """Eq. (22) axis by axis, the optimal sequences without constraints, and the outputs that they lead to.

    Both are affine in the axis's xi(k) and y_d,

        [w_opt; y_c] = W [xi(k); y_d],

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
        N, n, n_r = problem.horizon, problem.model.n, problem.objective.C_r.shape[0]
        self.inputs = _blocks([axis.T.shape[1] for axis in parts])
        self.outputs = _blocks([axis.outputs.size for axis in parts])
        self._w, self._y = np.empty((self.inputs[-1].stop, N)), np.empty((self.outputs[-1].stop, N))
        columns = np.arange(n + N * n_r)
        wanted = columns[n:].reshape(N, n_r)
        self._query = np.empty(columns.size)
        order = [np.concatenate([axis.states, wanted[:, axis.regulated].ravel()]) for axis in parts]
        self._order, self._given = np.concatenate(order), np.empty(sum(part.size for part in order))
        self._products: list[tuple[Array, Array, Array]] = []
        """Matrix, what it is multiplied with, where that goes: views."""
        givens = zip(parts, _blocks([part.size for part in order]), self.inputs, self.outputs, strict=True)
        for axis, given, inputs, outputs in givens:
            of_inputs, of_outputs = _maps(axis.problem)
            self._products.append((of_inputs, self._given[given], self._w[inputs].reshape(-1)))
            if axis.outputs.size:
                self._products.append((of_outputs, self._given[given], self._y[outputs].reshape(-1)))

    def at(self, state: Array, desired: Array) -> tuple[Array, Array]:
        """Inputs (m, N) and outputs (n_c, N) of all axes for xi(k) (n,) and y_d (N, n_r); the next call's too."""
        np.concatenate((state, desired), axis=None, out=self._query)
        self._query.take(self._order, out=self._given, mode="clip")  # a mode that takes no copy
        for matrix, given, found in self._products:
            np.dot(matrix, given, out=found)
        return self._w, self._y


def _maps(problem: Problem) -> tuple[Array, Array]:
    """W of one axis, for its inputs (m N, n + N n_r) and outputs (n_c N, ...), each channel's N steps together."""
    N, model, C_c = problem.horizon, problem.model, require_bounds(problem).C_c
    gains, maps = sequence_gains(problem), prediction(model, N)
    if not np.abs(gains.L - np.tile(np.eye(model.nu), (N, 1))).max() < ROUNDING:
        raise np.linalg.LinAlgError("the Hessian is too ill-conditioned")
    inputs = np.hstack([gains.K, gains.G])
    states = maps.Psi @ inputs
    states[:, : model.n] += maps.Phi
    return _by_channel(inputs.reshape(N, model.nu, -1)), _by_channel(C_c @ states.reshape(N, model.n, -1))


def _by_channel(steps: Array) -> Array:
    """(channels N, columns) of (N, channels, columns)."""
    return np.ascontiguousarray(steps.transpose(1, 0, 2)).reshape(-1, steps.shape[2])


def _blocks(sizes: list[int]) -> list[slice]:
    """Neighbouring ranges of these sizes."""
    ends = np.cumsum(sizes).tolist()
    return [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]
