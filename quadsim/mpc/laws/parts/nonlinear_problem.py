"""The problem that a nonlinear MPC solves in each step, at hover: its model, its cost and all of its rows."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np
import scipy.linalg

from quadsim.controller import ROTORS
from quadsim.errors import ParameterError
from quadsim.fields import Pair
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.laws.nonlinear import Nonlinear
from quadsim.mpc.laws.parts.body import linearise
from quadsim.mpc.laws.parts.sqp import OWN_NAMES, TILT_SIDES
from quadsim.mpc.problem.constraints import Constraint, Penalty
from quadsim.mpc.problem.model import LinearModel
from quadsim.mpc.problem.ocp import Objective, Problem, lqr_terminal_weight
from quadsim.mpc.problem.rigidbody import N_BODY, Inputs, P, RigidBody, V, W, rigid_body
from quadsim.mpc.tables.climb import climb_constraint, climb_of_rotors, climb_speeds
from quadsim.mpc.tables.lags import resolved_lag
from quadsim.state import EULER, EULER_RATE, POSITIONS, VELOCITIES, Array
from quadsim.vehicle import N_ROTORS, Vehicle

_HOVER_STATES: Final = (
    *("x", "y", "z", "attitude x", "attitude y", "attitude z", "vx", "vy", "vz"),
    *("body rate x", "body rate y", "body rate z", "rotor 1", "rotor 2", "rotor 3", "rotor 4"),
)
"""States of the model near hover: the quaternion's vector part is the attitude."""


def prediction_model(settings: Nonlinear, vehicle: Vehicle, period: float) -> RigidBody:
    """Return the rigid body from node to node, undisturbed.

    Raises:
        InputError: the vehicle lacks what the settings ask of it.
    """
    inputs = Inputs(settings.inputs)
    if settings.commands != ROTORS:
        inputs = Inputs.RATES
    if settings.moment:
        vehicle.require_moment("controller")
    return rigid_body(
        vehicle,
        period * settings.stride(period),
        substeps=settings.substeps,
        inputs=inputs,
        rotor_lag=resolved_lag(settings.rotor_lag, vehicle) or None,
        lag=settings.inner_lag or (0.0, 0.0, 0.0, 0.0),
        attitude_lag=settings.attitude_lag,
        drag=np.array(settings.drag),
        quadratic_drag=np.array(settings.quadratic_drag),
        moment=settings.moment,
    )


def commands_to_inputs(model: RigidBody, vehicle: Vehicle, commands: Array) -> Array:
    """Return the inputs for commands (..., 4): rotor speeds [rad/s] or targets [N], [rad/s]."""
    if model.targets:
        return commands / model.scale
    return model.shares(vehicle.mean_coefficient * np.square(commands))


def inputs_to_commands(model: RigidBody, vehicle: Vehicle, shares: Array) -> Array:
    """Return the commands of inputs (..., 4): rotor speeds [rad/s] or targets [N], [rad/s]."""
    if model.targets:
        return shares * model.scale
    return np.sqrt(model.thrusts(np.maximum(shares, 0.0)) / vehicle.mean_coefficient)


def level_command(model: RigidBody, vehicle: Vehicle) -> Array:
    """(4,) the command of level hover: rotor speeds [rad/s] or targets [N], [rad/s]."""
    if model.targets:
        return np.array([vehicle.mass * vehicle.gravity, 0.0, 0.0, 0.0])
    return vehicle.hover_speeds


