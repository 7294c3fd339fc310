"""From the tables `[controller]` to what flies: one builder per table, which alone knows the table and its law.

Laws are imported when one is built: most flights need one of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import singledispatch

import numpy as np

from mpc.baselines.geometric import Geometric, GeometricController
from mpc.baselines.lqr import LQR, LQRTable
from mpc.baselines.pid import PID, CascadedPID
from mpc.bounded import Bounded, ControllerTable, Weighted, require_lags
from mpc.constrained import Constrained
from mpc.nonlinear.settings import Nonlinear
from mpc.obstacles import Shape
from mpc.pilot import Pilot
from mpc.robust.settings import Robust
from mpc.unconstrained import Unconstrained, UnconstrainedMPC
from quadsim.controller import ROTORS, Controller
from quadsim.errors import InputError, MissingCoreError
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
    return Pilot(law, vehicle, guard=table.guard(vehicle, period), inner=table.inner_loop(vehicle))


@singledispatch
def law_of(table: ControllerTable, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Controller:
    """Return the law of a table, in Python; see `build`.  A table from elsewhere registers its builder here."""
    raise NotImplementedError(type(table).__name__)


@law_of.register(Unconstrained)
def _unconstrained(
    table: Unconstrained, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()
) -> UnconstrainedMPC:
    return UnconstrainedMPC(table.problem(vehicle, period))


@law_of.register(Constrained)
@law_of.register(Robust)
def _linear(table: Bounded, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Controller:
    from mpc.linear import LinearMPC, NominalPreparation, Preparation
    from mpc.robust.controller import RobustPreparation

    problem, space = table.problem(vehicle, period), table.space(shapes, vehicle, period)
    preparation: Preparation = NominalPreparation(problem)
    if isinstance(table, Robust):
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
        MissingCoreError: the library is missing.
        ExportError: C does not implement this law.
    """
    from mpc.core.law import CompiledMPC
    from mpc.core.library import why_missing
    from mpc.core.numbers import exportable

    reason = why_missing()
    if reason is not None:
        raise MissingCoreError(reason, instead="leave out controller.compiled")
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


@law_of.register(LQRTable)
def _lqr(table: LQRTable, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Controller:
    return LQR(vehicle, period, table)


@law_of.register(PID)
def _pid(table: PID, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Controller:
    return CascadedPID(vehicle, period, table)


@law_of.register(Geometric)
def _geometric(table: Geometric, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Controller:
    return GeometricController(vehicle, period, table)
