"""Nonlinear optimal control problems in CasADi, solved by IPOPT: from formulas alone, nothing of quadsim is imported.

The vehicle and the first problem are those of Torrente et al., "Data-Driven MPC for Quadrotors" (RA-L 2021): states
position, quaternion wxyz, velocity (world), body rates; inputs thrusts as shares of 20 N; one Runge-Kutta step a node.
The second has rotors that follow their commanded speeds with a lag, the error-state attitude q_r* q, and bounds on tilt
and on steps of the inputs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import casadi as cs
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MASS = 1.0
GRAVITY = 9.81
INERTIA = (0.03, 0.03, 0.06)
LARGEST_THRUST = 20.0
_H: Final = 0.235 * math.sqrt(0.5)
ROTORS_X = (_H, -_H, -_H, _H)
ROTORS_Y = (-_H, -_H, _H, _H)
REACTION = (-0.013, 0.013, -0.013, 0.013)
IPOPT: Final = {
    "ipopt.tol": 1e-11, "ipopt.constr_viol_tol": 1e-11, "ipopt.compl_inf_tol": 1e-11, "ipopt.dual_inf_tol": 1e-9,
    "ipopt.bound_relax_factor": 0.0, "ipopt.honor_original_bounds": "yes", "ipopt.mu_target": 0.0,
    "ipopt.max_iter": 500, "ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False,
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Case:
    """One problem.

    Attributes:
        name: what tables call it.
        nodes: N.
        node: time from one node to the next [s].
        lag: time constant by which rotor speeds follow the inputs [s]; 0 for none.
        speeds: whether inputs are shares of the largest speed, whose square is that of the thrust.
        difference: whether the attitude error is q - q_r, instead of 2 vec(q_r* q).
        position, attitude, velocity, body_rates, input, move: weights.
        tilt: half-angle of a cone around the vertical that a polygon of twelve sides within it bounds [rad].
        steps: (N,) largest steps of an input, from one node to the next; empty for no bound.
        penalty: linear and quadratic, of exceeding a side of the polygon [1/rad, 1/rad^2]; zeros for a hard bound.
    """

    name: str
    nodes: int
    node: float
    lag: float = 0.0
    speeds: bool = False
    difference: bool = True
    position: float = 10.0
    attitude: float = 0.1
    velocity: float = 0.05
    body_rates: float = 0.05
    input: float = 0.1
    move: float = 0.0
    tilt: float = 0.0
    steps: tuple[float, ...] = ()
    penalty: tuple[float, float] = (0.0, 0.0)

    @property
    def n(self) -> int:
        """Number of states."""
        return 17 if self.lag else 13


def rotation(q: cs.SX) -> cs.SX:
    """R(q), polynomial."""
    w, x, y, z = cs.vertsplit(q)
    return cs.vertcat(
        cs.horzcat(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        cs.horzcat(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        cs.horzcat(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def product(p: cs.SX, q: cs.SX) -> cs.SX:
    """The Hamilton product."""
    a = p[0]
    u = p[1:4]
    b = q[0]
    v = q[1:4]
    return cs.vertcat(a * b - cs.dot(u, v), a * v + b * u + cs.cross(u, v))


def slope(case: Case, body: cs.SX, rotors: cs.SX) -> cs.SX:
    """d(p, q, v, omega)/dt."""
    q = body[3:7]
    v = body[7:10]
    omega = body[10:13]
    J = cs.DM(INERTIA)
    thrusts = LARGEST_THRUST * (rotors * rotors if case.speeds else rotors)
    torque = cs.vertcat(
        cs.dot(cs.DM(ROTORS_Y), thrusts), -cs.dot(cs.DM(ROTORS_X), thrusts), cs.dot(cs.DM(REACTION), thrusts)
    )
    return cs.vertcat(
        v,
        product(q, cs.vertcat(0, omega)) / 2,
        cs.vertcat(0, 0, -GRAVITY) + rotation(q) @ cs.vertcat(0, 0, cs.sum1(thrusts) / MASS),
        (torque - cs.cross(omega, J * omega)) / J,
    )


def following(case: Case, x: cs.SX, u: cs.SX) -> cs.SX:
    """x(k+1): the classical Runge-Kutta step of the body, its rotors' speeds those of each instant."""

    def rotors(t: float) -> cs.SX:
        return u + math.exp(-t / case.lag) * (x[13:] - u) if case.lag else u

    h = case.node
    body = x[:13]
    a = slope(case, body, rotors(0.0))
    b = slope(case, body + h / 2 * a, rotors(h / 2))
    c = slope(case, body + h / 2 * b, rotors(h / 2))
    d = slope(case, body + h * c, rotors(h))
    end = body + h / 6 * (a + 2 * b + 2 * c + d)
    return cs.vertcat(end, rotors(h)) if case.lag else end


