"""One directory per run: complete or not there at all, with a SHA-256 per file."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final

from quadsim.audit import Finding, Limit
from quadsim.errors import FileError
from quadsim.flightlog import FlightLog, read_log
from quadsim.outputs import LOCK_FILE, MANIFEST_FILE, digest, digest_of, growing, to_json
from quadsim.vehicle import Vehicle

SUMMARY_FILE: Final = "summary.json"
SCENARIO_FILE: Final = "scenario.toml"
RECORDING_FILE: Final = "flight.rrd"
VIDEO_FILE: Final = "flight.mp4"
FIGURES_DIR: Final = "figures"
KIND: Final = "run"
"""What `quadsim.outputs` calls a run directory."""

_SUMMARY_TYPES: Final = {
    "scenario": str,
    "status": str,
    "reason": str | None,
    "satisfied": bool,
    "duration": float,
    "tracking": dict,
    "constraints": list,
    "control": dict,
    "controller": dict,
    "vehicle": dict,
    "files": dict,
}


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


def read_json(path: Path, kinds: Mapping[str, Any], what: str) -> dict[str, Any]:
    """A JSON object from a file of ours.

    Args:
        path: of the file.
        kinds: types of the entries that it has to have.
        what: it is, for messages.

    Raises:
        FileError: it cannot be read, or an entry is missing or of another type.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise FileError(path, f"is not {what} ({error})") from error
    if not isinstance(found, dict):
        raise FileError(path, f"is not {what}: it is no table")
    wrong = [name for name, kind in kinds.items() if not isinstance(found.get(name, ...), kind)]
    if wrong:
        raise FileError(path, f"is not {what}: it lacks or misstates {', '.join(wrong)}")
    return found


def is_run(directory: Path) -> bool:
    """Whether a path is a run directory: one with a summary of ours, since others write a `summary.json` too."""
    try:
        read_summary(directory)
    except FileError:
        return False
    return True


def read_summary(directory: Path) -> dict[str, Any]:
    """`summary.json` of a run directory.

    Raises:
        FileError: there is none, or it is not one of ours.
    """
    path = directory / SUMMARY_FILE
    if not path.is_file():
        raise FileError(directory, f"is not a run directory: it has no {SUMMARY_FILE}")
    return read_json(path, _SUMMARY_TYPES, "a run's summary")


def load_run(directory: Path) -> Run:
    """Read a run back.

    Raises:
        FileError: a file is missing or damaged.
    """
    summary = read_summary(directory)
    try:
        vehicle = Vehicle(**summary["vehicle"])
        limits = tuple(limit_from_json(entry) for entry in summary["constraints"])
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(directory / SUMMARY_FILE, f"is damaged ({error})") from error
    log = read_log(directory, reason=summary["reason"])
    return Run(directory=directory, summary=summary, log=log, vehicle=vehicle, limits=limits)


def file_hashes(directory: Path) -> dict[str, str]:
    """SHA-256 of every file below a directory but the summary and our own bookkeeping, by relative path, sorted."""
    paths = sorted(path for path in directory.rglob("*") if path.is_file())
    names = [path.relative_to(directory).as_posix() for path in paths]
    return {name: digest_of(directory / name) for name in names if name not in (SUMMARY_FILE, MANIFEST_FILE, LOCK_FILE)}


@contextlib.contextmanager
def adding(directory: Path, name: str) -> Iterator[Callable[[bytes], None]]:
    """Add a product such as the film to a run directory, or replace it, together with its hash in the summary.

    Args:
        directory: of the run.
        name: of the file, relative to it.

    Yields:
        What takes the file's content and writes it.

    Raises:
        FileError: it is not a run directory.
        OutputError: it cannot be written, or the file or the summary is not as we wrote it.
    """
    read_summary(directory)
    with growing(directory, KIND) as files:
        files.require([name, SUMMARY_FILE])

        def write(content: bytes) -> None:
            summary = read_summary(directory)
            summary["files"] = dict(sorted({**summary["files"], name: digest(content)}.items()))
            files.write({name: content, SUMMARY_FILE: to_json(summary).encode()})

        yield write


def damaged_files(directory: Path, summary: Mapping[str, Any]) -> list[str]:
    """Files named in the summary that are missing or whose SHA-256 is not the recorded one."""
    found = file_hashes(directory)
    return [name for name, digest in summary["files"].items() if found.get(name) != digest]
