"""Campaign execution: fly the missing flights, save their rows as they arrive, and summarise the whole.

A flight's row depends on the campaign file and its number alone (`plan`), so a resumed campaign has the same table as
one that was never interrupted.  Rows go to disk through `store`; the summary is `statistics.estimate` of the table.
`recorded_flight` and `compare_replay` are for one flight that is flown again.
"""

from __future__ import annotations

import math
import tempfile
import time as clock
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from quadsim.console.junit import Cases
from quadsim.console.results import EXIT_DONE, EXIT_FAILED, Result, Shown
from quadsim.errors import InputError, OutputError, ParameterError
from quadsim.features.campaign.campaign_file import CampaignFile
from quadsim.features.campaign.campaign_report import (
    campaign_lines,
    campaign_overview,
    verdict_sentence,
    write_report,
)
from quadsim.features.campaign.plan import Plan
from quadsim.features.campaign.rows import CampaignSummary, make_table
from quadsim.features.campaign.statistics import Judgement, estimate, proportion, worst_flight
from quadsim.features.campaign.store import (
    CAMPAIGN_FILE,
    FLIGHTS_FILE,
    MANIFEST_FILE,
    TIMES_FILE,
    UNREPRODUCIBLE,
    Store,
    is_campaign,
    other_than_flew,
    read_flights,
    read_manifest,
    require_same,
    start_session,
    stored_plan,
    write_manifest,
)
from quadsim.flight.rundir import SCENARIO_FILE
from quadsim.outputs import Growing, digest_of, growing, optional
from quadsim.report.figure import Figure
from quadsim.rollout.flown import Flight, to_pandas
from quadsim.rollout.machine import code_digest
from quadsim.rollout.many import MEMORY, TIMEOUT, count_workers
from quadsim.scenarios.schema.scenario import Scenario

REPORT_FILES: Final = ("index.html", "campaign.png")
_REQUIREMENTS_IN_REPR: Final = 5  # how many of them a repr lists
CHECK_EVERY: Final = 10
"""Flights between checks of the interval, if it decides when to stop; for grids, whole repetitions."""


@dataclass(frozen=True, kw_only=True)
class CampaignProgress:
    """Progress of a campaign."""

    flown: int  # flights completed
    flights: int  # flights in all
    failed: int  # failures among the completed flights
    rate: float  # flights per second of this session


Watch = Callable[[CampaignProgress], None]


@dataclass(frozen=True, kw_only=True, repr=False)
class CampaignResult(Result):
    """Result of a campaign."""

    directory: Path  # where everything is
    manifest: dict[str, Any]  # what was flown, with what
    table: pa.Table  # `flights.parquet`
    summary: dict[str, Any]  # `summary.json`
    judgements: tuple[Judgement, ...] = ()  # of the requirements that were stated

    @property
    def exit_status(self) -> int:
        """See `Result.exit_status`; 1 where the flights do not support a requirement."""
        if all(judgement.holds for judgement in self.judgements):
            return EXIT_DONE
        return EXIT_FAILED

    def verdicts(self) -> tuple[str, Cases]:
        """See `quadsim.console.junit.Judged`."""
        cases = [(entry.requirement.text, entry.holds, entry.sentence) for entry in self.judgements]
        return self.summary["campaign"], cases

    def __repr__(self) -> str:
        lines = [f"<CampaignResult {self.summary['campaign']}: {verdict_sentence(self.summary)}"]
        if self.summary["worst"]:
            worst = self.summary["worst"][0]
            lines.append(f"worst flight: {worst['flight']}, {worst['verdict']}")
            if worst["worst_constraint"] is not None:
                share = f"{worst['worst_margin']:.3g} times half its band"
                lines.append(f"its worst margin: {worst['worst_constraint']}, {share}")
        for judgement in self.judgements[:_REQUIREMENTS_IN_REPR]:
            lines.append(judgement.sentence)
        lines.append(f"in {self.directory}>")
        return "\n ".join(lines)

    def small_plot(self) -> Figure | None:
        """See `Result.small_plot`: worst margins and relevant parameters."""
        figure = campaign_overview(self.table, self.summary, "")
        if figure.panels:
            return figure
        return None

    def shown(self) -> Shown:
        """See `Result.shown`."""
        return campaign_lines(self.summary, self.judgements, self.directory)

    def to_json(self) -> dict[str, Any]:
        """Return `summary.json` and the verdict on each requirement."""
        return {**self.summary, "requirements": [judgement.to_json() for judgement in self.judgements]}

    def to_pandas(self) -> Any:
        """Return the table as a pandas DataFrame.

        Raises:
            MissingPackageError: pandas is not installed.
        """
        return to_pandas(self.table)


