"""Every installed QP solver on the periods of one flight: time of the whole controller step, failures, differences.

A flight is recorded by the controller as its scenario has it.  Its measured states, references and commands before are
then given to that controller again, to one that solves the whole QP by each solver in every period, and to the core's.
Between two answers the plant flies a period, which leaves in the caches what it leaves there in a flight.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from timing import Record, options, run, step_quantiles, time_in_turns

from mpc.constrained import ConstrainedMPC
from mpc.solvers import QPSolver, make_solver
from quadsim.controller import ACCEPTED, CORE, Command, Controller, Moment
from quadsim.errors import FlightError, InputError, MissingCoreError, MissingPackageError
from quadsim.flight.log import ControlLog
from quadsim.state import Array, make_state
from scenarios.app import load
from scenarios.build import build_controller, build_plant, build_problem
from scenarios.catalogue import read_catalogue
from scenarios.courses.make import build_reference
from scenarios.parts.vehicle import build_vehicle
from scenarios.run import fly_scenario
from scenarios.schema.controller import ConstrainedSpec
from scenarios.schema.scenario import Scenario

SEGMENT = 20
"""Consecutive periods that a solver answers before it is the next one's turn."""
FLOWN = "as flown"


class Replayed:
    """A controller that is given the queries of a flight, each after the command given before it in that flight."""

    def __init__(self, controller: Controller, log: ControlLog, reference: Array) -> None:
        self._controller, self._log, self._reference = controller, log, reference
        self._before = np.vstack([log.speeds_before, log.speeds[:-1]])
        self._period = -2
        self.commands: dict[int, Command | None] = {}  # by period; None where it gave none

    def prepare(self, period: int) -> None:
        """Look up a period's query; what is warm stays so, as in a flight, unless periods lie between."""
        before = self._before[period]
        if period != self._period + 1:
            self._controller.reset(before)
        self._period = period
        moment = Moment(time=float(self._log.t[period]), acting=before)
        reference = self._reference[period + 1 : period + 1 + self._controller.horizon]
        self._query = (moment, self._log.state[period], reference)

    def answer(self) -> None:
        """Answer it."""
        try:
            command = self._controller.step(*self._query)
        except FlightError:  # the solver failed, and there is no earlier plan to hold
            command = None
        self.commands.setdefault(self._period, command)


def controllers(scenario: Scenario) -> dict[str, Controller]:
    """The scenario's as it is, and by each solver that is there, without the unconstrained optimum tried first."""
    vehicle = build_vehicle(scenario)
    problem, found = build_problem(scenario, vehicle), {FLOWN: build_controller(scenario, vehicle)}
    for name in read_catalogue().solvers:
        with contextlib.suppress(MissingPackageError, MissingCoreError):
            solver = make_solver(name, problem) if name == CORE else QPSolver(name, problem)
            found[name] = ConstrainedMPC(problem, solver)
    return found


def measure(name: str, quick: bool) -> list[Record]:
    """A record of each solver, the controller as it is flown first."""
    scenario = load(name)
    if not isinstance(scenario.controller, ConstrainedSpec):
        raise InputError(f"{name} is flown without a QP; choose a scenario with a constrained controller")
    if quick:
        scenario = scenario.replace({"duration": 2.0, "controller.horizon": 10, "constraints": []})
    vehicle = build_vehicle(scenario)
    log = fly_scenario(scenario).log.control
    candidates: dict[str, Replayed] = {}
    for solver, controller in controllers(scenario).items():
        reference = build_reference(scenario, log.t.size + controller.horizon)
        candidates[solver] = Replayed(controller, log, reference)
    segments = [range(start, min(start + SEGMENT, log.t.size)) for start in range(0, log.t.size, SEGMENT)]
    hover = make_state(position=(0.0, 0.0, 10.0))
    with build_plant(scenario, vehicle) as plant:

        def fly_a_period() -> None:
            plant.reset(hover)
            plant.advance(plant.hover_speeds, scenario.steps_per_period)
            plant.state()

        times = time_in_turns(
            {solver: (each.prepare, each.answer) for solver, each in candidates.items()},
            segments[:1] if quick else segments,
            between=fly_a_period,
            repeats=1 if quick else 3,
            rng=np.random.default_rng(scenario.seed),
        )
    return [_record(solver, each, times[solver], log) for solver, each in candidates.items()]


def _record(solver: str, replayed: Replayed, ms: Array, log: ControlLog) -> Record:
    """Step times, and how far the accepted answers are from the commands flown, of which the optimum is unique."""
    answered = {k: command for k, command in replayed.commands.items() if command and command.status in ACCEPTED}
    differences = [float(np.abs(command.speeds - log.speeds[k]).max()) for k, command in answered.items()]
    return {
        "solver": solver,
        "periods": len(replayed.commands),
        "failures": len(replayed.commands) - len(answered),
        **step_quantiles(ms),
        "largest_difference_rad_s": max(differences, default=None),
    }


def draw(records: Sequence[Record], path: Path) -> None:
    """Draw median, 99th percentile and maximum of each solver's step."""
    import matplotlib.pyplot as plt

    ranked = sorted(records, key=lambda record: -record["p99_ms"])
    figure, axes = plt.subplots(figsize=(8.0, 1.2 + 0.35 * len(ranked)), layout="constrained")
    for key, marker in (("p50_ms", "|"), ("p99_ms", "D"), ("max_ms", ">")):
        axes.plot([record[key] for record in ranked], range(len(ranked)), marker, label=key.removesuffix("_ms"))
    axes.set_yticks(range(len(ranked)), [record["solver"] for record in ranked])
    axes.set(xscale="log", xlabel="controller step [ms]")
    axes.legend()
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main() -> None:
    """Measure, print and write."""
    chosen = options(__doc__, scenario={"default": "paper-constrained", "help": "default: %(default)s"})
    records = run(lambda: measure(chosen.scenario, chosen.quick), f"QP solvers on {chosen.scenario}", chosen.json)
    if chosen.json is not None:
        draw(records, chosen.json.with_suffix(".png"))


if __name__ == "__main__":
    main()
