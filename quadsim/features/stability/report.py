"""What `quadsim stability` found: its table, sentences, figures and files.

Everything is made from the `LoopMargins` and `StabilityMap` of `margins`; nothing is measured here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from quadsim.console.results import Shown, Tabular
from quadsim.features.stability.margins import (
    BRACKET_WIDTH,
    MAP_POINTS,
    LoopMargins,
    LoopPoint,
    MarginSide,
    StabilityMap,
    to_plain,
)
from quadsim.features.stability.quantities import VARIED, VariedQuantity
from quadsim.outputs import SUMMARY_FILE, to_json, writing
from quadsim.palette import COLOUR, line_colour
from quadsim.report.figure import Area, Bound, Figure, Panel, Series
from quadsim.report.table import ABSENT, Cell, Grid, Mark, grid_to_markdown, line
from quadsim.report.to_matplotlib import write_pngs

MARGINS_FILE: Final = "stability.md"
_NO_FLIGHT: Final = "*"  # marks a value beyond which the vehicle cannot be flown
_BARS_WIDTH: Final = 0.8  # of all bars of a quantity together
_LARGEST_RATE: Final = 4.0  # largest magnitude of a rate that is drawn [1/s]


@dataclass(frozen=True, repr=False)
class Stability(Tabular):
    """The growth of one or several loops at their nominal point, and their margins.

    `loops` has a `LoopMargins` for each controller and size; `loops[0].margins["delay"].upper.stable` is the largest
    delay [ms] at which the first was found stable.
    """

    scenario: str
    loops: tuple[LoopMargins, ...]
    quantities: tuple[VariedQuantity, ...]
    maps: tuple[StabilityMap, ...] = ()
    directory: Path | None = None

    @property
    def grid(self) -> Grid:
        """The margins: a line for each quantity, two columns for each loop."""
        measured = self._measured_loops
        head = ["quantity", "nominal"]
        for name in self._names(measured):
            head += [f"{name}: from", "to"]
        lines = []
        for quantity in self.quantities:
            nominal = _nominal_value(quantity, measured)
            if nominal is None:
                continue
            cells: list[Cell | str] = [f"{nominal:.3g}"]
            for loop in measured:
                margin = loop.margins.get(quantity.name)
                if margin is None:
                    cells += [ABSENT, ABSENT]
                else:
                    cells.append(_cell(margin.lower, "<", quantity.name, loop))
                    cells.append(_cell(margin.upper, ">", quantity.name, loop))
            lines.append(line(quantity.label, *cells))
        return Grid(
            key="margins",
            title=f"{self.scenario}: stable",
            head=tuple(head),
            lines=tuple(lines),
            note=self._note(measured),
        )

    @property
    def _measured_loops(self) -> list[LoopMargins]:
        """The loops that have margins."""
        return [loop for loop in self.loops if loop.margins]

    def _names(self, loops: Sequence[LoopMargins]) -> list[str]:
        """Return the name of each loop, with its size where they differ."""
        sizes = {loop.size for loop in self.loops}
        if len(sizes) > 1:
            return [f"{loop.name}, {loop.size:g} m/s" for loop in loops]
        return [loop.name for loop in loops]

    def _note(self, loops: Sequence[LoopMargins]) -> str:
        note = (
            f"Stable up to these values, to {100.0 * BRACKET_WIDTH:g} %; "
            "< and >: up to the end of the range that is searched."
        )
        for loop in loops:
            for margin in loop.margins.values():
                if any(side.state == "no flight" for side in margin.sides):
                    return f"{note} {_NO_FLIGHT}: beyond it there is no flight."
        return note

    @property
    def sentences(self) -> tuple[str, ...]:
        """What was found of each loop: its growth, its closest margin, and why there is no flight beyond some."""
        sentences: list[str] = []
        for name, loop in zip(self._names(self.loops), self.loops, strict=True):
            sentences.append(f"{name}: {_growth_sentence(loop)}")
            if loop.margins:
                sentences.append(_closest_sentence(loop))
            for margin in loop.margins.values():
                for side in margin.sides:
                    if side.state == "no flight" and side.unstable is not None:
                        value = _value(side.unstable, margin.quantity)
                        sentences.append(f"No flight with {margin.quantity} {value}: {side.why}.")
            for failure in loop.failures:
                sentences.append(f"Not measured: {failure}.")
        return tuple(sentences)

    def records(self) -> list[dict[str, Any]]:
        """Return a row per loop and quantity: `nominal`, and stable from `lower` to `upper`.

        `lower_state` and `upper_state` say what is beyond: `unstable`, or `stable` where the range searched ends.
        """
        rows = []
        for loop in self.loops:
            for margin in loop.margins.values():
                row: dict[str, Any] = {"loop": loop.name, "size": loop.size, "quantity": margin.quantity}
                row["nominal"] = margin.nominal
                for end, side in (("lower", margin.lower), ("upper", margin.upper)):
                    if side is None:
                        row[end] = None
                        row[f"{end}_state"] = None
                    else:
                        row[end] = side.stable
                        row[f"{end}_state"] = side.state
                rows.append(row)
        return rows

    def shown(self) -> Shown:
        """See `Result.shown`."""
        from quadsim.console import console

        grid = self.grid
        yield from console.grids([grid] if grid.lines else [])
        yield from self.sentences
        for stability_map in self.maps:
            yield ""
            yield from console.grids([_map_grid(stability_map)])

    def outputs(self) -> Shown:
        """See `Result.outputs`."""
        from quadsim.console import console

        if self.directory is not None:
            yield console.written_to(self.directory)

    def to_json(self) -> dict[str, Any]:
        """See `Result.to_json`; without anything that a clock measured."""
        return {
            "scenario": self.scenario,
            "loops": [to_plain(loop) for loop in self.loops],
            "maps": [asdict(stability_map) for stability_map in self.maps],
        }

    def to_markdown(self) -> str:
        """Return table and sentences as Markdown."""
        grid = self.grid
        parts = []
        if grid.lines:
            parts += [grid_to_markdown(grid), f"{grid.note}\n"]
        for sentence in self.sentences:
            parts.append(f"{sentence}\n")
        return "\n".join(parts)

    def small_plot(self) -> Figure | None:
        """See `Result.small_plot`."""
        figure = self.figure
        if figure.panels:
            return figure
        return None

    @property
    def figure(self) -> Figure:
        """The margins as bars, and the growth over each quantity."""
        measured = self._measured_loops
        if not measured:
            return Figure(key="stability", title="", panels=())
        panels = [self._bars(measured)]
        for quantity in self.quantities:
            panels.append(self._growths(quantity, measured))
        title = f"{self.scenario}: growth of a small difference [1/s] over each quantity"
        return Figure(key="stability", title=title, panels=tuple(panels), columns=2)

    def _bars(self, loops: Sequence[LoopMargins]) -> Panel:
        """Return the margins on both sides of the nominal values, as shares."""
        width = _BARS_WIDTH / len(loops)
        series = []
        for i, (name, loop) in enumerate(zip(self._names(loops), loops, strict=True)):
            places = np.arange(len(self.quantities)) + (i - 0.5 * (len(loops) - 1)) * width
            for sign in (-1.0, 1.0):
                for place, quantity in zip(places.tolist(), self.quantities, strict=True):
                    series.append(
                        Series(
                            x=np.array([place, place + width]),  # the second, of no height, gives the bars their width
                            y=np.array([_share(loop, quantity, sign), 0.0]),
                            colour=line_colour(i),
                            label=name,
                            style="bars",
                        )
                    )
        return Panel(
            title="margin over its nominal value, or over the range searched",
            unit="%",
            y_label="margin",
            x_label="quantity",
            x_names=tuple(quantity.name for quantity in self.quantities),
            series=tuple(series),
            y_range=(-110.0, 110.0),
        )

    def _growths(self, quantity: VariedQuantity, loops: Sequence[LoopMargins]) -> Panel:
        """Return the growth over one quantity, at the values that the search looked at."""
        series = []
        for i, (name, loop) in enumerate(zip(self._names(loops), loops, strict=True)):
            margin = loop.margins.get(quantity.name)
            if margin is None:
                continue
            rates: dict[float, float] = {}
            for side in margin.sides:
                for point in side.points:
                    if point.rate is not None:
                        rates[point.values[quantity.name]] = point.rate
            rates[margin.nominal] = loop.growth.rate
            values = np.array(sorted(rates))
            heights = np.clip([rates[value] for value in values.tolist()], -_LARGEST_RATE, _LARGEST_RATE)
            series.append(Series(x=values, y=heights, colour=line_colour(i), label=name))
            series.append(Series(x=values, y=heights, colour=line_colour(i), style="points", width=3.0))
        return Panel(
            title=f"growth over {quantity.name}",
            unit="1/s",
            y_label="growth",
            x_label=quantity.label,
            series=tuple(series),
            bounds=(Bound(value=0.0),),
        )

    def write(self, directory: Path, *, overwrite: bool = False) -> Stability:
        """Write `summary.json`, the table and the figures, together or not at all.

        Raises:
            OutputError: the directory cannot be written, or holds something else.
        """
        figures = []
        margins_figure = self.figure
        if margins_figure.panels:
            figures.append(margins_figure)
        for stability_map in self.maps:
            figures.append(_map_figure(stability_map))
        with writing(directory, overwrite=overwrite) as partial:
            (partial / SUMMARY_FILE).write_text(to_json(self.to_json()), encoding="utf-8")
            (partial / MARGINS_FILE).write_text(self.to_markdown(), encoding="utf-8")
            write_pngs(figures, partial)
        return replace(self, directory=directory)


def _nominal_value(quantity: VariedQuantity, loops: Sequence[LoopMargins]) -> float | None:
    """Return a quantity's value at the nominal point; None where no loop has a margin of it."""
    for loop in loops:
        if quantity.name in loop.margins:
            return loop.margins[quantity.name].nominal
    return None


