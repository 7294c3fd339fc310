"""The fallback contract's types in C, `quadsim_guard.h`: in flight it is `quadsim.mpc.fallback.contract.Guard`."""

from __future__ import annotations

import ctypes
from typing import Final

from quadsim.controller import COMMANDED, MISSED, NOT_CONVERGED, SOLVED, UNCONSTRAINED, Phase
from quadsim.core.library import AT, INT, REAL, struct_members
from quadsim.mpc.answer import INFEASIBLE_ANSWER
from quadsim.mpc.solvers import INVALID_DATA

STATUSES: Final = (
    *(UNCONSTRAINED, SOLVED, SOLVED, "primal_infeasible", "max_iterations", "no_room", INVALID_DATA, "not_finite"),
    *("out_of_bounds", "state_unknown", "invalid_reference", str(Phase.LANDED), MISSED, INFEASIBLE_ANSWER),
    *(NOT_CONVERGED, COMMANDED),
)
"""Recorded statuses by `enum quadsim_status`."""


class TrimStruct(ctypes.Structure):
    """A `quadsim_trim`."""

    _fields_ = struct_members(REAL, "commands:4 lift:3 twist:3")


class GuardStruct(ctypes.Structure):
    """A `quadsim_guard`."""

    _fields_ = [
        *struct_members(AT, "numbers kept"),
        *struct_members(
            INT, "horizon level learns asked waiting planned foreseeing age hovered targeted since unseen:12"
        ),
        *struct_members(REAL, "in_force:4 before:4 state:12 covariance:144 last:12 last_rates:3 foreseen:12"),
        *struct_members(REAL, "heading:2 level_there:2 resting:4 target:12"),
    ]
