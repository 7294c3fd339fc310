"""The study of what constraints cost: which comparisons call for one, and what is flown and timed for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from mpc.solvers import SOLVERS, make_backend
from quadsim.errors import InputError
from quadsim.flight import metrics
from quadsim.flight.rundir import SCENARIO_FILE
from scenarios.cost.cost_flights import (
    Flown,
    course,
    fly,
    fly_all,
    is_counterpart,
    key,
    named,
    time_candidates,
    time_flights,
    with_controller,
    with_tilt,
    with_vehicles,
    without_constraints,
)
from scenarios.cost.study import CandidateTimes, CostStudy, Outcome, Sweep, SweepPoint, Variation
from scenarios.courses.make import build_course_steps, build_reference
from scenarios.loading import load_scenario
from scenarios.machine import machine
from scenarios.progress import Progress, silent
from scenarios.schema.controller import ConstrainedSpec, UnconstrainedSpec, shared_tilt_bound
from scenarios.schema.scenario import Scenario

TILTS: Final = (2.0, 3.0, 4.0, 5.0, 7.0, 10.0, 15.0, 20.0)  # bounds on roll and pitch that are tried [deg]
HORIZONS: Final = (10, 15, 20, 30, 50, 75, 100)  # horizons that are tried, N
ARM_LENGTHS: Final = (0.2, 0.3, 0.5)  # L [m]; the paper gives none
DRAGS: Final = (0.012, 0.024, 0.048)  # d/b [m]; the paper gives none
SOLVERS_TIMED: Final = ("piqp-multistage", "piqp-dense", "qpoases")  # both of this project, and the paper's own
LONGEST_UNREQUESTED: Final = 120.0
"""A course that takes longer than this [s] is studied only on request: it is flown about thirty times."""


def find_study(targets: Sequence[str], *, requested: bool | None) -> list[Scenario]:
    """The first constrained scenario of runs or scenarios that are compared, and all unconstrained ones of its course.

    Where `requested` is None a study is made where a constrained and an unconstrained controller fly one course, which
    takes no longer than `LONGEST_UNREQUESTED`; nothing is returned where none is to be made.

    Raises:
        InputError: a study is requested, and nothing is flown by a constrained controller.
    """
    if requested is False:
        return []
    try:
        files = [Path(target) / SCENARIO_FILE if Path(target).is_dir() else target for target in targets]
        scenarios = [load_scenario(str(file)) for file in files]
    except InputError:
        if requested:
            raise
        return []  # a run can be compared all the same, and what is no run is refused when it is read
    constrained = next((each for each in scenarios if isinstance(each.controller, ConstrainedSpec)), None)
    if constrained is None:
        if requested:
            raise InputError("--cost needs a flight by a constrained controller among those that are compared")
        return []
    assert isinstance(constrained.controller, ConstrainedSpec)
    others = [
        each
        for each in scenarios
        if isinstance(each.controller, UnconstrainedSpec) and course(each) == course(constrained)
    ]
    flyable = SOLVERS[constrained.controller.solver].installed
    if requested is None and (not others or constrained.duration > LONGEST_UNREQUESTED or not flyable):
        return []
    if not flyable:
        make_backend(constrained.controller.solver)  # reports what is missing, before anything is flown
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
    timed: Sequence[CandidateTimes] | None = None,
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
        timed: the gain without constraints, the controller as flown, and solvers, where they have been timed already.
        workers: processes that fly; one per usable core by default.
        progress: called with how much is done, of how much.

    Returns:
        The study.
    """
    spec = constrained.controller
    assert isinstance(spec, ConstrainedSpec)
    base = fly(constrained)
    if timed is None:
        candidates, left_out = time_candidates(constrained, base.control, solvers, progress)
    else:
        candidates, left_out = tuple(timed), {}

    own = shared_tilt_bound(spec)
    tilted = {tilt: with_tilt(constrained, tilt) for tilt in sorted({*tilts} | ({own} if own else set()))}
    shortened = {n: with_controller(constrained, horizon=n) for n in sorted({*horizons, spec.horizon})}
    varied = with_vehicles(constrained, arm_lengths, drags)
    apart = named([each for each in others if not is_counterpart(each, constrained)])

    wanted = [*shortened.values(), *tilted.values(), *varied.values()]
    wanted += [without_constraints(each) for each in (constrained, *shortened.values())] + [*apart.values()]
    flown = fly_all(wanted, {key(constrained): base}, workers, progress)

    def outcome(scenario: Scenario) -> Outcome:
        return flown[key(scenario)].outcome

    swept = [
        each for each in (*tilted.values(), *shortened.values()) if not candidates or key(each) != key(constrained)
    ]
    steps = time_flights(swept, flown, progress)
    if candidates:
        steps[key(constrained)] = metrics.percentiles(candidates[1].step_ms)

    def point(value: float, scenario: Scenario, *, free: bool) -> SweepPoint:
        return SweepPoint(
            value=value,
            constrained=outcome(scenario),
            step_ms=steps.get(key(scenario), {}),
            unconstrained=outcome(without_constraints(scenario)) if free else None,
        )

    t = np.arange(constrained.periods, dtype=np.float64) * constrained.control_period
    return CostStudy(
        name=constrained.name,
        horizon=spec.horizon,
        deadline_ms=1e3 * constrained.control_period,
        duration=constrained.duration,
        constrained=base.outcome,
        unconstrained=outcome(without_constraints(constrained)),
        others={name: outcome(scenario) for name, scenario in apart.items()},
        reference=metrics.settling(t, build_reference(constrained, t.size), build_course_steps(constrained)),
        candidates=candidates,
        left_out=left_out,
        tilt=Sweep(
            name="tilt bound",
            unit="deg",
            base=own,
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
    varied = with_vehicles(constrained, arm_lengths, drags)
    return _variations(varied, fly_all([*varied.values()], {}, workers, silent))


def _variations(varied: Mapping[tuple[float, float], Scenario], flown: Mapping[str, Flown]) -> tuple[Variation, ...]:
    return tuple(
        Variation(arm_length=arm, drag_to_thrust=drag, outcome=flown[key(scenario)].outcome)
        for (arm, drag), scenario in varied.items()
    )
