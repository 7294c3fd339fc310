"""A tuning carried out: batches of candidates, few flights first; then the start and the answer on fresh draws."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import tomlkit

from quadsim.errors import InputError, OutputError
from quadsim.flight.summary import read_json
from quadsim.outputs import SUMMARY_FILE as SUMMARY_FILE
from quadsim.outputs import Growing, growing, to_json
from scenarios.campaign import manifest as records
from scenarios.campaign.pilot import fly_flights
from scenarios.campaign.plan import plan_differences
from scenarios.campaign.report.campaign_page import write_comparison_report
from scenarios.campaign.results.store import Store
from scenarios.campaign.results.table import Row
from scenarios.campaign.run import Standing, Watch, fly_campaign, new_session, put_report
from scenarios.campaign.statistics.comparison import Comparison, compare
from scenarios.schema.scenario import Scenario
from scenarios.tuning.outcome import NAMES, Found, summarise
from scenarios.tuning.pilot import TuningPilot
from scenarios.tuning.plan import TuningPlan, Values
from scenarios.tuning.ranking import Score, answer, pareto, ranked, score
from scenarios.tuning.report.tuning_page import write_report
from scenarios.tuning.search import Search, require_optuna
from scenarios.tuning.spec import START

FORMAT: Final = "quadsim tuning"
MANIFEST_FILE: Final = "manifest.json"
TUNING_FILE: Final = "tuning.toml"
SCENARIO_FILE: Final = "scenario.toml"
ANSWER_FILE: Final = "best.toml"
REPORT_FILES: Final = ("index.html", "tuning.png", "tuning.svg")
START_DIR, ANSWER_DIR, COMPARISON_DIR = "start", "candidate-{}", "comparison"
_FORM: Final = {"format": str, "status": str, "sessions": list}
_MAY_GROW: Final = ("trials", "fresh", "description")


@dataclass(frozen=True, kw_only=True)
class TuningResult:
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
    """Search, or continue it, and hold the answer against the start.

    The same file gives the same answer with any workers and order, interrupted or not.  Besides its own files, the
    directory has the campaigns on fresh draws, `start/` and `candidate-N/`, their `comparison/`, and of two objectives
    `front-N.toml` for each point of the Pareto front.

    Args:
        plan: the tuning.
        directory: where its results go.
        workers: see `scenarios.many.fly_many`.
        cluster: the same.
        resume: whether to continue what the directory holds, perhaps with more trials.
        overwrite: whether to replace an earlier output there.
        report: whether to write the pages and their figures.
        watch: called with the progress, as answers come.

    Raises:
        InputError: another tuning is there, or other code began it.
        MissingPackageError: Optuna is not installed.
        OutputError: the directory cannot be written, or another process writes there.
        KeyboardInterrupt: a person stopped it; what was flown is there.
    """
    session = new_session(workers, cluster)
    going_on = (directory / MANIFEST_FILE).is_file() and not overwrite
    if going_on and not resume:
        raise OutputError(directory, "a tuning is already there; continue it with --resume, or choose another --out")
    with growing(directory, MANIFEST_FILE, overwrite=overwrite) as files:
        manifest = _go_on(plan, files) if going_on else _begin(plan)
        files.remove([SUMMARY_FILE])
        manifest["sessions"].append(session)
        files.write({**_texts(plan), MANIFEST_FILE: to_json(manifest).encode()})
        flights = _Flights(plan, files, workers, cluster, watch)
        started = clock.perf_counter()
        try:
            search = Search(plan, files)
            _search(plan, search, flights)
            table = flights.close()
            found = _conclude(plan, search, flights)
            files.remove([path.name for path in sorted(files.path.glob("front-*.toml"))])
            files.write({ANSWER_FILE: found.best.to_toml().encode(), **_front(plan, found)})
            result = _validate(plan, files, found, table, workers=workers, cluster=cluster, report=report, watch=watch)
            manifest["status"] = "complete"
        except BaseException:
            manifest["status"] = "interrupted"
            raise
        finally:
            session |= {"flights": flights.flown, "wall_s": clock.perf_counter() - started}
            files.write({MANIFEST_FILE: to_json(manifest).encode()})
        files.finish(result.summary)
    return result


class _Flights:
    """The flights of the search: those that are there, and who flies those that are missing."""

    def __init__(
        self, plan: TuningPlan, files: Growing, workers: int | None, cluster: str | None, watch: Watch
    ) -> None:
        self._plan, self._workers, self._cluster, self._watch = plan, workers, cluster, watch
        self._store = Store(files, plan.schema)
        self._rows: dict[int, Row] = {row["flight"]: row for row in self._store.table().to_pylist()}
        self._started = clock.perf_counter()
        self.flown = 0
        per_batch, before = 0, 0
        for flights, candidates in zip(plan.spec.flights, _halving(plan), strict=True):
            per_batch += (flights - before) * candidates
            before = flights
        self._total = plan.most + plan.spec.trials // plan.spec.batch * per_batch

    def fly(self, candidates: Mapping[int, Values], flights: int) -> None:
        """Have candidates fly their first draws, except those already flown."""
        numbers = [c * self._plan.most + draw for c in candidates for draw in range(flights)]
        missing = [number for number in numbers if number not in self._rows]
        if not missing:
            return
        try:
            pilot = TuningPilot(self._plan, candidates)
            with closing(fly_flights(pilot, missing, workers=self._workers, cluster=self._cluster)) as rows:
                for row in rows:
                    self._store.add(row)
                    self._rows[row["flight"]] = row
                    self.flown += 1
                    self._report()
        finally:
            self._store.flush()

    def scores(self, candidates: Iterable[int]) -> list[Score]:
        """The scores of candidates that have flown."""
        most = self._plan.most
        rows = {c: self._of(c) for c in {*candidates, START}}
        if len(rows[START]) < most:
            raise AssertionError("the start has not flown all draws")
        return [score(self._plan, rows, candidate) for candidate in candidates]

    def close(self) -> pa.Table:
        """Put all flights into their final two tables; returns the first."""
        return self._store.close(max(self._rows) + 1)

    def _of(self, candidate: int) -> list[Row]:
        first = candidate * self._plan.most
        return [self._rows[i] for i in range(first, first + self._plan.most) if i in self._rows]

    def _report(self) -> None:
        rate = self.flown / max(clock.perf_counter() - self._started, 1e-9)
        failed = sum(bool(row["failed"]) for row in self._rows.values())
        self._watch(Standing(flown=len(self._rows), flights=self._total, failed=failed, rate=rate))


def _halving(plan: TuningPlan) -> list[int]:
    """Candidates of a batch that fly each number of draws: so many that each costs about as much as the first."""
    first = plan.spec.flights[0]
    return [math.ceil(plan.spec.batch * first / flights) for flights in plan.spec.flights]


def _search(plan: TuningPlan, search: Search, flights: _Flights) -> None:
    """All batches, each by successive halving: all its candidates fly a few draws, the best of them go on to more."""
    flights.fly({START: {}}, plan.most)
    search.begin(flights.scores([START])[0])
    while search.unfinished or search.proposed <= plan.spec.trials:
        batch = search.ask()
        going_on = list(batch)
        for number, candidates in zip(plan.spec.flights, _halving(plan), strict=True):
            if candidates < len(going_on):
                going_on = [each.candidate for each in ranked(flights.scores(going_on))[:candidates]]
            flights.fly({candidate: batch[candidate] for candidate in going_on}, number)
        search.tell(flights.scores(batch))


def _conclude(plan: TuningPlan, search: Search, flights: _Flights) -> Found:
    """What the search found."""
    candidates = search.candidates()
    scores = flights.scores(candidates)
    best = answer(plan, scores)
    front = pareto(plan, scores)
    name = f"{plan.spec.name}-best"
    return Found(
        scores=scores,
        candidates=candidates,
        answer=best,
        front=front,
        importance=tuple(search.importance(scores, i) for i in range(len(plan.spec.objectives))),
        best=plan.candidate(candidates[best.candidate], name),
    )


def _front(plan: TuningPlan, found: Found) -> dict[str, bytes]:
    """Of two objectives, the scenario of each point of the Pareto front, by its file."""
    if len(plan.spec.objectives) < 2:
        return {}
    names = {each.candidate: f"front-{each.candidate}" for each in found.front}
    return {
        f"{name}.toml": plan.candidate(found.candidates[c], f"{plan.spec.name}-{name}").to_toml().encode()
        for c, name in names.items()
    }


def _validate(
    plan: TuningPlan,
    files: Growing,
    found: Found,
    table: pa.Table,
    *,
    workers: int | None,
    cluster: str | None,
    report: bool,
    watch: Watch,
) -> TuningResult:
    """Fly the start and the answer on fresh draws, compare them, and write what came of it all."""
    best = found.answer.candidate
    tables, folders, campaigns = [], [], []
    for candidate in dict.fromkeys((START, best)):
        folder = START_DIR if candidate == START else ANSWER_DIR.format(candidate)
        campaign = plan.of(found.candidates[candidate], name=f"{plan.spec.name}-{folder}", fresh=True)
        directory = files.path / folder
        folders.append(folder)
        campaigns.append(campaign)
        resume = records.is_campaign(directory)
        flown = fly_campaign(
            campaign, directory, workers=workers, cluster=cluster, resume=resume, report=report, watch=watch
        )
        tables.append(flown.table)
    comparison = None
    if best != START:
        comparison = compare(tables[0], tables[1], NAMES, differences=plan_differences(*campaigns))
    if comparison is not None and report:
        write_comparison_report(comparison, files.path / COMPARISON_DIR, overwrite=True)
    summary = summarise(plan, found, tables[0], tables[-1])
    write = partial(write_report, summary=summary, tables=tables, campaigns=folders)
    put_report(files, REPORT_FILES, write if report else None)
    return TuningResult(directory=files.path, best=found.best, table=table, summary=summary, comparison=comparison)


def _begin(plan: TuningPlan) -> dict[str, Any]:
    """The manifest of a new tuning."""
    return {
        "format": FORMAT,
        "name": plan.spec.name,
        "description": plan.spec.description,
        "scenario": plan.scenario.name,
        "status": "running",
        "optuna": require_optuna().__version__,
        **records.flown_by(plan.start),
        "sessions": [],
    }


def _go_on(plan: TuningPlan, files: Growing) -> dict[str, Any]:
    """The manifest of a tuning that is resumed, perhaps with more trials or more fresh flights.

    Raises:
        FileError: there is none, or it is damaged.
        InputError: it is another tuning, or other code began it.
    """
    manifest = read_json(files.path / MANIFEST_FILE, _FORM, "a tuning's manifest")
    if manifest["format"] != FORMAT:
        raise InputError(f"{files.path}: its {MANIFEST_FILE} is not a tuning's")
    before, now = {name: (files.path / name).read_bytes() for name in (TUNING_FILE, SCENARIO_FILE)}, _texts(plan)
    differing = ["scenario"] if before[SCENARIO_FILE] != now[SCENARIO_FILE] else []
    old, new = (tomlkit.parse(text[TUNING_FILE].decode()).unwrap() for text in (before, now))
    differing += [name for name in new if name not in _MAY_GROW and old.get(name) != new[name]]
    if old["trials"] > new["trials"]:
        differing.append("trials")
    if differing:
        raise InputError(
            f"{files.path}: --resume needs the same tuning, and its {', '.join(differing)} differs from "
            "the one there; more trials and more fresh flights may follow; choose another --out"
        )
    other = [name for name in records.other_than_flew(manifest, plan.start) if name != "machine"]
    if manifest["optuna"] != require_optuna().__version__:
        other.append("optuna")
    if other:
        raise InputError(
            f"{files.path}: --resume needs the same code, and this one differs from what began it "
            f"({', '.join(other)}); choose another --out"
        )
    return {**manifest, "status": "running"}


def _texts(plan: TuningPlan) -> Mapping[str, bytes]:
    """The tuning as files that need no others."""
    campaign = plan.spec.campaign.model_copy(update={"scenario": SCENARIO_FILE, "set": {}})
    own = plan.spec.model_copy(update={"campaign": campaign})
    return {TUNING_FILE: own.to_toml().encode(), SCENARIO_FILE: plan.scenario.to_toml().encode()}
