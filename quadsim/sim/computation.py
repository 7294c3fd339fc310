"""The time that a command takes to be computed, simulated: a slow solver flies, and the same way everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Le, doc

from quadsim.controller import Command
from quadsim.fields import Instant, Positive


@dataclass(frozen=True, kw_only=True)
class Stall:
    """The computer answers nothing for a while; a command being computed waits for its end."""

    at: Instant
    type: Annotated[Literal["stall"], doc("kind of event: stall")] = "stall"
    duration: Annotated[Positive, doc("[s] how long")]

    def text(self) -> str:
        """What happens, in words."""
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
            "whether the last plan is continued while a command is late; else the last command is held; absent: true "
            "with a controller within the fallback contract"
        ),
    ] = None
    jitter: Annotated[Seconds, doc("[s] mean of an exponentially distributed part")] = 0.0


@dataclass(frozen=True, kw_only=True)
class Computation(ComputationTime):
    """How long the controller's computer takes from a measurement to the command, seconds of simulated time.

    The sum of a fixed part, a part per solver iteration, an exponentially distributed part, as the wait for a busy
    processor is, and the wait for the end of a stall.  A command that comes after the next period's begin has missed
    its deadline and is dropped.  What acts until one comes is the command before it or, with `plan`, the next step of
    the last plan that came in time: where commands are due `delay` after their measurement, the actuators' side has
    that plan and continues it.
    """

    stalls: tuple[Stall, ...] = ()  # when the computer answers nothing

    def taken(self, time: float, command: Command, rng: np.random.Generator) -> float:
        """From the measurement at `time` [s] to the command [s]."""
        taken = self.delay + self.per_iteration * command.iterations
        if self.jitter:
            taken += rng.exponential(self.jitter)
        for stall in sorted(self.stalls, key=lambda stall: stall.at):
            if time < stall.at + stall.duration and time + taken >= stall.at:
                taken = max(taken, stall.at + stall.duration - time)
        return taken
