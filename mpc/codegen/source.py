"""The C files of a controller: the core's sources, verbatim, and one file of its numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from typing import Final

from mpc.answer import ActuatorBounds
from mpc.codegen.ctext import CText, Precision
from mpc.core.numbers import Exportable, controller_numbers, fallback_numbers, robust_numbers
from mpc.core.solver import core_problem
from mpc.core.tables import Tables, members
from mpc.model import hover_model
from mpc.robust.settings import split_delay
from quadsim.vehicle import N_ROTORS

CORE_FILES: Final = (
    *("quadsim_core.h", "quadsim_core.c", "quadsim_math.h"),
    *("quadsim_mpc.h", "quadsim_mpc.c", "quadsim_guard.h", "quadsim_guard.c"),
)
"""Files of `mpc/core/c` to export verbatim."""
BODY_FILES: Final = ("quadsim_rigid.h",)
"""Files of `quadsim/core` to export verbatim."""
DATA: Final = "quadsim_data.h"
"""The generated file."""
CHANGES: Final = 500
"""Limit of active-set changes in a search."""
ROWS_PER_STEP: Final = 2.56
"""Capacity for active rows, per step of the horizon."""
LEAST_ROWS: Final = 64


def part(name: str, package: str = "mpc.codegen") -> str:
    """Return a hand-written C source of a package."""
    return (resources.files(package) / "c" / name).read_text(encoding="utf-8")


@dataclass(frozen=True, kw_only=True)
class CController:
    """A controller as C source."""

    law: Exportable  # the law to export
    precision: Precision = "double"  # of all numbers
    title: str = ""  # a line that identifies it, in ASCII
    asked: int | None = None  # active rows with room; None for 2.56 per step of the horizon, and at least 64

    @cached_property
    def tables(self) -> Tables:
        """The numbers of its problem."""
        return core_problem(self.law.problem).tables

    @property
    def rows(self) -> int:
        """Capacity for active rows."""
        N = self.law.problem.horizon
        usual = max(LEAST_ROWS, math.ceil(ROWS_PER_STEP * N))
        return min(N * len(self.tables.rows), usual if self.asked is None else self.asked)

    @property
    def reals(self) -> int:
        """Numbers of memory needed, as counted by `quadsim_mpc_reals`."""
        N, problem, room = self.law.problem.horizon, self.tables.problem, self.rows + 1
        rows = N * len(self.tables.rows)
        packed = 4 * room + 3 * rows  # bytes of integers
        widest = max(len(axis.B) for axis in self.tables.axes)
        work = N * (5 * N_ROTORS + widest) + 3 * rows + 6 * room + room * (room - 1) // 2
        settings, period = self.law.settings, self.law.problem.model.period
        sent = 0 if settings is None else N_ROTORS * split_delay(settings.delay, period)[0]
        return work + packed // self.real_bytes + 1 + N * (len(problem.objective.C_r) + N_ROTORS) + sent

    @property
    def real_bytes(self) -> int:
        """Size of a number in bytes."""
        return 8 if self.precision == "double" else 4

    @cached_property
    def files(self) -> dict[str, str]:
        """Its C files, by name."""
        body = {name: (resources.files("quadsim.core") / name).read_text(encoding="utf-8") for name in BODY_FILES}
        return {name: part(name, "mpc.core") for name in CORE_FILES} | body | {DATA: self._data()}

    def _data(self) -> str:
        text = CText(self.precision, "quadsim_data_")
        head = part(DATA).replace("@TITLE@", self.title).replace("@PERIOD@", f"{self.law.problem.model.period:g}")
        for name, value in {
            "@IFN@": "ifdef" if self.precision == "double" else "ifndef",
            "@PRECISION@": self.precision,
            "@HORIZON@": self.law.problem.horizon,
            "@MEMORY@": self.reals,
        }.items():
            head = head.replace(name, str(value))
        numbers = problem_data(text, self.tables, self.rows + 1)
        return head.replace("@NUMBERS@\n", "\n".join([*numbers, *_controller(text, self.law, self.tables)]))


def problem_data(text: CText, tables: Tables, room: int) -> list[str]:
    """Return the optimisation's numbers, with its `quadsim_problem` last."""
    blocks, entries = text.members(members(tables, room=room, changes=CHANGES))
    return [*blocks, text.struct("quadsim_problem", f"{text.prefix}problem", **entries)]


def _controller(text: CText, law: Exportable, tables: Tables) -> list[str]:
    """Return the numbers apart from those of the optimisation, with the `quadsim_controller` last."""
    numbers, robust = controller_numbers(law), "NULL"
    problem = law.problem
    bounds = ActuatorBounds.of_problem(problem) if problem.every_constraint else None
    model = hover_model(law.vehicle, problem.model.period)
    members = fallback_numbers(model, bounds, law.fallback, problem.horizon)
    fallback = {name: text.value(value) for name, value in members.items()}
    blocks = [
        text.array("C_r", numbers.pop("C_r")),
        text.struct("quadsim_fallback", f"{text.prefix}fallback", **fallback),
    ]
    if law.settings is not None:
        values = {name: text.value(value) for name, value in robust_numbers(law, tables.modes).items()}
        blocks.append(text.struct("quadsim_robust", f"{text.prefix}robust", **values))
        robust = f"&{text.prefix}robust"
    addresses = {
        "problem": f"&{text.prefix}problem",
        "robust": robust,
        "fallback": f"&{text.prefix}fallback",
        "C_r": f"{text.prefix}C_r",
    }
    limits = {name: text.value(value) for name, value in numbers.items()}
    return [*blocks, text.struct("quadsim_controller", "QUADSIM_CONTROLLER", **addresses, **limits)]
