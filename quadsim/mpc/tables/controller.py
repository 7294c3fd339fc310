"""What every table `[controller]` has: what it builds for a vehicle, and the fields of several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, ClassVar, Final

from annotated_types import Ge, Le, doc

from quadsim.controller import ROTORS, Controller
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.guard.settings import FallbackSettings
from quadsim.mpc.pilot.attitudes import AttitudeTargets
from quadsim.mpc.pilot.indi import INDISettings, TorqueIncrement
from quadsim.mpc.problem.model import LinearModel, hover_model
from quadsim.mpc.problem.polytope import Polytope
from quadsim.mpc.space import Shape
from quadsim.vehicle import Vehicle

if TYPE_CHECKING:
    from quadsim.mpc.guard.contract import Guard

LARGEST_HORIZON: Final = 1000
Range = tuple[float, float]
Horizon = Annotated[int, Ge(1), Le(LARGEST_HORIZON)]
KktEvery = Annotated[
    int, Ge(1), doc("[periods] interval at which KKT residuals are computed and logged; 1: every period")
]
Law = Annotated[str, doc("the controller, by its name in `quadsim list`")]


class ControllerTable:
    """A table `[controller]`: it builds a controller, the guard around it and an inner loop; all else is a default."""

    title: ClassVar[str]  # the controller's display name; this and the next two come from `quadsim.mpc.laws.register`
    description: ClassVar[str]  # its line in `quadsim list`
    place: ClassVar[int]  # in lists; controllers of one place are in the order of their names
    any_attitude: ClassVar = False  # whether the controller reads attitudes as quaternions
    type: str  # the controller's name, as files state and flights record it
    horizon: int
    polytopes: tuple[Polytope, ...] = ()
    commands: str = ROTORS
    inner_lag: tuple[float, ...] | None = None  # of what an autopilot flies: a field of each table with `commands`
    attitude_lag: tuple[float, ...] | None = None  # a field of each table that `turns_by_attitude`
    indi: INDISettings | None = None
    fallback: FallbackSettings | None = None
    iterations: int = 1
    output_bounds: Mapping[str, Sequence[float]] = MappingProxyType({})

    def law(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Controller:
        """Return the controller for a control `period` [s], with obstacles and regions `shapes`.

        Raises:
            InputError: no controller can be built from these numbers.
        """
        raise NotImplementedError(f"the table {type(self).__name__} has no method `law`")

    @property
    def turns_by_attitude(self) -> bool:
        """Whether the controller asks for body rates and commands the attitudes whose errors are those rates."""
        return False

    def attitudes(self) -> AttitudeTargets | None:
        """Return what makes attitudes of the controller's body rates; None where its commands are flown as they are."""
        return None

    def guard(self, vehicle: Vehicle, period: float) -> Guard | None:
        """Return the fallback contract around the controller; None without one."""
        fallback = self.fallback
        if fallback is None or not fallback.enabled:
            return None
        from quadsim.mpc.guard.contract import Guard

        return Guard(
            self.level_hover(vehicle, period),
            bounds=self.actuators(vehicle),
            settings=fallback.within(self.output_bounds),
        )

    def level_hover(self, vehicle: Vehicle, period: float) -> LinearModel:
        """Return the linear model at level hover of what the controller commands."""
        return hover_model(vehicle, period)

    def actuators(self, vehicle: Vehicle) -> ActuatorBounds:
        """Return the bounds on what the controller commands."""
        return ActuatorBounds.of_vehicle(vehicle)

    @property
    def holds_speeds(self) -> bool:
        """Whether rotors turn at each command for a whole period, as the audit of a saved run then checks.

        Not behind an autopilot, nor where an inner loop of the controller corrects the speeds.
        """
        return self.commands == ROTORS and self.indi is None

    def audited(self, vehicle: Vehicle) -> dict[str, Range]:
        """Return its hard and soft bounds on audited signals, in file units."""
        return {}

    def inner_loop(self, vehicle: Vehicle) -> TorqueIncrement | None:
        """Return the inner loop that corrects the rotor speeds it commands; None without one."""
        return None


def ranges(bounds: Mapping[str, Sequence[float]]) -> dict[str, Range]:
    """Return bounds by name, as pairs."""
    return {name: (pair[0], pair[1]) for name, pair in bounds.items()}


def require_ordered(name: str, pair: Sequence[float]) -> None:
    """Reject a pair of bounds unless the lower is below the upper."""
    if not pair[0] < pair[1]:
        raise ValueError(f"{name} must have its lower bound below its upper; got {[*pair]}")
