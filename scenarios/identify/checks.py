"""What of a log can be used: its parts in the air without gaps."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

from quadsim.errors import InputError
from quadsim.state import Array
from quadsim.vehicle import Vehicle
from scenarios.identify.motion import body_z, slope
from scenarios.identify.record import INPUTS, Record

SHORTEST: Final = 2.0  # [s] of a span that is used
LEAST: Final = 4.0  # [s] that the longest must have
MARGIN: Final = 0.5  # [s] cut beside the ground, where it still acts through the air and the legs


def spans(record: Record, vehicle: Vehicle) -> list[slice]:
    """Return the parts of a log in the air and without gaps, each 2 s or longer.

    On the ground, the rotors carry less than the weight while the vehicle rests, or turn at a constant speed.

    Raises:
        InputError: none is 4 s long.
    """
    fields = [getattr(record, name) for name in ("velocity", "attitude", "rates", "position", *INPUTS)]
    logged = np.logical_and.reduce([np.isfinite(rows).all(axis=1) for rows in fields if rows is not None])
    whole = _runs(logged, round(SHORTEST / record.period))
    aloft = [] if not whole else _aloft(record, whole, vehicle.gravity)
    longest = max((part.stop - part.start for part in aloft), default=0) * record.period
    if longest >= LEAST * (1.0 - 1e-6):
        return aloft
    gaps = f"{100.0 * (1.0 - logged.mean()):.0f} % of its samples are in gaps, " if not logged.all() else ""
    inputs = driver(record)[logged]
    swing = 0.0 if not len(inputs) else float(np.ptp(inputs, axis=0).max() / max(np.abs(inputs).max(), 1e-9))
    height = "" if record.position is None else f", its altitude by {np.ptp(record.position[logged, 2]):.2f} m"
    moved = f"its rotors' outputs change by {100.0 * swing:.0f} %{height}" if logged.any() else "no sample is complete"
    never = "never flies" if longest == 0.0 else f"flies for {longest:.1f} s at most in one piece"
    raise InputError(f"{record.name}: {never}; {LEAST:g} s without a gap are needed ({gaps}{moved})")


def driver(record: Record) -> Array:
    """What drives the rotors (N, 4): measured speeds, else the commands or the throttle."""
    rows = next(rows for rows in (record.speeds, record.commands, record.throttle) if rows is not None)
    return np.asarray(rows)


def _runs(mask: np.ndarray, shortest: int) -> list[slice]:
    """Runs of true samples with at least the shortest length."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2) if b - a >= max(shortest, 2)]


def _aloft(record: Record, parts: list[slice], gravity: float) -> list[slice]:
    """The runs in the air in parts without gaps."""
    second = round(1.0 / record.period)
    rows: dict[str, list[Array]] = {name: [] for name in ("effort", "load", "climb", "still", "constant")}
    for part in parts:
        velocity, inputs = record.velocity[part], driver(record)[part]
        rate = slope(velocity, record.period, 0.2)
        rows["effort"].append(uniform_filter1d(np.square(inputs).mean(axis=1), max(second // 10, 1)))
        rows["load"].append(
            ((rate + np.array([0.0, 0.0, gravity])) * body_z(record.attitude[part])).sum(axis=1) / gravity
        )
        rows["climb"].append(rate[:, 2])
        slow = np.linalg.norm(uniform_filter1d(velocity, max(second // 5, 1), axis=0), axis=1) < 0.3
        turning = np.linalg.norm(uniform_filter1d(record.rates[part], max(second // 5, 1), axis=0), axis=1)
        rows["still"].append(slow & (turning < 0.5))
        change = maximum_filter1d(inputs, second, axis=0) - minimum_filter1d(inputs, second, axis=0)
        rows["constant"].append((change < 3e-3 * np.abs(inputs).mean()).all(axis=1))
    effort, load = np.concatenate(rows["effort"]), np.concatenate(rows["load"])
    heavy = (effort > 0.5 * effort.max()) & (load > 0.3)
    hover = float(np.median(effort[heavy] / load[heavy])) if heavy.any() else float(np.median(effort))
    aloft = []
    for i, part in enumerate(parts):
        lacking = 1.0 - rows["effort"][i] / hover  # share of the weight that the rotors do not carry
        resting = (lacking > 0.15) & (np.abs(rows["climb"][i]) < 0.4 * lacking * gravity)
        ground = rows["still"][i] & (resting | rows["constant"][i])
        near = maximum_filter1d(ground.astype(int), 2 * round(MARGIN / record.period) + 1) > 0
        aloft += [
            slice(part.start + run.start, part.start + run.stop)
            for run in _runs(~near, round(SHORTEST / record.period))
        ]
    return aloft
