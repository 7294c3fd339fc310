"""A growing campaign directory: no stored flight is lost or stored twice, whichever process is killed.

Rows are appended as files of their own below `parts/`, every few seconds; those that a killed process had not yet
appended are flown again.  When all is flown the parts become `flights.parquet` and `timing.parquet`, and go.  The
manifest has what was flown, by which code, and how far it is.  `campaign` writes here, `paired` and replays read.
"""

from __future__ import annotations

import io
import shlex
import sys
import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from quadsim.errors import FileError, InputError
from quadsim.features.campaign.campaign_file import CampaignFile
from quadsim.features.campaign.plan import Plan, load_plan
from quadsim.features.campaign.rows import TIMES, make_table, read_table, split_times
from quadsim.flight.parquet import FORMAT, format_of, require_format
from quadsim.flight.rundir import SCENARIO_FILE, read_json, require_inside
from quadsim.outputs import SUMMARY_FILE, Growing, digest_of, to_json
from quadsim.report.page import PAGE_FILE
from quadsim.rollout.machine import code_digest, digest_below, machine, versions
from quadsim.rollout.many import Row
from quadsim.scenarios.plugin import Plugin, PluginForce, import_plugin

MANIFEST_FILE: Final = "manifest.json"
CAMPAIGN_FILE: Final = "campaign.toml"
CAMPAIGN: Final = "quadsim campaign"
_MANIFEST_TYPES: Final = {"format": str, "name": str, "status": str, "flights": int, "flown": int, "sessions": list}
FLIGHTS_FILE: Final = "flights.parquet"
TIMES_FILE: Final = "timing.parquet"
FLUSH_S: Final = 5.0  # how long an answer may wait in memory before it is on the disk [s]
PARTS_DIR: Final = "parts"
UNREPRODUCIBLE: Final = (TIMES_FILE, MANIFEST_FILE, PAGE_FILE)
"""Files with clock times, the machine or the directory's name, so that they differ where the flights are the same.

`summary.json` has no SHA-256 of them; `manifest.json` has that of `timing.parquet`.
"""


def read_flights(path: Path, schema: pa.Schema) -> pa.Table:
    """A campaign's table, with or without its clock times.

    Raises:
        FileError: it cannot be read, it has other columns than the campaign, or flights are there twice, or unsorted.
    """
    table = read_table(path)
    require_format(format_of(table), path, f"quadsim campaign {shlex.quote(str(path.parent / CAMPAIGN_FILE))}")
    types = {field.name: field.type for field in table.schema}
    for field in schema:
        if field.name not in TIMES and types.get(field.name) != field.type:
            raise FileError(path, "has other columns than this campaign")
    flights = table["flight"].to_numpy()
    if flights.size and (flights[0] < 0 or (np.diff(flights) <= 0).any()):
        raise FileError(path, "has flights that are not numbered upwards from 0")
    return table


