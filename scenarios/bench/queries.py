"""The queries of a controller in a flight, to time another one on the same."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from mpc.ocp import Problem, Query
from quadsim.controller import Command, Controller, Moment
from quadsim.errors import FlightError
from quadsim.flight.log import ControlLog
from quadsim.state import Array, make_state
from quadsim.vehicle import Vehicle
from scenarios.build import build_plant
from scenarios.courses.make import build_reference
from scenarios.schema.scenario import Scenario


@dataclass(frozen=True, kw_only=True)
class Queries:
    """The queries of K control periods."""

    t: Array  # (K,) [s]
    state: Array  # (K, 12) measured
    reference: Array  # (K + N, 4) filtered x, y, z [m], yaw [rad], row k at t_k
    speeds_before: Array  # (K, 4) u(k-1) [rad/s]

    def of_qp(self, problem: Problem, period: int) -> Query:
        """xi(k), y_d and u(k-1)."""
        reference = self.reference[period + 1 : period + 1 + problem.horizon]
        return Query(self.state[period], problem.objective.desired(reference), self.speeds_before[period])


def recorded(scenario: Scenario, log: ControlLog, horizon: int) -> Queries:
    """The queries of a flown scenario, with a reference for N = `horizon`."""
    return Queries(
        t=log.t,
        state=log.state,
        reference=build_reference(scenario, log.t.size + horizon),
        speeds_before=np.vstack([log.speeds_before, log.speeds[:-1]]),
    )


class QueriedController:
    """A controller that is given a flight's queries, each after the command that was given before it in that flight."""

    def __init__(self, controller: Controller, queries: Queries) -> None:
        self._controller, self._queries = controller, queries
        self.command: Command | None = None  # its last answer; None where there was none
        self._period: int | None = None
        self.statuses: dict[int, str] = {}  # what it answered first, by period; `failed` where it gave no command

    def prepare(self, period: int) -> None:
        """See `scenarios.bench.timing.Candidate.prepare`."""
        queries, before = self._queries, self._queries.speeds_before[period]
        if self._period is None or period != self._period + 1:
            self._controller.reset(before)  # else what is warm stays so, as in a flight
        reference = queries.reference[period + 1 : period + 1 + self._controller.horizon]
        moment = Moment(time=float(queries.t[period]), acting=before)
        self._query = (moment, queries.state[period], reference)
        self._period, self.command = period, None

    def answer(self) -> None:
        """See `scenarios.bench.timing.Candidate.answer`."""
        try:
            self.command = self._controller.step(*self._query)
        except FlightError:  # there is no earlier plan to hold: the solver failed
            self.command = None
        assert self._period is not None
        self.statuses.setdefault(self._period, "failed" if self.command is None else self.command.status)


@contextlib.contextmanager
def flight_between(scenario: Scenario, vehicle: Vehicle) -> Iterator[Callable[[], None]]:
    """What a flight does between two control steps: it flies a period and measures, which empties caches."""
    with build_plant(scenario, vehicle) as plant:
        hover = make_state(position=(0.0, 0.0, 10.0))

        def fly() -> None:
            plant.reset(hover)
            plant.advance(plant.hover_speeds, scenario.steps_per_period)
            plant.state()

        yield fly
