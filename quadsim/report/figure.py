"""A figure as plain data: panels of curves, bounds, bands, areas and labels.

`quadsim.report.to_matplotlib` draws it for files and notebooks, `quadsim.report.to_plotly` for pages.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from quadsim.flight.audit import SIGNALS, Limit, SpaceLimit
from quadsim.flight.log import ControlLog, FlightLog, PlantLog, columns_of
from quadsim.space import AnyObstacle, Obstacle, Region, footprint
from quadsim.state import POSITION, REFERENCE_NAMES, Array

LEAST_SPANS: Final = {"m": 0.01, "deg": 0.1, "m/s": 0.01, "deg/s": 0.1, "rad/s": 1.0}
"""Span of an axis, by unit, below which only rounding would be visible."""
_HALF_TURN: Final = 180.0


def least_range(curves: Sequence[Array], unit: str) -> tuple[float, float] | None:
    """Return the axis range for constant curves; None if the axis may fit itself to them, or has no least span.

    Numbers that are not finite do not count.
    """
    span = LEAST_SPANS.get(unit, 0.0)
    drawn = extent(curves)
    if drawn is None:
        return None
    low, high = drawn
    if high - low >= span:
        return None
    middle = 0.5 * (low + high)
    if abs(middle) < 1e-3 * span:
        middle = 0.0  # an axis about zero has round ticks
    return middle - 0.5 * span, middle + 0.5 * span


_START_SHARE: Final = 0.001  # share of its time that is a curve's start, its first sample at least
_LEAST_SPIKE: Final = 3.0  # how many times its later span a panel's span has to be, for a start to be left outside


def _after_start(x: Array, y: Array) -> Array:
    """Values y over x, both (K,), after their start."""
    if not x.size:
        return y
    start = x[0] + _START_SHARE * (x[-1] - x[0])
    return y[x > start]


def extent(curves: Sequence[Array]) -> tuple[float, float] | None:
    """Return the lowest and the highest finite value; None without any."""
    if not curves:
        return None
    values = np.concatenate([np.ravel(curve) for curve in curves])
    values = values[np.isfinite(values)]
    if values.size:
        return float(values.min()), float(values.max())
    return None


def reference_curve(log: ControlLog, name: str) -> Array:
    """(K,) filtered reference of x, y, z or yaw, in the unit of its signal."""
    values = log.reference[:, REFERENCE_NAMES.index(name)]
    if SIGNALS[name].unit == "deg":
        return np.degrees(values)
    return values


def bounds_of(limits: Iterable[Limit], signal: str, end: float) -> list[tuple[float, float, float]]:
    """Return each distinct bound on a signal, with its start and stop in a flight that ends at `end` [s]."""
    bounds: list[tuple[float, float, float]] = []
    for limit in limits:
        if limit.signal != signal or limit.start >= end:
            continue
        for value in (limit.lower, limit.upper):
            bound = (value, limit.start, min(limit.stop, end))
            if np.isfinite(value) and bound not in bounds:
                bounds.append(bound)
    return bounds


def break_at_wraps(t: Array, values: Array, unit: str) -> tuple[Array, Array]:
    """A curve with a gap wherever an angle in degrees jumps by more than half a turn, as roll does beyond 180 deg.

    Times [s] and values (K,) become (K + wraps,), with a NaN in each gap; values of another unit than `deg` never wrap.
    """
    after = np.empty(0, int)
    if unit == "deg":
        after = np.flatnonzero(np.abs(np.diff(values)) > _HALF_TURN) + 1
    middles = 0.5 * (t[after - 1] + t[after])
    return np.insert(t, after, middles), np.insert(values, after, np.nan)


_VISIBLE_SPEED: Final = 1e-3
"""Difference between commanded and acting rotor speeds above which both are drawn [rad/s]."""


@dataclass(frozen=True, kw_only=True)
class EffectCurves:
    """One quantity at the plant's instants, `values` (M, n), by `names`; `key` is a short name, e.g. `wind`."""

    key: str
    title: str
    unit: str
    values: Array
    names: tuple[str, ...] = ("x", "y", "z")


def effect_curves(log: FlightLog) -> list[EffectCurves]:
    """Return external force, torque, wind, voltage and charge, unless zero throughout."""
    plant = log.plant
    units: dict[str, str] = {}
    for column in columns_of(PlantLog).values():
        units.update(column.units)
    curves = []
    if plant.wrench is not None:
        force = plant.wrench[:, :3]
        torque = plant.wrench[:, 3:]
        curves.append(EffectCurves(key="force", title="external force, world", unit=units["force_x"], values=force))
        curves.append(EffectCurves(key="torque", title="external torque, body", unit=units["torque_x"], values=torque))
    if plant.wind is not None:
        curves.append(EffectCurves(key="wind", title="wind, world", unit=units["wind_x"], values=plant.wind))
    if plant.battery is not None:
        for name, column in zip(columns_of(PlantLog)["battery"].units, plant.battery.T, strict=True):
            title = f"battery {name}"
            values = column[:, None]
            curves.append(EffectCurves(key=name, title=title, unit=units[name], values=values, names=(name,)))
    return [curve for curve in curves if np.any(curve.values)]


