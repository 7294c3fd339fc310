"""From the tables `[controller]` to what flies: a law in Python (`quadsim.mpc.laws`) or C, its guard and inner loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from quadsim.controller import CORE, Controller
from quadsim.errors import ExportError, InputError, ParameterError
from quadsim.mpc.laws.robust import Robust
from quadsim.mpc.pilot.pilot import Pilot
from quadsim.mpc.space import Shape
from quadsim.mpc.tables.bounded import USUAL_SOLVER, Bounded, Weighted
from quadsim.mpc.tables.controller import ControllerTable
from quadsim.vehicle import Vehicle

if TYPE_CHECKING:
    from quadsim.mpc.laws.parts.compiled import CompiledPreparation

AnyTable = TypeVar("AnyTable", bound=ControllerTable)


def build(table: ControllerTable, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Pilot:
    """Return the controller for a control `period` [s], with obstacles and regions `shapes`.

    Where it commands targets, it flies once it has an autopilot.

    Raises:
        InputError: no controller can be built from these numbers.
    """
    try:
        preparation = _in_c(table, vehicle, period, shapes)
        law = table.law(vehicle, period, shapes) if preparation is None else _compiled(table, preparation)
    except np.linalg.LinAlgError as error:
        raise InputError(
            "the controller's gain cannot be computed: its weights and the vehicle's numbers are too many orders "
            f"of magnitude apart ({error})"
        ) from error
    return Pilot(law, vehicle, guard=table.guard(vehicle, period), inner=table.inner_loop(vehicle))


def stated(table: AnyTable, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> AnyTable:
    """Return a table with the values of `compiled` and `solver` that hold where they are absent.

    Raises:
        InputError: no controller can be built from these numbers.
    """
    if not isinstance(table, Weighted):
        return table
    compiled = _in_c(table, vehicle, period, shapes) is not None
    if isinstance(table, Bounded):
        return replace(table, compiled=compiled, solver=table.solver or (CORE if compiled else USUAL_SOLVER))
    return replace(table, compiled=compiled)


def _in_c(
    table: ControllerTable, vehicle: Vehicle, period: float, shapes: Sequence[Shape]
) -> CompiledPreparation | None:
    """Return the preparation in C of a law that C flies; None of one that flies in Python.

    The field `compiled` decides.  Where it is absent, C flies `robust` with the solver `core`, or none stated, if C
    implements it.

    Raises:
        ExportError: C does not implement a law with `compiled = true`.
    """
    if not isinstance(table, Weighted) or table.compiled is False:
        return None
    if table.compiled is None and not (isinstance(table, Robust) and table.solver in (None, CORE)):
        return None
    from quadsim.mpc.laws.parts.compiled import CompiledPreparation
    from quadsim.mpc.laws.parts.numbers import exportable

    try:
        return CompiledPreparation(exportable(table, vehicle, period, shapes))
    except (ExportError, ParameterError):
        if table.compiled is None:
            return None
        raise


def _compiled(table: ControllerTable, preparation: CompiledPreparation) -> Controller:
    """Return the law in C."""
    from quadsim.mpc.laws.parts.compiled import CompiledGain, CompiledSolver
    from quadsim.mpc.laws.parts.linear import linear_law

    if not isinstance(table, Bounded):
        return CompiledGain(preparation)
    return linear_law(table, preparation, CompiledSolver(preparation))
