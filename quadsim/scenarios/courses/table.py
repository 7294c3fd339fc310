"""`[reference]`: the table of a course, of the type that it names."""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import Discriminator, Tag

from quadsim.scenarios.courses.csv_course import Csv
from quadsim.scenarios.courses.legs import Waypoints, YawTurns
from quadsim.scenarios.courses.loops import Circle, FigureEight, Helix
from quadsim.scenarios.courses.minimum_snap import MinimumSnap
from quadsim.scenarios.courses.ramped import RampedCircle, RampedLemniscate
from quadsim.scenarios.courses.steps import Steps

DEFAULT: Final = "steps"  # the type of a table that states none


def _kind(value: object) -> str:
    """The tag of a table or of what was made of one."""
    if isinstance(value, dict):
        kind = value.get("type", DEFAULT)
    else:
        kind = getattr(value, "type", DEFAULT)
    if isinstance(kind, str):
        return kind
    return repr(kind)


ReferenceTable = Annotated[
    Annotated[Steps, Tag("steps")]
    | Annotated[Waypoints, Tag("waypoints")]
    | Annotated[MinimumSnap, Tag("minimum_snap")]
    | Annotated[Circle, Tag("circle")]
    | Annotated[Helix, Tag("helix")]
    | Annotated[FigureEight, Tag("figure_eight")]
    | Annotated[RampedCircle, Tag("ramped_circle")]
    | Annotated[RampedLemniscate, Tag("ramped_lemniscate")]
    | Annotated[YawTurns, Tag("yaw_turns")]
    | Annotated[Csv, Tag("csv")],
    Discriminator(_kind),
]
"""The desired course, of the kind named by its field `type`; add a new kind to this union."""
