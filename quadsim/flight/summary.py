"""`summary.json` of a run: its form, whether it agrees with itself, and the digest that seals it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from quadsim.errors import FileError, printable
from quadsim.flight.audit import CLEARANCE, SIGNALS, SUM, TERMS, sum_signal
from quadsim.flight.form import MAYBE_NUMBER, MAYBE_TEXT, NUMBER, Each, Optional, misfits, read_json
from quadsim.outputs.paths import require_inside
from quadsim.state import REFERENCE_NAMES, STATE_NAMES

SUMMARY_FILE: Final = "summary.json"

_WHAT: Final = "a run's summary"
_COURSE: Final = {
    **dict.fromkeys(
        ("tilt", "velocity", "acceleration", "yaw", "yaw_rate", "rotor_min", "rotor_max", "thrust_to_weight"), NUMBER
    ),
    "thrust_min": Optional(NUMBER),
}
_CHANNELS: Final = dict.fromkeys(REFERENCE_NAMES, NUMBER)
_STATES: Final = dict.fromkeys(STATE_NAMES, NUMBER)
_SPREAD: Final = dict.fromkeys(("p50", "p95", "p99", "max"), NUMBER)
_LAW: Final = {"name": str, "solver": str, "horizon": Optional(int)}
_FLOWN: Final = {
    "tracking": {
        "unit": dict.fromkeys(REFERENCE_NAMES, str),
        **dict.fromkeys(("rmse", "max_error", "final_error", "overshoot"), _CHANNELS),
        "position_error": Optional(dict.fromkeys(("mean", "rms", "max"), NUMBER)),
        "settling": Optional([{"channel": str, "time": NUMBER, "settled": MAYBE_NUMBER}]),
    },
    "control": {
        **dict.fromkeys(("speed_min", "speed_max", "slew_min", "slew_max"), NUMBER),
        "total_variation": Optional(NUMBER),
    },
    "controller": {
        **_LAW,
        "statuses": Each(int),
        "fallbacks": Each(int),
        "iterations": {"mean": NUMBER, "max": int},
        **dict.fromkeys(("active_max", "active_periods", "unrecovered"), Optional(int)),
        "residual_max": Optional({"primal": MAYBE_NUMBER, "dual": MAYBE_NUMBER}),
        "solve_ms": _SPREAD,
        "step_ms": _SPREAD,
        "deadline_ms": NUMBER,
        "deadline_misses": int,
    },
}
"""Of a flight that came to its first period; of another these tables are empty, but for the controller's own."""
_CONSTRAINT: Final = {
    **dict.fromkeys(("name", "signal", "unit"), str),
    **dict.fromkeys(("tolerance", "tolerance_sampled", "start", "time_violated"), NUMBER),
    **dict.fromkeys(("required", "satisfied"), bool),
    "terms": Optional(Each(NUMBER)),
    "shape": Optional(dict),
    "radius": Optional(NUMBER),
    **dict.fromkeys(
        ("lower", "upper", "stop", "peak_sampled", "peak_plant", "worst_margin_sampled", "worst_margin", "worst_time"),
        MAYBE_NUMBER,
    ),
}
_VEHICLE: Final = {
    "name": str,
    "description": Optional(str),
    **dict.fromkeys(
        ("mass", "gravity", "arm_length", "thrust_coefficient", "drag_to_thrust", "speed_min", "speed_max"), NUMBER
    ),
    "inertia": [NUMBER],
    "rotor_azimuths": [NUMBER],
    "rotor_spins": [int],
    **dict.fromkeys(
        ("rotor_rise", "rotor_fall", "rotor_inertia", "rotor_radius", "rotor_drag", "extent"), Optional(MAYBE_NUMBER)
    ),
    "body_drag": Optional(([NUMBER], type(None))),
}
_DIAGNOSIS: Final = {
    "time": NUMBER,
    "feasible": (bool, type(None)),
    **dict.fromkeys(("status", "sentence", "advice"), str),
    "conflict": [
        {
            **dict.fromkeys(("name", "side", "unit", "field"), str),
            "rotors": [int],
            "by": NUMBER,
            **dict.fromkeys(("start", "stop"), MAYBE_NUMBER),
        }
    ],
    "suggestions": [{"settings": dict, "after": MAYBE_NUMBER}],
}
_TOUCHDOWN: Final = dict.fromkeys(("time", "speed", "horizontal_speed", "tilt"), NUMBER)
FORM: Final = {
    **dict.fromkeys(("scenario", "status"), str),
    "reason": MAYBE_TEXT,
    "satisfied": bool,
    "duration": NUMBER,
    **dict.fromkeys(("description", "group", "expected"), Optional(str)),
    "as_expected": Optional(bool),
    "seed": Optional(int),
    "course": Optional({**_COURSE, "jumps": [NUMBER], "problems": [str], "sentence": str}),
    "events": Optional([{"time": NUMBER, "text": str}]),
    "tracking": dict,
    "constraints": [_CONSTRAINT],
    "control": dict,
    "controller": _LAW,
    "diagnosis": Optional((_DIAGNOSIS, type(None))),
    "computation": Optional({"delay_ms": _SPREAD, "missed": int}),
    "estimation": Optional(
        {
            "rmse": _STATES,
            "max_error": _STATES,
            "not_finite": int,
            "samples": Each({"accepted": int, "rejected": int}),
        }
    ),
    "ground": Optional(
        {
            "started": str,
            "takeoff_time": MAYBE_NUMBER,
            "touchdown": (_TOUCHDOWN, type(None)),
            "phase": MAYBE_TEXT,
            "crashed": bool,
        }
    ),
    "vehicle": _VEHICLE,
    "actual": Optional(_VEHICLE),
    "wall_s": {"simulate": NUMBER, "total": NUMBER},
    "versions": Optional(Each(str)),
    "machine": Optional({"system": str, "processor": str, "cores": (int, type(None))}),
    "files": Each(str),
}
FLOWN_FORM: Final = FORM | _FLOWN  # of a flight that came to its first period
_TOGETHER: Final = {"worst_margin": ("worst_time", "peak_plant"), "worst_margin_sampled": ("peak_sampled",)}
"""Of a constraint: present wherever a margin is."""


