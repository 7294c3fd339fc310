"""The optimal control problem of an MPC as a value: the only definition of what is solved.

Over N steps of a linear model, from x(k) and after the input u(k-1), the MPC minimises

    sum_i |C_r x(k+i) - y_d(i)|^2_Qy + |u(k+i-1) - u_s|^2_Qu + |u(k+i-1) - u(k+i-2)|^2_Qd,    i = 1 .. N,

subject to a tuple of constraints. The inputs' target u_s belongs to an equilibrium (`Equilibrium`), and the last state
may have a weight P of its own (`Objective`). Every formulation is built from the stacked rows of all constraints,
whatever their kind.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np

from quadsim import shorthands
from quadsim.errors import ParameterError
from quadsim.mpc.problem.constraints import Bounds, Constraint, Rows, selection, stacked_rows
from quadsim.mpc.problem.model import LinearModel
from quadsim.mpc.problem.regulator import stabilising
from quadsim.state import REFERENCE_RATES, REFERENCE_STATES, STATE_NAMES, Array
from quadsim.vehicle import N_ROTORS

SEMIDEFINITE_ROUNDING: Final = 1e-12
"""Size of a negative eigenvalue, relative to the matrix's largest entry, that a semidefinite matrix may have."""


class Equilibrium(NamedTuple):
    """An equilibrium of the model, x_s = A x_s + B (u_s - u_bar); u_s is also the target of the inputs."""

    x: Array  # (n,) x_s
    u: Array  # (nu,) u_s [rad/s]; (N, nu) if it differs from step to step, as it may with `Query.steps`


@dataclass(frozen=True, kw_only=True)
class Objective:
    """The cost of Eq. (5), with two further terms.

    Examples:
        >>> import numpy as np
        >>> from quadsim import mpc
        >>> position = np.array([[1.0, 0.0]])  # of a double integrator: position, velocity
        >>> objective = mpc.Objective(C_r=position, Q_y=np.eye(1), Q_u=0.1 * np.eye(1))
        >>> objective.Q_u.shape, objective.Q_d is None
        ((1, 1), True)
    """

    C_r: Array  # (n_r, n) regulated outputs y_r = C_r xi. Eq. (4), where the paper prints n_r x n_r
    Q_y: Array  # (n_r, n_r) weight of the output error, symmetric positive definite
    Q_u: Array  # (nu, nu) weight of u - u_s, symmetric positive definite; in the paper, u_s is always u_bar
    # (nu, nu) weight of input changes from step to step, symmetric positive semidefinite; None for none
    Q_d: Array | None = None
    # (n, n) weight of the last state, symmetric positive semidefinite; None for Q_y, as at all other steps.  It weighs
    # the distance from the state x_s + C_r^+ (y_d - C_r x_s), which has the desired outputs and is closest to x_s
    P: Array | None = None
    follows_rates: bool = True  # whether desired velocities and yaw rate are the reference's; otherwise they are 0

    def __post_init__(self) -> None:
        for name in ("Q_y", "Q_u"):
            _check_definite(name, getattr(self, name))
        for name in ("Q_d", "P"):
            if getattr(self, name) is not None:
                _check_semidefinite(name, getattr(self, name))
        if self.C_r.ndim != 2 or self.Q_y.shape[0] != self.C_r.shape[0]:
            raise ParameterError("controller", "C_r", self.C_r.shape, f"of shape ({self.Q_y.shape[0]}, n)")

    @cached_property
    def needs_rates(self) -> bool:
        """Whether a desired output of a linear model depends on the reference's velocities or its yaw rate."""
        return self.follows_rates and bool(self.C_r[:, REFERENCE_RATES].any())

    def desired(self, reference: Array, rates: Array | None = None) -> Array:
        """Return the desired outputs y_r^d (N, n_r) of a linear model; roll, pitch and their rates are desired at 0.

        Args:
            reference: (N, 4) x, y, z [m], yaw [rad].
            rates: (N, 4) their rates of change (`reference_rates`); not read unless the objective `needs_rates`.

        Raises:
            ParameterError: an output depends on the rates, which are absent.
        """
        of_reference: Array = np.dot(reference, self.C_r[:, REFERENCE_STATES].T)
        if not self.needs_rates:
            return of_reference
        if rates is None:
            rule = "given where a velocity or the yaw rate has a weight: Problem.desired computes them"
            raise ParameterError("controller", "rates", None, rule)
        of_rates = np.dot(rates, self.C_r[:, REFERENCE_RATES].T)
        return np.asarray(of_reference + of_rates)

    @cached_property
    def weights(self) -> tuple[Array, Array]:
        """Q (n, n) and W (n, n_r) of the state cost x' Q x - 2 x' W y_d, up to a constant."""
        W = self.C_r.T @ self.Q_y
        return W @ self.C_r, W

    @cached_property
    def terminal_weights(self) -> tuple[Array, Array]:
        """Q (n, n) and W (n, n_r) of the last state's cost dx' Q dx - 2 dx' W dy, up to a constant.

        The deviations are dx = x(k+N) - x_s and dy = y_d - C_r x_s.
        """
        if self.P is None:
            return self.weights
        return self.P, self.P @ np.linalg.pinv(self.C_r)

    @property
    def move_weight(self) -> Array:
        """Q_d (nu, nu), zeros if there is none."""
        if self.Q_d is None:
            return np.zeros_like(self.Q_u)
        return self.Q_d


