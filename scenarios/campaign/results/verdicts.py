"""The verdicts on a flight of a campaign: how each is ranked, worded and drawn.  A new one is a line here."""

from __future__ import annotations

from typing import Final, NamedTuple

from quadsim.report.palette import BOUND, LINES, REFERENCE
from scenarios.many import DIED, ERROR, MEMORY, TIMEOUT

HARMLESS: Final = "satisfied"
INCOMPLETE: Final = "incomplete"  # of a flight that ended before it reached a required constraint: neither good nor bad


class Verdict(NamedTuple):
    """What is to be known of a verdict."""

    badness: int  # its place among the worst flights: the larger, the worse
    phrase: str  # what such flights did, after their number
    phrase_of_one: str  # what one such flight did
    colour: str  # of its flights
    marker: str  # of its flights, in matplotlib's letters
    symbol: str  # of its flights, in plotly's words


_HELD, _VIOLATED, _RAISED = "held every required constraint", "violated a required constraint", "raised an error"

VERDICTS: Final = {
    HARMLESS: Verdict(0, _HELD, _HELD, LINES[0], "o", "circle"),
    INCOMPLETE: Verdict(
        1,
        "ended before a required constraint was reached",
        "ended before a required constraint was reached",
        LINES[2],
        "P",
        "cross",
    ),
    "violated": Verdict(2, _VIOLATED, _VIOLATED, LINES[1], "D", "diamond"),
    "lost": Verdict(6, "were lost", "was lost", BOUND, "x", "x"),
    ERROR: Verdict(5, _RAISED, _RAISED, REFERENCE, "s", "square"),
    DIED: Verdict(5, "ended with their process", "ended with its process", LINES[3], "p", "pentagon"),
    TIMEOUT: Verdict(
        4, "were ended since they took too long", "was ended since it took too long", LINES[4], "^", "triangle-up"
    ),
    MEMORY: Verdict(
        *(3, "were ended since they took too much memory", "was ended since it took too much memory"),
        *(LINES[5], "v", "triangle-down"),
    ),
}
"""In the order in which they are drawn and counted."""

VERDICT_EVENTS: Final = tuple(name for name in VERDICTS if name not in (HARMLESS, "violated"))
"""Verdicts that are events of their own name; `violation` is every verdict but `satisfied` and `incomplete`."""
