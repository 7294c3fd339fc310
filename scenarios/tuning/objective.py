"""What is to be small: arithmetic on the numbers of a flight."""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping
from typing import Any, Final

from quadsim.errors import InputError, UnknownNameError

_OPERATORS: Final[dict[type[ast.AST], Callable[..., float]]] = {
    **{ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul},
    **{ast.Div: operator.truediv, ast.Pow: math.pow, ast.USub: operator.neg},
}
_FUNCTIONS: Final[dict[str, Callable[..., float]]] = {"sqrt": math.sqrt, "abs": abs, "min": min, "max": max}


def value_of(expression: str, row: Mapping[str, Any]) -> float:
    """The value of e.g. `sqrt(rmse.x**2 + rmse.y**2)` in a flight; NaN where it has no such number, or no finite one.

    Raises:
        InputError: it is no arithmetic on columns.
        UnknownNameError: the flight has no such column.
    """
    rule = f"with + - * / ** and {', '.join(_FUNCTIONS)}, such as 'rmse.x + rmse.y'"
    refused = InputError(f"{expression!r} must be arithmetic on columns, {rule}")
    try:
        tree = ast.parse(expression.strip(), mode="eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise refused from error
    try:
        value = _value(tree.body, row)
    except InputError:
        raise
    except (ArithmeticError, ValueError):
        return math.nan
    except TypeError as error:
        raise refused from error
    return value if math.isfinite(value) else math.nan


def _value(node: ast.expr, row: Mapping[str, Any]) -> float:
    match node:
        case ast.Constant(value=int() | float() as number):
            return float(number)
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](_value(operand, row))
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](_value(left, row), _value(right, row))
        case ast.Call(func=ast.Name(id=name), args=args, keywords=[]) if name in _FUNCTIONS:
            return _FUNCTIONS[name](*(_value(each, row) for each in args))
        case ast.Name() | ast.Attribute():
            name = ast.unparse(node)
            if name not in row:
                raise UnknownNameError("column of numbers", name, row)
            if row[name] is None:
                raise ValueError(name)
            return float(row[name])
    raise TypeError(node)
