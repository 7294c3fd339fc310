"""Execution of a tuning: the search, then start and result on fresh draws.

A tuning as a page that works offline, and as tables for the terminal.
"""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from quadsim.errors import InputError, OutputError
from quadsim.flight.rundir import read_json
from quadsim.outputs import SUMMARY_FILE, growing, optional, to_json
from quadsim.report.page import PAGE_FILE, Section, render_page
from quadsim.report.table import ABSENT, Cell, Grid, Mark, format_number, line
from quadsim.report.to_plotly import Plot, embed
from scenarios.campaign.campaign import CampaignProgress, Watch, fly_campaign, put_report
from scenarios.campaign.paired import PairedComparison, compare_pairs
from scenarios.campaign.plan import plan_differences
from scenarios.campaign.statistics import judge, label, paired_difference
from scenarios.campaign.store import flown_by
from scenarios.many import count_workers
from scenarios.results import EXIT_DONE, EXIT_FAILED, Result, Shown
from scenarios.schema.scenario import Scenario
from scenarios.schema.writing import plain
from scenarios.tuning.search import JOURNAL_FILE, Search, require_optuna
from scenarios.tuning.tuning_plan import OWN, START, TuningPlan

if TYPE_CHECKING:
    from optuna.study import Study
    from optuna.trial import FrozenTrial


MANIFEST_FILE: Final = "manifest.json"
_FIRST: Final = ("tuning.toml", "scenario.toml")  # written before the manifest
_MAY_CHANGE: Final = {"trials", "fresh", "description"}  # where a tuning is resumed


@dataclass(frozen=True, kw_only=True, repr=False)
class TuningResult(Result):
    """Result of a tuning.

    Attributes:
        directory: where everything is.
        best: the answer; the start where nothing better was found.
        table: every flight of the search.
        summary: `summary.json`.
        comparison: the answer against the start on fresh draws, flight by flight; None where they are the same.
    """

    directory: Path
    best: Scenario
    table: pa.Table
    summary: Mapping[str, Any]
    comparison: PairedComparison | None

    @property
    def holds(self) -> bool:
        """Whether the result's fresh flights support the requirement."""
        return bool(self.summary["fresh"]["best"]["requirement"]["holds"])

    @property
    def exit_status(self) -> int:
        """See `Result.exit_status`; 1 if the requirement is not met."""
        return EXIT_DONE if self.holds else EXIT_FAILED

    def shown(self) -> Shown:
        """See `Result.shown`."""
        from scenarios import console
        from scenarios.tuning.tuning import sentences, tables, verdict

        yield console.styled((self.summary["tuning"], "bold"), f": {verdict(self.summary)}")
        yield from sentences(self.summary)
        yield from console.grids(tables(self.summary), left=("fields",))
        yield console.written_to(self.directory)

    def to_json(self) -> dict[str, Any]:
        """`summary.json`."""
        return dict(self.summary)


