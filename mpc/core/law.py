"""The whole law in C: the library's controllers instead of Python's step."""

from __future__ import annotations

import ctypes
import math
import time as clock
from functools import cache, lru_cache
from typing import Final, NoReturn

import numpy as np

from mpc.answer import ActuatorBounds
from mpc.core.numbers import Exportable, controller_numbers, robust_numbers
from mpc.core.solver import PROBLEMS, Key, Work, core_library, core_problem
from mpc.equilibrium import Trim
from mpc.heading import predict_in_heading_frame
from mpc.model import hover_model
from mpc.nonlinear.model import SUBSTEPS
from mpc.paper import rollout
from mpc.robust.settings import LONGEST_SPAN
from quadsim.controller import (
    CORE,
    FALLBACK,
    GAIN,
    GROUNDED,
    SOLVED,
    UNCONSTRAINED,
    Command,
    Phase,
    Statistics,
    StepInputs,
    stopped,
)
from quadsim.core.library import check_sizes
from quadsim.state import EULER, EULER_RATE, N_STATES, VELOCITY, Array
from quadsim.vehicle import N_ROTORS

STATUSES: Final = (UNCONSTRAINED, SOLVED, SOLVED, "clipped", "shifted", "before")
"""Log entries for the values of `enum quadsim_status`."""
ANSWERERS: Final = (GAIN, CORE, CORE, FALLBACK, FALLBACK, FALLBACK)
"""The matching `answered_by`."""
LEVELS: Final = (0, 0, 0, 1, 2, 3)
"""The matching fallback level."""
_MOVING: Final = [*VELOCITY, *EULER, *EULER_RATE]
_SAME_TIME: Final = 1e-6  # [s]
_INT, _REAL, _AT = ctypes.c_int, ctypes.c_double, ctypes.c_void_p


def _arrays(**sizes: int) -> list[tuple[str, type]]:
    return [(name, _REAL * size) for name, size in sizes.items()]


class _Robust(ctypes.Structure):
    _fields_ = [
        *((name, _INT) for name in ("observes", "heading", "under_way")),
        *((name, _REAL) for name in ("gravity", "least_lift", "upright", "period", "delay", "delayed_share")),
        *((name, _REAL) for name in ("rest_of_period", "spun_period", "spun_delay", "spun_before", "largest_turn")),
        *_arrays(effectiveness=16, allocation=16, gyration=3, slope_inverse=16, modes=16, gain=6, largest=6),
        *_arrays(decay_before=4 * SUBSTEPS, decay_delay=4 * SUBSTEPS, decay_period=4 * SUBSTEPS),
        *_arrays(plausible_state=12, plausible_reference=4),
    ]


class _Controller(ctypes.Structure):
    _fields_ = [
        *((name, _AT) for name in ("problem", "robust", "C_r")),
        *_arrays(hover=4, speed_min=4, speed_max=4, step_min=4, step_max=4),
    ]


class _MPC(ctypes.Structure):
    _fields_ = [
        *(("controller", _AT), ("work", Work), ("wanted", _AT), ("sent", _AT)),
        *(*_arrays(before=4), ("age", _INT), ("headed", _INT), ("heading", _REAL), ("known", _INT)),
        *_arrays(rotors=4, ahead=12, turning=4, estimate=6),
        *_arrays(trim=4, lift=3, twist=3, effectiveness=16),
    ]


@cache
def _library() -> ctypes.CDLL:
    library = core_library()
    check_sizes(quadsim_robust=_Robust, quadsim_controller=_Controller, quadsim_mpc=_MPC)
    library.quadsim_mpc_reals.restype, library.quadsim_mpc_reals.argtypes = ctypes.c_long, [_AT]
    library.quadsim_mpc_start.restype, library.quadsim_mpc_start.argtypes = None, [_AT] * 3
    library.quadsim_mpc_reset.restype, library.quadsim_mpc_reset.argtypes = None, [_AT] * 2
    library.quadsim_mpc_step.argtypes = [_AT] * 5
    return library


class _Shared:
    """A law's numbers in the library's memory layout, shared by equal laws of this process."""

    def __init__(self, law: Exportable) -> None:
        self.nominal = hover_model(law.vehicle, law.problem.model.period)
        self.bounds = ActuatorBounds.of_problem(law.problem) if law.problem.every_constraint else None
        self.problem = core_problem(law.problem)
        numbers, robust = controller_numbers(law), None
        self._C_r = np.ascontiguousarray(numbers.pop("C_r"))
        if law.settings is not None:
            members = robust_numbers(law, self.problem.tables.modes)
            robust = _Robust(**{name: _plain(value) for name, value in members.items()})
        self._robust = robust
        self.struct = _Controller(
            problem=ctypes.addressof(self.problem.struct),
            robust=None if robust is None else ctypes.addressof(robust),
            C_r=self._C_r.ctypes.data,
            **{name: _plain(value) for name, value in numbers.items()},
        )


@lru_cache(PROBLEMS)
def _shared(key: Key[Exportable]) -> _Shared:
    return _Shared(key.of)


def _plain(value: float | Array) -> float | tuple[float, ...]:
    return tuple(value.ravel().tolist()) if isinstance(value, np.ndarray) else value


