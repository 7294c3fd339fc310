"""Which events are in force, and from when."""

from __future__ import annotations

import pytest

from quadsim.sim.effects import Push, PushChange, push_changes
from quadsim.sim.effects.lasting import in_force
from quadsim.sim.effects.rotors import RotorLoss, efficiency_changes


def push(at: float, duration: float) -> Push:
    """A push along x, as strong as it is late."""
    return Push(at=at, duration=duration, force=(at, 0.0, 0.0))


def test_events_that_overlap_are_in_force_together_in_the_order_in_which_they_stand() -> None:
    late = push(2.0, 2.0)
    early = push(1.0, 2.0)
    assert [*in_force([late, early])] == [(1.0, [early]), (2.0, [late, early]), (3.0, [late]), (4.0, [])]


def test_one_that_starts_where_another_ends_takes_over_at_that_instant() -> None:
    first = push(1.0, 1.0)
    second = push(2.0, 1.0)
    assert [*push_changes([first, second])] == [
        PushChange(at=1.0, pushes=(first,)),
        PushChange(at=2.0, pushes=(second,)),
        PushChange(at=3.0, pushes=()),
    ]


def test_losses_of_a_worn_rotor_multiply_and_those_without_an_end_stay() -> None:
    losses = [
        RotorLoss(at=1.0, rotor=2, loss=0.5),
        RotorLoss(at=2.0, rotor=2, loss=0.2, duration=1.0),
        RotorLoss(at=1.5, rotor=4, loss=1.0),
    ]
    changes = [*efficiency_changes(losses, (1.0, 0.9, 1.0, 1.0))]
    assert [(change.at, change.rotor) for change in changes] == [(1.0, 2), (2.0, 2), (3.0, 2), (1.5, 4)]
    assert [change.efficiency for change in changes] == pytest.approx([0.45, 0.36, 0.45, 0.0])


def test_without_events_nothing_changes() -> None:
    assert [*in_force([])] == []
    assert [*efficiency_changes([], (1.0, 1.0, 1.0, 1.0))] == []