def fly_tuning(
    plan: TuningPlan,
    directory: Path,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    report: bool = True,
    watch: Watch = lambda state: None,
) -> TuningResult:
    """Search, or resume a search, and compare the result with the start; see `quadsim.tune`.

    The same file gives the same answer with any workers and order: a batch is proposed before it flies, and its scores
    are told in the order of its candidates.  A search that is resumed proposes again what it proposed, and flies what
    is missing.
    """
    manifest = _manifest(plan)
    count_workers(workers, cluster)
    going_on = (directory / MANIFEST_FILE).is_file() and not overwrite
    if going_on and not resume:
        raise OutputError(directory, "a tuning is already there; continue it with --resume, or choose another --out")
    name = plan.spec.name
    with growing(directory, MANIFEST_FILE, overwrite=overwrite, first=_FIRST) as files, _quiet():
        if going_on:
            _require_same(manifest, files.path)
        fronts = [path.name for path in files.path.glob("front-*.toml")]
        files.remove([SUMMARY_FILE, JOURNAL_FILE, f"{JOURNAL_FILE}.lock", *fronts])
        texts = dict(zip(_FIRST, (plan.to_toml(), plan.start.scenario.to_toml()), strict=True))
        files.write({file: text.encode() for file, text in {**texts, MANIFEST_FILE: to_json(manifest)}.items()})
        search = Search(plan, files, lambda **state: watch(CampaignProgress(**state)), workers=workers, cluster=cluster)
        table = search.run()
        answer, front = search.answer()
        best = plan.candidate(search.candidates[answer], f"{name}-best")
        answers = [best]
        if len(plan.spec.objectives) > 1:
            answers += [plan.candidate(search.candidates[c], f"{name}-front-{c}") for c in front]
        files.write({f"{s.name.removeprefix(f'{name}-')}.toml": s.to_toml().encode() for s in answers})

        folders = {START: "start", answer: "start" if answer == START else f"candidate-{answer}"}
        campaigns = {folder: plan.fresh(search.candidates[c], f"{name}-{folder}") for c, folder in folders.items()}
        finish = partial(fly_campaign, workers=workers, cluster=cluster, resume=True, report=report, watch=watch)
        tables = [finish(campaign, files.path / folder).table for folder, campaign in campaigns.items()]
        comparison = None
        if answer != START:
            comparison = compare_pairs(
                tables[0], tables[1], ("start", "best"), differences=plan_differences(*campaigns.values())
            )
            if report:
                with optional("the comparison"):
                    comparison.write_report(files.path / "comparison", overwrite=True)
        summary = _summary(plan, search, answer, front, tables)
        write = partial(write_page, study=search.study, summary=summary)
        files.finish(summary)
        with optional("the report"):
            put_report(files, [PAGE_FILE], write if report else None)
        files.finish(summary)  # now with the report among its files
    return TuningResult(directory=files.path, best=best, table=table, summary=summary, comparison=comparison)


def _summary(
    plan: TuningPlan, search: Search, answer: int, front: Sequence[int], tables: Sequence[pa.Table]
) -> Summary:
    """Return `summary.json`: the search, and the fresh flights of start and result."""
    shown = {candidate: plan.shown(values) for candidate, values in search.candidates.items()}
    fresh = {"start": tables[0], "best": tables[-1]}
    values = [plan.objectives(table.to_pylist()) for table in fresh.values()]
    both = np.isfinite(values).all(axis=(0, 2))
    objectives = []
    for i, objective in enumerate(plan.spec.objectives):
        numbers = [(*search.scores[candidate].values, None, None)[i] for candidate in (START, answer)]
        numbers += [float(flights[both, i].mean()) if both.any() else None for flights in values]
        named = dict(zip(("start", "best", "fresh_start", "fresh_best"), numbers, strict=True))
        difference = asdict(paired_difference(*(flights[both, i] for flights in values)))
        objectives.append({**asdict(objective), **named, **difference})
    return {
        "tuning": plan.spec.name,
        "description": plan.spec.description,
        "scenario": plan.start.scenario.name,
        "guard": plan.guard.text,
        "answer": answer,
        "trials": plan.spec.trials,
        "search_flights": sum(score.flights for score in search.scores.values()),
        "draws": plan.most,
        "search": [
            {**asdict(entry), "start": shown[START][entry.name], "best": shown[answer][entry.name]}
            for entry in plan.spec.search
        ],
        "objectives": objectives,
        "fresh": {
            name: {"flights": table.num_rows, "requirement": judge(table, plan.requirement).to_json()}
            for name, table in fresh.items()
        },
        "front": list(front),
        "candidates": [
            {**asdict(score), "feasible": score.feasible, "search": shown[candidate]}
            for candidate, score in sorted(search.scores.items())
        ],
    }


def _manifest(plan: TuningPlan) -> dict[str, Any]:
    """Return the definition of a tuning and the versions that affect it."""
    tables = {k: v for k, v in asdict(plan.spec).items() if k not in _MAY_CHANGE}
    campaign = {k: v for k, v in asdict(plan.start.spec).items() if k not in OWN}
    scenario = plain(plan.start.scenario)
    stated = {"format": "quadsim tuning", **tables, "campaign": campaign, "scenario": scenario}
    return {**stated, "optuna": require_optuna().__version__, **flown_by(plan.start)}