class CompiledMPC:
    """A law run by the library; it falls back as the C does on a target.

    Raises:
        FileError: the library cannot be compiled or loaded.
        ParameterError: the core cannot take the problem.
    """

    solver: Final = "compiled"
    """Stands for a solver's name."""

    def __init__(self, law: Exportable) -> None:
        library, shared = _library(), _shared(Key.to(law))
        self.name, self.problem, self.horizon = law.name, law.problem, law.problem.horizon
        self._shared, self._robust = shared, law.settings is not None
        self._unbounded = shared.bounds is None  # this law is the gain: no status reports a free optimum
        controller = ctypes.addressof(shared.struct)
        # The struct and its views point into this memory.
        self._memory, self._mpc = np.zeros(library.quadsim_mpc_reals(controller)), _MPC()
        at = ctypes.addressof(self._mpc)
        library.quadsim_mpc_start(at, controller, self._memory.ctypes.data)
        work, N, rows = self._mpc.work, self.horizon, self.horizon * shared.problem.struct.step_rows
        self._plan = _view(work.plan, N * N_ROTORS).reshape(N, N_ROTORS)
        self._value, self._shift = (_view(start, rows) for start in (work.value, work.shift))
        self._side = np.ctypeslib.as_array((ctypes.c_int8 * rows).from_address(work.last))
        self._trim, self._lift, self._twist = map(
            np.ctypeslib.as_array, (self._mpc.trim, self._mpc.lift, self._mpc.twist)
        )
        tables = shared.problem.tables
        self._soft = any(math.isfinite(row.l1) for row in tables.rows)
        self._lower, self._upper = (
            np.broadcast_to(bound, (N, bound.shape[1])).ravel() for bound in (tables.lower, tables.upper)
        )
        self._state, self._path, self._acting, self._command = (
            np.zeros(shape) for shape in (N_STATES, (N, 4), N_ROTORS, N_ROTORS)
        )
        arrays = self._state, self._path, self._acting, self._command
        self._arguments = at, *(array.ctypes.data for array in arrays)
        self._step, self._restart = library.quadsim_mpc_step, library.quadsim_mpc_reset
        self.reset(shared.nominal.u_bar)

    def __reduce__(self) -> NoReturn:
        """Refuse: addresses are useless in a copy or another process."""
        raise TypeError("a CompiledMPC cannot be copied or pickled: make another")

    def reset(self, speeds: Array) -> None:
        """See `quadsim.controller.Controller.reset`."""
        self._before = np.array(speeds, float)
        self._restart(self._arguments[0], self._before.ctypes.data)
        self._called_at = self._measured = -math.inf

    @property
    def trim(self) -> Trim:
        """The equilibrium under the estimated disturbance."""
        if self._robust:
            return Trim(speeds=self._trim.copy(), lift=self._lift.copy(), twist=self._twist.copy())
        return Trim(speeds=self._shared.nominal.u_bar, lift=np.array([0.0, 0.0, 1.0]))

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """See `quadsim.controller.Controller.step`."""
        acting = self._before if now.acting is None else now.acting
        if now.phase in GROUNDED:
            return self._stop(acting, now.phase)
        self._state[:], self._acting[:], self._path[:] = state, acting, reference
        if self._robust and not self._may_learn(now):
            self._mpc.known = 0
        started = clock.perf_counter()
        status = self._step(*self._arguments)
        spent_s = clock.perf_counter() - started
        self._before = self._command.copy()
        if now.phase is not Phase.FLYING:  # the ground holds the vehicle, so its motion shows no disturbance
            self._mpc.known = 0
        accepted = LEVELS[status] == 0
        plan = self._plan.copy() if accepted else np.empty_like(self._plan)
        plan[0 if accepted else slice(None)] = self._before
        active = int(np.count_nonzero(self._side)) if accepted else 0
        return Command(
            speeds=self._before.copy(),
            plan=plan,
            status=UNCONSTRAINED if self._unbounded else STATUSES[status],
            answered_by=GAIN if self._unbounded else ANSWERERS[status],
            fallback=LEVELS[status],
            stats=Statistics(
                iterations=self._mpc.work.changes,
                active=active,
                slack=self._most_slack() if active and self._soft else 0.0,
                solve_s=spent_s,
            ),
        )

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`."""
        if self._robust:
            return predict_in_heading_frame(self._shared.nominal, states, plans, self.trim)
        return rollout(self.problem.model, states, plans)

    def _most_slack(self) -> float:
        """Return the largest violation of a soft bound by the optimum."""
        beyond = np.flatnonzero(np.abs(self._side) == 2)
        values = self._value[beyond] + self._shift[beyond]
        return float(np.maximum(values - self._upper[beyond], self._lower[beyond] - values).max(initial=0.0))

    def _stop(self, acting: Array, phase: Phase) -> Command:
        bounds = self._shared.bounds
        speeds = np.zeros(N_ROTORS) if bounds is None else bounds.reach(acting)[0]
        self.reset(speeds)
        return stopped(speeds.copy(), self.horizon, phase)

    def _may_learn(self, now: StepInputs) -> bool:
        """Return whether the observer may compare the state with its prediction, as `RobustPreparation` does."""
        if abs(now.time - self._called_at - self._shared.nominal.period) > _SAME_TIME:
            self._measured = -math.inf
        self._called_at = now.time
        if now.unseen is not None and now.unseen[_MOVING].any():
            return False
        span, self._measured = now.time - self._measured, now.time
        return span - _SAME_TIME <= LONGEST_SPAN and now.phase is Phase.FLYING


def _view(address: int, count: int) -> Array:
    return np.ctypeslib.as_array((_REAL * count).from_address(address))
