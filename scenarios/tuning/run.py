"""A tuning carried out: the search, then the start and the answer on fresh draws."""

from __future__ import annotations

import contextlib
import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from quadsim.errors import InputError, OutputError
from quadsim.flight.rundir import read_json
from quadsim.outputs import SUMMARY_FILE, growing, to_json
from quadsim.report.page import PAGE_FILE
from scenarios.campaign.manifest import flown_by
from scenarios.campaign.pilot import fly_flights
from scenarios.campaign.plan import plan_differences
from scenarios.campaign.report.campaign_page import write_comparison_report
from scenarios.campaign.run import Standing, Watch, fly_campaign, put_report
from scenarios.campaign.statistics.comparison import Comparison, compare
from scenarios.campaign.statistics.inference import paired_difference
from scenarios.campaign.statistics.requirement import judge
from scenarios.many import count_workers
from scenarios.results import EXIT_DONE, EXIT_FAILED, Result, Shown
from scenarios.schema.scenario import Scenario
from scenarios.tuning.page import Summary, write_page
from scenarios.tuning.plan import OWN, START, TuningPlan
from scenarios.tuning.search import JOURNAL_FILE, Search, require_optuna

MANIFEST_FILE: Final = "manifest.json"
_MAY_CHANGE: Final = {"trials", "fresh", "description"}  # where a tuning is resumed


@dataclass(frozen=True, kw_only=True)
class TuningResult(Result):
    """What came of a tuning.

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
    comparison: Comparison | None

    @property
    def holds(self) -> bool:
        """Whether the answer's fresh flights support the requirement."""
        return bool(self.summary["fresh"]["best"]["requirement"]["holds"])

    @property
    def exit_status(self) -> int:
        """See `Result.exit_status`; 1 where the requirement does not hold."""
        return EXIT_DONE if self.holds else EXIT_FAILED

    def shown(self) -> Shown:
        """See `Result.shown`."""
        from scenarios import console
        from scenarios.tuning.page import sentences, tables, verdict

        yield console.styled((self.summary["tuning"], "bold"), f": {verdict(self.summary)}")
        yield from sentences(self.summary)
        yield from console.grids(tables(self.summary), left=("fields",))
        yield console.written_to(self.directory)

    def to_json(self) -> dict[str, Any]:
        """`summary.json`."""
        return dict(self.summary)


def tune(
    plan: TuningPlan,
    directory: Path,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    report: bool = True,
    watch: Watch = lambda standing: None,
) -> TuningResult:
    """Search, or continue it, and compare the answer with the start; see `quadsim.tune`.

    The same file gives the same answer with any workers and order: a batch is proposed before it flies, and its scores
    are told in the order of its candidates.  A search that is resumed proposes again what it proposed, and flies what
    is missing.

    Raises:
        InputError: another tuning is there, or other code began it.
        MissingPackageError: Optuna is not installed.
        OutputError: the directory cannot be written, or another process writes there.
        KeyboardInterrupt: a person stopped it; what was flown is there.
    """
    manifest = _manifest(plan)
    count_workers(workers, cluster)
    going_on = (directory / MANIFEST_FILE).is_file() and not overwrite
    if going_on and not resume:
        raise OutputError(directory, "a tuning is already there; continue it with --resume, or choose another --out")
    name = plan.spec.name
    with growing(directory, MANIFEST_FILE, overwrite=overwrite) as files, _quiet():
        if going_on:
            _require_same(manifest, files.path)
        fronts = [path.name for path in files.path.glob("front-*.toml")]
        files.remove([SUMMARY_FILE, JOURNAL_FILE, f"{JOURNAL_FILE}.lock", *fronts])
        texts = {"tuning.toml": plan.to_toml(), "scenario.toml": plan.start.scenario.to_toml()}
        files.write({file: text.encode() for file, text in {**texts, MANIFEST_FILE: to_json(manifest)}.items()})
        fly = partial(fly_flights, workers=workers, cluster=cluster)
        search = Search(plan, files, fly, lambda **standing: watch(Standing(**standing)))
        table = search.run()
        answer, front = search.answer()
        best = plan.candidate(search.candidates[answer], f"{name}-best")
        found = [best]
        if len(plan.spec.objectives) > 1:
            found += [plan.candidate(search.candidates[each], f"{name}-front-{each}") for each in front]
        files.write({f"{each.name.removeprefix(f'{name}-')}.toml": each.to_toml().encode() for each in found})

        folders = {START: "start", answer: "start" if answer == START else f"candidate-{answer}"}
        campaigns = {
            folder: plan.fresh(search.candidates[each], f"{name}-{folder}") for each, folder in folders.items()
        }
        finish = partial(fly_campaign, workers=workers, cluster=cluster, resume=True, report=report, watch=watch)
        tables = [finish(campaign, files.path / folder).table for folder, campaign in campaigns.items()]
        comparison = None
        if answer != START:
            comparison = compare(
                tables[0], tables[1], ("start", "best"), differences=plan_differences(*campaigns.values())
            )
            if report:
                write_comparison_report(comparison, files.path / "comparison", overwrite=True)
        summary = _summary(plan, search, answer, front, tables)
        write = partial(write_page, study=search.study, summary=summary)
        put_report(files, [PAGE_FILE], write if report else None)
        files.finish(summary)
    return TuningResult(directory=files.path, best=best, table=table, summary=summary, comparison=comparison)


def _summary(
    plan: TuningPlan, search: Search, answer: int, front: Sequence[int], tables: Sequence[pa.Table]
) -> Summary:
    """`summary.json`: the search, and the fresh flights of the start and of the answer."""
    shown = {candidate: plan.shown(values) for candidate, values in search.candidates.items()}
    fresh = {"start": tables[0], "best": tables[-1]}
    values = [plan.objectives(table.to_pylist()) for table in fresh.values()]
    both = np.isfinite(values).all(axis=(0, 2))
    objectives = []
    for i, objective in enumerate(plan.spec.objectives):
        found = [(*search.scores[candidate].values, None, None)[i] for candidate in (START, answer)]
        found += [float(each[both, i].mean()) if both.any() else None for each in values]
        named = dict(zip(("start", "best", "fresh_start", "fresh_best"), found, strict=True))
        difference = asdict(paired_difference(*(each[both, i] for each in values)))
        objectives.append({**objective.model_dump(), **named, **difference})
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
            {**entry.model_dump(), "start": shown[START][entry.name], "best": shown[answer][entry.name]}
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
    """What is flown, with what."""
    tables = plan.spec.model_dump(mode="json", exclude=_MAY_CHANGE)
    campaign = plan.start.spec.model_dump(mode="json", exclude={*OWN})
    scenario = json.loads(plan.start.scenario.model_dump_json())  # infinite bounds are null
    own = {"format": "quadsim tuning", **tables, "campaign": campaign, "scenario": scenario}
    return {**own, "optuna": require_optuna().__version__, **flown_by(plan.start)}


def _require_same(manifest: Mapping[str, Any], directory: Path) -> None:
    """Refuse to continue another tuning.

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
