"""How obstacles, corridors and the fence are enforced."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Le, doc

from quadsim.fields import NonNegative


@dataclass(frozen=True, kw_only=True)
class AvoidanceSettings:
    """How closely."""

    margin: Annotated[NonNegative, doc("[m] added: planes change from instant to instant")] = 0.05
    rows: Annotated[
        int,
        Ge(1),
        Le(50),
        doc("[-] half-spaces per predicted instant that the QP has, the tightest; more where it takes more"),
    ] = 6
    iterations: Annotated[int, Ge(1), Le(50), doc("[-] QPs per period at most, each along the last one's plan")] = 3
