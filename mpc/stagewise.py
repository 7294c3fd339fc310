"""The QP of a model that differs from step to step, x(k+i+1) = A_i x(k+i) + B_i u(k+i) + c_i, solved by PIQP.

As in `mpc.multistage` the horizon is cut into stages of a few steps each, the variables in stage order,

    v_0, e_0 | s_1, v_1, e_1 | s_2, v_2, e_2 | ... | s_J, e_J

with s_j the state at the start of stage j (s_0 = x(k) is known, s_J = x(k+N)), v_j = u - u_ref of its steps and, where
output bounds are soft, e_j the slacks of its states.  States inside a stage are condensed.  Minimised is

    sum_i |C_r x(k+i) - y_d(i)|^2_Qy + |u(k+i-1) - u_ref(i)|^2_Qu + |u(k+i-1) - u(k+i-2)|^2_Qd
          + l1' e(i) + |e(i)|^2_l2,  i = 1 .. N,

subject to hard bounds on inputs and slews, and to y_min - e <= C_c x <= y_max + e, e >= 0; hard ones have e = 0.

The pattern of the matrices is fixed, entries that happen to be zero included: each period only their values change.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import piqp

from mpc.penalty import Penalty as Penalty
from mpc.problem import Bounds, Objective
from mpc.qp import QP, Solution, Vectors
from mpc.solvers import _piqp
from mpc.stagematrices import Matrices, MatrixBuilder, condense
from mpc.stages import constraint_rows, layout
from quadsim.errors import ParameterError
from quadsim.state import Array

STEPS_PER_STAGE: Final = 4
"""M, the fastest of 1 to 7 for 16 states, though 2 to 5 hardly differ."""
SCALINGS: Final = 3
"""Passes of PIQP's scaling, which new matrices need anew: its usual ten take 0.2 ms longer and save no iteration."""
LARGEST: Final = 1e6
"""Magnitude of a number in the data beyond which it is no vehicle's: four steps of such numbers multiply to 1e30, where
PIQP takes bounds for infinite."""


@dataclass(frozen=True, kw_only=True)
class Program:
    """One period's QP, and what turns its answer into a trajectory.

    Attributes:
        qp: sparse matrices of the fixed pattern.
        u_reference: (N, nu) [rad/s].
        head: (1, L + 1, n) the states of the first stage where v_0 = 0.
        tail: (J - 1, M + 1, n) those of the others where s_j = 0, v_j = 0.
    """

    qp: QP
    u_reference: Array
    head: Array
    tail: Array


@dataclass(frozen=True, kw_only=True)
class StagewiseAnswer:
    """A trajectory; to be used only when the solution's status is `solved`.

    Attributes:
        plan: (N, nu) inputs [rad/s].
        states: (N, n) predicted states x(k+1) .. x(k+N).
        slack: (N, n_c) how far outputs may leave their bounds there; zero where these are hard.
        solution: PIQP's answer.
    """

    plan: Array
    states: Array
    slack: Array
    solution: Solution


