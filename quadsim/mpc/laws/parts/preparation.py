"""An MPC for imperfect vehicles: soft output bounds, rotor lag, known delays, disturbances, any heading.

Each part has its own setting and is off by default; without any part it solves the paper's optimisation.  The query of
each period is C's, whoever solves it: `quadsim_mpc_prepare`, whose equations are in `quadsim/mpc/c/quadsim_mpc.c`.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import replace
from typing import Final, NoReturn

import numpy as np

from quadsim.controller import ROTORS, Phase, StepInputs
from quadsim.core.mirror import constant, core_library, set_members, struct
from quadsim.mpc.estimate.disturbance import SAME_TIME
from quadsim.mpc.estimate.observer import LONGEST_SPAN
from quadsim.mpc.laws.parts.core_law import CoreNumbers
from quadsim.mpc.laws.parts.linear import Remembered
from quadsim.mpc.laws.parts.numbers import controller_numbers, robust_numbers
from quadsim.mpc.laws.robust import Robust
from quadsim.mpc.problem.equilibrium import Trim
from quadsim.mpc.problem.heading import predict_in_heading_frame
from quadsim.mpc.problem.model import hover_model
from quadsim.mpc.problem.ocp import Equilibrium, Problem, Query
from quadsim.mpc.solvers.core_tables import rotor_states
from quadsim.state import EULER, EULER_RATE, N_STATES, VELOCITY, Array
from quadsim.vehicle import N_ROTORS, Vehicle

_FREE: Final = constant("QUADSIM_FREE")
_MOVING: Final = [*VELOCITY, *EULER, *EULER_RATE]


class RobustPreparation:
    """The query of the robust MPC; see the module and `quadsim.mpc.laws.parts.linear.Preparation`.

    Attributes:
        problem: the optimal control problem, that of the table `settings` (`Robust.problem`).
        delay: from t_k to the instant of x(k) [s].

    Raises:
        FileError: the library cannot be compiled or loaded.

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> from quadsim import mpc
        >>> vehicle = quadsim.load_vehicle("lopes2011")
        >>> table = quadsim.load("robust", {"controller.delay": 0.02}).controller
        >>> preparation = mpc.RobustPreparation(vehicle, table.problem(vehicle, 0.05), table)
        >>> preparation.delay
        0.02
    """

    def __init__(self, vehicle: Vehicle, problem: Problem, settings: Robust) -> None:
        self.problem = problem
        self.delay = settings.delay
        self._library = core_library()
        if settings.commands == ROTORS:
            self._nominal = hover_model(vehicle, problem.model.period, moment=settings.moment)
        else:
            self._nominal = settings.level_hover(vehicle, problem.model.period)
        self._robust = struct("quadsim_robust")()
        set_members(self._robust, **robust_numbers(settings, vehicle, problem.model.period))
        self._C_r = np.ascontiguousarray(problem.objective.C_r)
        self._sizes = struct("quadsim_problem")(
            horizon=problem.horizon,
            states=problem.model.n,
            regulated=len(self._C_r),
            rotor_states=rotor_states(problem),
            C_r=self._C_r.ctypes.data,
        )
        self._controller = struct("quadsim_controller")(
            problem=ctypes.addressof(self._sizes), robust=ctypes.addressof(self._robust)
        )
        set_members(self._controller, **controller_numbers(problem))
        # The struct points into this memory, and the views into both.
        self._memory = np.zeros(self._library.quadsim_mpc_reals(self._controller))
        self._mpc = mpc = struct("quadsim_mpc")()
        self._library.quadsim_mpc_start(mpc, self._controller, self._memory.ctypes.data)
        n = problem.model.n
        N = problem.horizon
        n_r = len(self._C_r)
        under_way = self._robust.under_way
        self._x = np.ctypeslib.as_array(mpc.state)[:n]
        self._x_s = np.ctypeslib.as_array(mpc.rest)[:n]
        self._u_s = np.ctypeslib.as_array(mpc.rest_command)
        self._desired = _view(mpc.desired, N * n_r).reshape(N, n_r)
        self._sent = _view(mpc.sent, under_way * N_ROTORS).reshape(under_way, N_ROTORS)
        self._rotors = np.ctypeslib.as_array(mpc.rotors)
        self._turning = np.ctypeslib.as_array(mpc.rotors_ahead)
        self._ahead = np.ctypeslib.as_array(mpc.ahead)
        self._estimate = np.ctypeslib.as_array(mpc.estimate)
        self._state = np.zeros(N_STATES)
        self._reference = np.zeros((N, 4))
        self._acting = np.zeros(N_ROTORS)
        self._inputs = [self._state.ctypes.data, self._reference.ctypes.data, self._acting.ctypes.data]
        self.reset(problem.model.u_bar)

    def __reduce__(self) -> NoReturn:
        """Refuse: addresses are useless in a copy or another process."""
        raise TypeError("a RobustPreparation cannot be copied or pickled: make another")

    def reset(self, speeds: Array) -> None:
        """Restart after the command u(-1) (4,) [rad/s], with rotors at that speed."""
        self._acting[:] = speeds
        self._library.quadsim_mpc_reset(self._mpc, self._acting.ctypes.data)
        self._called_at = self._measured = -math.inf
        self._trim: Trim | None = None  # of the estimate now, once it has been asked for

    @property
    def numbers(self) -> CoreNumbers:
        """See `quadsim.mpc.laws.parts.linear.Preparation`."""
        return CoreNumbers(self._controller, self._robust)

    @property
    def memory(self) -> Remembered:
        """See `quadsim.mpc.laws.parts.linear.Preparation`."""
        ahead = None
        estimate = None
        if self._mpc.ahead_known:
            ahead = self._ahead.copy()
        if self._robust.observes:
            estimate = self._estimate.copy()
        return Remembered(
            delay=self.delay,
            rotors=self._rotors.copy(),
            turning=self._turning.copy(),
            sent=tuple(self._sent.copy()),
            ahead=ahead,
            called_at=self._called_at,
            measured=self._measured,
            estimate=estimate,
            targets=bool(self._robust.targets),
        )

    def adopt(self, memory: Remembered | None, disturbance: Array | None) -> None:
        """Take over the rotor speeds, the commands under way and the disturbance of the previous controller."""
        if memory is not None:
            if memory.targets == bool(self._robust.targets):
                self._rotors[:] = memory.rotors
                self._turning[:] = memory.turning
                for row, sent in zip(self._sent[::-1], memory.sent[::-1], strict=False):
                    row[:] = sent
            self._called_at = memory.called_at
            self._measured = memory.measured
            if memory.ahead is not None and memory.delay == self.delay:
                self._ahead[:] = memory.ahead
                self._mpc.ahead_known = 1
            if memory.estimate is not None:
                disturbance = memory.estimate
        if disturbance is not None:
            estimate = np.array(disturbance, float)
            self._library.quadsim_mpc_learn(self._mpc, estimate.ctypes.data)
            self._trim = None

    def stand(self, now: StepInputs, acting: Array) -> None:
        """Let the rotors follow their commands, and assume no disturbance."""
        self._acting[:] = acting
        self._called_at = now.time
        self._library.quadsim_mpc_stand(self._mpc, self._acting.ctypes.data)
        self._trim = None

    def prepare(self, now: StepInputs, state: Array, reference: Array, acting: Array) -> Query | None:
        """See `quadsim.mpc.laws.parts.linear.Preparation.prepare`.

        Numbers that are not finite, exceed `quadsim.mpc.guard.numbers.PLAUSIBLE`, or lead to such numbers give
        None and do not update the observer.  Nor does a state that is predicted in part (`StepInputs.unseen`), the
        first measured state after more than `LONGEST_SPAN` of such states, or a state after a pause: `now.time` must be
        one period later than last time.
        """
        flying = now.phase is Phase.FLYING
        learns = self._may_learn(now)
        self._state[:] = state
        self._reference[:] = reference
        self._acting[:] = acting
        status = self._library.quadsim_mpc_prepare(self._mpc, flying, learns, *self._inputs)
        self._trim = None
        if status != _FREE:
            return None
        return Query(
            self._x.copy(), self._desired.copy(), self._acting.copy(), Equilibrium(self._x_s.copy(), self._u_s.copy())
        )

    @property
    def yaw(self) -> float:
        """Angle by which the axes of the last query are turned about world z [rad]."""
        return float(self._mpc.yaw)

    @property
    def trim(self) -> Trim:
        """The equilibrium under the estimated disturbance."""
        if self._trim is None:
            trim = self._mpc.trim
            self._trim = Trim(speeds=np.array(trim.commands), lift=np.array(trim.lift), twist=np.array(trim.twist))
        return self._trim

    @property
    def disturbance(self) -> Array:
        """(6,) estimated acceleration at rest, world [m/s^2], and angular acceleration, body [rad/s^2]."""
        trim = self.trim
        x, y, up = trim.lift.tolist()
        thrust = math.hypot(x, y, up)
        return np.array([-x, -y, self._robust.gravity - up, *(thrust * trim.twist)])

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`; by the hover model, with the latest disturbance estimate."""
        return predict_in_heading_frame(self._nominal, states, plans, replace(self.trim, speeds=self._u_s.copy()))

    def _may_learn(self, now: StepInputs) -> bool:
        """Return whether the observer may compare this period's state with the one that it expected."""
        if abs(now.time - self._called_at - self.problem.model.period) > SAME_TIME:
            self._measured = -math.inf
        self._called_at = now.time
        if now.unseen is not None and now.unseen[_MOVING].any():
            return False
        span = now.time - self._measured
        self._measured = now.time
        return bool(span - SAME_TIME <= LONGEST_SPAN) and now.phase is Phase.FLYING


def _view(address: int, count: int) -> Array:
    """Return `count` numbers of C as an array."""
    if not count:
        return np.empty(0)
    return np.ctypeslib.as_array((ctypes.c_double * count).from_address(address))
