"""A tuning as a page that works offline, and as tables for the terminal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from quadsim.report.page import PAGE_FILE, Section, render_page
from quadsim.report.table import ABSENT, Cell, Grid, Mark, format_number, line
from quadsim.report.to_plotly import Plot, embed
from scenarios.campaign.statistics.wording import label
from scenarios.tuning.plan import START

if TYPE_CHECKING:
    from optuna.study import Study
    from optuna.trial import FrozenTrial

Summary = Mapping[str, Any]
FEWEST: Final = 5  # feasible candidates of which importances are drawn
_FILES: Final = ("best.toml", "tuning.toml", "scenario.toml", "flights.parquet", "summary.json", "journal.log")


def verdict(summary: Summary) -> str:
    """What is better, by how much, on fresh draws."""
    if summary["answer"] == START:
        return f"No candidate of {summary['trials']} was better than the start"
    gains = []
    for each in summary["objectives"]:
        start, best, change = _compared(each["fresh_start"], each["fresh_best"])
        gains.append(f"{label(each['name'], each['unit'])} {best} against {start} ({change})")
    return f"Candidate {summary['answer']} on fresh draws: {', '.join(gains)}"


def sentences(summary: Summary) -> tuple[str, ...]:
    """Whether the answer and the start hold the requirement."""
    names = ("best",) if summary["answer"] == START else ("best", "start")
    return tuple(f"{name}: {summary['fresh'][name]['requirement']['sentence']}" for name in names)


def tables(summary: Summary) -> tuple[Grid, Grid]:
    """The objectives on the draws that chose the answer and on fresh ones, and the values that were found."""
    objectives = [
        line(
            label(each["name"], each["unit"]),
            *_compared(each["start"], each["best"]),
            *_compared(each["fresh_start"], each["fresh_best"]),
            f"{format_number(each['lower'])} to {format_number(each['upper'])}",
        )
        for each in summary["objectives"]
    ]
    values = [
        line(
            label(each["name"], each["unit"]),
            Cell(text=", ".join(each["fields"]), mark=Mark.CODE),
            *(str(v) if isinstance(v, str | bool) else format_number(v) for v in (each["start"], each["best"])),
        )
        for each in summary["search"]
    ]
    head = ("objective", "start, search", "best, search", "promised", "start, fresh", "best, fresh", "confirmed")
    found = Grid(
        key="objectives",
        title="The draws that chose it, and fresh ones",
        head=(*head, "mean difference, 95 %"),
        lines=tuple(objectives),
        note=f"Search: {summary['search_flights']} flights, each on the first of the same {summary['draws']} draws.",
    )
    return found, Grid(key="values", title="Values", head=("name", "fields", "start", "best"), lines=tuple(values))


def write_page(directory: Path, *, study: Study, summary: Summary) -> None:
    """Write `index.html`, with Optuna's own plots, for a directory that has the fresh campaigns."""
    from optuna import visualization
    from optuna.importance import PedAnovaImportanceEvaluator

    names = [label(each["name"], each["unit"]) for each in summary["objectives"]]
    if len(names) > 1:
        plots = [_plot(visualization.plot_pareto_front(study, target_names=names), "candidates", "Pareto front", 430)]
    else:
        history = visualization.plot_optimization_history(study, target_name=names[0])
        plots = [_plot(history, "candidates", "candidates", 430)]
    feasible = {each["candidate"] for each in summary["candidates"] if each["feasible"]}
    for i, name in enumerate(names if len(feasible) >= FEWEST and len(summary["search"]) > 1 else ()):

        def value(trial: FrozenTrial, i: int = i) -> float:  # infinite ones are left out
            return trial.values[i] if trial.number in feasible else math.inf

        by = {"target": value, "target_name": name}
        shares = visualization.plot_param_importances(study, evaluator=PedAnovaImportanceEvaluator(), **by)
        plots.append(_plot(shares, f"importance{i}", f"importance for {name}", 170 + 34 * len(summary["search"])))
        plots.append(_plot(visualization.plot_slice(study, **by), f"slice{i}", f"{name} by field", 380))
    answer, holds = summary["answer"], summary["fresh"]["best"]["requirement"]["holds"]
    pages = ["start"] if answer == START else ["start", f"candidate-{answer}", "comparison"]
    page = render_page(
        "tuning",
        summary["tuning"],
        [
            Section(title="Fresh draws", text=sentences(summary), tables=tables(summary)),
            Section(title="The search", plots=tuple(plots)),
        ],
        description=summary["description"],
        verdict=Cell(text=verdict(summary), mark=Mark.GOOD if holds else Mark.BAD),
        files={**{name: name for name in _FILES}, **{folder: f"{folder}/index.html" for folder in pages}},
    )
    (directory / PAGE_FILE).write_text(page, encoding="utf-8")


def _plot(figure: Any, key: str, title: str, height: int) -> Plot:
    figure.update_layout(title_text="", margin={"t": 12, "b": 52})  # the page has the title
    return embed(figure, key, title, height)


def _compared(start: float | None, best: float | None) -> tuple[str, str, str]:
    """Both values, and the change from the one to the other."""
    change = f"{100.0 * (best - start) / abs(start):+.1f} %" if start and best is not None else ABSENT
    return format_number(start), format_number(best), change
