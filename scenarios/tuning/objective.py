"""What is to be small: arithmetic on a flight's numbers, and its statistic over draws that all candidates share."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from quadsim.errors import InputError, UnknownNameError
from quadsim.state import Array
from scenarios.campaign.results.events import is_number

if TYPE_CHECKING:
    import pyarrow as pa

    from scenarios.tuning.plan import TuningPlan

Rows = Sequence[Mapping[str, Any]]
_FUNCTIONS: Final[dict[str, Callable[..., float]]] = {"sqrt": math.sqrt, "abs": abs, "min": min, "max": max}
_TOKEN: Final = re.compile(
    r"\s*(?:(?P<name>[a-z_][\w.]*)|(?P<number>(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)|(?P<operator>\*\*|[-+*/(),])|(?P<other>\S))",
    re.IGNORECASE,
)
STATISTICS: Final[dict[str, Callable[[Array], float]]] = {
    "mean": lambda values: float(np.mean(values)),
    "median": lambda values: float(np.median(values)),
    "max": lambda values: float(np.max(values)),
}


@dataclass(frozen=True)
class Expression:
    """Arithmetic on the columns of a flight's row; see `parse_expression`."""

    source: str  # in Python, of `row`
    columns: frozenset[str]  # that it names

    def value(self, row: Mapping[str, Any]) -> float:
        """Its value in one flight; NaN where the flight has no such number, or the value is not finite."""
        try:
            value = float(eval(self.source, {"__builtins__": {}, **_FUNCTIONS}, {"row": row}))
        except (ArithmeticError, ValueError, TypeError):  # TypeError: of a number that the flight does not have
            return math.nan
        return value if math.isfinite(value) else math.nan

    def require_columns(self, columns: Mapping[str, pa.DataType]) -> None:
        """Refuse columns that flights do not have, or that hold text.

        Raises:
            UnknownNameError: naming the first of them.
        """
        known = [name for name, kind in columns.items() if is_number(kind)]
        for name in sorted(self.columns.difference(known)):
            raise UnknownNameError("column of numbers", name, known)


def parse_expression(text: str) -> Expression:
    """An expression from its text, e.g. `sqrt(rmse.x**2 + rmse.y**2)`: names, numbers as floats, operators, no more.

    Raises:
        InputError: it is none; the message goes on from the field's name.
    """
    columns, words = set(), []
    for token in _TOKEN.finditer(text.strip()):
        name, number, word = token["name"], token["number"], token[0].strip()
        if token["other"]:
            rule = f"columns, numbers, + - * / ** and {', '.join(_FUNCTIONS)}"
            raise InputError(f"must be made of {rule}; got {word!r} in {text!r}")
        if name and name not in _FUNCTIONS:
            columns.add(name)
        words.append(f"row[{name!r}]" if name in columns else repr(float(number)) if number else word)
    source = " ".join(words)
    try:
        with warnings.catch_warnings(action="ignore"):  # such as that a number is no function
            float(eval(source, {"__builtins__": {}, **_FUNCTIONS}, {"row": dict.fromkeys(columns, 1.0)}))
    except (ArithmeticError, ValueError):
        pass  # for these numbers
    except (SyntaxError, TypeError, NameError, RecursionError, MemoryError) as error:
        raise InputError(f"must be arithmetic on columns, such as 'rmse.x + rmse.y'; got {text!r}") from error
    return Expression(source, frozenset(columns))


@dataclass(frozen=True, kw_only=True)
class Score:
    """The results of a candidate's flights."""

    candidate: int
    flights: int  # that it flew
    count: int  # of them, those with the event that counts
    completed: int  # of them, those that were completed and have every objective
    values: tuple[float, ...]  # of the objectives, corrected for the draws that it did not meet; empty for none
    excess: float  # share of flights with the event, less what is allowed; 1 where no flight was completed

    @property
    def feasible(self) -> bool:
        """Whether no larger share of its flights has the event than is allowed."""
        return self.excess <= 0.0


def score(plan: TuningPlan, candidate: int, rows: Rows, start_rows: Rows) -> Score:
    """The score of a candidate.

    Few flights do not count for or against a candidate that happened to fly easy or hard draws: its statistic is
    corrected by the start's over all draws, less the start's over the same draws (a control variate).

    Args:
        plan: the tuning.
        candidate: its number.
        rows: of its flights, on the first draws in their order.
        start_rows: of the start, on all draws.
    """
    values, start = objective_values(plan, rows), objective_values(plan, start_rows)
    whole, met = (np.asarray(np.isfinite(each).all(axis=1)) for each in (values, start))
    both = whole & met[: len(rows)]
    statistics = [STATISTICS[objective.statistic] for objective in plan.spec.objectives]
    scores: tuple[float, ...] = ()
    if both.any():
        there = start[: len(rows)]
        scores = tuple(of(values[both, i]) - of(there[both, i]) + of(start[met, i]) for i, of in enumerate(statistics))
    elif whole.any():
        scores = tuple(of(values[whole, i]) for i, of in enumerate(statistics))
    count = sum(plan.guard.holds(row) for row in rows)
    return Score(
        candidate=candidate,
        flights=len(rows),
        count=count,
        completed=int(whole.sum()),
        values=scores,
        excess=count / len(rows) - plan.requirement.share if scores else 1.0,
    )


def objective_values(plan: TuningPlan, rows: Rows) -> Array:
    """(flights, objectives) of some flights; NaN for one that was not completed."""
    values = [
        [expression.value(row) if row["status"] == "completed" else np.nan for expression in plan.expressions]
        for row in rows
    ]
    return np.asarray(values, float).reshape(len(rows), len(plan.expressions))
