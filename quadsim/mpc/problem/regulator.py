"""The discrete linear-quadratic regulator, and whether there is one.

With weights on outputs C x alone, the Riccati equation has a stabilising solution only if every mode that the outputs
do not show comes to rest by itself (detectability; Hautus, 1969, "Controllability and observability conditions of
linear autonomous systems").  At a mode that neither grows nor decays, as a free heading is, its solver decides by
rounding: one processor accepts what another refuses.  Such modes are therefore found before, with a tolerance, and the
closed loop is checked after.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import scipy.linalg

from quadsim.state import STATE_NAMES, Array, Indices
from quadsim.vehicle import N_ROTORS

LEAST_DECAY: Final = 1e-6
"""Least share of itself that a mode which comes to rest loses in a period.  Rounding moves that of a free heading or
position, 0, by 1e-7 at most."""
_NEAR: Final = 1e-3
"""Modes that lose less than this share are named together with one that does not come to rest: rounding spreads the
four equal modes of x, vx, pitch and its rate by some 1e-4."""
_RANK: Final = 1e-9  # least size of a further direction of what outputs show, relative to the matrix
_PART: Final = 1e-6  # least size of a state in a mode that is named after it
_ROTORS: Final = tuple(f"rotor {i + 1}" for i in range(N_ROTORS))
_VEHICLES_STATES: Final = (*STATE_NAMES, *_ROTORS)


def lqr(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """K (nu, n) of u = -K x, which minimises the infinite sum of x' Q x + u' R u, x(k+1) = A x(k) + B u(k)."""
    P = scipy.linalg.solve_discrete_are(A, B, Q, R)
    return np.asarray(np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A))


def stabilising(
    A: Array, B: Array, C: Array, Q: Array, R: Array, states: Sequence[str] | None = None
) -> tuple[Array, Array]:
    """Return P (n, n) and K (nu, n) of the regulator u = -K x that brings every state to rest.

    It minimises the infinite sum of x' C' Q C x + u' R u, whose least value is x(0)' P x(0).

    Args:
        A: (n, n) of x(k+1) = A x(k) + B u(k).
        B: (n, nu).
        C: (m, n) the weighted outputs.
        Q: (m, m) their weights, symmetric positive definite.
        R: (nu, nu) those of the inputs, symmetric positive definite.
        states: names of the states; absent for those of a vehicle, with or without its rotors.

    Raises:
        ValueError: there is no such regulator; the text says which states do not come to rest.
    """
    names = states or _VEHICLES_STATES
    hidden = undetected(A, C)
    if hidden.size:
        raise ValueError(f"nothing weighted shows {_state_names(hidden, names)}, which would not come to rest")
    try:
        P = scipy.linalg.solve_discrete_are(A, B, C.T @ Q @ C, R)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ValueError("with these weights the Riccati equation has no solution") from error
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    moving = _states_of(_moving(A - B @ K))
    if moving.size:
        raise ValueError(f"with these weights nothing brings {_state_names(moving, names)} to rest")
    return np.asarray(P), np.asarray(K)


def undetected(A: Array, C: Array) -> Indices:
    """Return the states of the modes that outputs C x do not show, and that do not come to rest by themselves."""
    basis = observed(A, C)
    if basis.shape[1] == len(A):
        return np.zeros(0, np.int64)
    if basis.shape[1]:
        hidden = scipy.linalg.null_space(basis.T)
    else:
        hidden = np.eye(len(A))
    return _states_of(hidden @ _moving(hidden.T @ A @ hidden))


def observed(A: Array, C: Array) -> Array:
    """(n, r) orthonormal basis of the states observed through C x, the row space of [C; C A; ...]."""
    basis = scipy.linalg.orth(C.T)
    while True:
        # Normalised, so that directions and not magnitudes determine the rank.
        further = basis @ (basis.T @ A.T @ basis) - A.T @ basis
        size = np.linalg.norm(further, axis=0)
        new = further[:, size > _RANK * np.linalg.norm(A)]
        if new.size == 0:
            return np.asarray(basis)
        basis = scipy.linalg.orth(np.hstack([basis, new / np.linalg.norm(new, axis=0)]), rcond=_RANK)


def _moving(A: Array) -> Array:
    """(n, r) orthonormal basis of the modes of x(k+1) = A x(k) that do not come to rest, and of those near them."""
    if np.abs(np.linalg.eigvals(A)).max() <= 1.0 - LEAST_DECAY:
        return np.zeros((len(A), 0))
    _, basis, count = scipy.linalg.schur(A, output="complex", sort=lambda value: abs(value) > 1.0 - _NEAR)
    return np.asarray(basis[:, :count])


def _states_of(basis: Array) -> Indices:
    """Return the states that move in modes with this orthonormal basis (n, r)."""
    return np.flatnonzero(np.linalg.norm(basis, axis=1) > _PART)


def _state_names(indices: Indices, names: Sequence[str]) -> str:
    """Return the names of states, of `state i` where one has none."""
    listed = []
    for i in indices.tolist():
        if i < len(names):
            listed.append(names[i])
        else:
            listed.append(f"state {i + 1}")
    return ", ".join(listed)
