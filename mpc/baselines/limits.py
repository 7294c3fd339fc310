"""What a baseline's rotor speeds are held to, and what they have in common with every controller's answer."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mpc.model import LinearModel
from quadsim.controller import Command, Moment, stopped
from quadsim.errors import CommandError, ParameterError
from quadsim.state import STATE_NAMES, Array

Pair = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class InputBounds:
    """Bounds on rotor speeds; None for no bound.

    Attributes:
        speed: (lower, upper) of u(k) [rad/s].
        slew: (lower, upper) of u(k) - u(k-1) [rad/s].

    Raises:
        ParameterError: a pair is not two finite numbers in order, a speed is negative, or a slew leaves out 0.
    """

    speed: Pair | None = None
    slew: Pair | None = None

    def __post_init__(self) -> None:
        for name in ("speed", "slew"):
            pair = getattr(self, name)
            if pair is None:
                continue
            if len(pair) != 2 or not all(math.isfinite(value) for value in pair) or not pair[0] < pair[1]:
                raise ParameterError("controller", name, pair, "two finite numbers, the lower one first")
        if self.speed is not None and self.speed[0] < 0.0:
            raise ParameterError("controller", "speed", self.speed, "at least 0 rad/s")
        if self.slew is not None and not self.slew[0] <= 0.0 <= self.slew[1]:
            raise ParameterError("controller", "slew", self.slew, "one that a held speed, 0, is within")

    def reach(self, before: Array) -> tuple[Array, Array]:
        """The lowest and highest speeds (4,) after u(k-1) = `before` (4,) [rad/s]; rotors turn one way, so 0 at least.

        Where both cannot hold, as after a command outside `speed`, `speed` holds.
        """
        low, high = self.speed or (0.0, math.inf)
        down, up = self.slew or (-math.inf, math.inf)
        return np.clip(before + down, low, high), np.clip(before + up, low, high)


def require_positive(name: str, value: float) -> None:
    """A setting that has to be a positive, finite number.

    Raises:
        ParameterError: it is not.
    """
    if not 0.0 < value < math.inf:
        raise ParameterError("controller", name, value, "positive and finite")


def require_within(name: str, value: float, lower: float, upper: float) -> None:
    """A setting that has to be between two numbers.

    Raises:
        ParameterError: it is not.
    """
    if not lower <= value <= upper:
        raise ParameterError("controller", name, value, f"between {lower:g} and {upper:g}")


def require_finite(now: Moment, state: Array, reference: Array) -> None:
    """A measurement and a preview that a command can be made from.

    Raises:
        CommandError: a number is not finite; nothing was commanded, and the controller's memory is as it was.
    """
    if not np.isfinite(state).all():
        names = ", ".join(STATE_NAMES[i] for i in np.flatnonzero(~np.isfinite(state)))
        raise CommandError(f"no command from a measured state whose {names} is not finite", time=now.time)
    if not np.isfinite(reference).all():
        raise CommandError("no command from a reference that is not finite", time=now.time)


def stop(now: Moment, bounds: InputBounds, before: Array, horizon: int) -> Command:
    """The command on the ground: to the lowest speed, as fast as the bounds allow from `before` (4,) [rad/s]."""
    return stopped(bounds.reach(before)[0], horizon, now.phase)


def held_for_a_period(speeds: Array, model: LinearModel, horizon: int) -> Array:
    """The plan (N, 4) of a law that plans one period ahead: `speeds` (4,), then hover [rad/s]."""
    plan = np.tile(model.u_bar, (horizon, 1))
    plan[0] = speeds
    return plan
