"""Flights that ended early, for what is drawn and written from runs."""

import dataclasses

import pytest

from quadsim.flight.rundir import Run, load_run
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.loading import load_scenario


@pytest.fixture(scope="session")
def aborted_run(short_run: Run) -> Run:
    """The short flight as if it had been lost at its end, under another name."""
    reason = "at t = 6.000 s: the plant's state is <not> finite & more"
    summary = {**short_run.summary, "scenario": "lost", "status": "aborted", "verdict": "lost", "reason": reason}
    return dataclasses.replace(short_run, summary=summary, log=dataclasses.replace(short_run.log, reason=reason))


@pytest.fixture(scope="session")
def empty_run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A flight that ended before its first period was over: no numbers, no constraints reached."""
    directory = tmp_path_factory.mktemp("empty") / "run"
    flight = Rollout(load_scenario("paper-constrained", ["initial.euler=[60, 0, 0]"])).fly()
    flight.save(directory, video=False, recording=False, figures=False)
    return load_run(directory)
