"""`[computation]`: how long commands take."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from scenarios.schema.base import Spec

Seconds = Annotated[float, Field(ge=0.0, le=100.0)]


class ComputationSpec(Spec):
    """Time from measurement to command; a command later than the control period is dropped.  No clock is read."""

    delay: Seconds = Field(default=0.0, description="[s] fixed part")
    per_iteration: Seconds = Field(default=0.0, description="[s] for each iteration of the solver")
    plan: bool | None = Field(
        default=None,
        description="whether the last plan is continued while a command is late; else the last command is held; "
        "absent: true with a controller within the fallback contract",
    )
    jitter: Seconds = Field(default=0.0, description="[s] mean of an exponentially distributed part")
