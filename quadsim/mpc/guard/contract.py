"""The fallback contract: the commands flown when a controller has no usable answer.

Each period flies the first of these that is available:

0. the controller's answer, if its status is one of `ACCEPTED` and it is finite and within the actuators' bounds;
1. its last good plan, shifted by the periods since, with an LQR correction towards the states that the plan predicted,
unless the plan is too old or the vehicle too far from it;

2. level hover by LQR: velocity to zero, then the position held; height and yaw held from the start;

3. descent: the same, sinking at a constant speed, after level 2 has lasted too long.

The controller is called in every period with a known state, so it resumes automatically.  It receives the command in
force, so that its slew bounds refer to the acting command, and the list of predicted channels (`StepInputs.unseen`).

The contract is `quadsim/mpc/c/quadsim_guard.c`, for exported controllers and here: `Guard` calls the controller, and
gives the C what only Python has.

A controller that estimates disturbances is `quadsim.mpc.problem.equilibrium.Trimmed`.  Levels 1 to 3, and predictions
of missing channels, start from its equilibrium; it is held while nothing is measured.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Final, NoReturn

import numpy as np

from quadsim.controller import (
    ACCEPTED,
    COMMANDED,
    FALLBACK,
    GROUNDED,
    Command,
    Controller,
    Phase,
    Predicting,
    StepInputs,
    stopped,
)
from quadsim.core.mirror import constant, core_library, set_members, struct
from quadsim.errors import FlightError, ParameterError
from quadsim.mpc.guard.answer import ActuatorBounds, resized
from quadsim.mpc.guard.numbers import UPRIGHT, fallback_numbers
from quadsim.mpc.guard.settings import USUAL_FALLBACK, FallbackSettings
from quadsim.mpc.guard.structs import STATUSES
from quadsim.mpc.problem.equilibrium import Trim, Trimmed
from quadsim.mpc.problem.heading import anchored, predict_in_heading_frame
from quadsim.mpc.problem.model import LinearModel
from quadsim.mpc.solvers import INVALID_DATA
from quadsim.state import ANGLE_RATES, ANGLES, INDEX, N_STATES, REFERENCE_STATES, Array, all_true
from quadsim.vehicle import N_ROTORS

FAILURES: Final[tuple[type[Exception], ...]] = (FlightError, np.linalg.LinAlgError, ArithmeticError, RuntimeError)
"""Exceptions of numerics and compiled back ends.  Programming errors (`TypeError`, `KeyError`, ...) end the run."""
_MISTAKES: Final = (NotImplementedError, RecursionError)  # subclasses of `RuntimeError` that are programming errors
_CALLED: Final = constant("QUADSIM_FREE")  # by which the C wants the controller to be called
_ANSWERED: Final = STATUSES.index(COMMANDED)
_FAILED: Final = STATUSES.index(INVALID_DATA)
_LOST: Final = STATUSES.index("state_unknown")
"""What the C has to tell apart: an answer that is flown, none, and none because the state is not known."""
PHASES: Final[Mapping[Phase, int]] = {
    Phase.FLYING: constant("QUADSIM_PHASE_FLYING"),
    Phase.ARMED: constant("QUADSIM_PHASE_ARMED"),
    Phase.LANDED: constant("QUADSIM_PHASE_LANDED"),
    Phase.CRASHED: constant("QUADSIM_PHASE_LANDED"),
}
"""`enum quadsim_phase` by phase."""


class Guard:
    """The fallback contract around any controller, which `quadsim.mpc.pilot.pilot.Pilot` passes to it.

    It never sends a command that is not finite or not within the bounds.  It passes the controller's usable commands
    unchanged; a controller may have its own fallback.

    Attributes:
        model: of level hover.
        numbers: the `quadsim_fallback` of the contract.
    """

    def __init__(
        self, model: LinearModel, *, bounds: ActuatorBounds, settings: FallbackSettings = USUAL_FALLBACK
    ) -> None:
        self.model = model
        self.numbers = struct("quadsim_fallback")()
        set_members(self.numbers, **fallback_numbers(model, bounds, settings.within({})))
        self._library = core_library()
        self._struct = struct("quadsim_guard")()
        self._trim = struct("quadsim_trim")()
        self._kept = np.zeros((1, N_ROTORS))  # memory of the last plan that was flown
        self._library.quadsim_guard_start(self._struct, self.numbers, 1, self._kept.ctypes.data)
        self._state = np.ctypeslib.as_array(self._struct.state)
        self._unseen = np.ctypeslib.as_array(self._struct.unseen)
        self._in_force = np.ctypeslib.as_array(self._struct.in_force)
        self._foreseen = np.ctypeslib.as_array(self._struct.foreseen)
        self._measured = np.zeros(N_STATES)
        self._acting = np.zeros(N_ROTORS)
        self._inputs = self._measured.ctypes.data, self._acting.ctypes.data
        self._rest_commands = np.ctypeslib.as_array(self._trim.commands)
        self._rest_lift = np.ctypeslib.as_array(self._trim.lift)
        self._rest_twist = np.ctypeslib.as_array(self._trim.twist)
        self._level = Trim(speeds=model.u_bar, lift=np.array([0.0, 0.0, 1.0]))
        self._law: Controller | None = None  # the last that was asked for its trim
        self._trimmed: Trimmed | None = None
        self.reset(model.u_bar)

    def __reduce__(self) -> NoReturn:
        """Refuse: addresses are useless in a copy or another process."""
        raise TypeError("a fallback contract cannot be copied or pickled: make another")

    def reset(self, speeds: Array) -> Array:
        """Restart after the command u(-1) (4,) [rad/s]; return it, or hover's if it is not usable."""
        command = _numbers_for_the_core(speeds, (N_ROTORS,))
        self._library.quadsim_guard_reset(self._struct, command.ctypes.data)
        self._predicted: Array | None = None  # (N, 12) where the rest of the last plan leads, once it is asked for
        self._predicted_at = 0  # the age of the plan then
        return np.array(self._struct.before)

    def adopt(self, previous: Guard, horizon: int) -> None:
        """Take over the previous contract's level, state and plan, for a controller of N = `horizon`."""
        self._fit(horizon)
        self._library.quadsim_guard_adopt(self._struct, previous._struct)
        self._predicted = None

    def step(self, law: Controller, now: StepInputs, state: Array, reference: Array) -> Command:
        """Return the command of the first available level; see `quadsim.controller.Controller.step`.

        It catches the `FAILURES` of the controller; their names become the status.  While grounded, the rotors slow
        down to their lowest speed as fast as the bounds allow.
        """
        self._fit(law.horizon)
        code = self._begin(law, now, state, reference)
        status = STATUSES[code]
        answer: Command | None = None
        plan = self._kept
        if code == _CALLED:
            status, answer = self._call(law, now, reference)
            code = _FAILED
            if status == STATUSES[_LOST]:
                code = _LOST
        if answer is not None and status in ACCEPTED:
            plan = _plan_of(answer)
            code = self._library.quadsim_guard_check(self._struct, _ANSWERED, plan.ctypes.data)
            if code != _ANSWERED:
                status = STATUSES[code]
        plan = self._end(law, now.phase, code, plan)
        speeds = plan[0].copy()
        if now.phase in GROUNDED:
            return stopped(speeds, law.horizon, now.phase)
        if answer is not None and code == _ANSWERED:
            return Command(  # `replace` takes five times as long, in every period
                speeds=speeds,
                plan=plan,
                status=answer.status,
                answered_by=answer.answered_by,
                stats=answer.stats,
                inner=answer.inner,
                iterations_by=answer.iterations_by,
            )
        spent = answer or Command(speeds=speeds, plan=plan)
        stats = spent.stats._replace(active=0, slack=0.0, sqp_defect=math.nan, sqp_step=math.nan)
        flown = replace(spent, speeds=speeds, plan=plan, stats=stats)
        return replace(flown, status=status, answered_by=FALLBACK, fallback=self._struct.level)

    @property
    def state(self) -> Array:
        """(12,) the state of the present period, its missing channels predicted."""
        return self._state.copy()

    def hover(self, law: Controller, state: Array, acting: Array) -> Array:
        """Restart after the command in force (4,), and return the plan (N, 4) of level hover from a state (12,)."""
        self.reset(acting)
        self._fit(law.horizon)
        level = np.zeros((law.horizon, len(REFERENCE_STATES)))
        self._begin(law, StepInputs(acting=acting), state, level)
        return self._end(law, Phase.FLYING, _FAILED, self._kept)

    def trim(self, law: Controller) -> Trim:
        """Return the equilibrium that the controller estimates; level hover if it estimates none."""
        trim = _result_or_failure(lambda: self._trim_of(law))
        if isinstance(trim, Trim):
            return trim
        return self._level

    def _trim_of(self, law: Controller) -> object:
        if law is not self._law:  # asked once: a runtime protocol takes as long as ten array operations
            self._law = law
            self._trimmed = None
            if isinstance(law, Trimmed):
                self._trimmed = law
        if self._trimmed is None:
            return None
        return self._trimmed.trim

    def predict(self, law: Controller, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Predicting`; by the hover model where the controller cannot."""
        predicted = None
        if isinstance(law, Predicting):
            predicted = _result_or_failure(lambda: law.predict(states, plans))
        if isinstance(predicted, np.ndarray) and predicted.shape == (*plans.shape[:2], N_STATES):
            return predicted
        trim = self.trim(law)
        return predict_in_heading_frame(anchored(self.model, trim), states, plans, trim)

    def _fit(self, horizon: int) -> None:
        """Give plans the length of a controller's horizon."""
        if horizon == self._struct.horizon:
            return
        if horizon < 1:
            raise ParameterError("controller", "horizon", horizon, "at least 1")
        self._kept = resized(self._kept, horizon)
        self._struct.horizon = horizon
        self._struct.kept = self._kept.ctypes.data
        self._predicted = None  # along a plan of the old horizon

    def _set_trim(self, law: Controller) -> None:
        trim = self.trim(law)
        self._rest_commands[:] = trim.speeds
        self._rest_lift[:] = trim.lift
        self._rest_twist[:] = trim.twist

    def _begin(self, law: Controller, now: StepInputs, state: Array, reference: Array) -> int:
        """Complete the state; return the status for which the controller is not to be called, or `_CALLED`."""
        self._measured[:] = _numbers_for_the_core(state, (N_STATES,))
        path = _numbers_for_the_core(reference, (law.horizon, len(REFERENCE_STATES)))
        self._acting[:] = _numbers_for_the_core(now.acting, (N_ROTORS,))
        self._set_trim(law)
        measured, acting = self._inputs
        code: int = self._library.quadsim_guard_begin(
            self._struct, PHASES[now.phase], self._trim, measured, path.ctypes.data, path.size, acting
        )
        return code

    def _call(self, law: Controller, now: StepInputs, reference: Array) -> tuple[str, Command | None]:
        """Return the controller's status and, if it gave one, its answer, of the right shape if it is accepted."""
        known = self._state.copy()
        completed = completed_inputs(now, self._in_force.copy(), self._unseen.astype(float), known)
        answer: Command | Exception = _result_or_failure(lambda: law.step(completed, known.copy(), reference))
        if isinstance(answer, Exception):  # e.g. `PlanExhaustedError` as `plan_exhausted_error`
            return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", type(answer).__name__).lower(), None
        if answer.status in ACCEPTED:
            shaped = np.shape(answer.speeds) == (N_ROTORS,) and np.shape(answer.plan) == (law.horizon, N_ROTORS)
            if not shaped:
                return "wrong_shape", answer
        return answer.status, answer

    def _end(self, law: Controller, phase: Phase, code: int, answered: Array) -> Array:
        """Return the plan (N, 4) of the period, its command first, of a controller's status and perhaps its plan."""
        if code != _ANSWERED:
            self._set_trim(law)  # the controller's call may have changed it
        if self._library.quadsim_guard_foresees(self._struct, PHASES[phase], code):
            self._foresee(law)
        plan = np.empty_like(self._kept)
        address = plan.ctypes.data
        self._library.quadsim_guard_end(self._struct, PHASES[phase], self._trim, code, answered.ctypes.data, address)
        self._library.quadsim_guard_plan(self._struct, address)
        if self._struct.level == 0:
            self._predicted = None
        return plan

    def _foresee(self, law: Controller) -> None:
        """Move on the state that the last plan leads to."""
        age = self._struct.age
        last = len(self._kept) - 1
        if self._predicted is None:
            plan = resized(self._kept[min(age, last) :], len(self._kept))
            self._predicted = self.predict(law, self._foreseen[None].copy(), plan[None])[0]
            self._predicted_at = age
        self._foreseen[:] = self._predicted[min(age - self._predicted_at, last)]


def completed_inputs(now: StepInputs, acting: Array, unseen: Array, known: Array) -> StepInputs:
    """Return a step's inputs with the command in force (4,), for the state `known` (12,) of ages `unseen` (12,).

    Attitude and body rates are omitted where those of the state are predicted.  Near a pitch of 90 deg, Euler rates are
    implausibly large, but body rates are not.
    """
    attitude = now.attitude
    rates = now.body_rates
    if unseen[ANGLES].any():
        attitude = None
    if unseen[ANGLE_RATES].any() and abs(float(known[INDEX["pitch"]])) < UPRIGHT:
        rates = None
    return StepInputs(  # `replace` takes five times as long, in every period
        time=now.time,
        phase=now.phase,
        acting=acting,
        attitude=attitude,
        body_rates=rates,
        motion=now.motion,
        unseen=unseen,
        signals=now.signals,
    )


def _numbers_for_the_core(value: Any, shape: tuple[int, ...]) -> Array:
    """Return real numbers of a shape as the C takes them; of anything else as many that are none."""
    if isinstance(value, np.ndarray) and value.dtype == np.float64 and value.shape == shape:
        return np.ascontiguousarray(value)
    if np.shape(value) != shape or np.iscomplexobj(value):
        return np.full(shape, math.nan)
    return np.ascontiguousarray(value, float)


def _plan_of(answer: Command) -> Array:
    """Return the plan (N, 4) of an answer with its command first; where that is not finite in the plan it stays so."""
    plan = np.array(answer.plan, float, order="C")
    if all_true(np.isfinite(plan[0])):
        plan[0] = answer.speeds
    return plan


def _result_or_failure(call: Callable[[], Any]) -> Any:
    """Return the result of a call, or the exception of `FAILURES` that it raises."""
    try:
        return call()
    except _MISTAKES:
        raise
    except FAILURES as error:
        return error
