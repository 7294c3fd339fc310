"""Fly a campaign: what is missing is flown, rows are saved as they come, the whole is summed up."""

from __future__ import annotations

import math
import tempfile
import time as clock
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from quadsim.errors import InputError, OutputError, ParameterError
from quadsim.outputs import SUMMARY_FILE as SUMMARY_FILE
from quadsim.outputs import Growing, growing
from scenarios.campaign import manifest as records
from scenarios.campaign.pilot import CampaignPilot, fly_flights
from scenarios.campaign.plan import Plan
from scenarios.campaign.report.campaign_page import write_report
from scenarios.campaign.results.store import TIMES_FILE, Store
from scenarios.campaign.results.table import Row, read_table
from scenarios.campaign.statistics.estimates import estimate
from scenarios.campaign.statistics.inference import proportion
from scenarios.campaign.statistics.requirement import Judgement
from scenarios.flight import to_pandas
from scenarios.many import count_workers

REPORT_FILES: Final = ("index.html", "campaign.png")
CHECK_EVERY: Final = 10
"""Flights after which the interval is looked at again, where it decides when to stop; of grids, whole turns."""


@dataclass(frozen=True, kw_only=True)
class Standing:
    """How far a campaign is."""

    flown: int  # flights that are there
    flights: int  # that there are to be
    failed: int  # of those flown
    rate: float  # flights per second of this session; 0 before the first


Watch = Callable[[Standing], None]


