"""Figures as PNG and in notebooks, by matplotlib; the same numbers give the same bytes in one installation."""

from __future__ import annotations

import contextlib
import io
import logging
import re
import textwrap
from base64 import b64encode
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from quadsim.errors import OutputError, ParameterError
from quadsim.outputs import require_file, writing_file
from quadsim.palette import COLOUR
from quadsim.report.figure import Bound, Figure, Label, Panel, Series
from quadsim.state import Array

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas
    from matplotlib.typing import RcKeyType

Style: TypeAlias = "Mapping[str, Any] | str | Path | None"
"""What a user's figure has besides: matplotlib's rcParams, or a style sheet by its name or file."""
DPI: Final = 160
STYLE: Final[dict[RcKeyType, Any]] = {
    "axes.axisbelow": True,
    "axes.edgecolor": "#5b6067",
    "axes.grid": True,
    "axes.labelsize": 9.5,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 9.5,
    "font.size": 9.0,
    "grid.color": "#e3e5e8",
    "grid.linewidth": 0.7,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "path.simplify_threshold": 0.2,
    "text.parse_math": False,
    "xtick.color": "#5b6067",
    "xtick.labelcolor": "#1c1e21",
    "ytick.color": "#5b6067",
    "ytick.labelcolor": "#1c1e21",
}
"""What is drawn unlike matplotlib's defaults; texts are literal, `$` included."""
JOURNAL: Final[dict[RcKeyType, Any]] = {
    "axes.labelsize": 8.0,
    "axes.linewidth": 0.6,
    "axes.titlesize": 8.0,
    "font.size": 8.0,
    "grid.linewidth": 0.5,
    "legend.borderaxespad": 0.2,
    "legend.borderpad": 0.2,
    "legend.columnspacing": 1.2,
    "legend.fontsize": 7.5,
    "legend.handlelength": 1.6,
    "legend.handletextpad": 0.5,
    "legend.labelspacing": 0.25,
    "pdf.fonttype": 42,
    "ps.fonttype": 42,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
}
"""What a figure of a stated width has besides: texts of 8 pt, and fonts that journals accept, Type 42."""
JOURNAL_DPI: Final = 300
SUFFIXES: Final = (".pdf", ".svg", ".png")


@dataclass(frozen=True, kw_only=True)
class _Layout:
    """Sizes of a figure's parts."""

    row: float  # height of a row of panels [in]
    head: float  # height of what stands above and below the panels [in]
    letters: int  # characters beside a vertical axis


_WIDTH: Final = 9.6  # of a figure without a stated width [in]
_PAGE: Final = _Layout(row=1.95, head=0.7, letters=26)
_JOURNAL: Final = _Layout(row=1.2, head=0.5, letters=17)
"""Of a figure of a stated width."""
_LARGEST_SVG: Final = 40_000  # letters of a notebook's figure above which it is a PNG
_NOTEBOOK_DPI: Final = 55
_READ_LATE: Final[tuple[RcKeyType, ...]] = ("pdf.fonttype", "ps.fonttype")
"""Settings that matplotlib reads when a figure is saved; its default is Type 3."""
_MOST_COLUMNS: Final = 6  # of a legend
_LINE_HEIGHT: Final = 1.25  # of a text [font size]
_DASHES: Final = (0, (5, 2))
_MARKERS: Final = {
    "circle": "o",
    "diamond": "D",
    "square": "s",
    "x": "x",
    "cross": "P",
    "pentagon": "p",
    "triangle-up": "^",
    "triangle-down": "v",
    "triangle-left": "<",
    "triangle-right": ">",
}


def write_pngs(figures: Iterable[Figure], directory: Path) -> list[Path]:
    """Write each figure as `KEY.png`; the files written.

    Raises:
        OutputError: the directory, one that is being made, cannot be written, or holds a file of that name.
    """
    paths = []
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for figure in figures:
            png = to_png(figure)
            path = directory / f"{figure.key}.png"
            with path.open("xb") as file:
                file.write(png)
            paths.append(path)
    except OSError as error:
        raise OutputError(directory, error.strerror or str(error)) from error
    return paths


def to_png(figure: Figure, dpi: float | None = None) -> bytes:
    """The figure as a PNG of so many pixels per inch, `DPI` unless told."""
    png = io.BytesIO()
    with _style():
        draw(figure).savefig(png, format="png", dpi=dpi or DPI)
    return png.getvalue()


