"""The whole law in C: predictor, observer and QP in one call per period, instead of Python's preparation and solver."""

from __future__ import annotations

import ctypes
import math
import time as clock
from dataclasses import replace
from functools import lru_cache
from typing import Final, NoReturn

import numpy as np

from quadsim.controller import (
    GAIN,
    GROUNDED,
    UNCONSTRAINED,
    Command,
    Phase,
    Statistics,
    StepInputs,
    stopped,
)
from quadsim.core.mirror import core_library, set_members, struct
from quadsim.mpc.estimate.observer import LONGEST_SPAN
from quadsim.mpc.forms.condensing import Condensed
from quadsim.mpc.guard.structs import STATUSES
from quadsim.mpc.laws.parts.linear import Remembered
from quadsim.mpc.laws.parts.numbers import Exportable, controller_numbers, robust_numbers
from quadsim.mpc.problem.equilibrium import Trim
from quadsim.mpc.problem.heading import predict_in_heading_frame
from quadsim.mpc.problem.model import hover_model
from quadsim.mpc.problem.ocp import Equilibrium, Query
from quadsim.mpc.problem.paper import rollout
from quadsim.mpc.solvers import INVALID_DATA, Answer
from quadsim.mpc.solvers.core import PROBLEMS, Core, Key, Optimum, core_problem
from quadsim.mpc.solvers.core_tables import with_constraints
from quadsim.state import EULER, EULER_RATE, N_STATES, VELOCITY, Array
from quadsim.vehicle import N_ROTORS

INVALID: Final = STATUSES.index(INVALID_DATA)
_MOVING: Final = [*VELOCITY, *EULER, *EULER_RATE]
_SAME_TIME: Final = 1e-6  # [s]


class _Shared:
    """A law's numbers in the library's memory layout, shared by equal laws of this process."""

    def __init__(self, law: Exportable) -> None:
        self.nominal = hover_model(law.vehicle, law.problem.model.period)
        self.problem = core_problem(law.problem)
        numbers, robust = controller_numbers(law), None
        self._C_r = np.ascontiguousarray(law.problem.objective.C_r)
        if law.settings is not None:
            robust = struct("quadsim_robust")()
            set_members(robust, **robust_numbers(law, self.problem.tables.modes))
        self.robust = robust
        self.struct = struct("quadsim_controller")(
            problem=ctypes.addressof(self.problem.struct),
            robust=None if robust is None else ctypes.addressof(robust),
            C_r=self._C_r.ctypes.data,
        )
        set_members(self.struct, **numbers)


@lru_cache(PROBLEMS)
def _shared(key: Key[Exportable]) -> _Shared:
    return _Shared(key.of)


