"""What the panel says of a constraint: the truth, in a row that does not move."""

from __future__ import annotations

import re

import numpy as np
import pytest

from quadsim.flight.audit import Limit
from scenarios.live.readout import constraint_rows, hints, is_violated
from scenarios.live.session import Frame

ROLL = Limit(name="roll", signal="roll", lower=-5.0, upper=5.0, tolerance=0.05)
LATE = Limit(name="arrival_x", signal="x_error", lower=-0.1, upper=0.1, start=29.0)


def frame(*margins: float, name: str = "roll") -> Frame:
    """A period in which each vehicle has this margin."""
    samples = (None,) * len(margins)
    return Frame(
        k=0,
        time=1.0,
        samples=samples,
        margins=tuple({name: margin} for margin in margins),
        horizons=samples,
        pull=np.zeros(3),
        refused=(),
    )


@pytest.mark.parametrize(
    ("margin", "says"),
    [
        (4.0, "+4.00 deg</td><td></td>"),
        (0.3, "+0.30 deg</td><td>near</td>"),
        (-0.04, "-0.04 deg</td><td>near</td>"),
        (-0.06, "-0.06 deg</td><td>violated</td>"),
        (-1.3e-10, "+0.00 deg</td><td>near</td>"),
    ],
)
def test_a_row_says_of_a_margin_what_the_audit_would(margin: float, says: str) -> None:
    row = constraint_rows((ROLL,), {"roll"}, frame(margin))
    assert says in row


def test_rounding_is_no_violation_and_more_is() -> None:
    exact = Limit(name="roll", signal="roll", lower=-5.0, upper=5.0)
    assert not is_violated(exact, -1.3e-10)
    assert is_violated(exact, -1e-6)


def test_two_vehicles_share_a_row_and_a_constraint_keeps_its_row_when_it_ends() -> None:
    both = constraint_rows((ROLL, LATE), {"roll"}, frame(4.0, 1.0))
    assert both.count("<tr") == 3  # with the head
    assert both.count("<i style") == 4  # a mark per vehicle, and the two bounds
    assert "ended" in both
    assert "from 29 s" in constraint_rows((ROLL, LATE), {"roll", "arrival_x"}, frame(4.0))


def test_bars_grow_towards_the_bound() -> None:
    rows = [constraint_rows((ROLL,), {"roll"}, frame(margin)) for margin in (5.0, 3.0, 0.0, -2.0)]
    widths = [float(re.findall(r"left:0;width:([\d.]+)%", row)[0]) for row in rows]
    assert widths == sorted(widths)
    assert widths[0] == 0.0


def test_hints_that_were_followed_go() -> None:
    assert hints(()).count("<div>") == 3
    assert "Drag the drone" not in hints({"pull"})
