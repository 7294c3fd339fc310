"""The rigid body of the nonlinear law in C: its numbers in the core's layout, and its motion from node to node."""

from __future__ import annotations

import ctypes
import math
from typing import Final

import numpy as np

from quadsim.core.mirror import Struct, constant, core_library, set_members, struct
from quadsim.mpc.problem.rigidbody import N_BODY, Inputs, RigidBody
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS

STATES_ROOM: Final = constant("QUADSIM_NMPC_MOST")
"""Most states, with the input before."""
ProblemStruct: Final = struct("quadsim_nmpc_problem")
WorldStruct: Final = struct("quadsim_nmpc_world")


class World:
    """What a model knows of its surroundings, in the core's layout.

    Attributes:
        struct: that layout.
        numbers: (13,) its view: acceleration, angular acceleration, drag, quadratic drag over the mass, thrust scale.
    """

    def __init__(self, struct: Struct) -> None:
        self.struct = struct
        self.numbers = np.ctypeslib.as_array((ctypes.c_double * 13).from_buffer(struct))

    @classmethod
    def of(cls, model: RigidBody) -> World:
        """Return that of a model."""
        world = cls(WorldStruct())
        world.set(model)
        return world

    def set(self, model: RigidBody) -> None:
        """Take another disturbance, drag and thrust scale."""
        numbers, mass = self.numbers, model.mass
        numbers[0:3], numbers[3:6] = model.acceleration, model.angular_acceleration
        numbers[6:9], numbers[9:12], numbers[12] = model.drag / mass, model.quadratic_drag / mass, model.thrust_scale


def body_numbers(model: RigidBody, p: Struct) -> Array:
    """Fill in the rigid body's numbers; return (2 substeps + 1, 4) what p.left points to, which the caller keeps."""
    p.actuators, p.targets, p.speeds = model.actuators, model.targets, model.inputs is Inputs.SPEED
    p.moments, p.substeps, p.step, p.gravity = model.moments, model.substeps, model.step, model.gravity
    p.largest = model.mass * model.gravity if model.targets else model.largest_thrust
    ixx, iyy, izz = model.inertia.tolist()
    gyration = (0.0, 0.0, 0.0) if model.targets else ((iyy - izz) / ixx, (izz - ixx) / iyy, (ixx - iyy) / izz)
    lag = np.array(model.lags)
    air = {"moment": model.moment, "inflow": model.inflow, "damping": model.damping}
    set_members(p, effect=model.effect, gyration=gyration, lead=lag / model.step, **air)
    instants = np.arange(2 * model.substeps + 1)[:, None] * (0.5 * model.step / model.substeps)
    left = np.where(lag > 0.0, np.exp(-instants / np.where(lag > 0.0, lag, 1.0)), 0.0)
    p.left = left.ctypes.data
    return left


class Body:
    """The motion of a rigid body over one step of its model.

    Args:
        model: the rigid body; `set_world` changes its disturbance, drag and thrust scale.

    Attributes:
        world: what it knows of its surroundings; another one may be shared with others.
        struct: its numbers in the core's layout.
        left: what `struct.left` points to.
    """

    def __init__(self, model: RigidBody) -> None:
        self.struct, self._n, self._library = ProblemStruct(), model.n, core_library()
        self.left = body_numbers(model, self.struct)
        self.world = World.of(model)

    def set_world(self, model: RigidBody) -> None:
        """Take the disturbance, drag and thrust scale of another model."""
        self.world.set(model)

    def advance(self, x: Array, u: Array) -> Array:
        """Return the states (..., n) one step after states x (..., n) under inputs u (..., 4)."""
        x, u, end = np.ascontiguousarray(x), np.ascontiguousarray(u), np.empty(x.shape)
        assert x.shape == (*u.shape[:-1], self._n)
        assert u.shape[-1] == N_ROTORS
        count = math.prod(x.shape[:-1])
        arrays = (array.ctypes.data for array in (x, u, end))
        self._library.quadsim_nmpc_advance(self.struct, self.world.struct, count, *arrays)
        return end

    def linearise(self, x: Array, u: Array, frames: Array | None = None) -> tuple[Array, Array, Array]:
        """Linearise the step from states x (M, n) under inputs u (M, 4), as a horizon's nodes: A, B and x(k+1).

        With `frames` (M + 1, 4), reference quaternions q_r, A and B refer to states with q_r* q in place of q: the
        first M at the start of the steps, the last M at the end.

        Returns:
            (M, n, n), (M, n, 4) and (M, n): exact derivatives of the Runge-Kutta map; x(k+1) itself is in no frame.
        """
        x, u = np.ascontiguousarray(x), np.ascontiguousarray(u)
        M, n = x.shape
        if frames is None:
            frames = np.tile([1.0, 0.0, 0.0, 0.0], (M + 1, 1))
        slopes, end, frames = np.empty((M, N_BODY, width_of(n))), np.empty((M, n)), np.ascontiguousarray(frames)
        for i in range(M):
            arrays = (x[i], u[i], frames[i : i + 2], slopes[i], end[i])
            addresses = (array.ctypes.data for array in arrays)
            self._library.quadsim_nmpc_slopes(self.struct, self.world.struct, *addresses)
        return *unpacked(slopes, n, 0, self.left[-1]), end


def width_of(n: int) -> int:
    """Return the columns of a map of n states and 4 inputs: all but the position, padded to an even number."""
    return (n + 2) & ~1


def unpacked(slopes: Array, n: int, befores: int, left: Array) -> tuple[Array, Array]:
    """A (M, n, n) and B (M, n, 4) from the core's maps (M, 13, W); `left` (4,) is what a step leaves of actuators.

    The core's states may end with `befores` more, the inputs before.
    """
    M, inputs = len(slopes), n - 3 + befores
    A, B = np.zeros((M, n, n)), np.zeros((M, n, N_ROTORS))
    A[:, :3, :3] = np.eye(3)
    A[:, :N_BODY, 3:], B[:, :N_BODY] = slopes[:, :, : n - 3], slopes[:, :, inputs : inputs + N_ROTORS]
    for a in range(n - N_BODY):
        A[:, N_BODY + a, N_BODY + a], B[:, N_BODY + a, a] = left[a], 1.0 - left[a]
    return A, B
