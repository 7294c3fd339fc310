"""A run's directory: its files, and `summary.json`, with the SHA-256 of each; limits and findings to JSON and back.

`quadsim.rollout.flown` writes it, `quadsim.rollout.stored` and `quadsim.rollout.reaudit` read it.
"""

from __future__ import annotations

import json
import math
import os
import shlex
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from types import NoneType
from typing import Any, Final

from quadsim.errors import FileError, printable
from quadsim.flight.audit import Finding, Limit, SpaceLimit
from quadsim.flight.parquet import require_format
from quadsim.input_limits import LARGEST_JSON
from quadsim.outputs import SUMMARY_FILE as SUMMARY_FILE
from quadsim.outputs import file_hashes
from quadsim.space import shape_from_json, shape_to_json

JSON_NUMBER: Final = (int, float)
MAYBE_NUMBER: Final = (int, float, NoneType)
_SUMMARY_TYPES: Final = {
    "scenario": str,
    "status": str,
    "verdict": str,
    "format": int,
    "reason": (str, NoneType),
    "satisfied": bool,
    "duration": JSON_NUMBER,
    "constraints": list,
    "tracking": dict,
    "control": dict,
    "controller": dict,
    "vehicle": dict,
    "wall_s": dict,
    "files": dict,
}
_CONSTRAINT_TYPES: Final = {
    "name": str,
    "signal": str,
    "unit": str,
    "tolerance": JSON_NUMBER,
    "tolerance_sampled": JSON_NUMBER,
    "start": JSON_NUMBER,
    "time_violated": JSON_NUMBER,
    "required": bool,
    "satisfied": bool,
    "lower": MAYBE_NUMBER,
    "upper": MAYBE_NUMBER,
    "stop": MAYBE_NUMBER,
    "peak_sampled": MAYBE_NUMBER,
    "peak_plant": MAYBE_NUMBER,
    "worst_margin_sampled": MAYBE_NUMBER,
    "worst_margin": MAYBE_NUMBER,
    "worst_time": MAYBE_NUMBER,
}
"""Entries on which verdicts and pages depend; the rest is trusted."""
_FINDING_NUMBERS: Final = (
    "peak_sampled",
    "peak_plant",
    "worst_margin_sampled",
    "worst_margin",
    "worst_time",
    "time_violated",
)
"""Fields of a `Finding` that are numbers."""
_NO_BOUND: Final = {"lower": -math.inf, "upper": math.inf, "stop": math.inf}
"""What null stands for in these fields of a limit."""


def read_json(path: Path, form: Mapping[str, Any], what: str) -> dict[str, Any]:
    """Read a JSON object that quadsim wrote; `what` names it in messages, `form` gives the types of its entries.

    Raises:
        FileError: it cannot be read, is not JSON, or an entry is missing or of another type.
    """
    try:
        if path.stat().st_size > LARGEST_JSON:
            raise FileError(path, f"is not {what}: it has more than {LARGEST_JSON} bytes")
        table = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse)
    except (OSError, RecursionError, ValueError) as error:
        if isinstance(error, FileError):
            raise
        raise FileError(path, f"is not {what} ({printable(str(error))[:200]})") from error
    misfits = _misfits(table, form)
    if misfits:
        raise FileError(path, f"is not {what}: it lacks or misstates {', '.join(misfits)}")
    return dict(table)


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not a JSON number")


def _misfits(table: object, form: Mapping[str, Any]) -> list[str]:
    """Return the entries of a table that are missing or of another type; true and false are not numbers."""
    if not isinstance(table, dict):
        return [*form]
    misfits = []
    for name, kind in form.items():
        value = table.get(name)
        flag_for_number = isinstance(value, bool) and kind is not bool
        if name not in table or not isinstance(value, kind) or flag_for_number:
            misfits.append(name)
    return misfits