def _cell(side: MarginSide | None, sign: str, name: str, loop: LoopMargins) -> Cell:
    """Return the value up to which a loop is stable, on one side; the closest limit is marked."""
    if side is None:
        return Cell(text=ABSENT)
    text = f"{side.stable:.3g}"
    if side.unstable is None:
        return Cell(text=f"{sign} {text}")
    if side.state == "no flight":
        return Cell(text=f"{text} {_NO_FLIGHT}")
    closest = loop.closest
    if closest is not None and closest.quantity == name and closest.value == side.stable:
        return Cell(text=text, mark=Mark.BEST)
    return Cell(text=text)


def _value(value: float, name: str) -> str:
    return f"{value:.3g} {VARIED[name].unit}"


def _growth_sentence(loop: LoopMargins) -> str:
    """Say whether a loop is stable at its nominal point."""
    growth = loop.growth
    if growth.verdict == "stable":
        return f"stable: a small difference shrinks at a rate of {-growth.rate:.3g} 1/s."
    if growth.ended:
        return f"unstable: a flight ends early, {growth.ended}; it has no margins."
    if growth.verdict == "unstable":
        fold = np.exp(growth.rate)
        return f"unstable: a small difference grows {fold:.3g}-fold a second; it has no margins."
    return "neither stable nor unstable: a small difference stays what it is; it has no margins."


