"""The preparation of the robust MPC in NumPy, written from its equations, against which C is tested; Sec. 2.2."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from quadsim.mpc.estimate.observer import LEAST_UPRIGHT, DisturbanceObserver
from quadsim.mpc.laws.robust import Robust
from quadsim.mpc.problem.equilibrium import LEAST_LIFT, Trim
from quadsim.mpc.problem.heading import slope, turn_horizontally
from quadsim.mpc.problem.model import hover_model, split_delay
from quadsim.mpc.problem.ocp import Equilibrium, Problem, Query
from quadsim.mpc.tables.lags import resolved_lag
from quadsim.rotation import body_to_world, euler_to_body_rates
from quadsim.state import EULER, EULER_RATE, INDEX, N_STATES, VELOCITY, Array, ReferenceTurns
from quadsim.vehicle import Vehicle

YAW = INDEX["yaw"]


@dataclass(frozen=True, kw_only=True)
class NonlinearModel:
    """x(k+1) = f(x(k), u(k)) of a body whose rotor speeds are the inputs, or follow them as tau_r dw/dt = u - w."""

    effectiveness: Array  # (4, 4) maps squared rotor speeds to U / m [m/s^2] and I^-1 tau [rad/s^2]
    inertia: Array  # (3,) [kg m^2]
    gravity: float
    period: float
    substeps: int = 2  # Runge-Kutta steps
    rotor_lag: float | None = None  # tau_r [s]; None if the inputs are the speeds
    acceleration: Array = field(default_factory=lambda: np.zeros(3))  # of a disturbance, world [m/s^2]
    angular_acceleration: Array = field(default_factory=lambda: np.zeros(3))  # and body [rad/s^2]
    air: Vehicle | None = None  # whose moments and loss of thrust in still air it has; None for none

    @property
    def n(self) -> int:
        """Number of states."""
        return N_STATES if self.rotor_lag is None else N_STATES + 4


def nonlinear_model(
    vehicle: Vehicle, period: float, *, substeps: int = 2, rotor_lag: float | None = None
) -> NonlinearModel:
    """The vehicle's model, undisturbed."""
    return NonlinearModel(
        effectiveness=vehicle.accelerations(vehicle.allocation),
        inertia=np.array(vehicle.inertia),
        gravity=vehicle.gravity,
        period=period,
        substeps=substeps,
        rotor_lag=rotor_lag,
    )


def spun(model: NonlinearModel, rotors: Array, command: Array, time: float) -> Array:
    """Rotor speeds (4,) a time [s] after speeds (4,) under a command (4,)."""
    if model.rotor_lag is None:
        return command
    return np.asarray(command + math.exp(-time / model.rotor_lag) * (rotors - command))


def air_on(vehicle: Vehicle, speeds: Array, velocity: Array, rates: Array) -> Array:
    """What still air adds to U / m and I^-1 tau (4,), velocity and rates along the body's axes.

    Of the thrust lost to inflow, the sum of the speeds counts, and the torque is that of turning, as in hover.
    """
    turning = float(speeds.sum())
    torque = vehicle.air_moment(turning, velocity, rates)
    torque = torque - vehicle.lost_to_inflow(vehicle.hover_speeds, np.zeros(3), rates)[1:]
    lost = (vehicle.inflow or 0.0) * turning * velocity[2] / vehicle.mass
    return np.append(-lost, vehicle.angular_acceleration(torque))


def slopes(model: NonlinearModel, x: Array, speeds: Array) -> Array:
    """dx/dt (12,): Newton, Euler, and E(eta) d2(eta)/dt2 = d(omega)/dt - dE/dt d(eta)/dt, E^-1 written out."""
    roll, pitch, yaw = x[6:11:2].tolist()
    dr, dp, dy = x[7:12:2].tolist()
    thrust, *torque = (model.effectiveness @ speeds**2).tolist()
    sr = math.sin(roll)
    sp = math.sin(pitch)
    sy = math.sin(yaw)
    cr = math.cos(roll)
    cp = math.cos(pitch)
    cy = math.cos(yaw)
    # omega = E d(eta)/dt
    p = dr - sp * dy
    q = cr * dp + cp * sr * dy
    r = cp * cr * dy - sr * dp
    if model.air is not None:
        velocity = body_to_world(x[[*EULER]]).T @ x[[*VELOCITY]]
        added = air_on(model.air, speeds, velocity, np.array([p, q, r]))
        thrust, *torque = (np.array([thrust, *torque]) + added).tolist()
    (i_x, i_y, i_z), (a_x, a_y, a_z) = model.inertia.tolist(), model.angular_acceleration.tolist()
    # d(omega)/dt less dE/dt d(eta)/dt
    turned_x = torque[0] + (i_y - i_z) / i_x * q * r + a_x + cp * dp * dy
    turned_y = torque[1] + (i_z - i_x) / i_y * r * p + a_y + sr * dr * dp + (sp * sr * dp - cp * cr * dr) * dy
    turned_z = torque[2] + (i_x - i_y) / i_z * p * q + a_z + cr * dr * dp + (sp * cr * dp + cp * sr * dr) * dy
    yawed = (sr * turned_y + cr * turned_z) / cp
    result = np.empty(N_STATES)
    result[0::2] = x[1::2]
    result[1:6:2] = [thrust * (cy * sp * cr + sy * sr), thrust * (sy * sp * cr - cy * sr), thrust * cp * cr]
    result[1:6:2] += model.acceleration
    result[5] -= model.gravity
    result[7:12:2] = [turned_x + sp * yawed, cr * turned_y - sr * turned_z, yawed]
    return result


