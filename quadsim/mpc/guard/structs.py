"""The statuses of `quadsim_guard.h`, in words."""

from __future__ import annotations

from typing import Final

from quadsim.controller import COMMANDED, MISSED, NOT_CONVERGED, SOLVED, UNCONSTRAINED, Phase
from quadsim.mpc.guard.answer import INFEASIBLE_ANSWER
from quadsim.mpc.solvers import INVALID_DATA

STATUSES: Final = (
    *(UNCONSTRAINED, SOLVED, SOLVED, "primal_infeasible", "max_iterations", "no_room", INVALID_DATA, "not_finite"),
    *("out_of_bounds", "state_unknown", "invalid_reference", str(Phase.LANDED), MISSED, INFEASIBLE_ANSWER),
    *(NOT_CONVERGED, COMMANDED),
)
"""Recorded statuses by `enum quadsim_status`."""
