"""Checks against peers: each is held to what it allows, and shown and saved when all is done."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from peers import constrained_qp, recorded
from peers.checks import HEAD, Check
from peers.constrained_qp import ConstrainedQP
from peers.recorded import Query
from threadpoolctl import threadpool_limits

from quadsim.mpc.problem.ocp import Problem

MEASURED = Path(__file__).resolve().parents[2] / "runs" / "numbers" / "peers.json"
"""What docs/tools/remake.py fills the table of docs/evidence.md from."""


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> Iterator[None]:
    """Linear algebra on one thread: the matrices are small, and the cores are for the other tests."""
    with threadpool_limits(limits=1):
        yield


@pytest.fixture
def hold(record_property: Callable[[str, object], None]) -> Callable[[Check], None]:
    """Report a check, and fail if it does not hold."""

    def hold_one(check: Check) -> None:
        record_property("check", check.row)
        assert check.holds, " | ".join(check.row)

    return hold_one


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
    """Write every check that was measured, passed or not, as a table; if all was run, save it."""
    reports = [report for kind in ("passed", "failed") for report in terminalreporter.getreports(kind)]
    rows = [value for report in reports for name, value in report.user_properties if name == "check"]
    if not rows:
        return
    widths = [max(len(row[i]) for row in (HEAD, *rows)) for i in range(len(HEAD))]
    terminalreporter.section("held against peers")
    for row in (HEAD, *rows):
        terminalreporter.line("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    if terminalreporter.config.args == ["tests/peers"] and not terminalreporter.config.option.keyword:
        MEASURED.parent.mkdir(parents=True, exist_ok=True)
        MEASURED.write_text(json.dumps(sorted(rows), indent=1), encoding="utf-8")
