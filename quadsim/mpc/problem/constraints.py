"""Constraints as values, and the stacked rows of all of them, which every formulation of a problem is built from.

A constraint is lower <= C x(k+i) + D u(k+i) + E (u(k+i) - u(k+i-1)) <= upper, hard, or soft with a penalty.  `Bounds`
has those of the paper, Eqs. (12)-(20); `Rows` stacks all constraints of a `quadsim.mpc.problem.ocp.Problem`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Final, NamedTuple, TypeAlias

import numpy as np
from annotated_types import Ge, Le, doc

from quadsim.errors import ParameterError
from quadsim.state import INDEX, N_STATES, STATE_NAMES, STATE_UNITS, Array, Indices, shown_unit

_INPUTS: Final = "controller.input_bounds"
Price = Annotated[float, Ge(0.0), Le(1e12)]
RowFlags: TypeAlias = np.ndarray[tuple[int], np.dtype[np.bool_]]


class Origin(NamedTuple):
    """Where a row comes from, in words and units of scenario files."""

    name: str  # in reports
    unit: str = "-"  # in which files state its bounds
    factor: float = 1.0  # file units per unit of the row
    rotor: int = 0  # the rotor, 1 to 4, where files state the bound for all alike; 0 for other rows
    field: str = ""  # field of the file that states its bounds; empty if none does
    row: int | None = None  # index in the lists `lower` and `upper` of that field; None if the field is a pair
    soft: str = ""  # table of the file that makes it soft; empty if none does

    def place(self, *, upper: bool) -> tuple[str, int]:
        """Return which list of numbers of the file has its upper or lower bound, and at which index.

        A pair is a list, too, of the lower and the upper bound.  The name is empty if no file states the bound.
        """
        if not self.field or self.row is None:
            return self.field, int(upper)
        side = "lower"
        if upper:
            side = "upper"
        return f"{self.field}.{side}", self.row


@dataclass(frozen=True, kw_only=True)
class Penalty:
    """The penalty l1 e + l2 e^2 for violating a row of a soft constraint by e.

    While l1 exceeds the multiplier that the hard row would have, the penalty is exact: e is zero wherever the hard
    problem is feasible (Kerrigan and Maciejowski, 2000, "Soft constraints and exact penalty functions in model
    predictive control").

    Examples:
        >>> from dataclasses import replace
        >>> import numpy as np
        >>> import quadsim
        >>> from quadsim import mpc
        >>> problem = quadsim.problem("paper-constrained")  # with hard bounds on roll and pitch
        >>> penalty = mpc.Penalty(l1=np.full(2, 1e3), l2=np.full(2, 1e3))
        >>> soft = replace(problem, bounds=replace(problem.bounds, penalty=penalty))
        >>> soft.rows.soft.size
        2
    """

    l1: Array  # (m,) at least 0
    l2: Array  # (m,) at least 0
    largest: bool = False  # whether a step's rows share one slack, the largest violation; l1, l2 are then uniform

    def __post_init__(self) -> None:
        for name in ("l1", "l2"):
            value = getattr(self, name)
            is_vector = value.shape == self.l1.shape and value.ndim == 1
            if not is_vector or not _finite_and_not_negative(value):
                raise ParameterError("controller", name, value, "one finite number >= 0 per constrained output")
            if self.largest and (value != value[:1]).any():
                raise ParameterError("controller", name, value, "the same number for all rows that share a slack")


@dataclass(frozen=True, kw_only=True)
class Soft:
    """The cost of violating a soft bound by e: l1 e + l2 e^2."""

    linear: Annotated[
        Price,
        doc(
            "[1/unit; rad for angles of output_bounds, the row's unit of a polytope] l1: exact if larger than the "
            "multipliers of hard bounds, as 1e8 nearly always is; but a nearly hard bound reacts to model errors like "
            "a hard one"
        ),
    ] = 2e5
    quadratic: Annotated[Price, doc("[1/unit^2] l2")] = 1e4

    def penalty(self, rows: int) -> Penalty:
        """Return the penalty for `rows` rows."""
        return Penalty(l1=np.full(rows, self.linear), l2=np.full(rows, self.quadratic))


@dataclass(frozen=True, kw_only=True)
class Constraint:
    """lower <= C x(k+i) + D u(k+i) + E (u(k+i) - u(k+i-1)) <= upper.

    Rows on states alone hold at x(k+1) .. x(k+N), all others at i = 0 .. N-1.  Where rows differ from step to step, as
    half-spaces along a plan do, C stacks them: entry i is for x(k+i+1).

    Examples:
        >>> from dataclasses import replace
        >>> import numpy as np
        >>> import quadsim
        >>> from quadsim import mpc
        >>> problem = quadsim.problem("paper-constrained")
        >>> collective = mpc.Constraint(
        ...     name="collective", lower=np.array([700.0]), upper=np.array([800.0]), D=np.ones((1, 4))
        ... )
        >>> bounded = replace(problem, constraints=(collective,))
        >>> [constraint.name for constraint in bounded.constraints]
        ['collective']
    """

    name: str  # used in messages and audits
    lower: Array  # (m,), or (N, m) if bounds differ from step to step; infinite for no bound
    upper: Array  # same
    C: Array | None = None  # (m, n), or (N, m, n) if rows differ from step to step; None for zeros
    D: Array | None = None  # (m, nu); same
    E: Array | None = None  # (m, nu); same
    penalty: Penalty | None = None  # penalty of a violation; None for a hard constraint
    origins: tuple[Origin, ...] = ()  # (m,) where the rows come from; empty if only the matrices are known

    def __post_init__(self) -> None:
        _check_order(f"{self.name}.lower", self.lower, "upper", self.upper)
        m = self.lower.shape[-1]
        matrices = [matrix for matrix in (self.C, self.D, self.E) if matrix is not None]
        counts = [matrix.shape[-2] for matrix in matrices]
        if not matrices or counts != [m] * len(matrices):
            raise ParameterError("controller", self.name, counts, f"{m} rows")
        for matrix in matrices:
            if not np.isfinite(matrix).all():
                raise ParameterError("controller", self.name, matrices, "finite numbers")
        involves_inputs = self.D is not None or self.E is not None
        if self.C is not None and self.C.ndim == 3 and involves_inputs:
            raise ParameterError("controller", self.name, self.C.shape, "rows of states alone where they differ")
        if self.penalty is not None and self.penalty.l1.size != m:
            raise ParameterError("controller", "l1", self.penalty.l1.shape, f"of shape ({m},)")
        if self.origins and len(self.origins) != m:
            raise ParameterError("controller", f"{self.name}.origins", len(self.origins), f"one per row, {m}")

    def origin(self, row: int) -> Origin:
        """Return where a row comes from; by default its own name, with the row's number if there are several."""
        if self.origins:
            return self.origins[row]
        if self.lower.shape[-1] == 1:
            return Origin(self.name)
        return Origin(f"{self.name}, row {row + 1},")


def _finite_and_not_negative(values: Array) -> bool:
    return bool((np.isfinite(values) & (values >= 0.0)).all())


def _check_order(low: str, lower: Array, high: str, upper: Array) -> None:
    """Reject bounds of different shapes, with NaN, or without a gap."""
    if lower.shape != upper.shape or np.isnan(lower).any() or np.isnan(upper).any():
        raise ParameterError("controller", low, lower, f"numbers of the same shape as {high} = {upper}")
    if np.any(lower >= upper):
        raise ParameterError("controller", low, lower, f"below {high} = {upper}")


def tightened(constraint: Constraint, margins: Array) -> Constraint:
    """Return the constraint with both bounds moved inwards by margins (N, m).

    Raises:
        ParameterError: a margin is negative, not finite or of another shape, or leaves no gap between the bounds.
    """
    m = constraint.lower.shape[-1]
    has_rows = np.ndim(margins) == 2 and margins.shape[1] == m
    if not has_rows or not _finite_and_not_negative(margins):
        raise ParameterError("controller", "margins", margins, f"finite numbers >= 0 of shape (N, {m})")
    lower = constraint.lower + margins
    upper = constraint.upper - margins
    if not np.all(lower < upper):
        raise ParameterError("controller", "margins", margins.max(0), "less than half of the gap between the bounds")
    return replace(constraint, lower=lower, upper=upper)


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """The constraints of Eqs. (12)-(20); an infinite entry means no bound.

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> bounds = quadsim.problem("paper-constrained").bounds
        >>> np.degrees(bounds.y_max).round(6).tolist(), bounds.delta_max.tolist()  # roll, pitch; steps of four speeds
        ([5.0, 5.0], [5.0, 5.0, 5.0, 5.0])
    """

    C_c: Array  # (n_c, n) constrained outputs y_c = C_c xi. Eq. (12)
    y_min: Array  # (n_c,) output bounds. Eq. (13)
    y_max: Array  # same
    delta_min: Array  # (nu,) bounds on u(k) - u(k-1) [rad/s]. Eq. (15)
    delta_max: Array  # same
    u_min: Array  # (nu,) input bounds [rad/s]. Eq. (20)
    u_max: Array  # same
    penalty: Penalty | None = None  # penalty for violating an output bound; None for hard bounds
    margins: Array | None = None  # (N, n_c) tightening of output bounds at each predicted state; None for none

    def __post_init__(self) -> None:
        for low, high in (("y_min", "y_max"), ("delta_min", "delta_max"), ("u_min", "u_max")):
            _check_order(low, getattr(self, low), high, getattr(self, high))

    @property
    def constraints(self) -> tuple[Constraint, ...]:
        """These bounds as three constraints: on outputs, tightened by the margins, on slews and on inputs."""
        outputs = Constraint(
            name="outputs",
            lower=self.y_min,
            upper=self.y_max,
            C=self.C_c,
            penalty=self.penalty,
            origins=tuple(self.output(i) for i in range(len(self.C_c))),
        )
        if self.margins is not None:
            outputs = tightened(outputs, self.margins)
        rotors = self.u_min.size
        identity = np.eye(rotors)
        slews = _rotor_origins("slew", rotors)
        speeds = _rotor_origins("speed", rotors)
        return (
            outputs,
            Constraint(name="slews", lower=self.delta_min, upper=self.delta_max, E=identity, origins=slews),
            Constraint(name="inputs", lower=self.u_min, upper=self.u_max, D=identity, origins=speeds),
        )

    def output(self, i: int) -> Origin:
        """Return the origin of a constrained output: a state, as scenario files name it, or a row of C_c."""
        row = self.C_c[i]
        states = np.flatnonzero(row)
        if states.size == 1:
            state = int(states[0])
            if row[state] == 1.0 and state < N_STATES:
                return origin_of_state(state)
        return Origin(f"row {i} of C_c")


def _rotor_origins(name: str, rotors: int) -> tuple[Origin, ...]:
    """Return the origins of a bound that files state for all rotors alike."""
    field = f"{_INPUTS}.{name}"
    return tuple(Origin(name, "rad/s", rotor=rotor, field=field) for rotor in range(1, rotors + 1))


def selection(names: Sequence[str]) -> Array:
    """Return the rows of the identity that select states by name."""
    indices = [INDEX[name] for name in names]
    return np.eye(N_STATES)[indices]


def origin_of_state(index: int) -> Origin:
    """Return the origin of a bound on one of the paper's states."""
    name = STATE_NAMES[index]
    unit, factor = shown_unit(STATE_UNITS[index])
    return Origin(name, unit, factor, field=f"controller.output_bounds.{name}", soft="controller.soft")


@dataclass(frozen=True, kw_only=True)
class Rows:
    """The m normalised rows of all constraints that have a finite bound, in the constraints' order.

    A row is the constraint's times its `scale`, so that its unit does not affect any solver.  Penalties are those of
    normalised rows too.  Formulations return slacks and multipliers in the constraints' units.
    """

    scale: Array  # (m,) of `row_scale`; the same for rows that share a slack
    C: Array  # (m, n), or (N, m, n) if rows differ from step to step
    D: Array  # (m, nu)
    E: Array  # (m, nu)
    lower: Array  # (N, m)
    upper: Array  # same
    l1: Array  # (m,) linear penalty of a normalised row; infinite for hard rows
    l2: Array  # (m,) quadratic penalty of a normalised row
    slack: Indices  # (m,) index of a soft row's slack within its step; -1 for hard rows
    # (m,) whether a row is of states alone: its entry i is then for x(k+i+1), otherwise for x(k+i) and u(k+i)
    of_states: RowFlags
    input: Indices  # (m,) which input a hard row bounds, if it bounds nothing else; -1 otherwise
    step: Indices  # (m,) which input's step u(k+i) - u(k+i-1) a hard row bounds, if nothing else; -1 otherwise
    names: tuple[str, ...]  # (m,) names of their constraints

    @cached_property
    def slack_scale(self) -> Array:
        """Return (n_s,) the scale of each slack of a step."""
        return self.scale[self.slacks]

    @cached_property
    def on_states(self) -> RowFlags:
        """Return (m,) whether a row involves states, alone or not."""
        return _involves_states(self.C).reshape(len(self.D))

    @cached_property
    def starts(self) -> bool:
        """Return whether a row involves the state at the start of its step: with inputs, at x(k+i)."""
        return bool((self.on_states & ~self.of_states).any())

    @cached_property
    def soft(self) -> Indices:
        """Return (m_s,) the indices of soft rows."""
        return np.flatnonzero(np.isfinite(self.l1))

    @cached_property
    def slacks(self) -> Indices:
        """Return (n_s,) the first row of each slack; these are all soft rows if none share a slack."""
        _, first = np.unique(self.slack[self.soft], return_index=True)
        return self.soft[first]


SCALE_ROUNDING: Final = 1e-9
"""Share by which the largest coefficient of a row may exceed 1 through rounding, as that of a unit normal may."""
LARGEST_EXPONENT: Final = 1000
"""Largest magnitude of the exponent of a row's scale, with which all scales are finite."""


def row_scale(largest: Array) -> Array:
    """Return the powers of two (m,) that bring rows' `largest` coefficients (m,) into (1/2, 1]; 1 for rows of zeros.

    A power of two keeps all digits.  Bounds on single states and inputs, unit normals and sums of terms with factors of
    1 keep their scale of 1.
    """
    _, exponent = np.frexp(largest * (1.0 - SCALE_ROUNDING))
    exponent = np.clip(exponent, -LARGEST_EXPONENT, LARGEST_EXPONENT)
    scale = np.ldexp(1.0, -exponent)
    return np.asarray(np.where(largest > 0.0, scale, 1.0))


def renumbered(slack: Indices) -> Indices:
    """Return the slack numbers (m,) without gaps; hard rows keep -1."""
    _, numbers = np.unique(np.concatenate([[-1], slack]), return_inverse=True)
    return np.asarray(numbers[1:] - 1)


@dataclass(frozen=True)
class _Stack:
    """Rows of one or more constraints one below the other, in the constraints' units; members as in `Rows`."""

    C: Array
    D: Array
    E: Array
    lower: Array
    upper: Array
    l1: Array
    l2: Array
    slack: Indices
    names: list[str]


def stacked_rows(constraints: Sequence[Constraint], *, horizon: int, n: int, nu: int) -> Rows:
    """Return the normalised rows of constraints on a model of n states and nu inputs."""
    stack = _stacked(_parts(constraints, horizon, n, nu))
    scale = _shared_scale(stack)
    column = scale[:, None]
    C = stack.C * column
    D = stack.D * column
    E = stack.E * column
    lower = stack.lower * scale
    upper = stack.upper * scale
    l1 = stack.l1 / scale
    l2 = stack.l2 / scale**2
    hard_on_inputs = np.isinf(l1) & ~_involves_states(C)
    of_states = np.asarray(~D.any(axis=1) & ~E.any(axis=1))
    bounded = np.flatnonzero((np.isfinite(lower) | np.isfinite(upper)).any(axis=0))
    return Rows(
        scale=scale[bounded],
        C=C[..., bounded, :],
        D=D[bounded],
        E=E[bounded],
        lower=lower[:, bounded],
        upper=upper[:, bounded],
        l1=l1[bounded],
        l2=l2[bounded],
        slack=renumbered(stack.slack[bounded]),
        of_states=of_states[bounded].reshape(bounded.size),
        input=np.where(hard_on_inputs, _single_column(D, E), -1)[bounded],
        step=np.where(hard_on_inputs, _single_column(E, D), -1)[bounded],
        names=tuple(stack.names[i] for i in bounded),
    )


def _parts(constraints: Sequence[Constraint], horizon: int, n: int, nu: int) -> list[_Stack]:
    """Return each constraint's rows; C is (N, m, n) for all if rows of any constraint differ from step to step."""
    steps: tuple[int, ...] = ()
    if any(constraint.C is not None and constraint.C.ndim == 3 for constraint in constraints):
        steps = (horizon,)
    parts = []
    first_row = 0
    for constraint in constraints:
        m = constraint.lower.shape[-1]
        l1, l2, slack = _softness(constraint, first_row)
        part = _Stack(
            C=_broadcast(constraint.C, (*steps, m, n)),
            D=_broadcast(constraint.D, (m, nu)),
            E=_broadcast(constraint.E, (m, nu)),
            lower=np.broadcast_to(constraint.lower, (horizon, m)),
            upper=np.broadcast_to(constraint.upper, (horizon, m)),
            l1=l1,
            l2=l2,
            slack=slack,
            names=[constraint.name] * m,
        )
        parts.append(part)
        first_row += m
    return parts


def _stacked(parts: Sequence[_Stack]) -> _Stack:
    """Return the rows of all parts, one below the other."""
    names = []
    for part in parts:
        names += part.names
    return _Stack(
        C=np.concatenate([part.C for part in parts], axis=-2),
        D=np.concatenate([part.D for part in parts], axis=-2),
        E=np.concatenate([part.E for part in parts], axis=-2),
        lower=np.concatenate([part.lower for part in parts], axis=1),
        upper=np.concatenate([part.upper for part in parts], axis=1),
        l1=np.concatenate([part.l1 for part in parts]),
        l2=np.concatenate([part.l2 for part in parts]),
        slack=np.concatenate([part.slack for part in parts]),
        names=names,
    )


def _softness(part: Constraint, first_row: int) -> tuple[Array, Array, Indices]:
    """Return l1, l2 and slacks (m,) of a constraint's rows, the first of which is number `first_row` of all.

    A slack has the number of its first row.  Such numbers have gaps, which `renumbered` closes.
    """
    m = part.lower.shape[-1]
    if part.penalty is None:
        return np.full(m, math.inf), np.zeros(m), np.full(m, -1)
    if part.penalty.largest:
        slack = np.full(m, first_row)
    else:
        slack = first_row + np.arange(m)
    return part.penalty.l1, part.penalty.l2, slack


def _shared_scale(stack: _Stack) -> Array:
    """Return (m,) the `row_scale` of rows; rows that share a slack have the least of theirs."""
    scale = row_scale(_largest_coefficients(stack.C, stack.D, stack.E))
    for number in np.unique(stack.slack[stack.slack >= 0]):
        shared = stack.slack == number
        scale[shared] = scale[shared].min()
    return scale


def _broadcast(matrix: Array | None, shape: tuple[int, ...]) -> Array:
    """Return the matrix in a shape; zeros for None."""
    if matrix is None:
        return np.zeros(shape)
    return np.broadcast_to(matrix, shape)


def _largest_coefficients(C: Array, D: Array, E: Array) -> Array:
    """Return (m,) the largest magnitude of a row's coefficients in C (m, n) or (N, m, n), D and E (m, nu)."""
    of_states = np.abs(C).max(axis=-1, initial=0.0)
    if C.ndim == 3:
        of_states = of_states.max(axis=0)
    of_inputs = np.maximum(np.abs(D).max(axis=1, initial=0.0), np.abs(E).max(axis=1, initial=0.0))
    return np.asarray(np.maximum(of_states, of_inputs))


def _involves_states(C: Array) -> RowFlags:
    """Return (m,) whether rows of C (m, n) or (N, m, n) involve a state."""
    if C.ndim == 3:
        return np.asarray(C.any(axis=(0, 2)))
    return np.asarray(C.any(axis=1))


def _single_column(matrix: Array, other: Array) -> Indices:
    """Return (m,) the only column of a row of the matrix (m, nu), where it is 1 and the other's row is 0; else -1."""
    single = (np.count_nonzero(matrix, axis=1) == 1) & (matrix.max(axis=1, initial=0.0) == 1.0)
    alone = single & ~other.any(axis=1)
    return np.where(alone, np.argmax(matrix, axis=1), -1)
