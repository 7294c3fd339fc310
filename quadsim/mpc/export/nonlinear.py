"""The C files of a nonlinear controller: its quadratic program, its rigid bodies, its fallback, and its numbers.

The memory has a capacity for 2 active rows per node of the horizon; the kernel is compiled for its sizes alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from quadsim.controller import ATTITUDE, ROTORS
from quadsim.errors import ExportError
from quadsim.mpc.export.ctext import CText
from quadsim.mpc.export.follower import BODY_AHEAD_FILES, CFollower
from quadsim.mpc.export.source import CHANGES, SHARED_FILES
from quadsim.mpc.guard.numbers import fallback_numbers
from quadsim.mpc.laws.nonlinear import Nonlinear
from quadsim.mpc.laws.parts.nonlinear_mpc import NonlinearMPC
from quadsim.mpc.problem.model import LinearModel, hover_model, target_model
from quadsim.mpc.solvers.core_tables import NO_BOUND

NONLINEAR_FILES: Final = (
    *SHARED_FILES,
    *BODY_AHEAD_FILES,
    "quadsim_ramp.h",
    "quadsim_ramp.c",
    "quadsim_nmpc.c",
    "quadsim_nmpc_qp.h",
    "quadsim_nmpc_rows.c",
    "quadsim_nmpc_riccati.c",
    "quadsim_nmpc_active_set.c",
    "quadsim_nmpc_interior.c",
    "quadsim_nmpc_solve.c",
    "quadsim_nonlinear.h",
    "quadsim_nonlinear.c",
)
"""Files of `quadsim/mpc/c` to export verbatim."""
ROWS_PER_NODE: Final = 2.0
"""Capacity for active rows, per node."""
FEWEST_ROWS: Final = 32


@dataclass(frozen=True, kw_only=True)
class CNonlinear(CFollower):
    """A nonlinear controller as C source, with memory for 2 active rows per node, and for at least 32.

    Raises:
        ExportError: it cannot be exported.
    """

    table: Nonlinear

    law_name = "quadsim_nonlinear"
    law_files = NONLINEAR_FILES
    motion_row = "position, quaternion, velocity, body rates, thrusts of the rotors"

    def __post_init__(self) -> None:
        if self.table.commands == ATTITUDE:
            raise ExportError('it is \'nonlinear\' with commands = "attitude"; exported are "rotors" and "rates"')
        if self.table.indi is not None:
            raise ExportError("its rotor speeds are corrected at each physics step: leave out controller.indi")
        if self.table.time_limit is not None:
            raise ExportError("its steps end by a clock, which the C has not: leave out controller.time_limit")

    @cached_property
    def law(self) -> NonlinearMPC:
        """The controller, of whose numbers these are."""
        table = self.table
        vehicle = self.vehicle
        return NonlinearMPC(
            vehicle,
            period=self.control_period,
            settings=table,
            bounds=table.actuators(vehicle),
            constraints=table.constraints(),
        )

    @property
    def tolerances(self) -> tuple[str, str]:
        """See `CSource`; of thrust [N] and rates [rad/s] as well."""
        if self.commands == ROTORS:
            return "1e-9", "2.0"
        return "1e-9", "0.05"

    @property
    def defines(self) -> str:
        """See `CSource`: with its sizes, of which alone the kernel then has code."""
        struct = self.law.program.struct
        return f"{super().defines} -DQUADSIM_SIZES={struct.actuators},{int(struct.moves > 0)}".strip()

    @property
    def rows(self) -> int:
        """See `CSource`."""
        program = self.law.program
        rows = self.requested_rows
        if rows is None:
            rows = max(FEWEST_ROWS, math.ceil(ROWS_PER_NODE * program.struct.horizon))
        return min(program.most_rows, rows)

    @property
    def reals(self) -> int:
        """See `CSource`."""
        return self.law.memory(self.rows + 1)[0]

    @property
    def ints(self) -> int:
        """See `CSource`."""
        return self.law.memory(self.rows + 1)[1]

    def _model(self) -> LinearModel:
        """The model of level hover."""
        if self.table.commands == ROTORS:
            return hover_model(self.vehicle, self.control_period)
        assert self.table.inner_lag is not None
        return target_model(self.vehicle, self.control_period, self.table.inner_lag)

    def numbers(self, text: CText) -> list[str]:
        """See `CSource`."""
        law = self.law
        prefix = text.prefix
        blocks = self._program_blocks(text)
        blocks += self.body_blocks(text, law.bodies)
        fallback = fallback_numbers(self._model(), self.bounds, self.table.fallback.within({}))
        blocks.append(text.struct("quadsim_fallback", f"{prefix}fallback", **text.initialisers(fallback)))
        addresses = {name: f"&{prefix}{name}" for name in ("problem", *law.bodies, "fallback")}
        if law.delay is not None:
            blocks += self.delay_blocks(text, law.delay, law.delay_bodies)
            addresses["delay"] = f"&{prefix}delay"
        if law.ramp is not None:
            blocks.append(text.struct("quadsim_ramp_numbers", f"{prefix}ramp", **text.mirrored(law.ramp.numbers)))
            addresses["ramp"] = f"&{prefix}ramp"
        members = text.mirrored(law.numbers, addresses, motion=int(self.motion))
        return [*blocks, text.struct("quadsim_nonlinear_numbers", "QUADSIM_CONTROLLER", **members)]

    def _program_blocks(self, text: CText) -> list[str]:
        """Return the quadratic program, with its `quadsim_nmpc_problem` last, after what it points to."""
        program = self.law.program
        prefix = text.prefix
        blocks = []
        pointers = {"terms": f"{prefix}terms"}
        for name, array in program.pointed.items():
            if array.dtype == np.double:
                array = np.clip(array, -NO_BOUND, NO_BOUND)
            blocks.append(text.array(name, array))
            pointers[name] = f"{prefix}{name}"
        terms = program.terms if program.struct.rows else ()
        blocks.append(text.structs("quadsim_nmpc_term", "terms", terms))
        members = text.mirrored(program.struct, pointers, capacity=self.rows + 1, changes=CHANGES)
        blocks.append(text.struct("quadsim_nmpc_problem", f"{prefix}problem", **members))
        return blocks
