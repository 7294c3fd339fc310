"""Faults at the solver, the sensors and the computer, put into flights of the paper's course at seeded instants."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Final
from unittest import mock

import numpy as np
from threadpoolctl import threadpool_limits

from mpc.answer import Answer
from mpc.exact.shortcut import Shortcut
from mpc.fallback.contract import Guarded
from mpc.ocp import Query
from mpc.solvers import piqp_backends
from quadsim.controller import SOLVED, Command, Controller, Moment
from quadsim.flight.log import FlightLog
from quadsim.sim.physics import Segment
from quadsim.sim.plant import Plant
from quadsim.sim.sensing.sensor import SensorName
from quadsim.state import POSITION, Array
from quadsim.vehicle import N_ROTORS, Vehicle
from scenarios.bench.mismatch.conditions import CONDITIONS
from scenarios.bench.mismatch.controllers import FULL, equip
from scenarios.build import build_controller, build_plant, build_problem
from scenarios.courses.make import build_reference
from scenarios.loading import load_scenario
from scenarios.many import answers
from scenarios.parts.navigation import build_navigation
from scenarios.parts.vehicle import build_vehicle
from scenarios.run import fly_once
from scenarios.schema.scenario import Scenario

PERIOD: Final = 0.05
"""Of control [s]."""
CONTROLLERS: Final = ("robust", "paper")
"""The full robust controller, and the paper's; both guarded."""
DISTURBANCES: Final = ("mass +30 %", "mass -30 %", "worn rotor", "lag 50 ms")
"""In which the robust controller meets faults, beside the nominal condition.  The paper's is lost in two of them."""
EARLIEST: Final = {"worn rotor": 14.0}
"""Instant from which on there are faults, where that is later than else [s]: one thing fails at a time."""
NEAR: Final = 0.1
"""Distance from the flight without the fault that counts as back [m].  The reference is no measure: in the climb, at
its bounds, the vehicle is metres behind it."""
SOON: Final = 10.0
"""Time from the fault's end in which the vehicle has to be back [s]."""
AFTER: Final = 12.0
"""Time flown from the fault's end [s]."""
LAST: Final = 60.0
"""Time at which the paper's course ends [s]."""
STATUSES: Final = tuple(sorted({*piqp_backends.STATUS.values()} - {SOLVED}))


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One thing that goes wrong.

    Attributes:
        name: what it is.
        duration: from its beginning to its end [s].
        statuses: what the solver answers, period by period, instead of its optimum; all it gives is NaN then.
        events: entries of the scenario's events, but for their time; as TOML.
    """

    name: str
    duration: float
    statuses: tuple[str, ...] = ()
    events: tuple[str, ...] = ()


def failing(name: str, statuses: Sequence[str]) -> Fault:
    """The solver answers these in successive periods."""
    return Fault(name=f"solver: {name}", duration=PERIOD * len(statuses), statuses=tuple(statuses))


def faults() -> tuple[Fault, ...]:
    """Each status of PIQP, ten failures on end, a stall, NaN in each measured number, frozen sensors, all at once."""

    def sensed(name: str, kind: str, duration: float, sensors: Sequence[str], axis: str = "") -> Fault:
        what = f"fault='{kind}', duration={duration}" + (f", axes=['{axis}']" if axis else "")
        events = tuple(f"type='sensor_fault', sensor='{sensor}', {what}" for sensor in sensors)
        return Fault(name=f"{name} for {duration:g} s", duration=duration, events=events)

    return (
        *(failing(status, (status,)) for status in STATUSES),
        failing("10 failures on end", ("numerics",) * 10),
        Fault(name="computer: stalls for 100 ms", duration=0.1, events=("type='stall', duration=0.1",)),
        *(sensed(f"{sensor} {axis}: NaN", "nan", 1.0, (sensor,), axis) for sensor in SensorName for axis in "xyz"),
        *(sensed(f"{sensor}: frozen", "freeze", 0.5, (sensor,)) for sensor in SensorName),
        sensed("all sensors: NaN", "nan", 1.0, tuple(SensorName)),
        sensed("all sensors: frozen", "freeze", 0.5, tuple(SensorName)),
    )


@dataclass(frozen=True, kw_only=True)
class Injection:
    """A fault in a flight: of which controller, when [s], and under which of `mismatch.conditions.CONDITIONS`."""

    controller: str
    fault: Fault
    start: float
    condition: str = "nominal"

    @property
    def stop(self) -> float:
        """The fault's end [s]."""
        return self.start + self.fault.duration


