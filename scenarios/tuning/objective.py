"""What is to be small: expressions of a flight's numbers, and their statistic over flights."""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from quadsim.errors import InputError, UnknownNameError
from quadsim.state import Array
from scenarios.campaign.results.events import is_number

if TYPE_CHECKING:
    import pyarrow as pa

_OPERATIONS: Final[dict[type[ast.operator], Callable[[float, float], float]]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_FUNCTIONS: Final[dict[str, Callable[..., float]]] = {"sqrt": math.sqrt, "abs": abs, "min": min, "max": max}
STATISTICS: Final[dict[str, Callable[[Array], float]]] = {
    "mean": lambda values: float(values.mean()),
    "median": lambda values: float(np.median(values)),
    "max": lambda values: float(values.max()),
}


class Expression:
    """Arithmetic on the columns of a flight's row; see `parse_expression`."""

    def __init__(self, text: str, tree: ast.expr, columns: set[str]) -> None:
        self.text, self._tree = text, tree
        self.columns = columns  # that it names

    def value(self, row: Mapping[str, Any]) -> float:
        """Its value in one flight; NaN where the flight has no such number, or the value is not finite."""
        try:
            found = float(_evaluate(self._tree, row))
        except (ArithmeticError, ValueError, TypeError):  # TypeError: of a number that the flight does not have
            return math.nan
        return found if math.isfinite(found) else math.nan


def parse_expression(text: str) -> Expression:
    """An expression from its text, e.g. `sqrt(rmse.x**2 + rmse.y**2)`.

    Raises:
        InputError: it is none; the message goes on from the field's name.
    """
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise InputError(f"must be arithmetic on columns, such as 'rmse.x + rmse.y'; got {text!r}") from error
    return Expression(text, tree, set(_columns(tree, text)))


def require_columns(expression: Expression, columns: Mapping[str, pa.DataType]) -> None:
    """Refuse columns that flights do not have, or that hold text.

    Raises:
        UnknownNameError: naming the first of them.
    """
    known = [name for name, kind in columns.items() if is_number(kind)]
    for name in sorted(expression.columns):
        if name not in known:
            raise UnknownNameError("column of numbers", name, known)


def _columns(node: ast.AST, text: str) -> Iterator[str]:
    """The columns that are named in what is arithmetic; all else is refused."""
    match node:
        case ast.Constant(value=bool() | str() | bytes() | None):
            pass
        case ast.Constant(value=int() | float()):
            return
        case ast.Name() | ast.Attribute() if (name := _dotted(node)) is not None:
            yield name
            return
        case ast.BinOp(left, kind, right) if type(kind) in _OPERATIONS:
            yield from _columns(left, text)
            yield from _columns(right, text)
            return
        case ast.UnaryOp(ast.USub() | ast.UAdd(), operand):
            yield from _columns(operand, text)
            return
        case ast.Call(ast.Name(name), [_, *_] as arguments, []) if name in _FUNCTIONS:
            if (name in ("min", "max")) == (len(arguments) > 1):
                for argument in arguments:
                    yield from _columns(argument, text)
                return
    rule = f"columns, numbers, + - * / ** and {', '.join(_FUNCTIONS)}"
    raise InputError(f"must be made of {rule}; got {ast.unparse(node)!r} in {text!r}")


def _evaluate(node: ast.AST, row: Mapping[str, Any]) -> Any:
    match node:
        case ast.Constant(value):
            return float(value)  # type: ignore[arg-type]
        case ast.BinOp(left, kind, right):
            return _OPERATIONS[type(kind)](_evaluate(left, row), _evaluate(right, row))
        case ast.UnaryOp(kind, operand):
            found = _evaluate(operand, row)
            return -found if isinstance(kind, ast.USub) else found
        case ast.Call(ast.Name(name), arguments):
            return _FUNCTIONS[name](*(_evaluate(argument, row) for argument in arguments))
    return row[_dotted(node) or ""]


def _dotted(node: ast.AST) -> str | None:
    """A name such as `rmse.x`; None for anything else."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute) and (owner := _dotted(node.value)) is not None:
        return f"{owner}.{node.attr}"
    return None
