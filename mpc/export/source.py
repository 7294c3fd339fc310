"""The C files of a controller: the solver's sources and its numbers."""

from __future__ import annotations

from importlib import resources
from typing import Final, Literal

import numpy as np

from mpc.answer import ActuatorBounds
from mpc.export.ctext import bounded, lower_packed, number, reals, small_integers, structs
from mpc.export.tables import AxisTables, Tables
from quadsim.state import Array

Precision = Literal["double", "float"]
HEADER: Final = "quadsim_mpc.h"
SOURCE: Final = "quadsim_mpc.c"
DATA: Final = "quadsim_mpc_data.h"


def part(name: str) -> str:
    """A hand-written C source of this package."""
    return (resources.files("mpc.export") / "c" / name).read_text(encoding="utf-8")


def header(found: Tables, *, precision: Precision, title: str, state: str = "") -> str:
    """The interface, with the sizes of the problem and further members of the controller's struct."""
    text = part(HEADER).replace("@TITLE@", title).replace("@PERIOD@", f"{found.problem.model.period:g}")
    real = "double" if precision == "double" else "float"
    return text.replace("@REAL@", real).replace("@SIZES@", _sizes(found, precision)).replace("@STATE@", state)


def solver(found: Tables) -> str:
    """The solver's source, with the dynamic programming of each size of axis."""
    shapes = _shapes(found)
    text = [part("axis.c").replace("@n@", str(n)).replace("@m@", str(m)) for n, m in shapes]
    cases = []
    for shape, (n, m) in enumerate(shapes):
        cases.append(f"    case {shape}:" if shape < len(shapes) - 1 else "    default:")
        cases.append(f"        plan_backwards_{n}x{m}(axis, pull, push, w);")
        cases.append(f"        plan_forwards_{n}x{m}(axis, start, w, values);")
        cases.append("        break;")
    plan = (
        "\n/* The optimum w [N][m] of an axis without rows, from x(k), and the values [N][M] of its rows' C x. */\n"
        "static void plan(const struct axis *axis, const real *pull, const real *push, const real *start, real *w,\n"
        "                 real *values)\n{\n    switch (axis->shape) {\n" + "\n".join(cases) + "\n    }\n}\n"
    )
    return part("solver.c").replace("@AXES@\n", "".join([*text, plan]))


def _shapes(found: Tables) -> list[tuple[int, int]]:
    """The sizes (n, m) of axes, each once."""
    return list(dict.fromkeys((len(axis.B), axis.inputs) for axis in found.axes))


def _sizes(found: Tables, precision: Precision) -> str:
    widest = max(axis.inputs for axis in found.axes)
    sizes = {
        "HORIZON": (found.problem.horizon, "N, periods of the reference and of the plan"),
        "STATES": (found.problem.model.n, "of the prediction"),
        "STEP_ROWS": (len(found.rows), "rows of constraints in each step"),
        "PARTS": (len(found.axes), "parts that the problem falls into"),
        "AXIS_STATES": (max(1, *(len(axis.B) for axis in found.axes)), "of the largest axis"),
        "AXIS_INPUTS": (widest, "likewise"),
        "ROOM": (found.room, "active rows that there is room for"),
        "ENTRIES": (1 + widest * max((len(row.terms) for row in found.rows), default=0), "of the largest row"),
    }
    lines = [f"#define QUADSIM_{name} {value} /* {meaning} */" for name, (value, meaning) in sizes.items()]
    return "\n".join(["#define QUADSIM_FLOAT 1", *lines] if precision == "float" else lines)


def data(found: Tables, bounds: ActuatorBounds, *, rests: bool) -> str:
    """The numbers, for either precision."""
    model = found.problem.model
    mixed = any(row.axis >= 0 and row.terms for row in found.rows)
    blocks = [
        "/* The numbers of one controller, in one place. */\n",
        f"#define QUADSIM_BOUNDS_DIFFER {int(len(found.lower) > 1)} /* whether steps have bounds of their own */",
        f"#define QUADSIM_MIXED {int(mixed)} /* whether a row has both states and inputs */",
        f"#define QUADSIM_RESTS {int(rests)} /* whether the model rests elsewhere than level */\n",
        reals("T", found.T),
        reals("T_INVERSE", found.T_inverse),
        reals("HOVER", model.u_bar),
        reals("SPEED_MIN", bounds.u_min),
        reals("SPEED_MAX", bounds.u_max),
        reals("STEP_MIN", bounded(bounds.delta_min)),
        reals("STEP_MAX", bounded(bounds.delta_max)),
        reals("LOWER", bounded(found.lower)),
        reals("UPPER", bounded(found.upper)),
        reals("SCALE", found.scale),
        reals("TOLERANCE", found.tolerance),
    ]
    for g, axis in enumerate(found.axes):
        blocks += _axis_arrays(g, axis)
    blocks += [structs("axis", "AXES", (_axis(g, axis, _shapes(found)) for g, axis in enumerate(found.axes))), *_rows(found)]
    return "\n".join(blocks)


def _axis_arrays(g: int, axis: AxisTables) -> list[str]:
    return [
        small_integers(f"STATE_{g}", axis.states),
        small_integers(f"TARGET_{g}", axis.targets),
        small_integers(f"ROW_{g}", axis.rows),
        reals(f"B_{g}", axis.B),
        reals(f"CLOSED_{g}", axis.closed),
        reals(f"K_{g}", axis.K),
        reals(f"INVERSE_{g}", axis.inverse),
        reals(f"W_{g}", axis.W),
        reals(f"W_END_{g}", axis.W_end),
        reals(f"V_{g}", axis.V),
        reals(f"V_END_{g}", axis.V_end),
        reals(f"C_{g}", axis.C),
        reals(f"RESPONSES_{g}", _tidy(lower_packed(axis.responses))),
    ]


def _tidy(values: Array) -> Array:
    """Without what is a product of rounding."""
    return np.where(np.abs(values) < 1e-18 * np.abs(values).max(initial=0.0), 0.0, values)


def _axis(g: int, axis: AxisTables, shapes: list[tuple[int, int]]) -> str:
    n, m = axis.B.shape
    sizes = f"{n}, {m}, {axis.first}, {len(axis.rows)}, {len(axis.targets)}, {shapes.index((n, m))}, {int(axis.before)}"
    names = ["STATE", "TARGET", "ROW", "B", "CLOSED", "K", "INVERSE", "W", "W_END", "V", "V_END", "C", "RESPONSES"]
    return ", ".join([sizes, *(f"{name}_{g}" for name in names)])


def _rows(found: Tables) -> list[str]:
    terms: list[str] = []
    rows: list[str] = []
    for r, row in enumerate(found.rows):
        first = len(terms)
        terms += [f"{number(coefficient)}, {j}, {lag}" for coefficient, j, lag in row.terms]
        output = found.axes[row.axis].rows.index(r) if row.axis >= 0 else 0
        soft = np.isfinite(row.l1)
        penalty = f"{int(soft)}, {number(row.l1 if soft else 0.0)}, {number(row.compliance)}"
        place = f"{row.axis}, {output}, {int(row.later)}, {first}, {len(terms)}"
        rows.append(f"{place}, {penalty}")
    return [structs("term", "TERMS", terms or ["R(0.0), 0, 0"]), structs("row", "ROWS", rows)]
