"""A figure as plain data: panels of curves, bounds, bands and areas.

`quadsim.report.to_matplotlib` draws it for files and notebooks, `quadsim.report.to_plotly` for pages.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from quadsim.report.curves import least_range
from quadsim.state import Array


@dataclass(frozen=True, kw_only=True)
class Series:
    """Values y over x, both (K,); NaN is a gap."""

    x: Array
    y: Array
    colour: str
    style: Literal["line", "steps", "points", "bars"] = "line"  # steps are held until the next x; bars centred on x
    label: str = ""  # entry in the legend; series of the same label share one
    group: str = ""  # what a toggle of the page switches, e.g. `run0`
    dashed: bool = False
    width: float = 1.3  # of a line, or diameter of a marker [pt]
    marker: str = "circle"  # by plotly's name
    opacity: float = 1.0
    base: Array | None = None  # (K,) where bars begin, for stacked ones
    flights: Array | None = None  # (K,) number of the flight behind each point, which a page shows on hover


@dataclass(frozen=True, kw_only=True)
class Bound:
    """A bound at a value of y, from `start` to `stop` on the x axis; a vertical one is at a value of x, throughout."""

    value: float
    start: float = -np.inf
    stop: float = np.inf
    vertical: bool = False


@dataclass(frozen=True, kw_only=True)
class Band:
    """What lies between `low` and `high`, (K,) over x (K,)."""

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
class Panel:
    """Axes with what is drawn in them.

    An axis of a known unit has a least span, below which there is only rounding.
    """

    title: str  # what y is; beside the axis, or above the panel where `x_label` names its own horizontal axis
    unit: str = ""  # of y
    series: tuple[Series, ...] = ()
    bounds: tuple[Bound, ...] = ()
    bands: tuple[Band, ...] = ()
    areas: tuple[Area, ...] = ()
    x_label: str = ""
    y_label: str = ""
    y_log: bool = False
    y_range: tuple[float, float] | None = None  # ends of the axis; None fits it to what is drawn
    x_names: tuple[str, ...] = ()  # names of 0, 1, ... on the axis, in place of numbers
    equal: bool = False  # whether both axes have one scale
    whole: bool = False  # whether y counts things
    legend: bool = False  # whether the labels are explained in the panel, not in the legend of all panels
    height: float = 1.0  # of its row, relative to others

    @property
    def heading(self) -> str:
        """Title and unit."""
        unit = self.unit.replace(" ", "\u00a0")  # no line ends within it
        return f"{self.title} [{unit}]" if unit else self.title

    @property
    def least_range(self) -> tuple[float, float] | None:
        """Ends of y that curves and bounds which all stand still need; None where the axis fits itself."""
        curves = [series.y for series in self.series] + [np.array([bound.value]) for bound in self.bounds]
        return least_range([*curves, *(edge for band in self.bands for edge in (band.low, band.high))], self.unit)


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


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Paths and solids in space, which pages show."""

    key: str
    title: str
    paths: tuple[tuple[Array, str, str, str, bool], ...]  # (K, 3) [m], label, colour, group, dashed; NaN is a gap
    solids: tuple[tuple[Array, str], ...] = ()  # points (K, 3) [m] whose convex hull is a solid, and its name
