"""An MPC for imperfect vehicles: soft output bounds, rotor lag, known delays, disturbances, any heading.

Each part has its own setting and is off by default; without any part it solves the paper's optimisation.

The hover model is linearised at the vehicle's equilibrium under the estimated disturbance, (x_s, u_s) of
`quadsim.mpc.problem.equilibrium`,

    x(k+1) = x_s + A (x(k) - x_s) + B (u(k) - u_s),

and u_s is the target of the inputs.  The equilibrium is then predicted exactly: with a constant reference and
disturbance a loop that settles with no bound active has no steady-state error, whatever the errors of A and B.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import Final

import numpy as np

from quadsim.controller import Phase, StepInputs
from quadsim.mpc.estimate.observer import LONGEST_SPAN, DisturbanceObserver, thrust_axis
from quadsim.mpc.guard.numbers import PLAUSIBLE, PLAUSIBLE_REFERENCE
from quadsim.mpc.laws.parts.linear import Remembered
from quadsim.mpc.laws.robust import Robust
from quadsim.mpc.problem.equilibrium import Trim, equilibrium, twisted
from quadsim.mpc.problem.heading import (
    predict_in_heading_frame,
    seen_from,
    slope,
    turn_horizontally,
    turned_axes,
    with_limited_yaw,
)
from quadsim.mpc.problem.model import hover_model, split_delay
from quadsim.mpc.problem.nonlinear_model import Triple, advance_disturbed, nonlinear_model, spun
from quadsim.mpc.problem.ocp import Equilibrium, Problem, Query
from quadsim.mpc.tables.lags import resolved_lag
from quadsim.state import EULER, EULER_RATE, INDEX, N_STATES, VELOCITY, Array, ReferenceTurns, all_true
from quadsim.vehicle import Vehicle

_SAME_TIME: Final = 1e-6  # [s]
_YAW: Final = INDEX["yaw"]
_MOVING: Final = [*VELOCITY, *EULER, *EULER_RATE]


class RobustPreparation:
    """The query of the robust MPC; see the module and `quadsim.mpc.laws.parts.linear.Preparation`.

    Attributes:
        problem: the optimal control problem, that of the table `settings` (`Robust.problem`).
        delay: from t_k to the instant of x(k) [s].
        yaw: angle by which the axes of the last query are turned about world z [rad].
        trim: the equilibrium under the estimated disturbance.
    """

    def __init__(self, vehicle: Vehicle, problem: Problem, settings: Robust) -> None:
        self.problem, self.delay, self.yaw = problem, settings.delay, 0.0
        self._heading, self._largest_turn = settings.heading, math.radians(settings.largest_turn)
        self._period = period = problem.model.period
        whole, self._late = split_delay(settings.delay, period)
        self._sent: deque[Array] = deque(maxlen=whole + 1)  # u(k-1-n) .. u(k-1): the command in force, and under way
        self._nominal = hover_model(vehicle, period)
        self._model = nonlinear_model(vehicle, period, rotor_lag=resolved_lag(settings.rotor_lag, vehicle) or None)
        self._of_twist = np.ascontiguousarray(np.linalg.inv(slope(self._nominal))[:, 1:])
        observing = settings.offset_free
        self._observer = None if observing is None else DisturbanceObserver(observing, period)
        self._turns = ReferenceTurns()
        self.reset(vehicle.hover_speeds)

    def reset(self, speeds: Array) -> None:
        """Restart after the command u(-1) (4,) [rad/s], with rotors at that speed."""
        speeds = np.array(speeds, float)
        self._sent.extend([speeds] * (self._sent.maxlen or 1))
        # Rotor speeds and state when the next command takes over in this period, and speeds when this period's does.
        self._rotors = self._turning = speeds.copy()
        self._ahead: Array | None = None
        self._called_at = self._measured = -math.inf
        self._turns.reset()
        self._forget()

    @property
    def memory(self) -> Remembered:
        """See `quadsim.mpc.laws.parts.linear.Preparation`."""
        return Remembered(
            delay=self.delay,
            rotors=self._rotors.copy(),
            turning=self._turning.copy(),
            sent=tuple(self._sent),
            ahead=self._ahead,
            called_at=self._called_at,
            measured=self._measured,
            estimate=None if self._observer is None else self._observer.estimate,
        )

    def adopt(self, memory: Remembered | None, disturbance: Array | None) -> None:
        """Take over the rotor speeds, the commands under way and the disturbance of the previous law."""
        if memory is not None:
            self._rotors, self._turning = memory.rotors, memory.turning
            self._sent.extend(memory.sent)
            self._called_at, self._measured = memory.called_at, memory.measured
            if self.delay == memory.delay:
                self._ahead = memory.ahead
            if memory.estimate is not None:
                disturbance = memory.estimate
        if self._observer is not None and disturbance is not None:
            self._observer.adopt(disturbance)
            self._update_trim()

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def stand(self, now: StepInputs, acting: Array) -> None:
        """Let the rotors follow their commands, and assume no disturbance."""
        self._advance_rotors(now.time, acting)
        self._forget()

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # values out of range are rejected, not warned of
    def prepare(self, now: StepInputs, state: Array, reference: Array, acting: Array) -> Query | None:
        """See `quadsim.mpc.laws.parts.linear.Preparation.prepare`.

        Numbers that are not finite, exceed `quadsim.mpc.guard.numbers.PLAUSIBLE`, or lead to such numbers give
        None and do not update the observer.  Nor does a state that is predicted in part (`StepInputs.unseen`), the
        first measured state after more than `LONGEST_SPAN` of such states, or a state after a pause: `now.time` must be
        one period later than last time.
        """
        ahead, before, called_at = self._ahead, self._rotors, self._called_at
        in_force, under_way, rotors, turning = self._advance_rotors(now.time, acting)
        if not (all_true(np.abs(state) <= PLAUSIBLE) and all_true(np.abs(reference) <= PLAUSIBLE_REFERENCE)):
            return None
        if ahead is None or abs(now.time - called_at - self._period) > _SAME_TIME:
            self._measured = -math.inf
        span = self._span(now)
        if self._observer is not None and ahead is not None and span <= LONGEST_SPAN and now.phase is Phase.FLYING:
            expected = self._after(self._period - self._late, ahead, before, in_force)
            if all_true(np.isfinite(expected)):
                self._observer.update(state, expected)
                self._update_trim()
        x0 = following = self._after(self._late, state, rotors, in_force)
        for command, speeds in zip(under_way, turning, strict=False):
            x0 = self._after(self._period, x0, speeds, command)
        if not all_true(np.isfinite(x0)):
            return None
        self.yaw = float(x0[_YAW]) if self._heading else 0.0
        if now.phase is Phase.FLYING:  # before, the ground holds the vehicle, so its motion shows no disturbance
            self._ahead = following
        reference = self._turns.follow(reference, float(state[_YAW]))
        rates = self.problem.rates(reference)
        if self.delay:
            reference = self._at_prediction(reference, len(under_way))
            rates = None if rates is None else self._at_prediction(rates, len(under_way))
        x0 = np.concatenate([x0, self._turning])[: self._model.n]
        if self._heading:
            reference = with_limited_yaw(reference, self.yaw, self._largest_turn)
            x0 = turn_horizontally(x0, -self.yaw)
            x0[_YAW] = 0.0
        u_s = self._balanced()
        x_s = self.trim.state(self.yaw, self._model.n)
        x_s[N_STATES:] = u_s[: self._model.n - N_STATES]
        seen = seen_from(reference, self.yaw)
        seen_rates = None if rates is None else turned_axes(rates, self.yaw)
        desired = self.problem.objective.desired(seen, seen_rates)
        return Query(x0, desired, acting, Equilibrium(x_s, u_s))

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`; by the hover model, with the latest disturbance estimate."""
        return predict_in_heading_frame(self._nominal, states, plans, replace(self.trim, speeds=self._balanced()))

    @property
    def disturbance(self) -> Array:
        """(6,) estimated acceleration at rest, world [m/s^2], and angular acceleration, body [rad/s^2]."""
        thrust = self._model.effectiveness[0] @ np.square(self.trim.speeds)
        return np.concatenate([self._resting, thrust * self.trim.twist])

    def _advance_rotors(self, time: float, acting: Array) -> tuple[Array, list[Array], Array, list[Array]]:
        """Predict the rotor speeds from the last call to when this period's command takes over.

        Returns:
            the command in force (4,), those under way, and the rotor speeds (4,) at t_k, and when each of the latter
            and then this period's command takes over [rad/s].
        """
        self._sent.append(acting)
        in_force, *under_way = self._sent
        rotors = spun(self._model, self._rotors, in_force, self._period - self._late)
        self._rotors = spun(self._model, rotors, in_force, self._late)
        turning = [self._rotors]
        for command in under_way:
            turning.append(spun(self._model, turning[-1], command, self._period))
        self._ahead, self._called_at, self._turning = None, time, turning[-1]
        return in_force, under_way, rotors, turning

    def _at_prediction(self, preview: Array, under_way: int) -> Array:
        """Return the rows (N, 4) of a preview at the predicted instants, later by the delay; the last one is held."""
        held = np.repeat(preview[-1:], under_way, axis=0)
        preview = np.concatenate([preview[under_way:], held])
        later = np.concatenate([preview[1:], preview[-1:]])
        return np.asarray(preview + self._late / self._period * (later - preview))

    def _forget(self) -> None:
        """Assume no disturbance."""
        if self._observer is not None:
            self._observer.reset()
        self._update_trim()

    def _update_trim(self) -> None:
        """Update the equilibrium from the disturbance estimate."""
        self._estimate = np.zeros(6) if self._observer is None else self._observer.estimate
        estimate, gravity = self._estimate, self._model.gravity
        (x, y), twist = estimate[:2].tolist(), estimate[3:] / gravity
        lift = math.hypot(x, y, gravity)
        self._effectiveness = twisted(self._model.effectiveness, twist)
        self._resting = self._acceleration((-x / lift, -y / lift, gravity / lift))
        self.trim: Trim = equilibrium(self._model, acceleration=self._resting, twist=twist)

    def _acceleration(self, axis: Triple) -> Triple:
        """Return the estimated disturbance in the world frame [m/s^2], for thrust along a world-frame axis."""
        x, y, along = self._estimate[:3].tolist()
        return along * axis[0] + x, along * axis[1] + y, along * axis[2]

    def _span(self, now: StepInputs) -> float:
        """Time since the last measured state [s]; infinite after a pause, or if the present one is not measured."""
        if now.unseen is not None and now.unseen[_MOVING].any():
            return math.inf
        span, self._measured = now.time - self._measured, now.time
        return span - _SAME_TIME

    def _after(self, time: float, state: Array, rotors: Array, command: Array) -> Array:
        """Predict the state (12,) a time [s] after a state (12,) with rotor speeds (4,), under a command (4,)."""
        if time <= 1e-9:
            return state
        start = np.concatenate((state, rotors))[: self._model.n]
        acceleration = self._acceleration(thrust_axis(state.tolist()))
        return advance_disturbed(self._model, start, command, time, self._effectiveness, acceleration)[:N_STATES]

    def _balanced(self) -> Array:
        """(4,) speeds at rest [rad/s] that also balance the torque caused by thrust, which the hover matrices omit."""
        thrust = self._model.effectiveness[0]
        excess = np.dot(thrust, np.square(self._turning) - np.square(self.trim.speeds))
        return np.asarray(self.trim.speeds - np.dot(self._of_twist, excess * self.trim.twist))