def _require_same(manifest: Mapping[str, Any], directory: Path) -> None:
    """Refuse to resume a different tuning.

    Raises:
        FileError: its manifest is damaged.
        InputError: it is another one, or other code began it.
    """
    before = read_json(directory / MANIFEST_FILE, {"format": str}, "a tuning's manifest")
    differing = [key for key in manifest if key != "machine" and before.get(key) != manifest[key]]
    if differing:
        raise InputError(
            f"{directory}: --resume needs the same tuning and the same code, and its {', '.join(differing)} differs "
            "from the one there; trials and fresh flights may; choose another --out"
        )


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress Optuna's notices, such as those on experimental parts."""
    logging = require_optuna().logging
    level = logging.get_verbosity()
    logging.set_verbosity(logging.ERROR)
    with warnings.catch_warnings(action="ignore"):
        try:
            yield
        finally:
            logging.set_verbosity(level)


Summary = Mapping[str, Any]
FEWEST: Final = 5  # feasible candidates of which importances are drawn
_FILES: Final = ("best.toml", "tuning.toml", "scenario.toml", "flights.parquet", "summary.json", "journal.log")


def verdict(summary: Summary) -> str:
    """Return which of start and result is better on fresh draws, and by how much."""
    if summary["answer"] == START:
        return f"No candidate of {summary['trials']} was better than the start"
    gains = []
    for objective in summary["objectives"]:
        start, best, change = _compared(objective["fresh_start"], objective["fresh_best"])
        gains.append(f"{label(objective['name'], objective['unit'])} {best} against {start} ({change})")
    return f"Candidate {summary['answer']} on fresh draws: {', '.join(gains)}"


def sentences(summary: Summary) -> tuple[str, ...]:
    """Return the verdicts of start and result on the requirement."""
    names = ("best",) if summary["answer"] == START else ("best", "start")
    return tuple(f"{name}: {summary['fresh'][name]['requirement']['sentence']}" for name in names)


def tables(summary: Summary) -> tuple[Grid, Grid]:
    """Return the objectives on the search draws and on fresh draws, and the tuned values."""
    objectives = [
        line(
            label(entry["name"], entry["unit"]),
            *_compared(entry["start"], entry["best"]),
            *_compared(entry["fresh_start"], entry["fresh_best"]),
            f"{format_number(entry['lower'])} to {format_number(entry['upper'])}",
        )
        for entry in summary["objectives"]
    ]
    values = [
        line(
            label(entry["name"], entry["unit"]),
            Cell(text=", ".join(entry["fields"]), mark=Mark.CODE),
            *(str(v) if isinstance(v, str | bool) else format_number(v) for v in (entry["start"], entry["best"])),
        )
        for entry in summary["search"]
    ]
    head = ("objective", "start, search", "best, search", "promised", "start, fresh", "best, fresh", "confirmed")
    grid = Grid(
        key="objectives",
        title="Search draws and fresh draws",
        head=(*head, "mean difference, 95 %"),
        lines=tuple(objectives),
        note=f"Search: {summary['search_flights']} flights, each on the first of the same {summary['draws']} draws.",
    )
    return grid, Grid(key="values", title="Values", head=("name", "fields", "start", "best"), lines=tuple(values))


def write_page(directory: Path, *, study: Study, summary: Summary) -> None:
    """Write `index.html`, with Optuna's own plots, for a directory that has the fresh campaigns."""
    from optuna import visualization
    from optuna.importance import PedAnovaImportanceEvaluator

    names = [label(entry["name"], entry["unit"]) for entry in summary["objectives"]]
    if len(names) > 1:
        plots = [_plot(visualization.plot_pareto_front(study, target_names=names), "candidates", "Pareto front", 430)]
    else:
        history = visualization.plot_optimization_history(study, target_name=names[0])
        plots = [_plot(history, "candidates", "candidates", 430)]
    feasible = {entry["candidate"] for entry in summary["candidates"] if entry["feasible"]}
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
        verdict=Cell(text=verdict(summary), mark=Mark.GOOD if holds else Mark.BAD),
        notes=(summary["description"],),
        files={**{name: name for name in _FILES}, **{folder: f"{folder}/index.html" for folder in pages}},
    )
    (directory / PAGE_FILE).write_text(page, encoding="utf-8")


def _plot(figure: Any, key: str, title: str, height: int) -> Plot:
    figure.update_layout(title_text="", margin={"t": 12, "b": 52})  # the page has the title
    return embed(figure, key, title, height)


def _compared(start: float | None, best: float | None) -> tuple[str, str, str]:
    """Return both values and the change from the first to the second."""
    change = f"{100.0 * (best - start) / abs(start):+.1f} %" if start and best is not None else ABSENT
    return format_number(start), format_number(best), change
