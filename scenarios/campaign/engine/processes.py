"""What Linux lets a process know and decide of those below it: who they are, what they hold, that none outlives it.

Other systems have nothing of this: there no process is adopted, and what processes hold is not known.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import signal
import time as clock
from collections.abc import Iterable
from pathlib import Path
from typing import Final

_SET_DEATH_SIGNAL: Final = 1  # of prctl(2), as the next
_SET_CHILD_SUBREAPER: Final = 36
_HELD: Final = ("RssAnon:", "RssShmem:", "VmSwap:")
"""Lines of /proc/PID/status: what a process holds that is not just a file's content, shared or not."""
_HELD_ALONE: Final = ("Pss_Anon:", "Pss_Shmem:", "SwapPss:")
"""Lines of /proc/PID/smaps_rollup: the same, what is shared divided by those who share it."""
_WRITABLE: Final = ("VmData:",)
_ENDING_S: Final = 5.0
_MB: Final = 1e6


def adopt_orphans() -> None:
    """From now on this process is the parent of all below it whose own parent dies."""
    _prctl(_SET_CHILD_SUBREAPER, 1)


def die_with(parent: int) -> None:
    """From now on this process is killed when its parent dies; at once if that is no longer `parent`."""
    _prctl(_SET_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def limit_memory(megabytes: float) -> None:
    """Have the system refuse this process, and each below it, more than so much writable memory besides what it has.

    It also takes them first where the machine itself runs out of memory.
    """
    with contextlib.suppress(OSError, ValueError):
        most = int(_sum_of(Path("/proc/self/status"), _WRITABLE) + megabytes * _MB)
        resource.setrlimit(resource.RLIMIT_DATA, (most, most))
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


def memory_above(megabytes: float, pid: int) -> float | None:
    """What a process and all below it hold [MB], where that is more than so much; None where it is not, or not known.

    What they share counts once.
    """
    family = [pid, *_below(pid)]
    if sum(_sum_of(Path(f"/proc/{each}/status"), _HELD) for each in family) <= megabytes * _MB:
        return None  # of what is shared, this counted too much
    held = sum(_sum_of(Path(f"/proc/{each}/smaps_rollup"), _HELD_ALONE) for each in family) / _MB
    return held if held > megabytes else None


def has_strays(worker: int) -> bool:
    """Whether a child of this process has children, or has had some that were left to this process."""
    return bool(_children(worker)) or any(pid != worker for pid in _children(os.getpid()))


def end_children(group: int | None = None) -> None:
    """Kill all below this process, which has adopted orphans, and see that they are gone.

    A group of processes is killed first, in one stroke, which those that keep multiplying do not outrun.
    """
    if group is not None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(group, signal.SIGKILL)
    until = clock.monotonic() + _ENDING_S
    while clock.monotonic() < until:
        for pid in _children(os.getpid()):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
        try:
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        except ChildProcessError:
            return
        clock.sleep(0.001)


def is_stopped(pid: int) -> bool:
    """Whether a process is stopped, as SIGSTOP does."""
    return _state(Path(f"/proc/{pid}"))[:1] == ["T"]


def end_session(session: int) -> None:
    """Kill the processes of a session whose leader is dead."""
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, LookupError):
            if int(_state(folder)[3]) == session:
                os.kill(int(folder.name), signal.SIGKILL)


def _state(process: Path) -> list[str]:
    """/proc/PID/stat after the name: state, parent, group, session; nothing of a process that is gone."""
    try:
        return (process / "stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
    except OSError:
        return []


def _below(pid: int) -> Iterable[int]:
    waiting = _children(pid)
    while waiting:
        each = waiting.pop()
        yield each
        waiting += _children(each)


def _children(pid: int) -> list[int]:
    """Also those that are dead and not waited for; none of a process that is gone."""
    found: list[int] = []
    with contextlib.suppress(OSError):
        for task in os.scandir(f"/proc/{pid}/task"):
            found += map(int, Path(task.path, "children").read_text(encoding="ascii").split())
    return found


def _sum_of(file: Path, names: tuple[str, ...]) -> float:
    """The sum [bytes] of those lines of a file, which are in kB; 0 of a process that is gone."""
    try:
        lines = file.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return 0.0
    return sum(1024.0 * int(line.split()[1]) for line in lines if line.startswith(names))


def _prctl(option: int, value: int) -> None:
    """Where there is none, nothing happens."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(option, value, 0, 0, 0)
