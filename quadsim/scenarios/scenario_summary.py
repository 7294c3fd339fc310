"""A scenario as a notebook shows it: what flies, where, by which controller, and the course over time."""

from __future__ import annotations

from html import escape

import numpy as np

from quadsim.console.results import plot_html
from quadsim.errors import InputError
from quadsim.palette import COLOUR
from quadsim.report.figure import Figure, Panel, Series
from quadsim.scenarios.loading import assemble
from quadsim.scenarios.schema.scenario import Scenario


def scenario_html(scenario: Scenario) -> str:
    """Return a scenario as notebooks show it: its parts, and its course over time or why it cannot be built.

    Args:
        scenario: the scenario.

    Examples:
        >>> import quadsim
        >>> "<th>vehicle</th><td>lopes2011</td>" in quadsim.scenario_html(quadsim.load("hover"))
        True
    """
    controller = scenario.controller
    bounds = []
    for name, (low, high) in controller.output_bounds.items():
        bounds.append(f"{name} {low:g} to {high:g}")
    rows = {
        "duration": f"{scenario.duration:g} s, {scenario.periods} periods of {scenario.control_period:g} s",
        "vehicle": str(scenario.vehicle.file),
        "course": scenario.reference.type,
        "controller": f"{controller.type}, horizon {controller.horizon}",
        "output bounds": ", ".join(bounds),
        "audited": ", ".join(scenario.audited_names),
    }
    table = ""
    for name, text in rows.items():
        if text:
            table += f"<tr><th>{name}</th><td>{escape(text)}</td></tr>"
    head = f"<p><b>{escape(scenario.name)}</b>: {escape(scenario.description)}</p><table>{table}</table>"
    try:
        figure = course_figure(scenario)
    except InputError as error:
        return f"{head}<p>{escape(str(error))}</p>"
    return head + plot_html(figure)


def course_figure(scenario: Scenario) -> Figure:
    """The filtered reference of x, y and z over time."""
    reference = assemble(scenario).reference(scenario.periods)
    t = scenario.control_period * np.arange(len(reference), dtype=np.float64)
    panels = []
    for name, column in zip("xyz", reference.T[:3], strict=True):
        curve = Series(x=t, y=column, colour=COLOUR.reference, label="reference, filtered")
        panels.append(Panel(title=name, unit="m", series=(curve,)))
    return Figure(key="course", title="", panels=tuple(panels), columns=1, end=scenario.duration)
