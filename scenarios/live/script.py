"""A session without a browser: a TOML file of inputs and of the times at which they are given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

from quadsim.assets import read_toml
from quadsim.errors import InputError, ParameterError
from scenarios.live.session import Session


@dataclass(frozen=True, kw_only=True)
class Script:
    """What a user does."""

    duration: float  # of the session [s]
    inputs: tuple[tuple[float, Mapping[str, Any]], ...]
    """In order of time [s], each a table as `Session.submit` takes it."""


def read_script(path: str | Path) -> Script:
    """Read a script.

    Raises:
        FileError: it cannot be read.
        InputError: it is not a script.
    """
    data = read_toml(Path(path))
    unknown = sorted(set(data) - {"duration", "inputs"})
    if unknown:
        raise InputError(f"{path}: unknown: {', '.join(unknown)}; a script has duration and [[inputs]]")
    duration, inputs = data.get("duration"), data.get("inputs", [])
    if not _is_number(duration) or not 0.0 < duration <= 36_000.0:
        raise ParameterError("script", "duration", duration, "above 0 s, up to 36000 s")
    if not isinstance(inputs, list):
        raise ParameterError("script", "inputs", inputs, "tables [[inputs]]")
    found = []
    for i, each in enumerate(inputs):
        at = each.get("at") if isinstance(each, dict) else None
        if not _is_number(at) or not 0.0 <= at < duration:
            raise ParameterError(f"script.inputs.{i}", "at", at, f"from 0 to below duration = {duration} s")
        found.append((float(at), {name: value for name, value in each.items() if name != "at"}))
    return Script(duration=float(duration), inputs=tuple(sorted(found, key=lambda entry: entry[0])))


def play(session: Session, script: Script) -> list[str]:
    """Fly a session by a script, as fast as it goes; why inputs were refused.

    An input is given when the first period begins that is not before its time, by the same queue as a page's.
    """
    refused: list[str] = []
    waiting = list(script.inputs)
    while session.reason is None and session.k * session.period < script.duration - 1e-9:
        while waiting and waiting[0][0] <= session.k * session.period + 1e-9:
            session.submit(waiting.pop(0)[1])
        refused += session.advance().refused
    return refused


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)
