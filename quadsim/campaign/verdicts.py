"""What a flight's verdict may be: how it ended, what is said of it, how bad it is, and how it is drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from quadsim.campaign.table import ERROR, MEMORY, TIMEOUT
from quadsim.palette import BOUND, LINES, REFERENCE


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """One of them.

    Attributes:
        name: as tables have it.
        one: said of one flight.
        many: said of several.
        rank: the worst one has the smallest.
        colour: in which it is drawn.
        symbol: plotly's.
        marker: matplotlib's.
    """

    name: str
    one: str
    many: str
    rank: int
    colour: str
    symbol: str
    marker: str


_ALL: Final = (
    Verdict(
        name="satisfied",
        one="held every required constraint",
        many="held every required constraint",
        rank=5,
        colour=LINES[0],
        symbol="circle",
        marker="o",
    ),
    Verdict(
        name="violated",
        one="violated a required constraint",
        many="violated a required constraint",
        rank=4,
        colour=LINES[1],
        symbol="diamond",
        marker="D",
    ),
    Verdict(name="lost", one="was lost", many="were lost", rank=0, colour=BOUND, symbol="x", marker="x"),
    Verdict(
        name=ERROR,
        one="raised an error",
        many="raised an error",
        rank=1,
        colour=REFERENCE,
        symbol="square",
        marker="s",
    ),
    Verdict(
        name=TIMEOUT,
        one="was ended since it took too long",
        many="were ended since they took too long",
        rank=2,
        colour=LINES[3],
        symbol="triangle-up",
        marker="^",
    ),
    Verdict(
        name=MEMORY,
        one="was ended since it took too much memory",
        many="were ended since they took too much memory",
        rank=3,
        colour=LINES[5],
        symbol="triangle-down",
        marker="v",
    ),
)
VERDICTS: Final = {verdict.name: verdict for verdict in _ALL}
"""By their names, in the order of tables and legends."""
GOOD: Final = "satisfied"