def commanded_speeds(log: FlightLog) -> Array | None:
    """Return (M, 4) the commands in force at the plant's instants [rad/s]; None if the rotors always match them.

    They differ where rotors lag or saturate, and where commands take time to compute.
    """
    plant = log.plant
    control = log.control
    if not control.t.size:
        return None
    period = np.searchsorted(control.t, plant.t, side="right") - 1
    commanded: Array = control.speeds[period]
    if np.abs(commanded - plant.speeds).max() > _VISIBLE_SPEED:
        return commanded
    return None


@dataclass(frozen=True, kw_only=True)
class Series:
    """Values y over x, both (K,); NaN is a gap."""

    x: Array
    y: Array
    colour: str
    style: Literal["line", "steps", "points", "bars"] = "line"  # steps are held until the next x; bars centred on x
    label: str = ""  # entry in the legend; series of the same label share one
    group: str = ""  # toggled by the page, e.g. `run0`
    dashed: bool = False
    width: float = 1.3  # of a line, or diameter of a marker [pt]
    marker: str = "circle"  # by plotly's name
    opacity: float = 1.0
    base: Array | None = None  # (K,) where bars begin, for stacked ones
    flights: Array | None = None  # (K,) number of the flight behind each point, which a page shows on hover

    @property
    def bar_width(self) -> float:
        """The width of bars, in units of x: they touch where they are closest."""
        if self.x.size > 1:
            return float(np.diff(self.x).min())
        return 0.8


@dataclass(frozen=True, kw_only=True)
class Bound:
    """A bound at a value of y, from `start` to `stop` on the x axis; a vertical one is at a value of x, throughout."""

    value: float
    start: float = -np.inf
    stop: float = np.inf
    vertical: bool = False


@dataclass(frozen=True, kw_only=True)
class Band:
    """The area between `low` and `high`, (K,) over x (K,)."""

    x: Array
    low: Array
    high: Array
    colour: str
    label: str = ""
    opacity: float = 0.25


@dataclass(frozen=True, kw_only=True)
class Area:
    """A filled outline (n, 2)."""

    outline: Array
    colour: str
    label: str = ""
    opacity: float = 0.5


@dataclass(frozen=True, kw_only=True)
class Label:
    """A text centred on a point; without a colour it has that of the axes' texts."""

    x: float
    y: float
    text: str
    colour: str = ""
    bold: bool = False


@dataclass(frozen=True, kw_only=True)
class Panel:
    """Axes and their content.

    An axis of a known unit has a least span, below which there is only rounding.
    """

    title: str  # what y is; beside the axis, or above the panel where `x_label` names its own horizontal axis
    unit: str = ""  # of y
    series: tuple[Series, ...] = ()
    bounds: tuple[Bound, ...] = ()
    bands: tuple[Band, ...] = ()
    areas: tuple[Area, ...] = ()
    labels: tuple[Label, ...] = ()
    x_label: str = ""
    y_label: str = ""
    y_log: bool = False
    y_range: tuple[float, float] | None = None  # ends of the axis; None fits it to what is drawn
    x_names: tuple[str, ...] = ()  # names of 0, 1, ... on the axis, in place of numbers
    equal: bool = False  # whether both axes have one scale
    whole: bool = False  # whether y is a count
    legend: bool = False  # whether the labels are explained in the panel, not in the legend of all panels
    height: float = 1.0  # of its row, relative to others

    @property
    def heading(self) -> str:
        """Title and unit, and the value of a start outside the axis."""
        heading = self.title
        unit = self.unit.replace(" ", "\u00a0")  # no line break within it
        if unit:
            heading = f"{self.title} [{unit}]"
        if self.settled_range is None:
            return heading
        low, high = self.settled_range
        first, last = extent(self._curves()) or self.settled_range
        if last - high > low - first:
            peak = last
        else:
            peak = first
        return f"{heading}, {peak:.3g} at first"

    def _curves(self) -> list[Array]:
        """Return what is drawn over time."""
        curves = [series.y for series in self.series]
        for band in self.bands:
            curves += [band.low, band.high]
        return curves

    @property
    def settled_range(self) -> tuple[float, float] | None:
        """The range of y after the curves' starts, where a start would flatten all that follows; None elsewhere.

        A first command, or the iterations of a first solve without a warm start, may be far beyond all others.
        """
        is_timed = not (self.x_label or self.y_log or self.equal or self.y_range)
        if not is_timed or any(series.style == "bars" for series in self.series):
            return None
        bounds = np.array([bound.value for bound in self.bounds])
        later = [_after_start(series.x, series.y) for series in self.series]
        for band in self.bands:
            later += [_after_start(band.x, band.low), _after_start(band.x, band.high)]
        settled = extent([*later, bounds])
        whole = extent([*self._curves(), bounds])
        if settled is None or whole is None:
            return None
        low, high = settled
        span = max(high - low, LEAST_SPANS.get(self.unit, 0.0)) or max(abs(high), 1.0)
        if whole[1] - whole[0] <= _LEAST_SPIKE * span:
            return None
        middle = 0.5 * (low + high)
        return middle - 0.55 * span, middle + 0.55 * span

    @property
    def fixed_range(self) -> tuple[float, float] | None:
        """The range of y that is stated, or that leaves a start outside; None if the axis fits itself."""
        return self.y_range or self.settled_range

    @property
    def least_range(self) -> tuple[float, float] | None:
        """The range of y for constant curves and bounds; None if the axis fits itself."""
        bounds = np.array([bound.value for bound in self.bounds])
        return least_range([*self._curves(), bounds], self.unit)