def objective_of(output_weights: Mapping[str, float], speed_weights: float | Sequence[float]) -> Objective:
    """Return the objective with weights of states, by name, and of rotor speeds, one for all or one per rotor."""
    regulated = [name for name in STATE_NAMES if name in output_weights]
    weights = [output_weights[name] for name in regulated]
    weight_per_rotor = np.broadcast_to(np.asarray(speed_weights, float), N_ROTORS)
    return Objective(C_r=selection(regulated), Q_y=np.diag(weights), Q_u=np.diag(weight_per_rotor))


def reference_rates(reference: Array, period: float) -> Array:
    """Return the velocities [m/s] and the yaw rate [rad/s] (N, 4) of a reference (N, 4), by finite differences.

    The rates at a row are the mean of those of the steps before and after it.  At the first and the last row they are
    the slope of the parabola through the three rows there.  Both are exact where the acceleration is constant.  If
    there are two rows, the rates of both are those of the step between them.

    Args:
        reference: x, y, z [m], yaw [rad], the yaw without jumps of a turn (`quadsim.state.ReferenceTurns`).
        period: time from row to row [s].

    Raises:
        ParameterError: there is only one row.
    """
    if len(reference) < 2:
        rule = "at least 2 where a velocity or the yaw rate has a weight: it is desired as the reference changes"
        raise ParameterError("controller", "horizon", len(reference), rule)
    of_steps = (reference[1:] - reference[:-1]) / period
    rates = np.empty_like(reference)
    rates[1:-1] = 0.5 * (of_steps[:-1] + of_steps[1:])
    second = min(1, len(of_steps) - 1)  # of two rows, the only step
    rates[0] = 1.5 * of_steps[0] - 0.5 * of_steps[second]
    rates[-1] = 1.5 * of_steps[-1] - 0.5 * of_steps[-1 - second]
    return rates


def lqr_terminal_weight(model: LinearModel, objective: Objective, states: Sequence[str] | None = None) -> Array:
    """Return P (n, n) of the DARE: the unconstrained cost of bringing a state to rest over an infinite horizon.

    With it, the unconstrained optimum over N steps is that over an infinite horizon, except for the weight of input
    changes, which the DARE omits.  `states` are the names of the model's states in messages, unless they are a
    vehicle's.

    Raises:
        ParameterError: some states would not come to rest, for example because an undamped state has no weight.
    """
    try:
        P, _ = stabilising(model.A, model.B, objective.C_r, objective.Q_y, objective.Q_u, states)
    except ValueError as error:
        rule = f"left out, or weights on all of x, y, z and yaw: {error}"
        raise ParameterError("controller", "terminal", "lqr", rule) from error
    return np.asarray(0.5 * (P + P.T))  # symmetric to the last bit, as `Objective` requires