def next_state(model: NonlinearModel, x: Array, u: Array) -> Array:
    """The state (n,) one period after a state x (n,) under inputs u (4,), by Runge-Kutta's classical method."""
    step = model.period / model.substeps
    state = x[:N_STATES]
    rotors = x[N_STATES:]
    for k in range(model.substeps):
        start, middle, end = (spun(model, rotors, u, (k + share) * step) for share in (0.0, 0.5, 1.0))
        k_1 = slopes(model, state, start)
        k_2 = slopes(model, state + 0.5 * step * k_1, middle)
        k_3 = slopes(model, state + 0.5 * step * k_2, middle)
        k_4 = slopes(model, state + step * k_3, end)
        state = state + step / 6.0 * (k_1 + 2.0 * k_2 + 2.0 * k_3 + k_4)
    return np.concatenate([state, spun(model, rotors, u, model.period)])[: model.n]


def twisted(effectiveness: Array, twist: Array) -> Array:
    """(4, 4) effectiveness of a model whose thrust causes an angular acceleration; see `Trim.twist`."""
    return effectiveness + np.outer(np.append(0.0, twist), effectiveness[0])


def equilibrium(model: NonlinearModel, twist: Array | None = None) -> Trim:
    """U / m R(eta) e_z = g e_z - a, I^-1 tau = -alpha, of a model that is not yet `twisted`; at least `LEAST_LIFT`."""
    twist = np.zeros(3) if twist is None else twist
    lift = np.array([0.0, 0.0, model.gravity]) - model.acceleration
    lift[2] = max(lift[2], LEAST_LIFT * model.gravity)
    thrust = float(np.linalg.norm(lift))
    drive = np.append(thrust, -thrust * twist - model.angular_acceleration)
    squares = np.linalg.solve(model.effectiveness, drive)
    return Trim(speeds=np.sqrt(np.maximum(squares, 0.0)), lift=lift, twist=twist)


def surprise(measured: Array, expected: Array) -> Array:
    """Innovations (6,): along world x, y and the thrust, whatever its direction, and about the body's axes."""
    axis = body_to_world(measured[[*EULER]])[:, 2]
    missed = (measured - expected)[[*VELOCITY]]
    along = missed[2] / max(axis[2], LEAST_UPRIGHT)
    rates = [euler_to_body_rates(state[[*EULER]], state[[*EULER_RATE]]) for state in (measured, expected)]
    return np.concatenate([(missed - along * axis)[:2], [along], rates[0] - rates[1]])


