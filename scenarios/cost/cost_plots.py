"""A study of what constraints cost -> its plots."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING, Final

import numpy as np

from quadsim.report.palette import BOUND, REFERENCE, line_colour
from quadsim.report.plots.panels import BOTTOM, PANEL_HEIGHT, TOP, Plot, finished, panels, place
from scenarios.cost.cost_curves import Curve, Panel, lost_at, step_curves, sweep_panels
from scenarios.cost.study import CostStudy, Sweep

if TYPE_CHECKING:
    from plotly.graph_objects import Figure, Scatter

_LOG_TICKS: Final = [float(f"{digit}e{power}") for power in range(-4, 6) for digit in (1, 2, 5)]


def cost_plots(study: CostStudy) -> list[Plot]:
    """Step times of all candidates, and both sweeps."""
    sweeps = [
        _sweep(study, study.tilt, "cost-tilt", "Over the bound on roll and pitch"),
        _sweep(study, study.horizons, "cost-horizon", "Over the horizon"),
    ]
    return [_steps(study), *sweeps] if study.candidates else sweeps


def _steps(study: CostStudy) -> Plot:
    from plotly.graph_objects import Figure

    curves = step_curves(study)
    figure = Figure([_line(curve) for curve in curves])
    figure.add_vline(study.deadline_ms, line={"color": BOUND, "width": 1.4, "dash": "dash"})
    ends = [np.log10(time) for time in (0.8 * min(curve.x[0] for curve in curves), 1.5 * study.deadline_ms)]
    figure.update_xaxes(range=[ends[0], max(ends[1], np.log10(1.1 * max(curve.x[-1] for curve in curves)))])
    figure.update_xaxes(type="log", title={"text": "time of a whole controller step [ms]", "standoff": 6}, dtick=1)
    figure.update_yaxes(title={"text": "periods answered by then [%]"}, range=[-2, 102])
    figure.update_layout(margin={"l": 60, "r": 12, "t": TOP, "b": BOTTOM})
    title = "Time to compute a command, by what computes it"
    keys = tuple((curve.label, line_colour(curve.colour)) for curve in curves)
    return finished(figure, "cost-steps", title, height=380, timed=False, keys=keys)


def _sweep(study: CostStudy, sweep: Sweep, key: str, title: str) -> Plot:
    drawn = sweep_panels(study, sweep)
    figure = panels([_title(panel) for panel in drawn])
    rows = -(-len(drawn) // 2)
    for i, panel in enumerate(drawn):
        for curve in panel.curves:
            figure.add_trace(_line(curve, mode="lines+markers"), **place(i))
        if panel.logarithmic:
            figure.update_yaxes(type="log", tickvals=_LOG_TICKS, tickformat="~g", **place(i))
    if sweep.base is not None:
        figure.add_vline(sweep.base, line={"color": REFERENCE, "width": 1.0, "dash": "dot"})
    figure.update_xaxes(showticklabels=True)
    figure.update_xaxes(title={"text": f"{sweep.name} [{sweep.unit}]", "standoff": 6}, row=rows)
    figure.update_annotations(font={"size": 13})
    for i, panel in enumerate(drawn):
        _marks(figure, i, sweep, panel)
    figure.update_layout(margin={"l": 52, "r": 12, "t": TOP, "b": BOTTOM}, hovermode="x unified")
    return finished(figure, key, title, height=rows * PANEL_HEIGHT + TOP + BOTTOM, timed=False)


def _line(curve: Curve, mode: str = "lines") -> Scatter:
    from plotly.graph_objects import Scatter

    colour = line_colour(curve.colour)
    return Scatter(
        x=curve.x.astype(np.float32),
        y=curve.y.astype(np.float32),
        mode=mode,
        name=html.escape(curve.label),
        line={"color": colour, "width": 1.6, "dash": "dash" if curve.dashed else "solid"},
        marker={"color": colour, "size": 5},
    )


def _marks(figure: Figure, i: int, sweep: Sweep, panel: Panel) -> None:
    """Crosses at the foot of a panel where the vehicle is lost, and what never settles at its head."""
    with_them, without = lost_at(sweep)
    free = without if any(curve.dashed for curve in panel.curves) else []
    number = "" if i == 0 else str(i + 1)
    for colour, values, text, y, anchor in (
        (REFERENCE, free, "x", 0.0, "bottom"),
        (BOUND, with_them, "x", 0.0, "bottom"),
        (BOUND, panel.never, "▲", 1.0, "top"),
    ):
        font = {"color": colour, "size": 12}
        where = {"xref": f"x{number}", "yref": f"y{number} domain", "y": y, "yanchor": anchor}
        for value in values:
            figure.add_annotation(x=value, text=text, showarrow=False, font=font, **where)


def _title(panel: Panel) -> str:
    """The panel's label, and the names of its solid curves where there are several."""
    names = [
        f'<span style="color:{line_colour(curve.colour)}">{html.escape(curve.label)}</span>'
        for curve in panel.curves
        if not curve.dashed
    ]
    return f"{panel.label}: {', '.join(names)}" if len(names) > 1 else panel.label
