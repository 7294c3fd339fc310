"""A controller that holds still, and does harm once in a flight: each kind of harm by its name.

It stands alone: the processes of a campaign import it by the place of this file.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import locale
import math
import mmap
import os
import resource
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

KINDS: dict[str, Callable[[], object]] = {}
ENDED: dict[str, str] = {}
"""The verdict of each kind's flight where it is no ordinary one."""
_GIGABYTE = 1 << 30
_SIGMASK = set(signal.Signals)


class Hostile:
    """Rotor speeds that just hover, whatever happens.

    Args:
        vehicle: its hover speed is answered.
        period: not used.
        horizon: not used.
        kind: what is done in the fourth step, the last word of this; `calm` does nothing.
        armed: whether anything is done at all.
    """

    def __init__(self, vehicle: Any, *, period: float, horizon: int, kind: str = "calm", armed: bool = False) -> None:
        self._speeds = np.full(4, vehicle.hover_speed)
        self._harm = KINDS.get(kind.split()[-1]) if armed else None
        self._steps = 0

    def step(self, now: Any, state: Any, reference: Any) -> Any:
        """Hover, a little against the tilt, through functions that others may have replaced."""
        self._steps += 1
        if self._harm is not None and self._steps == 4:
            self._harm()
        error = np.clip(state[4] - reference[0, 2], -0.1, 0.1)
        return self._speeds * (1.0 - 0.05 * math.sin(float(error)) * np.float64(1.0))


def _kind(verdict: str = "") -> Callable[[Callable[[], object]], Callable[[], object]]:
    def known(harm: Callable[[], object]) -> Callable[[], object]:
        name = harm.__name__
        KINDS[name] = harm
        if verdict:
            ENDED[name] = verdict
        return harm

    return known


@_kind("timeout")
def hangs_in_python() -> None:
    while True:
        pass


@_kind("timeout")
def hangs_holding_the_interpreter() -> None:
    ctypes.PyDLL(None).sleep(1000)


@_kind("timeout")
def hangs_with_signals_blocked() -> None:
    signal.pthread_sigmask(signal.SIG_BLOCK, _SIGMASK)
    while True:
        time.sleep(1.0)


@_kind("timeout")
def stops_itself() -> None:
    os.kill(os.getpid(), signal.SIGSTOP)


@_kind("timeout")
def waits_for_a_lock() -> None:
    lock = threading.Lock()
    lock.acquire()
    lock.acquire()


@_kind()
def forks() -> None:
    os.fork()


@_kind()
def forks_often() -> None:
    for _ in range(6):
        os.fork()


@_kind()
def forks_and_leaves_a_child() -> None:
    if os.fork() == 0:
        while True:
            time.sleep(1.0)


@_kind()
def forks_a_child_that_raises() -> None:
    if os.fork() == 0:
        raise RuntimeError("in the child")


@_kind("error")
def forks_and_leaves_the_rest_to_the_child() -> None:
    if os.fork():
        os._exit(0)


@_kind()
def leaves_a_daemon() -> None:
    if os.fork() == 0:
        os.setsid()
        if os.fork() == 0:
            signal.pthread_sigmask(signal.SIG_BLOCK, _SIGMASK)
            while True:
                time.sleep(1.0)
        os._exit(0)
    os.wait()


@_kind()
def leaves_a_command() -> None:
    subprocess.Popen(["sleep", "1000"], start_new_session=True)