def fly_campaign(
    plan: Plan,
    directory: Path,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    until_width: float | None = None,
    report: bool = True,
    watch: Watch = lambda state: None,
) -> CampaignResult:
    """Fly a campaign or its missing flights; the rows do not depend on the workers.  See `quadsim.campaign`."""
    if until_width is not None and not 0.0 < until_width < 1.0:
        raise ParameterError("", "--until-width", until_width, "between 0 and 1")
    engine = "local" if cluster is None else "dask"
    entry = {"engine": engine, "workers": count_workers(workers, cluster), "flights": 0, "wall_s": None}
    if is_campaign(directory) and not (resume or overwrite):
        raise OutputError(directory, "a campaign is already there; continue it with --resume, or choose another --out")
    code_digest()  # kept: a process that dies before its manifest is there could not be resumed
    with growing(directory, MANIFEST_FILE, overwrite=overwrite, first=(CAMPAIGN_FILE, SCENARIO_FILE)) as files:
        if is_campaign(directory):
            require_same(plan, directory)
        session = _Session(plan, files, until_width=until_width, watch=watch)
        manifest = start_session(plan, files, entry, flying=bool(session.missing))
        if session.missing:
            files.remove(REPORT_FILES)  # an earlier report lacks the flights to come
        try:
            session.fly(workers, cluster)
        except BaseException:
            manifest["status"] = "interrupted"
            raise
        finally:
            entry["flights"] = session.flown
            entry["wall_s"] = clock.perf_counter() - session.started
            manifest["flown"] = session.completed
            write_manifest(manifest, files)

        table, summary = _close(plan, session, manifest, files)
        files.finish(summary, unhashed=UNREPRODUCIBLE)  # complete already, should the report fail
        with optional("the report"):
            if report:
                _replace_report(files, table, summary, plan.spec)
            else:
                files.remove(REPORT_FILES)
        files.finish(summary, unhashed=UNREPRODUCIBLE)  # now with the report among its files
        return CampaignResult(directory=files.path, manifest=manifest, table=table, summary=summary)


class _Session:
    """One call of `fly_campaign`: it flies the flights that are not on disk yet, until there are enough of them."""

    def __init__(self, plan: Plan, files: Growing, *, until_width: float | None, watch: Watch) -> None:
        self._plan = plan
        self._width = until_width
        self._watch = watch
        self.store = Store(files, plan.schema)
        self.needed = plan.spec.flights  # fewer once the interval is narrow enough
        self.flown = 0  # in this session
        self._checked = 0  # number of first flights after which the interval was last checked
        self.started = clock.perf_counter()
        self.outcomes = np.full(plan.spec.flights, -1, np.int8)  # -1 not flown, 0 passed, 1 failed
        stored = self.store.table()
        stored = stored.filter(pc.less(stored["flight"], plan.spec.flights))
        self.outcomes[stored["flight"].to_numpy()] = stored["failed"].to_numpy(zero_copy_only=False)

    @property
    def completed(self) -> int:
        """Number of the needed flights that have been flown, in earlier sessions too."""
        return int(np.count_nonzero(self.outcomes[: self.needed] >= 0))

    @property
    def missing(self) -> list[int]:
        """The flights that are still to be flown; none if the interval is narrow enough."""
        if self._is_narrow_enough():
            return []
        return list(np.flatnonzero(self.outcomes < 0).tolist())

    def fly(self, workers: int | None, cluster: str | None) -> None:
        """Fly missing flights until the campaign is complete or the interval is narrow enough.

        Raises:
            InputError: the interval is narrow enough after fewer flights than a finished campaign has.
        """
        missing = self.missing
        counted = self.store.counted()
        if self._is_narrow_enough() and self.needed < counted:
            narrow = f"the interval is as narrow after {self.needed} of the {counted} flights that are there"
            raise InputError(f"--until-width would leave out flights: {narrow}; go on without it")
        try:
            with closing(self._plan.fly_all(missing, workers=workers, cluster=cluster)) as rows:
                for row in rows:
                    self.store.add(row)
                    self.flown += 1
                    self.outcomes[row["flight"]] = row["failed"]
                    self._watch(self._progress())
                    if self._is_narrow_enough():
                        return
        finally:
            self.store.flush()

    def _progress(self) -> CampaignProgress:
        flown = int(np.count_nonzero(self.outcomes >= 0))
        failed = int(np.count_nonzero(self.outcomes >= 1))
        rate = self.flown / (clock.perf_counter() - self.started)
        return CampaignProgress(flown=flown, flights=self.needed, failed=failed, rate=rate)

    def _is_narrow_enough(self) -> bool:
        """Return whether the interval is narrow enough after the first n flights, for the smallest such n.

        Only flights without a gap before them count, so that the answer does not depend on which came back first.
        """
        if self._width is None:
            return False
        if self.needed < self.outcomes.size:
            return True
        without_gap = int(np.argmax(np.append(self.outcomes, -1) < 0))  # how many flights precede the first gap
        every = math.lcm(CHECK_EVERY, self._plan.spec.cells)  # each combination of the grids equally often
        for count in range(self._checked + every, without_gap + 1, every):
            self._checked = count
            failures = int(np.count_nonzero(self.outcomes[:count] == 1))
            estimated = proportion(failures, count)
            if estimated["upper"] - estimated["lower"] <= self._width:
                self.needed = count
                return True
        return False


