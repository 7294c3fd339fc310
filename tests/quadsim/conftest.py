"""Runs made from the short flight, for what is drawn and written from runs."""

import dataclasses

import pytest

from quadsim.flight.log import ControlLog, TimingLog
from quadsim.flight.rundir import Run


@pytest.fixture(scope="session")
def aborted_run(short_run: Run) -> Run:
    """The short flight as if it had been lost at its end, under another name."""
    reason = "at t = 6.000 s: the plant's state is <not> finite & more"
    summary = {**short_run.summary, "scenario": "lost", "status": "aborted", "reason": reason}
    return dataclasses.replace(short_run, summary=summary, log=dataclasses.replace(short_run.log, reason=reason))


@pytest.fixture(scope="session")
def empty_run(short_run: Run) -> Run:
    """A flight that ended before its first period was over: no numbers, no constraints reached."""

    def head(log: ControlLog | TimingLog, *whole: str) -> dict[str, object]:
        columns = {field.name: getattr(log, field.name) for field in dataclasses.fields(log) if field.name not in whole}
        return {name: column[:0] for name, column in columns.items() if column is not None}

    log = dataclasses.replace(
        short_run.log,
        control=dataclasses.replace(short_run.log.control, **head(short_run.log.control, "speeds_before")),
        timing=dataclasses.replace(short_run.log.timing, **head(short_run.log.timing)),
        plant=short_run.log.plant.every(short_run.log.plant.t.size),
        predicted=None,
        reason="at t = 0.000 s: the command is not finite",
    )
    unreached = {"peak_sampled": None, "peak_plant": None, "worst_margin_sampled": None, "worst_margin": None}
    summary = {
        **short_run.summary,
        "scenario": "ended-at-once",
        "status": "aborted",
        "reason": log.reason,
        "duration": 0.0,
        "tracking": {},
        "control": {},
        "controller": {"name": "constrained", "solver": "piqp-multistage", "horizon": 50},
        "constraints": [
            {**entry, **unreached, "worst_time": None, "time_violated": 0.0, "satisfied": False}
            for entry in short_run.summary["constraints"]
        ],
    }
    return dataclasses.replace(short_run, summary=summary, log=log)
