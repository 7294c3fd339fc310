"""The numbers of a law in C except those of its problem: members of the structs of quadsim_mpc.h, in their order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mpc.answer import ActuatorBounds
from mpc.bounded import Bounded, Weighted, resolved_lag
from mpc.core.tables import NO_BOUND
from mpc.equilibrium import LEAST_LIFT
from mpc.fallback.completion import PLAUSIBLE
from mpc.heading import slope
from mpc.model import hover_model
from mpc.nonlinear.model import SUBSTEPS, nonlinear_model
from mpc.observer import UPRIGHT, DisturbanceObserver
from mpc.obstacles import Shape
from mpc.ocp import Problem
from mpc.robust.settings import Robust, split_delay
from quadsim.errors import ExportError
from quadsim.state import REFERENCE_STATES, Array
from quadsim.vehicle import N_ROTORS, Vehicle


@dataclass(frozen=True, kw_only=True)
class Exportable:
    """The data of a law in C."""

    name: str
    problem: Problem
    vehicle: Vehicle  # the modelled vehicle
    settings: Robust | None = None  # the table of the robust controller; None for the paper's controllers


def exportable(table: Weighted, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Exportable:
    """Return the data of a table's law in C.

    Raises:
        ExportError: the controller cannot be exported.
        InputError: no controller can be built from these numbers.
    """
    if isinstance(table, Bounded) and table.avoidance is not None and shapes:
        rule = "its half-spaces around obstacles are others in each period: leave out controller.avoidance"
        raise ExportError(rule)
    settings = table if isinstance(table, Robust) else None
    return Exportable(name=table.type, problem=table.problem(vehicle, period), vehicle=vehicle, settings=settings)


def controller_numbers(law: Exportable) -> dict[str, Array]:
    """Return the members of a `quadsim_controller`."""
    problem, free = law.problem, np.full(N_ROTORS, NO_BOUND)
    limits = {"speed_min": -free, "speed_max": free, "step_min": -free, "step_max": free}
    if problem.every_constraint:
        bounds = ActuatorBounds.of_problem(problem)
        sides = bounds.u_min, bounds.u_max, bounds.delta_min, bounds.delta_max
        limits = {name: np.clip(side, -NO_BOUND, NO_BOUND) for name, side in zip(limits, sides, strict=True)}
    return {"C_r": problem.objective.C_r, "hover": problem.model.u_bar, **limits}


def robust_numbers(law: Exportable, modes: Array) -> dict[str, float | Array]:
    """Return the members of a `quadsim_robust`; `modes` (4, 4) as in `mpc.core.tables.Tables`."""
    settings, vehicle, period = law.settings, law.vehicle, law.problem.model.period
    assert settings is not None
    lag, (whole, late) = resolved_lag(settings.rotor_lag, vehicle), split_delay(settings.delay, period)
    model = nonlinear_model(vehicle, period, rotor_lag=lag or None)
    observing = settings.offset_free
    observer = None if observing is None else DisturbanceObserver(observing, period)
    instants = (np.arange(SUBSTEPS)[:, None] + [0.0, 0.5, 0.5, 1.0]).ravel() / SUBSTEPS

    def decay(time: Array | float) -> Array:
        """Return the share of a deviation of rotor speeds that is left after a time [s]."""
        return np.asarray(np.exp(-np.asarray(time) / lag) if lag else np.zeros(np.shape(time)), float)

    return {
        "observes": int(observer is not None),
        "heading": int(settings.heading),
        "under_way": whole,
        "gravity": model.gravity,
        "least_lift": LEAST_LIFT,
        "upright": UPRIGHT,
        "period": period,
        "delay": late,
        "delayed_share": late / period,
        "rest_of_period": period - late,
        "spun_period": float(decay(period)),
        "spun_delay": float(decay(late)),
        "spun_before": float(decay(period - late)),
        "largest_turn": math.radians(settings.largest_turn),
        "effectiveness": np.asarray(model.effectiveness, float),
        "allocation": np.asarray(model.allocation, float),
        "gyration": np.asarray(model.gyration, float),
        "slope_inverse": np.asarray(np.linalg.inv(slope(hover_model(vehicle, period))), float),
        "modes": modes,
        "gain": np.zeros(6) if observer is None else observer.gain,
        "largest": np.zeros(6) if observer is None else observer.largest,
        "decay_before": decay(instants * (period - late)),
        "decay_delay": decay(instants * late),
        "decay_period": decay(instants * period),
        "plausible_state": PLAUSIBLE,
        "plausible_reference": PLAUSIBLE[list(REFERENCE_STATES)],
    }
