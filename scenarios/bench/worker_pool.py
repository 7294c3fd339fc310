"""Many calls of a function, over processes."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TypeVar

from scenarios.machine import usable_cores

Question = TypeVar("Question")
Answer = TypeVar("Answer")


def answer_all(
    function: Callable[[Question], Answer],
    questions: Sequence[Question],
    *,
    workers: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Answer]:
    """Call a module's function for each question in a process, one per usable core by default; the answers in order."""
    context = multiprocessing.get_context("spawn")  # a fork would take over whatever threads hold
    count = min(workers or usable_cores(), len(questions) or 1)
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_leave_interrupts_to_parent)
    answers: dict[int, Answer] = {}
    try:
        futures = {pool.submit(function, question): i for i, question in enumerate(questions)}
        for future in as_completed(futures):
            answers[futures[future]] = future.result()
            progress(len(answers), len(questions))
    finally:
        pool.shutdown(cancel_futures=True)
    return [answers[i] for i in range(len(questions))]


def _leave_interrupts_to_parent() -> None:
    """Ctrl-C reaches every process of a terminal; only the parent reports it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
