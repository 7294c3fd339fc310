"""The events of a flight, scheduled in its scenario or applied during it; `quadsim.rollout.rollout` applies them.

Where an event may occur, the model is compiled, sensors are sampled and forces are evaluated in another way than
without events, with other last bits.  A neutral event, which changes nothing, selects that way: it is in the scenario
of a live flight and in the scenario saved from it, whether or not an event of its kind occurred.
"""

from __future__ import annotations

import math
from bisect import insort
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING, Any, Final, NamedTuple, get_args

from quadsim.controller import Controller, Diagnosable
from quadsim.errors import InputError, ParameterError, printable
from quadsim.mpc.problem.ocp import InfeasiblePeriod
from quadsim.scenarios.schema.controllers import AnyController, changed_controller
from quadsim.scenarios.schema.events import (
    MOST_EVENTS,
    ControllerEvent,
    Event,
    SensorFaultEvent,
    SensorText,
    SetpointEvent,
    first_period,
)
from quadsim.scenarios.schema.problems import parse_table
from quadsim.sim.computation import Stall
from quadsim.sim.effects import LOADING, Push
from quadsim.sim.effects.load import Load, MassChange, PayloadDrop, PayloadPickup
from quadsim.sim.effects.wind import Air, Gust, WindChange
from quadsim.sim.loop import ClosedLoop
from quadsim.sim.navigation import Navigation
from quadsim.sim.plant import Plant
from quadsim.sim.sensing import SensorName
from quadsim.state import REFERENCE_NAMES

if TYPE_CHECKING:
    from quadsim.scenarios.assembly import Assembly
    from quadsim.scenarios.courses.followed import FollowedCourse
    from quadsim.scenarios.schema.scenario import Scenario

_DEPENDENT: Final = (ControllerEvent, PayloadDrop, PayloadPickup, SensorFaultEvent)
"""The events that depend on other parts of the scenario."""
TRACKING_ERRORS: Final = frozenset(f"{name}_error" for name in REFERENCE_NAMES)  # signals relative to the course
_MOST_SINGLY: Final = 3  # longest run of events of one kind that is reported singly; longer runs become one entry
_LONGEST_TEXT: Final = 200  # characters of an event in a summary


@dataclass(frozen=True, kw_only=True)
class Successor:
    """A controller that is ready to take over, and its table in a scenario file."""

    spec: AnyController
    controller: Controller


@dataclass(frozen=True, kw_only=True)
class _Listed:
    """A table of events, for messages to name them."""

    events: list[Event]


class _Due(NamedTuple):
    """An event outside the plant that is scheduled."""

    period: int  # the first one from its time on
    time: float  # [s]
    event: SetpointEvent | ControllerEvent
    successor: Successor | None  # the controller that takes over, if it has been built


