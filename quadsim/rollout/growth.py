"""Whether a closed loop is stable, measured in it: two flights of one seed, and the growth of their difference.

Both hold a hover; the second starts with a small velocity and yaw rate.  Noise, gusts, biases and steady errors are the
same in both and cancel in the difference d(t), which after its transients follows the slowest mode of the loop,
|d(t)| ~ exp(rate t).  `quadsim.rollout.stability` measures with it, `quadsim.rollout.remedies` compares changes.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol, TypeAlias

import numpy as np

from quadsim.errors import FlightError
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.sim.physics import Period
from quadsim.state import EULER, POSITION, VELOCITY, Array, wrapped

SIZE: Final = 1e-3
"""Velocity along x with which the second flight starts [m/s].

So little that no bound acts, and that a loop which oscillates within its bounds has a far larger difference.
"""
NEUTRAL: Final = 0.003
"""Rate [1/s] within which a difference neither grows nor decays: it takes longer than is flown to tell."""
LONGEST_PAIR: Final = 24.0  # flown where the rate is small [s]
USUAL_PAIR: Final = 12.0  # flown otherwise, at most [s]
_SMALL_RATE: Final = 0.05  # magnitude of a rate below which `LONGEST_PAIR` is flown [1/s]
_BLOCK: Final = 1.0  # time of which the largest difference is taken [s]
_LEAST_BLOCKS: Final = 4
_DECAYED: Final = 1e-5  # difference over that of the first block at which the flights end
_GROWN: Final = 30.0  # the same, of one that grows
_SATURATED: Final = math.e  # the same, beyond what the transients of a stable loop leave after some seconds
SHORT_PAIR: Final = 8.0  # flown where a flight must not wait for long [s]
NOTABLE: Final = 0.05  # least rate that tells an unstable loop where no more than `SHORT_PAIR` is flown [1/s]
_HOVER_HEIGHT: Final = 5.0  # [m]
_VELOCITY_SHARES: Final = (1.0, 0.6, 0.3)  # direction of the velocity at the start, x component 1
_YAW_RATE_SHARE: Final = 50.0  # yaw rate at the start [deg/s] per velocity along x [m/s]
_LEFT_OUT: Final[Mapping[str, list[Any]]] = {"constraints": [], "events": [], "obstacles": [], "corridors": []}

_TINY: Final = float(np.finfo(float).tiny)

LoopVerdict: TypeAlias = Literal["stable", "neutral", "unstable"]


class Stepped(Protocol):
    """A flight that is flown period by period."""

    def step(self) -> Period:
        """Fly one control period."""
        ...


StartPlain: TypeAlias = Callable[[Assembly], contextlib.AbstractContextManager[Stepped]]
"""Starts a flight that is not recorded."""
MeasureGrowth: TypeAlias = Callable[[Scenario, float], "Growth"]
"""Measures a scenario's loop at a heading [deg], for `SHORT_PAIR` seconds; see `grown`."""


@dataclass(frozen=True, kw_only=True)
class Growth:
    """How the difference of two flights grows.

    `rate` is the largest real part of the loop's exponents, of any controller, linear or not, with the plant as it
    is, sampled, delayed and lagging.  Negative means stable.  For a linear one it is ln(rho) / tau_s, with rho the
    spectral radius of the sampled loop.
    """

    rate: float  # [1/s]; infinite where a flight ended before its difference could be compared
    left: float  # difference at the end, over that at the start
    time: float  # flown [s]
    ended: str = ""  # why a flight ended early; empty if none did

    @property
    def verdict(self) -> LoopVerdict:
        """Whether the loop is stable; `neutral` where the difference stays what it was."""
        if self.ended or self.rate > NEUTRAL:
            return "unstable"
        if self.rate < -NEUTRAL:
            return "stable"
        return "neutral"

    @property
    def notable(self) -> bool:
        """Whether the loop is unstable by so much that flights of `SHORT_PAIR` seconds tell."""
        return bool(self.ended) or self.rate >= NOTABLE

    @property
    def stable(self) -> bool:
        """Whether the difference decays."""
        return self.verdict == "stable"


