"""What do constraints cost?  Flies and times all that a `quadsim.cost.CostStudy` tells of."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from mpc.constrained import ConstrainedMPC
from mpc.solvers import SOLVERS, QPSolver, make_backend
from mpc.unconstrained import UnconstrainedMPC
from quadsim import metrics
from quadsim.controller import Controller
from quadsim.cost import Contender, CostStudy, Outcome, Sweep, SweepPoint, Variation
from quadsim.errors import InputError, MissingPackageError
from quadsim.flightlog import ControlLog, FlightLog
from quadsim.rundir import SCENARIO_FILE
from quadsim.state import REFERENCE_STATES, Array
from scenarios.build import build_controller, build_course_steps, build_problem, build_reference, build_vehicle
from scenarios.loading import load_scenario
from scenarios.queries import recorded, time_steps
from scenarios.runner import Progress, fly_scenario, machine, silent
from scenarios.spec import ConstrainedSpec, Scenario, UnconstrainedSpec

TILTS: Final = (2.0, 3.0, 4.0, 5.0, 7.0, 10.0, 15.0, 20.0)
"""Bounds on roll and pitch that are tried [deg]."""
HORIZONS: Final = (10, 15, 20, 30, 50, 75, 100)
"""Horizons that are tried, N."""
ARM_LENGTHS: Final = (0.2, 0.3, 0.5)
"""L [m]; the paper gives none."""
DRAGS: Final = (0.012, 0.024, 0.048)
"""d/b [m]; the paper gives none."""
SOLVERS_TIMED: Final = ("piqp-multistage", "piqp-dense", "qpoases")
"""Both of this project, and the paper's own."""
REPEATS: Final = 3
SWEEP_REPEATS: Final = 2
SWEEP_STRIDE: Final = 3
"""Of a flight in a sweep, each period of so many is timed."""
LONGEST_PASS: Final = 20.0
"""A contender that takes longer than this for all periods of a flight [s] is timed once."""
LONGEST_UNASKED: Final = 120.0
"""A course that takes longer than this [s] is studied only when that is asked for: it is flown about thirty times."""


@dataclass(frozen=True, kw_only=True)
class _Flown:
    """A flight as a worker process hands it back."""

    outcome: Outcome
    control: ControlLog


def find_study(targets: Sequence[str], *, asked: bool | None) -> list[Scenario]:
    """The scenarios of what is compared that a study is made from: a constrained one, then unconstrained ones.

    Args:
        targets: run directories, or scenarios.
        asked: whether a study is wanted; None to find out: it is where a constrained and an unconstrained controller
            fly the same course, which takes no longer than `LONGEST_UNASKED`.

    Returns:
        The first constrained scenario and all unconstrained ones of its course, or nothing where none is to be made.

    Raises:
        InputError: a study is asked for, and nothing is flown by a constrained controller.
    """
    if asked is False:
        return []
    try:
        scenarios = [load_scenario(_scenario_of(target)) for target in targets]
    except InputError:
        if asked:
            raise
        return []  # a run can be compared all the same, and what is no run is refused when it is read
    constrained = next((each for each in scenarios if isinstance(each.controller, ConstrainedSpec)), None)
    if constrained is None:
        if asked:
            raise InputError("--cost needs a flight by a constrained controller among those that are compared")
        return []
    assert isinstance(constrained.controller, ConstrainedSpec)
    others = [
        each
        for each in scenarios
        if isinstance(each.controller, UnconstrainedSpec) and _course(each) == _course(constrained)
    ]
    flyable = SOLVERS[constrained.controller.solver].installed
    if asked is None and (not others or constrained.duration > LONGEST_UNASKED or not flyable):
        return []
    if not flyable:
        make_backend(constrained.controller.solver)  # says what is missing, before anything is flown
    return [constrained, *others]