def residual(case: Case, x: cs.SX, x_r: cs.SX) -> cs.SX:
    """What a state's cost is the sum of the squares of."""
    q = x[3:7]
    q_r = x_r[3:7]
    turned = q - q_r if case.difference else 2 * product(cs.vertcat(q_r[0], -q_r[1:4]), q)[1:4]
    return cs.vertcat(
        math.sqrt(case.position) * (x[:3] - x_r[:3]),
        math.sqrt(case.attitude) * turned,
        math.sqrt(case.velocity) * (x[7:10] - x_r[7:10]),
        math.sqrt(case.body_rates) * (x[10:13] - x_r[10:13]),
    )


class Found(NamedTuple):
    """States (N + 1, n), inputs (N, 4), and whether IPOPT calls them optimal."""

    states: Array
    inputs: Array
    solved: bool


class Peer:
    """A case's nonlinear problem, and the QP of its linearisation along a plan, both solved by IPOPT."""

    def __init__(self, case: Case) -> None:
        self.case = case
        N = case.nodes
        n = case.n
        X = cs.SX.sym("X", n, N + 1)
        U = cs.SX.sym("U", 4, N)
        x_r = cs.SX.sym("x_r", 13, N)
        u_r = cs.SX.sym("u_r", 4, N)
        before = cs.SX.sym("before", 4)
        sides = 12 if case.tilt else 0
        E = cs.SX.sym("E", 1, N) if any(case.penalty) else cs.SX(1, N)  # of the largest violation
        cost = cs.SX(0)
        rows = []
        lower = []
        upper = []
        for i in range(N):
            step = U[:, i] - (U[:, i - 1] if i else before)
            cost += case.input * cs.sumsqr(U[:, i] - u_r[:, i]) + case.move * cs.sumsqr(step)
            if i:
                cost += cs.sumsqr(residual(case, X[:, i], x_r[:, i]))
            rows.append(X[:, i + 1] - following(case, X[:, i], U[:, i]))
            lower = lower + [0.0] * n
            upper = upper + [0.0] * n
            if case.steps:
                rows.append(step)
                lower = lower + [-case.steps[i]] * 4
                upper = upper + [case.steps[i]] * 4
            if sides:
                axis = rotation(X[3:7, i + 1])[:, 2]
                angles = math.tau / sides * np.arange(sides)
                rows.append(cs.DM(np.cos(angles)) * axis[0] + cs.DM(np.sin(angles)) * axis[1] - E[0, i])
                bound = math.sin(case.tilt) * math.cos(math.pi / sides)
                lower = lower + [-math.inf] * sides
                upper = upper + [bound] * sides
                l1, l2 = case.penalty
                excess = E[0, i] / math.cos(case.tilt)  # sines to angles
                cost += l1 * excess + l2 * excess**2
        w = cs.veccat(X, U, *([E] if any(case.penalty) else []))
        g = cs.vertcat(*rows)
        p = cs.veccat(x_r, u_r, before)
        at = cs.SX.sym("at", w.shape)
        there = cs.substitute(g, w, at)
        linear = there + cs.jtimes(there, at, w - at)
        self._whole = cs.nlpsol("whole", "ipopt", {"x": w, "p": p, "f": cost, "g": g}, IPOPT)
        self._linear = cs.nlpsol("linear", "ipopt", {"x": w, "p": cs.vertcat(p, at), "f": cost, "g": linear}, IPOPT)
        self._rows = (lower, upper)
        self._slacks = w.numel() - (N + 1) * n - 4 * N

    def optimum(self, x0: Array, x_r: Array, u_r: Array, before: Array) -> Found:
        """From a state (n,) and an input (4,), towards states (N + 1, 13) and inputs (N, 4), which it starts at."""
        rotors = np.concatenate([u_r, u_r[-1:]]) if self.case.lag else np.zeros((len(x_r), 0))
        guess = np.hstack([x_r, rotors]), np.clip(u_r, 0.0, 1.0)
        return self._solve(self._whole, guess, x0, x_r, u_r, before, along=False)

    def step(self, plan: tuple[Array, Array], x0: Array, x_r: Array, u_r: Array, before: Array) -> Found:
        """The optimum with dynamics and tilt linearised along a plan of states (N + 1, n) and inputs (N, 4)."""
        return self._solve(self._linear, plan, x0, x_r, u_r, before, along=True)

    def _solve(
        self, solver: cs.Function, plan: tuple[Array, Array], x0: Array, x_r: Array, u_r: Array, before: Array,
        *, along: bool,
    ) -> Found:  # fmt: skip
        N = self.case.nodes
        n = self.case.n
        guess = np.concatenate([plan[0].ravel(), plan[1].ravel(), np.zeros(self._slacks)])
        free = np.full(N * n, math.inf)
        low = np.concatenate([x0, -free, np.zeros(4 * N + self._slacks)])
        high = np.concatenate([x0, free, np.ones(4 * N), np.full(self._slacks, math.inf)])
        p = np.concatenate([x_r[:N].ravel(), u_r.ravel(), before, guess if along else []])
        result = solver(x0=guess, p=p, lbx=low, ubx=high, lbg=self._rows[0], ubg=self._rows[1])
        w = result["x"].full().ravel()
        states = w[: n * (N + 1)].reshape(N + 1, n)
        inputs = w[n * (N + 1) :][: 4 * N].reshape(N, 4)
        return Found(states, inputs, bool(solver.stats()["success"]))
