"""The C files of a controller: the core's, as they are, and one of its numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib import resources
from typing import Final

import numpy as np

from mpc.core.tables import AxisTables, Tables, tables
from mpc.export.ctext import CText, Precision, bounded, initialiser, lower_packed
from mpc.ocp import Problem
from mpc.robust.settings import RobustSettings
from quadsim.vehicle import Vehicle

CORE: Final = ("quadsim_core.h", "quadsim_core.c", "quadsim_mpc.h", "quadsim_mpc.c")
"""Files of `mpc/core/c`, which are exported byte for byte."""
DATA: Final = "quadsim_data.h"
"""The generated file."""
CHANGES: Final = 500
"""Of the active set in a search, after which it is given up."""


def part(name: str, package: str = "mpc.export") -> str:
    """A hand-written C source of a package."""
    return (resources.files(package) / "c" / name).read_text(encoding="utf-8")


def _axis(text: CText, g: int, axis: AxisTables) -> tuple[str, list[str]]:
    """The initialiser of an axis, and its arrays."""
    n, m = axis.B.shape
    integers = {"state": axis.states, "target": axis.regulated, "row": axis.rows}
    reals = {
        "B": axis.B,
        "closed": axis.closed,
        "K": axis.K,
        "inverse": axis.inverse,
        "W": axis.W_r,
        "W_end": axis.W_r_end,
        "C": axis.C,
        "responses": lower_packed(axis.responses),
    }
    arrays = [text.small_integers(f"{name}_{g}", values) for name, values in integers.items()]
    arrays += [text.reals(f"{name}_{g}", values) for name, values in reals.items()]
    sizes = {"states": n, "inputs": m, "first": axis.first, "outputs": len(axis.rows), "targets": len(axis.regulated)}
    names = {name: f"{text.prefix}{name}_{g}" for name in (*integers, *reals)}
    return initialiser(**sizes, before=int(axis.before), **names), arrays


def _rows(text: CText, found: Tables) -> list[str]:
    terms, rows = [], []
    for r, row in enumerate(found.rows):
        soft = math.isfinite(row.l1)
        place = {
            "axis": row.axis,
            "output": found.axes[row.axis].rows.index(r) if row.axis >= 0 else 0,
            "later": int(row.later),
            "first": len(terms),
            "past": len(terms) + len(row.terms),
        }
        penalty = {"l1": text.number(row.l1 if soft else 0.0), "compliance": text.number(row.compliance)}
        rows.append(initialiser(**place, soft=int(soft), **penalty))
        for coefficient, j, lag in row.terms:
            terms.append(initialiser(coefficient=text.number(coefficient), input=j, lag=lag))
    return [text.structs("quadsim_term", "terms", terms), text.structs("quadsim_row", "rows", rows)]


def problem_data(text: CText, found: Tables, room: int) -> list[str]:
    """The optimisation's numbers, the last of them its `quadsim_problem`."""
    problem = found.problem
    reals = {
        "T": found.T,
        "T_inverse": found.T_inverse,
        "lower": bounded(found.lower),
        "upper": bounded(found.upper),
        "scale": found.scale,
        "tolerance": found.tolerance,
    }
    blocks, axes = [text.reals(name, values) for name, values in reals.items()], []
    for g, axis in enumerate(found.axes):
        entry, arrays = _axis(text, g, axis)
        axes.append(entry)
        blocks += arrays
    blocks += [text.structs("quadsim_axis", "axes", axes), *_rows(text, found)]
    members = initialiser(
        horizon=problem.horizon,
        states=problem.model.n,
        step_rows=len(found.rows),
        parts=len(axes),
        regulated=len(problem.objective.C_r),
        room=room,
        changes=CHANGES,
        bounds_differ=int(len(found.lower) > 1),
        mixed=int(any(row.axis >= 0 and row.terms for row in found.rows)),
        **{name: text.prefix + name for name in ("axes", "rows", "terms", *reals)},
    )
    return [*blocks, f"static const quadsim_problem {text.prefix}problem = {members};\n"]
