"""Checks against peers: each is held to what it allows and to the page, and shown when all is done."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from peers import constrained_qp, recorded
from peers.checks import HEAD, Check, outdated
from peers.constrained_qp import ConstrainedQP
from peers.recorded import Query
from threadpoolctl import threadpool_limits

from mpc.ocp import Problem

PAGE = Path(__file__).resolve().parents[2] / "docs" / "verification.md"


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> Iterator[None]:
    """Linear algebra on one thread: the matrices are small, and the cores are for the other tests."""
    with threadpool_limits(limits=1):
        yield


@pytest.fixture(scope="session")
def page() -> str:
    """The page that `make verification` wrote."""
    return PAGE.read_text(encoding="utf-8")


@pytest.fixture
def hold(record_property: Callable[[str, object], None]) -> Callable[[Check], None]:
    """Report a check, and fail if it does not hold."""

    def hold_one(check: Check) -> None:
        record_property("check", check.row)
        assert check.holds, " | ".join(check.row)

    return hold_one


@pytest.fixture
def on_page(page: str) -> Callable[[tuple[str, ...]], None]:
    """Fail if the page does not have a row, with today's versions and magnitudes."""

    def row_on_page(row: tuple[str, ...]) -> None:
        assert outdated(row, page) is None, f"{PAGE.name} is out of date: make verification"

    return row_on_page


@pytest.fixture(scope="session")
def recording() -> tuple[Problem, tuple[Query, ...]]:
    """What the controller was given in the paper's constrained flight."""
    return recorded.record()


@pytest.fixture(scope="session")
def problem(recording: tuple[Problem, tuple[Query, ...]]) -> Problem:
    return recording[0]


@pytest.fixture(scope="session")
def queries(recording: tuple[Problem, tuple[Query, ...]]) -> tuple[Query, ...]:
    return recording[1]


@pytest.fixture(scope="session")
def against_qpmpc(problem: Problem, queries: tuple[Query, ...]) -> ConstrainedQP:
    """Every recorded QP, solved by qpmpc and by us."""
    return constrained_qp.measure(problem, queries)


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Write every check that was measured, passed or not, as a table."""
    reports = [report for kind in ("passed", "failed") for report in terminalreporter.getreports(kind)]
    rows = [value for report in reports for name, value in report.user_properties if name == "check"]
    if not rows:
        return
    widths = [max(len(row[i]) for row in (HEAD, *rows)) for i in range(len(HEAD))]
    terminalreporter.section("held against peers")
    for row in (HEAD, *rows):
        terminalreporter.line("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