def _closest_sentence(loop: LoopMargins) -> str:
    """Say which margin is the smallest."""
    closest = loop.closest
    if closest is None:
        return "Within the ranges searched nothing makes it unstable."
    quantity = VARIED[closest.quantity]
    if quantity.measure == "nominal":
        of = "the nominal value"
    else:
        of = "the range searched"
    value = _value(closest.value, closest.quantity)
    return f"The closest limit is that of {quantity.name}, at {value}: {100.0 * closest.share:.3g} % of {of} away."


def _share(loop: LoopMargins, quantity: VariedQuantity, sign: float) -> float:
    """Return a margin [%], signed, for the bars; 0 where there is none."""
    margin = loop.margins.get(quantity.name)
    if margin is None:
        return 0.0
    side = margin.upper if sign > 0.0 else margin.lower
    if side is None:
        return 0.0
    percent = 100.0 * quantity.distance(margin.nominal, side.stable)
    return sign * min(percent, 100.0)


def _map_rows(stability_map: StabilityMap) -> Iterator[tuple[float, tuple[LoopPoint, ...]]]:
    """Yield each value of the second quantity with its points, the largest first."""
    for i in reversed(range(MAP_POINTS)):
        yield stability_map.values[1][i], stability_map.points[i * MAP_POINTS : (i + 1) * MAP_POINTS]


def _map_grid(stability_map: StabilityMap) -> Grid:
    """Return the rates of a map as a table."""
    across_name, up_name = stability_map.quantities
    across = VARIED[across_name]
    up = VARIED[up_name]
    lines = []
    for value, points in _map_rows(stability_map):
        cells = []
        for point in points:
            text = ABSENT if point.rate is None else f"{point.rate:.2f}"
            mark = Mark.GOOD if point.state == "stable" else Mark.BAD
            cells.append(Cell(text=text, mark=mark))
        lines.append(line(f"{value:.3g}", *cells))
    return Grid(
        key=f"map-{across.name}-{up.name}",
        title=f"{stability_map.name}, {stability_map.size:g} m/s: growth [1/s], {across.label} across, {up.label} up",
        head=("", *(f"{value:.3g}" for value in stability_map.values[0])),
        lines=tuple(lines),
        note="Negative: stable.",
    )


def _map_figure(stability_map: StabilityMap) -> Figure:
    """Return a map as a figure: a cell for each point, stable or not."""
    across_name, up_name = stability_map.quantities
    across = VARIED[across_name]
    up = VARIED[up_name]
    columns = _edges(stability_map.values[0])
    rows = _edges(stability_map.values[1])
    areas = []
    for i, point in enumerate(stability_map.points):
        row, column = divmod(i, MAP_POINTS)
        left, right = columns[column : column + 2]
        bottom, top = rows[row : row + 2]
        outline = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
        if point.state == "stable":
            areas.append(Area(outline=outline, colour=COLOUR.satisfied, label="stable", opacity=0.6))
        else:
            areas.append(Area(outline=outline, colour=COLOUR.violated, label="not stable", opacity=0.6))
    panel = Panel(title=up.name, unit=up.unit, x_label=across.label, areas=tuple(areas), legend=True, height=2.4)
    title = f"{stability_map.name}, {stability_map.size:g} m/s: stable or not"
    key = f"map-{across.name}-{up.name}-{stability_map.name}-{stability_map.size:g}"
    return Figure(key=key, title=title, panels=(panel,), columns=1)


def _edges(values: Sequence[float]) -> list[float]:
    """Return the edges of cells about values."""
    numbers = np.array(values)
    middles = 0.5 * (numbers[1:] + numbers[:-1])
    return [float(numbers[0]), *middles.tolist(), float(numbers[-1])]
