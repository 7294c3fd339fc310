"""The parts of a QP cut into stages: where its variables are, and matrices of a fixed pattern."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix

from quadsim.state import Array, Indices


class Pattern:
    """A sparse matrix assembled from blocks (..., rows, columns) that keep their places.

    Args:
        shape: of the matrix.
        places: rows (..., rows) and columns (..., columns) of each block.
        blocks: an example; what is zero in it is left out for good.
        rounding: share of the largest of its block's row and of its block's column below which an entry is zero.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        places: Sequence[tuple[Indices, Indices]],
        blocks: list[Array],
        *,
        rounding: float = 0.0,
    ) -> None:
        pairs = list(zip(places, blocks, strict=True))
        rows = np.concatenate([np.broadcast_to(at[0][..., :, None], block.shape).ravel() for at, block in pairs])
        columns = np.concatenate([np.broadcast_to(at[1][..., None, :], block.shape).ravel() for at, block in pairs])
        order = np.lexsort((rows, columns))
        self._order = order[np.concatenate([_present(block, rounding).ravel() for block in blocks])[order]]
        self._rows = rows[self._order].astype(np.int32)
        counts = np.bincount(columns[self._order], minlength=shape[1])
        self._starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        self._shape = shape

    def matrix(self, blocks: list[Array]) -> csc_matrix:
        """The matrix with these blocks, its zeros stored."""
        data = np.concatenate([block.ravel() for block in blocks])[self._order]
        return csc_matrix((data, self._rows, self._starts), shape=self._shape)


def _present(block: Array, rounding: float) -> NDArray[np.bool_]:
    """Which entries (..., rows, columns) of a block are not zero."""
    size = np.abs(block)
    if not rounding or not size.size:
        return size > 0.0
    largest = np.minimum(size.max(axis=-1, keepdims=True), size.max(axis=-2, keepdims=True))
    return np.asarray(size > rounding * largest)


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Where everything is among the variables.

    Attributes:
        N, n, nu, L, M: horizon, states, inputs, steps in the first stage and in each other.
        head: (L nu,) v_0.
        tail: (J - 1, n + M nu) [s_j, v_j].
        starts: (J, n) s_1 .. s_J.
        inputs: (N, nu) in time order.
        slacks: (N, n_s) in time order; n_s = 0 where bounds are hard.
        ends: (J, n) equality rows.
        lasts, firsts: (J - 1, nu) the last inputs of each stage but the last, and the first of the one after it.
        size: of all.
    """

    N: int
    n: int
    nu: int
    L: int
    M: int
    head: Indices
    tail: Indices
    starts: Indices
    inputs: Indices
    slacks: Indices
    ends: Indices
    lasts: Indices
    firsts: Indices
    size: int


def layout(N: int, n: int, nu: int, n_s: int, M: int) -> Layout:
    """Variables for a horizon N of n states, nu inputs and n_s slacks in stages of M steps."""
    room = M + (n // nu if M > 1 else 0)
    L = N if room >= N else room - (room - N) % M
    stages = (N - L) // M
    first, width = L * nu + (L - 1) * n_s, n + M * (nu + n_s)
    base = first + width * np.arange(stages + 1)[:, None]
    size = first + stages * width + n + n_s
    head, tail = np.arange(L * nu), base[:-1] + np.arange(n + M * nu)
    starts = base + np.arange(n)
    later = base[:-1] + n + M * nu + np.arange(M * n_s)
    inputs = np.concatenate([head, tail[:, n:].ravel()]).reshape(N, nu)
    cuts = L + M * np.arange(stages)
    slacks = [np.arange(L * nu, first), later.ravel(), np.arange(size - n_s, size)]
    return Layout(
        N=N,
        n=n,
        nu=nu,
        L=L,
        M=M,
        head=head,
        tail=tail,
        starts=starts,
        inputs=inputs,
        slacks=np.concatenate(slacks).reshape(N, n_s),
        ends=np.arange(starts.size).reshape(starts.shape),
        lasts=inputs[cuts - 1],
        firsts=inputs[cuts],
        size=size,
    )


def condense_stages(start: Array, A: Array, B: Array, c: Array) -> Array:
    """(J, L + 1, n, m + 1) states of J stages of L steps, as functions of the variables, the inputs the last, and of 1.

    Args:
        start: (J, n, m + 1) the first of them.
        A: (J, L, n, n).
        B: (J, L, n, nu).
        c: (J, L, n).
    """
    (count, steps, n, nu), columns = B.shape, start.shape[2]
    states = np.empty((count, steps + 1, n, columns))
    states[:, 0] = start
    for t in range(steps):
        np.matmul(A[:, t], states[:, t], out=states[:, t + 1])
        at = columns - 1 - (steps - t) * nu
        states[:, t + 1, :, at : at + nu] = B[:, t]
        states[:, t + 1, :, -1] += c[:, t]
    return states
