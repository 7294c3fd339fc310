"""Export of a scenario's controller as self-contained C99, with a test of its capacity for active rows.

`quadsim.mpc.export` has the controller's files and numbers, `record` the periods of a flight as test vectors; here they
become a directory.  The memory is sized for some active rows: `reach` draws states around the reference, and finds from
how far away the capacity still suffices for the exact optimum.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, get_args

import numpy as np

from quadsim.controller import ROTORS
from quadsim.core.mirror import core_library
from quadsim.errors import ExportError, ParameterError
from quadsim.features.export.record import Recording, record
from quadsim.mpc.export.ctext import CText, Precision
from quadsim.mpc.export.geometric import CGeometric
from quadsim.mpc.export.nonlinear import CNonlinear
from quadsim.mpc.export.source import BODY_FILES, CHANGES, DATA_FILE, CController, CSource, c_source
from quadsim.mpc.export.targets import TARGETS, Machine
from quadsim.mpc.laws.geometric import Geometric
from quadsim.mpc.laws.nonlinear import Nonlinear
from quadsim.mpc.laws.parts.numbers import AVOIDS, Exportable, exportable
from quadsim.mpc.laws.parts.sqp import SQPStatus
from quadsim.mpc.problem.rigidbody import N_BODY, P, V
from quadsim.mpc.solvers import Method
from quadsim.mpc.solvers.core import CoreProblem, WorkStruct
from quadsim.mpc.tables.bounded import Weighted
from quadsim.outputs import absolute, reserving, writing
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import N_STATES, POSITION, VELOCITY, Array

DISTANCES: Final = (0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Per axis [m], and speeds per axis [m/s]."""
DRAWS: Final = 200
"""States that are drawn at each distance."""


@dataclass(frozen=True, kw_only=True)
class Reach:
    """How far from the reference the capacity for active rows suffices, of states that were drawn around it.

    Attributes:
        distance: the largest one [m, m/s] up to which it did for every state; 0 where it did not at the first.
        drawn: states up to there.
        feasible: those of them that have an optimum.
        beyond: the next distance; None where none was left to try.
        lost: of its states with an optimum, those for which the capacity did not suffice.
    """

    distance: float
    drawn: int
    feasible: int
    beyond: float | None = None
    lost: int = 0

    def __str__(self) -> str:
        if self.drawn == 0:
            draws = DRAWS
        else:
            draws = self.drawn // (1 + DISTANCES.index(self.distance))
        sufficed = f"up to {self.distance:g} m and m/s per axis it sufficed for all {self.feasible} feasible states"
        if self.beyond is None:
            return f"{sufficed} of {self.drawn} drawn"
        return f"{sufficed} of {self.drawn} drawn, at {self.beyond:g} it lacked for {self.lost} of {draws}"


Solves = Callable[[Array], bool]
"""Whether a search from a state (6,) off a reference at rest finds an optimum: position [m], velocity [m/s]."""


class LinearSearch:
    """Cold searches of a linear controller, with a capacity for active rows and a limit of changes; 0 for all it needs.

    Attitude and yaw are level, rotors hover.
    """

    def __init__(self, controller: CController, capacity: int, changes: int) -> None:
        problem = controller.law.problem
        self._library = core_library()
        self._shared = CoreProblem(problem)  # has the arrays that the struct points to
        self._struct = type(self._shared.struct).from_buffer_copy(self._shared.struct)
        self._struct.capacity = capacity or self._struct.capacity
        self._struct.changes = changes or self._struct.changes
        self._work = WorkStruct()
        self._memory = np.zeros(self._library.quadsim_work_reals(self._struct))
        self._library.quadsim_work_start(self._work, self._struct, self._memory.ctypes.data)
        self._desired = np.zeros((problem.horizon, len(problem.objective.C_r)))
        self._hover_speeds = np.array(problem.model.u_bar)
        self._rest = np.zeros(problem.model.n)
        self._rest[N_STATES:] = self._hover_speeds[: self._rest.size - N_STATES]

    def __call__(self, offset: Array) -> bool:
        """See `Solves`."""
        state = self._rest.copy()
        state[[*POSITION, *VELOCITY]] += offset
        self._library.quadsim_work_reset(self._work)
        method: int = self._library.quadsim_optimise(
            self._work,
            state.ctypes.data,
            self._desired.ctypes.data,
            self._rest.ctypes.data,
            self._hover_speeds.ctypes.data,
            self._hover_speeds.ctypes.data,
        )
        return method < len(Method)