def figure_html(figure: Figure) -> str:
    """The figure for a notebook: SVG, or PNG where its curves make that large."""
    file = io.StringIO()
    with _style({"svg.fonttype": "none", "svg.hashsalt": figure.key}):
        no_metadata = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        draw(figure).savefig(file, format="svg", metadata=no_metadata, dpi=72)
    text = file.getvalue()
    svg = _rounded_paths(text[text.index("<svg") :])
    if len(svg) <= _LARGEST_SVG:
        return svg
    png = b64encode(to_png(figure, dpi=_NOTEBOOK_DPI)).decode()
    return f'<img alt="{figure.key}" src="data:image/png;base64,{png}">'


def _rounded_paths(svg: str) -> str:
    """An SVG whose curves have one decimal, finer than a pixel."""

    def rounded(path: re.Match[str]) -> str:
        return re.sub(r"(\.\d)\d+", r"\1", path[0])

    return re.sub(r' d="[^"]*"', rounded, svg)


def figure_file(path: Path | str, *, overwrite: bool = False) -> Path:
    """Return the absolute path of a figure to be written by `write_figure`; call it before the work for it starts.

    Raises:
        ParameterError: it ends in none of `SUFFIXES`.
        OutputError: it cannot be written, or exists and may not be overwritten.
    """
    if Path(path).suffix not in SUFFIXES:
        raise ParameterError("", "out", str(path), f"a file ending in {', '.join(SUFFIXES)}")
    return require_file(path, overwrite=overwrite)


def write_figure(
    figure: Figure, path: Path | str, *, width: float, overwrite: bool = False, style: Style = None
) -> list[Axes]:
    """Write a figure for a journal as PDF, SVG or PNG, by the suffix of its path; the same numbers give the same bytes.

    `style` is as of `draw`.

    Returns:
        Its axes, panel by panel.

    Raises:
        InputError: as of `figure_file`.
    """
    path = figure_file(path, overwrite=overwrite)
    metadata: dict[str, Any] = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}.get(path.suffix, {})
    with _style(JOURNAL, style, {"svg.hashsalt": figure.key}):
        canvas = _draw(figure, interactive=False, width=width)
        with writing_file(path, overwrite=overwrite) as new:
            canvas.savefig(new, metadata=metadata, dpi=JOURNAL_DPI)
    return canvas.axes


def show_window(canvas: Canvas) -> bool:
    """Show an interactive figure until its window is closed; False at once where there is no display."""
    from matplotlib import pyplot

    if type(canvas.canvas).required_interactive_framework is None:
        return False
    pyplot.show()
    return True


def draw(figure: Figure, *, interactive: bool = False, width: float | None = None, style: Style = None) -> Canvas:
    """The figure as matplotlib's.

    Args:
        figure: what to draw.
        interactive: whether notebooks and `pyplot.show` show it.
        width: its width [in], in the style of a journal; None: as wide as a page of ours.
        style: replaces settings of texts, axes, grid and legend; curves keep their colours.

    Raises:
        ParameterError: matplotlib knows no such style, or refuses a value of it.
    """
    journal: Mapping[RcKeyType, Any] | None = None
    if width is not None:
        journal = JOURNAL
    with _style(journal, style):
        return _draw(figure, interactive=interactive, width=width)


@contextlib.contextmanager
def _style(*more: Style | Mapping[RcKeyType, Any]) -> Iterator[None]:
    """Matplotlib's defaults with `STYLE` and more, whatever the user's matplotlibrc says, and without its notices.

    Raises:
        ParameterError: matplotlib knows no such style, or refuses a value of it.
    """
    notices = logging.getLogger("matplotlib")
    level = notices.level
    notices.setLevel(logging.ERROR)  # as on a home directory that it cannot write
    try:
        import matplotlib.style

        with matplotlib.style.context("default"):
            for style in (STYLE, *more):
                if style is not None:
                    _use(style)
            yield
    finally:
        notices.setLevel(level)


def _use(style: Style | Mapping[RcKeyType, Any]) -> None:
    """Apply a style to what is drawn from now on.

    Raises:
        ParameterError: matplotlib knows no such style, or refuses a value of it.
    """
    import matplotlib.style

    if isinstance(style, Path):
        style = str(style)
    try:
        matplotlib.style.use(style)  # type: ignore[arg-type]
    except (OSError, KeyError, ValueError, TypeError, AttributeError) as error:
        reason: object = error
        if error.args:
            reason = error.args[0]
        shown: object = str(style)
        if isinstance(style, Mapping):
            shown = dict(style)
        rule = f"rcParams of matplotlib, or a style sheet by its name or file ({str(reason).splitlines()[0]})"
        raise ParameterError("", "style", shown, rule) from None


