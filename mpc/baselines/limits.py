"""What numbers the baselines' settings may have."""

from __future__ import annotations

import math

from quadsim.errors import ParameterError


def require_positive(name: str, value: float) -> None:
    """A setting that has to be a positive, finite number.

    Raises:
        ParameterError: it is not.
    """
    if not 0.0 < value < math.inf:
        raise ParameterError("controller", name, value, "positive and finite")


def require_within(name: str, value: float, lower: float, upper: float) -> None:
    """A setting that has to be between two numbers.

    Raises:
        ParameterError: it is not.
    """
    if not lower <= value <= upper:
        raise ParameterError("controller", name, value, f"between {lower:g} and {upper:g}")
