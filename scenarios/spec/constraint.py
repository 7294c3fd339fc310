"""`[[constraints]]`: what the flight is audited against."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from quadsim.audit import SIGNALS
from quadsim.errors import UnknownNameError
from scenarios.spec.base import Number, Spec


class ConstraintSpec(Spec):
    """What the flight is audited against; see `quadsim.audit.Limit`."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+$")]
    signal: str
    lower: Number | None = None
    upper: Number | None = None
    tolerance: Annotated[float, Field(ge=0.0, le=1e6, description="at the physics rate")] = 0.0
    tolerance_sampled: Annotated[float, Field(ge=0.0, le=1e6, description="at the control samples")] = 0.0
    required: bool = Field(default=True, description="false: measured and reported, never a failure")
    start: Number = Field(default=0.0, description="first time it holds [s]")
    stop: Number | None = Field(default=None, description="last time it holds [s]")

    @model_validator(mode="after")
    def _check(self) -> ConstraintSpec:
        if self.signal not in SIGNALS:
            raise ValueError(f"signal: {UnknownNameError('signal', self.signal, SIGNALS)}")
        if self.lower is None and self.upper is None:
            raise ValueError("lower must be given, or upper, or both")
        if self.lower is not None and self.upper is not None and self.lower >= self.upper:
            raise ValueError(f"lower must be below upper = {self.upper}; got {self.lower}")
        if self.tolerance_sampled > self.tolerance:
            raise ValueError(
                f"tolerance_sampled must be at most tolerance = {self.tolerance}; got {self.tolerance_sampled}"
            )
        if self.stop is not None and self.stop < self.start:
            raise ValueError(f"stop must be at least start = {self.start}; got {self.stop}")
        return self
