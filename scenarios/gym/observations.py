"""What an agent observes: one vector of named parts, with the unit of every entry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np
from gymnasium.spaces import Box

from quadsim.errors import ParameterError, UnknownNameError
from quadsim.state import REFERENCE_NAMES, REFERENCE_STATES, STATE_NAMES, STATE_UNITS, Array
from quadsim.vehicle import N_ROTORS

Part = Literal["state", "preview", "ahead", "command"]

USUAL: Final[tuple[Part, ...]] = ("state", "preview", "command")
LARGEST: Final = 1e6  # magnitude that the plant takes for divergence
_REFERENCE: Final = list(REFERENCE_STATES)


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One entry of the observation: its name, such as `vx`, `x[3]` (three periods ahead) or `u1`, and its unit."""

    name: str
    unit: str


class Observations:
    """The parts that were chosen, one after the other, as float64.

    - `state`: the twelve states as measured or estimated, `quadsim.state.STATE_NAMES` [m, m/s, rad, rad/s].
    - `preview`: the filtered reference x, y, z [m], yaw [rad] at t_{k+1} .. t_{k+n}, row by row.
    - `ahead`: the same less the measured x, y, z, yaw: how far, and where to.
    - `command`: u(k-1), the rotor speeds in force [rad/s].

    Attributes:
        parts: their names.
        layout: an `Entry` for each entry.
        space: up to `LARGEST`, which no flight passes; what a faulty sensor gives, such as NaN, is not in it.
    """

    def __init__(self, parts: Sequence[str], preview: int) -> None:
        if not parts or len(set(parts)) < len(parts):
            raise ParameterError(
                "", "observation", list(parts), f"one or more of {', '.join(get_args(Part))}, once each"
            )
        for part in parts:
            if part not in get_args(Part):
                raise UnknownNameError("part of the observation", str(part), get_args(Part))
        units = [STATE_UNITS[i] for i in REFERENCE_STATES]
        named = list(zip(REFERENCE_NAMES, units, strict=True))
        rows = [(f"{name}[{i}]", unit) for i in range(1, preview + 1) for name, unit in named]
        entries: dict[str, list[tuple[str, str]]] = {
            "state": list(zip(STATE_NAMES, STATE_UNITS, strict=True)),
            "preview": rows,
            "ahead": [(f"{name} ahead", unit) for name, unit in rows],
            "command": [(f"u{i + 1}", "rad/s") for i in range(N_ROTORS)],
        }
        self.parts: tuple[str, ...] = tuple(parts)
        self.layout = tuple(Entry(name=name, unit=unit) for part in parts for name, unit in entries[part])
        self.space = Box(-LARGEST, LARGEST, (len(self.layout),), dtype=np.float64)

    def of(self, state: Array, preview: Array, command: Array) -> Array:
        """The observation of a state (12,), a preview (n, 4) and a command (4,)."""
        ahead = preview - state[_REFERENCE] if "ahead" in self.parts else preview
        values: dict[str, Array] = {
            "state": state,
            "preview": preview.ravel(),
            "ahead": ahead.ravel(),
            "command": command,
        }
        return np.concatenate([values[part] for part in self.parts])
