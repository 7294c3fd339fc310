"""The margins of a loop: up to which value of each quantity it is stable, by bisection.

From the nominal value p0 a search goes outwards to the first value at which the growth |d(t)| ~ exp(rate t) of
`quadsim.rollout.growth` is not negative, then halves the bracket until it is `BRACKET_WIDTH` wide: as a share of the
margin |p - p0|, or as a logarithm where p is a factor.  `quantities` says what p is, `report` shows what was found.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Final, Literal, TypeAlias

from quadsim.console.progress import Progress
from quadsim.errors import InputError
from quadsim.features.stability.quantities import VARIED, VariedQuantity, point
from quadsim.rollout import many
from quadsim.rollout.growth import Growth, hovering
from quadsim.rollout.stability import measure_growth
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.feasibility_check import hover_notes
from quadsim.scenarios.plugin import Plugin
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.ties import first_smallest

BRACKET_WIDTH: Final = 0.02
"""Width of the last bracket: as a share of a margin, or of the value where this is a factor."""
_OUTWARD_SHARES: Final = (1.0 / 16.0, 1.0 / 8.0, 1.0 / 4.0, 1.0 / 2.0, 1.0)
"""Shares of the way from the nominal value to the end of the range, at which a search measures first, in this order: a
loop may be stable again beyond an unstable value."""
_NARROWEST: Final = 5e-4  # bracket at which a search ends in any case, as a share of the way to the end of the range
MAP_POINTS: Final = 9  # values of either quantity in a map
_MAP_REACH: Final = 1.25  # distance from the nominal value to the edge of a map, over the margin

PointState: TypeAlias = Literal["stable", "neutral", "unstable", "no flight"]


@dataclass(frozen=True, kw_only=True)
class LoopPoint:
    """The loop at one value of each quantity."""

    values: Mapping[str, float]
    """By name of a quantity, in its unit."""
    state: PointState
    rate: float | None = None  # [1/s]; None without a flight, or where it ended at once
    why: str = ""  # why no flight is possible, or why it ended early


@dataclass(frozen=True, kw_only=True)
class MarginSide:
    """One side of a margin.

    The loop is stable at `stable`, and at every measured value between it and the nominal one.  It is not stable at
    `unstable`, which is None where the loop is stable up to the end of the range.
    """

    stable: float
    unstable: float | None
    state: PointState  # at `unstable`; `stable` where that is None
    why: str  # why the vehicle cannot be flown at `unstable`, or why the flight ended; empty if it did not
    points: tuple[LoopPoint, ...]  # those that the search measured, in its order


@dataclass(frozen=True, kw_only=True)
class Margin:
    """A quantity's margin on both sides of its nominal value; a side is None where the range ends at the nominal."""

    quantity: str
    nominal: float
    lower: MarginSide | None
    upper: MarginSide | None

    @property
    def sides(self) -> tuple[MarginSide, ...]:
        """The sides that there are, the upper one first."""
        sides = (self.upper, self.lower)
        return tuple(side for side in sides if side is not None)


@dataclass(frozen=True, kw_only=True)
class ClosestLimit:
    """The margin that is the smallest, as a share of the nominal value or of the range; see `VariedQuantity`."""

    quantity: str
    value: float
    share: float


@dataclass(frozen=True, kw_only=True)
class LoopMargins:
    """The growth of one loop at its nominal point, and its margins."""

    name: str  # of the controller
    size: float  # velocity at the start of the second flight [m/s]
    growth: Growth
    margins: Mapping[str, Margin]
    """By quantity; empty unless the loop is stable at its nominal point."""
    failures: tuple[str, ...] = ()  # searches that failed, with the reason

    @property
    def closest(self) -> ClosestLimit | None:
        """The smallest margin, the first of equal ones; None where nothing within its range makes the loop unstable."""
        limits: list[ClosestLimit] = []
        for name, margin in self.margins.items():
            for side in margin.sides:
                if side.state in ("unstable", "neutral"):
                    share = VARIED[name].distance(margin.nominal, side.stable)
                    limits.append(ClosestLimit(quantity=name, value=side.stable, share=share))
        if not limits:
            return None
        shares = [limit.share for limit in limits]
        return limits[first_smallest(shares)]


