"""`[lost]`: when a flight is lost, and ends."""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import BeforeValidator, Field
from pydantic_core import PydanticCustomError

from scenarios.spec.base import Positive, Spec

_STEEPEST: Final = 180.0


def _tilt_or_false(value: Any) -> Any:
    return _number_or_false(value, _STEEPEST)


def _number_or_false(value: Any, most: float = 1e6) -> Any:
    """Refuse all but numbers in range and false, in one sentence; 0, which Python takes for false, is refused too."""
    if value is False or (isinstance(value, int | float) and value is not True and 0.0 < value <= most):
        return value
    raise PydanticCustomError("number_or_false", "a number > 0 and <= {most}, or false", {"most": f"{most:g}"})


Limit = Annotated[Positive | Literal[False], BeforeValidator(_number_or_false)]


class LostSpec(Spec):
    """When the flight is lost and ends, by the true state at each control sample; false switches a criterion off."""

    tilt: Annotated[Annotated[float, Field(gt=0.0, le=_STEEPEST)] | Literal[False], BeforeValidator(_tilt_or_false)] = (
        Field(
            default=120.0,
            description="[deg] between the thrust axis and the vertical; at 120, half the thrust pulls down; false for "
            "loops and flips",
        )
    )
    distance: Limit = Field(default=100.0, description="[m] from the reference at the same time")
    depth: Limit = Field(default=50.0, description="[m] below the lowest of the start and the reference so far")
    speed: Limit = Field(default=50.0, description="[m/s] in any direction")
