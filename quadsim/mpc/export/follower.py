"""The C files of a controller that may follow a course's motion."""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import ClassVar

from quadsim.mpc.export.source import CSource
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.laws.geometric import Geometric, GeometricController
from quadsim.mpc.laws.nonlinear import Nonlinear
from quadsim.mpc.laws.parts.nonlinear_law import WIDTH_OF_MOTION
from quadsim.mpc.laws.parts.nonlinear_mpc import NonlinearMPC
from quadsim.state import N_STATES
from quadsim.vehicle import Vehicle


@dataclass(frozen=True, kw_only=True)
class CFollower(CSource):
    """A controller as C source whose reference is a preview, or the motion of a course.

    Raises:
        ExportError: it cannot be exported.
    """

    table: Nonlinear | Geometric
    vehicle: Vehicle
    control_period: float  # [s]
    motion: bool = False  # whether the course has a motion

    state = N_STATES + 7
    plan = "law->plan"
    motion_row: ClassVar[str]
    """What a row of a motion is."""

    @property
    @abc.abstractmethod
    def law(self) -> NonlinearMPC | GeometricController:
        """The controller, of whose numbers these are."""

    @property
    def period(self) -> float:
        """See `CSource`."""
        return self.control_period

    @property
    def horizon(self) -> int:
        """See `CSource`."""
        return self.table.horizon

    @property
    def bounds(self) -> ActuatorBounds:
        """See `CSource`."""
        return self.table.actuators(self.vehicle)

    @property
    def commands(self) -> str:
        """See `CSource`."""
        return self.table.commands

    @property
    def motion_rows(self) -> int:
        """See `CSource`."""
        return self.law.motion_rows if self.motion else 0

    @property
    def reference(self) -> tuple[int, int, str]:
        """See `CSource`."""
        return (self.motion_rows, WIDTH_OF_MOTION, self.motion_row) if self.motion_rows else super().reference