class StagewiseQP:
    """Sets PIQP up once, then solves with other matrices each period.

    Args:
        N: horizon, steps.
        n: number of states.
        nu: number of inputs.
        objective: C_r (n_r, n), Q_y and Q_u.
        bounds: on outputs, inputs and slews; an infinite entry is no bound.
        penalty: of leaving the output bounds; None for hard ones.
        move_weight: Q_d (nu, nu), of an input's change from one step to the next; None for none.
        margins: (N, n_c) by which the output bounds are drawn in at each predicted state; None for none.
        steps_per_stage: M.  The first stage, which has no state among its variables, takes what is left of the horizon,
            and where M > 1 as many more steps as there is room for in blocks of the others' size.
        tolerance: absolute, of PIQP.

    Raises:
        ParameterError: a number or a shape is not possible.
    """

    def __init__(
        self,
        N: int,
        n: int,
        nu: int,
        objective: Objective,
        bounds: Bounds,
        penalty: Penalty | None = None,
        *,
        move_weight: Array | None = None,
        margins: Array | None = None,
        steps_per_stage: int = STEPS_PER_STAGE,
        tolerance: float = _piqp.TOLERANCE,
    ) -> None:
        for name, value in (("horizon", N), ("steps_per_stage", steps_per_stage)):
            if not isinstance(value, int) or value < 1:
                raise ParameterError("controller", name, value, "a whole number >= 1")
        _check_shapes(n, nu, objective, bounds, penalty)
        _check_options(N, nu, bounds, move_weight, margins)
        self._n_c = bounds.y_min.size
        self._at = at = layout(N, n, nu, 0 if penalty is None else self._n_c, steps_per_stage)
        self._root = np.linalg.cholesky(objective.Q_y).T  # |y|^2_Qy = |root y|^2
        self._regulated = self._root @ objective.C_r
        self._move_weight = 2.0 * (np.zeros((nu, nu)) if move_weight is None else move_weight)
        self._rows = rows = constraint_rows(at, bounds, soft=penalty is not None, margins=margins)
        self._penalty = penalty
        l1, l2 = (np.zeros(0), np.zeros(0)) if penalty is None else (penalty.l1, penalty.l2)
        self._builder = MatrixBuilder(
            at, rows, self._regulated, 2.0 * objective.Q_u, self._move_weight, 2.0 * np.tile(l2, N)
        )
        self._c = np.zeros(at.size)
        self._c[at.slacks] = l1
        self._x_l, self._x_u = np.full(at.size, -math.inf), np.full(at.size, math.inf)
        self._x_l[at.inputs], self._x_u[at.inputs], self._x_l[at.slacks] = bounds.u_min, bounds.u_max, 0.0

        self._solver = piqp.SparseSolver()
        self._solver.settings.kkt_solver = piqp.KKTSolver.sparse_multistage
        self._solver.settings.preconditioner_iter = SCALINGS
        _piqp.configure(self._solver)
        self._solver.settings.eps_abs, self._solver.settings.eps_rel = tolerance, 0.1 * tolerance
        nothing = np.zeros((N, n))
        self._held = self.prepare(np.tile(np.eye(n), (N, 1, 1)), np.tile(np.eye(n, nu), (N, 1, 1)))
        desired = np.zeros((N, len(self._root)))
        program = self.formulate(self._held, nothing, nothing[0], desired, np.zeros(nu), np.zeros(nu))
        _piqp.setup(self._solver, program.qp)

    def solve(
        self, A: Array, B: Array, c: Array, x0: Array, desired: Array, u_before: Array, u_reference: Array
    ) -> StagewiseAnswer:
        """Solve one period's QP.

        Data that is not finite, or beyond `LARGEST`, is answered with the status `invalid_data`: PIQP cannot be trusted
        to notice.

        Args:
            A: (N, n, n), A_i.
            B: (N, n, nu), B_i.
            c: (N, n), c_i.
            x0: (n,) x(k).
            desired: (N, n_r) y_d for x(k+1) .. x(k+N).
            u_before: (nu,) u(k-1) [rad/s].
            u_reference: (nu,) or (N, nu) u_ref [rad/s].
        """
        if not _usable(A, B):
            return self._refusal()
        return self.solve_prepared(self.prepare(A, B), c, x0, desired, u_before, u_reference)

    def prepare(self, A: Array, B: Array) -> Matrices:
        """The QP's matrices; arguments as for `solve`."""
        return self._builder.build(A, B)

    def solve_prepared(
        self, matrices: Matrices, c: Array, x0: Array, desired: Array, u_before: Array, u_reference: Array
    ) -> StagewiseAnswer:
        """Solve one period's QP, in half the time where the matrices are those of the call before.

        Args:
            matrices: of `prepare`.
            c: (N, n), c_i.
            x0: (n,) x(k).
            desired: (N, n_r) y_d for x(k+1) .. x(k+N).
            u_before: (nu,) u(k-1) [rad/s].
            u_reference: (nu,) or (N, nu) u_ref [rad/s].
        """
        if not _usable(c, x0, desired, u_before, u_reference):
            return self._refusal()
        program = self.formulate(matrices, c, x0, desired, u_before, u_reference)
        qp, at = program.qp, self._at
        others = {"x_l": qp.x_l, "x_u": qp.x_u}
        if matrices is not self._held:
            others |= {"P": qp.P, "A": qp.A, "G": qp.G}
            self._held = matrices
        vectors = Vectors(c=qp.c, b=qp.b, h_l=qp.h_l, h_u=qp.h_u)
        solution = _piqp.solve(_WithMore(self._solver, others), vectors, rows=qp.h_l.size)
        x = solution.x
        first = (matrices.head @ x[at.head] + program.head)[0, 1:-1]
        later = (matrices.tail[:, :-1] @ x[at.tail][:, None, :, None])[..., 0] + program.tail[:, :-1]
        return StagewiseAnswer(
            plan=x[at.inputs] + program.u_reference,
            states=np.concatenate([first, later.reshape(-1, at.n), x[at.starts[-1:]]]),
            slack=np.zeros((at.N, self._n_c)) if self._penalty is None else x[at.slacks],
            solution=solution,
        )

    def formulate(
        self, matrices: Matrices, c: Array, x0: Array, desired: Array, u_before: Array, u_reference: Array
    ) -> Program:
        """One period's QP; arguments as for `solve_prepared`."""
        at, rows = self._at, self._rows
        reference = np.broadcast_to(u_reference, (at.N, at.nu))
        head, tail = self._offsets(matrices, c + (matrices.B @ reference[:, :, None])[:, :, 0], x0)
        # Row i is for x(k+i); x(k) itself is past changing, and its row has no effect.
        wanted = np.concatenate([np.zeros((1, len(self._root))), desired @ self._root.T])
        gradient = self._c.copy()
        gradient[at.head] = _pull(matrices.first, head[:, :-1] @ self._regulated.T, wanted[: at.L])[0]
        gradient[at.tail] = _pull(matrices.later, tail[:, :-1] @ self._regulated.T, wanted[at.L : -1])
        gradient[at.starts[-1]] = -2.0 * self._regulated.T @ wanted[-1]
        changes = np.diff(reference, axis=0, prepend=u_before[None])
        pulls = changes @ self._move_weight
        gradient[at.inputs] += pulls
        gradient[at.inputs[:-1]] -= pulls[1:]
        known = np.concatenate([head[0, 1:-1], tail[:, :-1].reshape(-1, at.n), np.zeros((1, at.n))]) @ rows.C.T
        shift = np.concatenate([known.ravel(), changes[:, rows.limited].ravel()])
        x_l, x_u = self._x_l.copy(), self._x_u.copy()
        x_l[at.inputs] -= reference
        x_u[at.inputs] -= reference
        qp = QP(
            P=matrices.P,
            c=gradient,
            A=matrices.dynamics,
            b=np.concatenate([head[:, -1], tail[:, -1]]).ravel(),
            G=matrices.rows,
            h_l=rows.h_l - shift,
            h_u=rows.h_u - shift,
            x_l=x_l,
            x_u=x_u,
        )
        return Program(qp=qp, u_reference=reference, head=head, tail=tail)

    def _offsets(self, matrices: Matrices, c: Array, x0: Array) -> tuple[Array, Array]:
        """`head` and `tail` of a program."""
        zero = np.zeros((len(self._at.tail), self._at.n, 1))
        head, tail = condense(self._at, x0[None, :, None], zero, matrices.A, matrices.B[:, :, :0], c)
        return head[..., 0], tail[..., 0]

    def _refusal(self) -> StagewiseAnswer:
        at, rows = self._at, self._rows
        solution = Solution(
            x=np.full(at.size, math.nan),
            y=np.full(at.starts.size, math.nan),
            z=np.full(rows.h_l.size, math.nan),
            z_box=np.full(at.size, math.nan),
            status="invalid_data",
            iterations=0,
            active=0,
            primal_residual=math.nan,
            dual_residual=math.nan,
            solve_s=0.0,
        )
        plan, states, slack = (np.full((at.N, width), math.nan) for width in (at.nu, at.n, self._n_c))
        return StagewiseAnswer(plan=plan, states=states, slack=slack, solution=solution)


