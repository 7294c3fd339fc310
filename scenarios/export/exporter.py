"""A scenario's controller as a directory of self-contained C99."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final, get_args

import numpy as np

from mpc.answer import ActuatorBounds
from mpc.export.ctext import number
from mpc.export.source import DATA, HEADER, SOURCE, Precision, data, header, part, solver
from mpc.export.tables import Tables, tables
from mpc.export.targets import TARGETS, Target
from mpc.ocp import Problem
from quadsim.errors import ExportError, ParameterError
from quadsim.outputs import real_path, require_directory, write_text, writing
from quadsim.state import Array
from quadsim.vehicle import Vehicle
from scenarios.api import load
from scenarios.export.record import Recording, record
from scenarios.parts.controllers import make_problem
from scenarios.parts.vehicle import build_vehicle
from scenarios.schema.controller import ConstrainedSpec
from scenarios.schema.scenario import Scenario

KIND: Final = "export"  # what `quadsim.outputs` calls such a directory
EXPORTED: Final = "constrained"


def export(
    scenario: Scenario | str | Path, out: str | Path, *, precision: Precision = "double", target: str = "posix"
) -> Path:
    """Write a scenario's controller as self-contained C99, with the periods of the scenario's flight as test vectors.

    The same scenario gives the same bytes.  No compiler is needed; `make -C DIR check` then compiles it and runs the
    recorded periods.

    Args:
        scenario: it, or its name or file.
        out: the directory; an earlier export there is replaced.
        precision: of all numbers, `double` or `float`.
        target: the machine that its programs are for: `posix`, or `cortex-m7` or `cortex-m4f` on a board that QEMU
            emulates.

    Returns:
        The directory.

    Raises:
        ExportError: this controller cannot be exported; the message says why.
        InputError: something else is wrong with the input.
        OutputError: the directory cannot be written.

    Examples:
        >>> import quadsim
        >>> directory = quadsim.export(quadsim.load("hover", {"duration": 1.0}), "c")  # doctest: +SKIP
    """
    for name, value, allowed in (("precision", precision, get_args(Precision)), ("target", target, tuple(TARGETS))):
        if value not in allowed:
            raise ParameterError("", f"--{name}", value, f"one of {', '.join(allowed)}")
    if not isinstance(scenario, Scenario):
        scenario = load(scenario)
    directory = real_path(out)
    require_directory(directory, KIND)
    files = sources(scenario, precision) | vector_files(record(scenario))
    files |= programs(TARGETS[target])
    with writing(directory, KIND) as partial:
        for name, text in files.items():
            write_text(partial / name, text)
    return directory


def sources(scenario: Scenario, precision: Precision) -> dict[str, str]:
    """The controller's own files, by name, and a README.

    Raises:
        ExportError: this controller cannot be exported.
    """
    vehicle = build_vehicle(scenario)
    found = tables(exported_problem(scenario, vehicle))
    bounds = ActuatorBounds.of_problem(found.problem)
    title = f"{scenario.name}: {scenario.description}" if scenario.description else scenario.name
    text = title.replace("*/", "* /").replace("/*", "/ *").encode("ascii", "backslashreplace").decode()
    return {
        HEADER: header(found, precision=precision, title=text),
        SOURCE: solver(found) + part("answer.c") + part("constrained.c"),
        DATA: data(found, bounds, rests=False),
        "README.md": _readme(text, found, precision),
    }


def programs(target: Target) -> dict[str, str]:
    """What runs the controller on a machine, by file name."""
    names = ("main.c", "serial.c", "target.h", *target.sources, "LICENSE")
    return {name: part(name) for name in names} | {"Makefile": target.makefile + part("Makefile")}


def exported_problem(scenario: Scenario, vehicle: Vehicle) -> Problem:
    """The optimisation of a controller that can be exported.

    Raises:
        ExportError: it cannot.
    """
    spec = scenario.controller
    if not isinstance(spec, ConstrainedSpec):
        raise ExportError(f"its controller is {spec.type!r}; exported are: {EXPORTED}")
    if spec.avoidance is not None and (scenario.obstacles or scenario.regions):
        raise ExportError("its half-spaces around obstacles are others in each period; leave out controller.avoidance")
    return make_problem(spec, vehicle, scenario.control_period)


def vector_files(recording: Recording) -> dict[str, str]:
    """The recorded periods as C, by file name."""
    count = len(recording.state)
    rows = [
        f"    {{{_row(state)}, {_row(acting)}, {_row(command)}, {status}}}"
        for state, acting, command, status in zip(
            recording.state, recording.acting, recording.command, recording.status.tolist(), strict=True
        )
    ]
    path = [f"    {_row(row)}" for row in recording.path]
    source = [
        '#include "vectors.h"\n',
        "#ifdef QUADSIM_FLOAT\n#define R(number) number##F\n#else\n#define R(number) number\n#endif\n",
        "const int quadsim_vectors_count = QUADSIM_VECTORS;\n",
        f"const quadsim_real quadsim_vectors_speeds[4] = {_row(recording.speeds)};\n",
        "const quadsim_real quadsim_vectors_path[QUADSIM_VECTORS_ROWS][4] = {",
        ",\n".join(path) + "\n};\n",
        "const struct quadsim_vector quadsim_vectors[QUADSIM_VECTORS] = {",
        ",\n".join(rows) + "\n};\n",
    ]
    return {"vectors.h": part("vectors.h").replace("@COUNT@", str(count)), "vectors.c": "\n".join(source)}


def _row(numbers: Array) -> str:
    return "{" + ", ".join(map(number, np.ravel(numbers).tolist())) + "}"


def _readme(title: str, found: Tables, precision: Precision) -> str:
    problem, size = found.problem, 8 if precision == "double" else 4
    constants = size * math.ceil(sum(part.responses.size / 2 + part.closed.size + part.K.size for part in found.axes))
    memory = size * found.room * (found.room + 1) // 2
    return f"""# {title}

A model predictive controller as C99, exported from quadsim in {precision} precision: N = {problem.horizon} periods of
{problem.model.period:g} s, {len(found.rows)} rows of constraints in each.  It needs nothing but a compiler: no
allocation, no recursion, no global state, and of the C library `memcpy` and `memset`.

| file | is |
|---|---|
| `{HEADER}` | the interface: state order, units, frames |
| `{SOURCE}`, `{DATA}` | the controller and its numbers |
| `vectors.h`, `vectors.c` | the periods of the flight that it was recorded on |
| `main.c`, `Makefile` | `make check` runs these periods and compares |
| `serial.c` | the controller behind a serial line, with checksums and a watchdog: a start for an integration |
| `target.h` and what implements it | the clock, the console and the serial line that these two need of a machine |

```c
static quadsim_mpc mpc;
quadsim_mpc_reset(&mpc, speeds);          /* the command in force */
/* every {problem.model.period:g} s: */
status = quadsim_mpc_step(&mpc, state, reference, acting, command);
```

The struct takes some {memory // 1000} kB, the constants {constants // 1000} kB, which can stay in flash.
Solve once before take-off: the first step starts without an active set and takes the most changes of it.
`mpc.changes` says how many each step took.
"""