@dataclass(frozen=True, kw_only=True)
class Consequence:
    """What came of it.

    Attributes:
        injection: what was done.
        reason: why the flight ended early; None when it did not.
        finite: whether everything that the plant was given was finite.
        within: whether it held the bounds on speeds and steps.
        fallback: deepest level.
        furthest: largest distance from the flight without the fault [m].
        back: time from the fault's end to the last instant out of `NEAR` [s]; 0 for none.
    """

    injection: Injection
    reason: str | None
    finite: bool
    within: bool
    fallback: int
    furthest: float
    back: float

    @property
    def harmless(self) -> bool:
        """Whether the contract held."""
        return self.reason is None and self.finite and self.within and self.back <= SOON


def draw(count: int, *, seed: int = 0, earliest: float = 1.0, latest: float = LAST - AFTER - 1.0) -> list[Injection]:
    """Faults of all kinds, in turns in a random order, at this many random instants; each for both controllers.

    The robust controller meets each kind under a disturbance first, then in all conditions in turns.
    """
    rng = np.random.default_rng(seed)
    kinds = faults()
    injections = []
    for k, i in enumerate(
        np.concatenate([rng.permutation(len(kinds)) for _ in range(-(-count // len(kinds)))])[:count]
    ):
        conditions = DISTURBANCES if k < len(kinds) else ("nominal", *DISTURBANCES)
        condition = conditions[k % len(conditions)]
        first = max(earliest, EARLIEST.get(condition, 0.0))
        start = round(PERIOD * int(rng.integers(round(first / PERIOD), round(latest / PERIOD), endpoint=True)), 9)
        injections.append(Injection(controller="robust", fault=kinds[i], start=start, condition=condition))
    return [*injections, *(replace(each, controller="paper", condition="nominal") for each in injections)]


def draw_flight(controller: str, condition: str, count: int, *, seed: int) -> list[Injection]:
    """This many different faults for one flight, over all of it, each after what came of the one before."""
    rng = np.random.default_rng(seed)
    kinds = faults()
    chosen = [kinds[i] for i in rng.permutation(len(kinds))[:count]]
    earliest = max(1.0, EARLIEST.get(condition, 0.0))
    slack = LAST - earliest - sum(fault.duration + SOON for fault in chosen)
    waits = np.diff(np.sort(rng.uniform(0.0, slack, count)), prepend=0.0)
    injections, free = [], earliest
    for fault, wait in zip(chosen, waits, strict=True):
        start = PERIOD * math.floor((free + wait) / PERIOD)
        injections.append(Injection(controller=controller, fault=fault, start=round(start, 9), condition=condition))
        free += wait + fault.duration + SOON
    return injections


def inject_all(injections: list[Injection], **options: Any) -> list[Consequence]:
    """Fly all of them, over processes; options are those of `answers`."""
    return answers(inject, injections, **options)


def inject(injection: Injection, *, longest: float = LAST) -> Consequence:
    """Fly one of them, until `AFTER` from its end; the flight without it lasts `longest` [s]."""
    return fly_with([injection], longest=longest)[0]


def fly_with(injections: Sequence[Injection], *, longest: float = LAST, shortcut: bool = False) -> list[Consequence]:
    """Fly several in one flight, of the same controller and condition, in the order of their instants.

    Each is judged until the next begins.  With the shortcut, the whole QP is solved where the solver is to fail, and
    otherwise only where the shortcut has no answer: as in everyday flights, and in half the time.
    """
    first, last = injections[0], injections[-1]
    duration = min(last.stop + AFTER, LAST)
    log, given = _fly(first.controller, first.condition, duration, injections, shortcut=shortcut)
    sound, _ = _sound_flight(first.controller, first.condition, longest)
    control = log.control
    there = sound.control.truth[: control.t.size, list(POSITION)]
    gap = np.linalg.norm(control.truth[:, list(POSITION)] - there, axis=1)
    finite, within = judge(given)
    consequences = []
    for injection, until in zip(injections, [*(each.start for each in injections[1:]), math.inf], strict=True):
        rows = (control.t >= injection.start - 1e-9) & (control.t < until - 1e-9)
        out = control.t[rows][gap[rows] > NEAR]
        consequences.append(
            Consequence(
                injection=injection,
                reason=log.reason,
                finite=finite,
                within=within,
                fallback=int(control.fallback[rows].max(initial=0)),
                furthest=float(gap[rows].max(initial=0.0)),
                back=max(0.0, round(float(out[-1] - injection.stop), 9)) if out.size else 0.0,
            )
        )
    return consequences


def judge(given: Array) -> tuple[bool, bool]:
    """Whether commands (M, 4), in the order in which they acted, are finite, and within the paper's bounds."""
    bounds = build_problem(*_built()).bounds
    assert bounds is not None
    before = np.full((1, N_ROTORS), _built()[1].hover_speed)
    steps = np.diff(np.concatenate([before, given]), axis=0)
    margins = [given - bounds.u_min, bounds.u_max - given, steps - bounds.delta_min, bounds.delta_max - steps]
    return bool(np.isfinite(given).all()), all(bool((margin >= -1e-6).all()) for margin in margins)  # as NaN is not


@contextlib.contextmanager
def recorded(plant: Plant) -> Iterator[list[Array]]:
    """Everything (4,) that the plant is commanded to hold, before it looks at it."""
    given: list[Array] = []
    real = plant.advance

    def advance(speeds: Array, steps: int) -> Segment:
        given.append(np.array(speeds, float))
        return real(speeds, steps)

    with mock.patch.object(plant, "advance", advance):
        yield given


@cache
def _built() -> tuple[Scenario, Vehicle]:
    scenario = load_scenario("paper-constrained")
    return scenario, build_vehicle(scenario)


@cache
def _sound_flight(controller: str, condition: str, duration: float) -> tuple[FlightLog, Array]:
    """With the shortcut, whose answers are those of the whole QP within 1e-6 rad/s."""
    return _fly(controller, condition, duration, (), shortcut=True)


def _fly(
    controller: str, condition: str, duration: float, injections: Sequence[Injection], *, shortcut: bool = False
) -> tuple[FlightLog, Array]:
    """A flight, and what the plant was given (M, 4); without the shortcut there is a QP in every period."""
    switch = f"controller.shortcut={str(shortcut).lower()}"
    settings = (f"duration={round(duration, 9)}", switch, "controller.fallback.enabled=true")
    scenario = load_scenario("paper-constrained", (*settings, *CONDITIONS[condition].settings))
    events = [f"{{at={each.start}, {event}}}" for each in injections for event in each.fault.events]
    faulty = load_scenario("paper-constrained", (settings[0], f"events=[{', '.join(events)}]"))
    if controller == "robust":
        scenario = equip(scenario, FULL, CONDITIONS[condition])
        whole = scenario.controller.model_copy(update={"shortcut": shortcut})
        scenario = scenario.model_copy(update={"controller": whole})
    scenario = scenario.model_copy(update={"events": [*scenario.events, *faulty.events]})
    vehicle = build_vehicle(scenario)
    with threadpool_limits(limits=1), _failing_solver() as solver, build_plant(scenario, vehicle) as plant:
        guarded = build_controller(scenario, vehicle)
        assert isinstance(guarded, Guarded)
        guarded.inner = _Watched(guarded.inner, solver, injections)
        reference = build_reference(scenario, scenario.periods + guarded.horizon)
        navigation = build_navigation(scenario, vehicle)
        with recorded(plant) as given:
            log = fly_once(scenario, vehicle, plant, guarded, reference, navigation=navigation)
    return log, np.array(given)


class _FailingSolver:
    """Stands between PIQP and all controllers; answers `status` where that is not `solved`, and nothing else."""

    status: str = SOLVED

    def solve(self, real: Any, backend: Any, qp: Any) -> Any:
        found = real(backend, qp)
        if self.status == SOLVED:
            return found
        nowhere = {name: getattr(found, name) * np.nan for name in ("x", "y", "z", "z_box")}
        return found._replace(**nowhere, status=self.status)


@contextlib.contextmanager
def _failing_solver() -> Iterator[_FailingSolver]:
    failing = _FailingSolver()
    shortest, real = Shortcut.solve, piqp_backends._Piqp.solve

    def solve(shortcut: Shortcut, query: Query) -> Answer:
        """The whole QP where it is to fail: there is nothing to fail in a shortcut."""
        return shortest(shortcut, query) if failing.status == SOLVED else shortcut._whole.solve(query)

    with (
        mock.patch.object(piqp_backends._Piqp, "solve", lambda backend, qp: failing.solve(real, backend, qp)),
        mock.patch.object(Shortcut, "solve", solve),
    ):
        yield failing


class _Watched:
    """A controller whose solver fails in chosen periods."""

    def __init__(self, inner: Controller, solver: _FailingSolver, injections: Sequence[Injection]) -> None:
        self.inner, self._solver = inner, solver
        self._statuses = {
            round(each.start / PERIOD) + k: status
            for each in injections
            for k, status in enumerate(each.fault.statuses)
        }

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def step(self, now: Moment, state: Array, reference: Array) -> Command:
        self._solver.status = self._statuses.get(round(now.time / PERIOD), SOLVED)
        return self.inner.step(now, state, reference)