class NumpyPreparation:
    """Queries of the robust MPC, period by period."""

    def __init__(self, vehicle: Vehicle, problem: Problem, settings: Robust) -> None:
        period = problem.model.period
        self.problem = problem
        self.settings = settings
        model = nonlinear_model(vehicle, period, rotor_lag=resolved_lag(settings.rotor_lag, vehicle) or None)
        self.model = replace(model, air=vehicle if settings.moment else None)
        self.whole, self.late = split_delay(settings.delay, period)
        self.from_accelerations = np.linalg.inv(slope(hover_model(vehicle, period)))
        self.observer = DisturbanceObserver(settings.offset_free, period) if settings.offset_free else None
        self.turns = ReferenceTurns()
        self.estimate = np.zeros(6)
        self.sent = deque([vehicle.hover_speeds] * (self.whole + 1), maxlen=self.whole + 1)
        self.rotors = vehicle.hover_speeds  # when the next command takes over in this period
        self.ahead: Array | None = None  # the state there

    def after(self, time: float, state: Array, rotors: Array, command: Array) -> Array:
        """The state (12,) a time later, under the estimated disturbance."""
        if time <= 1e-9:
            return state
        acceleration = self.estimate[2] * body_to_world(state[[*EULER]])[:, 2]
        acceleration[:2] += self.estimate[:2]
        effectiveness = twisted(self.model.effectiveness, self.estimate[3:] / self.model.gravity)
        model = replace(self.model, period=time, effectiveness=effectiveness, acceleration=acceleration)
        return next_state(model, np.concatenate([state, rotors])[: model.n], command)[:N_STATES]

    @property
    def trim(self) -> Trim:
        """Rest under the estimate."""
        x, y, along = self.estimate[:3]
        axis = np.array([-x, -y, self.model.gravity]) / math.hypot(x, y, self.model.gravity)
        model = replace(self.model, acceleration=along * axis + [x, y, 0.0])
        return equilibrium(model, self.estimate[3:] / self.model.gravity)

    def follow(self, acting: Array) -> tuple[Array, list[Array], Array]:
        """Let rotors follow their commands; returns the one in force, those under way, and the speeds (4,) at t_k."""
        self.sent.append(acting)
        in_force, *under_way = self.sent
        rotors = spun(self.model, self.rotors, in_force, self.model.period - self.late)
        self.rotors = spun(self.model, rotors, in_force, self.late)
        return in_force, under_way, rotors

    def stand(self, acting: Array) -> None:
        """Pass a period on the ground."""
        self.follow(acting)
        self.estimate = np.zeros(6)
        self.ahead = None

    def prepare(self, state: Array, reference: Array, acting: Array, *, flying: bool, learns: bool) -> Query:
        """The query of a period in the air, or on the ground before it."""
        period = self.model.period
        before = self.rotors
        ahead = self.ahead
        in_force, under_way, rotors = self.follow(acting)
        if self.observer is not None and ahead is not None and learns:
            missed = surprise(state, self.after(period - self.late, ahead, before, in_force))
            estimate = self.estimate + self.observer.gain * missed
            self.estimate = np.clip(estimate, -self.observer.largest, self.observer.largest)
        x = self.after(self.late, state, rotors, in_force)
        self.ahead = x if flying else None
        turning = self.rotors
        for command in under_way:
            x = self.after(period, x, turning, command)
            turning = spun(self.model, turning, command, period)
        return self.query(x, turning, self.turns.follow(reference, float(state[YAW])), acting)

    def query(self, x: Array, turning: Array, reference: Array, acting: Array) -> Query:
        """The query from a state (12,) and rotor speeds (4,) at the instant from which the command acts."""
        beyond = self.beyond_hover(x, turning)
        n = self.problem.model.n
        trim = self.trim
        yaw = float(x[YAW]) if self.settings.heading else 0.0
        rates = self.problem.rates(reference)
        reference = self.later(reference)
        rates = None if rates is None else self.later(rates)
        if self.settings.heading:
            most = math.radians(self.settings.largest_turn)
            steps = np.diff(reference[:, 3], prepend=yaw)
            reference[:, 3] = np.cumsum(np.clip(steps, -most, most))
            x = turn_horizontally(x, -yaw)
            x[YAW] = 0.0
        c = math.cos(yaw)
        s = math.sin(yaw)
        for rows in (reference, rates):
            if rows is not None:
                rows[:, :2] = rows[:, :2] @ np.array([[c, -s], [s, c]])
        thrust = self.model.effectiveness[0]
        excess = thrust @ (turning**2 - trim.speeds**2)  # thrust that differs turns the vehicle otherwise
        u_s = trim.speeds - self.from_accelerations[:, 1:] @ (excess * trim.twist)
        u_s = u_s - self.from_accelerations @ beyond
        x_s = trim.state(yaw, n)
        x_s[N_STATES:] = u_s[: n - N_STATES]
        desired = self.problem.objective.desired(reference, rates)
        return Query(np.concatenate([x, turning])[:n], desired, acting, Equilibrium(x_s, u_s))

    def beyond_hover(self, x: Array, turning: Array) -> Array:
        """What the air does at a state (12,) with rotor speeds (4,) beyond what the hover model has of it, (4,)."""
        vehicle = self.model.air
        if vehicle is None:
            return np.zeros(4)
        velocity = x[[*VELOCITY]]
        euler = x[[*EULER]]
        euler_rates = x[[*EULER_RATE]]
        along = body_to_world(euler).T @ velocity
        done = air_on(vehicle, turning, along, euler_to_body_rates(euler, euler_rates))
        level = body_to_world(np.array([0.0, 0.0, euler[2] if self.settings.heading else 0.0])).T @ velocity
        # to first order, each alone
        across = np.array([*level[:2], 0.0])
        climbing = np.array([0.0, 0.0, level[2]])
        hover = vehicle.hover_speeds
        known = air_on(vehicle, hover, across, euler_rates) + air_on(vehicle, hover, climbing, np.zeros(3))
        return np.asarray(done - known)

    def later(self, rows: Array) -> Array:
        """Rows (N, 4) at instants that are later by the delay; the last one is held."""
        index = np.arange(len(rows)) + self.whole + self.late / self.model.period
        at = np.arange(len(rows))
        return np.column_stack([np.interp(index, at, column) for column in rows.T])
