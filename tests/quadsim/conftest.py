"""Runs made from the short flight, for what is drawn and written from runs."""

import dataclasses

import numpy as np
import pytest

from quadsim.flight.log import ControlLog, TimingLog
from quadsim.flight.rundir import Run
from scenarios.cost.study import MEASURES, Contender, CostStudy, Outcome, Sweep, SweepPoint, Variation


@pytest.fixture(scope="session")
def aborted_run(short_run: Run) -> Run:
    """The short flight as if it had been lost at its end, under another name."""
    reason = "at t = 6.000 s: the plant's state is <not> finite & more"
    summary = {**short_run.summary, "scenario": "lost", "status": "aborted", "reason": reason}
    return dataclasses.replace(short_run, summary=summary, log=dataclasses.replace(short_run.log, reason=reason))


@pytest.fixture(scope="session")
def empty_run(short_run: Run) -> Run:
    """A flight that ended before its first period was over: no numbers, no constraints reached."""

    def head(log: ControlLog | TimingLog, *kept: str) -> dict[str, object]:
        return {field.name: getattr(log, field.name)[:0] for field in dataclasses.fields(log) if field.name not in kept}

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


def make_outcome(scale: float = 1.0, *, reason: str | None = None, settled: float | None = 4.0) -> Outcome:
    """A flight of ten periods whose measures are `scale` times 1, 2, 3 and so on."""
    return Outcome(
        reason=reason,
        flown=0.5,
        statuses={"infeasible": 1, "solved": 3, "unconstrained": 6},
        fallbacks=1,
        active=3,
        numbers={key: scale * (i + 1.0) for i, key in enumerate(MEASURES)},
        settling=[
            {"channel": "x", "time": 0.0, "before": 0.0, "after": 1.0, "settled": settled},
            {"channel": "x", "time": 10.0, "before": 1.0, "after": 0.0, "settled": 3.0},
        ],
    )


@pytest.fixture
def cost_study() -> CostStudy:
    """A made-up study in which everything that can happen does: flights lost, plans held, steps that never settle."""
    step_ms = np.linspace(1.0, 10.0, 10)
    shortcut = ("unconstrained",) * 6 + ("solved",) * 3 + ("infeasible",)
    lost = make_outcome(9.0, reason="the plant diverged", settled=None)
    times = {"p50": 0.5, "p95": 0.8, "p99": 0.9, "max": 1.0}
    return CostStudy(
        name="bounded",
        horizon=20,
        deadline_ms=50.0,
        duration=0.5,
        constrained=make_outcome(2.0),
        unconstrained=make_outcome(4.0, settled=8.0),
        others={"free": make_outcome(3.0)},
        reference=[{"settled": 5.0}, {"settled": None}],
        contenders=(
            Contender(name="gain", step_ms=0.01 * step_ms, statuses=("solved",) * 10, repeats=3),
            Contender(name="as flown", step_ms=step_ms, statuses=shortcut, repeats=3),
            Contender(name="QP by slow", step_ms=8.0 * step_ms, statuses=("solved",) * 10, repeats=1),
        ),
        left_out={"absent": "pip install it"},
        tilt=Sweep(
            name="tilt bound",
            unit="deg",
            base=5.0,
            points=(
                SweepPoint(value=2.0, constrained=make_outcome(3.0, settled=None), step_ms=times),
                SweepPoint(value=5.0, constrained=make_outcome(2.0), step_ms=times),
                SweepPoint(value=10.0, constrained=lost, step_ms={}),
            ),
        ),
        horizons=Sweep(
            name="horizon",
            unit="periods",
            base=20,
            points=(
                SweepPoint(value=10, constrained=make_outcome(3.0), step_ms=times, unconstrained=lost),
                SweepPoint(value=20, constrained=make_outcome(2.0), step_ms=times, unconstrained=make_outcome(4.0)),
            ),
        ),
        variations=(
            Variation(arm_length=0.2, drag_to_thrust=0.012, outcome=make_outcome(2.0)),
            Variation(arm_length=0.5, drag_to_thrust=0.024, outcome=make_outcome(2.5)),
            Variation(arm_length=0.5, drag_to_thrust=0.048, outcome=lost),
        ),
        machine={"processor": "abacus", "cores": 2},
    )
