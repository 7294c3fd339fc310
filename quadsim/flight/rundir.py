"""A run's directory: tables, scenario and summary first, then what is made from them; each file with its SHA-256."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

from quadsim.errors import FileError
from quadsim.flight.audit import Finding, Held, Limit, SpaceLimit, SumLimit
from quadsim.flight.log import FlightLog
from quadsim.flight.parquet import read_log
from quadsim.flight.summary import SUMMARY_FILE as SUMMARY_FILE
from quadsim.flight.summary import read_summary as read_summary
from quadsim.outputs import file_hashes
from quadsim.space import shape_from_json, shape_to_json
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
        "verdict": finding.verdict,
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


def constraint_verdict(entry: Mapping[str, Any]) -> Held:
    """The verdict on a constraint of a summary that follows from its margins."""
    return finding_from_json(entry).verdict


def deciding_margin(entry: Mapping[str, Any]) -> tuple[float | None, float]:
    """The margin that this verdict rests on, None where there is none, and its tolerance."""
    margin, tolerance = finding_from_json(entry).deciding
    return None if math.isnan(margin) else margin, tolerance


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
