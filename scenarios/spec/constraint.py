"""`[[constraints]]`: what the flight is audited against."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from quadsim.audit import SIGNALS
from quadsim.errors import UnknownNameError
from scenarios.spec.base import NonNegative, Number, Spec


class ConstraintSpec(Spec):
    """Bounds on a signal of the flight; see `quadsim.audit.Limit`."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+$")] = Field(description="what reports call it")
    signal: str = Field(
        description="what is bounded: " + ", ".join(f"{name} [{signal.unit}]" for name, signal in SIGNALS.items()),
        json_schema_extra={"enum": [*SIGNALS]},
    )
    lower: Number | None = Field(default=None, description="[unit of the signal] lower bound")
    upper: Number | None = Field(default=None, description="[unit of the signal] upper bound")
    tolerance: NonNegative = Field(default=0.0, description="[unit of the signal] allowed beyond, at the physics rate")
    tolerance_sampled: NonNegative = Field(
        default=0.0, description="[unit of the signal] allowed beyond, at the control samples"
    )
    required: bool = Field(default=True, description="false: measured and reported, never a failure")
    start: Number = Field(default=0.0, description="[s] first time it holds")
    stop: Number | None = Field(default=None, description="[s] last time it holds; absent: the flight's end")

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
