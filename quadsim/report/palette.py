"""Colours of everything drawn from a flight on paper or on a page: distinct for colour-blind readers as well.

Runs and rotors take theirs in order from Okabe and Ito's palette (2008), its blue made lighter for dark pages, and
less its vermilion, which is too near the red of the bounds.
"""

from __future__ import annotations

from typing import Final

LINES: Final = ("#1b7fc4", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#8c6d31")
REFERENCE: Final = "#7a7f87"
BOUND: Final = "#dc2f38"
OBSTACLE: Final = "#b85c48"
COURSE_COLOUR: Final = LINES[3]  # of a curve through a cloud of points


def line_colour(i: int) -> str:
    """Colour of the i-th run, or rotor, counted from 0; they repeat after six."""
    return LINES[i % len(LINES)]
