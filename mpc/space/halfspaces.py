"""Keeping clear of obstacles, and inside corridors and a fence, by half-spaces along the predicted positions.

An obstacle's convex solid is avoided at each predicted instant by the plane through its nearest point to where
the last plan was to be then, p_i, at distance d_i and with the outward normal n_i:

    n_i . p >= n_i . p_i - d_i + r + m_i,

r the radius of the vehicle's bounding ball and m_i the margin.  Where p_i is inside, d_i is negative and the
plane is that of the nearest way out.  Behind the plane lies all of the solid, so that what satisfies the half-space
keeps clear at that instant, wherever p_i was: the restriction is safe, and it is conservative.  A moving obstacle is
where it will be at that instant.  Corridors and the fence are half-spaces themselves, and exact.

The planes change with the plan, so that the QP is solved again along the new one, a few times per period at most
(sequential convex programming; Schulman et al., 2014, "Motion planning with sequential convex optimization and convex
collision checking").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final, TypeAlias

import numpy as np
from annotated_types import Ge, Le, doc

from mpc.constraints import Constraint, Penalty
from quadsim.fields import NonNegative
from quadsim.space import AnyObstacle, Corridor, Fence, Obstacle, Solids
from quadsim.state import POSITION, Array

Shape: TypeAlias = AnyObstacle | Corridor | Fence

LOOSE: Final = 1e3
"""By how much [m] a half-space that is not in force is left open."""


@dataclass(frozen=True, kw_only=True)
class AvoidanceSettings:
    """How obstacles, corridors and the fence are enforced, and how closely."""

    margin: Annotated[NonNegative, doc("[m] added: planes change from instant to instant")] = 0.05
    rows: Annotated[
        int,
        Ge(1),
        Le(50),
        doc("[-] half-spaces per predicted instant that the QP has, the tightest; more where it takes more"),
    ] = 6
    iterations: Annotated[int, Ge(1), Le(50), doc("[-] QPs per period at most, each along the last one's plan")] = 3


class Space:
    """Obstacles and regions as half-spaces.

    Args:
        shapes: the obstacles and regions.
        radius: of the vehicle's bounding ball [m].
        period: from one predicted instant to the next [s].
        horizon: N.
        settings: see `AvoidanceSettings`.
        margins: (N, 3) further ones along x, y, z at each predicted instant [m], as of a disturbance; None for none.
        penalty: l1 [1/m] and l2 [1/m^2] of violating a half-space; None for hard ones.
        largest: whether it is of the largest violation at each instant, instead of all.
        positions: which of the states are x, y, z.
    """

    def __init__(
        self,
        shapes: Sequence[Shape],
        *,
        radius: float,
        period: float,
        horizon: int,
        settings: AvoidanceSettings,
        margins: Array | None = None,
        penalty: tuple[float, float] | None = None,
        positions: Sequence[int] = POSITION,
        largest: bool = False,
    ) -> None:
        self._largest = largest
        self.settings, self.penalty, self.period, self.positions = settings, penalty, period, list(positions)
        self._shapes, self._distance = tuple(shapes), radius + settings.margin
        self._margins = np.zeros((horizon, 3)) if margins is None else margins
        self._solids = Solids([shape for shape in self._shapes if isinstance(shape, Obstacle)])
        counts = [len(s.solids) if isinstance(s, Obstacle) else len(s.half_spaces[1]) for s in self._shapes]
        places = np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1])
        self._names = np.repeat(np.array([shape.name for shape in self._shapes], str), counts)
        self._of_solids = np.repeat(np.array([isinstance(s, Obstacle) for s in self._shapes], bool), counts)
        shaped = zip(self._shapes, places, strict=False)
        self._regions = [(shape, at) for shape, at in shaped if not isinstance(shape, Obstacle)]

    def half_spaces(self, t: Array, positions: Array) -> tuple[Array, Array]:
        """Normals (S, N, 3) and bounds (S, N) [m] of normal . p >= bound, at times (N,) along positions (N, 3)."""
        normals, bounds = np.empty((len(self._names), len(t), 3)), np.empty((len(self._names), len(t)))
        distance, normal = self._solids.clearances(t, positions)
        normals[self._of_solids], bounds[self._of_solids] = normal, (normal * positions).sum(axis=2) - distance
        for region, at in self._regions:
            rows, upper = region.half_spaces
            normals[at] = -rows[:, None, :]
            # Also at the instants just before and after: what is between two of them is then inside as well.
            in_force = (t > region.start - self.period) & (t < region.stop + self.period)
            bounds[at] = np.where(in_force, -upper[:, None], (normals[at] * positions).sum(axis=2) - LOOSE)
        return normals, bounds + self._distance + (np.abs(normals) * self._margins).sum(axis=2)

    def constraint(self, normals: Array, bounds: Array, states: int, *, name: str = "space") -> Constraint:
        """Half-spaces (m, N, 3), (m, N) as rows on so many states."""
        C = np.zeros((bounds.shape[1], len(bounds), states))
        C[:, :, self.positions] = normals.transpose(1, 0, 2)
        lower, (l1, l2) = bounds.T, (0.0, 0.0) if self.penalty is None else self.penalty
        penalty = Penalty(l1=np.full(len(bounds), l1), l2=np.full(len(bounds), l2), largest=self._largest)
        return Constraint(
            name=name,
            lower=lower,
            upper=np.full_like(lower, np.inf),
            C=C,
            penalty=None if self.penalty is None else penalty,
        )

    def constraints(self, normals: Array, bounds: Array, states: int) -> tuple[Constraint, ...]:
        """All half-spaces, one constraint per obstacle or region, by its name."""
        found = []
        for shape in self._shapes:
            at = self._names == shape.name
            found.append(self.constraint(normals[at], bounds[at], states, name=_titled(shape)))
        return tuple(found)


def _titled(shape: Shape) -> str:
    kind = "obstacle" if isinstance(shape, Obstacle) else "corridor" if isinstance(shape, Corridor) else ""
    return f"{kind} {shape.name}".strip()
