"""Types of the commands' arguments: as Python reads them, and as the command line parses them.

Type checkers see the first half, with what a call from Python may pass; cyclopts the second, with how a word is parsed,
completed or refused.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from glob import escape, glob
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from cyclopts import Parameter

from quadsim.assets import vehicle_names
from quadsim.scenarios.catalogue import scenario_names

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from quadsim.console.progress import Progress
    from quadsim.rollout.flown import Flight
    from quadsim.scenarios.schema.scenario import Scenario

    File: TypeAlias = str | Path
    Files: TypeAlias = Sequence[File]
    VehicleName: TypeAlias = File
    ScenarioName: TypeAlias = Scenario | File
    ComparedName: TypeAlias = Flight | ScenarioName
    Changes: TypeAlias = Mapping[Any, Any] | Sequence[str]
    Names: TypeAlias = Sequence[str]
    Labels: TypeAlias = Sequence[str]
    Plotted: TypeAlias = Flight | File | Sequence[Flight | File]
    SignalName = str
    Inches = float
    StyleName: TypeAlias = Mapping[str, Any] | File
    Whole = int
    Flag = bool
    UserCode = object
    UserForces = Sequence[object]
    UserReference: TypeAlias = Callable[[float], ArrayLike] | None
    Fields: TypeAlias = Mapping[str, Any] | None
    Watched: TypeAlias = Progress | bool
    Flown: TypeAlias = Callable[[Any], object] | None
else:  # as cyclopts reads them: it resolves all annotations where a command is declared

    def one_of(names: Callable[[], Sequence[str]]) -> Any:
        """Return the type of a shipped name or a path, which the shell completes."""

        def completions(context: Any) -> list[str]:
            return [*names(), *glob(f"{escape(context.incomplete or '.')}*")]  # noqa: PTH207  # as it was typed

        return Annotated[str, Parameter(completer=completions)]

    def _whole(_: type, tokens: Sequence[Any]) -> int:
        text = tokens[0].value
        if not text.lstrip("+-").isdecimal():  # left to itself, cyclopts rounds 3.7
            raise ValueError(f"must be a whole number; got {text!r:.100}")
        return int(text)

    File = Path
    Files = Sequence[Path]
    VehicleName = one_of(vehicle_names)
    ComparedName = ScenarioName = one_of(scenario_names)
    Changes = Annotated[Sequence[str], Parameter(name="--set")]
    Names = Annotated[Sequence[str], Parameter(name="--name")]
    Labels = Annotated[Sequence[str], Parameter(consume_multiple=True)]
    Plotted = Files
    Inches = float
    SignalName = Annotated[str, Parameter(name="--signals", consume_multiple=True)]
    StyleName = str
    Whole = Annotated[int, Parameter(converter=_whole)]
    Flag = Annotated[bool, Parameter(negative="")]
    UserCode = UserForces = UserReference = Fields = Watched = Flown = Annotated[Any, Parameter(parse=False)]
