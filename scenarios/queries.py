"""What a controller was asked in a flight, to ask another one the same and time it."""

from __future__ import annotations

import contextlib
import time as clock
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from quadsim.controller import Controller, Moment
from quadsim.errors import FlightError
from quadsim.flightlog import ControlLog
from quadsim.state import Array
from scenarios.build import build_reference
from scenarios.spec import Scenario
from scenarios.timing import undisturbed


@dataclass(frozen=True, kw_only=True)
class Queries:
    """The queries of K control periods.

    Attributes:
        t: (K,) [s].
        state: (K, 12) measured.
        reference: (K + N, 4) filtered x, y, z [m], yaw [rad], row k at t_k.
        speeds_before: (K, 4) u(k-1) [rad/s].
    """

    t: Array
    state: Array
    reference: Array
    speeds_before: Array


def recorded(scenario: Scenario, log: ControlLog, horizon: int) -> Queries:
    """The queries of a flown scenario, with a reference for N = `horizon`."""
    return Queries(
        t=log.t,
        state=log.state,
        reference=build_reference(scenario, log.t.size + horizon),
        speeds_before=np.vstack([log.speeds_before, log.speeds[:-1]]),
    )


def time_steps(
    controller: Controller, queries: Queries, *, stride: int = 1, progress: Callable[[], None] = lambda: None
) -> tuple[Array, tuple[str, ...]]:
    """Answer queries once each, on one thread, with the garbage collector at rest.

    The controller is reset to u(k-1) before each step, so that each is asked exactly what was asked in flight.

    Args:
        controller: what is timed.
        queries: what it is asked.
        stride: one query of so many is asked.
        progress: called after each step, outside its time.

    Returns:
        (ceil(K / stride),) time of each whole step [ms], and what each answered: its status, or `failed` where it gave
        no command.
    """
    step_ms, statuses = [], []
    with undisturbed():
        for k in range(0, queries.t.size, stride):
            controller.reset(queries.speeds_before[k])
            reference = queries.reference[k + 1 : k + 1 + controller.horizon]
            now, state, status = Moment(time=float(queries.t[k])), queries.state[k], "failed"
            started = clock.perf_counter()
            with contextlib.suppress(FlightError):
                status = controller.step(now, state, reference).status
            step_ms.append(1e3 * (clock.perf_counter() - started))
            statuses.append(status)
            progress()
    return np.array(step_ms), tuple(statuses)