def read_summary(directory: Path) -> dict[str, Any]:
    """`summary.json` of a run directory, with all of its form.

    Raises:
        FileError: there is none, quadsim did not write it, it contradicts itself, or a link leads out of the directory.
    """
    require_inside(directory)
    path = directory / SUMMARY_FILE
    if not path.is_file():
        raise FileError(directory, f"is not a run directory: it has no {SUMMARY_FILE}")
    summary = read_json(path, FORM, _WHAT)
    flown = {key: summary[key] for key in _FLOWN}
    wrong = list(misfits(flown, _FLOWN)) if summary["tracking"] or summary["control"] else []
    if wrong:
        raise FileError(path, f"is not {_WHAT}: it lacks or misstates {', '.join(map(printable, wrong[:10]))}")
    if problem := next(contradictions(summary), None):
        raise FileError(path, f"contradicts itself: {printable(problem)}")
    return summary


def contradictions(summary: Mapping[str, Any]) -> Iterator[str]:
    """What a summary states that is inconsistent."""
    if (summary["status"] == "completed") != (summary["reason"] is None):
        yield f"status is {summary['status']!r:.40}, and reason is {summary['reason']!r:.80}"
    names = [entry["name"] for entry in summary["constraints"]]
    if len(set(names)) < len(names):
        yield "two constraints have one name"
    for entry in summary["constraints"]:
        name = f"{entry['name']:.80}"
        if _unit(entry) != entry["unit"]:
            yield f"{name}: signal {entry['signal']!r:.40} in {entry['unit']!r:.40}"
        for key, others in _TOGETHER.items():
            if entry[key] is not None and any(entry[other] is None for other in others):
                yield f"{name}: {key} is there without {' and '.join(others)}"
        if entry["worst_margin"] is None and entry["worst_margin_sampled"] is not None:
            yield f"{name}: worst_margin_sampled is there without worst_margin"
        if entry["satisfied"] != is_satisfied(entry):
            yield f"{name}: satisfied is {str(entry['satisfied']).lower()}, and its worst margins say otherwise"


def _unit(entry: Mapping[str, Any]) -> str | None:
    """The unit of a constraint's signal; None where there is no such signal."""
    if entry["signal"] in SIGNALS:
        return SIGNALS[entry["signal"]].unit
    if entry["signal"] == CLEARANCE:
        return "m" if "shape" in entry and "radius" in entry else None
    terms = tuple(entry.get("terms", {}).items())
    known = entry["signal"] == SUM and terms and all(name in TERMS for name, _ in terms)
    return sum_signal(terms).unit if known else None


def is_satisfied(entry: Mapping[str, Any]) -> bool:
    """The verdict on a constraint that follows from its margins; see `quadsim.flight.audit.Finding.satisfied`."""
    at_physics_rate, at_samples = entry["worst_margin"], entry["worst_margin_sampled"]
    if at_physics_rate is None or at_physics_rate < -entry["tolerance"]:
        return False
    return at_samples is None or bool(at_samples >= -entry["tolerance_sampled"])


def summary_digest(summary: Mapping[str, Any], fixed: Mapping[str, str]) -> str:
    """SHA-256 of a summary without its table of files, and of the hashes of those files that are made once.

    Args:
        summary: `summary.json`.
        fixed: hashes by file; a film, say, is made again, and is none of them.
    """
    hashed = {key: value for key, value in summary.items() if key != "files"}
    text = json.dumps([hashed, dict(fixed)], sort_keys=True, allow_nan=False)
    return "sha256:" + hashlib.sha256(text.encode()).hexdigest()