class FlightEvents:
    """The events of a flight, scheduled and applied, each passed to the part that it affects.

    Attributes:
        assembly: parts of the scenario flown, with the events applied.
        infeasible_period: the first period whose QP had no answer, of the controllers before the present one.
    """

    def __init__(
        self,
        assembly: Assembly,
        *,
        plant: Plant,
        navigation: Navigation | None,
        reference: FollowedCourse,
        loop: ClosedLoop,
        build: Callable[[AnyController], Controller] | None,
    ) -> None:
        """Prepare for the first period; `build` makes a controller, None if the user's own controller flies."""
        self.assembly = assembly
        scenario = assembly.scenario
        self._spec = scenario.controller
        self._plant = plant
        self._navigation = navigation
        self._reference = reference
        self._loop = loop
        self._build = build
        self._recent: list[Event] = [*scenario.events]  # those still pending in the plant, and others
        self.infeasible_period: InfeasiblePeriod | None = None
        self._due: list[_Due] = []
        for event in scenario.events:
            self._schedule(event)
        loop.before = self._begin

    def close(self) -> None:
        """Drop references to this object, so that nothing of the flight stays in a cycle."""
        self._loop.before = self._build = None

    @property
    def scenario(self) -> Scenario:
        """The scenario flown, with the events applied."""
        return self.assembly.scenario

    def apply(self, event: Event | Mapping[str, Any], successor: Successor | None = None) -> Event:
        """See `quadsim.rollout.rollout.Rollout.apply`."""
        event = self._stamped(event)
        scenario = self._with(event)
        assembly = self.assembly.of(scenario)
        if isinstance(event, SetpointEvent):
            self._schedule(event)
        elif isinstance(event, ControllerEvent):
            self._succeed(event, scenario, successor)
        elif isinstance(event, Stall):
            self._loop.computation = assembly.computation(self._spec)
        elif isinstance(event, SensorFaultEvent):
            if self._navigation is None or not self._navigation.has(SensorName(event.sensor)):
                raise _not_started_for(event)
            self._navigation.reschedule(assembly.faults)
        elif isinstance(event, Gust | WindChange):
            _ = assembly.moving_air
            if self._plant.wind is None:
                raise _not_started_for(event)
            self._plant.wind.reschedule(*assembly.winds)
        else:
            past = self._loop.time - scenario.control_period
            recent = []
            for other in (*self._recent, event):
                if other.at + _duration(other) >= past:
                    recent.append(other)
            changes = assembly.changes(recent)
            if not self._plant.allows(changes):
                raise _not_started_for(event)
            self._plant.reschedule(changes)
            self._recent = recent
        self.assembly = assembly
        return event

    def successor(self, fields: Mapping[str, Any]) -> Successor:
        """See `quadsim.rollout.rollout.Rollout.successor`."""
        return self._built(changed_controller(self._spec, fields))

    def leave_course(self) -> None:
        """End the constraints on the tracking error, and drop those that would begin later."""
        scenario = self.scenario
        now = round(self._loop.k * self.scenario.control_period, 9)
        kept = []
        for limit in scenario.constraints:
            if limit.signal not in TRACKING_ERRORS:
                kept.append(limit)
            elif limit.start < now:
                kept.append(replace(limit, stop=min(limit.stop, now)))
        self.assembly = self.assembly.of(scenario.altered(constraints=kept))

    def flown(self) -> Scenario:
        """Return the scenario up to now, unless the flight has ended otherwise, or nothing has been flown."""
        scenario = self.scenario
        k = self._loop.k
        if k in (0, scenario.periods) or self._loop.reason is not None:
            return scenario
        duration = round(k * scenario.control_period, 9)
        events = [event for event in scenario.events if event.at < duration]
        for event in scenario.events:
            if event.at < duration:
                continue
            substitute = neutral(scenario, event)
            if substitute is not None and substitute not in events:
                events.insert(0, substitute)
        return scenario.altered(duration=duration, events=events)

    def _stamped(self, event: Event | Mapping[str, Any]) -> Event:
        """Return an event with its time, effective from the first period not yet observed."""
        step = self.scenario.plant.timestep
        first = self._loop.k + self._loop.observed
        at = round(first * self.scenario.control_period, 9)
        if isinstance(event, Mapping):
            event = parse_table(_Listed, {"events": [{**event, "at": at}]}, "event").events[0]
        if isinstance(event, SensorFaultEvent):  # this period has been sensed already
            at = round(at + step, 9)
        if isinstance(event, Stall) and self._loop.answered >= at:  # a command that has arrived was not delayed
            at = round(self._loop.answered + step, 9)
        return replace(event, at=at)

    def _with(self, event: Event) -> Scenario:
        """Return the scenario with one more event, extended to its time."""
        before = self.scenario
        events = [*before.events, event]
        if len(events) > MOST_EVENTS:
            raise ParameterError("scenario", "events", len(events), f"of {MOST_EVENTS} or fewer entries")
        changes: dict[str, Any] = {"events": events}
        if event.at >= before.duration:
            periods = math.floor(event.at / before.control_period + 1e-6) + 1
            changes["duration"] = round(periods * before.control_period, 9)
        scenario = before.altered(**changes)
        if isinstance(event, _DEPENDENT):
            try:
                scenario.require_consistent()
            except ValueError as error:
                raise InputError(str(error)) from None
        return scenario

    def _schedule(self, event: Event, ready: Successor | None = None) -> None:
        """Schedule an event outside the plant for the first period from its time on."""
        if isinstance(event, SetpointEvent | ControllerEvent):
            first = first_period(event.at, self.scenario.control_period)
            insort(self._due, _Due(first, event.at, event, ready), key=lambda due: (due.period, due.time))

    def _begin(self, k: int) -> None:
        """Apply the events due at the start of a period."""
        while self._due and self._due[0].period <= k:
            due = self._due.pop(0)
            if isinstance(due.event, SetpointEvent):
                self._reference.set(k, due.event.values)
                self._loop.motion = None
            else:
                self._switch(changed_controller(self._spec, due.event.fields), due.successor)

    def first_infeasible_period(self) -> InfeasiblePeriod | None:
        """Return, over all controllers so far, the first QP without an answer, or else the first SQP not converged."""
        periods = []
        for period in (self.infeasible_period, infeasible_period_of(self._loop.controller)):
            if period is not None:
                periods.append(period)
        return min(periods, key=lambda period: period.converges is not None, default=None)

    def _switch(self, spec: AnyController, ready: Successor | None) -> None:
        if ready is None or ready.spec != spec:
            ready = self._built(spec)
        self.infeasible_period = self.first_infeasible_period()
        self._loop.switch(ready.controller)
        self._spec = spec
        self._loop.computation = self.assembly.computation(spec)

    def _succeed(self, event: ControllerEvent, scenario: Scenario, ready: Successor | None) -> None:
        """Schedule a change of the controller, after checking it and later changes in the file."""
        specs = [spec for at, spec in scenario.controller_changes if at >= event.at]
        before = sum(at == event.at for at, _ in self.scenario.controller_changes)
        succeeding, *later = specs[before:]
        if ready is None or ready.spec != succeeding:
            ready = self._built(succeeding)
        for spec in later:
            self._built(spec)
        self._schedule(event, ready)

    def _built(self, spec: AnyController) -> Successor:
        if self._build is None:
            raise ParameterError("event", "type", "controller", "another type of event with your own controller")
        return Successor(spec=spec, controller=self._build(spec))


