"""Faults at the solver, the sensors and the computer, put into flights of the paper's course at seeded instants."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Final
from unittest import mock

import numpy as np
from threadpoolctl import threadpool_limits

from mpc.fallback import Guarded
from mpc.solvers import _piqp
from quadsim.controller import SOLVED, Command, Controller, Moment
from quadsim.flightlog import FlightLog
from quadsim.sensing import SensorName
from quadsim.state import POSITION, Array
from scenarios.bench.climbers import FULL, equip
from scenarios.bench.processes import answer_all
from scenarios.bench.rungs import CONDITIONS
from scenarios.build import build_controller, build_plant, build_problem, build_reference, build_vehicle
from scenarios.flying import fly_once
from scenarios.loading import load_scenario
from scenarios.navigation import build_navigation

CONTROLLERS: Final = ("robust", "paper")
"""The full robust controller, and the paper's; both guarded."""
NEAR: Final = 0.1
"""Distance from the flight without the fault that counts as back [m].  The reference is no measure: in the climb, at
its bounds, the vehicle is metres behind it."""
SOON: Final = 10.0
"""Time from the fault's beginning in which the vehicle has to be back [s]."""
AFTER: Final = 12.0
"""Time flown from the fault's beginning [s]."""
STATUSES: Final = tuple(sorted({*_piqp.STATUS.values()} - {SOLVED}))


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One thing that goes wrong.

    Attributes:
        name: what it is.
        statuses: what the solver answers, period by period, instead of its optimum; all it gives is NaN then.
        events: entries of the scenario's events, but for their time; as TOML.
    """

    name: str
    statuses: tuple[str, ...] = ()
    events: tuple[str, ...] = ()


def faults() -> tuple[Fault, ...]:
    """Each status of PIQP, ten failures on end, a stall, NaN in each measured number, frozen sensors, all at once."""

    def sensed(sensor: str, kind: str, duration: float) -> str:
        return f"type='sensor_fault', sensor='{sensor}', fault='{kind}', duration={duration}"

    return (
        *(Fault(name=f"solver: {status}", statuses=(status,)) for status in STATUSES),
        Fault(name="solver: 10 failures on end", statuses=("numerics",) * 10),
        Fault(name="computer: stalls for 100 ms", events=("type='stall', duration=0.1",)),
        *(
            Fault(name=f"{sensor} {axis}: NaN for 1 s", events=(f"{sensed(sensor, 'nan', 1.0)}, axes=['{axis}']",))
            for sensor in SensorName
            for axis in "xyz"
        ),
        *(Fault(name=f"{sensor}: frozen for 0.5 s", events=(sensed(sensor, "freeze", 0.5),)) for sensor in SensorName),
        *(
            Fault(name=f"all sensors: {what}", events=tuple(sensed(sensor, kind, duration) for sensor in SensorName))
            for what, kind, duration in (("NaN for 1 s", "nan", 1.0), ("frozen for 0.5 s", "freeze", 0.5))
        ),
    )


@dataclass(frozen=True, kw_only=True)
class Injection:
    """A fault in a flight: of which controller, and when [s]."""

    controller: str
    fault: Fault
    start: float


@dataclass(frozen=True, kw_only=True)
class Consequence:
    """What came of it.

    Attributes:
        injection: what was done.
        reason: why the flight ended early; None when it did not.
        finite: whether every command was finite.
        within: whether every command kept its bounds on speeds and steps.
        fallback: deepest level.
        furthest: largest distance from the flight without the fault [m].
        back: time from the fault's beginning to the last instant out of `NEAR` [s]; 0 for none.
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
        """Whether the contract was kept."""
        return self.reason is None and self.finite and self.within and self.back <= SOON