def study_cost(
    constrained: Scenario,
    others: Sequence[Scenario] = (),
    *,
    tilts: Sequence[float] = TILTS,
    horizons: Sequence[int] = HORIZONS,
    arm_lengths: Sequence[float] = ARM_LENGTHS,
    drags: Sequence[float] = DRAGS,
    solvers: Sequence[str] = SOLVERS_TIMED,
    workers: int | None = None,
    progress: Progress = silent,
) -> CostStudy:
    """Fly a constrained scenario, its counterpart without constraints, and everything they are compared with.

    Steps are timed one after the other, while nothing else flies; flights are spread over processes.  What no clock
    measured is the same however many there are.

    Args:
        constrained: by a constrained controller.
        others: by unconstrained controllers, on the same course.
        tilts: bounds on roll and pitch to try [deg], besides its own.
        horizons: N to try, besides its own.
        arm_lengths: L to try [m].
        drags: d/b to try [m].
        solvers: what is to solve the QP in every period, for comparison; one that is not installed is left out.
        workers: processes that fly; one per usable core by default.
        progress: told how far it is.

    Returns:
        The study.
    """
    spec = constrained.controller
    assert isinstance(spec, ConstrainedSpec)
    base = _fly(constrained)
    contenders, left_out = _time_contenders(constrained, base.control, solvers, progress)

    own_tilt = _own_tilt(spec)
    tilted = {tilt: _with_tilt(constrained, tilt) for tilt in sorted({*tilts} | ({own_tilt} if own_tilt else set()))}
    shortened = {n: _with_controller(constrained, horizon=n) for n in sorted({*horizons, spec.horizon})}
    varied = _variants(constrained, arm_lengths, drags)
    apart = _named([each for each in others if not _is_counterpart(each, constrained)])

    wanted = [*shortened.values(), *tilted.values(), *varied.values()]
    wanted += [_without_constraints(each) for each in (constrained, *shortened.values())] + [*apart.values()]
    flown = _fly_all(wanted, {constrained.to_toml(): base}, workers, progress)

    def outcome(scenario: Scenario) -> Outcome:
        return flown[scenario.to_toml()].outcome

    timed = _time_flights([*tilted.values(), *shortened.values()], flown, progress)

    def point(value: float, scenario: Scenario, *, free: bool) -> SweepPoint:
        return SweepPoint(
            value=value,
            constrained=outcome(scenario),
            step_ms=timed.get(scenario.to_toml(), {}),
            unconstrained=outcome(_without_constraints(scenario)) if free else None,
        )

    return CostStudy(
        name=constrained.name,
        horizon=spec.horizon,
        deadline_ms=1e3 * constrained.control_period,
        duration=constrained.duration,
        constrained=base.outcome,
        unconstrained=outcome(_without_constraints(constrained)),
        others={name: outcome(scenario) for name, scenario in apart.items()},
        reference=_reference_settling(constrained),
        contenders=contenders,
        left_out=left_out,
        tilt=Sweep(
            name="tilt bound",
            unit="deg",
            base=own_tilt,
            points=tuple(point(tilt, scenario, free=False) for tilt, scenario in tilted.items()),
        ),
        horizons=Sweep(
            name="horizon",
            unit="periods",
            base=spec.horizon,
            points=tuple(point(n, scenario, free=True) for n, scenario in shortened.items()),
        ),
        variations=_variations(varied, flown),
        machine=machine(),
    )


def fly_variations(
    constrained: Scenario,
    *,
    arm_lengths: Sequence[float] = ARM_LENGTHS,
    drags: Sequence[float] = DRAGS,
    workers: int | None = None,
) -> tuple[Variation, ...]:
    """The constrained flight over the parameters that the paper leaves out; see `study_cost`."""
    varied = _variants(constrained, arm_lengths, drags)
    return _variations(varied, _fly_all([*varied.values()], {}, workers, silent))


def _variants(
    scenario: Scenario, arm_lengths: Sequence[float], drags: Sequence[float]
) -> dict[tuple[float, float], Scenario]:
    return {(arm, drag): _with_vehicle(scenario, arm, drag) for arm in arm_lengths for drag in drags}


def _variations(varied: Mapping[tuple[float, float], Scenario], flown: Mapping[str, _Flown]) -> tuple[Variation, ...]:
    return tuple(
        Variation(arm_length=arm, drag_to_thrust=drag, outcome=flown[scenario.to_toml()].outcome)
        for (arm, drag), scenario in varied.items()
    )


def _scenario_of(target: str) -> str:
    return str(Path(target) / SCENARIO_FILE) if Path(target).is_dir() else target


def _fly(scenario: Scenario) -> _Flown:
    flight = fly_scenario(scenario)
    return _Flown(outcome=_outcome(scenario, flight.log), control=flight.log.control)


def _outcome(scenario: Scenario, log: FlightLog) -> Outcome:
    control = log.control
    outputs = control.state[:, REFERENCE_STATES]
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
    """A value for each of `quadsim.cost.MEASURES`."""
    tracking, control = metrics.tracking(log.control), metrics.control(log.control)
    rmse = tracking["rmse"]
    return {
        "tilt_sampled": metrics.peak_tilt(log.control.state),
        "tilt_plant": metrics.peak_tilt(log.plant.state),
        **{f"rmse_{axis}": rmse[axis] for axis in "xyz"},
        "rmse_yaw": float(np.degrees(rmse["yaw"])),
        "end_error": max(abs(error) for error in tracking["final_error"].values()),
        "speed_max": control["speed_max"],
        "step_max": max(-control["slew_min"], control["slew_max"]),
        "total_variation": control["total_variation"],
    }


def _reference_settling(scenario: Scenario) -> list[dict[str, Any]]:
    """Settling of the filtered reference itself."""
    t = np.arange(scenario.periods, dtype=np.float64) * scenario.control_period
    return metrics.settling(t, build_reference(scenario, t.size), build_course_steps(scenario))


# Scenarios that differ from the constrained one in one thing.


def _with_controller(scenario: Scenario, **changes: Any) -> Scenario:
    return scenario.model_copy(update={"controller": scenario.controller.model_copy(update=changes)})


def _with_tilt(scenario: Scenario, tilt: float) -> Scenario:
    assert isinstance(scenario.controller, ConstrainedSpec)
    bounds = {**scenario.controller.output_bounds, "roll": [-tilt, tilt], "pitch": [-tilt, tilt]}
    return _with_controller(scenario, output_bounds=bounds)


