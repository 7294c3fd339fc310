"""The features: folders beside the core, which names none of them but here.

A feature has its commands in its `commands.py`, imported when one is called, its tests in a folder of its name, and its
pages.  `make without-features` takes each away, with its entry here, and sees the rest pass.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from quadsim.errors import InputError


@dataclass(frozen=True, kw_only=True)
class FeatureCommand:
    """A command of a feature, as the help of `quadsim` lists it before the feature is imported."""

    function: str  # of the feature's `commands`
    help: str  # the first line of its docstring
    examples: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Feature:
    """What the core knows of a feature."""

    commands: Mapping[str, FeatureCommand] = field(default_factory=dict)  # by the word on the command line
    owns_directories: bool = False
    """Whether its `commands` have `owns(directory)`, `check_advice(directory)` and `compare_directories(...)`."""


FEATURES: Final[dict[str, Feature]] = {
    "live": Feature(
        commands={
            "live": FeatureCommand(
                function="live",
                help="Fly interactively in the browser: push, change every setting, save the flight as a scenario.",
                examples=("quadsim live", "quadsim live robust --against paper-constrained"),
            )
        }
    ),
    "campaign": Feature(
        commands={
            "campaign": FeatureCommand(
                function="campaign",
                help="Fly a scenario many times with randomly drawn parameters.",
                examples=(
                    "quadsim campaign paper-robustness --flights 100",
                    "quadsim campaign mine.toml --resume --require 'P(violation) < 0.01 @ 95%'",
                ),
            ),
            "replay": FeatureCommand(
                function="replay",
                help="Fly one flight of a finished campaign again, with all outputs.",
                examples=(
                    "quadsim replay runs/campaigns/paper-robustness --worst",
                    "quadsim replay runs/campaigns/paper-robustness --flight 12 --no-video",
                ),
            ),
        },
        owns_directories=True,
    ),
    "papers": Feature(
        commands={
            "reproduce": FeatureCommand(
                function="reproduce",
                help="Reproduce papers' numbers: theirs, ours, difference; exit 1 if one is off.",
                examples=("quadsim reproduce", "quadsim reproduce torrente2021 --junit numbers.xml"),
            )
        }
    ),
    "export": Feature(
        commands={
            "export": FeatureCommand(
                function="export",
                help="Export a scenario's controller as self-contained C99, with recorded periods to test it.",
                examples=(
                    "quadsim export paper-constrained --out exported",
                    "quadsim export paper-constrained --out small --precision float --target cortex-m7",
                ),
            )
        }
    ),
    "identify": Feature(
        commands={
            "identify": FeatureCommand(
                function="identify",
                help="Identify a vehicle from flight logs: its file, with an interval for every number.",
                examples=(
                    "quadsim identify eight.csv --vehicle start.toml --out mine.toml --page mine.html",
                    "quadsim identify eight.csv climb.csv --vehicle start.toml --test square.csv --poles 14",
                ),
            )
        }
    ),
    "design": Feature(
        commands={
            "scenario": FeatureCommand(
                function="scenario",
                help="Print a scenario with all defaults and comments, as a start for your own.",
                examples=(
                    "quadsim scenario hover > mine.toml",
                    "quadsim scenario --for hummingbird --course figure-eight --fastest > mine.toml",
                ),
            ),
            "vehicle": FeatureCommand(
                function="vehicle_report",
                help="Report a vehicle's limits and designed gains, and the sources of its parameters; draw it.",
                examples=(
                    "quadsim vehicle hummingbird --scenario paper-constrained",
                    "quadsim vehicle --template > mine.toml",
                ),
            ),
        }
    ),
    "stability": Feature(
        commands={
            "stability": FeatureCommand(
                function="stability",
                help="Measure the margins of a closed loop: how fast it settles, and what makes it unstable.",
                examples=(
                    "quadsim stability paper-constrained",
                    "quadsim stability first.toml --over delay lag --controller lqr nonlinear --out margins",
                ),
            )
        }
    ),
    "gym": Feature(),
}


def commands_of(feature: str) -> Any:
    """Import the commands of a feature.

    Raises:
        InputError: there is no such feature.
    """
    if feature not in FEATURES:
        raise InputError(f"this quadsim has been installed without its feature {feature!r}")
    return importlib.import_module(f"quadsim.features.{feature}.commands")


def owner_of(directory: Path) -> Any:
    """Import the commands of the feature that made a directory; None for a run, or for what no feature made."""
    for name, feature in FEATURES.items():
        if feature.owns_directories:
            commands = commands_of(name)
            if commands.owns(directory):
                return commands
    return None
