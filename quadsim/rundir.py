"""One directory per run: complete or not there at all, with a SHA-256 per file."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final

from quadsim.audit import Finding, Limit
from quadsim.errors import FileError, OutputError
from quadsim.flightlog import (
    FLIGHT_FILE,
    HORIZON_FILE,
    PLANT_FILE,
    TIMING_FILE,
    FlightLog,
    add_metadata,
    read_log,
    read_metadata,
)
from quadsim.summary import SUMMARY_FILE as SUMMARY_FILE
from quadsim.summary import read_summary as read_summary
from quadsim.summary import summary_digest
from quadsim.vehicle import Vehicle

SCENARIO_FILE: Final = "scenario.toml"
RECORDING_FILE: Final = "flight.rrd"
VIDEO_FILE: Final = "flight.mp4"
FIGURES_DIR: Final = "figures"
SEAL: Final = "summary"
"""Under which `timing.parquet` keeps the summary's digest."""

_FREE_BYTES_NEEDED: Final = 16 * 1024 * 1024


@dataclass(frozen=True, kw_only=True)
class Run:
    """A finished run, read back from its directory.

    Attributes:
        directory: where it is.
        summary: `summary.json`.
        log: the flight, its plant rows at the log rate.
        vehicle: the vehicle flown.
        limits: the constraints it was audited against.
    """

    directory: Path
    summary: dict[str, Any]
    log: FlightLog
    vehicle: Vehicle
    limits: tuple[Limit, ...]

    @property
    def name(self) -> str:
        """The scenario's name."""
        return str(self.summary["scenario"])


def vehicle_to_json(vehicle: Vehicle) -> dict[str, Any]:
    """The vehicle's numbers for `summary.json`."""
    return asdict(vehicle)


def limit_to_json(finding: Finding) -> dict[str, Any]:
    """One entry of `constraints` in `summary.json`; an absent bound, or a window the flight never reached, is null."""
    limit = finding.limit

    def finite(value: float) -> float | None:
        return value if math.isfinite(value) else None

    return {
        "name": limit.name,
        "signal": limit.signal,
        "unit": limit.unit,
        "lower": finite(limit.lower),
        "upper": finite(limit.upper),
        "tolerance": limit.tolerance,
        "tolerance_sampled": limit.tolerance_sampled,
        "required": limit.required,
        "start": limit.start,
        "stop": finite(limit.stop),
        "peak_sampled": finite(finding.peak_sampled),
        "peak_plant": finite(finding.peak_plant),
        "worst_margin_sampled": finite(finding.worst_margin_sampled),
        "worst_margin": finite(finding.worst_margin),
        "worst_time": finite(finding.worst_time),
        "time_violated": finding.time_violated,
        "satisfied": finding.satisfied,
    }


def limit_from_json(entry: Mapping[str, Any]) -> Limit:
    """The limit that `limit_to_json` wrote."""
    absent = {"lower": -math.inf, "upper": math.inf, "stop": math.inf}
    values: dict[str, Any] = {field.name: entry[field.name] for field in fields(Limit)}
    return Limit(**values | {name: bound for name, bound in absent.items() if values[name] is None})


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write strict JSON (no NaN), in one step; see `write_atomically`."""
    write_atomically(path, json.dumps(data, indent=2, allow_nan=False) + "\n")


def write_atomically(path: Path, text: str) -> None:
    """Write or replace a text file in one step.

    Raises:
        OutputError: it cannot be written; what was there is still there.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        temporary.write_text(text, encoding="utf-8")
        temporary.replace(path)
    except OSError as error:
        raise OutputError(path, error.strerror or str(error)) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def is_run(directory: Path) -> bool:
    """Whether a path is a run directory: one with a summary of ours, since others write a `summary.json` too."""
    try:
        read_summary(directory)
    except FileError:
        return False
    return True


def holds_run_alone(directory: Path) -> bool:
    """Whether a directory is a run and holds no file but the run's own, so that it may be replaced."""
    try:
        own = {SUMMARY_FILE, *read_summary(directory)["files"]}
    except FileError:
        return False
    return all(path.relative_to(directory).as_posix() in own for path in directory.rglob("*") if path.is_file())


