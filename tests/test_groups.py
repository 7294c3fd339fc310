"""What `make test` leaves out: the groups of slow tests, each with a representative that it runs all the same."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

TESTS = Path(__file__).parent


def marked() -> Iterator[tuple[str, str, Path]]:
    """The mark and group of every `pytest.mark.MARK("group")` of these, and its file."""
    for path in sorted(TESTS.rglob("test_*.py")):
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if "mark.slow" in text or "mark.representative" in text else ():
            match node:
                case ast.Call(
                    func=ast.Attribute(attr="slow" | "representative" as mark), args=[ast.Constant(value=group)]
                ):
                    yield mark, group, path


def test_every_slow_group_has_a_representative_among_the_quick_tests() -> None:
    marks = {*marked()}
    slow, representatives = (
        {(group, path) for mark, group, path in marks if mark == kind} for kind in ("slow", "representative")
    )
    assert {group for group, _ in representatives} == {group for group, _ in slow}
    assert representatives <= slow, "a representative is a test of its group"
