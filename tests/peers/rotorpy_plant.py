"""RotorPy's multirotor with our vehicle's numbers, and behind the methods that `quadsim.sim.loop.fly` calls.

Both simulators take b w^2 [N] and d w^2 [N m] per rotor, arms from the centre of mass, +1 for a rotor that reacts with
+z torque, and g = 9.81 m/s^2.  RotorPy keeps quaternions as (x, y, z, w), body rates in the body frame, and integrates
with scipy's adaptive solvers.  Its aerodynamics, ground and noise are left out.

Its rotors lag: tau_m dw/dt = w_commanded - w.  They are put at the commanded speed when a hold begins, where dw/dt = 0
whatever tau_m is, so that the speed is held exactly, as in our plant.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from rotorpy.vehicles.multirotor import Multirotor
from scipy.integrate import solve_ivp

from quadsim.errors import ParameterError
from quadsim.rotation import euler_to_body_rates, euler_to_quaternion
from quadsim.sim.physics import PhysicsSteps, physics_to_state, steps_type
from quadsim.state import EULER, EULER_RATE, POSITION, VELOCITY, Array
from quadsim.vehicle import N_ROTORS, Vehicle

INTEGRATOR: Final = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
"""An explicit Runge-Kutta method of order 8, at a tolerance near rounding."""


def make_multirotor(vehicle: Vehicle) -> Any:
    """RotorPy's multirotor for a vehicle.

    Raises:
        ParameterError: the vehicle's gravity is not the one built into RotorPy.
    """
    (ixx, iyy, izz), (ixy, ixz, iyz) = vehicle.inertia, vehicle.products_of_inertia or (0.0, 0.0, 0.0)
    parameters = {
        "mass": vehicle.mass,
        **{"Ixx": ixx, "Iyy": iyy, "Izz": izz, "Ixy": ixy, "Ixz": ixz, "Iyz": iyz},
        "num_rotors": N_ROTORS,
        "rotor_pos": {f"r{i}": position for i, position in enumerate(vehicle.hubs, start=1)},
        "rotor_directions": np.array(vehicle.rotor_spins),
        "rotor_speed_min": 0.0,
        "rotor_speed_max": np.inf,
        "k_eta": vehicle.thrust_coefficient,
        "k_m": (vehicle.drag_to_thrust * vehicle.thrust_coefficient),
        "tau_m": 1.0,
    }
    multirotor = Multirotor(
        parameters, control_abstraction="cmd_motor_speeds", aero=False, integrator_kwargs=dict(INTEGRATOR)
    )
    if multirotor.g != vehicle.gravity:
        raise ParameterError("vehicle", "gravity", vehicle.gravity, f"{multirotor.g}, which is built into RotorPy")
    return multirotor


class RotorPyPlant:
    """RotorPy's multirotor in the place of `quadsim.sim.plant.Plant`; the methods are explained there.

    Attributes:
        vehicle: what flies.
        timestep: spacing of the states that `advance` returns [s]; the integrator chooses its own steps.
    """

    timestep: Final = 1e-3

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        self._multirotor = make_multirotor(vehicle)
        self._time = 0.0
        self._yaw = 0.0
        self._vector = np.zeros(16 + N_ROTORS)
        """RotorPy's own: position, velocity, quaternion (x, y, z, w), body rates, wind, rotor speeds."""

    @property
    def physics(self) -> Array:
        """(14,) the state now, in MuJoCo's order."""
        return _to_physics(np.array([self._time]), self._vector[None])[0]

    @property
    def speeds(self) -> Array:
        """(4,) rotor speeds now [rad/s]."""
        return self._vector[16:].copy()

    @property
    def attitude(self) -> tuple[Array, Array]:
        """The quaternion wxyz (4,) and the body rates (3,) [rad/s] now."""
        physics = self.physics
        return physics[4:8], physics[11:14]

    def reset(self, state: Array, speeds: Array | None = None) -> None:
        """Put the vehicle at a state (12,) at time zero, in still air, its rotors at speeds (4,) [rad/s]."""
        self._vector[16:] = self.vehicle.hover_speed if speeds is None else speeds
        euler = state[list(EULER)]
        self._vector[:13] = np.concatenate(
            [
                state[list(POSITION)],
                state[list(VELOCITY)],
                np.roll(euler_to_quaternion(euler), -1),
                euler_to_body_rates(euler, state[list(EULER_RATE)]),
            ]
        )
        self._time = 0.0
        self._yaw = float(euler[2])

    def state(self) -> Array:
        """(12,) the true state now, yaw unwrapped since the last reset."""
        state = physics_to_state(self.physics[None], self._yaw)[0]
        self._yaw = float(state[EULER[2]])
        return state

    def begin(self, steps: int) -> None:
        """Begin a period, whose steps `hold` appends to `flown`."""
        self.flown = np.empty(0, steps_type())

    def hold(self, command: Array, steps: int, **nothing: None) -> None:
        """Hold a command (4,) [rad/s]; there is no inner loop, and there are no sensors."""
        assert not any(nothing.values())
        self.flown = np.concatenate([self.flown, self.advance(command, steps)])

    def advance(self, speeds: Array, steps: int) -> PhysicsSteps:
        """Hold rotor speeds (4,) [rad/s], and return the states in MuJoCo's order.

        RotorPy's `step` integrates the same function in the same way, but gives the end of the hold alone.
        """
        held = np.maximum(speeds, 0.0)
        self._vector[16:] = held
        t = self.timestep * np.arange(1, steps + 1)
        solution = solve_ivp(
            lambda time, vector: self._multirotor._s_dot_fn(time, vector, held),
            (0.0, t[-1]),
            self._vector,
            t_eval=t,
            **INTEGRATOR,
        )
        vectors = solution.y.T
        vectors[:, 6:10] /= np.linalg.norm(vectors[:, 6:10], axis=1, keepdims=True)
        physics = _to_physics(self._time + t, vectors)
        self._time = float(physics[-1, 0])
        self._vector = vectors[-1].copy()
        flown = np.empty(steps, steps_type())
        flown["physics"] = physics
        flown["speeds"] = held
        flown["commands"] = held
        flown["thrust"] = math.nan
        return flown


def _to_physics(t: Array, vectors: Array) -> Array:
    """MuJoCo's states (M, 14) at times (M,) [s] from RotorPy's vectors (M, 20)."""
    position, velocity, quaternion, body_rates = np.split(vectors[:, :13], [3, 6, 10], axis=1)
    return np.column_stack([t, position, np.roll(quaternion, 1, axis=1), velocity, body_rates])
