"""What `make test` leaves out: the groups of slow tests, each with a witness that it runs all the same."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

TESTS = Path(__file__).parent


def marked(mark: str) -> Iterator[tuple[str, Path]]:
    """The group of every `pytest.mark.MARK("group")`, and its file."""
    for path in sorted(TESTS.rglob("test_*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == mark:
                (group,) = (ast.literal_eval(argument) for argument in node.args)
                yield group, path


def test_every_slow_group_has_a_witness_among_the_quick_tests() -> None:
    slow, witnesses = set(marked("slow")), set(marked("witness"))
    assert {group for group, _ in witnesses} == {group for group, _ in slow}
    assert witnesses <= slow, "a witness is a test of its group"
