"""An error about wrong input stands alone: the one that it was made from says the same in words of the code."""

from __future__ import annotations

import ast
from pathlib import Path

import quadsim.errors
import quadsim.scenarios.schema.problems
from quadsim.errors import InputError

ROOT = Path(__file__).resolve().parents[1] / "quadsim"
MODULES = (quadsim.errors, quadsim.scenarios.schema.problems)


def input_errors() -> set[str]:
    names = {"ValidationError"}  # pydantic's, of which ours are made
    for module in MODULES:
        for name, value in vars(module).items():
            if isinstance(value, type) and issubclass(value, InputError):
                names.add(name)
    return names


def caught(handler: ast.ExceptHandler) -> set[str]:
    kinds = handler.type.elts if isinstance(handler.type, ast.Tuple) else [handler.type]
    return {kind.id for kind in kinds if isinstance(kind, ast.Name)}


def chained(tree: ast.AST, errors: set[str]) -> list[int]:
    lines = []
    for handler in ast.walk(tree):
        if not isinstance(handler, ast.ExceptHandler) or not caught(handler) or not caught(handler) <= errors:
            continue
        for node in ast.walk(handler):
            if isinstance(node, ast.Raise) and isinstance(node.cause, ast.Name):
                lines.append(node.lineno)
    return lines


def test_no_message_about_input_trails_the_error_that_it_was_made_from() -> None:
    errors = input_errors()
    assert {"ParameterError", "ScenarioError", "UnknownNameError"} <= errors
    example = "try:\n    f()\nexcept ParameterError as error:\n    raise InputError(str(error)) from error"
    assert chained(ast.parse(example), errors) == [4]
    found = []
    for file in sorted(ROOT.rglob("*.py")):
        for line in chained(ast.parse(file.read_text(encoding="utf-8")), errors):
            found.append(f"{file.relative_to(ROOT)}:{line}")
    assert found == []