def nonlinear_search(controller: CNonlinear, capacity: int, changes: int) -> Solves:
    """Return the same of a nonlinear controller's first programs, along a reference at rest."""
    law = replace(controller).law
    program = law.program.struct
    hover = law.problem.model.u_bar
    law.resize(capacity or program.capacity, changes or program.changes)
    states = np.zeros((program.horizon + 1, N_BODY))
    thrusts = np.tile(np.array(law.numbers.lifts), (program.horizon, 1))
    states[:, 3] = 1.0

    def solves(offset: Array) -> bool:
        measured = np.concatenate([states[0], hover[: program.actuators]])
        measured[P] = offset[:3]
        measured[V] = offset[3:]
        law.stored_plan = None
        return law.solve(measured, hover, states, thrusts) <= SQPStatus.UNCONVERGED

    return solves


def reach(whole: Solves, limited: Solves, draws: int = DRAWS) -> Reach:
    """Draw states around a reference at rest, and search with a limited capacity and with all that can be needed.

    Position and velocity are uniform within a distance per axis; each search begins without an active set.

    Raises:
        FileError: the library cannot be compiled or loaded.
    """
    rng = np.random.default_rng(0)
    reached = Reach(distance=0.0, drawn=0, feasible=0)
    for distance in DISTANCES:
        feasible = 0
        lost = 0
        for offset in rng.uniform(-distance, distance, (draws, 6)):
            if whole(offset):
                feasible += 1
                if not limited(offset):
                    lost += 1
        if lost:
            return replace(reached, beyond=distance, lost=lost)
        reached = Reach(distance=distance, drawn=reached.drawn + draws, feasible=reached.feasible + feasible)
    return reached


WARM: Final = """Solve once before take-off: the first step starts without an active set and takes the most changes of
it.  `quadsim_law_changes(&law)` is the number in each step.

"""
"""What the README says of a controller that solves an optimisation."""
FACTS: Final = "export.json"
"""File with an export's memory, and from how far away its capacity suffices."""


def export(
    scenario: Scenario | str | Path,
    out: str | Path,
    *,
    overwrite: bool = False,
    precision: Precision = "double",
    target: str = "posix",
    rows: int | None = None,
) -> Path:
    """Write a scenario's controller as self-contained C99, with the periods of the scenario's flight as test vectors.

    The same scenario gives the same bytes.  No compiler is needed; `make -C DIR check` then compiles it and runs the
    recorded periods.  `export.json` has its memory, and how far from the reference its capacity suffices.

    Args:
        scenario: it, or its name or file.
        out: the directory.
        overwrite: whether to replace an earlier output there.
        precision: of all numbers, `double` or `float`.
        target: the machine that its programs are for: `posix`, or `cortex-m7` or `cortex-m4f` on a board that QEMU
            emulates.
        rows: capacity for active rows; memory grows with the square.  None for 2.56 per step of the
            horizon, and at least 64.

    Returns:
        The directory.

    Raises:
        ExportError: this controller cannot be exported; the message gives the reason.
        InputError: something else is wrong with the input.
        OutputError: the directory cannot be written.

    Examples:
        >>> import quadsim
        >>> directory = quadsim.export(quadsim.load("hover", {"duration": 1.0}), "c")  # doctest: +SKIP
    """
    precisions = get_args(Precision)
    if precision not in precisions:
        raise ParameterError("", "--precision", precision, f"one of {', '.join(precisions)}")
    if target not in TARGETS:
        raise ParameterError("", "--target", target, f"one of {', '.join(TARGETS)}")
    if rows is not None and rows < 1:
        raise ParameterError("", "--rows", rows, "at least 1")
    scenario = load_scenario(scenario)
    with reserving(out, overwrite=overwrite) as directory:
        controller = c_controller(scenario, precision, rows)
        facts = _facts(controller)
        files = dict(controller.files)
        files |= programs(controller, TARGETS[target])
        files |= vector_files(record(scenario), controller)
        files["README.md"] = _readme(scenario, controller, memory_sentence(facts))
        files[FACTS] = json.dumps(facts, indent=2) + "\n"
        with writing(directory, overwrite=overwrite) as partial:
            for name, text in files.items():
                (partial / name).write_text(text, encoding="utf-8")
    return absolute(out)