def load_run(directory: Path) -> Run:
    """Read a run back.

    Raises:
        FileError: a file is missing or damaged.
    """
    summary = read_summary(directory)
    try:
        vehicle = Vehicle(**summary["vehicle"])
        limits = tuple(limit_from_json(entry) for entry in summary["constraints"])
    except (ArithmeticError, TypeError, ValueError) as error:
        raise FileError(directory / SUMMARY_FILE, f"is damaged ({error})") from error
    log = read_log(directory, reason=summary["reason"])
    return Run(directory=directory, summary=summary, log=log, vehicle=vehicle, limits=limits)


def file_hashes(directory: Path) -> dict[str, str]:
    """SHA-256 of every file below a directory but the summary, by relative path, sorted.

    Raises:
        FileError: one cannot be read.
    """
    paths = sorted(path for path in directory.rglob("*") if path.is_file() and path.name != SUMMARY_FILE)
    return {
        path.relative_to(directory).as_posix(): "sha256:" + hashlib.sha256(_content(path)).hexdigest() for path in paths
    }


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise FileError(path, f"cannot be read ({error.strerror})") from error


def seal(directory: Path, summary: Mapping[str, Any]) -> None:
    """Write the summary of a run whose files are all there, with their hashes, and its digest into `timing.parquet`.

    So the summary says when another file is changed, and `timing.parquet` when the summary is.

    Raises:
        OutputError: they cannot be written.
    """
    hashes = file_hashes(directory)
    add_metadata(directory / TIMING_FILE, {SEAL: summary_digest(summary, _fixed(hashes))})
    write_json(directory / SUMMARY_FILE, {**summary, "files": file_hashes(directory)})


def refresh_hash(directory: Path, name: str) -> None:
    """Record the hash of one of a run's files again, after a product such as the video was added; no other's."""
    summary = read_summary(directory)
    hashes = {**summary["files"], name: file_hashes(directory)[name]}
    write_json(directory / SUMMARY_FILE, {**summary, "files": dict(sorted(hashes.items()))})


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


@contextlib.contextmanager
def writing(target: Path, replaces: Callable[[Path], bool] = holds_run_alone) -> Iterator[Path]:
    """A directory to fill, which becomes `target` when the block ends well and vanishes when it does not.

    Parents that are missing are made, and vanish with it.

    Args:
        target: the directory to make.
        replaces: whether a directory that is already there, and not empty, may go: an earlier one of the same kind.

    Raises:
        OutputError: the place cannot be written, is nearly full, or holds something else.
    """
    target = Path(target)
    missing: list[Path] = []
    temporary: Path | None = None
    try:
        occupied = target.exists() and not (target.is_dir() and (replaces(target) or not any(target.iterdir())))
        if occupied:
            raise OutputError(target, "something else is already there; choose another --out")
        files = [parent for parent in target.parents if parent.is_file()]
        if files:
            raise OutputError(target, f"{files[0]} is a file")
        missing = [parent for parent in target.parents if not parent.exists()]
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".partial", dir=target.parent))
        if shutil.disk_usage(temporary).free < _FREE_BYTES_NEEDED:
            raise OutputError(target, "the disk is full")
        temporary.chmod(0o755)
        yield temporary
        _replace(temporary, target)
    except OutputError as error:
        if temporary is None or not error.path.is_relative_to(temporary):
            raise
        raise OutputError(target / error.path.relative_to(temporary), error.problem) from error
    except OSError as error:
        raise OutputError(target, error.strerror or str(error)) from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
        for parent in missing:  # from the innermost outwards; one that is not empty stays
            with contextlib.suppress(OSError):
                parent.rmdir()


def _replace(temporary: Path, target: Path) -> None:
    if not target.exists():
        temporary.rename(target)
        return
    old = temporary.with_suffix(".old")
    target.rename(old)
    try:
        temporary.rename(target)
    except OSError:
        old.rename(target)
        raise
    shutil.rmtree(old, ignore_errors=True)