@_kind("memory")
def takes_memory_at_once() -> Any:
    return np.ones(64 * _GIGABYTE // 8)


@_kind("memory")
def takes_memory_in_small_pieces() -> None:
    held = []
    while True:
        held.append(bytearray(1 << 20))


@_kind("memory")
def takes_shared_memory() -> None:
    held = []
    while True:
        held.append(mmap.mmap(-1, 1 << 26))
        held[-1][::4096] = bytes(len(held[-1]) // 4096)


@_kind("memory")
def has_children_take_memory() -> None:
    for _ in range(8):
        if os.fork() == 0:
            _kept = np.ones((1 << 26) // 8)
            while True:
                time.sleep(1.0)
    while True:
        time.sleep(0.01)


@_kind()
def kills_the_fork_server() -> None:
    _kill_those_with("multiprocessing.forkserver")


@_kind()
def kills_the_resource_tracker() -> None:
    _kill_those_with("multiprocessing.resource_tracker")


@_kind("error")
def kills_its_keeper() -> None:
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(10.0)


@_kind("error")
def kills_itself() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@_kind("error")
def kills_its_group() -> None:
    os.killpg(0, signal.SIGTERM)


@_kind("error")
def aborts() -> None:
    os.abort()


@_kind("error")
def reads_where_nothing_is() -> None:
    ctypes.string_at(0)


@_kind("error")
def exits_at_once() -> None:
    os._exit(0)


@_kind("error")
def asks_to_leave() -> None:
    sys.exit(3)


@_kind("error")
def raises_what_ends_generators() -> None:
    raise GeneratorExit


@_kind("lost")
def raises_what_ctrl_c_raises() -> None:
    raise KeyboardInterrupt


@_kind("error")
def recurses_for_ever() -> None:
    recurses_for_ever()


@_kind("error")
def closes_all_files() -> None:
    os.closerange(3, 4096)


@_kind("error")
def puts_other_files_in_their_place() -> None:
    os.closerange(3, 4096)
    for _ in range(60):
        os.open(os.devnull, os.O_RDWR)


@_kind("error")
def writes_into_all_files() -> None:
    for number in range(3, 64):
        with contextlib.suppress(OSError):
            os.set_blocking(number, False)
            os.write(number, b"x" * 1000)


@_kind()
def prints_megabytes() -> None:
    with Path(os.devnull).open("w") as nothing, contextlib.redirect_stdout(nothing):
        print("x" * 5_000_000)
    print("hostile: printed by a controller")


@_kind()
def changes_the_directory() -> None:
    os.chdir("/")


@_kind()
def changes_the_environment() -> None:
    os.environ.clear()


@_kind()
def takes_signals() -> None:
    for number in (signal.SIGTERM, signal.SIGCHLD, signal.SIGUSR1, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    signal.pthread_sigmask(signal.SIG_BLOCK, _SIGMASK)


@_kind()
def sets_an_alarm() -> None:
    signal.setitimer(signal.ITIMER_REAL, 0.05)


@_kind()
def leaves_threads() -> None:
    def change() -> None:
        while True:
            time.sleep(0.001)
            np.seterr(all="raise")

    threading.Thread(target=change).start()
    threading.Thread(target=change, daemon=True).start()


@_kind()
def has_numbers_raise() -> None:
    np.seterr(all="raise")


@_kind()
def has_warnings_raise() -> None:
    warnings.simplefilter("error")


@_kind()
def rounds_otherwise() -> None:
    ctypes.CDLL("libm.so.6").fesetround(0x400)


@_kind("error")
def replaces_functions_of_numpy() -> None:
    np.clip = lambda value, low, high: 0.07  # type: ignore[assignment]


@_kind()
def replaces_functions_of_math() -> None:
    math.sin = lambda value: 0.5  # type: ignore[assignment]


@_kind("error")
def replaces_the_clock() -> None:
    time.perf_counter = None  # type: ignore[assignment]


@_kind()
def replaces_methods_of_ours() -> None:
    from quadsim.sim.plant import Plant

    Plant.state = lambda self: np.full(12, 0.01)  # type: ignore[method-assign]


@_kind()
def never_collects() -> None:
    gc.disable()
    gc.set_threshold(0)


@_kind()
def speaks_another_language() -> None:
    with contextlib.suppress(locale.Error):
        locale.setlocale(locale.LC_ALL, "C.UTF-8")
    sys.setrecursionlimit(200_000)
    sys.path.insert(0, "/")


@_kind()
def limits_itself() -> None:
    resource.setrlimit(resource.RLIMIT_NOFILE, (12, 12))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))


def _kill_those_with(name: str) -> None:
    """Kill, of the processes that this campaign started, those whose command line has a name; of none if orphaned."""
    pid = os.getpid()
    while "forkserver" in _command(pid):  # a worker, its keeper, the server: they have the server's command line
        pid = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    if pid > 1:
        for each in map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split()):
            if name in _command(each):
                os.kill(each, signal.SIGKILL)


def _command(pid: int) -> str:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace")
    return ""
