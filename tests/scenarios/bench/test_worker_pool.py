"""Work spread over processes.  They import this module for their function: it imports little."""

from __future__ import annotations

import subprocess
import sys
import time as clock
from collections.abc import Callable
from pathlib import Path

from scenarios.bench.worker_pool import answer_all


def _slow_first(number: int) -> int:
    clock.sleep(0.3 if number == 0 else 0.0)
    return number * number


def test_answers_come_in_the_order_of_their_questions() -> None:
    heard: list[tuple[int, int]] = []
    found = answer_all(_slow_first, [0, 1, 2, 3], workers=2, progress=lambda done, total: heard.append((done, total)))
    assert found == [0, 1, 4, 9]
    assert heard == [(1, 4), (2, 4), (3, 4), (4, 4)]


def wait_for(condition: Callable[[], bool]) -> bool:
    """Whether it comes true within 30 s."""
    deadline = clock.monotonic() + 30.0
    while not condition() and clock.monotonic() < deadline:
        clock.sleep(0.02)
    return condition()


def test_no_worker_outlives_a_parent_that_is_killed(tmp_path: Path) -> None:
    """A worker that waits for its next question would never hear that none comes."""
    (tmp_path / "module.py").write_text(
        "import os, pathlib, time\n"
        "def answer(number):\n"
        "    pathlib.Path(str(os.getpid())).touch()\n"
        "    time.sleep(number)\n"
    )
    script = (
        "import module\n"
        "from scenarios.bench.worker_pool import answer_all\n"
        "if __name__ == '__main__': answer_all(module.answer, [0.5, 1000.0], workers=2)\n"
    )
    (tmp_path / "script.py").write_text(script)
    root = Path(__file__).resolve().parents[3]
    parent = subprocess.Popen([sys.executable, "script.py"], cwd=tmp_path, env={"PYTHONPATH": f"{root}:{tmp_path}"})

    def workers() -> list[int]:
        return [int(entry.name) for entry in tmp_path.iterdir() if entry.name.isdigit()]

    try:
        assert wait_for(lambda: len(workers()) == 2)
        clock.sleep(0.5)  # one of the two waits now
    finally:
        parent.kill()
        parent.wait()
    assert wait_for(lambda: not any(Path(f"/proc/{worker}").exists() for worker in workers()))