@dataclass(frozen=True, kw_only=True)
class Result:
    """What came of a campaign.

    Attributes:
        directory: where everything is.
        manifest: what was flown, with what.
        table: `flights.parquet`.
        summary: `summary.json`.
        failure: the events of which any one makes a flight fail.
        judgements: of the requirements that were stated.
    """

    directory: Path
    manifest: dict[str, Any]
    table: pa.Table
    summary: dict[str, Any]
    failure: tuple[str, ...]
    judgements: tuple[Judgement, ...] = ()

    def to_pandas(self) -> Any:
        """The table as a pandas DataFrame.

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
    watch: Watch = lambda standing: None,
) -> Result:
    """Fly a campaign, or what is missing of it.

    Each flight's row is the same with any worker and order; so is the table of all.  Whatever ends this
    early, what was flown stays, and `resume` continues it.

    Args:
        plan: the campaign.
        directory: where its results go.
        workers: see `scenarios.many.fly_many`.
        cluster: the same.
        resume: whether to continue what the directory holds; without it there must be nothing there.
        overwrite: whether to replace an earlier output there.
        until_width: width of the 95 % interval of the failure probability, from 0 to 1, at which to stop.
        report: whether to write the page and its figure.
        watch: called with the progress, as answers come.

    Raises:
        InputError: another campaign is there, or `until_width` would leave out flights that are there.
        OutputError: the directory cannot be written, or another process flies there.
        KeyboardInterrupt: a person stopped it; what was flown is there.
    """
    if until_width is not None and not 0.0 < until_width < 1.0:
        raise ParameterError("", "--until-width", until_width, "between 0 and 1")
    session = new_session(workers, cluster)
    if records.is_campaign(directory) and not (resume or overwrite):
        raise OutputError(directory, "a campaign is already there; continue it with --resume, or choose another --out")
    with growing(directory, records.MANIFEST_FILE, overwrite=overwrite) as files:
        going_on = records.is_campaign(directory)
        if going_on:
            records.require_same(plan, directory)
        progress = _Progress(plan, files, until_width=until_width, watch=watch)
        manifest = records.go_on(plan, files, flying=progress.missing) if going_on else records.begin(plan, files)
        manifest["sessions"].append(session)
        records.write(manifest, files)
        try:
            progress.fly(workers, cluster)
        except BaseException:
            manifest["status"] = "interrupted"
            raise
        finally:
            session |= {"flights": progress.flown, "wall_s": clock.perf_counter() - progress.started}
            manifest["flown"] = progress.done
            records.write(manifest, files)
        return _conclude(plan, files, progress, manifest, report=report)


def new_session(workers: int | None, cluster: str | None) -> dict[str, Any]:
    """What a manifest has of a session, before its first flight.

    Raises:
        QuadsimError: nobody can fly so; see `scenarios.many.fly_many`.
    """
    engine = "local" if cluster is None else "dask"
    return {"engine": engine, "workers": count_workers(workers, cluster), "flights": 0, "wall_s": None}


class _Progress:
    """A session: what is there, what is still to be flown, and what is waiting to be written."""

    def __init__(self, plan: Plan, files: Growing, *, until_width: float | None, watch: Watch) -> None:
        self.store = Store(files, plan.schema)
        self.wanted = plan.spec.flights
        self.flown = 0
        self.started = clock.perf_counter()
        self._plan, self._width, self._watch = plan, until_width, watch
        self._outcomes = np.full(plan.spec.flights, -1, np.int8)  # not flown, passed, failed
        self._checked = 0
        there = self.store.table().select(["flight", "failed"])
        self._counted = self.store.counted()
        within = there.filter(pc.less(there["flight"], plan.spec.flights))
        self._note(within["flight"].to_numpy(), within["failed"].to_numpy(zero_copy_only=False))

    @property
    def missing(self) -> bool:
        return bool((self._outcomes < 0).any()) and not self._is_sure()

    @property
    def done(self) -> int:
        return int(np.count_nonzero(self._outcomes[: self.wanted] >= 0))

    def fly(self, workers: int | None, cluster: str | None) -> None:
        """Fly what is missing, until nothing is, or the interval is narrow enough.

        Raises:
            InputError: it is so before flights that a finished campaign has.
        """
        if self._is_sure() and self.wanted < self._counted:
            given = f"the interval is as narrow after {self.wanted} of the {self._counted} flights that are there"
            raise InputError(f"--until-width would leave out flights: {given}; go on without it")
        if not self.missing:
            return
        missing = np.flatnonzero(self._outcomes < 0).tolist()
        try:
            with closing(fly_flights(CampaignPilot(self._plan), missing, workers=workers, cluster=cluster)) as rows:
                for row in rows:
                    self._keep(row)
                    if self._is_sure():
                        return
        finally:
            self.store.flush()

    def _keep(self, row: Row) -> None:
        self.store.add(row)
        self.flown += 1
        self._note(row["flight"], row["failed"])
        elapsed = clock.perf_counter() - self.started
        failed = int(np.count_nonzero(self._outcomes == 1))
        there = int(np.count_nonzero(self._outcomes >= 0))
        self._watch(Standing(flown=there, flights=self.wanted, failed=failed, rate=self.flown / elapsed))

    def _note(self, flights: Any, failed: Any) -> None:
        self._outcomes[np.asarray(flights, int)] = np.asarray(failed, np.int8)

    def _is_sure(self) -> bool:
        """Whether the interval is narrow enough after the first n flights, for the smallest such n.

        Only flights without a gap before them count, so that the answer does not depend on which came back first.
        """
        if self._width is None:
            return False
        if self.wanted < self._outcomes.size:
            return True
        gaps = np.flatnonzero(self._outcomes < 0)
        whole = int(gaps[0]) if gaps.size else self._outcomes.size
        every = math.lcm(CHECK_EVERY, self._plan.spec.cells)  # whole turns of the grids
        for count in range(self._checked + every, whole + 1, every):
            self._checked = count
            share = proportion(int(np.count_nonzero(self._outcomes[:count] == 1)), count)
            if share.upper - share.lower <= self._width:
                self.wanted = count
                return True
        return False


def _conclude(plan: Plan, files: Growing, progress: _Progress, manifest: dict[str, Any], *, report: bool) -> Result:
    """Final tables, estimates and report."""
    directory = files.path
    table = progress.store.close(progress.wanted)
    summary = {"campaign": plan.spec.name, "scenario": plan.scenario.name, **estimate(table)}
    write = partial(
        write_report,
        campaign=directory,
        table=table,
        summary=summary,
        name=plan.spec.name,
        description=plan.spec.description,
        failure=plan.spec.failure,
    )
    put_report(files, REPORT_FILES, write if report else None)
    # flights by the processor that flew them; those that raised, or that no process came back from, have none
    processors = read_table(directory / TIMES_FILE)["machine"].drop_null().to_pylist()
    manifest["machines"] = dict(sorted(Counter(processors).items()))
    manifest["status"] = "complete" if progress.wanted == plan.spec.flights else "stopped"
    records.write(manifest, files)
    files.finish(summary)
    return Result(
        directory=directory, manifest=manifest, table=table, summary=summary, failure=tuple(plan.spec.failure)
    )


def put_report(files: Growing, names: Sequence[str], write: Callable[[Path], object] | None) -> None:
    """Put what a function writes into a directory there, file by file; without one, remove an earlier report.

    Raises:
        OutputError: they cannot be written.
    """
    if write is None:
        files.remove(names)
        return
    with tempfile.TemporaryDirectory() as scratch:
        write(Path(scratch))
        files.write({name: (Path(scratch) / name).read_bytes() for name in names})
