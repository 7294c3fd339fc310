"""Export of a scenario's controller as self-contained C99, with a test of its room for active rows."""

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
from quadsim.mpc.export.source import BODY_FILES, CHANGES, DATA, CController, CSource, part
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
"""States of each distance."""


@dataclass(frozen=True, kw_only=True)
class Reach:
    """What was found by states up to the first distance at which one ran out of room.

    Attributes:
        distance: the largest one [m, m/s] up to which none did; 0 where some did at the first.
        drawn: states up to there.
        feasible: those of them that have an optimum.
        beyond: the next distance; None where none was left to try.
        lost: of its states with an optimum, those that ran out of room.
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
    """Cold searches of a linear controller with a room, and a number of changes, of its own; 0 for all that it needs.

    Attitude and yaw are level, rotors hover.
    """

    def __init__(self, controller: CController, room: int, changes: int) -> None:
        problem = controller.law.problem
        self._library = core_library()
        self._shared = CoreProblem(problem)
        struct = self._struct = type(self._shared.struct).from_buffer_copy(self._shared.struct)
        struct.room = room or struct.room
        struct.changes = changes or struct.changes
        self._work = WorkStruct()
        self._memory = np.zeros(self._library.quadsim_work_reals(struct))
        self._library.quadsim_work_start(self._work, struct, self._memory.ctypes.data)
        rest = np.zeros(problem.model.n)
        speeds = np.array(problem.model.u_bar)
        rest[N_STATES:] = speeds[: rest.size - N_STATES]
        self._query = np.zeros((problem.horizon, len(problem.objective.C_r))), rest, speeds, speeds

    def __call__(self, offset: Array) -> bool:
        """See `Solves`."""
        state = self._query[1].copy()
        state[[*POSITION, *VELOCITY]] += offset
        self._library.quadsim_work_reset(self._work)
        addresses = (part.ctypes.data for part in (state, *self._query))
        found: int = self._library.quadsim_optimise(self._work, *addresses)
        return found < len(Method)


def nonlinear_search(controller: CNonlinear, room: int, changes: int) -> Solves:
    """Return the same of a nonlinear controller's first programs, along a reference at rest."""
    law = replace(controller).law
    program = law.program.struct
    hover = law.problem.model.u_bar
    law.resize(room or program.room, changes or program.changes)
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
    """Draw states around a reference at rest, and search with this room and with all that can be needed.

    Position and velocity are uniform within a distance per axis; each search begins without an active set.

    Raises:
        FileError: the library cannot be compiled or loaded.
    """
    rng = np.random.default_rng(0)
    reached = Reach(distance=0.0, drawn=0, feasible=0)
    for distance in DISTANCES:
        feasible = lost = 0
        for offset in rng.uniform(-distance, distance, (draws, 6)):
            if whole(offset):
                feasible += 1
                lost += not limited(offset)
        if lost:
            return replace(reached, beyond=distance, lost=lost)
        reached = Reach(distance=distance, drawn=reached.drawn + draws, feasible=reached.feasible + feasible)
    return reached


WARM: Final = """Solve once before take-off: the first step starts without an active set and takes the most changes of
it.  `quadsim_law_changes(&law)` is the number in each step.

"""
"""What the README says of a solver."""
FACTS: Final = "export.json"
"""File with an export's memory and the range of its room."""


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
    recorded periods.  `export.json` has its memory, and how far from the reference its room for active rows suffices.

    Args:
        scenario: it, or its name or file.
        out: the directory.
        overwrite: whether to replace an earlier output there.
        precision: of all numbers, `double` or `float`.
        target: the machine that its programs are for: `posix`, or `cortex-m7` or `cortex-m4f` on a board that QEMU
            emulates.
        rows: active rows that there is room for; memory grows with the square.  None for 2.56 per step of the
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
    for name, value, allowed in (("precision", precision, get_args(Precision)), ("target", target, tuple(TARGETS))):
        if value not in allowed:
            raise ParameterError("", f"--{name}", value, f"one of {', '.join(allowed)}")
    if rows is not None and rows < 1:
        raise ParameterError("", "--rows", rows, "at least 1")
    scenario = load_scenario(scenario)
    with reserving(out, overwrite=overwrite) as directory:
        controller = c_controller(scenario, precision, rows)
        facts = _facts(controller)
        files = controller.files | programs(controller, TARGETS[target]) | vector_files(record(scenario), controller)
        files["README.md"] = _readme(scenario, controller, room_sentence(facts))
        files[FACTS] = json.dumps(facts, indent=2) + "\n"
        with writing(directory, overwrite=overwrite) as partial:
            for name, text in files.items():
                (partial / name).write_text(text, encoding="utf-8")
    return absolute(out)


