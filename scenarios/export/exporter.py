"""A scenario's controller as a directory of self-contained C99."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np

from mpc.export.ctext import number
from mpc.export.source import DATA, HEADER, SOURCE, Exportable, Precision, part, sources
from mpc.export.targets import TARGETS, Target
from quadsim.errors import ParameterError
from quadsim.outputs import absolute, reserving, writing
from quadsim.state import Array
from scenarios.export.record import Recording, record
from scenarios.loading import as_scenario
from scenarios.parts.controllers import exportable
from scenarios.parts.vehicle import build_vehicle
from scenarios.schema.scenario import Scenario


def export(
    scenario: Scenario | str | Path,
    out: str | Path,
    *,
    overwrite: bool = False,
    precision: Precision = "double",
    target: str = "posix",
) -> Path:
    """Write a scenario's controller as self-contained C99, with the periods of the scenario's flight as test vectors.

    The same scenario gives the same bytes.  No compiler is needed; `make -C DIR check` then compiles it and runs the
    recorded periods.

    Args:
        scenario: it, or its name or file.
        out: the directory.
        overwrite: whether to replace an earlier output there.
        precision: of all numbers, `double` or `float`.
        target: the machine that its programs are for: `posix`, or `cortex-m7` or `cortex-m4f` on a board that QEMU
            emulates.

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
    scenario = as_scenario(scenario)
    with reserving(out, overwrite=overwrite) as directory:
        files = controller_files(scenario, precision) | vector_files(record(scenario))
        files |= {"README.md": _readme(scenario, precision), **programs(TARGETS[target])}
        with writing(directory, overwrite=overwrite) as partial:
            for name, text in files.items():
                (partial / name).write_text(text, encoding="utf-8")
    return absolute(out)


def controller_files(scenario: Scenario, precision: Precision) -> dict[str, str]:
    """The controller's own files, by name.

    Raises:
        ExportError: this controller cannot be exported.
    """
    return sources(exported_law(scenario), precision=precision, title=_title(scenario))


def exported_law(scenario: Scenario) -> Exportable:
    """What is exported: the scenario's controller without what guards it.

    Raises:
        ExportError: it cannot be exported.
    """
    shapes = (*scenario.obstacles, *scenario.regions)
    return exportable(scenario.controller, build_vehicle(scenario), scenario.control_period, shapes)


def programs(target: Target) -> dict[str, str]:
    """What runs the controller on a machine, by file name."""
    names = ("main.c", "serial.c", "target.h", *target.sources, "LICENSE")
    return {name: part(name) for name in names} | {"Makefile": target.makefile + part("Makefile")}


def _title(scenario: Scenario) -> str:
    """The scenario's name and description as they can stand in a comment."""
    title = f"{scenario.name}: {scenario.description}" if scenario.description else scenario.name
    title = title.replace("*/", "* /").replace("/*", "/ *").replace("\\", "/")
    return title.encode("ascii", "replace").decode().replace("\n", " ")


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


def _readme(scenario: Scenario, precision: Precision) -> str:
    return f"""# {_title(scenario)}

A model predictive controller as C99 in {precision} precision, exported from quadsim: {scenario.controller.type}, to be
called every {scenario.control_period:g} s.  It needs nothing but a compiler: no allocation, no recursion, no global
state, and of the C library `memcpy` and `memset`.

| file | is |
|---|---|
| `{HEADER}` | the interface: state order, units, frames, and the sizes |
| `{SOURCE}`, `{DATA}` | the controller and its numbers |
| `vectors.h`, `vectors.c` | the periods of the flight that it was recorded on, with the exact answers |
| `main.c`, `Makefile` | `make check` runs these periods and compares |
| `serial.c` | the controller behind a serial line, with checksums and a watchdog: a start for an integration |
| `target.h` and what implements it | the clock, the console and the serial line that these two need of a machine |

```c
static quadsim_mpc mpc;
quadsim_mpc_reset(&mpc, speeds);          /* the command in force */
/* every {scenario.control_period:g} s: */
status = quadsim_mpc_step(&mpc, state, reference, acting, command);
```

Solve once before take-off: the first step starts without an active set and takes the most changes of it.
`mpc.changes` is the number in each step.  Compile with `-ffp-contract=off`, and every processor gives the same bits.
"""