def c_controller(scenario: Scenario | Assembly, precision: Precision = "double", rows: int | None = None) -> CSource:
    """The controller's own files, with memory for some active `rows`; see `export`.

    Raises:
        ExportError: this controller cannot be exported.
    """
    if isinstance(scenario, Assembly):
        assembly = scenario
    else:
        assembly = Assembly(scenario)
    scenario = assembly.scenario
    table = scenario.controller
    title = _title(scenario)
    if not isinstance(table, Nonlinear | Geometric):
        return CController(law=exported_law(scenario), precision=precision, title=title, requested_rows=rows)
    if isinstance(table, Nonlinear) and table.avoidance is not None and (scenario.obstacles or assembly.regions):
        raise ExportError(AVOIDS)
    if table.commands != ROTORS and table.inner_lag is None:
        table = replace(table, inner_lag=assembly.inner_lag)
    shared: dict[str, Any] = {
        "vehicle": assembly.vehicle,
        "control_period": scenario.control_period,
        "motion": assembly.motion is not None,
        "precision": precision,
        "title": title,
        "requested_rows": rows,
    }
    if isinstance(table, Geometric):
        if rows is not None:
            raise ParameterError("", "--rows", rows, "left out: a geometric controller solves no problem")
        return CGeometric(table=table, **shared)
    return CNonlinear(table=table, **shared)


def exported_law(scenario: Scenario) -> Exportable:
    """Return the exported linear controller: that of the scenario without its guards.

    Raises:
        ExportError: it cannot be exported.
    """
    controller = scenario.controller
    shapes = (*scenario.obstacles, *scenario.regions)
    if not isinstance(controller, Weighted):
        refused = f"it is {controller.type!r}"
        if controller.commands != ROTORS:
            refused += f' with commands = "{controller.commands}"'
        exported = "exported are unconstrained, constrained, robust, nonlinear, and geometric of rates"
        raise ExportError(f"{refused}; {exported}")
    return exportable(controller, Assembly(scenario).vehicle, scenario.control_period, shapes)


