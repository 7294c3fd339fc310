"""The bounds of a user's controller as limits of the audit, from its `problem`, `bounds` or `constraints`.

A constraint is lower <= C x + D u + E (u(k) - u(k-1)) <= upper. Its rows become bounds on a state, on the speed or the
slew of all rotors alike, or on a sum of states and rotor speeds. `quadsim.scenarios.limits` puts them into a scenario.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

import numpy as np

from quadsim.errors import InputError
from quadsim.flight.audit import SUM, TERM_SIGNALS, Limit
from quadsim.mpc.problem.constraints import Bounds, Constraint
from quadsim.mpc.problem.ocp import Problem
from quadsim.scenarios.schema.problems import parse_table
from quadsim.state import N_STATES, STATE_NAMES, STATE_UNITS, Array, shown_unit
from quadsim.vehicle import N_ROTORS

_SOURCES: Final = ("problem", "bounds", "constraints")
_SPEEDS: Final = tuple(f"speed_{j + 1}" for j in range(N_ROTORS))
_log: Final = logging.getLogger("quadsim")


def user_limits(controller: object, taken: Iterable[str] = ()) -> list[Limit]:
    """Return what a user's controller says of its bounds, as limits with distinct names.

    Args:
        controller: the user's object, with none, one or more of `problem`, a `quadsim.mpc.Problem`; `bounds`, a
            `quadsim.mpc.Bounds` or pairs by signal, in the units of the audit; `constraints`, a list of
            `quadsim.mpc.Constraint` or of entries as in `[[constraints]]`.
        taken: names that are not free.
    """
    names = set(taken)
    distinct: dict[tuple[Any, ...], Limit] = {}
    for source in _SOURCES:
        try:
            limits = list(_limits(getattr(controller, source, None), source))
        except (ArithmeticError, AttributeError, InputError, LookupError, TypeError, ValueError) as error:
            _log.warning("the controller's %s are not audited: %s", source, error)
            continue
        for limit in limits:
            terms = limit.terms or {}
            bound = (limit.signal, limit.lower, limit.upper, *terms.items())
            if bound not in distinct and limit.name not in names:
                distinct[bound] = limit
                names.add(limit.name)
    return list(distinct.values())


def _limits(stated: Any, source: str) -> Iterator[Limit]:
    """Yield the limits in one attribute of a controller; nothing where there is none."""
    if isinstance(stated, Problem):
        stated = stated.every_constraint
    elif isinstance(stated, Bounds):
        stated = stated.constraints
    elif isinstance(stated, Mapping):
        entries = []
        for name, (lower, upper) in stated.items():
            entries.append({"name": name, "signal": name, "lower": lower, "upper": upper})
        stated = entries
    if stated is None or callable(stated):
        return
    for entry in stated:
        if isinstance(entry, Limit):
            yield entry
        elif isinstance(entry, Constraint):
            yield from _rows(entry)
        else:
            finite = {}
            for name, value in entry.items():
                if not (isinstance(value, float) and math.isinf(value)):
                    finite[name] = value
            yield parse_table(Limit, finite, f"the controller's {source}")


def _rows(constraint: Constraint) -> Iterator[Limit]:
    """Yield the rows of a constraint; rows that change from step to step, or are about other states, are left out."""
    stacked = constraint.C is not None and constraint.C.ndim == 3
    if constraint.lower.ndim != 1 or stacked:
        _log.warning("%s is not audited: its rows change from step to step", constraint.name)
        return
    m = constraint.lower.size
    C = _matrix(constraint.C, m)
    D = _matrix(constraint.D, m)
    E = _matrix(constraint.E, m)
    if D.any() and not C.any() and not E.any():
        signal = "speed"
        pair = _common_bounds(D, constraint)
    elif E.any() and not C.any() and not D.any():
        signal = "slew"
        pair = _common_bounds(E, constraint)
    else:
        signal = ""
        pair = None
    if pair is not None:
        lower, upper = pair
        yield Limit(name=signal, signal=signal, lower=lower, upper=upper)
    elif E.any() or (C.size and C.shape[1] < N_STATES) or C[:, N_STATES:].any():
        _log.warning("%s is not audited: the audit knows the 12 states and rotor speeds", constraint.name)
    else:
        for i in range(m):
            yield from _row(constraint, i, C[i], D[i])


def _matrix(matrix: Array | None, rows: int) -> Array:
    """Return a matrix of a constraint; one without columns where it has none."""
    if matrix is None:
        return np.zeros((rows, 0))
    return matrix


def _common_bounds(matrix: Array, constraint: Constraint) -> tuple[float, float] | None:
    """Return the bounds of rows that bound every rotor alike, None of others."""
    lower = constraint.lower
    upper = constraint.upper
    if matrix.shape != (N_ROTORS, N_ROTORS) or (matrix != np.eye(N_ROTORS)).any():
        return None
    if (lower == lower[0]).all() and (upper == upper[0]).all():
        return (float(lower[0]), float(upper[0]))
    return None


def _row(constraint: Constraint, i: int, C: Array, D: Array) -> Iterator[Limit]:
    """Yield row i of a constraint, with factors in the units of the audit; nothing where it bounds nothing."""
    terms: dict[str, float] = {}
    for name, unit, factor in zip(STATE_NAMES, STATE_UNITS, C[:N_STATES], strict=False):
        if factor:
            _, scale = shown_unit(unit)
            terms[name] = float(factor / scale)
    for name, factor in zip(_SPEEDS, D, strict=False):
        if factor:
            terms[name] = float(factor)
    lower = float(constraint.lower[i])
    upper = float(constraint.upper[i])
    if not terms or (math.isinf(lower) and math.isinf(upper)):
        return
    if len(terms) == 1 and next(iter(terms)) in STATE_NAMES:
        ((name, factor),) = terms.items()
        lower, upper = sorted((lower / factor, upper / factor))
        yield Limit(name=name, signal=name, lower=lower, upper=upper)
    else:
        yield Limit(name=f"{constraint.name}_{i + 1}", signal=SUM, terms=terms, lower=lower, upper=upper)


assert set(_SPEEDS) < set(TERM_SIGNALS)
