"""The C files of a controller that may follow a course's motion, with position, attitude and their rates.

What the nonlinear and the geometric controller share: 19 numbers of a measured state, the rigid bodies by which they
predict until a command acts, and the reference, which is a preview or the motion itself.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import ClassVar, Final

from quadsim.core.mirror import Struct
from quadsim.mpc.export.ctext import CText
from quadsim.mpc.export.source import CSource
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.laws.geometric import Geometric, GeometricController
from quadsim.mpc.laws.nonlinear import Nonlinear
from quadsim.mpc.laws.parts.delay import Bodies
from quadsim.mpc.laws.parts.nonlinear_law import WIDTH_OF_MOTION
from quadsim.mpc.laws.parts.nonlinear_mpc import NonlinearMPC
from quadsim.state import N_STATES
from quadsim.vehicle import Vehicle

BODY_AHEAD_FILES: Final = (
    "quadsim_delay.h",
    "quadsim_delay.c",
    "quadsim_nmpc.h",
    "quadsim_nmpc_math.h",
    "quadsim_nmpc_model.c",
)
"""Files of the rigid body, and of how it moves until a command acts."""


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

    def body_blocks(self, text: CText, bodies: Bodies) -> list[str]:
        """Return rigid bodies and what they point to."""
        blocks = []
        for name, (body, left) in bodies.items():
            blocks.append(text.array(f"left_{name}", left))
            members = text.mirrored(body, {"left": f"{text.prefix}left_{name}"})
            blocks.append(text.struct("quadsim_nmpc_problem", f"{text.prefix}{name}", **members))
        return blocks

    def delay_blocks(self, text: CText, numbers: Struct, bodies: Bodies) -> list[str]:
        """Return the delay of commands, and the bodies that it points to."""
        addresses = {name: f"&{text.prefix}{name}" for name in bodies}
        members = text.mirrored(numbers, addresses)
        delay = text.struct("quadsim_delay_numbers", f"{text.prefix}delay", **members)
        return [*self.body_blocks(text, bodies), delay]

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
        if self.motion:
            return self.law.motion_rows
        return 0

    @property
    def reference(self) -> tuple[int, int, str]:
        """See `CSource`."""
        if self.motion_rows:
            return (self.motion_rows, WIDTH_OF_MOTION, self.motion_row)
        return super().reference
