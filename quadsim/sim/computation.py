"""Computation time as simulated time: a slow solver affects the flight reproducibly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Le, doc

from quadsim.controller import Command
from quadsim.fields import Instant, Positive


@dataclass(frozen=True, kw_only=True)
class Stall:
    """The computer stalls for a while; a command being computed waits until it resumes."""

    at: Instant
    type: Annotated[Literal["stall"], doc("kind of event: stall")] = "stall"
    duration: Annotated[Positive, doc("[s] length of the stall")]

    def text(self) -> str:
        """Describe the event."""
        return "the computer stalls"


Seconds = Annotated[float, Ge(0.0), Le(100.0)]


@dataclass(frozen=True, kw_only=True)
class ComputationTime:
    """Time from measurement to command; a command later than the control period is dropped.  No clock is read."""

    delay: Annotated[Seconds, doc("[s] fixed part")] = 0.0
    per_iteration: Annotated[Seconds, doc("[s] for each iteration of the solver")] = 0.0
    plan: Annotated[
        bool | None,
        doc(
            "whether the last plan continues while a command is late; else the last command is held; absent: true "
            "with a controller within the fallback contract"
        ),
    ] = None
    jitter: Annotated[Seconds, doc("[s] mean of an exponentially distributed part")] = 0.0


@dataclass(frozen=True, kw_only=True)
class Computation(ComputationTime):
    """Time from measurement to command, in simulated time.

    The sum of a fixed part, a part per solver iteration, an exponentially distributed part, like the wait for a busy
    processor, and the remainder of a stall.  A command that arrives after the next period has started misses its
    deadline and is dropped.  Until a command arrives, the previous one acts or, with `plan`, the next step of the last
    plan that arrived in time: if commands are due `delay` after their measurement, the actuators' side has that plan
    and continues it.
    """

    stalls: tuple[Stall, ...] = ()  # intervals without answers

    def taken(self, time: float, command: Command, rng: np.random.Generator) -> float:
        """Return the time from the measurement at `time` [s] to the command [s]."""
        taken = self.delay + self.per_iteration * command.iterations
        if self.jitter:
            taken += rng.exponential(self.jitter)
        for stall in sorted(self.stalls, key=lambda stall: stall.at):
            if time < stall.at + stall.duration and time + taken >= stall.at:
                taken = max(taken, stall.at + stall.duration - time)
        return taken
