"""What each command of `quadsim` does; its module is loaded when it runs, so that `quadsim --help` answers at once."""

from __future__ import annotations

from argparse import Namespace
from importlib import import_module
from typing import Final

EXIT_DONE, EXIT_FAILED, EXIT_WRONG_INPUT = 0, 1, 2

COMMANDS: Final = {
    "list": "catalogue:list_everything",
    "run": "flights:run",
    "check": "flights:check",
    "compare": "compare:compare",
    "video": "products:video",
    "view": "products:view",
    "scenario": "catalogue:scenario",
    "vehicle": "catalogue:vehicle",
    "campaign": "campaigns:campaign",
    "replay": "campaigns:replay",
    "bench": "bench:bench",
    "doctor": "catalogue:doctor",
}
"""Module and function of each command; a function takes the parsed line and returns the exit status."""


def carry_out(options: Namespace) -> int:
    """Run the command of a parsed line; returns the exit status."""
    module, _, function = COMMANDS[options.command].partition(":")
    status: int = getattr(import_module(f"{__name__}.{module}"), function)(options)
    return status
