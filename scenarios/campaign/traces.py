"""What a flight's controller may leave behind in its process, where the next flight would meet it."""

from __future__ import annotations

import gc
import locale
import os
import resource
import signal
import sys
import threading
import warnings
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import numpy as np

_PACKAGES: Final = ("quadsim", "mpc", "scenarios")
_MODULES: Final = (
    *("builtins", "gc", "math", "os", "random", "time", "warnings"),
    *("mujoco", "numpy", "numpy.linalg", "piqp", "scipy.linalg"),
)
"""Besides our own packages: modules that flights use, in which somebody may put something else."""
_LIMITS: Final = tuple(getattr(resource, name) for name in dir(resource) if name.startswith("RLIMIT_"))
_TIMERS: Final = (signal.ITIMER_REAL, signal.ITIMER_VIRTUAL, signal.ITIMER_PROF)
_ONE, _THREE, _SMALLEST = 1.0, 3.0, 5e-324
_Settings = tuple[Any, ...]


class Traces:
    """Looks for them.

    What a process is like when this is made is how it should stay: its working directory, environment, signals,
    threads, limits, numpy's and the processor's ways with numbers, and what our modules, and those that they compute
    with, consist of.  What a controller's own module keeps in its own variables is not looked for.
    """

    def __init__(self) -> None:
        self._settings = _settings()
        self._content = _content()

    def found(self) -> bool:
        """Whether anything is not as it was."""
        try:
            return _settings() != self._settings or any(
                now.get(name) is not value
                for owner, then in self._content
                for now in (vars(owner),)
                for name, value in then.items()
            )
        except Exception:  # of something that was put in the place of what this uses
            return True


def _content() -> list[tuple[ModuleType | type, dict[str, Any]]]:
    """Our modules and the classes in them, and the others, each with what it consists of."""
    ours = [module for name, module in sys.modules.items() if name.partition(".")[0] in _PACKAGES]
    classes = {
        each
        for module in ours
        for each in vars(module).values()
        if isinstance(each, type) and each.__module__.partition(".")[0] in _PACKAGES
    }
    others = [sys.modules[name] for name in _MODULES if name in sys.modules]
    owners: list[ModuleType | type] = [*ours, *classes, *others]
    return [(owner, dict(vars(owner))) for owner in owners]


def _settings() -> _Settings:
    """What belongs to the whole process, or to the thread that flies."""
    return (
        _folder(),
        dict(os.environ),
        list(sys.path),
        sys.getrecursionlimit(),
        locale.setlocale(locale.LC_ALL),
        np.geterr(),
        np.geterrcall(),
        _rounding(),
        gc.isenabled(),
        gc.get_threshold(),
        [each for each in warnings.filters if each[0] == "error"],
        [signal.getsignal(number) for number in signal.valid_signals()],
        signal.pthread_sigmask(signal.SIG_BLOCK, ()),
        [any(signal.getitimer(which)) for which in _TIMERS],
        [resource.getrlimit(which) for which in _LIMITS],
        threading.active_count(),
    )


def _folder() -> str:
    try:
        return str(Path.cwd())
    except OSError:  # it is no longer there
        return ""


def _rounding() -> tuple[float, ...]:
    """What a library may change in the processor: how it rounds, and whether it knows the smallest numbers."""
    return _ONE / _THREE, -_ONE / _THREE, _SMALLEST * _ONE
