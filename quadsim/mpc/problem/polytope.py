"""Polytopes of scenario files: linear constraints on states and rotor speeds, in file units.

A table `[[controller.polytopes]]` states lower <= A v <= upper; `Polytope.constraint` converts it to SI units for the
optimal control problem, and the audit checks the same rows at the physics rate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Final

import numpy as np
from annotated_types import Len, doc

from quadsim.errors import ParameterError, UnknownNameError
from quadsim.fields import NonNegative, Number
from quadsim.input_limits import MOST_ENTRIES
from quadsim.mpc.problem.constraints import Constraint, Origin, Soft
from quadsim.state import INDEX, N_STATES, STATE_NAMES, STATE_UNITS, shown_unit
from quadsim.vehicle import N_ROTORS

IN_DEGREES: Final = frozenset(
    name for name, unit in zip(STATE_NAMES, STATE_UNITS, strict=True) if unit.startswith("rad")
)
"""States that scenario files give in degrees (per second)."""
_SPEEDS: Final = tuple(f"speed_{i + 1}" for i in range(N_ROTORS))
TERMS: Final = (*STATE_NAMES, *_SPEEDS)
"""The quantities that the rows of a polytope may combine."""


@dataclass(frozen=True, kw_only=True)
class Polytope:
    """Linear constraints lower <= A v <= upper on states and rotor speeds.

    For example a geofence, a velocity polytope, a bound on total thrust.  The flight is audited against the same rows,
    at the physics rate.
    """

    name: Annotated[str, doc("name in reports; with several rows name_1, name_2, ...")] = field(
        metadata={"pattern": "^[A-Za-z][A-Za-z0-9_-]*$"}
    )
    of: Annotated[
        tuple[str, ...], Len(1, len(TERMS)), doc("v: states [m, m/s, deg, deg/s], speed_1 to speed_4 [rad/s]")
    ]
    rows: Annotated[tuple[tuple[Number, ...], ...], Len(1, MOST_ENTRIES), doc("A: one list of numbers per row")]
    lower: Annotated[tuple[Number, ...] | None, doc("[unit of the row] one per row; absent: no bound")] = None
    upper: Annotated[tuple[Number, ...] | None, doc("[unit of the row] one per row; absent: no bound")] = None
    soft: Annotated[Soft | None, doc("absent: hard")] = None
    tolerance: Annotated[
        NonNegative | None, doc("[unit of the row] of the audit, at the physics rate; absent: the default")
    ] = None
    tolerance_sampled: Annotated[
        NonNegative | None, doc("[unit of the row] of the audit, at the samples; absent: in proportion to tolerance")
    ] = None
    required: Annotated[bool, doc("false: reported only, without effect on the verdict")] = True

    def __post_init__(self) -> None:
        for name in self.of:
            if name not in TERMS:
                raise ValueError(f"of: {UnknownNameError('signal', name, TERMS)}")
        if len(set(self.of)) < len(self.of):
            raise ValueError(f"of must have distinct names; got {[*self.of]}")
        for row in self.rows:
            if len(row) != len(self.of) or not any(row):
                raise ValueError(f"rows must be lists of {len(self.of)} numbers, not all 0; got {[*row]}")
        if self.lower is None and self.upper is None:
            raise ValueError("lower must be given, or upper, or both")
        for side in ("lower", "upper"):
            bounds = getattr(self, side)
            if bounds is not None and len(bounds) != len(self.rows):
                raise ValueError(f"{side} must have one number per row, {len(self.rows)}; got {[*bounds]}")
        if self.lower is not None and self.upper is not None:
            for below, above in zip(self.lower, self.upper, strict=True):
                if below >= above:
                    raise ValueError(f"lower must be below upper = {above}; got {below}")
        if self.tolerance is not None and (self.tolerance_sampled or 0.0) > self.tolerance:
            rule = f"at most tolerance = {self.tolerance}"
            raise ParameterError("", "tolerance_sampled", self.tolerance_sampled, rule)

    @property
    def row_names(self) -> list[str]:
        """One name per row."""
        if len(self.rows) == 1:
            return [self.name]
        return [f"{self.name}_{i + 1}" for i in range(len(self.rows))]

    def constraint(self) -> Constraint:
        """Return the rows over the 12 states and four rotor speeds, in SI units."""
        rows = np.array(self.rows, float)
        count = len(self.rows)
        C = np.zeros((count, N_STATES))
        D = np.zeros((count, N_ROTORS))
        for name, column in zip(self.of, rows.T, strict=True):
            if name in IN_DEGREES:
                C[:, INDEX[name]] = column * math.degrees(1.0)
            elif name in INDEX:
                C[:, INDEX[name]] = column
            else:
                D[:, int(name.removeprefix("speed_")) - 1] = column
        lower = np.full(count, -math.inf)
        upper = np.full(count, math.inf)
        if self.lower is not None:
            lower = np.array(self.lower, float)
        if self.upper is not None:
            upper = np.array(self.upper, float)
        penalty = None
        if self.soft is not None:
            penalty = self.soft.penalty(count)
        origins = tuple(map(self._origin, range(count)))
        return Constraint(name=self.name, lower=lower, upper=upper, C=C, D=D, penalty=penalty, origins=origins)

    def _origin(self, row: int) -> Origin:
        units = set()
        for name, factor in zip(self.of, self.rows[row], strict=True):
            if factor:
                units.add(_unit(name))
        field = f"controller.polytopes.{self.name}"
        unit = units.pop() if len(units) == 1 else "-"
        return Origin(self.row_names[row], unit, field=field, row=row, soft=f"{field}.soft")


def rows_of(polytopes: Sequence[Polytope]) -> tuple[Constraint, ...]:
    """Return the polytopes as constraints."""
    return tuple(polytope.constraint() for polytope in polytopes)


def _unit(term: str) -> str:
    """Return the unit in which files state a term of a polytope."""
    if term in INDEX:
        return shown_unit(STATE_UNITS[INDEX[term]])[0]
    return "rad/s"