def draw(count: int, *, seed: int = 0, earliest: float = 1.0, latest: float = 47.0) -> list[Injection]:
    """Faults of all kinds, in turns in a random order, at so many random instants; each for both controllers."""
    rng = np.random.default_rng(seed)
    kinds = faults()
    order = [kinds[i] for _ in range(-(-count // len(kinds))) for i in rng.permutation(len(kinds))][:count]
    starts = 0.05 * rng.integers(round(20 * earliest), round(20 * latest), count, endpoint=True)
    return [
        Injection(controller=controller, fault=fault, start=round(float(start), 9))
        for controller in CONTROLLERS
        for fault, start in zip(order, starts, strict=True)
    ]


def inject_all(injections: list[Injection], **options: Any) -> list[Consequence]:
    """Fly all of them, over processes; options are those of `answer_all`."""
    return answer_all(inject, injections, **options)


def inject(injection: Injection, *, longest: float = 60.0) -> Consequence:
    """Fly one of them, until `AFTER` from its beginning; the flight without it lasts `longest` [s]."""
    fault, start = injection.fault, injection.start
    events = ", ".join(f"{{at={start}, {event}}}" for event in fault.events)
    log = _fly(injection.controller, start + AFTER, (f"events=[{events}]",), fault.statuses, start)
    sound = _sound_flight(injection.controller, longest)
    control = log.control
    there = sound.control.truth[: control.t.size, list(POSITION)]
    gap = np.linalg.norm(control.truth[:, list(POSITION)] - there, axis=1)
    out = control.t[gap > NEAR]
    bounds = build_problem(*_built()).bounds
    assert bounds is not None
    speeds, steps = control.speeds, control.slews
    inside = [speeds - bounds.u_min, bounds.u_max - speeds, steps - bounds.delta_min, bounds.delta_max - steps]
    return Consequence(
        injection=injection,
        reason=log.reason,
        finite=bool(np.isfinite(speeds).all()),
        within=bool(min(part.min() for part in inside) >= -1e-6),
        fallback=int(control.fallback.max()),
        furthest=float(gap.max()),
        back=round(float(out[-1] - start), 9) if out.size else 0.0,
    )


@cache
def _built() -> Any:
    scenario = load_scenario("paper-constrained")
    return scenario, build_vehicle(scenario)


@cache
def _sound_flight(controller: str, duration: float) -> FlightLog:
    return _fly(controller, duration, (), (), 0.0)


def _fly(
    controller: str, duration: float, events: tuple[str, ...], statuses: tuple[str, ...], start: float
) -> FlightLog:
    """A flight; without the shortcut, so that there is a QP to fail in every period."""
    settings = ("controller.shortcut=false", "controller.fallback.enabled=true", *events)
    scenario = load_scenario("paper-constrained", (f"duration={round(duration, 9)}", *settings))
    if controller == "robust":
        scenario = equip(scenario, FULL, CONDITIONS["nominal"])
    vehicle = build_vehicle(scenario)
    with threadpool_limits(limits=1), _failing_solver() as solver, build_plant(scenario, vehicle) as plant:
        guarded = build_controller(scenario, vehicle)
        assert isinstance(guarded, Guarded)
        guarded.inner = _Watched(guarded.inner, solver, start, scenario.control_period, statuses)
        return fly_once(
            scenario,
            vehicle,
            plant,
            guarded,
            build_reference(scenario, scenario.periods + guarded.horizon),
            navigation=build_navigation(scenario, vehicle),
        )


class _FailingSolver:
    """Stands between PIQP and all controllers; answers `status` where that is not `solved`, and nothing else."""

    status: str = SOLVED

    def solve(self, real: Any, solver: Any, vectors: Any, *, rows: int) -> Any:
        answer = real(solver, vectors, rows=rows)
        if self.status == SOLVED:
            return answer
        spoilt = {name: np.full_like(getattr(answer, name), np.nan) for name in ("x", "y", "z", "z_box")}
        return type(answer)(**{**vars(answer), **spoilt, "status": self.status})


@contextlib.contextmanager
def _failing_solver() -> Iterator[_FailingSolver]:
    failing = _FailingSolver()
    with mock.patch.object(_piqp, "solve", partial(failing.solve, _piqp.solve)):
        yield failing


class _Watched:
    """A controller whose solver fails in chosen periods."""

    def __init__(
        self, inner: Controller, solver: _FailingSolver, start: float, period: float, statuses: tuple[str, ...]
    ) -> None:
        self.inner, self._solver, self._start, self._period, self._statuses = inner, solver, start, period, statuses

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def step(self, now: Moment, state: Array, reference: Array) -> Command:
        since = round((now.time - self._start) / self._period)
        self._solver.status = self._statuses[since] if 0 <= since < len(self._statuses) else SOLVED
        return self.inner.step(now, state, reference)
