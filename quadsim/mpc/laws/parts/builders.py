"""From the tables `[controller]` to what flies: a law (`quadsim.mpc.laws`), its guard and inner loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from quadsim.controller import ROTORS
from quadsim.errors import InputError
from quadsim.mpc.guard.contract import Guard
from quadsim.mpc.laws import law_of
from quadsim.mpc.pilot.pilot import Pilot
from quadsim.mpc.problem.model import hover_model, target_model
from quadsim.mpc.space import Shape
from quadsim.mpc.tables.bounded import Bounded, ControllerTable, require_lags
from quadsim.mpc.tables.nonlinear import Nonlinear
from quadsim.vehicle import Vehicle

AnyTable = TypeVar("AnyTable", bound=ControllerTable)


def build(table: ControllerTable, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Pilot:
    """Return the controller for a control `period` [s], with obstacles and regions `shapes`.

    Where it commands targets, it flies once it has an autopilot.

    Raises:
        InputError: no controller can be built from these numbers.
    """
    try:
        law = law_of(table, vehicle, period, shapes)
    except np.linalg.LinAlgError as error:
        raise InputError(
            "the controller's gain cannot be computed: its weights and the vehicle's numbers are too many orders "
            f"of magnitude apart ({error})"
        ) from error
    return Pilot(law, vehicle, guard=guard_of(table, vehicle, period), inner=table.inner_loop(vehicle))


def guard_of(table: ControllerTable, vehicle: Vehicle, period: float) -> Guard | None:
    """Return the fallback contract around the law of a table; None without one."""
    fallback = table.fallback
    if fallback is None or not fallback.enabled:
        return None
    if isinstance(table, Nonlinear):
        model = hover_model(vehicle, period)
        if table.commands != ROTORS:
            model = target_model(vehicle, period, require_lags(table.inner_lag))
        return Guard(model, bounds=table.actuators(vehicle), settings=fallback)
    assert isinstance(table, Bounded)
    bounds, settings = table.input_bounds.actuators(vehicle), fallback.within(table.output_bounds)
    return Guard(hover_model(vehicle, period), bounds=bounds, settings=settings)


def stated(table: AnyTable, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> AnyTable:
    """Return a table with the `solver` that solves its QPs where none is stated.

    Raises:
        InputError: no controller can be built from these numbers.
    """
    if not isinstance(table, Bounded):
        return table
    problem, space = table.problem(vehicle, period), table.space(shapes, vehicle, period)
    return replace(table, solver=table.solver_name(problem, space))
