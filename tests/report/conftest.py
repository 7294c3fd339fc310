"""Flights that ended early, for what is drawn and written from runs."""

import dataclasses

import pytest
from support import renamed

from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout
from quadsim.rollout.stored import read_flight
from quadsim.scenarios.loading import load_scenario


@pytest.fixture(scope="session")
def aborted_run(short_run: Flight) -> Flight:
    """The short flight as if it had been lost at its end, under another name."""
    reason = "at t = 6.000 s: the plant's state is <not> finite & more"
    log = dataclasses.replace(short_run.log, reason=reason)
    return renamed(dataclasses.replace(short_run, log=log), "lost")


@pytest.fixture(scope="session")
def empty_run(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """A flight that ended before its first period was over: no numbers, no constraints reached."""
    directory = tmp_path_factory.mktemp("empty") / "run"
    flight = Rollout(load_scenario("paper-constrained", ["initial.euler=[60, 0, 0]"])).fly()
    flight.save(directory, video=False, recording=False, figures=False)
    return read_flight(directory)
