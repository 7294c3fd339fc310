"""The C files of a controller: the solver's sources and its numbers."""

from __future__ import annotations

from importlib import resources
from typing import Final, Literal

import numpy as np

from mpc.answer import ActuatorBounds
from mpc.core.numbers import Exportable
from mpc.core.tables import AxisTables, Tables, tables
from mpc.equilibrium import LEAST_LIFT
from mpc.export.ctext import NO_BOUND, bounded, lower_packed, number, reals, small_integers, structs
from mpc.fallback.completion import PLAUSIBLE
from mpc.heading import slope
from mpc.model import hover_model
from mpc.nonlinear.model import SUBSTEPS, nonlinear_model
from mpc.observer import UPRIGHT, DisturbanceObserver
from mpc.robust.settings import RobustSettings
from quadsim.state import REFERENCE_STATES, Array
from quadsim.vehicle import Vehicle

Precision = Literal["double", "float"]
HEADER: Final = "quadsim_mpc.h"
SOURCE: Final = "quadsim_mpc.c"
DATA: Final = "quadsim_mpc_data.h"


def part(name: str) -> str:
    """A hand-written C source of this package."""
    return (resources.files("mpc.export") / "c" / name).read_text(encoding="utf-8")


def sources(law: Exportable, *, precision: Precision, title: str) -> dict[str, str]:
    """The controller's files, by name.

    Args:
        law: the controller.
        precision: of all numbers.
        title: a line that identifies it, in ASCII.

    Raises:
        ParameterError: the problem is too large, or its rows differ from step to step.
    """
    problem, settings = law.problem, law.settings
    found = tables(problem)
    bounds = ActuatorBounds.of_problem(problem) if problem.every_constraint else None
    real = "double" if precision == "double" else "float"
    head = part(HEADER).replace("@TITLE@", title).replace("@PERIOD@", f"{problem.model.period:g}")
    head = head.replace("@REAL@", real).replace("@SIZES@", _sizes(found, precision))
    numbers = data(found, bounds, rests=settings is not None)
    parts = ["answer.c", "constrained.c"]
    if settings is not None:
        parts = ["elementary.c", "answer.c", "robust.c"]
        numbers += robust_data(law.vehicle, problem.model.period, settings) + "\n" + reals("MODES", found.modes)
    return {
        HEADER: head.replace("@STATE@", "" if settings is None else ROBUST_STATE),
        SOURCE: solver(found) + "".join(map(part, parts)),
        DATA: numbers,
    }


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
        "STEP_ROWS": (max(1, len(found.rows)), "rows of constraints in each step"),
        "PARTS": (len(found.axes), "parts that the problem falls into"),
        "AXIS_STATES": (max(1, *(len(axis.B) for axis in found.axes)), "of the largest axis"),
        "AXIS_INPUTS": (widest, "likewise"),
        "ENTRIES": (1 + widest * max((len(row.terms) for row in found.rows), default=0), "of the largest row"),
    }
    lines = [f"#define QUADSIM_{name} {value} /* {meaning} */" for name, (value, meaning) in sizes.items()]
    room = f"#define QUADSIM_ROOM {found.room} /* active rows that there is room for; more take more memory */"
    changes = "#define QUADSIM_CHANGES 500 /* of the active set in a search, after which it is given up */"
    lines += ["#ifndef QUADSIM_ROOM", room, "#endif", "#ifndef QUADSIM_CHANGES", changes, "#endif"]
    return "\n".join(["#define QUADSIM_FLOAT 1", *lines] if precision == "float" else lines)


ROBUST_STATE: Final = """\
    quadsim_real rotors[4];                      /* speeds at the instant from which the command acts [rad/s] */
    int known;                                   /* whether the state there is known */
    quadsim_real ahead[12];                      /* the state there */
    quadsim_real estimate[6];                    /* disturbance: world x, y, along thrust [m/s^2], body [rad/s^2] */
    quadsim_real trim[4];                        /* rotor speeds at rest against it [rad/s] */
    quadsim_real lift[3];                        /* along which thrust points there, world axes */
    quadsim_real twist[3];                       /* angular acceleration over that by thrust [1/m] */
    quadsim_real effectiveness[16];              /* from squared speeds to U/m and I^-1 tau, so twisted */
    quadsim_real reference[QUADSIM_HORIZON * 4]; /* as the prediction is given it */
"""
"""What the robust controller remembers besides."""


