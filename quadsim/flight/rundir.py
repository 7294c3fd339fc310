"""One directory per run: complete or not there at all, with a SHA-256 per file."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

from quadsim.errors import FileError
from quadsim.flight.audit import Finding, Limit, SpaceLimit, SumLimit
from quadsim.flight.log import FlightLog
from quadsim.flight.parquet import (
    FLIGHT_FILE,
    HORIZON_FILE,
    PLANT_FILE,
    TIMING_FILE,
    add_metadata,
    read_log,
    read_metadata,
)
from quadsim.flight.summary import SUMMARY_FILE as SUMMARY_FILE
from quadsim.flight.summary import read_summary as read_summary
from quadsim.flight.summary import summary_digest
from quadsim.outputs import LOCK_FILE, MANIFEST_FILE, digest, digest_of, growing, to_json, write_json
from quadsim.space import shape_from_json, shape_to_json
from quadsim.vehicle import Vehicle

SCENARIO_FILE: Final = "scenario.toml"
RECORDING_FILE: Final = "flight.rrd"
VIDEO_FILE: Final = "flight.mp4"
FIGURES_DIR: Final = "figures"
KIND: Final = "run"  # what `quadsim.outputs` calls a run directory
UNLISTED: Final = (SUMMARY_FILE, MANIFEST_FILE, LOCK_FILE)  # files of quadsim's whose hashes the summary does not have
SEAL: Final = "summary"  # under which `timing.parquet` keeps the summary's digest


@dataclass(frozen=True, kw_only=True)
class Run:
    """A finished run, read back from its directory."""

    directory: Path  # where it is
    summary: dict[str, Any]  # `summary.json`
    log: FlightLog  # the flight, its plant rows at the log rate
    vehicle: Vehicle  # the vehicle flown, as it really is
    limits: tuple[Limit, ...]  # the constraints it was audited against

    @property
    def name(self) -> str:
        """The scenario's name."""
        return str(self.summary["scenario"])

    @property
    def end(self) -> float:
        """Last time of the flight [s]."""
        return float(self.log.plant.t[-1])


def limit_to_json(finding: Finding) -> dict[str, Any]:
    """One entry of `constraints` in `summary.json`; an absent bound, or a window the flight never reached, is null."""
    limit = finding.limit
    stated = {name: value for name, value in vars(limit).items() if name not in ("name", "signal", "terms", "shape")}
    found = {name: value for name, value in vars(finding).items() if name != "limit"}
    return {
        "name": limit.name,
        "signal": limit.signal,
        **({"terms": dict(limit.terms)} if isinstance(limit, SumLimit) else {}),
        **({"shape": shape_to_json(limit.shape)} if isinstance(limit, SpaceLimit) else {}),
        "unit": limit.unit,
        **{name: value if math.isfinite(value) else None for name, value in (stated | found).items()},
        "satisfied": finding.satisfied,
    }


def limit_from_json(entry: Mapping[str, Any]) -> Limit:
    """The limit that `limit_to_json` wrote."""
    absent = {"lower": -math.inf, "upper": math.inf, "stop": math.inf}
    values = {field.name: entry[field.name] for field in fields(Limit)}
    values |= {name: bound for name, bound in absent.items() if values[name] is None}
    if entry.get("shape"):
        return SpaceLimit(shape=shape_from_json(entry["shape"]), radius=float(entry["radius"]), **values)
    if not entry.get("terms"):
        return Limit(**values)
    return SumLimit(terms=tuple((name, float(factor)) for name, factor in entry["terms"].items()), **values)


def finding_from_json(entry: Mapping[str, Any]) -> Finding:
    """The finding that `limit_to_json` wrote."""
    names = ("peak_sampled", "peak_plant", "worst_margin_sampled", "worst_margin", "worst_time", "time_violated")
    values = {name: math.nan if entry[name] is None else float(entry[name]) for name in names}
    return Finding(limit=limit_from_json(entry), **values)


def load_run(directory: Path) -> Run:
    """Read a run back.

    Raises:
        FileError: a file is missing or damaged.
    """
    summary = read_summary(directory)
    try:
        vehicle = Vehicle(**summary.get("actual", summary["vehicle"]))
        limits = tuple(limit_from_json(entry) for entry in summary["constraints"])
    except (ArithmeticError, TypeError, ValueError) as error:
        raise FileError(directory / SUMMARY_FILE, f"is damaged ({error})") from error
    log = read_log(directory, reason=summary["reason"])
    return Run(directory=directory, summary=summary, log=log, vehicle=vehicle, limits=limits)


def file_hashes(directory: Path) -> dict[str, str]:
    """SHA-256 of every file below a directory but the summary and our own bookkeeping, by relative path, sorted.

    Raises:
        FileError: one cannot be read.
    """
    hashes = {}
    for path in sorted(path for path in directory.rglob("*") if path.is_file()):
        name = path.relative_to(directory).as_posix()
        if name not in UNLISTED:
            try:
                hashes[name] = digest_of(path)
            except OSError as error:
                raise FileError(path, f"cannot be read ({error.strerror})") from error
    return hashes


@contextlib.contextmanager
def adding(directory: Path, name: str) -> Iterator[Path]:
    """Add a product such as the film to a run directory, or replace it, together with its hash in the summary.

    Args:
        directory: of the run.
        name: of the file, relative to it.

    Yields:
        The file to make, which gets its name when the block ends well.

    Raises:
        FileError: it is not a run directory.
        OutputError: it cannot be written, or the file or the summary is not as we wrote it.
    """
    read_summary(directory)
    with growing(directory, KIND) as files:
        files.require([name, SUMMARY_FILE])
        new = files.scratch / name
        yield new
        content, summary = new.read_bytes(), read_summary(directory)
        summary["files"] = dict(sorted({**summary["files"], name: digest(content)}.items()))
        files.write({name: content, SUMMARY_FILE: to_json(summary).encode()})


def seal(directory: Path, summary: Mapping[str, Any]) -> None:
    """Write the summary of a run whose files are all there, with their hashes, and its digest into `timing.parquet`.

    So the summary shows a change of another file, and `timing.parquet` one of the summary.

    Raises:
        OutputError: they cannot be written.
    """
    hashes = file_hashes(directory)
    add_metadata(directory / TIMING_FILE, {SEAL: summary_digest(summary, _fixed(hashes))})
    write_json(directory / SUMMARY_FILE, {**summary, "files": file_hashes(directory)})


def damaged_files(directory: Path, summary: Mapping[str, Any]) -> list[str]:
    """Files named in the summary that are missing or whose SHA-256 is not the recorded one."""
    found = file_hashes(directory)
    return [name for name, digest in summary["files"].items() if found.get(name) != digest]


def is_sealed(directory: Path, summary: Mapping[str, Any]) -> bool | None:
    """Whether a run's summary is the one that was written with it; None for a run that does not say.

    Raises:
        FileError: `timing.parquet` cannot be read.
    """
    recorded = read_metadata(directory / TIMING_FILE).get(SEAL)
    return None if recorded is None else recorded == summary_digest(summary, _fixed(summary["files"]))


def _fixed(hashes: Mapping[str, str]) -> dict[str, str]:
    """Hashes of what is made once, and holds no clock reading."""
    return {name: hashes[name] for name in (SCENARIO_FILE, FLIGHT_FILE, PLANT_FILE, HORIZON_FILE) if name in hashes}
