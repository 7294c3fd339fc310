"""A robust controller and its fallback contract as one controller of `quadsim_mpc.h`: a period is one call.

It is the controller that is exported, with the numbers of the controller that flies here.  Every usable answer has the
same bits as by `quadsim.mpc.laws.parts.linear.LinearMPC` and `quadsim.mpc.guard.contract.Guard`.
"""

from __future__ import annotations

import ctypes
from typing import Final, NamedTuple, NoReturn

import numpy as np

from quadsim.controller import CORE, GAIN
from quadsim.core.mirror import Struct, constant, core_library, struct
from quadsim.mpc.guard.answer import INFEASIBLE, AnswerCheck
from quadsim.mpc.guard.structs import STATUSES
from quadsim.mpc.problem.ocp import Problem
from quadsim.mpc.solvers import Method, Solver
from quadsim.mpc.solvers.core import Core, Optimum
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS

_CHECKED: Final = 32
"""Plans that are checked at a time, so that what is computed of them stays in the processor's caches."""
_FLYING: Final = constant("QUADSIM_PHASE_FLYING")


class CoreNumbers(NamedTuple):
    """The numbers of a controller in C, but for those of its problem and of its fallback contract."""

    controller: Struct  # a `quadsim_controller`
    robust: Struct  # the `quadsim_robust` that it points to


class CoreLaw:
    """See the module, and `quadsim.controller.CoreController`.

    Attributes:
        commands: (K + 1, 4) u(-1), then the command of each period so far [rad/s].
    """

    def __init__(
        self, problem: Problem, numbers: CoreNumbers, solver: Core, check: AnswerCheck, fallback: Struct
    ) -> None:
        """Prepare the controller of a problem.

        Args:
            problem: the optimal control problem.
            numbers: the controller's.
            solver: the problem's, whose tables are shared.
            check: of each answer against the problem.
            fallback: the contract's `quadsim_fallback`.
        """
        self._problem = problem
        self._check = check
        self._kept = solver.shared, numbers, fallback  # the controller points to them
        self._library = core_library()
        self._controller = type(numbers.controller).from_buffer_copy(numbers.controller)
        self._controller.problem = ctypes.addressof(solver.shared.struct)
        self._controller.fallback = ctypes.addressof(fallback)
        self._memory = np.zeros(self._library.quadsim_mpc_reals(self._controller))
        self._mpc = mpc = struct("quadsim_mpc")()
        self._library.quadsim_mpc_start(mpc, self._controller, self._memory.ctypes.data)
        self._optimum = Optimum(problem, solver.shared, mpc.work)
        n = problem.model.n
        self._state = np.ctypeslib.as_array(mpc.state)[:n]
        self._rest = np.ctypeslib.as_array(mpc.rest)[:n]
        self._resting = np.ctypeslib.as_array(mpc.rest_command)
        self._acting = np.ctypeslib.as_array(mpc.acting)
        self.start(0, problem.model.u_bar)

    def __reduce__(self) -> NoReturn:
        """Refuse: addresses are useless in a copy or another process."""
        raise TypeError("a CoreLaw cannot be copied or pickled: make another")

    def start(self, periods: int, speeds: Array) -> None:
        """Restart after the command u(-1) (4,) [rad/s], with room for K periods."""
        n = self._problem.model.n
        N = self._problem.horizon
        self.commands = np.empty((periods + 1, N_ROTORS))
        self.commands[0] = speeds
        self._library.quadsim_mpc_reset(self._mpc, self.commands.ctypes.data)
        self._iterations = np.zeros(periods)
        self._active = np.zeros(periods)
        self._found = np.zeros(periods, np.int64)
        self._plans = np.empty((periods, N, N_ROTORS))
        self._states, self._rests = np.empty((2, periods, n))
        self._restings, self._actings = np.empty((2, periods, N_ROTORS))
        self._slacks = np.zeros((periods, *self._optimum.slacks(Method.FREE).shape))
        self._k = 0
        self._violations: Array | None = None  # of the plans so far, once they are asked for

    def step(self, state: int, reference: int) -> bool:
        """Answer the next period, in the air.

        Args:
            state: address of the measured state (12,).
            reference: address of x, y, z [m], yaw [rad] (N, 4) at t_{k+1} .. t_{k+N}.

        Returns:
            whether there is an optimum, whose first input is the command.  Where there is none, another solver or the
            contract would have to answer, and the flight is not this object's to fly on.
        """
        k = self._k
        acting = self.commands[k].ctypes.data
        found = self._library.quadsim_mpc_step(
            self._mpc, _FLYING, state, reference, acting, acting + self.commands.strides[0]
        )
        if found >= len(Method):
            return False
        method = Method(found)
        self._found[k] = method
        self._plans[k] = self._optimum.plan
        self._states[k] = self._state
        self._rests[k] = self._rest
        self._restings[k] = self._resting
        self._actings[k] = self._acting
        self._iterations[k] = self._mpc.work.changes
        if method is not Method.FREE:
            self._active[k] = self._optimum.active
            self._slacks[k] = self._optimum.slacks(method)
        self._k = k + 1
        self._violations = None
        return True

    @property
    def accepted(self) -> bool:
        """Whether every plan so far satisfies the problem's rows; see `quadsim.mpc.guard.answer.AnswerCheck`."""
        return bool(np.all(self._infeasibility() <= INFEASIBLE))

    @property
    def statistics(self) -> dict[str, Array]:
        """See `quadsim.controller.CoreController`."""
        rows = slice(self._k)
        return {
            "iterations": self._iterations[rows],
            "active": self._active[rows],
            "slack": self._slacks[rows].max(axis=(1, 2), initial=0.0),
            "infeasibility": self._infeasibility(),
        }

    def _infeasibility(self) -> Array:
        """(K,) the largest violation of a row by each plan so far."""
        if self._violations is None:
            blocks = [np.empty(0)]
            for start in range(0, self._k, _CHECKED):
                rows = slice(start, min(start + _CHECKED, self._k))
                equilibrium = self._rests[rows], self._restings[rows]
                parts = self._states[rows], equilibrium, self._actings[rows], self._plans[rows], self._slacks[rows]
                blocks.append(self._check.violations(*parts))
            self._violations = np.concatenate(blocks)
        return self._violations

    @property
    def status(self) -> tuple[str, ...]:
        """K statuses, each of `quadsim.controller.OPTIMAL`."""
        return tuple(STATUSES[method] for method in self._found[: self._k].tolist())

    @property
    def answered_by(self) -> tuple[str, ...]:
        """K sources of commands."""
        sources = []
        for method in self._found[: self._k].tolist():
            if method == Method.FREE:
                sources.append(GAIN)
            else:
                sources.append(CORE)
        return tuple(sources)


def core_law(
    problem: Problem, numbers: CoreNumbers | None, solver: Solver, check: AnswerCheck, fallback: Struct
) -> CoreLaw | None:
    """Return a controller of these parts in the core; None where it is not C's alone, or would have other bits."""
    if numbers is None or not isinstance(solver, Core) or not check.maps:
        return None
    return CoreLaw(problem, numbers, solver, check, fallback)
