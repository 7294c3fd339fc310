"""How the figures of `quadsim bench` are styled and saved."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from quadsim.errors import OutputError

if TYPE_CHECKING:
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
