"""The scene of a flight: obstacles and regions, as reports draw them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from quadsim.flight.audit import Limit, SpaceLimit
from quadsim.flight.rundir import Run
from quadsim.space import AnyObstacle, Obstacle, Region, footprint
from quadsim.state import POSITION, Array

_ROUND: float = 1.5  # how far beyond course and path regions without an end are drawn [m]
_LONG: float = 40.0  # how far a path is followed from the middle of the course [m]: a lost vehicle leaves the picture


def obstacles_in(limits: Iterable[Limit]) -> list[AnyObstacle]:
    """The obstacles among limits."""
    return [limit.shape for limit in limits if isinstance(limit, SpaceLimit) and isinstance(limit.shape, Obstacle)]


def has_space(limits: Iterable[Limit]) -> bool:
    """Whether there are obstacles or regions among limits."""
    return any(isinstance(limit, SpaceLimit) for limit in limits)


def region_edges(run: Run) -> Iterator[tuple[SpaceLimit, Array]]:
    """Each region with its edges (E, 2, 3) [m], cut off around course and path."""
    regions = [limit for limit in run.limits if isinstance(limit, SpaceLimit) and isinstance(limit.shape, Region)]
    if not regions:
        return
    course = run.log.control.reference[:, :3]
    path = run.log.plant.state[:, POSITION]
    points = np.concatenate([course, path[np.isfinite(path).all(axis=1)]])
    middle = points[0]
    points = np.clip(points, middle - _LONG, middle + _LONG)
    for limit in regions:
        assert isinstance(limit.shape, Region)
        yield limit, limit.shape.edges(points.min(axis=0) - _ROUND, points.max(axis=0) + _ROUND)


def outlines(obstacle: Obstacle, t: float) -> list[Array]:
    """From above, each solid's outline (n, 2) [m] at a time."""
    place = obstacle.positions(np.array([t]))[0]
    return [place[:2] + footprint(solid) for solid in obstacle.solids]