def infeasible_period_of(controller: Controller) -> InfeasiblePeriod | None:
    """Return the first period whose QP had no answer; None if there is none."""
    if not isinstance(controller, Diagnosable):
        return None
    period = controller.infeasible_period
    if isinstance(period, InfeasiblePeriod):
        return period
    return None


def _duration(event: Event) -> float:
    """Return the time for which an event acts [s]."""
    duration: float | None = getattr(event, "duration", 0.0)
    if duration is None:
        return math.inf
    return duration


def _not_started_for(event: Event) -> InputError:
    rule = "of a kind that the flight was started for, with live=True or by an event of its scenario"
    return ParameterError("event", "type", event.type, rule)


def prepared(assembly: Assembly) -> Scenario:
    """Return a scenario whose flight is prepared for every event that its vehicle allows.

    Wind needs drag to push; with the integrator rk4 only a file schedules another mass; an estimator needs a fixed set
    of sensors.
    """
    scenario = assembly.scenario
    air = assembly.effects.air
    possible: list[Event] = [_push(scenario)]
    if scenario.plant.integrator == "mujoco":
        possible.append(_mass(scenario))
    if air is not None and air.drags:
        possible.append(_wind(scenario))
    for name in get_args(SensorText):
        if scenario.estimator is None or (scenario.sensors is not None and name in scenario.sensors.present()):
            possible.append(_fault(scenario, name))
    added = [event for event in possible if event not in scenario.events]
    return scenario.altered(events=[*added, *scenario.events])  # events of the file at time 0 come after


def neutral(scenario: Scenario, event: Event) -> Event | None:
    """Return a neutral event that prepares a flight for one; None if no preparation is needed."""
    if isinstance(event, Push):
        return _push(scenario)
    if isinstance(event, LOADING):
        return _mass(scenario)
    if isinstance(event, Gust | WindChange):
        return _wind(scenario)
    if isinstance(event, SensorFaultEvent):
        return _fault(scenario, event.sensor)
    return None


def _push(scenario: Scenario) -> Push:
    return Push(at=0.0, duration=scenario.plant.timestep, force=(0.0, 0.0, 0.0))


def _mass(scenario: Scenario) -> MassChange:
    return MassChange(at=0.0, factor=(scenario.effects.load or Load()).mass_factor)


def _wind(scenario: Scenario) -> WindChange:
    return WindChange(at=0.0, velocity=(scenario.effects.air or Air()).wind)


def _fault(scenario: Scenario, sensor: SensorText) -> SensorFaultEvent:
    step = scenario.plant.timestep
    return SensorFaultEvent(at=0.0, sensor=sensor, fault="bias", offset=(0.0, 0.0, 0.0), duration=step)


def story(scenario: Scenario, duration: float) -> list[dict[str, Any]]:
    """Return `events` of a summary: `time` [s] and `text` of the events within a duration [s], in order of time.

    Neutral events, as at the start of a live flight, are omitted.
    """
    happened = []
    for event in sorted(scenario.events, key=lambda event: event.at):
        if event.at < duration and event != neutral(scenario, event):
            happened.append(event)
    entries = []
    for _, group in groupby(happened, key=lambda event: event.type):
        alike = list(group)
        first = alike[0]
        last = alike[-1]
        if len(alike) <= _MOST_SINGLY:
            entries += [{"time": event.at, "text": _text(event)} for event in alike]
        else:
            text = f"{len(alike)} times until {last.at:g} s: {_text(first)} first, {_text(last)} last"
            entries.append({"time": first.at, "text": text})
    return entries


def _text(event: Event) -> str:
    """Return what happened, and for how long."""
    text = event.text()
    duration = getattr(event, "duration", None)
    if duration is not None:
        text += f" for {duration:g} s"
    return printable(text)[:_LONGEST_TEXT]
