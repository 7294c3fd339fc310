"""What a person does in a live session, as data: inputs in force until they are changed, and scripts with times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from annotated_types import Ge, Le, doc
from pydantic import Field

from quadsim.assets import read_toml
from quadsim.errors import ParameterError
from quadsim.fields import FLOORS, Fraction, Vector
from quadsim.scenarios.schema.events import Event
from quadsim.scenarios.schema.problems import parse_table

HELD: Final = ("pull", "wear", "steer")  # inputs in force until they are changed; the others are events


@dataclass(frozen=True, kw_only=True)
class Pull:
    """A spring from the vehicle to a point in the world, active until released."""

    type: Literal["pull"]
    to: Annotated[Vector | None, doc("[m] world; absent to let go")] = None


@dataclass(frozen=True, kw_only=True)
class Wear:
    """A rotor's loss of thrust, held."""

    type: Literal["wear"]
    rotor: Annotated[int, Ge(1), Le(4)]
    loss: Fraction


@dataclass(frozen=True, kw_only=True)
class Steer:
    """The set-point's velocity, held."""

    type: Literal["steer"]
    velocity: Annotated[Vector, doc("[m/s]")]


@dataclass(frozen=True, kw_only=True)
class HeldInput:
    """Declares an input that is in force until it is changed."""

    input: Annotated[Pull | Wear | Steer, Field(discriminator="type")]


@dataclass(frozen=True, kw_only=True)
class _Inputs:
    """Declares the inputs of a script."""

    inputs: list[Annotated[Event | Pull | Wear | Steer, Field(discriminator="type")]]


@dataclass(frozen=True, kw_only=True)
class Script:
    """A session without a browser: inputs as `Session.submit` takes them, and the times [s] at which they are given."""

    duration: Annotated[float, Ge(FLOORS["s"]), Le(36_000.0), doc("[s] of the session")]
    inputs: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        for i, entry in enumerate(self.inputs):
            at = entry.get("at")
            if not isinstance(at, int | float) or isinstance(at, bool) or not 0.0 <= at < self.duration:
                raise ParameterError("", f"inputs.{i}.at", at, f"below duration = {self.duration} s, and 0 or more")


def read_script(path: str | Path) -> Script:
    """Read a script.

    Raises:
        InputError: it is malformed, or an input is wrong whatever the scenario.
    """
    script = parse_table(Script, read_toml(Path(path)), str(path), file="script")
    inputs = []
    for entry in script.inputs:
        if entry.get("type") in HELD:
            inputs.append(without_time(entry))
        else:
            inputs.append(entry)
    parse_table(_Inputs, {"inputs": inputs}, str(path), file="script")
    return script


def without_time(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return an entry of a script without the time at which it is given."""
    return {key: value for key, value in entry.items() if key != "at"}