def hovering(
    scenario: Scenario, *, heading: float, size: float = 0.0, changes: Mapping[str, Any] | None = None
) -> Scenario:
    """Return a scenario that holds a hover in free air, with vehicle, controller, effects and sensors of this one.

    Args:
        scenario: gives all but course, start, events, obstacles, ground and constraints.
        heading: of the hover [deg].
        size: velocity along x at the start [m/s], with a yaw rate in proportion.
        changes: values of further fields, by dotted path.

    Raises:
        InputError: a changed field is not allowed.
    """
    changed = changes or {}
    period = changed.get("control_period", scenario.control_period)
    fields: dict[str, Any] = {
        **_LEFT_OUT,
        "duration": math.ceil(LONGEST_PAIR / period - 1e-6) * period,
        "reference": {"type": "yaw_turns", "turns": [{"start": 0.0, "yaw": heading, "rate": 30.0}]},
        "initial": {
            "position": [0.0, 0.0, _HOVER_HEIGHT],
            "euler": [0.0, 0.0, heading],
            "velocity": [size * share for share in _VELOCITY_SHARES],
            "body_rates": [0.0, 0.0, _YAW_RATE_SHARE * size],
        },
    }
    if scenario.keep_in is not None:
        fields["keep_in"] = None
    if scenario.effects.ground is not None:
        fields["effects.ground"] = None
    return scenario.replace({**fields, **changed})


def grown(
    scenario: Scenario,
    start: StartPlain,
    *,
    heading: float = 0.0,
    size: float = SIZE,
    changes: Mapping[str, Any] | None = None,
    longest: float = LONGEST_PAIR,
) -> Growth:
    """Fly a pair of hovers of one seed that start differently; return how their difference grows.

    It is flown for `USUAL_PAIR` seconds, for `LONGEST_PAIR` where the rate is small, and less where the difference has
    decayed or grown before.

    Args:
        scenario: as in `hovering`.
        start: starts each of the flights.
        heading: as in `hovering` [deg].
        size: as in `hovering`, of the second flight.
        changes: as in `hovering`.
        longest: [s] ends the flights, at most `LONGEST_PAIR`.

    Raises:
        InputError: a changed field is not allowed, or the parts cannot be built.
    """
    still = hovering(scenario, heading=heading, changes=changes)
    pushed = hovering(scenario, heading=heading, size=size, changes=changes)
    period = still.control_period
    periods = min(still.periods, round(longest / period))
    per_block = max(round(_BLOCK / period), 1)
    distances: list[float] = []
    ended = ""
    with start(Assembly(still)) as first, start(Assembly(pushed)) as second:
        while len(distances) < periods:
            try:
                state = first.step().observation.truth
                pushed_state = second.step().observation.truth
            except FlightError as error:
                ended = str(error)
                break
            distances.append(_distance(state, pushed_state))
            at_block_end = len(distances) % per_block == 0
            if at_block_end and _is_clear(_blocks(distances, per_block), period * len(distances)):
                break
    time = round(period * len(distances), 9)
    rate, left = _rate(distances, per_block, period)
    return Growth(rate=rate, left=left, time=time, ended=ended)


def _distance(first: Array, second: Array) -> float:
    """Return the size of a difference of two states (12,): of position [m], velocity [m/s] and angles [rad]."""
    difference = first - second
    angles = wrapped(difference[list(EULER)])
    moved = difference[[*POSITION, *VELOCITY]]
    return float(np.sqrt(moved @ moved + angles @ angles))


def _blocks(distances: list[float], per_block: int) -> Array:
    """Return the largest distance within each whole block."""
    whole = len(distances) // per_block
    return np.array(distances[: whole * per_block]).reshape(whole, per_block).max(axis=1)


def _is_clear(blocks: Array, time: float) -> bool:
    """Return whether the rate is clear after a time [s], so that no more has to be flown."""
    if blocks.size < _LEAST_BLOCKS:
        return False
    share = float(blocks[-1] / blocks[0])
    if share < _DECAYED or share > _GROWN:
        return True
    return time >= USUAL_PAIR and abs(_slope(blocks)) > _SMALL_RATE


def _slope(blocks: Array) -> float:
    """Return the rate of the later half of the blocks [1/block], by least squares."""
    later = blocks[blocks.size // 2 :]
    logarithms = np.log(np.maximum(later, _TINY))
    return float(np.polyfit(np.arange(later.size), logarithms, 1)[0])


def _rate(distances: list[float], per_block: int, period: float) -> tuple[float, float]:
    """Return the rate [1/s], and the difference at the end over that at the start."""
    if len(distances) < 2:
        return math.inf, math.inf
    blocks = _blocks(distances, per_block)
    if blocks.size < _LEAST_BLOCKS:  # a flight was lost within seconds
        left = distances[-1] / distances[0]
        time = period * (len(distances) - 1)
        return math.log(max(left, _TINY)) / time, left
    left = float(blocks[-1] / blocks[0])
    rate = _slope(blocks) / (per_block * period)
    if left > _SATURATED:  # it may have grown to a limit cycle, in which it no longer does
        rate = max(rate, math.log(left) / (per_block * period * (blocks.size - 1)))
    return rate, left
