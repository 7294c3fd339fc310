"""What the command line prints: tables and progress bars.  Tables go to stdout, progress to stderr."""

from __future__ import annotations

import contextlib
import json
import math
from argparse import Namespace
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBars
from rich.table import Table
from rich.text import Text

from quadsim.controller import OPTIMAL, Phase, counts, law_name
from quadsim.errors import printable
from quadsim.flight.audit import HELD
from quadsim.flight.summary import constraint_verdict, deciding_margin
from quadsim.report.comparison import (
    crash,
    event_sentences,
    failure_sentences,
    required,
    verdict,
    violated_by_fallback,
)
from quadsim.report.table import Cell, Grid, Mark, Row
from scenarios.progress import Progress, silent


class PlainConsole(Console):
    """Shows every string as it is, from any source: paths, names, reasons, summaries.

    What is to have a style is a `rich.text.Text`, made by `styled`.
    """

    def __init__(self, *, stderr: bool = False, width: int | None = None) -> None:
        super().__init__(stderr=stderr, width=width, highlight=False, markup=False, emoji=False)

    def render_str(self, text: str, **options: Any) -> Text:
        """See `rich.console.Console.render_str`; all strings come by here, those of tables too."""
        return super().render_str(printable(text), **(options | {"markup": False, "emoji": False, "highlight": False}))


def styled(*parts: str | tuple[str, str]) -> Text:
    """Texts in a row, each by itself or with its style."""
    return Text.assemble(
        *(printable(part) if isinstance(part, str) else (printable(part[0]), part[1]) for part in parts)
    )


def stdout() -> PlainConsole:
    """Stdout; wide enough for the tables where it is a file or a pipe."""
    console = PlainConsole()
    return console if console.is_terminal else PlainConsole(width=120)


def stderr() -> PlainConsole:
    """Stderr."""
    return PlainConsole(stderr=True)


def print_listing(sections: Mapping[str, Mapping[str, str]]) -> None:
    """Names with one line each, by section."""
    console = stdout()
    for title, entries in sections.items():
        table = Table(
            title=title, title_justify="left", title_style="bold", box=None, show_header=False, padding=(0, 2)
        )
        table.add_column(no_wrap=True, style="cyan")
        table.add_column()
        for name, line in entries.items():
            table.add_row(name, line)
        console.print(table)
        console.print()


def print_summary(summary: Mapping[str, Any], where: str | None) -> None:
    """A flight's outcome, tracking, audit and solver, from its summary."""
    console, flown = stdout(), styled(f"  {summary['duration']:.2f} s flown")
    console.print(styled((summary["scenario"], "bold"), "  ") + outcome(summary) + flown)
    if summary.get("description"):
        console.print(summary["description"], soft_wrap=True)
    for line in summary.get("traceback", ()):
        console.print(styled(line), soft_wrap=True)
    if "course" in summary:
        console.print(summary["course"]["sentence"], soft_wrap=True)
    if summary["tracking"]:
        console.print(_tracking_table(summary["tracking"]))
    if summary["constraints"]:
        console.print(audit_table(summary["constraints"]))
    for line in summary.get("audit_notes", ()):
        console.print(line, soft_wrap=True)
    for line in _controller_lines(summary) if summary["tracking"] else ():
        console.print(line)
    for line in (*_effect_lines(summary), *failure_sentences(summary)):
        console.print(line, soft_wrap=True)
    if "reaudit" in summary:
        again = summary["reaudit"]
        phrase = "as recorded" if again["satisfied"] == summary["satisfied"] else "its verdict is recorded alone"
        console.print(f"audited again from the tables, {again['rate']:g} rows per second: {phrase}")
    if where is not None:
        print_place(where)


def print_place(where: str) -> None:
    """Where something was written."""
    stdout().print(styled("written to ", (where, "bold")), soft_wrap=True)


def say(text: str) -> None:
    """Print a message that is no result."""
    stderr().print(f"quadsim: {text}", soft_wrap=True)


def print_result(summary: Mapping[str, Any], options: Namespace, where: str | None = None) -> None:
    """A flight's summary, for a person or as JSON."""
    if options.json:
        print(json.dumps(summary, indent=2))
    else:
        print_summary(summary, where)