class CondensedQP(NamedTuple):
    """min 1/2 x' H x + f' x  subject to  lower <= A x <= upper,  x_min <= x <= x_max; see `Problem.qp`.

    It has n_x variables and n_rows rows; its bounds may be infinite.

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> problem = quadsim.problem("paper-constrained")
        >>> qp = problem.qp(np.zeros(12), np.zeros((50, 4)), problem.model.u_bar)
        >>> qp.H.shape, bool(np.allclose(qp.H, qp.H.T)), bool((qp.x_min <= qp.x_max).all())
        ((200, 200), True, True)
    """

    H: Array  # (n_x, n_x)
    f: Array  # (n_x,)
    A: Array  # (n_rows, n_x)
    lower: Array  # (n_rows,)
    upper: Array  # (n_rows,)
    x_min: Array  # (n_x,)
    x_max: Array  # (n_x,)


@dataclass(frozen=True, kw_only=True, repr=False)
class Problem:
    """A complete definition of a controller, apart from how its optimum is computed.

    Examples:
        >>> import numpy as np
        >>> from quadsim import mpc
        >>> A = np.array([[1.0, 0.1], [0.0, 1.0]])  # a double integrator: position, velocity
        >>> model = mpc.LinearModel(A=A, B=np.array([[0.005], [0.1]]), u_bar=np.zeros(1), period=0.1)
        >>> objective = mpc.Objective(C_r=np.array([[1.0, 0.0]]), Q_y=np.eye(1), Q_u=0.1 * np.eye(1))
        >>> bounds = mpc.Bounds(
        ...     C_c=np.array([[0.0, 1.0]]),  # the velocity
        ...     y_min=np.array([-0.5]),
        ...     y_max=np.array([0.5]),
        ...     delta_min=np.array([-np.inf]),
        ...     delta_max=np.array([np.inf]),
        ...     u_min=np.array([-1.0]),
        ...     u_max=np.array([1.0]),
        ... )
        >>> problem = mpc.Problem(model=model, horizon=20, objective=objective, bounds=bounds)
        >>> query = mpc.Query(state=np.array([2.0, 0.0]), desired=np.zeros((20, 1)), u_before=np.zeros(1))
        >>> answer = mpc.QPSolver("piqp", problem).solve(query)
        >>> velocity = 0.1 * np.cumsum(answer.plan[:, 0])
        >>> answer.status, answer.plan.shape, round(float(velocity.min()), 3)
        ('solved', (20, 1), -0.5)
    """

    model: LinearModel  # the prediction model
    horizon: int  # N, steps
    objective: Objective  # the cost to minimise
    bounds: Bounds | None = None  # the paper's constraints; None for none
    constraints: tuple[Constraint, ...] = ()  # further constraints

    def __post_init__(self) -> None:
        if not isinstance(self.horizon, int) or self.horizon < 1:
            raise ParameterError("controller", "horizon", self.horizon, "a whole number >= 1")
        n = self.model.n
        nu = self.model.nu
        check_shape("C_r", self.objective.C_r, (self.objective.C_r.shape[0], n))
        check_shape("Q_u", self.objective.Q_u, (nu, nu))
        if self.objective.Q_d is not None:
            check_shape("Q_d", self.objective.Q_d, (nu, nu))
        if self.objective.P is not None:
            check_shape("P", self.objective.P, (n, n))
        for constraint in self.every_constraint:
            self._check_constraint(constraint)

    def _check_constraint(self, constraint: Constraint) -> None:
        """Reject a constraint whose matrices or bounds do not have the sizes of the model and the horizon."""
        m = constraint.lower.shape[-1]
        columns = {"C": self.model.n, "D": self.model.nu, "E": self.model.nu}
        for name, count in columns.items():
            matrix: Array | None = getattr(constraint, name)
            if matrix is None:
                continue
            shape: tuple[int, ...] = (m, count)
            if matrix.ndim == 3:
                shape = (self.horizon, m, count)
            check_shape(f"{constraint.name}.{name}", matrix, shape)
        if constraint.lower.ndim == 2:
            check_shape(f"{constraint.name}.lower", constraint.lower, (self.horizon, m))

    def __repr__(self) -> str:
        model = self.model
        sizes = f"{model.n} states, {model.nu} inputs, {self.horizon} periods of {model.period:g} s"
        names = [constraint.name for constraint in self.every_constraint]
        if names:
            rows = f"{self.rows.lower.size} rows of constraints: {', '.join(names)}"
        else:
            rows = "without constraints"
        return f"<Problem: {sizes}\n {rows}>"

    @property
    def equilibrium(self) -> Equilibrium:
        """The equilibrium of the linearisation, at the origin."""
        return Equilibrium(np.zeros(self.model.n), self.model.u_bar)

    @property
    def every_constraint(self) -> tuple[Constraint, ...]:
        """The paper's constraints, in the order of `Bounds.constraints`, then the others."""
        if self.bounds is None:
            return self.constraints
        return (*self.bounds.constraints, *self.constraints)

    def rates(self, reference: Array) -> Array | None:
        """Return the `reference_rates` of a preview (N, 4); None if no desired output depends on them."""
        if self.objective.needs_rates:
            return reference_rates(reference, self.model.period)
        return None

    def desired(self, reference: Array) -> Array:
        """Return the desired outputs (N, n_r) of a preview (N, 4) x, y, z [m], yaw [rad], and of its rates."""
        return self.objective.desired(reference, self.rates(reference))

    def condensed(self) -> Any:
        """The QP in the inputs alone: its parts that are the same in all periods.

        Returns:
            A `quadsim.mpc.Condensed`: `cost` has H (N nu, N nu) of Eq. (7), F_x (N nu, n) of Eq. (8) and F_y (N nu, N
            n_r) of Eq. (9); `qp.G` has the rows, time by time; `inputs(x)` takes a solution to the plan (N, nu)
            [rad/s].

        Examples:
            >>> import quadsim
            >>> form = quadsim.problem("paper-constrained").condensed()
            >>> form.cost.H.shape, form.cost.F_x.shape
            ((200, 200), (200, 12))
        """
        return self._condensed

    @cached_property
    def _condensed(self) -> Any:
        """A `quadsim.mpc.Condensed`, made on first use; its module imports this one, hence `shorthands` and `Any`."""
        return shorthands.condensed_form(self)

    def qp(
        self, state: Array, reference: Array, u_before: Array, equilibrium: Equilibrium | None = None
    ) -> CondensedQP:
        """The condensed QP of one period, as new numpy arrays for any solver.  Eqs. (27)-(29).

        The variables x are the inputs u(k), ..., u(k+N-1) [rad/s], so x[:4] is the command, and then the slacks of
        soft rows.  Tightened bounds are in `lower` and `upper`.  Rows and slacks are those of the constraints times
        `rows.scale`, a power of two that is 1 for bounds on single states.

        Args:
            state: (12,) x(k) [m, m/s, rad, rad/s].  A model with rotor lag has 16 states, the last four of them the
                rotor speeds [rad/s]; if they are left out, the rotors turn at `u_before`.
            reference: (N, 4) x, y, z [m], yaw [rad] at t_{k+1} .. t_{k+N}.
            u_before: (4,) u(k-1) [rad/s].
            equilibrium: where the model rests against a disturbance; absent for hover.

        Raises:
            ParameterError: an array has another shape.

        Examples:
            >>> import numpy as np
            >>> import quadsim
            >>> problem = quadsim.problem("paper-unconstrained")
            >>> qp = problem.qp(np.zeros(12), np.zeros((problem.horizon, 4)), np.full(4, 200.0))
            >>> bool(np.allclose(np.linalg.solve(qp.H, -qp.f)[:4], problem.model.u_bar))
            True
        """
        return self._condensed.period(state, reference, u_before, equilibrium)

    @cached_property
    def rows(self) -> Rows:
        """The rows of all constraints, normalised."""
        constraints = self.every_constraint
        if not constraints:
            raise ValueError("a constrained MPC needs a problem with bounds")
        return stacked_rows(constraints, horizon=self.horizon, n=self.model.n, nu=self.model.nu)