class _WithMore:
    """A PIQP solver that is told more with the new vectors: two updates would scale the data twice."""

    def __init__(self, solver: Any, more: dict[str, Any]) -> None:
        self._solver, self._more = solver, more

    def update(self, **vectors: Array) -> None:
        self._solver.update(**self._more, **vectors)

    def solve(self) -> Any:
        return self._solver.solve()

    @property
    def result(self) -> Any:
        return self._solver.result


def _usable(*parts: Array) -> bool:
    return all(np.abs(part).max() <= LARGEST for part in parts)


def _pull(slopes: Array, outputs: Array, wanted: Array) -> Array:
    """Gradient (J, m) of the error of outputs (J, L, n_r) that is at zero variables."""
    errors = outputs.reshape(len(slopes), slopes.shape[1], 1) - wanted.reshape(len(slopes), slopes.shape[1], 1)
    pull: Array = 2.0 * (slopes.transpose(0, 2, 1) @ errors)[..., 0]
    return pull


def _check_shapes(n: int, nu: int, objective: Objective, bounds: Bounds, penalty: Penalty | None) -> None:
    n_c = bounds.y_min.size
    shapes = {
        "C_r": (objective.C_r, (len(objective.Q_y), n)),
        "Q_u": (objective.Q_u, (nu, nu)),
        "C_c": (bounds.C_c, (n_c, n)),
        "u_min": (bounds.u_min, (nu,)),
        "delta_min": (bounds.delta_min, (nu,)),
        "l1": (np.zeros(n_c) if penalty is None else penalty.l1, (n_c,)),
    }
    for name, (value, shape) in shapes.items():
        if value.shape != shape:
            raise ParameterError("controller", name, value.shape, f"of shape {shape}")


def _check_options(N: int, nu: int, bounds: Bounds, move_weight: Array | None, margins: Array | None) -> None:
    if move_weight is not None and not (
        np.shape(move_weight) == (nu, nu)
        and np.isfinite(move_weight).all()
        and np.array_equal(move_weight, move_weight.T)
        and np.linalg.eigvalsh(move_weight)[0] >= -1e-12 * np.abs(move_weight).max()
    ):
        rule = f"a symmetric matrix of shape {(nu, nu)} without negative eigenvalues"
        raise ParameterError("controller", "move_weight", move_weight, rule)
    if margins is None:
        return
    shape = (N, bounds.y_min.size)
    if np.shape(margins) != shape or not (np.isfinite(margins) & (margins >= 0.0)).all():
        raise ParameterError("controller", "margins", margins, f"finite numbers >= 0 of shape {shape}")
    if not np.all(bounds.y_min + margins < bounds.y_max - margins):
        raise ParameterError("controller", "margins", margins.max(0), "less than half of what is between the bounds")