def _facts(controller: CSource) -> dict[str, Any]:
    """Return the contents of `export.json`."""
    facts: dict[str, Any] = {"precision": controller.precision, "memory_bytes": controller.memory_bytes}
    if isinstance(controller, CGeometric):
        return facts
    capacity = controller.rows + 1
    if isinstance(controller, CNonlinear):
        whole: Solves = nonlinear_search(controller, 0, 0)
        reached = reach(whole, nonlinear_search(controller, capacity, CHANGES), DRAWS // 4)
    else:
        assert isinstance(controller, CController)
        reached = reach(LinearSearch(controller, 0, 0), LinearSearch(controller, capacity, CHANGES))
    facts["rows"] = controller.rows
    facts["reach"] = asdict(reached)
    return facts


def memory_sentence(facts: Mapping[str, Any]) -> str:
    """Return the memory, and the distance from the reference up to which its capacity for active rows suffices."""
    if "rows" not in facts:
        return f"{facts['memory_bytes']} bytes of memory"
    return (
        f"capacity for {facts['rows']} active rows, {facts['memory_bytes']} bytes of memory; {Reach(**facts['reach'])}"
    )


def programs(controller: CSource, target: Machine) -> dict[str, str]:
    """Return the files that run the controller on a target, by name."""
    files = {}
    for name in ("main.c", "serial.c", "target.h", *target.sources, "LICENSE"):
        files[name] = c_source(name)
    settings = target.makefile(controller.defines)
    files["Makefile"] = f"{settings}CONTROLLER = {controller.objects}\n{c_source('Makefile')}"
    return files


def _title(scenario: Scenario) -> str:
    """The scenario's name and description as they can stand in a comment."""
    if scenario.description:
        title = f"{scenario.name}: {scenario.description}"
    else:
        title = scenario.name
    title = title.replace("*/", "* /").replace("/*", "/ *").replace("\\", "/")
    return title.encode("ascii", "replace").decode().replace("\n", " ")


def vector_files(recording: Recording, controller: CSource) -> dict[str, str]:
    """The recorded periods as C, by file name."""
    text = CText(controller.precision)
    periods = []
    for state, acting, command, status in zip(
        recording.state, recording.acting, recording.command, recording.status.tolist(), strict=True
    ):
        periods.append(f"    {{{text.value(state)}, {text.value(acting)}, {text.value(command)}, {status}}}")
    path = [f"    {text.value(reference)}" for reference in recording.path]
    source = [
        '#include "vectors.h"\n',
        "const int quadsim_vectors_count = QUADSIM_VECTORS;\n",
        f"const quadsim_real quadsim_vectors_before[4] = {text.value(recording.before)};\n",
        f"const quadsim_real quadsim_vectors_path[QUADSIM_VECTORS_ROWS][{recording.path.shape[1]}] = {{",
        ",\n".join(path) + "\n};\n",
        "const struct quadsim_vector quadsim_vectors[QUADSIM_VECTORS] = {",
        ",\n".join(periods) + "\n};\n",
    ]
    header = controller.filled(c_source("vectors.h"))
    header = header.replace("@COUNT@", str(len(periods))).replace("@PATH@", str(len(path)))
    return {"vectors.h": header, "vectors.c": "\n".join(source)}


def _readme(scenario: Scenario, controller: CSource, memory: str) -> str:
    """Return the README of an export; `memory` is the sentence on it."""
    precision = controller.precision
    law = controller.law_name
    flags = f"-ffp-contract=off {controller.defines}".strip()
    if isinstance(controller, CGeometric):
        kind = "geometric"
        facts = "what it takes"
        warm = ""
    else:
        kind = "model predictive"
        facts = "what it takes, and how far its capacity for active rows suffices"
        warm = WARM
    further = []
    for name in (*controller.law_files, *BODY_FILES):
        if not name.startswith(("quadsim_guard", law)):
            further.append(f"`{name}`")
    sources = ", ".join(further)
    return f"""# {_title(scenario)}

A {kind} controller as C99 in {precision} precision, exported from quadsim: {scenario.controller.type}, to be
called every {scenario.control_period:g} s.  It needs nothing but a compiler: no allocation, no recursion, no global
state, and of the C library `memcpy`, `memmove` and `memset`.

| file | is |
|---|---|
| `{law}.h` | the interface: state order, units, frames |
| `{law}.c`, {sources} | the law, the same for every controller of its kind |
| `quadsim_guard.{{h,c}}` | what is flown without an answer of the law, and the completion of lacking measurements |
| `{DATA_FILE}` | this controller's numbers, and the memory that it needs |
| `{FACTS}` | {facts} |
| `vectors.h`, `vectors.c` | the periods of the flight that it was recorded on, with the exact answers |
| `main.c`, `Makefile` | `make check` runs these periods, compares, and prints those that differ |
| `serial.c` | the controller behind a serial line, with checksums and a watchdog: a start for an integration |
| `target.h` and what implements it | the clock, the console and the serial line that these two need of a machine |

```c
static quadsim_law law;
static quadsim_memory memory;
quadsim_law_start(&law, &memory);
quadsim_law_reset(&law, before);          /* the command in force */
/* every {scenario.control_period:g} s: */
status = quadsim_law_step(&law, QUADSIM_PHASE_FLYING, state, reference, acting, command);
```

{memory[0].upper()}{memory[1:]}.

{warm}Compile with `{flags}`, as the Makefile does; every processor then gives the same bits.
"""
