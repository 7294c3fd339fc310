"""A study of what constraints cost -> the curves that a page and a figure draw alike."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from quadsim.controller import UNCONSTRAINED
from quadsim.state import Array, read_only
from scenarios.cost.cost_tables import slowest
from scenarios.cost.study import CostStudy, Outcome, Sweep


@dataclass(frozen=True, kw_only=True)
class Curve:
    """A line through points; NaN where there is no value."""

    label: str  # its name
    x: Array  # (m,) of the points
    y: Array  # (m,) of the points
    colour: int  # its place in the palette
    dashed: bool = False  # whether it shows the flight without constraints


@dataclass(frozen=True, kw_only=True)
class Panel:
    """Curves over one pair of axes."""

    label: str  # of the vertical axis
    curves: tuple[Curve, ...]  # what is drawn
    logarithmic: bool = False  # whether the vertical axis is
    never: tuple[float, ...] = ()  # x of the flights whose value is beyond all bounds: marked at the top


def step_curves(study: CostStudy) -> list[Curve]:
    """Share of the periods [%] that each candidate answers within a time [ms]."""
    share = 100.0 * np.arange(1, len(study.candidates[0].step_ms) + 1) / len(study.candidates[0].step_ms)
    return [
        Curve(label=candidate.name, x=read_only(np.sort(candidate.step_ms)), y=share, colour=i)
        for i, candidate in enumerate(study.candidates)
    ]


def sweep_panels(study: CostStudy, sweep: Sweep) -> list[Panel]:
    """How tracking, settling, commands, tilt, activity and computation move with what is swept."""
    x = np.array([point.value for point in sweep.points], float)
    free = [study.unconstrained if point.unconstrained is None else point.unconstrained for point in sweep.points]
    flown = [point.constrained for point in sweep.points]

    def pair(label: str, of: Callable[[Outcome], float | None], colour: int) -> tuple[Curve, Curve]:
        return (
            Curve(label=label, x=x, y=_values(map(of, flown)), colour=colour),
            Curve(label=f"{label}, without", x=x, y=_values(map(of, free)), colour=colour, dashed=True),
        )

    def measured(key: str, colour: int, label: str) -> tuple[Curve, Curve]:
        return pair(label, lambda outcome: outcome.number(key), colour)

    def timed(key: str, colour: int) -> Curve:
        values = _values(point.step_ms.get(key) for point in sweep.points)
        return Curve(label=key, x=x, y=values, colour=colour)

    def share(label: str, of: Callable[[Outcome], int], colour: int) -> Curve:
        values = _values(100.0 * of(outcome) / outcome.periods if outcome.completed else None for outcome in flown)
        return Curve(label=label, x=x, y=values, colour=colour)

    errors = [curve for i, axis in enumerate("xyz") for curve in measured(f"rmse_{axis}", i, axis)]
    return [
        Panel(label="RMS error [m]", curves=tuple(errors), logarithmic=True),
        Panel(
            label="slowest settling [s]",
            curves=pair("settling", slowest, 0),
            never=tuple(p.value for p in sweep.points if p.constrained.completed and slowest(p.constrained) is None),
        ),
        Panel(label="peak tilt [deg]", curves=measured("tilt_plant", 0, "tilt"), logarithmic=True),
        Panel(label="total variation [rad/s]", curves=measured("total_variation", 0, "total variation")),
        Panel(
            label="periods [%]",
            curves=(
                share("active", lambda outcome: outcome.active, 3),
                share("no QP", lambda outcome: outcome.statuses.get(UNCONSTRAINED, 0), 4),
            ),
        ),
        Panel(label="step [ms]", curves=(timed("p50", 4), timed("p99", 3)), logarithmic=True),
    ]


def lost_at(sweep: Sweep) -> tuple[list[float], list[float]]:
    """The values at which the vehicle is lost: with constraints, and without."""
    with_them = [point.value for point in sweep.points if not point.constrained.completed]
    return with_them, [p.value for p in sweep.points if p.unconstrained and not p.unconstrained.completed]


def _values(values: Iterable[float | None]) -> Array:
    return read_only(np.array([np.nan if value is None else value for value in values], float))