@dataclass(frozen=True, kw_only=True)
class StabilityMap:
    """The loop over two quantities: points row by row, the first quantity varying fastest."""

    name: str  # of the controller
    size: float  # velocity at the start of the second flight [m/s]
    quantities: tuple[str, str]
    values: tuple[tuple[float, ...], tuple[float, ...]]
    points: tuple[LoopPoint, ...]


@dataclass(frozen=True, kw_only=True)
class MeasuredLoop:
    """A loop to be measured."""

    name: str  # of the controller
    scenario: Scenario
    size: float  # velocity at the start of the second flight [m/s]

    @property
    def calls_user_code(self) -> bool:
        """Whether its flights call a user's controller or force."""
        return isinstance(self.scenario.controller, Plugin) or bool(self.scenario.forces)


def measure_point(loop: MeasuredLoop, values: Mapping[str, float]) -> LoopPoint:
    """Measure the growth of a loop with these values of some quantities, where it can be flown with them."""
    assembly = Assembly(loop.scenario)
    heading, changes = point(assembly, values)
    try:
        changed = hovering(loop.scenario, heading=heading, changes=changes)
        notes = hover_notes(Assembly(changed))
        if notes:
            return LoopPoint(values=values, state="no flight", why=notes[0])
        result = measure_growth(loop.scenario, heading=heading, size=loop.size, changes=changes)
    except InputError as error:
        return LoopPoint(values=values, state="no flight", why=str(error))
    if math.isfinite(result.rate):
        rate = result.rate
    else:
        rate = None
    return LoopPoint(values=values, state=result.verdict, rate=rate, why=result.ended)


def find_side(at: Callable[[float], LoopPoint], value_at: Callable[[float], float], *, geometric: bool) -> MarginSide:
    """Search one side of a margin: outwards to the first value that is not stable, then by bisection.

    Args:
        at: measures the loop at a value.
        value_at: the value at a share of the way from the nominal value to the end of the range.
        geometric: whether the value is a factor.
    """
    points: list[LoopPoint] = []
    inner = 0.0  # largest share up to which every point is stable
    outer = None  # smallest share beyond it at which the point is not
    for share in _OUTWARD_SHARES:
        latest = at(value_at(share))
        points.append(latest)
        if latest.state != "stable":
            outer = share
            break
        inner = share
    if outer is None:
        return MarginSide(stable=value_at(1.0), unstable=None, state="stable", why="", points=tuple(points))
    not_stable = points[-1]
    while _is_wide(value_at, inner, outer, geometric=geometric):
        middle = 0.5 * (inner + outer)
        latest = at(value_at(middle))
        points.append(latest)
        if latest.state == "stable":
            inner = middle
        else:
            outer = middle
            not_stable = latest
    return MarginSide(
        stable=value_at(inner),
        unstable=value_at(outer),
        state=not_stable.state,
        why=not_stable.why,
        points=tuple(points),
    )


def _is_wide(value_at: Callable[[float], float], inner: float, outer: float, *, geometric: bool) -> bool:
    """Return whether a bracket, in shares of the way, is wider than `BRACKET_WIDTH`."""
    if outer - inner < _NARROWEST:
        return False
    stable = value_at(inner)
    not_stable = value_at(outer)
    middle = value_at(0.5 * (inner + outer))
    if middle in (stable, not_stable):  # of a quantity in whole steps, there is no value between
        return False
    if geometric:
        return abs(math.log(not_stable / stable)) > BRACKET_WIDTH
    margin = abs(not_stable - value_at(0.0))
    return abs(not_stable - stable) > BRACKET_WIDTH * margin


@dataclass(frozen=True, kw_only=True)
class _SideTask:
    """A task of a worker: one side of a margin."""

    loop: MeasuredLoop
    quantity: str
    upward: bool


