"""`summary.json` of a run: its form, and whether it agrees with itself."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from quadsim.errors import FileError, printable
from quadsim.flight.audit import CLEARANCE, SIGNALS, SUM, TERMS, Held, sum_signal
from quadsim.flight.form import MAYBE_NUMBER, MAYBE_TEXT, NUMBER, Each, Optional, misfits, read_json
from quadsim.outputs import SUMMARY_FILE as SUMMARY_FILE
from quadsim.state import REFERENCE_NAMES, STATE_NAMES

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
        "answered_by": Each(int),
        "iterations": ({"mean": NUMBER, "max": int}, type(None)),
        "iterations_by": Each({"mean": NUMBER, "max": int}),
        **dict.fromkeys(("active_max", "active_periods", "unrecovered"), Optional(int)),
        "residuals": Each({"max": MAYBE_NUMBER, "periods": int}),
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
    "verdict": Optional(str),
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
    "traceback": Optional([str]),
    "satisfied": bool,
    "duration": NUMBER,
    **dict.fromkeys(("description", "group", "expected", "verdict"), Optional(str)),
    "as_expected": Optional(bool),
    "seed": Optional(int),
    "course": Optional({**_COURSE, "jumps": [NUMBER], "problems": [str], "sentence": str}),
    "events": Optional([{"time": NUMBER, "text": str}]),
    "tracking": dict,
    "constraints": [_CONSTRAINT],
    "audit_notes": Optional([str]),
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
    "products": Optional(Each(str)),
    "files": Each(str),
}
FLOWN_FORM: Final = FORM | _FLOWN  # of a flight that came to its first period
_TOGETHER: Final = {"worst_margin": ("worst_time",), "worst_margin_sampled": ("peak_sampled",)}
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


def require_inside(directory: Path) -> None:
    """Refuse to read a directory that holds a link out of it; links within it are no harm.

    Raises:
        FileError: naming the first such link.
    """
    home = directory.resolve()
    for folder, folders, files in os.walk(directory):  # which follows no link to a folder
        for path in (Path(folder, name) for name in sorted((*folders, *files))):
            if path.is_symlink() and not Path(os.path.realpath(path)).is_relative_to(home):
                raise FileError(path, f"is a link that leads out of {directory}; nothing is read through it")


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
        found = constraint_verdict(entry)
        if entry["satisfied"] != (found == "satisfied") or entry.get("verdict", found) != found:
            stated = f"satisfied is {str(entry['satisfied']).lower()}, its verdict {entry.get('verdict', '-'):.40}"
            yield f"{name}: {stated}, and its worst margins say {found}"


def _unit(entry: Mapping[str, Any]) -> str | None:
    """The unit of a constraint's signal; None where there is no such signal."""
    if entry["signal"] in SIGNALS:
        return SIGNALS[entry["signal"]].unit
    if entry["signal"] == CLEARANCE:
        return "m" if "shape" in entry and "radius" in entry else None
    terms = tuple(entry.get("terms", {}).items())
    known = entry["signal"] == SUM and terms and all(name in TERMS for name, _ in terms)
    return sum_signal(terms).unit if known else None


def constraint_verdict(entry: Mapping[str, Any]) -> Held:
    """The verdict on a constraint that follows from its margins; see `quadsim.flight.audit.Finding.verdict`."""
    if entry["worst_time"] is None:
        return "incomplete"
    margin, tolerance = deciding_margin(entry)
    return "satisfied" if margin is not None and margin >= -tolerance else "violated"


def deciding_margin(entry: Mapping[str, Any]) -> tuple[float | None, float]:
    """The margin that a constraint's verdict rests on, and its tolerance; see `Finding.deciding_margin`.

    None where there is none: its window was not reached, or a value was no number.
    """
    at_physics_rate, at_samples = entry["worst_margin"], entry["worst_margin_sampled"]
    tolerance, tolerance_sampled = entry["tolerance"], entry["tolerance_sampled"]
    broken = at_samples is not None and at_samples < -tolerance_sampled
    if broken and at_physics_rate is not None and at_physics_rate >= -tolerance:
        return at_samples, tolerance_sampled
    return at_physics_rate, tolerance