def shown(path: Path) -> str:
    """A path for a person: relative to the current directory where it is in there."""
    with contextlib.suppress(ValueError, OSError):  # it is not in there; the current directory is gone
        return str(path.relative_to(Path.cwd()))
    return str(path)


def outcome(summary: Mapping[str, Any]) -> Text:
    """Completed or aborted with its reason, the verdict on the required constraints, and whether that was expected."""
    expected, as_expected = summary.get("expected", "satisfied"), summary.get("as_expected", True)
    remark = ""
    if expected != "satisfied":
        remark = ", as the scenario expects" if as_expected else f", where the scenario expects it {expected}"
    colour = "green" if as_expected and (remark or summary["satisfied"]) else "red"
    if summary["status"] != "completed":
        return styled((f"aborted{remark}", colour), f": {summary['reason']}")
    phrase = "every required constraint holds" if summary["satisfied"] else "a required constraint does not hold"
    if verdict(summary) == "incomplete":
        colour = "green" if remark and as_expected else "yellow"
        return styled((f"incomplete, {required(summary).text}{remark}", colour))
    if violated_by_fallback(summary):
        phrase = "but in permanent fallback"
    return styled((f"{crash(summary) or 'completed'}, {phrase}{remark}", colour))


def audit_table(constraints: Sequence[Mapping[str, Any]]) -> Table:
    """Every constraint with its bounds, peaks, margin, tolerances and verdict."""
    caption = (
        "margin: the one that decides, negative = violated, s: at the samples; tolerance: its own; beyond: seconds; "
        "-: no value there"
    )
    if any(not entry["required"] for entry in constraints):
        caption += ";  * reported, not required by the scenario"
    head = ("constraint", "bounds", "sampled", "plant", "margin", "tolerance", "beyond", "verdict")
    lines = []
    for entry in constraints:
        margin, tolerance = deciding_margin(entry)
        at_samples = "" if margin == entry["worst_margin"] else " s"
        lines.append(
            (
                f"{entry['name']} [{entry['unit']}]",
                _range(entry["lower"], entry["upper"]),
                *(_number(entry[name]) for name in ("peak_sampled", "peak_plant")),
                f"{_number(margin)}{at_samples}",
                _number(tolerance),
                _number(entry["time_violated"]),
                _verdict(entry),
            )
        )
    return _table("audit at the physics rate", head, lines, caption=caption, left=("verdict",), rigid=True)


def _verdict(entry: Mapping[str, Any]) -> Text:
    found = constraint_verdict(entry)
    if found == "violated":
        return styled(("VIOLATED", "red") if entry["required"] else ("exceeded*", "yellow"))
    return styled((HELD[found], "green" if found == "satisfied" else "yellow"))


def _tracking_table(tracking: Mapping[str, Any]) -> Table:
    head = ["", *(f"{channel} [{unit}]" for channel, unit in tracking["unit"].items())]
    lines = [
        (name.replace("_", " "), *(f"{tracking[name][channel]:.4g}" for channel in tracking["unit"]))
        for name in ("rmse", "max_error", "final_error", "overshoot")
    ]
    return _table("tracking, real minus filtered reference", head, lines)


def _controller_lines(summary: Mapping[str, Any]) -> Iterator[str]:
    control, controller = summary["control"], summary["controller"]
    times, usual = controller["step_ms"], OPTIMAL | {Phase.LANDED, Phase.CRASHED}
    refused = ", ".join(f"{n} {status}" for status, n in controller["statuses"].items() if status not in usual)
    where = f" ({controller['solver']})" if controller["solver"].startswith("C99") else ""
    yield (
        f"{law_name(controller['name'])}{where}: {counts(controller['answered_by'])}"
        f"{f' ({refused})' if refused else ''}; "
        f"step p50 {times['p50']:.3f}, p99 {times['p99']:.3f}, max {times['max']:.3f} ms "
        f"of {controller['deadline_ms']:g} ms"
    )
    yield (
        f"commanded speeds {control['speed_min']:.2f} .. {control['speed_max']:.2f} rad/s, "
        f"steps {control['slew_min']:.2f} .. {control['slew_max']:.2f} rad/s per period; "
        f"simulated in {summary['wall_s']['simulate']:.2f} s"
    )


