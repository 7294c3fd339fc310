"""Flights in space: their paths from above, clearances from obstacles and regions, and a scene that pages show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from quadsim.flight.audit import Limit, SpaceLimit
from quadsim.flight.record import FlightRecord
from quadsim.palette import COLOUR, line_colour
from quadsim.report.comparison import distinct_courses
from quadsim.report.figure import (
    Area,
    Bound,
    Panel,
    Scene,
    Series,
    extent,
    obstacles_in,
    outlines,
    region_edges,
)
from quadsim.report.flight_panels import REFERENCE_LOOK, flown_runs, run_curve
from quadsim.space import Obstacle
from quadsim.state import POSITION, Array

_NEAR_CLEARANCE: Final = 3.0
"""Clearance [m] below which a moving obstacle is drawn; upper limit of the curves."""
_OUTLINE_PERIOD: Final = 0.25  # time between the outlines of a moving obstacle [s]
_MOST_NAMED: Final = 9  # largest number of obstacles and regions named in the legend
_DIRECTIONS: Final = 300  # number of directions that sample the hull of a solid


def from_above(runs: Sequence[FlightRecord]) -> Panel:
    """Plot flights and their courses from above, with obstacles and the edges of regions."""
    areas = []
    lines = []
    ends = []
    for run in _first_with_limits(runs):
        for limit in run.limits:
            if isinstance(limit, SpaceLimit) and isinstance(limit.shape, Obstacle):
                areas += _obstacle_areas(limit, limit.shape, run)
        for _, edges in region_edges(run.limits, run.log):
            for edge in edges:
                lines.append(_region_edge(edge))
    for run in distinct_courses(runs):
        course = run.log.control.reference
        lines.append(Series(x=course[:, 0], y=course[:, 1], **REFERENCE_LOOK))
    for i, label, run in flown_runs(runs):
        position = run.log.plant.state[:, POSITION]
        colour = line_colour(i)
        lines.append(run_curve(i, label, position[:, 0], position[:, 1]))
        ends.append(_point(position[0], "start", colour, width=9.0))
        ends.append(_point(position[-1], "end", colour, width=5.0, marker="square"))
    return Panel(
        title="from above",
        x_label="x [m]",
        y_label="y [m]",
        equal=True,
        height=2.0,
        areas=tuple(areas),
        series=(*lines, *ends),
    )


def _first_with_limits(runs: Sequence[FlightRecord]) -> list[FlightRecord]:
    """Return the first of the runs with each set of limits."""
    first: dict[tuple[Limit, ...], FlightRecord] = {}
    for run in runs:
        first.setdefault(run.limits, run)
    return list(first.values())


def _obstacle_areas(limit: SpaceLimit, obstacle: Obstacle, run: FlightRecord) -> list[Area]:
    """From above, the outlines of an obstacle; of one that moves, all that the flight comes near, or its first."""
    instants = np.zeros(1)
    opacity = 0.55
    if obstacle.moves:
        opacity = 0.3
        t, clearance = limit.source.finest(run.log)
        near = t[clearance < _NEAR_CLEARANCE]
        if near.size:
            instants = np.arange(near[0], near[-1], _OUTLINE_PERIOD)
    areas = []
    for instant in instants:
        for outline in outlines(obstacle, instant):
            areas.append(Area(outline=outline, colour=COLOUR.obstacle, opacity=opacity, label="obstacle"))
    return areas


def _region_edge(edge: Array) -> Series:
    return Series(x=edge[:, 0], y=edge[:, 1], colour=COLOUR.bound, label="region", dashed=True, width=0.9)


def _point(place: Array, label: str, colour: str, **looks: Any) -> Series:
    return Series(x=place[:1], y=place[1:2], label=label, colour=colour, style="points", **looks)


def clearance_panel(run: FlightRecord) -> Panel:
    """Plot the distance to each obstacle and region while it is in force."""
    limits = [limit for limit in run.limits if isinstance(limit, SpaceLimit)]
    curves = []
    for i, limit in enumerate(limits):
        t, values = limit.source.finest(run.log)
        shown = np.where(limit.holds_at(t), values, np.nan)
        label = ""
        if len(limits) <= _MOST_NAMED:
            label = limit.name
        curves.append(Series(x=t, y=shown, colour=line_colour(i), label=label, width=1.0))
    low, high = extent([curve.y for curve in curves]) or (0.0, 0.0)
    return Panel(
        title="clearance",
        unit="m",
        series=tuple(curves),
        bounds=(Bound(value=0.0),),
        y_range=(min(0.0, low) - 0.1, min(high, _NEAR_CLEARANCE) + 0.1),
        legend=True,
        height=1.5,
    )


def path_scene(runs: Sequence[FlightRecord]) -> Scene:
    """Draw flights and courses in space, with obstacles at their start and the edges of regions."""
    solids = []
    paths = []
    directions = np.random.default_rng(0).normal(size=(_DIRECTIONS, 3))
    for run in _first_with_limits(runs):
        for obstacle in obstacles_in(run.limits):
            for solid in obstacle.solids:
                corners = np.unique(solid.support(directions).round(4), axis=0)
                solids.append((corners + obstacle.position, obstacle.name))
        for limit, edges in region_edges(run.limits, run.log):
            lines = np.insert(edges, 2, np.nan, axis=1).reshape(-1, 3)
            paths.append((lines, limit.name, COLOUR.bound, "", True))
    for run in distinct_courses(runs):
        paths.append((run.log.control.reference[:, :3], "reference", COLOUR.reference, "", True))
    for i, label, run in flown_runs(runs):
        paths.append((run.log.plant.state[:, POSITION], label, line_colour(i), f"run{i}", False))
    return Scene(key="path", title="path in space", paths=tuple(paths), solids=tuple(solids))
