"""What each command of `quadsim` does."""

from __future__ import annotations

import importlib
from argparse import Namespace
from collections.abc import Callable, Mapping
from typing import Final

EXIT_DONE, EXIT_FAILED, EXIT_WRONG_INPUT = 0, 1, 2

COMMANDS: Final[Mapping[str, str]] = {
    "list": "catalogue:list_everything",
    "run": "flights:run",
    "check": "flights:check",
    "compare": "flights:compare",
    "live": "live:live",
    "video": "flights:video",
    "view": "flights:view",
    "scenario": "catalogue:scenario",
    "vehicle": "vehicle_sheet:vehicle",
    "campaign": "campaigns:campaign",
    "replay": "campaigns:replay",
    "tune": "tunings:tune",
    "reproduce": "flights:reproduce",
    "export": "flights:export",
    "doctor": "catalogue:doctor",
}
"""Where each is, `module:function` in this package."""


def find_command(name: str) -> Callable[[Namespace], int]:
    """The function of a command, with no more imported than it takes: all commands together take half a second."""
    module, _, function = COMMANDS[name].partition(":")
    found: Callable[[Namespace], int] = getattr(importlib.import_module(f"{__name__}.{module}"), function)
    return found
