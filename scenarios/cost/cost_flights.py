"""Flights as a study holds them, flown over processes, and what their controllers' steps take."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from mpc.constrained import ConstrainedMPC
from mpc.solvers import QPSolver
from mpc.unconstrained import UnconstrainedMPC
from quadsim.controller import Controller
from quadsim.errors import MissingPackageError
from quadsim.flight import metrics
from quadsim.flight.log import ControlLog, FlightLog
from quadsim.state import REFERENCE_STATES
from scenarios.bench.queries import QueriedController, flight_between, recorded
from scenarios.bench.timing import StepTimes, segments, time_in_turns
from scenarios.build import build_controller, build_problem
from scenarios.cost.study import CandidateTimes, Outcome
from scenarios.courses.make import build_course_steps
from scenarios.many import answers
from scenarios.parts.vehicle import build_vehicle
from scenarios.progress import Progress
from scenarios.run import fly_scenario
from scenarios.schema.controller import ConstrainedSpec, UnconstrainedSpec
from scenarios.schema.scenario import Scenario

_NOT_THE_COURSE: Final = {
    *("name", "description", "group", "expect", "log_rate"),
    *("vehicle", "controller", "lost", "constraints"),
}
"""Fields in which flights that are compared by their controllers may differ; vehicles are compared by their numbers."""
REPEATS: Final = 3
SWEEP_STRIDE: Final = 3  # of a flight in a sweep, one segment in this number is timed
LONGEST_PASS: Final = 20.0  # a candidate that takes longer than this for all periods of a flight [s] is timed once


def with_controller(scenario: Scenario, **changes: Any) -> Scenario:
    """The scenario with other fields of its controller."""
    return scenario.model_copy(update={"controller": scenario.controller.model_copy(update=changes)})


def with_tilt(scenario: Scenario, tilt: float) -> Scenario:
    """The constrained scenario with other bounds on roll and pitch [deg]."""
    assert isinstance(scenario.controller, ConstrainedSpec)
    bounds = {**scenario.controller.output_bounds, "roll": [-tilt, tilt], "pitch": [-tilt, tilt]}
    return with_controller(scenario, output_bounds=bounds)


def with_vehicles(
    scenario: Scenario, arm_lengths: Sequence[float], drags: Sequence[float]
) -> dict[tuple[float, float], Scenario]:
    """The scenario with each pair of an arm length L [m] and a drag-to-thrust ratio d/b [m]."""

    def varied(arm: float, drag: float) -> Scenario:
        vehicle = scenario.vehicle.model_copy(update={"arm_length": arm, "drag_to_thrust": drag})
        return scenario.model_copy(update={"vehicle": vehicle})

    return {(arm, drag): varied(arm, drag) for arm in arm_lengths for drag in drags}


def without_constraints(scenario: Scenario) -> Scenario:
    """The counterpart: same weights and horizon, flown by the unconstrained controller."""
    spec = scenario.controller
    assert isinstance(spec, ConstrainedSpec)
    free = UnconstrainedSpec(
        type="unconstrained", horizon=spec.horizon, output_weights=spec.output_weights, input_weights=spec.input_weights
    )
    return scenario.model_copy(update={"controller": free})


def course(scenario: Scenario) -> tuple[Any, ...]:
    """What two flights must share to be compared by their controllers."""
    shared = [name for name in type(scenario).model_fields if name not in _NOT_THE_COURSE]
    return (*(getattr(scenario, name) for name in shared), build_vehicle(scenario))


def named(scenarios: Sequence[Scenario]) -> dict[str, Scenario]:
    """Scenarios by name, those that share one numbered."""
    numbered: dict[str, Scenario] = {}
    for each in scenarios:
        shared = sum(each.name == other.name for other in numbered.values())
        numbered[f"{each.name} ({shared + 1})" if shared else each.name] = each
    return numbered


def is_counterpart(scenario: Scenario, constrained: Scenario) -> bool:
    """Whether an unconstrained flight of the course is the constrained one, but for its constraints."""
    free = without_constraints(constrained)
    return all(getattr(scenario, name) == getattr(free, name) for name in ("controller", "vehicle", "plant"))


class Flown(NamedTuple):
    """A flight as a worker process hands it back."""

    outcome: Outcome
    control: ControlLog


def key(scenario: Scenario) -> str:
    """The same for equal scenarios, and different for others."""
    return scenario.model_dump_json()


def fly(scenario: Scenario) -> Flown:
    """Fly a scenario, here."""
    flight = fly_scenario(scenario)
    return Flown(outcome=_outcome(scenario, flight.log), control=flight.log.control)


def _outcome(scenario: Scenario, log: FlightLog) -> Outcome:
    control = log.control
    outputs = control.truth[:, REFERENCE_STATES]
    return Outcome(
        reason=log.reason,
        flown=round(control.t.size * scenario.control_period, 9),
        statuses={status: control.status.count(status) for status in sorted(set(control.status))},
        fallbacks=int(np.count_nonzero(control.fallback)),
        active=int(np.count_nonzero(control.active)),
        numbers=_numbers(log) if control.t.size else {},
        settling=metrics.settling(control.t, outputs, build_course_steps(scenario)),
    )


def _numbers(log: FlightLog) -> dict[str, float]:
    """A value for each of `scenarios.cost.study.MEASURES`."""
    tracking, control = metrics.tracking(log.control), metrics.control(log.control)
    rmse = tracking["rmse"]
    return {
        "tilt_sampled": metrics.peak_tilt(log.control.truth),
        "tilt_plant": metrics.peak_tilt(log.plant.state),
        **{f"rmse_{axis}": rmse[axis] for axis in "xyz"},
        "rmse_yaw": float(np.degrees(rmse["yaw"])),
        "end_error": max(abs(error) for error in tracking["final_error"].values()),
        "speed_max": control["speed_max"],
        "step_max": max(-control["slew_min"], control["slew_max"]),
        "total_variation": control["total_variation"],
    }


def fly_all(
    scenarios: Sequence[Scenario], flown: Mapping[str, Flown], workers: int | None, progress: Progress
) -> dict[str, Flown]:
    """Fly what was not flown yet, over processes; results, with those given, by `key`."""
    results = dict(flown)
    wanted = {name: scenario for scenario in scenarios if (name := key(scenario)) not in results}
    done = answers(fly, [*wanted.values()], workers=workers, progress=functools.partial(progress, "flights"))
    results |= zip(wanted, done, strict=True)
    return results


def time_candidates(
    scenario: Scenario, log: ControlLog, solvers: Sequence[str], progress: Progress
) -> tuple[tuple[CandidateTimes, ...], dict[str, str]]:
    """Everything that can compute a command, timed on the queries of a flight; and what could not take part.

    See `scenarios.bench.timing` for how.
    """
    if not log.t.size:
        return (), {}
    vehicle = build_vehicle(scenario)
    problem = build_problem(scenario, vehicle)
    controllers: dict[str, Controller] = {
        "unconstrained gain": UnconstrainedMPC(problem),
        "constrained, as flown": build_controller(scenario, vehicle),
    }
    left_out = {}
    for solver in solvers:
        try:
            controllers[f"QP by {solver}"] = ConstrainedMPC(problem, QPSolver(solver, problem), shortcut=False)
        except MissingPackageError as error:
            left_out[solver] = str(error)
    requested = {
        name: QueriedController(each, recorded(scenario, log, problem.horizon)) for name, each in controllers.items()
    }
    report = functools.partial(progress, "steps")
    laps = _timed(scenario, requested, segments(log.t.size, 1), longest_pass=LONGEST_PASS, progress=report)
    candidates = (
        CandidateTimes(
            name=name,
            step_ms=laps[name].median,
            statuses=tuple(each.statuses[period] for period in range(log.t.size)),
            repeats=len(laps[name].ms),
        )
        for name, each in requested.items()
    )
    return tuple(candidates), left_out


def _timed(
    scenario: Scenario, candidates: Mapping[str, QueriedController], chosen: Sequence[range], **options: Any
) -> dict[str, StepTimes]:
    with flight_between(scenario, build_vehicle(scenario)) as between:
        rng = np.random.default_rng(scenario.seed)
        return time_in_turns(candidates, chosen, between=between, repeats=REPEATS, rng=rng, **options)


def time_flights(
    scenarios: Sequence[Scenario], flown: Mapping[str, Flown], progress: Progress
) -> dict[str, dict[str, float]]:
    """Median, percentiles and maximum of each flight's controller step [ms], by `key`.

    A flight of not one period has none.
    """
    wanted = {key(scenario): scenario for scenario in scenarios}
    timed: dict[str, dict[str, float]] = {}
    for done, (name, scenario) in enumerate(wanted.items()):
        log = flown[name].control
        if log.t.size:
            controller = build_controller(scenario, build_vehicle(scenario))
            candidate = QueriedController(controller, recorded(scenario, log, controller.horizon))
            laps = _timed(scenario, {name: candidate}, segments(log.t.size, SWEEP_STRIDE))
            timed[name] = metrics.percentiles(laps[name].median)
        progress("sweeps", done + 1, len(wanted))
    return timed