def nonlinear_problem(
    settings: Nonlinear,
    vehicle: Vehicle,
    period: float,
    model: RigidBody,
    bounds: ActuatorBounds,
    constraints: tuple[Constraint, ...],
) -> Problem:
    """Return the problem of a controller with this model, at hover.

    Args:
        settings: its table.
        vehicle: its vehicle.
        period: control period [s].
        model: from node to node.
        bounds: of its commands.
        constraints: further rows, over the 12 states and four rotor speeds.

    Raises:
        ParameterError: a row is not linear in the model's states and inputs.
    """
    stride = settings.stride(period)
    nodes = settings.horizon // stride
    hover = commands_to_inputs(model, vehicle, level_command(model, vehicle))
    x = np.zeros(model.n)
    x[3] = 1.0
    x[N_BODY:] = hover[: model.n - N_BODY]
    A, B, _ = linearise(model, x[None], hover[None])
    rows, weights = settings.outputs()
    Q_d = None
    if settings.weights.move:
        Q_d = settings.weights.move * np.eye(N_ROTORS)
    objective = Objective(
        C_r=np.hstack([rows, np.zeros((len(rows), model.n - N_BODY))]),
        Q_y=np.diag(weights),
        Q_u=settings.weights.input * np.eye(N_ROTORS),
        Q_d=Q_d,
    )
    linear = LinearModel(A=A[0], B=B[0], u_bar=hover, period=model.step)
    Q, _ = objective.weights
    if settings.terminal == "lqr":
        P_end = _riccati(settings, linear, objective)
    elif settings.terminal == "none":
        P_end = 0.0 * Q
    else:
        P_end = settings.terminal * Q
    if settings.tilt is not None:  # two further states: the thrust axis along world x and y
        none = np.zeros((2, 2))
        A_axis = scipy.linalg.block_diag(linear.A, none)
        B_axis = np.vstack([linear.B, np.zeros((2, N_ROTORS))])
        linear = replace(linear, A=A_axis, B=B_axis)
        P_end = scipy.linalg.block_diag(P_end, none)
        objective = replace(objective, C_r=np.hstack([objective.C_r, np.zeros((len(rows), 2))]))
    lower = commands_to_inputs(model, vehicle, bounds.u_min)
    upper = commands_to_inputs(model, vehicle, bounds.u_max)
    parts = [Constraint(name="inputs", lower=lower, upper=upper, D=np.eye(N_ROTORS))]
    parts += _own_bounds(settings, vehicle, model, bounds, linear.n, nodes, stride)
    for constraint in constraints:
        parts.append(_of_states(constraint, vehicle, model, linear.n))
    objective = replace(objective, P=P_end)
    return Problem(model=linear, horizon=nodes, objective=objective, constraints=tuple(parts))


def _own_bounds(
    settings: Nonlinear, vehicle: Vehicle, model: RigidBody, bounds: ActuatorBounds, n: int, nodes: int, stride: int
) -> Iterator[Constraint]:
    """Yield the bounds on slew, tilt, climb acceleration and body rates, in a problem with n states."""
    if np.isfinite(bounds.delta_min).any() or np.isfinite(bounds.delta_max).any():
        if model.inputs is not Inputs.SPEED:
            rule = 'left out where inputs = "thrust": a step of a speed is not linear in thrusts; inputs = "speed"'
            raise ParameterError("controller", "input_bounds.slew", bounds.delta_max.tolist(), rule)
        steps = np.full((nodes, 1), float(stride))  # periods between nodes,
        steps[0] = 1.0  # except the first node, which follows the command in force
        lower = steps * bounds.delta_min / vehicle.speed_max
        upper = steps * bounds.delta_max / vehicle.speed_max
        yield Constraint(name="slews", lower=lower, upper=upper, E=np.eye(N_ROTORS))
    if settings.tilt is not None:
        tilt = math.radians(settings.tilt)
        angles = math.tau / TILT_SIDES * np.arange(TILT_SIDES)
        rows = np.zeros((TILT_SIDES, n))
        rows[:, -2] = np.cos(angles)
        rows[:, -1] = np.sin(angles)
        upper = np.full(TILT_SIDES, math.sin(tilt) * math.cos(math.pi / TILT_SIDES))
        penalty = _penalty(settings, TILT_SIDES, 1.0 / math.cos(tilt))  # in the sine of the tilt
        yield Constraint(name="tilt", lower=np.full(TILT_SIDES, -math.inf), upper=upper, C=rows, penalty=penalty)
    climb = settings.level_climb(vehicle)
    if climb is not None and not model.targets:
        yield _climb(climb, vehicle, model)
    rates = settings.largest_rates
    if np.isfinite(rates).any():
        penalty = _penalty(settings, 3, 1.0)
        yield Constraint(name="body_rates", lower=-rates, upper=rates, C=np.eye(n)[W], penalty=penalty)