def _search_side(task: _SideTask) -> many.Row:
    """Return the side of a margin, in a worker process."""
    assembly = Assembly(task.loop.scenario)
    quantity = VARIED[task.quantity]
    nominal = quantity.nominal(assembly)
    low, high = quantity.ends(nominal)
    if task.upward:
        end = high
    else:
        end = low
    value_at = partial(quantity.between, nominal, end, step=quantity.step(assembly))

    def at(value: float) -> LoopPoint:
        return measure_point(task.loop, {task.quantity: value})

    return {"side": find_side(at, value_at, geometric=quantity.geometric)}


def _measure_nominal(loop: MeasuredLoop) -> many.Row:
    """Return the growth at the nominal point, in a worker process."""
    heading, _changes = point(Assembly(loop.scenario), {})
    return {"growth": measure_growth(loop.scenario, heading=heading, size=loop.size)}


@dataclass(frozen=True, kw_only=True)
class _PointTask:
    """A task of a worker: one point of a map."""

    loop: MeasuredLoop
    values: Mapping[str, float]


def _measure_map_point(task: _PointTask) -> many.Row:
    """Return a point of a map, in a worker process."""
    return {"point": measure_point(task.loop, task.values)}


def loop_margins(loop: MeasuredLoop, quantities: Sequence[VariedQuantity]) -> LoopMargins:
    """Measure the margins of one loop in this process; there are none where it is not stable.

    Raises:
        InputError: the loop cannot be built.
    """
    growth: Growth = _measure_nominal(loop)["growth"]
    sides = {}
    if growth.stable:
        for task in _side_tasks(loop, quantities):
            sides[task.quantity, task.upward] = _search_side(task)["side"]
    return LoopMargins(name=loop.name, size=loop.size, growth=growth, margins=_margins(loop, quantities, sides))


class LoopMeasurement:
    """Measures loops in worker processes, and reports its progress."""

    def __init__(self, loops: Sequence[MeasuredLoop], *, workers: int | None, progress: Progress) -> None:
        self._loops = loops
        self._workers = workers
        self._progress = progress
        self._isolated = any(loop.calls_user_code for loop in loops)

    def _rows(self, stage: str, tasks: Sequence[Any], work: many.Fly) -> list[many.Row]:
        """Return the row of each task, in order."""
        rows: list[many.Row] = [{} for _ in tasks]
        self._progress(stage, 0, len(tasks))
        done = 0
        with closing(many.fly_many(tasks, work, workers=self._workers, isolate=self._isolated)) as finished:
            for place, row in finished:
                rows[place] = row
                done += 1
                self._progress(stage, done, len(tasks))
        return rows

    def growths(self) -> list[Growth]:
        """Return the growth of each loop at its nominal point.

        Raises:
            InputError: a loop cannot be built.
        """
        growths: list[Growth] = []
        for loop, row in zip(self._loops, self._rows("nominal", self._loops, _measure_nominal), strict=True):
            if "growth" not in row:
                raise InputError(f"{loop.name}: {row['reason']}")
            growths.append(row["growth"])
        return growths

    def margins(self, quantities: Sequence[VariedQuantity]) -> list[LoopMargins]:
        """Measure the margins of each loop; there are none where it is not stable.

        Raises:
            InputError: a loop cannot be built.
        """
        growths = self.growths()
        tasks: list[_SideTask] = []
        for loop, growth in zip(self._loops, growths, strict=True):
            if growth.stable:
                tasks += _side_tasks(loop, quantities)
        rows: list[many.Row] = []
        if tasks:
            rows = self._rows("margins", tasks, _search_side)
        measured: list[LoopMargins] = []
        for loop, growth in zip(self._loops, growths, strict=True):
            of_loop = [(task, row) for task, row in zip(tasks, rows, strict=True) if task.loop is loop]
            measured.append(_loop_margins_of(loop, growth, quantities, of_loop))
        return measured

    def map(self, loop: MeasuredLoop, measured: LoopMargins, pair: tuple[str, str]) -> StabilityMap:
        """Return the map of a stable loop over two quantities, to somewhat beyond the margins of both."""
        x_name, y_name = pair
        x_values = _map_values(measured.margins[x_name])
        y_values = _map_values(measured.margins[y_name])
        tasks = []
        for y in y_values:
            for x in x_values:
                tasks.append(_PointTask(loop=loop, values={x_name: x, y_name: y}))
        points: list[LoopPoint] = []
        for task, row in zip(tasks, self._rows("map", tasks, _measure_map_point), strict=True):
            if "point" in row:
                points.append(row["point"])
            else:
                points.append(LoopPoint(values=task.values, state="no flight", why=row["reason"]))
        return StabilityMap(
            name=loop.name, size=loop.size, quantities=pair, values=(x_values, y_values), points=tuple(points)
        )