def _draw(figure: Figure, *, interactive: bool, width: float | None) -> Canvas:
    layout = _PAGE
    if width is not None:
        layout = _JOURNAL
    heights = figure.row_heights
    size = (width or _WIDTH, layout.head + layout.row * sum(heights))
    canvas = _new_canvas(size, interactive=interactive)
    grid = canvas.subplots(len(heights), figure.columns, squeeze=False, height_ratios=heights)
    shared_entries: dict[str, Artist] = {}
    timed: list[Axes] = []
    for axes, panel in zip(grid.flat, figure.panels, strict=False):
        entries = _draw_panel(axes, panel, layout.letters)
        if panel.legend and entries:
            _draw_panel_legend(axes, panel, entries)
        else:
            for label, artist in entries.items():
                shared_entries.setdefault(label, artist)
        if not panel.x_label:
            timed.append(axes)
    for axes in grid.flat[len(figure.panels) :]:
        axes.set_axis_off()
    _share_time(timed, figure)
    canvas.align_ylabels()
    if figure.title:
        canvas.suptitle(figure.title, x=0.01, ha="left", fontsize=11.0, fontweight="bold")
    if shared_entries:
        _draw_shared_legend(canvas, shared_entries, size)
    return canvas


def _new_canvas(size: tuple[float, float], *, interactive: bool) -> Canvas:
    """An empty figure of a width and height [in]."""
    if not interactive:
        from matplotlib.figure import Figure as Canvas

        return Canvas(figsize=size, layout="constrained")
    from matplotlib import pyplot

    canvas = pyplot.figure(figsize=size, layout="constrained")
    _keep_fonts(canvas)
    return canvas