def _climb(pair: Pair, vehicle: Vehicle, model: RigidBody) -> Constraint:
    """Return the bounds on the climb acceleration as a row over the inputs that turn rotors."""
    if model.inputs is Inputs.SPEED:
        return climb_of_rotors(vehicle, pair, vehicle.speed_max)
    row = model.effectiveness[0] * model.largest_thrust  # in the thrusts it is linear
    lower, upper = (commands_to_inputs(model, vehicle, speeds) for speeds in climb_speeds(vehicle, pair))
    return climb_constraint(row, lower, upper)


def _penalty(settings: Nonlinear, rows: int, scale: float) -> Penalty | None:
    soft = settings.soft
    if soft is None:
        return None
    return Penalty(l1=np.full(rows, soft.linear * scale), l2=np.full(rows, soft.quadratic * scale**2), largest=True)


def _of_states(constraint: Constraint, vehicle: Vehicle, model: RigidBody, n: int) -> Constraint:
    """Convert rows over the 12 states and rotor speeds to the model's; refuse those not linear in its states."""
    m = constraint.lower.shape[-1]
    C = np.zeros((m, n))
    D = np.zeros((m, N_ROTORS))
    if constraint.name in OWN_NAMES:
        rule = f"named otherwise than {', '.join(OWN_NAMES)}, the controller's own bounds"
        raise ParameterError("controller", constraint.name, "further rows of that name", rule)
    if constraint.E is not None and constraint.E.any():
        rule = "without steps of rotor speeds, which input_bounds.slew bounds"
        raise ParameterError("controller", constraint.name, "of those", rule)
    if constraint.C is not None:
        if constraint.C.ndim == 3:
            rule = "with the same rows at all steps: only the half-spaces of obstacles differ from step to step"
            raise ParameterError("controller", constraint.name, "of others", rule)
        if constraint.C[:, [*EULER, *EULER_RATE]].any():
            rule = "without Euler angles and their rates; tilt and body_rate bound the attitude"
            raise ParameterError("controller", constraint.name, "of those", rule)
        C[:, P] = constraint.C[:, POSITIONS]
        C[:, V] = constraint.C[:, VELOCITIES]
    if constraint.D is not None and constraint.D.any():
        if model.targets:
            rule = "without rotor speeds where an autopilot flies the commands: an inner loop commands the rotors"
            raise ParameterError("controller", constraint.name, "of those", rule)
        if model.inputs is not Inputs.SPEED:
            rule = 'without rotor speeds where inputs = "thrust", in which they are not linear: inputs = "speed"'
            raise ParameterError("controller", constraint.name, "of those", rule)
        D = constraint.D * vehicle.speed_max
    return replace(constraint, C=C, D=D)


def _riccati(settings: Nonlinear, linear: LinearModel, objective: Objective) -> Array:
    """Return P at hover, where the quaternion's scalar part is constant and has no cost."""
    others = np.delete(np.arange(linear.n), 3)
    reduced = replace(objective, C_r=objective.C_r[:, others], P=None)
    if settings.attitude_error == "difference":
        rows = np.delete(np.arange(len(objective.C_r)), 3)
        reduced = replace(reduced, C_r=reduced.C_r[rows], Q_y=objective.Q_y[np.ix_(rows, rows)])
    part = replace(linear, A=linear.A[np.ix_(others, others)], B=linear.B[others])
    P_end = np.zeros((linear.n, linear.n))
    P_end[np.ix_(others, others)] = lqr_terminal_weight(part, reduced, _HOVER_STATES)
    return P_end
