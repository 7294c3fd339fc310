"""A run's directory: tables, scenario and summary first, then what is made from them; each file with its SHA-256."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from quadsim.errors import FileError
from quadsim.flight.audit import Limit
from quadsim.flight.log import FlightLog
from quadsim.flight.parquet import read_log
from quadsim.flight.summary import SUMMARY_FILE as SUMMARY_FILE
from quadsim.flight.summary import limit_from_json
from quadsim.flight.summary import read_summary as read_summary
from quadsim.outputs import file_hashes
from quadsim.vehicle import Vehicle

SCENARIO_FILE: Final = "scenario.toml"
RECORDING_FILE: Final = "flight.rrd"
VIDEO_FILE: Final = "flight.mp4"
FIGURES_DIR: Final = "figures"


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


def load_run(directory: Path) -> Run:
    """Read a run back.

    Raises:
        FileError: a file is missing or damaged.
    """
    summary = read_summary(directory)
    try:
        vehicle = Vehicle(**summary.get("actual", summary["vehicle"]))
        limits = tuple(limit_from_json(entry) for entry in summary["constraints"])
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise FileError(directory / SUMMARY_FILE, f"is damaged ({error})") from error
    raised = tuple(summary.get("traceback", ()))
    interrupted = summary.get("verdict") == "aborted" and not raised
    log = replace(read_log(directory, reason=summary["reason"]), interrupted=interrupted, traceback=raised)
    return Run(directory=directory, summary=summary, log=log, vehicle=vehicle, limits=limits)


def damaged_files(directory: Path, summary: Mapping[str, Any]) -> list[str]:
    """Files named in the summary that are missing or whose SHA-256 is not the recorded one."""
    found = file_hashes(directory)
    return [name for name, digest in summary["files"].items() if found.get(name) != digest]
