"""Tracking error and violated bounds over speed: the figure of `scenarios.bench.speed`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from quadsim.report.figures.canvas import new_figure
from quadsim.report.palette import LINES, REFERENCE
from scenarios.bench.speed import LAWS, SpeedBench

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TOP = 40.0  # of the errors' axis [m], with room for the crosses above all errors


def draw_speeds(measured: SpeedBench) -> Figure:
    """Error and share of violation over speed, a column of panels for each world."""
    from matplotlib.lines import Line2D

    figure = new_figure("Tracking error and violated bounds over speed", 3.1 * len(measured.worlds) + 0.6, 6.4)
    panels = figure.subplots(2, len(measured.worlds), sharex="col", sharey="row", squeeze=False)
    styles: dict[str, Any] = {
        law: {"color": (*LINES, REFERENCE, "#1c1e21")[i], "linestyle": "--" if LAWS[law].linear else "-"}
        for i, law in enumerate(LAWS)
    }
    for (world, speeds), (errors, violations) in zip(measured.worlds.items(), panels.T, strict=True):
        errors.set_title(world, loc="left", fontsize=9.5)
        errors.set_yscale("log")
        errors.yaxis.set_major_formatter("{x:g}")
        for law in measured.laws:
            flights = [measured.flights[world, speed, law] for speed in speeds]
            style = {**styles[law], "marker": "o", "markersize": 3.0}
            whole = np.array([math.nan if flight.error is None else flight.error for flight in flights])
            errors.errorbar(speeds, whole, yerr=[flight.half or 0.0 for flight in flights], **style)
            violations.plot(speeds, [100.0 * flight.violated for flight in flights], **style)
            lost = [speed for speed, flight in zip(speeds, flights, strict=True) if flight.error is None]
            row = 0.98 - 0.02 * measured.laws.index(law)
            at_top = {"color": styles[law]["color"], "transform": errors.get_xaxis_transform()}
            errors.plot(lost, [row] * len(lost), "x", markersize=5.0, **at_top)
        violations.set_xlabel("speed [m/s]")
    panels[0, 0].set_ylim(top=_TOP)
    panels[0, 0].set_ylabel("mean position error [m]; x: lost")
    panels[1, 0].set_ylabel("time beyond the tilt bound [%]")
    keys = [Line2D([], [], **styles[law]) for law in measured.laws]
    figure.legend(keys, list(measured.laws), loc="outside lower center", ncols=len(measured.laws))
    return figure
