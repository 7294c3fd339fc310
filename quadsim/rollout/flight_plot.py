"""Signals of any number of flights over one another, as matplotlib axes or as a file for a paper."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from quadsim.console.results import Result, Shown
from quadsim.errors import InputError, ParameterError
from quadsim.flight.record import FlightRecord
from quadsim.report.comparison import check_names
from quadsim.report.flight_figures import signals as draw_signals
from quadsim.report.to_matplotlib import Style, draw, figure_file, show_window, shows_itself, write_figure

PAGE_WIDTH: Final = 7.16  # of a figure across both columns of a journal's page [in]; 3.5 is one column
_WIDTHS: Final = (2.0, 20.0)  # of a figure, smallest and largest [in]
_USUAL_SIGNALS: Final = ("x", "y", "z", "roll", "pitch", "yaw")


class Overlay(list[Any], Result):
    """The matplotlib axes of a plot, top to bottom; `axes[0].figure` is the figure."""

    path: Path | None = None  # the file, if one was written

    def show(self) -> None:
        """Print where the file is, or open the figure in a window.

        Raises:
            InputError: there is neither a file nor a display.
        """
        if self.path is not None:
            super().show()
        elif not show_window(self[0].figure):
            raise InputError("no display to show the plot on; write it to a file: --out plot.pdf")

    def _ipython_display_(self) -> None:
        """Print the axes, or where the file is; a notebook itself shows a figure of pyplot, once."""
        if self.path is not None:
            super().show()
        elif not shows_itself():
            print(list(self))

    def shown(self) -> Shown:
        """See `Result.shown`."""
        from quadsim.console import console

        if self.path is not None:
            yield console.written_to(self.path)
            yield console.to_open(self.path)

    def to_json(self) -> dict[str, Any]:
        """Return the path of the file and the axes' labels."""
        file = None
        if self.path is not None:
            file = str(self.path)
        panels = [axes.get_ylabel().replace("\n", " ") for axes in self]
        return {"file": file, "panels": panels}


def plot_runs(
    runs: Sequence[FlightRecord],
    signals: Sequence[str],
    *,
    labels: Sequence[str] = (),
    width: float = PAGE_WIDTH,
    out: Path | str | None = None,
    overwrite: bool = False,
    style: Style = None,
) -> Overlay:
    """Overlay runs; arguments and errors as `quadsim.commands.app.plot`."""
    if not runs:
        raise InputError("plot needs one or more flights")
    check_names(labels, len(runs), "labels")
    if not _WIDTHS[0] <= width <= _WIDTHS[1]:
        raise ParameterError("", "width", width, "{:g} to {:g} in".format(*_WIDTHS))
    if labels:
        runs = [run.labelled(label) for run, label in zip(runs, labels, strict=True)]
    if out is not None:
        out = figure_file(out, overwrite=overwrite)
    figure = draw_signals(runs, signals or _USUAL_SIGNALS)
    if out is None:
        return Overlay(draw(figure, interactive=True, width=width, style=style).axes)
    plot = Overlay(write_figure(figure, out, width=width, overwrite=overwrite, style=style))
    plot.path = out
    return plot
