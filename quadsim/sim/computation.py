"""Computation time as simulated time: a slow solver affects the flight reproducibly.

    time taken = delay + per_iteration iterations + jitter,    and what is left of a stall

The loop lets a command act that much later; one that misses its deadline is dropped.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Final, Literal

import numpy as np
from annotated_types import Ge, Le, doc

from quadsim.controller import LAW, Command, Iterating
from quadsim.errors import ParameterError, UnknownNameError
from quadsim.fields import Instant, Seconds
from quadsim.mpc.pilot.pilot import Pilot
from quadsim.mpc.solvers import ALIASES, SUCCESSORS, find_solver, solver_entries

_COUNT_THEMSELVES: Final = ("nonlinear", LAW)
"""Controllers that count iterations without a solver of `quadsim list`: the nonlinear MPC, and a user's own."""


@dataclass(frozen=True, kw_only=True)
class Stall:
    """The computer stalls for a while; a command being computed waits until it resumes."""

    at: Instant
    type: Annotated[Literal["stall"], doc("kind of event: stall")] = "stall"
    duration: Annotated[Seconds, doc("[s] length of the stall")]

    def text(self) -> str:
        """Describe the event."""
        return "the computer stalls"


def physics_steps(time: float, timestep: float) -> int:
    """Return the number of physics steps until a time after their start has passed, both [s]."""
    return math.ceil(time / timestep - 1e-6)


ComputationSeconds = Annotated[float, Ge(0.0), Le(100.0)]


@dataclass(frozen=True, kw_only=True)
class ComputationTime:
    """Time from measurement to command; a command that misses its deadline is dropped.  No clock is read.

    The deadline is the end of the control period in which `delay` ends.
    """

    delay: Annotated[
        ComputationSeconds,
        doc("[s] fixed part; longer than a control period: several commands are under way at a time"),
    ] = 0.0
    per_iteration: Annotated[
        dict[str, ComputationSeconds],
        doc(
            "[s] for each iteration, by the solver that it was measured for: its name in `quadsim list`, nonlinear for "
            "that MPC's own, law for a controller of yours; refused without a solver that may answer; absent: no time"
        ),
    ] = field(default_factory=dict)
    plan: Annotated[
        bool | None,
        doc(
            "whether the last plan continues while a command is late; else the last command is held; absent: true "
            "with a controller within the fallback contract"
        ),
    ] = None
    jitter: Annotated[ComputationSeconds, doc("[s] mean of an exponentially distributed part")] = 0.0


@dataclass(frozen=True, kw_only=True)
class Computation(ComputationTime):
    """Time from measurement to command, in simulated time.

    The sum of a fixed part, a part per solver iteration, an exponentially distributed part, like the wait for a busy
    processor, and the remainder of a stall.  The deadline of a command is the end of the period in which the fixed part
    ends, after n = `whole_periods`: for a `delay` up to a period, the start of the next one.  A later command is
    dropped.  Until a command arrives, the previous one acts or, with `plan`, the next step of the last plan that
    arrived in time: if commands are due `delay` after their measurement, the actuators' side has that plan and
    continues it.

    Commands arrive in their order.  With n > 0 the plant flies u(k-1-n), then u(k-n), in the period of u(k).
    """

    stalls: tuple[Stall, ...] = ()  # intervals without answers

    def whole_periods(self, steps: int, timestep: float) -> int:
        """Return n, the periods of `steps` physics steps [s] that each command spends under way before its own."""
        return max(physics_steps(self.delay, timestep) - 1, 0) // steps

    def taken(self, time: float, command: Command, rng: np.random.Generator) -> float:
        """Return the time from the measurement at `time` [s] to the command [s].

        Raises:
            ParameterError: the solver that answered has no time per iteration, though others have one.
        """
        taken = self.delay
        if self.per_iteration and command.stats.iterations:
            taken += self._per_iteration_of(command.iterations_by or command.answered_by) * command.stats.iterations
        if self.jitter:
            taken += rng.exponential(self.jitter)
        for stall in sorted(self.stalls, key=lambda stall: stall.at):
            if time < stall.at + stall.duration and time + taken >= stall.at:
                taken = max(taken, stall.at + stall.duration - time)
        return taken

    def _per_iteration_of(self, solver: str) -> float:
        """Return the time that an iteration of a solver takes [s]."""
        if solver not in self.per_iteration:
            raise not_measured({solver}, self.per_iteration)
        return self.per_iteration[solver]


def times_by_solver(per_iteration: Mapping[str, float]) -> dict[str, float]:
    """Return times per iteration [s] by the solvers' own names, for which aliases may stand.

    Raises:
        ParameterError: a name is no solver, or two names are of one solver.
    """
    times: dict[str, float] = {}
    for name, seconds in per_iteration.items():
        if name not in _COUNT_THEMSELVES:
            try:
                find_solver(name)
            except UnknownNameError as error:
                if name in SUCCESSORS:
                    rule = f"absent: {error}"
                else:
                    known = ", ".join(sorted({*_COUNT_THEMSELVES, *ALIASES, *solver_entries()}))
                    rule = f"absent, or one of {known}"
                raise ParameterError("computation.per_iteration", name, seconds, rule) from None
        own_name = ALIASES.get(name, name)
        if own_name in times:
            rule = f"given once: {own_name} is another name of the same solver"
            raise ParameterError("computation.per_iteration", name, seconds, rule)
        times[own_name] = seconds
    return times


def not_measured(missing: Collection[str], measured: Collection[str]) -> ParameterError:
    """Return the error of a controller whose iterations are not those that were measured."""
    rule = f"given for every solver that may answer for this controller, so also for {', '.join(sorted(missing))}"
    return ParameterError("computation", "per_iteration", sorted(measured), rule)


def check_measured(settings: ComputationTime | None, controller: object) -> None:
    """Reject times per iteration of other solvers than those that may answer for a controller.

    Raises:
        ParameterError: a solver that may answer is not named in `computation.per_iteration`, or none iterates.
    """
    if settings is None or not settings.per_iteration:
        return
    law = controller
    if isinstance(controller, Pilot):
        law = controller.law
    named = times_by_solver(settings.per_iteration).keys()
    iterates: frozenset[str] = frozenset()
    if isinstance(law, Iterating):
        iterates = law.iterates
    if not iterates:
        rule = "absent with a controller that counts no iterations"
        raise ParameterError("computation", "per_iteration", settings.per_iteration, rule)
    if not iterates <= named:
        raise not_measured(iterates - named, named)
