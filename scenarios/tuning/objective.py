"""What is to be small: arithmetic on a flight's numbers, and its mean over draws that all candidates share."""

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


@dataclass(frozen=True)
class Expression:
    """Arithmetic on the columns of a flight's row; see `parse_expression`."""

    source: str  # in Python, of `row`

    def value(self, row: Mapping[str, Any]) -> float:
        """Its value in one flight; NaN where the flight has no such number, or the value is not finite."""
        try:
            value = float(eval(self.source, {"__builtins__": {}, **_FUNCTIONS}, {"row": row}))
        except (ArithmeticError, ValueError, TypeError):  # TypeError: of a number that the flight does not have
            return math.nan
        return value if math.isfinite(value) else math.nan


def parse_expression(text: str, columns: Mapping[str, pa.DataType]) -> Expression:
    """An expression from its text, e.g. `sqrt(rmse.x**2 + rmse.y**2)`: names, numbers as floats, operators, no more.

    Raises:
        InputError: it is none.
        UnknownNameError: flights have no column of numbers with that name.
    """
    known = [name for name, kind in columns.items() if is_number(kind)]
    words = []
    for token in _TOKEN.finditer(text.strip()):
        name, number, word = token["name"], token["number"], token[0].strip()
        if token["other"]:
            rule = f"columns, numbers, + - * / ** and {', '.join(_FUNCTIONS)}"
            raise InputError(f"{text!r} must be made of {rule}; got {word!r}")
        column = name and name not in _FUNCTIONS
        if column and name not in known:
            raise UnknownNameError("column of numbers", name, known)
        words.append(f"row[{name!r}]" if column else repr(float(number)) if number else word)
    source = " ".join(words)
    try:
        with warnings.catch_warnings(action="ignore"):  # such as that a number is no function
            float(eval(source, {"__builtins__": {}, **_FUNCTIONS}, {"row": dict.fromkeys(known, 1.0)}))
    except (ArithmeticError, ValueError):
        pass  # for these numbers
    except (SyntaxError, TypeError, NameError, RecursionError, MemoryError) as error:
        raise InputError(f"{text!r} must be arithmetic on columns, such as 'rmse.x + rmse.y'") from error
    return Expression(source)


@dataclass(frozen=True, kw_only=True)
class Score:
    """The results of a candidate's flights."""

    candidate: int
    flights: int  # that it flew
    count: int  # of them, those with the event that counts
    values: tuple[float, ...]  # of the objectives; empty where no flight has them all
    excess: float  # share of flights with the event, less what is allowed; 1 where there are no values

    @property
    def feasible(self) -> bool:
        """Whether no larger share of its flights has the event than is allowed."""
        return self.excess <= 0.0


def score(plan: TuningPlan, candidate: int, rows: Rows, start_rows: Rows) -> Score:
    """The score of a candidate: the start's mean over all draws, and its mean difference on those that both completed.

    So few flights do not count for or against a candidate that happened to fly easy or hard draws.
    `rows` are its flights, on the first draws in their order; `start_rows` those of the start, on all draws.
    """
    values, start = objective_values(plan, rows), objective_values(plan, start_rows)
    whole, met = (np.asarray(np.isfinite(each).all(axis=1)) for each in (values, start))
    both = whole & met[: len(rows)]
    means: Array = values[whole].mean(axis=0) if whole.any() else np.empty(0)
    if both.any():
        means = start[met].mean(axis=0) + (values - start[: len(rows)])[both].mean(axis=0)
    count = sum(plan.guard.holds(row) for row in rows)
    return Score(
        candidate=candidate,
        flights=len(rows),
        count=count,
        values=tuple(means.tolist()),
        excess=count / len(rows) - plan.requirement.share if means.size else 1.0,
    )


def objective_values(plan: TuningPlan, rows: Rows) -> Array:
    """(flights, objectives) of some flights; NaN for one that was not completed."""
    values = [
        [expression.value(row) if row["status"] == "completed" else np.nan for expression in plan.expressions]
        for row in rows
    ]
    return np.asarray(values, float).reshape(len(rows), len(plan.expressions))
