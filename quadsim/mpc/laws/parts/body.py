"""The rigid body of the nonlinear controller in C: its numbers in the core's layout, its motion from node to node."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from quadsim.core.mirror import Struct, constant, core_library, set_members, struct
from quadsim.mpc.problem.rigidbody import N_BODY, Inputs, RigidBody, inner_response
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS

MOST_BODY_STATES: Final = constant("QUADSIM_NMPC_MOST")
"""Most states, with the input before."""
LEFT: Final = constant("QUADSIM_NMPC_LEFT")
ProblemStruct: Final = struct("quadsim_nmpc_problem")
WorldStruct: Final = struct("quadsim_nmpc_world")


def world_of(model: RigidBody) -> Struct:
    """Return what a model knows of its surroundings, in the core's layout."""
    world = WorldStruct()
    world.thrust_scale = model.thrust_scale
    set_members(
        world,
        acceleration=model.acceleration,
        angular=model.angular_acceleration,
        drag=model.drag / model.mass,
        square_drag=model.quadratic_drag / model.mass,
    )
    return world


def body_of(model: RigidBody) -> tuple[Struct, Array]:
    """Return a rigid body's numbers in the core's layout, and (2 substeps + 1, 8) the array that they point to."""
    numbers = ProblemStruct()
    left = body_numbers(model, numbers)
    return numbers, left


def body_numbers(model: RigidBody, p: Struct) -> Array:
    """Fill in the rigid body's numbers; return (2 substeps + 1, 8) what p.left points to, which the caller keeps."""
    p.actuators = model.actuators
    p.targets = model.targets
    p.speeds = model.inputs is Inputs.SPEED
    p.moments = model.moments
    p.substeps = model.substeps
    p.step = model.step
    p.gravity = model.gravity
    if model.targets:
        p.largest = model.mass * model.gravity
    else:
        p.largest = model.largest_thrust
    ixx, iyy, izz = model.inertia.tolist()
    if model.targets:
        gyration = (0.0, 0.0, 0.0)
    else:
        gyration = ((iyy - izz) / ixx, (izz - ixx) / iyy, (ixx - iyy) / izz)
    lag = np.array(model.lags)
    air = {"moment": model.moment, "inflow": model.inflow, "damping": model.damping}
    p.loss = model.loss
    hold = np.ones(N_ROTORS)
    if model.attitude_lag is not None:
        hold[1:] += 0.5 * model.step / np.array(model.attitude_lag)  # by half of the step's turn
    set_members(p, effect=model.effect, gyration=gyration, lead=lag / model.step, hold=hold, **air)
    instants = 2 * model.substeps + 1
    left = np.empty((instants, LEFT))
    attitude_lags = (None, *(model.attitude_lag or (None, None, None)))
    for i in range(N_ROTORS):
        left[:, i], left[:, N_ROTORS + i] = inner_response(
            0.5 * model.step / model.substeps, instants, lag[i], attitude_lags[i]
        )
    p.left = left.ctypes.data
    return left


def next_states(body: Struct, world: Struct, x: Array, u: Array) -> Array:
    """Return the states (..., n) one step of a body after states x (..., n) under inputs u (..., 4)."""
    x = np.ascontiguousarray(x)
    u = np.ascontiguousarray(u)
    assert x.shape == (*u.shape[:-1], N_BODY + body.actuators)
    assert u.shape[-1] == N_ROTORS
    end = np.empty(x.shape)
    count = math.prod(x.shape[:-1])
    core_library().quadsim_nmpc_advance(body, world, count, x.ctypes.data, u.ctypes.data, end.ctypes.data)
    return end


def linearise(model: RigidBody, x: Array, u: Array, frames: Array | None = None) -> tuple[Array, Array, Array]:
    """Linearise the step of a model from states x (M, n) under inputs u (M, 4), as a horizon's nodes: A, B and x(k+1).

    With `frames` (M + 1, 4), reference quaternions q_r, A and B refer to states with q_r* q in place of q: the
    first M at the start of the steps, the last M at the end.

    Returns:
        (M, n, n), (M, n, 4) and (M, n): exact derivatives of the Runge-Kutta map; x(k+1) itself is in no frame.
    """
    body, left = body_of(model)
    world = world_of(model)
    x = np.ascontiguousarray(x)
    u = np.ascontiguousarray(u)
    M, n = x.shape
    if frames is None:
        frames = np.tile([1.0, 0.0, 0.0, 0.0], (M + 1, 1))
    frames = np.ascontiguousarray(frames)
    slopes = np.empty((M, N_BODY, width_of(n)))
    end = np.empty((M, n))
    for i in range(M):
        arrays = (x[i], u[i], frames[i : i + 2], slopes[i], end[i])
        addresses = (array.ctypes.data for array in arrays)
        core_library().quadsim_nmpc_slopes(body, world, *addresses)
    return *unpacked(slopes, n, 0, left[-1]), end


def width_of(n: int) -> int:
    """Return the columns of a map of n states and 4 inputs: all but the position, padded to an even number."""
    return (n + 2) & ~1


def unpacked(slopes: Array, n: int, befores: int, left: Array) -> tuple[Array, Array]:
    """A (M, n, n) and B (M, n, 4) from the core's maps (M, 13, W).

    `left` (8,) begins with what a step leaves of actuators.  The core's states may end with `befores` more, the inputs
    before.
    """
    M = len(slopes)
    inputs = n - 3 + befores
    A = np.zeros((M, n, n))
    B = np.zeros((M, n, N_ROTORS))
    A[:, :3, :3] = np.eye(3)
    A[:, :N_BODY, 3:] = slopes[:, :, : n - 3]
    B[:, :N_BODY] = slopes[:, :, inputs : inputs + N_ROTORS]
    for a in range(n - N_BODY):
        A[:, N_BODY + a, N_BODY + a] = left[a]
        B[:, N_BODY + a, a] = 1.0 - left[a]
    return A, B
