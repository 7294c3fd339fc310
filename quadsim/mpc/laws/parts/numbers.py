"""The numbers of a law in C except those of its problem: members of the structs of quadsim_mpc.h, in their order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from quadsim.errors import ExportError
from quadsim.mpc.estimate.observer import LEAST_UPRIGHT, DisturbanceObserver
from quadsim.mpc.guard.numbers import PLAUSIBLE
from quadsim.mpc.guard.settings import USUAL_FALLBACK, FallbackSettings
from quadsim.mpc.laws.robust import Robust
from quadsim.mpc.problem.equilibrium import LEAST_LIFT
from quadsim.mpc.problem.heading import slope
from quadsim.mpc.problem.model import hover_model, split_delay
from quadsim.mpc.problem.ocp import Problem
from quadsim.mpc.problem.rigidbody import SUBSTEPS, air_maps
from quadsim.mpc.space import Shape
from quadsim.mpc.tables.bounded import Bounded, Weighted
from quadsim.mpc.tables.lags import resolved_lag
from quadsim.state import REFERENCE_STATES, Array
from quadsim.vehicle import Vehicle

AVOIDS: Final = "its half-spaces around obstacles are others in each period: leave out controller.avoidance"
"""Why a controller that avoids obstacles is not exported."""


@dataclass(frozen=True, kw_only=True)
class Exportable:
    """The data of a law in C."""

    name: str
    problem: Problem
    vehicle: Vehicle  # the modelled vehicle
    settings: Robust | None = None  # the table of the robust controller; None for the paper's controllers
    fallback: FallbackSettings = USUAL_FALLBACK  # with the tilt that its bounds leave


def exportable(table: Weighted, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Exportable:
    """Return the data of a table's law in C.

    Raises:
        ExportError: the controller cannot be exported.
        InputError: no controller can be built from these numbers.
    """
    if isinstance(table, Bounded) and table.avoidance is not None and shapes:
        raise ExportError(AVOIDS)
    return Exportable(
        name=table.type,
        problem=table.problem(vehicle, period),
        vehicle=vehicle,
        settings=table if isinstance(table, Robust) else None,
        fallback=(table.fallback or USUAL_FALLBACK).within(table.output_bounds),
    )


def controller_numbers(problem: Problem) -> dict[str, float | Array]:
    """Return the members of a `quadsim_controller` that are numbers."""
    model = problem.model
    return {"hover": model.u_bar, "follows_rates": int(problem.objective.needs_rates), "period": model.period}


def robust_numbers(settings: Robust, vehicle: Vehicle, period: float) -> dict[str, float | Array]:
    """Return the members of a `quadsim_robust`, for a control `period` [s]."""
    lag = resolved_lag(settings.rotor_lag, vehicle)
    whole, late = split_delay(settings.delay, period)
    effectiveness = np.asarray(vehicle.accelerations(vehicle.allocation), float)
    ixx, iyy, izz = vehicle.inertia
    observing = settings.offset_free
    observer = None if observing is None else DisturbanceObserver(observing, period)
    air = air_maps(vehicle, 1.0)
    instants = (np.arange(SUBSTEPS)[:, None] + [0.0, 0.5, 0.5, 1.0]).ravel() / SUBSTEPS

    def decay(time: Array | float) -> Array:
        """Return the share of a deviation of rotor speeds that is left after a time [s]."""
        return np.asarray(np.exp(-np.asarray(time) / lag) if lag else np.zeros(np.shape(time)), float)

    return {
        "observes": int(observer is not None),
        "heading": int(settings.heading),
        "under_way": whole,
        "gravity": vehicle.gravity,
        "least_lift": LEAST_LIFT,
        "upright": LEAST_UPRIGHT,
        "period": period,
        "delay": late,
        "delayed_share": late / period,
        "rest_of_period": period - late,
        "spun_period": float(decay(period)),
        "spun_delay": float(decay(late)),
        "spun_before": float(decay(period - late)),
        "largest_turn": math.radians(settings.largest_turn),
        "effectiveness": effectiveness,
        "allocation": np.asarray(np.linalg.inv(effectiveness), float),
        "gyration": np.array([(iyy - izz) / ixx, (izz - ixx) / iyy, (ixx - iyy) / izz]),
        "moment": int(settings.moment),
        "across": air.across,
        "inflow": air.inflow,
        "damping": air.damping,
        "loss": air.loss,
        "slope_inverse": np.asarray(np.linalg.inv(slope(hover_model(vehicle, period))), float),
        "gain": np.zeros(6) if observer is None else observer.gain,
        "largest": np.zeros(6) if observer is None else observer.largest,
        "decay_before": decay(instants * (period - late)),
        "decay_delay": decay(instants * late),
        "decay_period": decay(instants * period),
        "plausible_state": PLAUSIBLE,
        "plausible_reference": PLAUSIBLE[list(REFERENCE_STATES)],
    }
