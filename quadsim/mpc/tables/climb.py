"""A bound on the climb acceleration, as rows on the commands: the vertical acceleration of the rotors' thrust.

In level flight a thrust U climbs with U / m - g.  The rows are linear in what the law commands, and exact where the
rotors climb at the bound without turning the vehicle: D u, with the slope D of the model, is bounded by its values at
the commands of these two climbs.  Rows on commands always have an answer, and rotors that lag stay between the commands
that they follow.  An autopilot's target of the thrust is bounded itself.

Tilted by phi, the vehicle climbs with U cos(phi) / m - g.  A linear law does not know that; a nonlinear one would turn
over to descend faster, so that it needs a bound on the tilt, up to which it then holds the lower bound.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, Final

import numpy as np
from annotated_types import doc

from quadsim.errors import ParameterError
from quadsim.fields import Pair
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.problem.constraints import Constraint, Origin
from quadsim.mpc.problem.model import continuous_model
from quadsim.mpc.tables.controller import require_ordered
from quadsim.state import INDEX, Array
from quadsim.vehicle import Vehicle

CLIMB: Final = "climb_acceleration"
"""The signal of the audit that the rows bound, and the field that states them."""
ClimbBounds = Annotated[
    Pair | None,
    doc(
        "[m/s^2] lower and upper bound of the vertical acceleration that the thrust gives in level flight, 0 in hover; "
        "absent: no bound"
    ),
]


def require_climb(pair: Pair | None) -> None:
    """Refuse bounds that hover is not within."""
    if pair is None:
        return
    require_ordered(CLIMB, pair)
    if not pair[0] < 0.0 < pair[1]:
        raise ValueError(f"{CLIMB} must contain 0 m/s^2, that of hover; got {[*pair]}")


def within_tilt(vehicle: Vehicle, pair: Pair, tilt: float) -> Pair:
    """Return the bounds with the lower one raised to that of level flight which holds it up to a tilt [deg].

    Raises:
        ParameterError: hover is no longer within them.
    """
    gravity = vehicle.gravity
    steepest = math.cos(math.radians(tilt))
    lower = (gravity + pair[0]) / steepest - gravity
    if lower >= 0.0:
        highest = gravity * (steepest - 1.0)
        rule = f"of a lower bound below {highest:.4g} m/s^2, what hover's thrust gives at tilt = {tilt:g} deg"
        raise ParameterError("controller", CLIMB, [*pair], rule)
    return lower, pair[1]


def climb_thrusts(vehicle: Vehicle, pair: Pair) -> tuple[float, float]:
    """Return the collective thrusts of level flight [N] with these two accelerations; rotors do not pull down."""
    lower, upper = (vehicle.mass * max(vehicle.gravity + bound, 0.0) for bound in pair)
    return lower, upper


def climb_speeds(vehicle: Vehicle, pair: Pair) -> tuple[Array, Array]:
    """Return the rotor speeds (4,) of level flight [rad/s] with these two accelerations."""
    lower, upper = (vehicle.speeds(thrust * vehicle.thrust_shares) for thrust in climb_thrusts(vehicle, pair))
    return lower, upper


def climb_constraint(row: Array, lower: Array, upper: Array, scale: float = 1.0) -> Constraint:
    """Return the constraint of a row D (4,) [m/s^2 per command], between the commands of its two climbs (4,).

    `scale` has the command per input of 1, where inputs are shares.
    """
    return Constraint(
        name=CLIMB,
        lower=np.array([row @ lower]),
        upper=np.array([row @ upper]),
        D=(row * scale)[None],
        origins=(Origin(CLIMB, "m/s^2", field=f"controller.{CLIMB}"),),
    )


def climb_of_rotors(vehicle: Vehicle, pair: Pair, scale: float = 1.0) -> Constraint:
    """Return the row over rotor speeds, with the slope of hover; `scale` as in `climb_constraint`."""
    row = continuous_model(vehicle)[1][INDEX["vz"]]
    return climb_constraint(row, *climb_speeds(vehicle, pair), scale)


def climbing_targets(bounds: ActuatorBounds, vehicle: Vehicle, pair: Pair | None) -> ActuatorBounds:
    """Return bounds on an autopilot's targets with those of these two climbs on the collective thrust, the first."""
    if pair is None:
        return bounds
    lower, upper = climb_thrusts(vehicle, pair)
    u_min = bounds.u_min.copy()
    u_max = bounds.u_max.copy()
    u_min[0] = max(u_min[0], lower)
    u_max[0] = min(u_max[0], upper)
    return replace(bounds, u_min=u_min, u_max=u_max)