class CompiledPreparation:
    """The preparation of a law in C, which solves each query as it makes it; see `linear.Preparation`.

    `yaw` is not known here; only obstacles, which C does not have, would need it.

    Attributes:
        problem: the optimal control problem; one without constraints gets one that bounds nothing.
        delay: from t_k to the instant of x(k) [s].

    Raises:
        FileError: the library cannot be compiled or loaded.
        ParameterError: the core cannot take the problem.
    """

    yaw: Final = 0.0

    def __init__(self, law: Exportable) -> None:
        self._library, shared = core_library(), _shared(Key.to(law))
        self._shared, self._robust, self.problem = shared, shared.robust, with_constraints(law.problem)
        self.delay = 0.0 if law.settings is None else law.settings.delay
        # The struct and its views point into this memory.
        self._memory = np.zeros(self._library.quadsim_mpc_reals(shared.struct))
        self._mpc = struct("quadsim_mpc")()
        mpc, N, n = self._mpc, law.problem.horizon, law.problem.model.n
        self._library.quadsim_mpc_start(mpc, shared.struct, self._memory.ctypes.data)
        self.optimum = Optimum(self.problem, shared.problem, mpc.work)
        trim = mpc.trim
        parts = (mpc.resting, mpc.turning, mpc.rotors, mpc.ahead, mpc.estimate, trim.commands, trim.lift, trim.twist)
        views = [np.ctypeslib.as_array(part) for part in parts]
        self._u_s, self._turning, self._rotors, self._ahead, self._estimate, self._trim, self._lift, self._twist = views
        self._x, self._x_s = (np.ctypeslib.as_array(part)[:n] for part in (mpc.state, mpc.rest))
        self._wanted = _view(mpc.wanted, N * len(self.problem.objective.C_r)).reshape(N, -1)
        whole = 0 if self._robust is None else self._robust.under_way
        self._sent = _view(mpc.sent, whole * N_ROTORS).reshape(whole, N_ROTORS)
        self._state, self._path, self._acting = (np.zeros(shape) for shape in (N_STATES, (N, 4), N_ROTORS))
        self._arguments = mpc, *(array.ctypes.data for array in (self._state, self._path, self._acting))
        self.found, self.started = INVALID, 0.0
        self.reset(shared.nominal.u_bar)

    def __reduce__(self) -> NoReturn:
        """Refuse: addresses are useless in a copy or another process."""
        raise TypeError("a law in C cannot be copied or pickled: make another")

    @property
    def condensed(self) -> Condensed:
        """The QP to which the KKT residuals of an optimum refer."""
        return self._shared.problem.condensed

    def reset(self, speeds: Array) -> None:
        """Restart after the command u(-1) (4,) [rad/s]."""
        self._acting[:] = speeds
        self._library.quadsim_mpc_reset(self._mpc, self._acting.ctypes.data)
        self._called_at = self._measured = -math.inf
        self._made: Trim | None = None  # of the estimate now, if it has been asked for

    def adopt(self, memory: Remembered | None, disturbance: Array | None) -> None:
        """See `quadsim.mpc.laws.parts.linear.Preparation`."""
        if self._robust is None:
            return
        if memory is not None:
            self._rotors[:], self._turning[:] = memory.rotors, memory.turning
            for row, sent in zip(self._sent[::-1], memory.sent[::-1], strict=False):
                row[:] = sent
            self._called_at, self._measured = memory.called_at, memory.measured
            if memory.ahead is not None and memory.delay == self.delay:
                self._ahead[:], self._mpc.known = memory.ahead, 1
            disturbance = disturbance if memory.estimate is None else memory.estimate
        if disturbance is not None:
            estimate = np.array(disturbance, float)
            self._library.quadsim_mpc_learn(self._mpc, estimate.ctypes.data)
            self._made = None

    @property
    def memory(self) -> Remembered | None:
        """See `quadsim.mpc.laws.parts.linear.Preparation`."""
        if self._robust is None:
            return None
        return Remembered(
            delay=self.delay,
            rotors=self._rotors.copy(),
            turning=self._turning.copy(),
            sent=tuple(self._sent.copy()),
            ahead=self._ahead.copy() if self._mpc.known else None,
            called_at=self._called_at,
            measured=self._measured,
            estimate=self._estimate.copy() if self._robust.observes else None,
        )

    @property
    def trim(self) -> Trim | None:
        """See `quadsim.mpc.laws.parts.linear.Preparation`."""
        if self._robust is None:
            return None
        if self._made is None:
            self._made = Trim(speeds=self._trim.copy(), lift=self._lift.copy(), twist=self._twist.copy())
        return self._made

    @property
    def disturbance(self) -> Array | None:
        """See `quadsim.mpc.laws.parts.linear.Preparation`."""
        if self._robust is None:
            return None
        x, y, up = self._lift.tolist()
        return np.array([-x, -y, self._robust.gravity - up, *(math.hypot(x, y, up) * self._twist)])

    def stand(self, now: StepInputs, acting: Array) -> None:
        """See `quadsim.mpc.laws.parts.linear.Preparation`."""
        self._acting[:], self._called_at, self._made = acting, now.time, None
        self._library.quadsim_mpc_stand(self._mpc, self._acting.ctypes.data)

    def prepare(self, now: StepInputs, state: Array, reference: Array, acting: Array) -> Query | None:
        """See `quadsim.mpc.laws.parts.linear.Preparation`."""
        self._state[:], self._path[:], self._acting[:] = state, reference, acting
        if self._robust is not None and not self._may_learn(now):
            self._mpc.known = 0
        self._made, self.started = None, clock.perf_counter()
        self.found = self._library.quadsim_mpc_solve(*self._arguments)
        if now.phase is not Phase.FLYING:  # the ground holds the vehicle, so its motion shows no disturbance
            self._mpc.known = 0
        objective = self.problem.objective
        if self.found == INVALID:
            return None if self._robust is not None else Query(state, self.problem.desired(reference), acting)
        x, x_s, u_s = self._x.copy(), self._x_s.copy(), self._u_s.copy()
        if x.size > N_STATES:  # C has the modes of rotor speeds here
            x[N_STATES:], x_s[N_STATES:] = self._turning, u_s
        return Query(x, self._wanted + objective.C_r @ x_s, acting, Equilibrium(x_s, u_s))

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`."""
        if (trim := self.trim) is not None:
            return predict_in_heading_frame(self._shared.nominal, states, plans, replace(trim, speeds=self._u_s.copy()))
        return rollout(self.problem.model, states, plans)

    def _may_learn(self, now: StepInputs) -> bool:
        """Return whether the observer may compare the state with its prediction, as `RobustPreparation` does."""
        if abs(now.time - self._called_at - self.problem.model.period) > _SAME_TIME:
            self._measured = -math.inf
        self._called_at = now.time
        if now.unseen is not None and now.unseen[_MOVING].any():
            return False
        span, self._measured = now.time - self._measured, now.time
        return span - _SAME_TIME <= LONGEST_SPAN and now.phase is Phase.FLYING


class CompiledSolver:
    """Reads the answer to the query that a preparation in C made last; see `quadsim.mpc.solvers.Solver`."""

    name: Final = "compiled"
    iterates: Final = Core.iterates

    def __init__(self, preparation: CompiledPreparation) -> None:
        self._preparation = preparation

    @property
    def formulation(self) -> Condensed:
        """See `quadsim.mpc.solvers.Solver`."""
        return self._preparation.condensed

    def reset(self) -> None:
        """See `quadsim.mpc.solvers.Solver`."""
        self._preparation.optimum.reset()

    def solve(self, query: Query) -> Answer:
        """See `quadsim.mpc.solvers.Solver`; the query is the last one prepared."""
        preparation = self._preparation
        return preparation.optimum.answer(preparation.found, query, preparation.started)


class CompiledGain:
    """The paper's unconstrained law in C: `quadsim.mpc.laws.unconstrained.UnconstrainedMPC` without constant gains."""

    name: Final = "unconstrained"
    solver: Final = CompiledSolver.name

    def __init__(self, preparation: CompiledPreparation) -> None:
        self._preparation, self._solver = preparation, CompiledSolver(preparation)
        self.problem, self.horizon = preparation.problem, preparation.problem.horizon

    def reset(self, speeds: Array) -> None:
        """See `quadsim.controller.Controller.reset`."""
        self._preparation.reset(speeds)

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """The optimum, rotors off while landed; see `quadsim.controller.Controller.step`."""
        if now.phase in GROUNDED:
            return stopped(np.zeros(N_ROTORS), self.horizon, now.phase)
        query = self._preparation.prepare(now, state, reference, self.problem.model.u_bar)
        assert query is not None
        plan, spent_s = np.full((self.horizon, N_ROTORS), math.nan), 0.0  # of numbers that are not finite
        if self._preparation.found != INVALID:
            answer = self._solver.solve(query)
            plan, spent_s = answer.plan, answer.stats.solve_s
        stats = Statistics(solve_s=spent_s)
        return Command(speeds=plan[0].copy(), plan=plan, status=UNCONSTRAINED, answered_by=GAIN, stats=stats)

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`."""
        return self._preparation.predict(states, plans)


def _view(address: int, count: int) -> Array:
    if not count:
        return np.empty(0)
    return np.ctypeslib.as_array((ctypes.c_double * count).from_address(address))
