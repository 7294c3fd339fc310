"""Every installed QP solver on the periods of a flight: set-up, time of the controller step, failures, differences.

A flight is recorded by the controller as its scenario has it.  Its measured states, references and commands before are
then given to the same controller with each solver.  All answer from the gain where the unconstrained optimum is
feasible.  Between two answers the plant flies a period, which leaves in the caches what it leaves there in a flight.
"""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from timing import Record, options, run, step_quantiles, time_in_turns

from quadsim.commands.app import load
from quadsim.console.progress import Progress
from quadsim.controller import ACCEPTED, Command, Controller, StepInputs
from quadsim.errors import FlightError, InputError, MissingPackageError
from quadsim.flight.log import ControlLog
from quadsim.mpc.laws.constrained import Constrained
from quadsim.mpc.laws.robust import Robust
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.catalogue import read_catalogue
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import Array, make_state

SEGMENT = 20
"""Consecutive periods that a solver answers before it is the next one's turn."""
Answers = dict[int, Command | None]
"""Commands by period; None where there was none."""


class Replayed:
    """A controller that is given the queries of a flight, each after the command given before it in that flight."""

    def __init__(self, controller: Controller, log: ControlLog, reference: Array) -> None:
        self._controller, self._log, self._reference = controller, log, reference
        self._before = np.vstack([log.speeds_before, log.speeds[:-1]])
        self._period = -2
        self.commands: Answers = {}

    def prepare(self, period: int) -> None:
        """Look up a period's query; what is warm stays so, as in a flight, unless periods lie between."""
        before = self._before[period]
        if period != self._period + 1:
            self._controller.reset(before)
        self._period = period
        moment = StepInputs(time=float(self._log.t[period]), acting=before)
        reference = self._reference[period + 1 : period + 1 + self._controller.horizon]
        self._query = (moment, self._log.state[period], reference)

    def answer(self) -> None:
        """Answer it."""
        try:
            command = self._controller.step(*self._query)
        except FlightError:  # the solver failed, and there is no earlier plan to hold
            command = None
        self.commands.setdefault(self._period, command)


def entries(scenario: Scenario, solvers: Sequence[str]) -> dict[str, Scenario]:
    """The scenario with each solver that is installed."""
    usable = {}
    for name in solvers:
        changed = scenario.replace({"controller.solver": name})
        try:
            Assembly(changed).controller()
        except MissingPackageError:
            continue
        usable[name] = changed
    return usable


def measure(name: str, solvers: Sequence[str], quick: bool, report: Progress) -> list[Record]:
    """A record of each solver on a scenario."""
    scenario = load(name)
    if not isinstance(scenario.controller, Constrained | Robust):
        raise InputError(f"{name} is flown by no MPC of fixed matrices; choose a constrained or a robust one")
    if quick:
        scenario = scenario.replace({"duration": 2.0, "controller.horizon": 10, "constraints": []})
    flight = Rollout(scenario).fly(report)
    log = flight.log.control
    candidates: dict[str, Replayed] = {}
    setup: dict[str, float] = {}
    for solver, entry in entries(scenario, solvers).items():
        assembly = flight.assembly.of(entry)
        started = clock.perf_counter()
        controller = assembly.controller()  # a second time: what can be shared within a process is there
        setup[solver] = 1e3 * (clock.perf_counter() - started)
        reference = assembly.reference(log.t.size + controller.horizon)
        candidates[solver] = Replayed(controller, log, reference)
    segments = [range(start, min(start + SEGMENT, log.t.size)) for start in range(0, log.t.size, SEGMENT)]
    hover = make_state(position=(0.0, 0.0, 10.0))
    with flight.assembly.plant() as plant:

        def fly_a_period() -> None:
            plant.reset(hover)
            plant.advance(plant.vehicle.hover_speeds, scenario.steps_per_period)
            plant.state()

        times = time_in_turns(
            {solver: (candidate.prepare, candidate.answer) for solver, candidate in candidates.items()},
            segments[:1] if quick else segments,
            between=fly_a_period,
            repeats=1 if quick else 3,
            rng=np.random.default_rng(scenario.seed),
            progress=report,
        )
    exact = candidates.get("core", next(iter(candidates.values()))).commands
    return [
        {
            "scenario": name,
            "solver": solver,
            "setup_ms": setup[solver],
            **step_quantiles(times[solver]),
            **_answers(candidate.commands, exact),
        }
        for solver, candidate in candidates.items()
    ]


def _answers(commands: Answers, exact: Answers) -> Record:
    """Periods without an accepted answer, and how far the others are from the exact optimum, which is unique."""
    answered = {k: command for k, command in commands.items() if command and command.status in ACCEPTED}
    pairs = ((command, exact[k]) for k, command in answered.items())
    differences = [float(np.abs(command.speeds - other.speeds).max()) for command, other in pairs if other]
    return {
        "periods": len(commands),
        "failures": len(commands) - len(answered),
        "largest_difference_rad_s": max(differences, default=None),
    }


def draw(records: Sequence[Record], path: Path) -> None:
    """Draw median, 99th percentile and maximum of each solver's step."""
    import matplotlib.pyplot as plt

    names = [*dict.fromkeys(record["scenario"] for record in records)]
    rows = len(records) / len(names)
    figure, panels = plt.subplots(
        1, len(names), figsize=(4.0 + 4.0 * len(names), 1.4 + 0.35 * rows), layout="constrained", squeeze=False
    )
    for axes, name in zip(panels[0], names, strict=True):
        ranked = sorted((r for r in records if r["scenario"] == name), key=lambda record: -record["p99_ms"])
        for key, marker in (("p50_ms", "|"), ("p99_ms", "D"), ("max_ms", ">")):
            axes.plot([record[key] for record in ranked], range(len(ranked)), marker, label=key.removesuffix("_ms"))
        axes.set_yticks(range(len(ranked)), [record["solver"] for record in ranked])
        axes.set(xscale="log", xlabel="controller step [ms]", title=name)
    panels[0, 0].legend()
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main() -> None:
    """Measure, print and write."""
    shipped = ["paper-constrained", "robust"]
    chosen = options(
        __doc__,
        scenario={"nargs": "+", "default": shipped, "help": "default: %(default)s"},
        solvers={"nargs": "+", "default": read_catalogue().solvers, "help": "default: every solver that is installed"},
    )
    records = run(
        lambda report: [row for name in chosen.scenario for row in measure(name, chosen.solvers, chosen.quick, report)],
        "QP solvers",
        chosen.json,
    )
    if chosen.json is not None:
        draw(records, chosen.json.with_suffix(".png"))


if __name__ == "__main__":
    main()
