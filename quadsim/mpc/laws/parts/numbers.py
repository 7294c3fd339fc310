"""The numbers of a controller in C except its problem's: members of the structs of quadsim_mpc.h, in their order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from quadsim.controller import ROTORS
from quadsim.core.mirror import constant
from quadsim.errors import ExportError
from quadsim.mpc.estimate.observer import LEAST_UPRIGHT, DisturbanceObserver
from quadsim.mpc.guard.numbers import PLAUSIBLE
from quadsim.mpc.guard.settings import USUAL_FALLBACK, FallbackSettings
from quadsim.mpc.laws.robust import Robust
from quadsim.mpc.problem.equilibrium import LEAST_LIFT
from quadsim.mpc.problem.heading import slope
from quadsim.mpc.problem.model import hover_model, split_delay
from quadsim.mpc.problem.ocp import Problem
from quadsim.mpc.problem.rigidbody import SUBSTEPS, air_maps, inner_response
from quadsim.mpc.space import Shape
from quadsim.mpc.tables.bounded import Bounded, Weighted
from quadsim.mpc.tables.lags import require_lags, resolved_lag
from quadsim.state import REFERENCE_STATES, Array
from quadsim.vehicle import Vehicle

AVOIDS: Final = "its half-spaces around obstacles are others in each period: leave out controller.avoidance"
"""Why a controller that avoids obstacles is not exported."""


ANSWER: Final = SUBSTEPS * constant("QUADSIM_ANSWER")
"""Numbers of an inner loop's answer over a span of time."""


@dataclass(frozen=True, kw_only=True)
class Exportable:
    """The data of a controller in C."""

    name: str
    problem: Problem
    vehicle: Vehicle  # the modelled vehicle
    settings: Robust | None = None  # the table of the robust controller; None for the paper's controllers
    fallback: FallbackSettings = USUAL_FALLBACK  # with the tilt that its bounds leave


def exportable(table: Weighted, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Exportable:
    """Return the data of a table's controller in C.

    Raises:
        ExportError: the controller cannot be exported.
        InputError: no controller can be built from these numbers.
    """
    if isinstance(table, Bounded) and table.avoidance is not None and shapes:
        raise ExportError(AVOIDS)
    if table.commands != ROTORS:
        raise ExportError(f'it is {table.type!r} with commands = "{table.commands}"; exported is "rotors"')
    settings = None
    if isinstance(table, Robust):
        settings = table
    return Exportable(
        name=table.type,
        problem=table.problem(vehicle, period),
        vehicle=vehicle,
        settings=settings,
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
    gain = np.zeros(6)
    largest = np.zeros(6)
    if settings.offset_free is not None:
        observer = DisturbanceObserver(settings.offset_free, period)
        gain = observer.gain.copy()
        largest = observer.largest
    air = air_maps(vehicle, 1.0)
    instants = (np.arange(SUBSTEPS)[:, None] + [0.0, 0.5, 0.5, 1.0]).ravel() / SUBSTEPS

    def decay(time: Array | float) -> Array:
        """Return the share of a deviation of rotor speeds that is left after a time [s]."""
        if not lag:
            return np.zeros(np.shape(time))
        return np.asarray(np.exp(-np.asarray(time) / lag), float)

    answer_before = answer_delay = answer_period = np.zeros(ANSWER)
    if settings.commands != ROTORS:
        answer_before = inner_answer(settings, period - late)
        answer_delay = inner_answer(settings, late)
        answer_period = inner_answer(settings, period)
        gain[3:] = 0.0  # an inner loop balances the torque
    return {
        "observes": int(settings.offset_free is not None),
        "heading": int(settings.heading),
        "under_way": whole,
        "gravity": vehicle.gravity,
        "least_lift": LEAST_LIFT,
        "upright": LEAST_UPRIGHT,
        "period": period,
        "delay": late,
        "delayed_share": late / period,
        "rest_of_period": period - late,
        "left_after_period": float(decay(period)),
        "left_after_delay": float(decay(late)),
        "left_after_rest": float(decay(period - late)),
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
        "gain": gain,
        "largest": largest,
        "decay_before": decay(instants * (period - late)),
        "decay_delay": decay(instants * late),
        "decay_period": decay(instants * period),
        "targets": int(settings.commands != ROTORS),
        "mass": vehicle.mass,
        "answer_before": answer_before,
        "answer_delay": answer_delay,
        "answer_period": answer_period,
        "plausible_state": PLAUSIBLE,
        "plausible_reference": PLAUSIBLE[list(REFERENCE_STATES)],
    }


def inner_answer(settings: Robust, span: float) -> Array:
    """Return (`ANSWER`,) the shares of an inner loop's answer over a span [s], at the instants of Runge-Kutta's steps.

    At each instant they are, about body x, y, z, what is left of the rates at the start, and what the turn takes from
    the targets (`quadsim.mpc.problem.rigidbody.inner_response`).
    """
    halves = 2 * SUBSTEPS
    at_halves = np.zeros((halves + 1, 6))
    attitude_lags = settings.attitude_lag or (None, None, None)
    for axis, lag in enumerate(require_lags(settings.inner_lag)[1:]):
        left, taken = inner_response(span / halves, halves + 1, lag, attitude_lags[axis])
        at_halves[:, axis] = left
        at_halves[:, 3 + axis] = taken
    instants = 2 * np.arange(SUBSTEPS)[:, None] + [0, 1, 1, 2]
    return at_halves[instants.ravel()].ravel()