def c_controller(scenario: Scenario | Assembly, precision: Precision = "double", rows: int | None = None) -> CSource:
    """The controller's own files, with room for active `rows`; see `export`.

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
        return CController(law=exported_law(scenario), precision=precision, title=title, asked=rows)
    if isinstance(table, Nonlinear) and table.avoidance is not None and (scenario.obstacles or assembly.regions):
        raise ExportError(AVOIDS)
    if table.commands != ROTORS and table.inner_lag is None:
        table = replace(table, inner_lag=assembly.inner_lag)
    shared: dict[str, Any] = {
        **{"vehicle": assembly.vehicle, "control_period": scenario.control_period},
        **{"motion": assembly.motion is not None, "precision": precision, "title": title, "asked": rows},
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
        if controller.commands == ROTORS:
            how = ""
        else:
            how = f' with commands = "{controller.commands}"'
        exported = "exported are unconstrained, constrained, robust, nonlinear, and geometric of rates"
        raise ExportError(f"it is {controller.type!r}{how}; {exported}")
    return exportable(controller, Assembly(scenario).vehicle, scenario.control_period, shapes)


def _facts(controller: CSource) -> dict[str, Any]:
    room = controller.rows + 1
    size = {"precision": controller.precision, "memory_bytes": controller.memory_bytes}
    if isinstance(controller, CGeometric):
        return size
    if isinstance(controller, CNonlinear):
        found = reach(nonlinear_search(controller, 0, 0), nonlinear_search(controller, room, CHANGES), DRAWS // 4)
    else:
        assert isinstance(controller, CController)
        found = reach(LinearSearch(controller, 0, 0), LinearSearch(controller, room, CHANGES))
    return size | {"rows": controller.rows, "reach": asdict(found)}


def room_sentence(facts: Mapping[str, Any]) -> str:
    """Return the memory of the room for active rows, and the distance from the reference up to which it suffices."""
    if "rows" not in facts:
        return f"{facts['memory_bytes']} bytes of memory"
    return f"room for {facts['rows']} active rows, {facts['memory_bytes']} bytes of memory; {Reach(**facts['reach'])}"


def programs(controller: CSource, target: Machine) -> dict[str, str]:
    """Return the files that run the controller on a target, by name."""
    names = ("main.c", "serial.c", "target.h", *target.sources, "LICENSE")
    makefile = f"{target.makefile(controller.defines)}CONTROLLER = {controller.objects}\n{part('Makefile')}"
    return {name: part(name) for name in names} | {"Makefile": makefile}


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
    row = CText(controller.precision).value
    queries = zip(recording.state, recording.acting, recording.command, recording.status.tolist(), strict=True)
    rows = [f"    {{{', '.join(map(row, arrays))}, {status}}}" for *arrays, status in queries]
    path = [f"    {row(reference)}" for reference in recording.path]
    source = [
        '#include "vectors.h"\n',
        "const int quadsim_vectors_count = QUADSIM_VECTORS;\n",
        f"const quadsim_real quadsim_vectors_before[4] = {row(recording.before)};\n",
        f"const quadsim_real quadsim_vectors_path[QUADSIM_VECTORS_ROWS][{recording.path.shape[1]}] = {{",
        ",\n".join(path) + "\n};\n",
        "const struct quadsim_vector quadsim_vectors[QUADSIM_VECTORS] = {",
        ",\n".join(rows) + "\n};\n",
    ]
    sizes = {"@COUNT@": len(rows), "@PATH@": len(path)}
    header = controller.filled(part("vectors.h"))
    for name, size in sizes.items():
        header = header.replace(name, str(size))
    return {"vectors.h": header, "vectors.c": "\n".join(source)}


def _readme(scenario: Scenario, controller: CSource, room: str) -> str:
    precision = controller.precision
    law = controller.law_name
    solves_none = isinstance(controller, CGeometric)
    flags = f"-ffp-contract=off {controller.defines}".strip()
    what = "geometric" if solves_none else "model predictive"
    files = *controller.law_files, *BODY_FILES
    sources = ", ".join(f"`{name}`" for name in files if not name.startswith(("quadsim_guard", law)))
    return f"""# {_title(scenario)}

A {what} controller as C99 in {precision} precision, exported from quadsim: {scenario.controller.type}, to be
called every {scenario.control_period:g} s.  It needs nothing but a compiler: no allocation, no recursion, no global
state, and of the C library `memcpy`, `memmove` and `memset`.

| file | is |
|---|---|
| `{law}.h` | the interface: state order, units, frames |
| `{law}.c`, {sources} | the law, the same for every controller of its kind |
| `quadsim_guard.{{h,c}}` | what is flown without an answer of the law, and the completion of lacking measurements |
| `{DATA}` | this controller's numbers, and the memory that it needs |
| `{FACTS}` | what it takes{"" if solves_none else ", and how far its room for active rows suffices"} |
| `vectors.h`, `vectors.c` | the periods of the flight that it was recorded on, with the exact answers |
| `main.c`, `Makefile` | `make check` runs these periods and compares |
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

{room[0].upper()}{room[1:]}.

{"" if solves_none else WARM}Compile with `{flags}`, as the Makefile does; every processor then gives the same bits.
"""
