"""The fallback contract: the commands flown when a controller has no usable answer.

Each period flies the first of these that is available:

0. the law's answer, if its status is one of `ACCEPTED` and it is finite and within the actuators' bounds;
1. its last good plan, shifted by the periods since, with an LQR correction towards the states that the plan predicted,
unless the plan is too old or the vehicle too far from it;

2. level hover by LQR: velocity to zero, then the position held; height and yaw held from the start;

3. descent: the same, sinking at a constant speed, after level 2 has lasted too long.

The law is called in every period with a known state, so it resumes automatically.  It receives the command in force, so
that its slew bounds refer to the acting command, and the list of predicted channels
(`StepInputs.unseen`).

Exported laws have the same contract in C, `quadsim/mpc/c/quadsim_guard.c`; `tests/firmware/test_guard.py` holds
the two together.

A law that estimates disturbances is `quadsim.mpc.problem.equilibrium.Trimmed`.  Levels 1 to 3, and predictions of
missing channels, start from its equilibrium; it is held while nothing is measured.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import numpy as np

from quadsim.controller import (
    ACCEPTED,
    FALLBACK,
    GROUNDED,
    Command,
    Controller,
    Phase,
    Predicting,
    StepInputs,
    check_command,
    stopped,
)
from quadsim.errors import FlightError
from quadsim.mpc.guard.answer import ActuatorBounds, rejection, resized, shifted
from quadsim.mpc.guard.completion import PLAUSIBLE_REFERENCE, StateCompletion, completed_inputs
from quadsim.mpc.guard.hover import HoverLaw
from quadsim.mpc.guard.settings import USUAL_FALLBACK, USUAL_TILT, FallbackSettings
from quadsim.mpc.problem.equilibrium import Trim, Trimmed
from quadsim.mpc.problem.heading import anchored, predict_in_heading_frame
from quadsim.mpc.problem.model import LinearModel
from quadsim.state import INDEX, N_STATES, POSITION, REFERENCE_STATES, Array, all_true
from quadsim.vehicle import N_ROTORS

FAILURES: Final[tuple[type[Exception], ...]] = (FlightError, np.linalg.LinAlgError, ArithmeticError, RuntimeError)
"""Exceptions of numerics and compiled back ends.  Programming errors (`TypeError`, `KeyError`, ...) end the run."""
_MISTAKES: Final = (NotImplementedError, RecursionError)  # subclasses of `RuntimeError` that are programming errors


class Guard:
    """The fallback contract around a law, which `quadsim.mpc.pilot.pilot.Pilot` passes to it, whatever that law does.

    It never sends a command that is not finite or not within the bounds.  It passes the law's usable commands
    unchanged; a law may have its own fallback.

    Attributes:
        hover: the law of levels 2 and 3, and of the correction on level 1.
    """

    def __init__(
        self, model: LinearModel, *, bounds: ActuatorBounds, settings: FallbackSettings = USUAL_FALLBACK
    ) -> None:
        self.hover = HoverLaw(model, tilt=math.radians(USUAL_TILT if settings.tilt is None else settings.tilt))
        self._model, self._bounds, self._settings = model, bounds, settings
        self._distance = settings.distance
        self._completion = StateCompletion(model)
        self._law: Controller | None = None  # the last that was asked for its trim
        self._trimmed: Trimmed | None = None
        self._level = Trim(speeds=model.u_bar, lift=np.array([0.0, 0.0, 1.0]))
        self.reset(model.u_bar)

    def reset(self, speeds: Array) -> Array:
        """Restart after the command u(-1) (4,) [rad/s]; return it, or hover's if it is not usable, for the law."""
        usable = check_command(speeds) is None
        self._before = np.array(speeds, float) if usable else self._model.u_bar.copy()
        self._completion.reset()
        self._forget()
        return self._before.copy()

    def _forget(self) -> None:
        """Leave all fallback levels."""
        self._good: tuple[Array, Array] | None = None  # state (12,) of the last accepted answer, and its plan (N, 4)
        self._foreseen: Array | None = None
        self._target: Array | None = None
        self._age = self._hovered = 0  # periods in fallback, and periods of these on level 2 or 3

    def adopt(self, previous: Guard, horizon: int) -> None:
        """Take over the previous contract's level, state and plan, for a law of N = `horizon`."""
        self._completion.adopt(previous._completion)
        self._age, self._target, self._hovered = previous._age, previous._target, previous._hovered
        if previous._good is not None and previous._model.targets is self._model.targets:
            state, plan = previous._good
            self._good = state, resized(plan, horizon)

    def step(self, law: Controller, now: StepInputs, state: Array, reference: Array) -> Command:
        """Return the command of the first available level; see `quadsim.controller.Controller.step`.

        It catches the `FAILURES` of the law; their names become the status.  While grounded, the rotors slow down to
        their lowest speed as fast as the bounds allow.
        """
        acting = self._before if now.acting is None or check_command(now.acting) is not None else now.acting
        known = self._completion.complete(state, acting, self.trim(law), free=now.phase is Phase.FLYING)
        completed = completed_inputs(now, acting.copy(), self._completion.unseen.copy(), known)
        status, answer = self._call(law, completed, known, reference)
        if now.phase in GROUNDED:
            self._forget()
            command = stopped(self._bounds.lowest(acting), law.horizon, now.phase)
        elif answer is None or status not in ACCEPTED:
            command = self._fall_back(law, status, answer, known, acting)
        else:
            self._forget()
            # Moved onto its bounds, and so is the rest of the plan, which may act without a call.
            speeds = self._bounds.clip(answer.speeds, acting)
            later = self._bounds.clip_plan(answer.plan[1:], speeds) if law.horizon > 1 else answer.plan[1:]
            command = replace(answer, speeds=speeds, plan=np.concatenate([speeds[None], later]), fallback=0)
            self._good = known, command.plan
        self._before = command.speeds.copy()
        return command

    def trim(self, law: Controller) -> Trim:
        """Return the equilibrium that the law estimates; level hover if it estimates none."""
        trim = _tried(lambda: self._trim(law))
        return trim if isinstance(trim, Trim) else self._level

    def _trim(self, law: Controller) -> object:
        if law is not self._law:  # asked once: a runtime protocol takes as long as ten array operations
            self._law, self._trimmed = law, law if isinstance(law, Trimmed) else None
        return None if self._trimmed is None else self._trimmed.trim

    def predict(self, law: Controller, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Predicting`; by the hover model where the law cannot."""
        predicted = _tried(lambda: law.predict(states, plans) if isinstance(law, Predicting) else None)
        if isinstance(predicted, np.ndarray) and predicted.shape == (*plans.shape[:2], N_STATES):
            return predicted
        trim = self.trim(law)
        return predict_in_heading_frame(anchored(self._model, trim), states, plans, trim)

    def _call(self, law: Controller, now: StepInputs, known: Array, reference: Array) -> tuple[str, Command | None]:
        """Return the law's status and, if it gave one, its answer; an accepted answer is safe to fly."""
        assert now.acting is not None
        if self._model.period * float(self._completion.unseen.max()) > self._settings.unseen:
            return "state_unknown", None
        shape = (law.horizon, len(REFERENCE_STATES))
        if np.shape(reference) != shape or not all_true(np.abs(reference) <= PLAUSIBLE_REFERENCE):
            return "invalid_reference", None
        answer: Command | Exception = _tried(lambda: law.step(now, known.copy(), reference))
        if isinstance(answer, Exception):  # e.g. `PlanExhaustedError` as `plan_exhausted_error`
            return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", type(answer).__name__).lower(), None
        if answer.status in ACCEPTED and (
            np.shape(answer.speeds) != (N_ROTORS,) or np.shape(answer.plan) != (law.horizon, N_ROTORS)
        ):
            return "wrong_shape", answer
        return rejection(answer.status, answer.speeds, answer.plan, self._bounds, now.acting) or answer.status, answer

    def _fall_back(self, law: Controller, status: str, answer: Command | None, known: Array, acting: Array) -> Command:
        self._age += 1
        plan, level = self._shifted(law, known, acting, lost=status == "state_unknown"), 1
        if plan is None:
            plan, level = self._hover(law, known, acting)
        spent = answer or Command(speeds=plan[0], plan=plan)
        spent = replace(spent, status=status, answered_by=FALLBACK, fallback=level)
        stats = spent.stats._replace(active=0, slack=0.0, sqp_defect=math.nan, sqp_step=math.nan)
        return replace(spent, speeds=plan[0].copy(), plan=plan, stats=stats)

    def _shifted(self, law: Controller, known: Array, acting: Array, *, lost: bool) -> Array | None:
        """Return the rest of the last good plan (N, 4), corrected; None from when it becomes unusable."""
        if self._good is None:
            return None
        (state, plan), age = self._good, self._age
        if self._foreseen is None:
            self._foreseen = self.predict(law, state[None], plan[None])[0]
        deviation = known - self._foreseen[min(age, law.horizon) - 1]  # row i is the state i + 1 periods later
        old = age >= law.horizon or age * self._model.period > self._settings.plan_age + 1e-9
        if lost or old or not (np.abs(deviation) <= self._distance).all():
            self._good = None
            return None
        plan = shifted(plan, age)
        plan[0] += self.hover.correction(deviation, float(known[INDEX["yaw"]]))
        return self._bounds.clip_plan(plan, acting)

    def _hover(self, law: Controller, known: Array, acting: Array) -> tuple[Array, int]:
        """Return the plan (N, 4) of level hover or descent, and its level."""
        settings, period = self._settings, self._model.period
        if self._target is None:
            self._target = np.zeros(N_STATES)
            for name in ("x", "y", "z", "yaw"):
                self._target[INDEX[name]] = known[INDEX[name]]
        x, y, z = POSITION
        if math.hypot(known[INDEX["vx"]], known[INDEX["vy"]]) > settings.settled:
            self._target[[x, y]] = known[[x, y]]
        sinking = self._hovered * period >= settings.hover - 1e-9
        if sinking:
            self._target[INDEX["vz"]] = -settings.sink
            self._target[z] -= settings.sink * period
        self._hovered += 1
        plan = self.hover.plan(known, self._target, acting, self._bounds, law.horizon, self.trim(law))
        return plan, 3 if sinking else 2


def _tried(call: Callable[[], Any]) -> Any:
    """Return the result of a call, or the exception of `FAILURES` that it raises."""
    try:
        return call()
    except _MISTAKES:
        raise
    except FAILURES as error:
        return error