def _side_tasks(loop: MeasuredLoop, quantities: Sequence[VariedQuantity]) -> Iterator[_SideTask]:
    """Yield the sides that lie within the range of each quantity."""
    assembly = Assembly(loop.scenario)
    for quantity in quantities:
        nominal = quantity.nominal(assembly)
        low, high = quantity.ends(nominal)
        if low < nominal:
            yield _SideTask(loop=loop, quantity=quantity.name, upward=False)
        if high > nominal:
            yield _SideTask(loop=loop, quantity=quantity.name, upward=True)


def _loop_margins_of(
    loop: MeasuredLoop,
    growth: Growth,
    quantities: Sequence[VariedQuantity],
    searches: Sequence[tuple[_SideTask, many.Row]],
) -> LoopMargins:
    """Return the margins of a loop from its searches; one that failed is listed with its reason."""
    sides = {}
    failures = []
    for task, row in searches:
        if "side" in row:
            sides[task.quantity, task.upward] = row["side"]
        else:
            failures.append(f"{task.quantity}: {row['reason']}")
    return LoopMargins(
        name=loop.name,
        size=loop.size,
        growth=growth,
        margins=_margins(loop, quantities, sides),
        failures=tuple(failures),
    )


def _margins(
    loop: MeasuredLoop, quantities: Sequence[VariedQuantity], sides: Mapping[tuple[str, bool], MarginSide]
) -> dict[str, Margin]:
    """Return the margins of those quantities of which a side was found."""
    assembly = Assembly(loop.scenario)
    margins: dict[str, Margin] = {}
    for quantity in quantities:
        lower = sides.get((quantity.name, False))
        upper = sides.get((quantity.name, True))
        if lower is None and upper is None:
            continue
        nominal = quantity.nominal(assembly)
        margins[quantity.name] = Margin(quantity=quantity.name, nominal=nominal, lower=lower, upper=upper)
    return margins


def _map_values(margin: Margin) -> tuple[float, ...]:
    """Return the values of a map along one quantity."""
    quantity = VARIED[margin.quantity]
    low, high = quantity.ends(margin.nominal)
    if margin.lower is None:
        low = margin.nominal
    elif margin.lower.unstable is not None:
        low = max(_beyond(margin.lower, margin.nominal), low)
    if margin.upper is None:
        high = margin.nominal
    elif margin.upper.unstable is not None:
        high = min(_beyond(margin.upper, margin.nominal), high)
    return tuple(quantity.between(low, high, i / (MAP_POINTS - 1)) for i in range(MAP_POINTS))


def _beyond(side: MarginSide, nominal: float) -> float:
    """Return a value somewhat farther from the nominal one than a margin."""
    return nominal + _MAP_REACH * (side.stable - nominal)


def to_plain(margins: LoopMargins) -> dict[str, Any]:
    """Return the margins of a loop as plain data."""
    closest = margins.closest
    listed: dict[str, Any] = {}
    for name, margin in margins.margins.items():
        listed[name] = {
            "unit": VARIED[name].unit,
            "nominal": margin.nominal,
            "lower": None if margin.lower is None else asdict(margin.lower),
            "upper": None if margin.upper is None else asdict(margin.upper),
        }
    growth = asdict(margins.growth)
    for name in ("rate", "left"):
        if not math.isfinite(growth[name]):
            growth[name] = None
    return {
        "controller": margins.name,
        "size": margins.size,
        "growth": {**growth, "verdict": margins.growth.verdict},
        "margins": listed,
        "closest": None if closest is None else asdict(closest),
        "failures": list(margins.failures),
    }