class Query(NamedTuple):
    """What differs from period to period, and with the `Problem` determines the optimum.

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> from quadsim import mpc
        >>> problem = quadsim.problem("paper-constrained")
        >>> reference = np.tile([1.0, 0.0, 0.0, 0.0], (50, 1))  # x, y, z [m], yaw [rad]
        >>> query = mpc.Query(state=np.zeros(12), desired=problem.desired(reference), u_before=problem.model.u_bar)
        >>> query.desired.shape
        (50, 4)
    """

    state: Array  # (n,) x(k)
    desired: Array  # (N, n_r) y_d for x(k+1) .. x(k+N)
    u_before: Array  # (nu,) u(k-1) [rad/s]
    equilibrium: Equilibrium | None = None  # None for the problem's own
    # A (N, n, n), B (N, n, nu) and c (N, n) of a model that changes from step to step, x(k+i+1) = A_i x(k+i) +
    # B_i u(k+i) + c_i; None for the problem's model
    steps: tuple[Array, Array, Array] | None = None


def predicted(problem: Problem, query: Query, plan: Array) -> Array:
    """Return (N, n) the states x(k+1) .. x(k+N) that the model predicts for a plan (N, nu)."""
    if query.steps is not None:
        return _predicted_by_steps(query.state, query.steps, plan)
    model = problem.model
    x_s, u_s = query.equilibrium or problem.equilibrium
    of_inputs = (plan - u_s) @ model.B.T
    deviations = np.empty((len(plan), query.state.size))
    deviation = query.state - x_s
    for i, of_input in enumerate(of_inputs):
        deviation = model.A @ deviation + of_input
        deviations[i] = deviation
    return deviations + x_s


