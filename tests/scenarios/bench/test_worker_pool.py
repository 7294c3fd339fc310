"""Work spread over processes.  They import this module for their function: it imports little."""

from __future__ import annotations

import time as clock

from scenarios.bench.worker_pool import answer_all


def _slow_first(number: int) -> int:
    clock.sleep(0.3 if number == 0 else 0.0)
    return number * number


def test_answers_come_in_the_order_of_their_questions() -> None:
    heard: list[tuple[int, int]] = []
    found = answer_all(_slow_first, [0, 1, 2, 3], workers=2, progress=lambda done, total: heard.append((done, total)))
    assert found == [0, 1, 4, 9]
    assert heard == [(1, 4), (2, 4), (3, 4), (4, 4)]
