"""Processes of a campaign killed at random instants; a hundred of them are `make kills`."""

from __future__ import annotations

from pathlib import Path

import sleepy_controller
from campaign_kills import CHANCES, kill_and_resume

SEED = 22
"""The first three kills are of a worker, of the server and of the campaign; the others are of workers."""

SLEEPY = f', controller = {{ type = "sleepy_controller:Sleepy", folder = "{Path(sleepy_controller.__file__).parent}" }}'


def test_kills_lose_nothing_and_change_nothing(tmp_path: Path) -> None:
    for flights in (40, 160, 640):  # where few are over before the first three kills, more
        directory = tmp_path / str(flights)
        directory.mkdir()
        outcome = kill_and_resume(
            directory, kills=6, flights=flights, duration=0.5, pause=0.3, seed=SEED, settings=SLEEPY
        )
        assert (outcome.lost, outcome.doubled, outcome.same) == (0, 0, True)
        if outcome.kills.total() >= 3:
            break
    assert set(outcome.kills) == set(CHANCES)
