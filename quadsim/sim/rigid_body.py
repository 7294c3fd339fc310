"""A free rigid body by the classical Runge-Kutta method, with motion-dependent forces evaluated at each stage.

MuJoCo's Runge-Kutta method holds external forces over a step.  This integrator replaces it to follow the rules of a
published simulation, or to measure the difference.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from quadsim.errors import ParameterError
from quadsim.sim.effects import LOADING, Change, Effects
from quadsim.sim.effects.forces import StepForces, Wrench
from quadsim.sim.effects.load import Load
from quadsim.space import Obstacle
from quadsim.vehicle import Vehicle

StateRates = tuple[list[float], Wrench]


def check_free(effects: Effects, changes: Iterable[Change], obstacles: Sequence[Obstacle] = ()) -> None:
    """Refuse features that this integrator lacks.

    Raises:
        ParameterError: there is a floor or an obstacle to touch, a load, or MuJoCo's drag.
    """
    unknown = {
        "contact with the ground": effects.ground is not None and effects.ground.contact,
        "obstacles": bool(obstacles),
        "a load": effects.load not in (None, Load()) or any(isinstance(change, LOADING) for change in changes),
        "effects.air.body_drag": effects.air is not None and effects.air.body_drag is not None,
    }
    if names := [name for name, present in unknown.items() if present]:
        raise ParameterError("plant", "integrator", "rk4", f"mujoco with {' and '.join(names)}")


class FreeBody:
    """The equations of motion of a vehicle, and one step of them.

        dp/dt = v,  dq/dt = q (0, w) / 2,  m dv/dt = -m g e_z + R(q) F e_z + f,  J dw/dt = tau + t - w x J w

    with R(q) a polynomial of q, which is normalised after each step.  States are MuJoCo's: position, world (3),
    quaternion wxyz (4), velocity, world (3), body rates (3).
    """

    def __init__(self, vehicle: Vehicle, forces: StepForces, timestep: float) -> None:
        """Prepare for motion-dependent forces and a step [s]."""
        self._mass, self._gravity, self._inertia = vehicle.mass, vehicle.gravity, vehicle.inertia
        torques = vehicle.allocation[1:] / vehicle.thrust_coefficient
        self._torques: list[list[float]] = torques.tolist()
        self._forces, self._step = forces, timestep

    def advance(
        self,
        state: Sequence[float],
        thrusts: Sequence[float],
        of_rotors: Sequence[float],
        wind: Sequence[float],
        held: Sequence[float],
    ) -> tuple[list[float], list[float]]:
        """Return the state (13,) one step later, and the mean of the forces and torques, as in `StepForces.at`.

        The thrusts are (4,) [N], `of_rotors` is a row (6,) of `StepForces.of_rotors`, then come the velocity (3,) of
        the air, world [m/s], and a constant force, world [N], and torque, body [N m], (6,).
        """
        h, (f1, f2, f3, f4) = self._step, thrusts
        fixed = f1 + f2 + f3 + f4, [a * f1 + b * f2 + c * f3 + d * f4 for a, b, c, d in self._torques], held

        def rates(x: Sequence[float]) -> StateRates:
            wrench = self._forces.at(x[:7], x[7:], thrusts, of_rotors, wind)
            return self._rates(x, wrench, *fixed), wrench

        k1, w1 = rates(state)
        k2, w2 = rates([x + 0.5 * h * k for x, k in zip(state, k1, strict=True)])
        k3, w3 = rates([x + 0.5 * h * k for x, k in zip(state, k2, strict=True)])
        k4, w4 = rates([x + h * k for x, k in zip(state, k3, strict=True)])
        after = [x + h / 6.0 * (a + 2.0 * b + 2.0 * c + d) for x, a, b, c, d in zip(state, k1, k2, k3, k4, strict=True)]
        w, x, y, z = after[3:7]
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        after[3:7] = w / norm, x / norm, y / norm, z / norm
        acted = [e + (a + 2.0 * b + 2.0 * c + d) / 6.0 for e, a, b, c, d in zip(held, w1, w2, w3, w4, strict=True)]
        return after, acted

    def _rates(
        self, state: Sequence[float], wrench: Wrench, push: float, torque: Sequence[float], held: Sequence[float]
    ) -> list[float]:
        """(13,) derivative of the state."""
        _, _, _, w, x, y, z, vx, vy, vz, p, q, r = state
        m, (jx, jy, jz) = self._mass, self._inertia
        return [
            vx,
            vy,
            vz,
            -0.5 * (x * p + y * q + z * r),
            0.5 * (w * p + y * r - z * q),
            0.5 * (w * q + z * p - x * r),
            0.5 * (w * r + x * q - y * p),
            (2.0 * (x * z + w * y) * push + wrench[0] + held[0]) / m,
            (2.0 * (y * z - w * x) * push + wrench[1] + held[1]) / m,
            ((1.0 - 2.0 * (x * x + y * y)) * push + wrench[2] + held[2]) / m - self._gravity,
            (torque[0] + wrench[3] + held[3] - (jz - jy) * q * r) / jx,
            (torque[1] + wrench[4] + held[4] - (jx - jz) * r * p) / jy,
            (torque[2] + wrench[5] + held[5] - (jy - jx) * p * q) / jz,
        ]
