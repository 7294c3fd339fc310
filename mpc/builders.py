"""From the tables `[controller]` to what flies.

A law in one file with its table registers its builder there; those here are imported when one is built: most flights
need one of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mpc.bounded import Bounded, ControllerTable, Weighted, law_of, require_lags
from mpc.constrained import Constrained
from mpc.fallback.contract import Guard
from mpc.model import hover_model, target_model
from mpc.nonlinear.settings import Nonlinear
from mpc.obstacles import Shape
from mpc.pilot import Pilot
from mpc.robust.settings import Robust
from quadsim.controller import ROTORS, Controller
from quadsim.errors import InputError
from quadsim.vehicle import Vehicle


def build(table: ControllerTable, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Pilot:
    """Return the controller for a control `period` [s], with obstacles and regions `shapes`.

    Where it commands targets, it flies once it has an autopilot.

    Raises:
        InputError: no controller can be built from these numbers.
    """
    try:
        if isinstance(table, Weighted) and table.compiled:
            law = _compiled(table, vehicle, period, shapes)
        else:
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


@law_of.register(Constrained)
@law_of.register(Robust)
def _linear(table: Bounded, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Controller:
    from mpc.linear import LinearMPC, NominalPreparation, Preparation

    problem, space = table.problem(vehicle, period), table.space(shapes, vehicle, period)
    preparation: Preparation = NominalPreparation(problem)
    if isinstance(table, Robust):
        from mpc.robust.controller import RobustPreparation

        preparation = RobustPreparation(vehicle, problem, table)
    return LinearMPC(
        preparation,
        table.make_solver(problem, space),
        name=table.type,
        holds=isinstance(table, Constrained),
        space=space,
        kkt_every=table.kkt_every,
    )


def _compiled(table: Weighted, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Controller:
    """Return the law in C.

    Raises:
        ExportError: C does not implement this law.
    """
    from mpc.core.law import CompiledMPC
    from mpc.core.numbers import exportable

    return CompiledMPC(exportable(table, vehicle, period, shapes))


@law_of.register(Nonlinear)
def _nonlinear(table: Nonlinear, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Controller:
    from mpc.nonlinear.controller import NonlinearMPC

    if table.commands != ROTORS:
        require_lags(table.inner_lag)
    return NonlinearMPC(
        vehicle,
        period=period,
        settings=table,
        bounds=table.actuators(vehicle),
        constraints=table.constraints(),
        space=table.space(shapes, vehicle, period),
        kkt_every=table.kkt_every,
    )