def robust_data(vehicle: Vehicle, period: float, settings: RobustSettings) -> str:
    """The numbers of the robust controller besides those of its problem."""
    lag, delay = settings.rotor_lag, settings.delay
    model = nonlinear_model(vehicle, period, rotor_lag=lag or None)
    observer = None if settings.observer is None else DisturbanceObserver(settings.observer, period)
    instants = (np.arange(SUBSTEPS)[:, None] + [0.0, 0.5, 0.5, 1.0]).ravel() / SUBSTEPS

    def decay(time: Array | float) -> Array:
        """Share of rotor speeds that is left after a time [s]."""
        return np.asarray(np.exp(-np.asarray(time) / lag) if lag else np.zeros(np.shape(time)), float)

    flags = {
        "SUBSTEPS": (SUBSTEPS, "Runge-Kutta steps of a prediction"),
        "OBSERVES": (int(observer is not None), "whether disturbances are estimated"),
        "HEADING": (int(settings.heading), "whether the model is turned by the yaw"),
    }
    numbers = {
        "GRAVITY": model.gravity,
        "LEAST_LIFT": LEAST_LIFT,
        "UPRIGHT": UPRIGHT,
        "DELAY": delay,
        "DELAYED_SHARE": delay / period,
        "REST_OF_PERIOD": period - delay,
        "SPUN_DELAY": float(decay(delay)),
        "SPUN_BEFORE": float(decay(period - delay)),
        "LARGEST_TURN": settings.largest_turn,
    }
    arrays = {
        "EFFECTIVENESS": model.effectiveness,
        "ALLOCATION": model.allocation,
        "GYRATION": model.gyration,
        "SLOPE_INVERSE": np.linalg.inv(slope(hover_model(vehicle, period))),
        "GAIN": np.zeros(6) if observer is None else observer.gain,
        "LARGEST": np.zeros(6) if observer is None else observer.largest,
        "DECAY_BEFORE": decay(instants * (period - delay)),
        "DECAY_DELAY": decay(instants * delay),
        "PLAUSIBLE": PLAUSIBLE,
        "PLAUSIBLE_REFERENCE": PLAUSIBLE[list(REFERENCE_STATES)],
    }
    return "\n".join(
        [
            "",
            *(f"#define QUADSIM_{name} {value} /* {meaning} */" for name, (value, meaning) in flags.items()),
            "",
            *(f"static const real {name} = {number(value)};" for name, value in numbers.items()),
            "",
            *(reals(name, values) for name, values in arrays.items()),
        ]
    )


def data(found: Tables, bounds: ActuatorBounds | None, *, rests: bool) -> str:
    """The numbers, for either precision."""
    if bounds is None:
        nothing = np.full(found.problem.model.nu, -NO_BOUND)
        speed_min, speed_max, step_min, step_max = nothing, -nothing, nothing, -nothing
    else:
        speed_min, speed_max, step_min, step_max = bounds.u_min, bounds.u_max, bounds.delta_min, bounds.delta_max
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
        reals("SPEED_MIN", speed_min),
        reals("SPEED_MAX", speed_max),
        reals("STEP_MIN", bounded(step_min)),
        reals("STEP_MAX", bounded(step_max)),
        reals("LOWER", bounded(found.lower if found.rows else np.array(-NO_BOUND))),
        reals("UPPER", bounded(found.upper if found.rows else np.array(NO_BOUND))),
        reals("SCALE", found.scale if found.rows else np.ones(found.problem.horizon)),
        reals("TOLERANCE", found.tolerance if found.rows else np.ones(1)),
    ]
    for g, axis in enumerate(found.axes):
        blocks += _axis_arrays(g, axis, needed=bool(found.rows))
    blocks += [
        structs("axis", "AXES", (_axis(g, axis, _shapes(found)) for g, axis in enumerate(found.axes))),
        *_rows(found),
    ]
    return "\n".join(blocks)


def _axis_arrays(g: int, axis: AxisTables, *, needed: bool) -> list[str]:
    """The arrays of an axis; its responses only where there are rows."""
    responses: Array = _tidy(lower_packed(axis.responses)) if needed else np.zeros(1)
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
        reals(f"RESPONSES_{g}", responses),
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
    none = "-1, 0, 0, 0, 0, 0, R(0.0), R(0.0)"  # C has no arrays of nothing
    return [structs("term", "TERMS", terms or ["R(0.0), 0, 0"]), structs("row", "ROWS", rows or [none])]
