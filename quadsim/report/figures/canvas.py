"""What all figures share: their style, and how they are saved."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from quadsim.errors import OutputError
from quadsim.flight.rundir import Run
from quadsim.report.curves import least_range

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.typing import RcKeyType

DPI: Final = 160
STYLE: Final[dict[RcKeyType, Any]] = {
    "axes.axisbelow": True,
    "axes.edgecolor": "#5b6067",
    "axes.grid": True,
    "axes.labelsize": 9.5,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "font.size": 9.0,
    "grid.color": "#e3e5e8",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "lines.linewidth": 1.3,
    "path.simplify_threshold": 0.2,
    "svg.fonttype": "none",
    "svg.hashsalt": "quadsim",
    "text.parse_math": False,
    "xtick.color": "#5b6067",
    "xtick.labelcolor": "#1c1e21",
    "ytick.color": "#5b6067",
    "ytick.labelcolor": "#1c1e21",
}


def write_drawings(drawings: Mapping[str, Callable[[], Figure]], directory: Path) -> list[Path]:
    """Draw figures, each in the style of all, and save them by their names as PNG and SVG; the files written.

    Raises:
        OutputError: the directory, one that is being made, cannot be written, or holds a file of that name.
    """
    import matplotlib

    paths = []
    options: dict[str, dict[str, Any]] = {"png": {"dpi": DPI}, "svg": {"metadata": {"Date": None}}}
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with matplotlib.rc_context(STYLE):
            for name, draw in drawings.items():
                figure = draw()
                if (layout := figure.get_layout_engine()) is not None:
                    layout.execute(figure)  # once for both files, neither of which is then drawn for it
                figure.set_layout_engine(None)
                for form, option in options.items():
                    paths.append(directory / f"{name}.{form}")
                    with paths[-1].open("xb") as file:
                        figure.savefig(file, format=form, **option)
    except OSError as error:
        raise OutputError(directory, error.strerror or str(error)) from error
    return paths


def new_figure(title: str, width: float, height: float) -> Figure:
    """An empty figure of so many inches, its title in the corner."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=11.0, fontweight="bold")
    return figure


def run_title(run: Run, what: str) -> str:
    """Title of a figure of one run."""
    ended = "" if run.log.reason is None else " (aborted)"
    return f"{run.name}{ended}: {what}"


def keep_least_span(axes: Axes, unit: str) -> None:
    """Widen the vertical axis of a panel whose curves and bounds all stand still; see `quadsim.report.curves`."""
    curves = [np.asarray(line.get_ydata(), float) for line in axes.get_lines()]
    curves += [np.asarray(axes.dataLim.intervaly)] if axes.collections else []
    ends = least_range(curves, unit)
    if ends is not None:
        axes.set_ylim(*ends)


def finish_figure(figure: Figure, bottom: Sequence[Axes], shown: Mapping[str, Artist], end: float) -> Figure:
    """The figure with its time axes labelled, and the legend above all panels, where it hides nothing."""
    for axes in bottom:
        axes.set_xlabel("time [s]")
        axes.set_xlim(-0.008 * end, end or 1.0)  # a peak in the first period stands clear of the axis
    figure.align_ylabels()
    if shown:
        figure.legend(list(shown.values()), list(shown), loc="outside upper right", ncols=len(shown))
    return figure
