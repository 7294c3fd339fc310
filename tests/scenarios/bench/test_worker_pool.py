"""Work spread over processes.  They import this module for their function: it imports little."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time as clock
from pathlib import Path

import psutil

from scenarios.bench.worker_pool import answer_all


def _slow_first(number: int) -> int:
    clock.sleep(0.3 if number == 0 else 0.0)
    return number * number


def test_answers_come_in_the_order_of_their_questions() -> None:
    heard: list[tuple[int, int]] = []
    found = answer_all(_slow_first, [0, 1, 2, 3], workers=2, progress=lambda done, total: heard.append((done, total)))
    assert found == [0, 1, 4, 9]
    assert heard == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_no_worker_outlives_a_parent_that_is_killed(tmp_path: Path) -> None:
    """A worker that waits for its next question would never hear that none comes."""
    from campaign_pilots import living, until  # here: see the module

    (tmp_path / "script.py").write_text(
        "import time\n"
        "from scenarios.bench.worker_pool import answer_all\n"
        "if __name__ == '__main__':\n"
        "    heard = lambda done, total: print(done, flush=True)\n"
        "    answer_all(time.sleep, [0.0, 1000.0], workers=2, progress=heard)\n"
    )
    command, root = [sys.executable, str(tmp_path / "script.py")], Path(__file__).resolve().parents[3]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == "1\n"  # one works, one waits
        family = {child.pid for child in psutil.Process(parent.pid).children(recursive=True)}
        try:
            assert len(living(family)) >= 2
            parent.kill()
            assert until(lambda: not living(family))
        finally:
            for pid in living(family):
                os.kill(pid, signal.SIGKILL)