def _predicted_by_steps(state: Array, steps: tuple[Array, Array, Array], plan: Array) -> Array:
    """Return the same for a model that changes from step to step (`Query.steps`), from the state x(k)."""
    A, B, c = steps
    of_inputs = np.matmul(B, plan[:, :, None])[:, :, 0]
    states = np.empty((len(plan), state.size))
    before = state
    for A_i, of_input, c_i, after in zip(A, of_inputs, c, states, strict=True):
        np.dot(A_i, before, out=after)
        np.add(after, of_input, out=after)
        np.add(after, c_i, out=after)
        before = after
    return states


@dataclass(frozen=True, kw_only=True)
class InfeasiblePeriod:
    """The first period of a flight without an answer, or whose SQP did not converge.

    Examples:
        >>> import quadsim
        >>> tilted = quadsim.load("hover", {"initial.euler": [20.0, 0.0, 0.0], "duration": 0.2})
        >>> period = quadsim.fly(tilted).infeasible_period
        >>> period.time, bool(period.query.state[6] > 0.3)  # roll [rad]
        (0.0, True)
    """

    problem: Problem  # the optimal control problem of that period
    query: Query  # the state and reference without a solution
    status: str  # why the answer was rejected
    time: float  # t_k, start of the period [s]
    delay: float = 0.0  # from t_k to the instant of x(k) [s]
    converges: Callable[[int], bool] | None = None  # if the SQP did not converge: whether it does within n iterations

    def __post_init__(self) -> None:
        # A controller may overwrite its state and its last command in the next period.
        state = self.query.state.copy()
        u_before = self.query.u_before.copy()
        object.__setattr__(self, "query", self.query._replace(state=state, u_before=u_before))


def check_shape(name: str, value: Array, shape: tuple[int, ...]) -> None:
    """Raise `ParameterError` if an array of the controller, by its name in messages, does not have this shape."""
    if value.shape != shape:
        raise ParameterError("controller", name, value.shape, f"of shape {shape}")


def _check_definite(name: str, matrix: Array) -> None:
    """Reject a matrix that is not symmetric and positive definite."""
    if not _is_symmetric(matrix) or not _smallest_eigenvalue(matrix) > 0.0:
        raise ParameterError("controller", name, matrix.tolist(), "symmetric and positive definite")


def _check_semidefinite(name: str, matrix: Array) -> None:
    """Reject a matrix that is not symmetric and, but for rounding, positive semidefinite."""
    if _is_symmetric(matrix):
        rounding = SEMIDEFINITE_ROUNDING * np.abs(matrix).max(initial=0.0)
        if _smallest_eigenvalue(matrix) >= -rounding:
            return
    raise ParameterError("controller", name, matrix.tolist(), "symmetric and positive semidefinite")


def _is_symmetric(matrix: Array) -> bool:
    """Return whether a matrix is symmetric, and all its entries are finite."""
    square = matrix.ndim == 2 and matrix.shape[0] == matrix.shape[1]
    return square and np.array_equal(matrix, matrix.T) and bool(np.all(np.isfinite(matrix)))


def _smallest_eigenvalue(matrix: Array) -> float:
    """Return the smallest eigenvalue of a symmetric matrix; infinite for one without entries."""
    return float(np.linalg.eigvalsh(matrix).min(initial=math.inf))
