"""The time that a command takes to be computed, simulated: a slow solver flies, and the same way everywhere."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from quadsim.controller import Command
from quadsim.errors import ParameterError


@dataclass(frozen=True, kw_only=True)
class Stall:
    """For `duration` [s] from `start` [s] on, no command is completed: one that is being computed waits for the end."""

    start: float
    duration: float


@dataclass(frozen=True, kw_only=True)
class Computation:
    """How long the controller's computer takes from a measurement to the command, seconds of simulated time.

    The sum of a fixed part, a part per solver iteration, an exponentially distributed part, and the wait for the end of
    a stall.  A command that comes after the next period's begin has missed its deadline and is dropped.  What acts
    until one comes is the command before it or, with `plan`, the next step of the last plan that came in time: where
    commands are due `fixed` after their measurement, the actuators' side has that plan and goes on by it.

    Attributes:
        fixed: [s].
        per_iteration: [s] for each iteration that the solver reports.
        jitter: mean of the random part [s]; exponential, as the wait for a busy processor is.
        stalls: when the computer answers nothing.
        plan: whether the last plan is continued until a command arrives.
    """

    fixed: float = 0.0
    per_iteration: float = 0.0
    jitter: float = 0.0
    stalls: tuple[Stall, ...] = ()
    plan: bool = False

    def __post_init__(self) -> None:
        for name in ("fixed", "per_iteration", "jitter"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ParameterError("computation", name, getattr(self, name), "at least 0 s and finite")

    def delay(self, time: float, command: Command, rng: np.random.Generator) -> float:
        """From the measurement at `time` [s] to the command [s]."""
        taken = self.fixed + self.per_iteration * command.iterations
        if self.jitter:
            taken += rng.exponential(self.jitter)
        for stall in sorted(self.stalls, key=lambda stall: stall.start):
            if time < stall.start + stall.duration and time + taken >= stall.start:
                taken = max(taken, stall.start + stall.duration - time)
        return taken
