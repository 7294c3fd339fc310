"""The figures of an identified vehicle: intervals, measured against predicted, errors over the horizon."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

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
from quadsim.state import shown_unit

_COLOURS: Final = dict(zip((IDENTIFIED, RATES_HELD, START, NO_DISTURBANCE, RATES_DECAY), CYCLE, strict=False)) | {
    NOISE_FLOOR: COLOUR.measured
}
_TRACED: Final = tuple(
    (i, title, *shown_unit(si))
    for axis, (velocity, rate) in enumerate(zip("xyz", ("roll", "pitch", "yaw"), strict=True))
    for i, title, si in ((axis, f"v{velocity}, world", "m/s"), (3 + axis, f"{rate} rate", "rad/s"))
)
"""Place, title, unit and scale of what is drawn, velocities in the left column."""


def interval_figure(estimates: Sequence[ParameterEstimate]) -> Figure:
    """Return each parameter's interval and start in percent of its value; those that a gate refuses are grey."""
    drawn = [estimate for estimate in estimates if estimate.in_file]
    series = []
    for refused, colour, label in (
        (False, _COLOURS[IDENTIFIED], "95 % interval"),
        (True, COLOUR.measured, "refused by a gate"),
    ):
        at = [(i, e) for i, e in enumerate(drawn) if bool(e.refused) is refused]
        x = np.ravel([[i, i, np.nan] for i, _ in at])
        y = np.ravel([[_percent(e.low, e), _percent(e.high, e), np.nan] for _, e in at])
        series += [Series(x=x, y=y, colour=colour, label=label, width=5.0)] if at else []
    series += [
        Series(
            x=np.arange(float(len(drawn))),
            y=np.zeros(len(drawn)),
            colour=_COLOURS[IDENTIFIED],
            style="points",
            width=4.0,
        )
    ]
    start = Series(
        x=np.arange(float(len(drawn))),
        y=np.array([np.nan if e.start is None else _percent(e.start, e) for e in drawn]),
        colour=_COLOURS[START],
        label=START,
        style="points",
        marker="diamond",
        width=6.0,
    )
    sure = []
    for e in drawn:
        if not e.refused:
            for end in (e.low, e.high, e.start or e.value):
                sure.append(_percent(end, e))
    reach = 1.2 * min(max(np.abs([1.0, *sure])), 100.0)
    panel = Panel(
        title="relative to the estimate",
        unit="%",
        series=(*series, start),
        y_range=(-reach, reach),
        x_names=tuple(estimate.name for estimate in drawn),
        height=1.3,
    )
    return Figure(key="intervals", title="intervals", panels=(panel,), columns=1)


def _percent(value: float, estimate: ParameterEstimate) -> float:
    return 100.0 * (value / estimate.value - 1.0)


def trace_figure(trace: Trace, models: Sequence[str] = (IDENTIFIED, RATES_HELD)) -> Figure:
    """Return velocity and body rates, measured and as predicted from each window's start."""
    t = trace.t - trace.t[0, 0]
    gap = np.full((len(t), 1), np.nan)
    panels = []
    for i, title, unit, scale in _TRACED:
        predicted = (
            Series(
                x=np.hstack([t, t[:, -1:]]).ravel(), y=np.hstack([scale * trace.predicted[name][..., i], gap]).ravel(),
                colour=_COLOURS[name], label=f"predicted, {name}",
            )
            for name in models
        )  # fmt: skip
        measured = Series(
            x=t.ravel(), y=scale * trace.measured[..., i].ravel(), colour=COLOUR.measured, label="measured", width=2.4
        )
        panels.append(Panel(title=title, unit=unit, series=(measured, *reversed([*predicted]))))
    title = f"measured and predicted: {trace.log} from {trace.t[0, 0]:.4g} s on, a prediction every {t[0, -1]:.2g} s"
    return Figure(key="trace", title=title, panels=tuple(panels), end=float(t[-1, -1]))


def horizon_figure(prediction: PredictionErrors) -> Figure:
    """Return the mean errors over the horizon."""
    x = np.array((0.0, *HORIZONS))
    panels = []
    for j, (quantity, si) in enumerate(QUANTITIES.items()):
        unit, scale = shown_unit(si)
        series = tuple(
            Series(x=x, y=np.insert(scale * errors[:, j], 0, 0.0), colour=_COLOURS[name], label=name)
            for name, errors in prediction.errors.items()
            if np.isfinite(errors[:, j]).all()
        )
        panels += [Panel(title=quantity, unit=unit, x_label="horizon [s]", series=series)] if series else []
    return Figure(key="horizon", title="mean error over the horizon", panels=tuple(panels))


def residual_figure(prediction: PredictionErrors) -> Figure:
    """Return what is left of velocity and body rates, axis by axis, of the identified vehicle and with rates held."""
    panels = []
    for i, title, unit, scale in _TRACED:
        series = []
        for name in (RATES_HELD, IDENTIFIED):
            left = scale * prediction.residuals[name][:, i]
            series.append(
                Series(x=prediction.ends, y=left, colour=_COLOURS[name], label=name, style="points", width=3.0)
            )
        title += f": RMS {float(np.sqrt(np.square(left).mean())):.2g}"  # of the identified vehicle
        panels.append(Panel(title=title, unit=unit, x_label="held-out flight [s]", series=tuple(series), height=0.7))
    title = f"measured less predicted after {RESIDUAL_AFTER:g} s; RMS of the identified vehicle"
    return Figure(key="residuals", title=title, panels=tuple(panels))
