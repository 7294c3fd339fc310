"""The optimum without constraints, axis by axis.  Eq. (22)."""

from __future__ import annotations

from typing import Final

import numpy as np
import scipy.linalg

from mpc.core.axes import Axis
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
        inputs: (nu,) what of the answer are inputs, those of one axis after the other.
        outputs: (n_c,) what of it are outputs, likewise.

    Raises:
        numpy.linalg.LinAlgError: a Hessian is so ill-conditioned that the gains are not exact.
    """

    def __init__(self, problem: Problem, parts: list[Axis]) -> None:
        N, n, n_r, nu = problem.horizon, problem.model.n, problem.objective.C_r.shape[0], problem.model.nu
        self._moves = problem.objective.Q_d is not None
        inputs = _blocks([axis.T.shape[1] for axis in parts])
        blocks = _blocks([axis.T.shape[1] + axis.outputs.size for axis in parts])
        ends = [block.start + axis.T.shape[1] for axis, block in zip(parts, blocks, strict=True)]
        self._found = np.empty((blocks[-1].stop, N))
        rows = np.arange(len(self._found))
        self.inputs = np.concatenate([rows[block.start : end] for block, end in zip(blocks, ends, strict=True)])
        self.outputs = np.concatenate([rows[end : block.stop] for block, end in zip(blocks, ends, strict=True)])
        columns = np.arange(n + N * n_r + (nu if self._moves else 0))
        wanted, before = columns[n : n + N * n_r].reshape(N, n_r), columns[n + N * n_r :]
        self._query = np.empty(columns.size)
        order = [
            np.concatenate([axis.states, wanted[:, axis.regulated].ravel(), before[own]])
            for axis, own in zip(parts, inputs, strict=True)
        ]
        self._to_axes = np.concatenate([axis.T_inverse for axis in parts]) if self._moves else np.zeros((0, nu))
        self._order, self._given = np.concatenate(order), np.empty(sum(part.size for part in order))
        self._products: list[tuple[Array, Array, Array]] = []
        """Matrix, what it is multiplied with, where that goes: views."""
        for axis, given, block in zip(parts, _blocks([part.size for part in order]), blocks, strict=True):
            W = _map(axis, problem.rows.C[np.ix_(axis.outputs, axis.states)])
            self._products.append((W, self._given[given], self._found[block].reshape(-1)))

    def at(self, dx: Array, dy: Array, du: Array) -> Array:
        """Inputs w and rows' C x of all axes (nu + n_c, N), for deviations (n,), (N, n_r), (nu,); reused."""
        if self._moves:
            np.concatenate((dx, dy, self._to_axes @ du), axis=None, out=self._query)
        else:
            np.concatenate((dx, dy), axis=None, out=self._query)
        self._query.take(self._order, out=self._given, mode="clip")  # a mode that takes no copy
        for matrix, given, found in self._products:
            np.dot(matrix, given, out=found)
        return self._found


def _map(axis: Axis, C: Array) -> Array:
    """W of one axis (m N + n_c N, columns), each channel's N steps together."""
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
    return np.concatenate(
        [_by_channel(inputs.reshape(N, model.nu, -1)), _by_channel(C @ states.reshape(N, model.n, -1))]
    )


def _by_channel(steps: Array) -> Array:
    """(channels N, columns) of (N, channels, columns)."""
    return np.ascontiguousarray(steps.transpose(1, 0, 2)).reshape(-1, steps.shape[2])


def _blocks(sizes: list[int]) -> list[slice]:
    """Neighbouring ranges of these sizes."""
    ends = np.cumsum(sizes).tolist()
    return [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]
