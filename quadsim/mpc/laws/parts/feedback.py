"""What controllers without a QP share: a period from measurement to command, and the prediction model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from annotated_types import Ge, Le, doc

from quadsim.controller import GROUNDED, Command, StepInputs, stopped
from quadsim.errors import CommandError
from quadsim.fields import NonNegative
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.laws.parts.preview import SMALLEST_PREVIEW, differentiator
from quadsim.mpc.problem.heading import predict_in_heading_frame
from quadsim.mpc.problem.model import LinearModel, hover_model
from quadsim.mpc.tables.commands import InputBounds
from quadsim.mpc.tables.controller import LARGEST_HORIZON, ControllerTable, Range
from quadsim.state import INDEX, STATE_NAMES, Array, ReferenceTurns
from quadsim.vehicle import Vehicle


class FeedbackLaw(ABC):
    """A controller without an optimisation; a subclass defines its command in flight, `_command`."""

    solver: Final = ""

    def __init__(self, vehicle: Vehicle, period: float, settings: Baseline, model: LinearModel | None = None) -> None:
        self.bounds = settings.actuators(vehicle)
        self.horizon = settings.horizon
        self._period = period
        if model is None:
            self.model = hover_model(vehicle, period)
        else:
            self.model = model
        self._operator = differentiator(self.horizon, period)
        self._turns = ReferenceTurns()
        self.reset(self.model.u_bar)

    def reset(self, speeds: Array) -> None:
        """Restart after the command u(-1) (4,) [rad/s]."""
        self._before = np.array(speeds, float)
        self._turns.reset()

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """Return the command; on the ground the lowest speed, as fast as bounds allow; see `quadsim.controller`.

        Raises:
            CommandError: the state or the reference is not finite; no command is sent, and the controller's state is
                unchanged.
        """
        before = self._before
        if now.acting is not None:
            before = now.acting
        before = before[: self.model.nu]
        if now.phase in GROUNDED:
            command = stopped(self.bounds.lowest(before), self.horizon, now.phase)
            self.reset(command.speeds)
            return command
        if not np.isfinite(state).all():
            names = ", ".join(STATE_NAMES[i] for i in np.flatnonzero(~np.isfinite(state)))
            raise CommandError(f"no command from a measured state whose {names} is not finite", time=now.time)
        if not np.isfinite(reference).all():
            raise CommandError("no command from a reference that is not finite", time=now.time)
        reference = self._turns.follow(reference, float(state[INDEX["yaw"]]))
        command = self._command(now, state, reference, before)
        self._before = command.speeds.copy()
        return command

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`."""
        return predict_in_heading_frame(self.model, states, plans[..., : self.model.nu])

    @abstractmethod
    def _command(self, now: StepInputs, state: Array, reference: Array, before: Array) -> Command:
        """Return the command in the air after `before` (4,) [rad/s], for finite numbers; see `Controller.step`."""

    def _held_for_a_period(self, speeds: Array) -> Command:
        """Return `speeds` (4,) [rad/s], or targets, with a plan that holds them for one period and hover after it."""
        plan = np.tile(speeds, (self.horizon, 1))
        plan[1:, : self.model.nu] = self.model.u_bar
        return Command(speeds=speeds.copy(), plan=plan)


@dataclass(frozen=True, kw_only=True)
class Baseline(ControllerTable):
    """The table of a baseline controller; every field has a default."""

    horizon: Annotated[
        int,
        Ge(SMALLEST_PREVIEW),
        Le(LARGEST_HORIZON),
        doc("[periods] N, preview of the reference, from which its velocity and acceleration are computed"),
    ] = 10
    input_bounds: Annotated[
        InputBounds | None,
        doc("limits of the commands; absent: the vehicle's range of speeds, and any step"),
    ] = None
    tilt: Annotated[float, Ge(0.1), Le(80.0), doc("[deg] largest tilt commanded")] = 45.0

    def audited(self, vehicle: Vehicle) -> dict[str, Range]:
        """See `quadsim.mpc.tables.controller.ControllerTable.audited`."""
        if self.input_bounds is None:
            return {}
        return self.input_bounds.audited(vehicle)

    def actuators(self, vehicle: Vehicle) -> ActuatorBounds:
        """See `quadsim.mpc.tables.controller.ControllerTable.actuators`."""
        if self.input_bounds is None:
            return ActuatorBounds.of_vehicle(vehicle)
        return self.input_bounds.actuators(vehicle)


@dataclass(frozen=True, kw_only=True)
class Tuned(Baseline):
    """A controller whose gains follow from the period and a lag."""

    lag: Annotated[
        NonNegative | None,
        doc("[s] lag of rotors and computer that the gains allow for; absent: the vehicle's, or half a period"),
    ] = None
