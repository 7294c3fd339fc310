"""Many calls of a function, over processes."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TypeVar

from scenarios.campaign.engine.processes import die_with
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
    """Call a module's function for each question in a process, one per usable core by default; the answers in order.

    The processes end with this one, however it ends (on Linux).
    """
    context = multiprocessing.get_context("spawn")  # a fork would take over whatever threads hold
    count = min(workers or usable_cores(), len(questions) or 1)
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_begin, initargs=(os.getpid(),))
    answers: dict[int, Answer] = {}
    try:
        futures = {pool.submit(function, question): i for i, question in enumerate(questions)}
        for future in as_completed(futures):
            answers[futures[future]] = future.result()
            progress(len(answers), len(questions))
    finally:
        pool.shutdown(cancel_futures=True)
    return [answers[i] for i in range(len(questions))]


def _begin(parent: int) -> None:
    """Leave Ctrl-C, which reaches every process of a terminal, to the parent, and end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    die_with(parent)