@dataclass(frozen=True, kw_only=True)
class Figure:
    """Panels, row by row; `key` names its file and identifies it in a page.

    `end` is the last instant of the axis of time that all panels without an `x_label` share [s]; None without one.
    """

    key: str
    title: str
    panels: tuple[Panel, ...]
    columns: int = 2
    end: float | None = None

    @property
    def labels(self) -> dict[str, str]:
        """The colour of each label, in order."""
        drawn: list[Series | Band | Area] = []
        for panel in self.panels:
            drawn += [*panel.areas, *panel.bands, *panel.series]
        return {item.label: item.colour for item in drawn if item.label}

    @property
    def row_heights(self) -> list[float]:
        """The height of each row of panels, relative to others."""
        heights = []
        for first in range(0, len(self.panels), self.columns):
            row = self.panels[first : first + self.columns]
            heights.append(max(panel.height for panel in row))
        return heights


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Paths and solids in space, which pages show."""

    key: str
    title: str
    paths: tuple[tuple[Array, str, str, str, bool], ...]  # (K, 3) [m], label, colour, group, dashed; NaN is a gap
    solids: tuple[tuple[Array, str], ...] = ()  # points (K, 3) [m] whose convex hull is a solid, and its name


_AROUND: Final = 1.5  # distance beyond course and path up to which unbounded regions are drawn [m]
_FARTHEST: Final = 40.0
"""Distance from the middle of the course up to which a path is drawn [m]; lost vehicles go farther."""


def obstacles_in(limits: Iterable[Limit]) -> list[AnyObstacle]:
    """The obstacles among limits."""
    obstacles = []
    for limit in limits:
        if isinstance(limit, SpaceLimit) and isinstance(limit.shape, Obstacle):
            obstacles.append(limit.shape)
    return obstacles


def has_space(limits: Iterable[Limit]) -> bool:
    """Whether there are obstacles or regions among limits."""
    return any(isinstance(limit, SpaceLimit) for limit in limits)


def region_edges(limits: Iterable[Limit], log: FlightLog) -> Iterator[tuple[SpaceLimit, Array]]:
    """Each region with its edges (E, 2, 3) [m], cut off around course and path."""
    regions: list[tuple[SpaceLimit, Region]] = []
    for limit in limits:
        if isinstance(limit, SpaceLimit) and isinstance(limit.shape, Region):
            regions.append((limit, limit.shape))
    if not regions:
        return
    course = log.control.reference[:, :3]
    path = log.plant.state[:, POSITION]
    points = np.concatenate([course, path[np.isfinite(path).all(axis=1)]])
    middle = points[0]
    points = np.clip(points, middle - _FARTHEST, middle + _FARTHEST)
    lowest = points.min(axis=0) - _AROUND
    highest = points.max(axis=0) + _AROUND
    for limit, region in regions:
        yield limit, region.edges(lowest, highest)


def outlines(obstacle: Obstacle, t: float) -> list[Array]:
    """From above, each solid's outline (n, 2) [m] at a time."""
    place = obstacle.positions(np.array([t]))[0]
    return [place[:2] + footprint(solid) for solid in obstacle.solids]