def _with_vehicle(scenario: Scenario, arm_length: float, drag_to_thrust: float) -> Scenario:
    changes = {"arm_length": arm_length, "drag_to_thrust": drag_to_thrust}
    return scenario.model_copy(update={"vehicle": scenario.vehicle.model_copy(update=changes)})


def _without_constraints(scenario: Scenario) -> Scenario:
    spec = scenario.controller
    free = UnconstrainedSpec(
        type="unconstrained",
        horizon=spec.horizon,
        output_weights=spec.output_weights,
        input_weights=spec.input_weights,
    )
    return scenario.model_copy(update={"controller": free})


def _own_tilt(spec: ConstrainedSpec) -> float | None:
    """The one number that bounds roll and pitch alike [deg], or None."""
    bounds = {abs(bound) for name in ("roll", "pitch") for bound in spec.output_bounds.get(name, [])}
    both = {"roll", "pitch"} <= spec.output_bounds.keys()
    return bounds.pop() if both and len(bounds) == 1 else None


def _course(scenario: Scenario) -> tuple[Any, ...]:
    """What two flights must share to be compared by their controllers."""
    return (
        scenario.reference,
        scenario.initial,
        scenario.duration,
        scenario.control_period,
        scenario.plant,
        build_vehicle(scenario),
    )


def _named(scenarios: Sequence[Scenario]) -> dict[str, Scenario]:
    """Scenarios by name, those that share one numbered."""
    named: dict[str, Scenario] = {}
    for each in scenarios:
        shared = sum(each.name == other.name for other in named.values())
        named[f"{each.name} ({shared + 1})" if shared else each.name] = each
    return named


def _is_counterpart(scenario: Scenario, constrained: Scenario) -> bool:
    """Whether an unconstrained flight of the course is the constrained one, but for its constraints."""
    free = _without_constraints(constrained)
    return all(getattr(scenario, name) == getattr(free, name) for name in ("controller", "vehicle", "plant"))


# Times and flights.


def _time_contenders(
    scenario: Scenario, log: ControlLog, solvers: Sequence[str], progress: Progress
) -> tuple[tuple[Contender, ...], dict[str, str]]:
    """Everything that can compute a command, timed on the queries of a flight; and what could not take part."""
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
    queries = recorded(scenario, log, problem.horizon)
    total, done = REPEATS * len(controllers) * log.t.size, 0
    passes: dict[str, list[tuple[Array, tuple[str, ...]]]] = {name: [] for name in controllers}

    def report() -> None:
        nonlocal done
        done += 1
        progress("steps", done, total)

    for _ in range(REPEATS):
        for name, controller in controllers.items():
            if any(step_ms.sum() > 1e3 * LONGEST_PASS for step_ms, _ in passes[name]):
                done += log.t.size
            else:
                passes[name].append(time_steps(controller, queries, progress=report))
    progress("steps", total, total)
    contenders = (
        Contender(
            name=name,
            step_ms=np.min([step_ms for step_ms, _ in timed], axis=0),
            statuses=timed[0][1],
            repeats=len(timed),
        )
        for name, timed in passes.items()
    )
    return tuple(contenders), left_out


def _time_flights(
    scenarios: Sequence[Scenario], flown: Mapping[str, _Flown], progress: Progress
) -> dict[str, dict[str, float]]:
    """Median, percentiles and maximum of each flight's controller step [ms], by the scenario's text.

    A flight of not one period has none.
    """
    texts = {scenario.to_toml(): scenario for scenario in scenarios}
    timed: dict[str, dict[str, float]] = {}
    for done, (text, scenario) in enumerate(texts.items()):
        log = flown[text].control
        if log.t.size:
            controller = build_controller(scenario, build_vehicle(scenario))
            queries = recorded(scenario, log, controller.horizon)
            passes = [time_steps(controller, queries, stride=SWEEP_STRIDE)[0] for _ in range(SWEEP_REPEATS)]
            timed[text] = metrics.percentiles(np.min(passes, axis=0))
        progress("sweeps", done + 1, len(texts))
    return timed


def _fly_all(
    scenarios: Sequence[Scenario], flown: Mapping[str, _Flown], workers: int | None, progress: Progress
) -> dict[str, _Flown]:
    """Fly what was not flown yet, over processes; results, with those given, by the scenario's text."""
    results = dict(flown)
    wanted = {text: scenario for scenario in scenarios if (text := scenario.to_toml()) not in results}
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    context = multiprocessing.get_context("spawn")  # a fork would take over whatever threads hold
    pool = ProcessPoolExecutor(workers or cores, mp_context=context, initializer=_leave_interrupts_to_parent)
    try:
        futures = {pool.submit(_fly, scenario): text for text, scenario in wanted.items()}
        for done, future in enumerate(as_completed(futures), start=1):
            results[futures[future]] = future.result()
            progress("flights", done, len(futures))
    finally:
        pool.shutdown(cancel_futures=True)
    return results


def _leave_interrupts_to_parent() -> None:
    """Ctrl-C reaches every process of a terminal; the parent alone is to say so."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