class Store:
    """The rows of a campaign on disk, in the columns of `quadsim.features.campaign.rows.make_schema`."""

    def __init__(self, files: Growing, schema: pa.Schema) -> None:
        self._files = files
        self._directory = files.path
        self._schema = schema
        self._waiting: list[Row] = []
        self._flushed = clock.perf_counter()

    def table(self) -> pa.Table:
        """Return all stored flights, once each, sorted.

        Raises:
            FileError: a file is damaged or of another campaign.
        """
        tables = [self._schema.empty_table()]
        if (self._directory / FLIGHTS_FILE).is_file():
            tables.append(self._final_table())
        for name in self._parts():
            tables.append(read_flights(self._directory / name, self._schema))
        whole = pa.concat_tables([self._in_schema(table) for table in tables])
        _, first = np.unique(whole["flight"].to_numpy(), return_index=True)
        return whole.take(first)

    def _final_table(self) -> pa.Table:
        """Return the flights of the final two tables, with null for times that are of other flights."""
        table = read_flights(self._directory / FLIGHTS_FILE, self._schema)
        times = read_table(self._directory / TIMES_FILE)
        same_flights = times["flight"].equals(table["flight"])  # else the process died between the two files
        for name in TIMES:
            if same_flights:
                column = times[name]
            else:
                column = pa.nulls(table.num_rows, self._schema.field(name).type)
            table = table.append_column(name, column)
        return table

    def _in_schema(self, table: pa.Table) -> pa.Table:
        """Return the columns of the schema, in its order."""
        columns = [table[name] for name in self._schema.names]
        return pa.Table.from_arrays(columns, schema=self._schema)

    def counted(self) -> int:
        """Number of flights in the final table; 0 without one."""
        path = self._directory / FLIGHTS_FILE
        if path.is_file():
            return read_table(path).num_rows
        return 0

    def add(self, row: Row) -> None:
        """Add a row; it may stay in memory until `flush`, for a short time."""
        self._waiting.append(row)
        if clock.perf_counter() - self._flushed > FLUSH_S:
            self.flush()

    def flush(self) -> None:
        """Append the rows in memory."""
        self._flushed = clock.perf_counter()
        self.append(self._waiting)
        self._waiting = []  # not before: by Ctrl-C it is appended once more, to the same file

    def append(self, rows: Sequence[Row]) -> None:
        """Add rows in one step.

        Raises:
            OutputError: they cannot be written; what was there is still there.
        """
        if rows:
            first = min(row["flight"] for row in rows)
            name = f"{PARTS_DIR}/part-{first:09d}.parquet"
            self._files.write({name: _encoded(make_table(rows, self._schema))})

    def close(self, flights: int) -> tuple[pa.Table, pa.Table]:
        """Put the first `flights` flights into their final two tables, which are returned, and remove the parts.

        Raises:
            OutputError: they cannot be written; the parts are still there.
        """
        whole = self.table()
        table, times = split_times(whole.filter(pc.less(whole["flight"], flights)))
        self._files.write({TIMES_FILE: _encoded(times), FLIGHTS_FILE: _encoded(table)})
        self._files.remove(self._parts())
        return table, times

    def _parts(self) -> list[str]:
        """Return the paths of the parts, relative to the directory."""
        paths = (self._directory / PARTS_DIR).glob("part-*.parquet")
        return sorted(f"{PARTS_DIR}/{path.name}" for path in paths)


def _encoded(table: pa.Table) -> bytes:
    """Return the bytes of a Parquet file."""
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    return buffer.getvalue()


def start_session(plan: Plan, files: Growing, session: Mapping[str, Any], *, flying: bool) -> dict[str, Any]:
    """Start or resume a campaign: write the files that define it, the manifest last, and return the manifest.

    Raises:
        FileError: it is damaged.
        InputError: something has to be flown, and other code would fly it.
        OutputError: they cannot be written.
    """
    manifest: dict[str, Any] = {
        "format": CAMPAIGN,
        "version": FORMAT,
        "name": plan.spec.name,
        "description": plan.spec.description,
        "scenario": plan.scenario.name,
        "status": "running",
        "flights": plan.spec.flights,
        "flown": 0,
        **flown_by(plan),
        "sessions": [],
    }
    if is_campaign(files.path):
        known = read_manifest(files.path)
        differing = [name for name in other_than_flew(known, plan) if name != "machine"]
        if flying and differing:
            raise InputError(
                f"{files.path}: --resume needs the same code, and this one differs from what flew the first flights "
                f"({', '.join(differing)}): half of the numbers would be another program's; choose another --out"
            )
        manifest = {**known, "status": "running", "flights": plan.spec.flights}
        files.remove([SUMMARY_FILE])  # which is there, with the list of all others, while nothing is being flown
    manifest["sessions"].append(session)
    campaign_text = _stored(plan).to_toml()
    scenario_text = plan.scenario.to_toml()  # neither file needs any other
    files.write({CAMPAIGN_FILE: campaign_text.encode(), SCENARIO_FILE: scenario_text.encode()})
    write_manifest(manifest, files)
    return manifest


def write_manifest(manifest: Mapping[str, Any], files: Growing) -> None:
    """Write or replace the manifest in one step."""
    files.write({MANIFEST_FILE: to_json(manifest).encode()})


