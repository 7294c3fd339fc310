"""The C files of a controller: the core's sources, verbatim, and one generated file of its numbers.

`CSource` is any controller as C, `CController` a linear one; the nonlinear and the geometric controller have modules of
their own.  The files are templates with names between @, filled here; numbers are written by `ctext`.
"""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from typing import ClassVar, Final

from quadsim.controller import ROTORS
from quadsim.mpc.export.ctext import CText, Precision
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.guard.numbers import fallback_numbers
from quadsim.mpc.laws.parts.numbers import Exportable, controller_numbers, robust_numbers
from quadsim.mpc.problem.model import hover_model, split_delay
from quadsim.mpc.solvers.core import core_problem
from quadsim.mpc.solvers.core_tables import Tables, members
from quadsim.state import N_STATES, REFERENCE_STATES
from quadsim.vehicle import N_ROTORS

SHARED_FILES: Final = ("quadsim_core.h", "quadsim_math.h", "quadsim_guard.h", "quadsim_guard.c")
"""Files of `quadsim/mpc/c` that every controller takes."""
CORE_FILES: Final = (*SHARED_FILES, "quadsim_core.c", "quadsim_mpc.h", "quadsim_mpc.c")
"""Those of the linear controllers."""
BODY_FILES: Final = ("quadsim_rigid.h",)
"""Files of `quadsim/core` to export verbatim, for every controller."""
DATA_FILE: Final = "quadsim_data.h"
"""The generated file."""
CHANGES: Final = 500
"""Limit of active-set changes in a search."""
ROWS_PER_STEP: Final = 2.56
"""Capacity for active rows, per step of the horizon."""
LEAST_ROWS: Final = 64


def c_source(name: str, package: str = "quadsim.mpc.export") -> str:
    """Return a hand-written C source of a package."""
    return (resources.files(package) / "c" / name).read_text(encoding="utf-8")


@dataclass(frozen=True, kw_only=True)
class CSource(abc.ABC):
    """A controller as C source: the files of its law, verbatim, and one of its numbers."""

    precision: Precision = "double"  # of all numbers
    title: str = ""  # a line that identifies it, in ASCII
    requested_rows: int | None = None  # active rows to have memory for; None for a number that usually suffices

    law_name: ClassVar[str]
    """Header of its law, and first word of its functions."""
    law_files: ClassVar[tuple[str, ...]]
    """Files of `quadsim/mpc/c` to export verbatim."""
    state: ClassVar[int] = N_STATES
    """Numbers of a measured state."""
    plan: ClassVar[str] = "law->work.plan"
    changes: ClassVar[str] = "law->work.changes"

    @property
    @abc.abstractmethod
    def period(self) -> float:
        """The control period [s]."""

    @property
    @abc.abstractmethod
    def horizon(self) -> int:
        """Periods of the plan."""

    @property
    @abc.abstractmethod
    def bounds(self) -> ActuatorBounds | None:
        """Bounds on its commands; None for none."""

    @property
    def tolerances(self) -> tuple[str, str]:
        """Of recorded commands, in doubles and in floats."""
        return "1e-8", "6e-2"

    @property
    def commands(self) -> str:
        """What it commands: rotor speeds, or the targets of an autopilot by name."""
        return ROTORS

    @property
    def motion_rows(self) -> int:
        """Samples of a motion that are its reference; 0 of a preview."""
        return 0

    @property
    def reference(self) -> tuple[int, int, str]:
        """Rows of a reference, numbers of a row, and what they are."""
        return self.horizon, len(REFERENCE_STATES), "x y z yaw"

    @property
    @abc.abstractmethod
    def rows(self) -> int:
        """Capacity for active rows."""

    @property
    @abc.abstractmethod
    def reals(self) -> int:
        """Numbers of memory needed."""

    @property
    def ints(self) -> int:
        """Integers of memory needed."""
        return 0

    @property
    def real_bytes(self) -> int:
        """Size of a number in bytes."""
        if self.precision == "double":
            return 8
        return 4

    @property
    def memory_bytes(self) -> int:
        """Memory needed, in bytes."""
        return self.reals * self.real_bytes + 4 * self.ints

    @abc.abstractmethod
    def numbers(self, text: CText) -> list[str]:
        """Return the generated numbers, with `QUADSIM_CONTROLLER` last."""

    @cached_property
    def files(self) -> dict[str, str]:
        """Its C files, by name."""
        files = {}
        for name in self.law_files:
            files[name] = c_source(name, "quadsim.mpc")
        for name in BODY_FILES:
            files[name] = (resources.files("quadsim.core") / name).read_text(encoding="utf-8")
        files[DATA_FILE] = self.filled(c_source(DATA_FILE))
        return files

    @property
    def defines(self) -> str:
        """Flags of a compiler that its files take."""
        if self.precision == "float":
            return "-DQUADSIM_FLOAT"
        return ""

    @property
    def objects(self) -> str:
        """Its object files, as the Makefile lists them."""
        objects = []
        for name in self.law_files:
            if name.endswith(".c"):
                objects.append(name.replace(".c", ".o"))
        return " ".join(sorted(objects))

    def filled(self, template: str) -> str:
        """Fill in the names between @ of a C file."""
        rows, width, what = self.reference
        law = self.law_name
        wrong_precision = "ifndef"  # of QUADSIM_FLOAT, with which the file does not compile
        if self.precision == "double":
            wrong_precision = "ifdef"
        integer_member = ""
        integer_argument = ""
        fits = f"{law}_reals(&QUADSIM_CONTROLLER) == QUADSIM_MEMORY"
        if self.ints:
            integer_member = f"    int ints[{self.ints}];\n"
            integer_argument = ", memory->ints"
            fits += f" && {law}_ints(&QUADSIM_CONTROLLER) == {self.ints}"
        values = {
            "LAW": law,
            "TITLE": self.title,
            "PERIOD": f"{self.period:g}",
            "IFN": wrong_precision,
            "PRECISION": self.precision,
            "HORIZON": self.horizon,
            "STATE": self.state,
            "ROWS": rows,
            "ROW": width,
            "REFERENCE": what,
            "MEMORY": self.reals,
            "INTS": integer_member,
            "MORE": integer_argument,
            "FITS": fits,
            "PLAN": self.plan,
            "CHANGES": self.changes,
            "DOUBLE_TOLERANCE": self.tolerances[0],
            "FLOAT_TOLERANCE": self.tolerances[1],
        }
        if "@NUMBERS@" in template:
            numbers = self.numbers(CText(self.precision, "quadsim_data_"))
            template = template.replace("@NUMBERS@\n", "\n".join(numbers))
        for key, value in values.items():
            template = template.replace(f"@{key}@", str(value))
        return template