def read_summary(directory: Path) -> dict[str, Any]:
    """Read `summary.json` of a run directory.

    Raises:
        FileError: it is missing, was not written by quadsim, or a link leads out of the directory.
    """
    path = directory / SUMMARY_FILE
    if not path.is_file():
        raise FileError(directory, f"is not a run directory: it has no {SUMMARY_FILE}")
    require_inside(directory)
    stated = read_json(path, {}, "a run's summary")
    if {"scenario", "constraints"} <= stated.keys():
        require_format(stated.get("format"), path, f"quadsim run {shlex.quote(str(directory / SCENARIO_FILE))}")
    summary = read_json(path, _SUMMARY_TYPES, "a run's summary")
    for i, entry in enumerate(summary["constraints"]):
        misfits = _misfits(entry, _CONSTRAINT_TYPES)
        if misfits:
            raise FileError(path, f"is not a run's summary: constraints.{i} lacks or misstates {', '.join(misfits)}")
    return summary


def require_inside(directory: Path) -> None:
    """Refuse to read a directory that contains a link to its outside; links within it are harmless.

    Raises:
        FileError: naming the first such link.
    """
    home = directory.resolve()
    for folder, folders, files in os.walk(directory):  # follows no link to a folder
        for name in sorted((*folders, *files)):
            path = Path(folder, name)
            if path.is_symlink() and not _leads_into(path, home):
                raise FileError(path, f"is a link that leads out of {directory}; nothing is read through it")


def _leads_into(link: Path, home: Path) -> bool:
    """Whether a link leads into a folder; not if it cannot be followed."""
    try:
        return Path(os.path.realpath(link)).is_relative_to(home)
    except OSError:
        return False


def limit_to_json(finding: Finding) -> dict[str, Any]:
    """Return an entry of `constraints` in `summary.json`; null for an absent bound or a window that was not reached."""
    limit = finding.limit
    entry: dict[str, Any] = {"name": limit.name, "signal": limit.signal}
    if limit.terms:
        entry["terms"] = dict(limit.terms)
    if isinstance(limit, SpaceLimit):
        entry["shape"] = shape_to_json(limit.shape)
    entry["unit"] = limit.unit
    for name, value in (vars(limit) | vars(finding)).items():
        if name in ("name", "signal", "terms", "shape", "limit"):
            continue
        entry[name] = None
        if math.isfinite(value):
            entry[name] = value
    entry["satisfied"] = finding.satisfied
    entry["verdict"] = finding.verdict
    return entry


def limit_from_json(entry: Mapping[str, Any]) -> Limit:
    """Return the limit that `limit_to_json` wrote."""
    values = {field.name: entry[field.name] for field in fields(Limit) if field.name != "terms"}
    for name, no_bound in _NO_BOUND.items():
        if values[name] is None:
            values[name] = no_bound
    if entry.get("shape"):
        return SpaceLimit(shape=shape_from_json(entry["shape"]), radius=float(entry["radius"]), **values)
    terms = {name: float(factor) for name, factor in entry.get("terms", {}).items()}
    return Limit(terms=terms or None, **values)


def finding_from_json(entry: Mapping[str, Any]) -> Finding:
    """Return the finding that `limit_to_json` wrote."""
    numbers = {}
    for name in _FINDING_NUMBERS:
        numbers[name] = math.nan
        if entry[name] is not None:
            numbers[name] = float(entry[name])
    return Finding(limit=limit_from_json(entry), **numbers)


def findings_of(summary: Mapping[str, Any]) -> tuple[Finding, ...]:
    """Return the audit of a summary."""
    return tuple(map(finding_from_json, summary["constraints"]))


SCENARIO_FILE: Final = "scenario.toml"
RECORDING_FILE: Final = "flight.rrd"
VIDEO_FILE: Final = "flight.mp4"
FIGURES_DIR: Final = "figures"


def damaged_files(directory: Path, summary: Mapping[str, Any]) -> list[str]:
    """Return the files named in the summary that are missing or whose SHA-256 differs."""
    digests = file_hashes(directory)
    return [name for name, digest in summary["files"].items() if digests.get(name) != digest]
