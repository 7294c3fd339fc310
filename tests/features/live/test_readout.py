"""What the panel says of a constraint: the truth, in a row that does not move."""

from __future__ import annotations

import re

import numpy as np
import pytest

from quadsim.features.live.readout import Constraints, hints, readings
from quadsim.features.live.session import Frame, Session
from quadsim.flight.audit import Limit
from quadsim.palette import COLOUR
from quadsim.scenarios.loading import load_scenario

ROLL = Limit(name="roll", signal="roll", lower=-5.0, upper=5.0, tolerance=0.05)
LATE = Limit(name="arrival_x", signal="x_error", lower=-0.1, upper=0.1, start=29.0)


def frame(*margins: float, health: tuple[float, ...] = (1.0,) * 4) -> Frame:
    """A period in which each vehicle has this margin in roll."""
    nothing = (None,) * len(margins)
    roll = tuple({"roll": margin} for margin in margins)
    return Frame(0, 1.0, nothing, roll, nothing, np.zeros(3), np.array(health), ())


def rows(*frames: Frame, limits: tuple[Limit, ...] = (ROLL,), audited: frozenset[str] = frozenset({"roll"})) -> str:
    """The table after these periods."""
    table = Constraints(limits)
    for each in frames:
        table.add(each)
    return table.rows(frames[-1], audited)


def numbers_of(table: str) -> list[str]:
    """Its numbers, in order; a violation as `violated: NUMBER`."""
    cells = re.findall('<td class="n">(.*?)</td>', table)
    return [re.sub('<span class="bad" title="violated">(.*?)</span>', r"violated: \1", cell) for cell in cells]


@pytest.mark.parametrize(
    ("margin", "number"),
    [
        (4.0, "+4.00"),
        (-0.04, "-0.04"),
        (-0.06, "violated: -0.06"),
        (-1.3e-10, "+0.00"),
    ],
)
def test_a_row_says_of_a_margin_what_the_audit_would(margin: float, number: str) -> None:
    assert numbers_of(rows(frame(margin))) == [number, number]


def test_the_worst_margin_stays() -> None:
    assert numbers_of(rows(frame(4.0), frame(-0.5), frame(3.0))) == ["+3.00", "violated: -0.50"]


def test_two_vehicles_share_a_row_and_a_constraint_keeps_its_row_when_it_ends() -> None:
    both = rows(frame(4.0, 1.0), limits=(ROLL, LATE))
    assert both.count("<tr") == 3  # with the head
    assert both.count("<i style") == 4  # a mark per vehicle, and the two bounds
    assert numbers_of(both) == ["+4.00", "+1.00", "ended", ""]
    assert "from 29 s" in rows(frame(4.0), limits=(ROLL, LATE), audited=frozenset({"roll", "arrival_x"}))


def test_bars_grow_towards_the_bound() -> None:
    tables = [rows(frame(margin)) for margin in (5.0, 3.0, 0.0, -2.0)]
    widths = [float(re.findall(r"left:0;width:([\d.]+)%", table)[0]) for table in tables]
    assert widths == sorted(widths)
    assert widths[0] == 0.0


def test_hints_that_were_followed_go() -> None:
    assert hints((), ["robust MPC"]).count("<b>") == 3
    assert "Drag the drone" not in hints({"pull"}, ["robust MPC"])
    assert re.findall('color:(#[0-9a-f]{6})">●</span> ([AB])', hints((), ["A", "B"])) == [
        (COLOUR.flown, "A"),
        (COLOUR.second, "B"),
    ]


def test_numbers_keep_their_height_and_name_a_broken_rotor() -> None:
    session = Session(load_scenario("hover", ["controller.horizon=5"]))
    sound = session.advance()
    session.submit({"type": "wear", "rotor": 2, "loss": 0.4})
    broken = session.advance()
    session.close()
    assert readings(None).count('class="line"') == readings(sound, [(0.0, 0.0)]).count('class="line"')
    assert "rotor 2: -40 %" in readings(broken, [(0.0, 0.0)])
    assert "rotor" not in readings(sound, [(0.0, 0.0)])