@dataclass(frozen=True, kw_only=True)
class CController(CSource):
    """A linear controller as C source, with memory for 2.56 active rows per step of the horizon, at least for 64."""

    law: Exportable  # the law to export

    law_name = "quadsim_mpc"
    law_files = CORE_FILES

    @property
    def period(self) -> float:
        """See `CSource`."""
        return self.law.problem.model.period

    @property
    def horizon(self) -> int:
        """See `CSource`."""
        return self.law.problem.horizon

    @property
    def bounds(self) -> ActuatorBounds | None:
        """See `CSource`."""
        problem = self.law.problem
        if problem.every_constraint:
            return ActuatorBounds.of_problem(problem)
        return None

    @cached_property
    def tables(self) -> Tables:
        """The numbers of its problem."""
        return core_problem(self.law.problem).tables

    @property
    def rows(self) -> int:
        """See `CSource`."""
        rows = self.requested_rows
        if rows is None:
            rows = max(LEAST_ROWS, math.ceil(ROWS_PER_STEP * self.horizon))
        return min(self.horizon * len(self.tables.rows), rows)

    @property
    def reals(self) -> int:
        """See `CSource`: as counted by `quadsim_mpc_reals`."""
        N = self.horizon
        objective = self.tables.problem.objective
        capacity = self.rows + 1
        rows = N * len(self.tables.rows)
        widest = max(len(axis.B) for axis in self.tables.axes)
        work = N * (5 * N_ROTORS + widest) + 3 * rows + 6 * capacity + capacity * (capacity - 1) // 2
        integer_bytes = 4 * capacity + 3 * rows
        packed = integer_bytes // self.real_bytes + 1
        goals_and_plan = N * (len(objective.C_r) + N_ROTORS)
        sent = 0  # commands that do not act yet
        settings = self.law.settings
        if settings is not None:
            delayed_periods, _ = split_delay(settings.delay, self.law.problem.model.period)
            sent = N_ROTORS * delayed_periods
        return work + packed + goals_and_plan + sent

    def numbers(self, text: CText) -> list[str]:
        """See `CSource`."""
        optimisation = problem_data(text, self.tables, self.rows + 1)
        return [*optimisation, *_controller(text, self.law, self.bounds)]


def problem_data(text: CText, tables: Tables, capacity: int) -> list[str]:
    """Return the optimisation's numbers, with its `quadsim_problem` last."""
    blocks, entries = text.members(members(tables, capacity=capacity, changes=CHANGES))
    return [*blocks, text.struct("quadsim_problem", f"{text.prefix}problem", **entries)]


def _controller(text: CText, law: Exportable, bounds: ActuatorBounds | None) -> list[str]:
    """Return the numbers apart from those of the optimisation, with the `quadsim_controller` last."""
    problem = law.problem
    addresses = {
        "problem": f"&{text.prefix}problem",
        "robust": "NULL",
        "fallback": f"&{text.prefix}fallback",
    }
    model = hover_model(law.vehicle, problem.model.period)
    fallback = fallback_numbers(model, bounds, law.fallback)
    blocks = [text.struct("quadsim_fallback", f"{text.prefix}fallback", **text.initialisers(fallback))]
    if law.settings is not None:
        robust = robust_numbers(law.settings, law.vehicle, problem.model.period)
        blocks.append(text.struct("quadsim_robust", f"{text.prefix}robust", **text.initialisers(robust)))
        addresses["robust"] = f"&{text.prefix}robust"
    limits = text.initialisers(controller_numbers(problem))
    return [*blocks, text.struct("quadsim_controller", "QUADSIM_CONTROLLER", **addresses, **limits)]
