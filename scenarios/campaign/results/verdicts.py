"""The verdicts on a flight of a campaign: how each is ranked and drawn.  A new one is a line here."""

from __future__ import annotations

from typing import Final, NamedTuple

from quadsim.report.curves import BOUND, LINES, REFERENCE
from scenarios.many import DIED, ERROR, MEMORY, TIMEOUT

HARMLESS: Final = "satisfied"
INCOMPLETE: Final = "incomplete"  # of a flight that ended before it reached a required constraint: neither good nor bad


class Verdict(NamedTuple):
    """What is to be known of a verdict."""

    badness: int  # its place among the worst flights: the larger, the worse
    colour: str  # of its flights
    symbol: str  # of its flights


VERDICTS: Final = {
    HARMLESS: Verdict(0, LINES[0], "circle"),
    INCOMPLETE: Verdict(1, LINES[2], "cross"),
    "violated": Verdict(2, LINES[1], "diamond"),
    "lost": Verdict(6, BOUND, "x"),
    ERROR: Verdict(5, REFERENCE, "square"),
    DIED: Verdict(5, LINES[3], "pentagon"),
    TIMEOUT: Verdict(4, LINES[4], "triangle-up"),
    MEMORY: Verdict(3, LINES[5], "triangle-down"),
}
"""In the order in which they are drawn and counted."""

VERDICT_EVENTS: Final = tuple(name for name in VERDICTS if name not in (HARMLESS, "violated"))
"""Verdicts that are events of their own name; `violation` is every verdict but `satisfied` and `incomplete`."""
