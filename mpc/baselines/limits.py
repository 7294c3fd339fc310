"""What the baselines have in common: checks of their settings and measurements, and plain answers."""

from __future__ import annotations

import math

import numpy as np

from mpc.actuators import ActuatorBounds
from mpc.model import LinearModel
from quadsim.controller import Command, Moment, stopped
from quadsim.errors import CommandError, ParameterError
from quadsim.state import STATE_NAMES, Array


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


def stop(now: Moment, bounds: ActuatorBounds, before: Array, horizon: int) -> Command:
    """The command on the ground: to the lowest speed, as fast as the bounds allow from `before` (4,) [rad/s]."""
    return stopped(bounds.reach(before)[0], horizon, now.phase)


def held_for_a_period(speeds: Array, model: LinearModel, horizon: int) -> Array:
    """The plan (N, 4) of a law that plans one period ahead: `speeds` (4,), then hover [rad/s]."""
    plan = np.tile(model.u_bar, (horizon, 1))
    plan[0] = speeds
    return plan