def _effect_lines(summary: Mapping[str, Any]) -> Iterator[str]:
    """What a flight's effects did, where it has them: events, ground, late commands, errors of the estimate."""
    if events := summary.get("events"):
        yield f"events: {'; '.join(event_sentences(events))}"
    if "ground" in summary:
        ground = summary["ground"]
        left = "started in the air" if ground["started"] == "flying" else "never left it"
        if ground["takeoff_time"] is not None:
            left = f"left it at {ground['takeoff_time']:.2f} s"
        touch = ground["touchdown"]
        met = ""
        if touch is not None:
            met = (
                f", met it at {touch['time']:.2f} s with {touch['speed']:.3g} m/s down, "
                f"{touch['horizontal_speed']:.3g} m/s along and {touch['tilt']:.3g} deg of tilt"
            )
        yield f"ground: {left}{met}; {ground['phase']} at the end"
    if "computation" in summary:
        delay = summary["computation"]["delay_ms"]
        yield (
            f"simulated computation: p50 {delay['p50']:.3g}, p99 {delay['p99']:.3g}, max {delay['max']:.3g} ms; "
            f"{summary['computation']['missed']} commands too late to be used"
        )
    if "estimation" in summary:
        rmse = summary["estimation"]["rmse"]
        lengths = ", ".join(f"{name} {rmse[name]:.3g}" for name in ("x", "y", "z"))
        angles = ", ".join(f"{name} {math.degrees(rmse[name]):.3g}" for name in ("roll", "pitch", "yaw"))
        yield f"RMS error of the measured state: {lengths} m; {angles} deg"


_BRIEF: Final = ("outcome", "required constraints", "RMS error", "verdict", "answered by", "statuses", "whole step, m")
"""How the labels begin of the rows that a terminal shows; the page and its `comparison.md` have them all."""


def print_comparison(rows: Sequence[Row], names: Sequence[str], where: str) -> None:
    """The comparison's answers side by side: outcomes, tracking, verdicts, times."""
    lines = [
        (
            (row.group if row.headline else row.label) + (f" [{row.unit}]" if row.unit else ""),
            *(_cell(cell) for cell in row.cells),
        )
        for row in rows
        if row.label.startswith(_BRIEF)
    ]
    stdout().print(_table("comparison", ["", *names], lines))
    stdout().print(styled("every number, plots and films: ", (where, "bold")), soft_wrap=True)


def print_grids(grids: Sequence[Grid], where: str | None, *, prose: Collection[str] = ()) -> None:
    """Tables of cases, one below the other, with what a reader has to know of each; `prose` names columns of words."""
    console = stdout()
    for grid in grids:
        lines = [[_cell(cell) for cell in line] for line in grid.lines]
        console.print(_table(grid.title, grid.head, lines, caption=grid.note.replace("`", "") or None, left=prose))
        console.print()
    if where is not None:
        print_place(where)


_STYLES: Final = {Mark.BEST: "bold", Mark.GOOD: "green", Mark.WARN: "yellow", Mark.BAD: "red"}


def _cell(cell: Cell) -> Text:
    return styled((cell.text, _STYLES.get(cell.mark, "")))


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e5 else f"{value:.3g}".replace("e-0", "e-")


def _range(lower: float | None, upper: float | None) -> str:
    if lower is not None and upper is not None and lower == -upper:
        return f"±{_number(upper)}"
    return f"{_number(lower)}..{_number(upper)}"


def _table(
    title: str,
    head: Sequence[str],
    lines: Iterable[Iterable[Any]],
    *,
    caption: str | None = None,
    left: Collection[str] = (),
    rigid: bool = False,
) -> Table:
    """A table whose first column, and those named in `left`, are of words; in a `rigid` one no cell is wrapped."""
    table = Table(title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, padding=0, pad_edge=False)
    table.caption, table.caption_justify = caption, "left"
    for i, name in enumerate(head):
        table.add_column(name, justify="right" if i and name not in left else "left", no_wrap=rigid or not i)
    for line in lines:
        table.add_row(*line)
    return table


@contextlib.contextmanager
def progress_bars() -> Iterator[Progress]:
    """Progress bars on stderr, one per stage; nothing when not on a terminal."""
    console = stderr()
    if not console.is_terminal:
        yield silent
        return
    columns = (TextColumn("{task.description:<10}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"))
    with ProgressBars(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=console, transient=True) as bars:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield report
