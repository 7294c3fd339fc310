"""What soft output bounds cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadsim.errors import ParameterError
from quadsim.state import Array


@dataclass(frozen=True, kw_only=True)
class Penalty:
    """What leaving an output bound by e costs: l1' e + e' diag(l2) e.

    While l1 exceeds the multipliers that the hard bounds would have, the penalty is exact: slack is zero wherever the
    hard problem is feasible (Kerrigan and Maciejowski, 2000, "Soft constraints and exact penalty functions in model
    predictive control").

    Attributes:
        l1: (n_c,) at least 0.
        l2: (n_c,) at least 0.
    """

    l1: Array
    l2: Array

    def __post_init__(self) -> None:
        for name in ("l1", "l2"):
            value = getattr(self, name)
            if value.shape != self.l1.shape or value.ndim != 1 or not (np.isfinite(value) & (value >= 0.0)).all():
                raise ParameterError("controller", name, value, "one finite number >= 0 per constrained output")
