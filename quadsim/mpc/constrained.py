"""`[controller] type = "constrained"`: the MPC of Eqs. (27)-(29)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import doc

from quadsim.mpc.bounded import Bounded
from quadsim.mpc.fallback.settings import FallbackSettings


@dataclass(frozen=True, kw_only=True)
class Constrained(Bounded):
    """The paper's constrained MPC, the optimum of a QP in every period (Sec. 5)."""

    type: Annotated[Literal["constrained"], doc("the control law, by its name in `quadsim list`")] = "constrained"
    fallback: Annotated[
        FallbackSettings | None,
        doc("absent: the last plan is held, shifted, and then the flight ends"),
    ] = None