def _draw_panel_legend(axes: Axes, panel: Panel, entries: Mapping[str, Artist]) -> None:
    """Explain a panel's labels: inside, or above it where no title stands there."""
    looks: dict[str, Any] = {"loc": "lower right", "columnspacing": 1.0, "handletextpad": 0.4}
    if panel.y_label:
        looks["ncols"] = 1
    else:
        looks |= {"ncols": 4, "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.1}
    axes.legend(entries.values(), entries, **looks)


def _draw_shared_legend(canvas: Canvas, entries: Mapping[str, Artist], size: tuple[float, float]) -> None:
    """Explain the labels of all panels below them, in a figure of a width and height [in]."""
    width, height = size
    columns = _legend_columns(list(entries), width)
    canvas.legend(list(entries.values()), list(entries), loc="outside lower right", ncols=columns)
    rows = -(-len(entries) // columns)
    canvas.set_figheight(height + (rows - 1) * _legend_line())  # which panels would lose otherwise


def _keep_fonts(canvas: Canvas) -> None:
    """Have a figure saved, at whatever later time, with the fonts that it is drawn with."""
    from matplotlib import rcParams

    fonts = {name: rcParams[name] for name in _READ_LATE}
    vars(canvas).update(savefig=partial(_save, canvas, fonts))


def _save(canvas: Canvas, fonts: dict[RcKeyType, Any], *args: Any, **options: Any) -> None:
    """Save a figure, see `matplotlib.figure.Figure.savefig`, with settings that matplotlib reads when it saves."""
    from matplotlib import rc_context

    with rc_context(fonts):
        type(canvas).savefig(canvas, *args, **options)


def shows_itself() -> bool:
    """Whether the figures of a cell are shown at its end, as in a notebook."""
    from matplotlib import get_backend

    return "inline" in get_backend()


def _legend_size() -> float:
    """Size of a legend's texts [pt]."""
    from matplotlib import rcParams
    from matplotlib.font_manager import FontProperties

    return FontProperties(size=rcParams["legend.fontsize"]).get_size_in_points()


def _legend_line() -> float:
    """Height of a line of a legend [in]."""
    from matplotlib import rcParams

    return (_LINE_HEIGHT + rcParams["legend.labelspacing"]) * _legend_size() / 72.0


def _legend_columns(labels: Sequence[str], width: float) -> int:
    """How many columns of labels fit in a width [in], each as wide as its longest label; filled one by one."""
    from matplotlib import rcParams
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    size = _legend_size()
    font = FontProperties(family=rcParams["font.family"], size=size)
    handle = (rcParams["legend.handlelength"] + rcParams["legend.handletextpad"]) * size
    space = rcParams["legend.columnspacing"] * size
    ends = 2.0 * (rcParams["legend.borderpad"] + rcParams["legend.borderaxespad"]) * size
    widths = [handle + TextPath((0.0, 0.0), label, prop=font).get_extents().width for label in labels]
    for ncols in range(min(_MOST_COLUMNS, len(labels)), 1, -1):
        taken = ends + (ncols - 1) * space
        for column in np.array_split(np.array(widths), ncols):
            taken += column.max()
        if taken <= 72.0 * width:
            return ncols
    return 1


def _share_time(panels: list[Axes], figure: Figure) -> None:
    """Link the axes of time, and label the lowest of each column."""
    for axes in panels[1:]:
        axes.sharex(panels[0])
    for i, axes in enumerate(panels):
        if i >= len(panels) - figure.columns:
            axes.set_xlabel("time [s]")
        else:
            axes.tick_params(labelbottom=False)
    if panels and figure.end is not None:  # a peak in the first period stands clear of the axis
        panels[0].set_xlim(-0.008 * figure.end, figure.end or 1.0)


def _draw_panel(axes: Axes, panel: Panel, letters: int) -> dict[str, Artist]:
    """Draw a panel whose vertical label has so many characters a line; the legend's entries."""
    entries: dict[str, Artist] = {}
    for area in panel.areas:
        entries[area.label] = axes.fill(*area.outline.T, color=area.colour, alpha=area.opacity, linewidth=0.0)[0]
    for band in panel.bands:
        looks: dict[str, Any] = {"color": band.colour, "alpha": band.opacity, "linewidth": 0.9}
        entries[band.label] = axes.fill_between(band.x, band.low, band.high, **looks)
    for series in panel.series:
        entries.setdefault(series.label, _draw_series(axes, series))
    for bound in panel.bounds:
        entries["bound"] = _draw_bound(axes, bound)
    for label in panel.labels:
        _draw_label(axes, label)
    _set_scales(axes, panel)
    if panel.y_label:
        axes.set_title(panel.heading)
        y_label = panel.y_label
    else:
        y_label = _wrapped(panel.heading, letters)
    axes.set(xlabel=panel.x_label, ylabel=y_label)
    entries.pop("", None)
    return entries


def _wrapped(heading: str, letters: int) -> str:
    """Return a heading in lines of so many letters; a name that is longer than a line breaks at its underscores."""
    longest = max(map(len, heading.split()), default=0)
    if longest <= letters:
        return textwrap.fill(heading, letters)
    return textwrap.fill(heading.replace("_", "_ "), letters).replace("_ ", "_")


def _draw_label(axes: Axes, label: Label) -> None:
    looks: dict[str, Any] = {}
    if label.bold:
        looks["fontweight"] = "bold"
    if label.colour:
        looks["color"] = label.colour
    axes.text(label.x, label.y, label.text, ha="center", va="center", **looks)


def _set_scales(axes: Axes, panel: Panel) -> None:
    """Set the kind of each axis, its ticks and its range, once everything is drawn."""
    from matplotlib.ticker import LogLocator, MaxNLocator

    if panel.y_log:
        axes.set_yscale("log")
        bottom, top = axes.get_ylim()
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
        if top < 100.0 * bottom:
            axes.yaxis.set_minor_formatter("{x:g}")
        else:
            axes.yaxis.set_minor_formatter("")  # by default mathematical text
    elif panel.whole:
        axes.yaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        axes.set_ylim(bottom=0.0, top=max(1.0, axes.get_ylim()[1]))
    if panel.x_names:
        axes.set_xticks(range(len(panel.x_names)), panel.x_names)
    if panel.equal:
        axes.set_aspect("equal", adjustable="datalim")
    y_range = panel.fixed_range or panel.least_range
    if y_range:
        axes.set_ylim(*y_range)


def _draw_series(axes: Axes, series: Series) -> Artist:
    looks: dict[str, Any] = {"color": series.colour, "alpha": series.opacity}
    if series.style == "bars":
        base: Array | float = 0.0
        if series.base is not None:
            base = series.base
        bars: Artist = axes.bar(series.x, series.y, series.bar_width, base, **looks).patches[0]
        return bars
    if series.style == "points":
        looks |= {"marker": _MARKERS[series.marker], "markersize": series.width, "linestyle": "none"}
        if series.marker == "x":
            looks["markeredgewidth"] = 0.9
        else:
            looks["markeredgewidth"] = 0.0
    else:
        looks |= {"linewidth": series.width, "linestyle": "-"}
        if series.dashed:
            looks["linestyle"] = _DASHES
        if series.style == "steps":
            looks["drawstyle"] = "steps-post"
    return axes.plot(series.x, series.y, **looks)[0]


def _draw_bound(axes: Axes, bound: Bound) -> Artist:
    looks: Any = {"color": COLOUR.bound, "linestyle": "--", "linewidth": 1.1}
    if bound.vertical:
        return axes.axvline(bound.value, **looks)
    if not np.isfinite([bound.start, bound.stop]).all():
        return axes.axhline(bound.value, **looks)
    return axes.hlines(bound.value, bound.start, bound.stop, **looks)