def _close(plan: Plan, session: _Session, manifest: dict[str, Any], files: Growing) -> tuple[pa.Table, dict[str, Any]]:
    """Write the final tables and the manifest of them; return the table of flights and its summary.

    Raises:
        OutputError: they cannot be written.
    """
    table, times = session.store.close(session.needed)
    summary = {"campaign": plan.spec.name, "scenario": plan.scenario.name, "failure": [*plan.spec.failure]}
    summary |= estimate(table, plan.limits)
    # Number of flights by processor; a flight that raised or whose process died has none.
    processors = times["machine"].drop_null().to_pylist()
    manifest["machines"] = dict(sorted(Counter(processors).items()))
    if session.needed == plan.spec.flights:
        manifest["status"] = "complete"
    else:
        manifest["status"] = "stopped"
    manifest["files"] = {TIMES_FILE: digest_of(files.path / TIMES_FILE)}
    write_manifest(manifest, files)
    return table, summary


def _replace_report(files: Growing, table: pa.Table, summary: CampaignSummary, spec: CampaignFile) -> None:
    """Write the report, and remove all files of an earlier one.

    Raises:
        OutputError: it cannot be written.
    """
    with tempfile.TemporaryDirectory() as scratch:
        write_report(Path(scratch), table, summary, spec, campaign=files.path)
        written = {path.name: path.read_bytes() for path in Path(scratch).iterdir()}
    files.remove([name for name in REPORT_FILES if name not in written])
    files.write(written)


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """A flight of a finished campaign."""

    number: int
    row: Mapping[str, Any]  # of `flights.parquet`
    plan: Plan
    scenario: Scenario
    notes: Sequence[str]  # reasons why its numbers may differ when it is flown again


def recorded_flight(directory: Path, number: int | None) -> Recorded:
    """Return a flight of a campaign directory, by default the worst; see `quadsim.replay`."""
    plan = stored_plan(directory)
    table = read_flights(directory / FLIGHTS_FILE, plan.schema)
    if number is None:
        number = worst_flight(table)
    flights = table["flight"].to_pylist()
    if number not in flights:
        raise ParameterError("", "--flight", number, f"one of the flights 0 to {flights[-1]} of {directory}")
    row = table.slice(flights.index(number), 1).to_pylist()[0]
    notes = []
    differing = other_than_flew(read_manifest(directory), plan)
    if differing:
        notes.append(f"other {', '.join(differing)} flew that campaign, so numbers may differ")
    if row["verdict"] in (TIMEOUT, MEMORY):
        ended = f"flight {number} was ended in the campaign ({row['reason']})"
        notes.append(f"{ended}; here nothing ends it but Ctrl-C")
    return Recorded(number=number, row=row, plan=plan, scenario=plan.of(number), notes=notes)


@dataclass(frozen=True, kw_only=True, repr=False)
class Replay(Result):
    """A flight of a campaign, flown again."""

    recorded: Recorded  # as the campaign has it
    flight: Flight  # as it was flown now
    differing: Sequence[str]  # columns of the campaign's table that are not the same bit for bit

    @property
    def exit_status(self) -> int:
        """See `Result.exit_status`; 1 if its numbers differ from the campaign's."""
        if self.differing:
            return EXIT_FAILED
        return EXIT_DONE

    def shown(self) -> Shown:
        """See `Result.shown`."""
        return self.flight.shown()

    def outputs(self) -> Shown:
        """See `Result.outputs`; before them, whether the numbers are the campaign's."""
        from quadsim.console import console

        number = self.recorded.number
        count = len(self.recorded.row)
        if self.differing:
            yield console.styled((f"flight {number} differs from the campaign's in {', '.join(self.differing)}", "red"))
        else:
            yield f"flight {number}: {count} columns, each the same as in the campaign"
        yield from self.flight.outputs()

    def to_json(self) -> dict[str, Any]:
        """Return `summary.json` of the new flight."""
        return self.flight.to_json()

    def to_pandas(self, table: str = "flight") -> Any:
        """Return a table of the new flight, see `Flight.to_pandas`."""
        return self.flight.to_pandas(table)


def compare_replay(flight: Flight, recorded: Recorded) -> Replay:
    """Compare a replayed flight with the campaign's record of it."""
    row = recorded.plan.row_of(recorded.number, flight)
    (again,) = make_table([row], recorded.plan.schema).to_pylist()
    differing = []
    for name, value in recorded.row.items():
        if name not in again or again[name] != value:
            differing.append(name)
    return Replay(recorded=recorded, flight=flight, differing=differing)
