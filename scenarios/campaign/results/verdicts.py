"""The verdicts on a flight of a campaign: how each is ranked, worded and drawn.  A new one is a line here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from quadsim.report.palette import BOUND, LINES, REFERENCE

ERROR: Final = "error"  # status and verdict of a flight that raised, or whose process died
TIMEOUT: Final = "timeout"  # those of a flight that was ended since it, or a step of its controller, took too long
MEMORY: Final = "memory"  # those of a flight that asked for too much memory
HARMLESS: Final = "satisfied"


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What is to be known of a verdict.

    Attributes:
        badness: its place among the worst flights: the larger, the worse.
        phrase: what such flights did, after their number.
        told_of_one: what one such flight did.
        colour: of its flights.
        marker: of its flights, in matplotlib's letters.
        symbol: of its flights, in plotly's words.
    """

    badness: int
    phrase: str
    phrase_of_one: str
    colour: str
    marker: str
    symbol: str


VERDICTS: Final = {
    "satisfied": Verdict(
        badness=0,
        phrase="held every required constraint",
        phrase_of_one="held every required constraint",
        colour=LINES[0],
        marker="o",
        symbol="circle",
    ),
    "violated": Verdict(
        badness=1,
        phrase="violated a required constraint",
        phrase_of_one="violated a required constraint",
        colour=LINES[1],
        marker="D",
        symbol="diamond",
    ),
    "lost": Verdict(badness=5, phrase="were lost", phrase_of_one="was lost", colour=BOUND, marker="x", symbol="x"),
    ERROR: Verdict(
        badness=4,
        phrase="raised an error",
        phrase_of_one="raised an error",
        colour=REFERENCE,
        marker="s",
        symbol="square",
    ),
    TIMEOUT: Verdict(
        badness=3,
        phrase="were ended since they took too long",
        phrase_of_one="was ended since it took too long",
        colour=LINES[4],
        marker="^",
        symbol="triangle-up",
    ),
    MEMORY: Verdict(
        badness=2,
        phrase="were ended since they took too much memory",
        phrase_of_one="was ended since it took too much memory",
        colour=LINES[5],
        marker="v",
        symbol="triangle-down",
    ),
}
"""In the order in which they are drawn and counted."""


OWN_EVENTS: Final = tuple(name for name in VERDICTS if name not in (HARMLESS, "violated"))
"""Verdicts that are events of their own name; `violation` is every verdict but `satisfied`."""
