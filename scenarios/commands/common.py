"""What several commands do: read a scenario with its settings, print a summary."""

from __future__ import annotations

import contextlib
import json
from argparse import Namespace
from pathlib import Path
from typing import Any

from scenarios.api import load as load_scenario
from scenarios.commands import console
from scenarios.schema.scenario import Scenario


def load(name: str, options: Namespace) -> Scenario:
    """The scenario of that name, with the settings and the seed of the command line.

    Raises:
        InputError: it cannot be flown.
    """
    settings = [*options.settings] if options.seed is None else [*options.settings, f"seed={options.seed}"]
    return load_scenario(name, settings)


def print_summary(summary: dict[str, Any], options: Namespace, where: str | None = None) -> None:
    """A flight's summary, for a person or as JSON."""
    if options.json:
        print(json.dumps(summary, indent=2))
    else:
        console.print_summary(summary, where)


def shown(path: Path) -> str:
    """A path for a person: relative to the current directory where it is in there."""
    with contextlib.suppress(ValueError, OSError):  # it is not in there; the current directory is gone
        return str(path.relative_to(Path.cwd()))
    return str(path)