def require_same(plan: Plan, directory: Path) -> None:
    """Refuse to continue a campaign with a different one.

    Raises:
        FileError: there is none, or it is damaged.
        InputError: it is another one.
    """
    known = stored_plan(directory)
    spec = _stored(plan)
    known_spec = _stored(known)
    differing = []
    for field in fields(CampaignFile):
        if getattr(spec, field.name) != getattr(known_spec, field.name):
            differing.append(field.name)
    may_grow = plan.spec.sampling != "latin_hypercube" and plan.spec.flights >= known.spec.flights
    if differing == ["flights"] and may_grow:
        differing = []
    if known.scenario != plan.scenario:
        differing.append("scenario")
    if differing:
        rule = ""
        if differing == ["flights"]:
            rule = "; more flights may follow, except of a latin_hypercube"
        raise InputError(
            f"{directory}: --resume needs the same campaign, and its {', '.join(differing)} differs from "
            f"the one there{rule}; choose another --out"
        )


def other_than_flew(manifest: Mapping[str, Any], plan: Plan) -> list[str]:
    """Return the entries of `flown_by` that changed since the campaign started."""
    return [name for name, value in flown_by(plan).items() if manifest.get(name) != value]


def flown_by(plan: Plan) -> dict[str, Any]:
    """Return versions and hashes of everything outside the campaign's files that affects numbers; imports user code."""
    controller = plan.scenario.controller
    controller_code = None
    if isinstance(controller, Plugin):
        controller_code = _user_code_digest(controller)
    force_code = [_user_code_digest(force) for force in plan.scenario.forces]
    return {
        "code": code_digest(),
        "controller": controller_code,
        "forces": force_code or None,
        "versions": versions(),
        "machine": machine(),
    }


def _user_code_digest(spec: Plugin | PluginForce) -> str | None:
    """SHA-256 of a user's module, or of the whole package that it is in; None without a file."""
    package, _, _rest = import_plugin(spec).__module__.partition(".")
    file = getattr(sys.modules[package], "__file__", None)
    if file is None:
        return None
    path = Path(file)
    if path.name == "__init__.py":
        path = path.parent
    return digest_below([path])


def read_manifest(directory: Path) -> dict[str, Any]:
    """`manifest.json` of a campaign.

    Raises:
        FileError: there is none, or it is not one of ours.
    """
    path = directory / MANIFEST_FILE
    if not path.is_file():
        raise FileError(directory, f"is not a campaign: it has no {MANIFEST_FILE}")
    require_inside(directory)
    manifest = _read_manifest(path)
    require_format(manifest.get("version"), path, f"quadsim campaign {shlex.quote(str(directory / CAMPAIGN_FILE))}")
    return manifest


def _read_manifest(path: Path) -> dict[str, Any]:
    manifest = read_json(path, _MANIFEST_TYPES, "a campaign's manifest")
    if manifest["format"] != CAMPAIGN:
        raise FileError(path, "is not a campaign's manifest: it lacks or misstates format")
    return manifest


def is_campaign(directory: Path) -> bool:
    """Whether a path is a campaign's directory, of whatever version."""
    if not (directory / MANIFEST_FILE).is_file():
        return False
    try:
        require_inside(directory)
        _read_manifest(directory / MANIFEST_FILE)
    except FileError:
        return False
    return True


def stored_plan(directory: Path) -> Plan:
    """Load the campaign of a directory from its files.

    Raises:
        FileError: it is none, or a file is missing or not the one that was flown.
    """
    manifest = read_manifest(directory)
    digests: dict[str, str] = {}
    if (directory / SUMMARY_FILE).exists():  # it is finished
        summary = read_json(directory / SUMMARY_FILE, {}, "a campaign's summary")
        digests = {**manifest.get("files", {}), **summary.get("files", {})}
    required = [CAMPAIGN_FILE, SCENARIO_FILE]
    for name in (FLIGHTS_FILE, TIMES_FILE):
        if name in digests:
            required.append(name)
    for name in required:
        path = directory / name
        if not path.is_file() or (name in digests and digest_of(path) != digests[name]):
            raise FileError(path, "is missing or not the file that was written")
    return load_plan(str(directory / CAMPAIGN_FILE))


def _stored(plan: Plan) -> CampaignFile:
    """Return the campaign file in its directory, with the scenario beside it."""
    return replace(plan.spec, scenario=SCENARIO_FILE, set={})
