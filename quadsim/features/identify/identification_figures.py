"""The figures of an identified vehicle: intervals, measured against predicted, residuals, errors over the horizon.

`report` puts them on its page.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from quadsim.features.identify.estimate import ParameterEstimate
from quadsim.features.identify.prediction import (
    HORIZONS,
    IDENTIFIED,
    NO_DISTURBANCE,
    NOISE_FLOOR,
    QUANTITIES,
    RATES_DECAY,
    RATES_HELD,
    RESIDUAL_AFTER,
    START,
    PredictionErrors,
    Trace,
)
from quadsim.palette import COLOUR, CYCLE
from quadsim.report.figure import Figure, Panel, Series
from quadsim.state import Array, shown_unit

_COLOURS: Final = {
    IDENTIFIED: CYCLE[0],
    RATES_HELD: CYCLE[1],
    START: CYCLE[2],
    NO_DISTURBANCE: CYCLE[3],
    RATES_DECAY: CYCLE[4],
    NOISE_FLOOR: COLOUR.measured,
}


class _Signal(NamedTuple):
    """A component of velocity or body rates that is drawn."""

    place: int  # among velocity and body rates
    title: str
    unit: str
    scale: float  # from SI units


def _signal(place: int, title: str, si: str) -> _Signal:
    return _Signal(place, title, *shown_unit(si))


_SIGNALS: Final = (
    _signal(0, "vx, world", "m/s"),
    _signal(3, "roll rate", "rad/s"),
    _signal(1, "vy, world", "m/s"),
    _signal(4, "pitch rate", "rad/s"),
    _signal(2, "vz, world", "m/s"),
    _signal(5, "yaw rate", "rad/s"),
)
"""What is drawn, velocities in the left column."""


def interval_figure(estimates: Sequence[ParameterEstimate]) -> Figure:
    """Return each parameter's interval and start in percent of its value; those that a gate refuses are grey."""
    drawn = [estimate for estimate in estimates if estimate.in_file]
    names = tuple(estimate.name for estimate in drawn)
    places = np.arange(float(len(drawn)))
    colour = _COLOURS[IDENTIFIED]
    values = Series(x=places, y=np.zeros(len(drawn)), colour=colour, style="points", width=4.0)
    panel = Panel(
        title="relative to the estimate",
        unit="%",
        series=(
            *_interval_series(drawn, colour, "95 % interval", refused=False),
            *_interval_series(drawn, COLOUR.measured, "refused by a gate", refused=True),
            values,
            _start_series(drawn, places),
        ),
        y_range=_reach(drawn),
        x_names=names,
        height=1.3,
    )
    return Figure(key="intervals", title="intervals", panels=(panel,), columns=1)


def _interval_series(drawn: Sequence[ParameterEstimate], colour: str, label: str, *, refused: bool) -> list[Series]:
    """A line from end to end of each interval of those that are refused, or of the others; none without any."""
    x = []
    y = []
    for place, estimate in enumerate(drawn):
        if bool(estimate.refused) is refused:
            x += [place, place, np.nan]
            y += [_percent(estimate.low, estimate), _percent(estimate.high, estimate), np.nan]
    if not x:
        return []
    return [Series(x=np.array(x), y=np.array(y), colour=colour, label=label, width=5.0)]


def _start_series(drawn: Sequence[ParameterEstimate], places: Array) -> Series:
    """The start's numbers, where it has any."""
    y = np.full(len(drawn), np.nan)
    for place, estimate in enumerate(drawn):
        if estimate.start is not None:
            y[place] = _percent(estimate.start, estimate)
    return Series(x=places, y=y, colour=_COLOURS[START], label=START, style="points", marker="diamond", width=6.0)


def _reach(drawn: Sequence[ParameterEstimate]) -> tuple[float, float]:
    """Percent either way within which the identified intervals and their starts are, 100 at most, and a margin."""
    shown = [1.0]
    for estimate in drawn:
        if not estimate.refused:
            for value in (estimate.low, estimate.high, estimate.start or estimate.value):
                shown.append(_percent(value, estimate))
    reach = 1.2 * min(max(np.abs(shown)), 100.0)
    return -reach, reach


def _percent(value: float, estimate: ParameterEstimate) -> float:
    return 100.0 * (value / estimate.value - 1.0)


def trace_figure(trace: Trace, models: Sequence[str] = (IDENTIFIED, RATES_HELD)) -> Figure:
    """Return velocity and body rates, measured and as predicted from each window's start."""
    t = trace.t - trace.t[0, 0]
    t_with_gaps = np.hstack([t, t[:, -1:]]).ravel()
    gap = np.full((len(t), 1), np.nan)
    panels = []
    for place, title, unit, scale in _SIGNALS:
        measured = scale * trace.measured[..., place].ravel()
        series = [Series(x=t.ravel(), y=measured, colour=COLOUR.measured, label="measured", width=2.4)]
        for name in reversed(models):  # the first is drawn last, above the others
            predicted = np.hstack([scale * trace.predicted[name][..., place], gap]).ravel()
            series.append(Series(x=t_with_gaps, y=predicted, colour=_COLOURS[name], label=f"predicted, {name}"))
        panels.append(Panel(title=title, unit=unit, series=tuple(series)))
    title = f"measured and predicted: {trace.log} from {trace.t[0, 0]:.4g} s on, a prediction every {t[0, -1]:.2g} s"
    return Figure(key="trace", title=title, panels=tuple(panels), end=float(t[-1, -1]))


def horizon_figure(prediction: PredictionErrors) -> Figure:
    """Return the mean errors over the horizon."""
    x = np.array((0.0, *HORIZONS))
    panels = []
    for j, (quantity, si) in enumerate(QUANTITIES.items()):
        unit, scale = shown_unit(si)
        series = []
        for name, errors in prediction.errors.items():
            if np.isfinite(errors[:, j]).all():
                y = np.insert(scale * errors[:, j], 0, 0.0)
                series.append(Series(x=x, y=y, colour=_COLOURS[name], label=name))
        if series:
            panels.append(Panel(title=quantity, unit=unit, x_label="horizon [s]", series=tuple(series)))
    return Figure(key="horizon", title="mean error over the horizon", panels=tuple(panels))


def residual_figure(prediction: PredictionErrors) -> Figure:
    """Return what is left of velocity and body rates, axis by axis, of the identified vehicle and with rates held."""
    panels = []
    for place, title, unit, scale in _SIGNALS:
        series = []
        for name in (RATES_HELD, IDENTIFIED):
            y = scale * prediction.residuals[name][:, place]
            series.append(Series(x=prediction.ends, y=y, colour=_COLOURS[name], label=name, style="points", width=3.0))
        of_identified = scale * prediction.residuals[IDENTIFIED][:, place]
        rms = float(np.sqrt(np.square(of_identified).mean()))
        panels.append(
            Panel(
                title=f"{title}: RMS {rms:.2g}",
                unit=unit,
                x_label="held-out flight [s]",
                series=tuple(series),
                height=0.7,
            )
        )
    title = f"measured less predicted after {RESIDUAL_AFTER:g} s; RMS of the identified vehicle"
    return Figure(key="residuals", title=title, panels=tuple(panels))
