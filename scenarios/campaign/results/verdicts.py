"""The verdicts on a flight of a campaign: how each is ranked, worded and drawn.  A new one is a line here."""

from __future__ import annotations

from typing import Final, NamedTuple

from quadsim.report.palette import BOUND, LINES, REFERENCE
from scenarios.many import DIED, ERROR, MEMORY, TIMEOUT

HARMLESS: Final = "satisfied"


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
    "violated": Verdict(1, _VIOLATED, _VIOLATED, LINES[1], "D", "diamond"),
    "lost": Verdict(5, "were lost", "was lost", BOUND, "x", "x"),
    ERROR: Verdict(4, _RAISED, _RAISED, REFERENCE, "s", "square"),
    DIED: Verdict(4, "ended with their process", "ended with its process", LINES[3], "P", "cross"),
    TIMEOUT: Verdict(
        3, "were ended since they took too long", "was ended since it took too long", LINES[4], "^", "triangle-up"
    ),
    MEMORY: Verdict(
        *(2, "were ended since they took too much memory", "was ended since it took too much memory"),
        *(LINES[5], "v", "triangle-down"),
    ),
}
"""In the order in which they are drawn and counted."""

VERDICT_EVENTS: Final = tuple(name for name in VERDICTS if name not in (HARMLESS, "violated"))
"""Verdicts that are events of their own name; `violation` is every verdict but `satisfied`."""
