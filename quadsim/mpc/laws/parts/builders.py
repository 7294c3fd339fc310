"""From the tables `[controller]` to what flies: a controller (`quadsim.mpc.laws`), its guard and inner loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from quadsim.errors import InputError
from quadsim.mpc.pilot.pilot import Pilot
from quadsim.mpc.space import Shape
from quadsim.mpc.tables.bounded import Bounded
from quadsim.mpc.tables.controller import ControllerTable
from quadsim.vehicle import Vehicle

AnyTable = TypeVar("AnyTable", bound=ControllerTable)


def build(table: ControllerTable, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Pilot:
    """Return the controller for a control `period` [s], with obstacles and regions `shapes`.

    Where it commands targets, it flies once it has an autopilot.

    Raises:
        InputError: no controller can be built from these numbers.
    """
    try:
        law = table.law(vehicle, period, shapes)
    except np.linalg.LinAlgError as error:
        raise InputError(
            "the controller's gain cannot be computed: its weights and the vehicle's numbers are too many orders "
            f"of magnitude apart ({error})"
        ) from error
    guard = table.guard(vehicle, period)
    inner = table.inner_loop(vehicle)
    return Pilot(law, vehicle, guard=guard, inner=inner, attitudes=table.attitudes())


def stated(table: AnyTable, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> AnyTable:
    """Return a table with the `solver` that solves its QPs where none is stated.

    Raises:
        InputError: no controller can be built from these numbers.
    """
    if not isinstance(table, Bounded):
        return table
    problem = table.problem(vehicle, period)
    space = table.space(shapes, vehicle, period)
    return replace(table, solver=table.solver_name(problem, space))
