"""What happens in a flight besides the course and the controller that it starts with, known in advance or not."""

from __future__ import annotations

import json
import math
from bisect import insort
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final, TypeVar

from pydantic import ValidationError

from mpc.ocp import InfeasiblePeriod
from quadsim.controller import Controller
from quadsim.errors import InputError, ParameterError
from quadsim.sim.computation import Computation, Stall
from quadsim.sim.effects.load import PayloadDrop, PayloadPickup
from quadsim.sim.effects.wind import Gust, WindChange
from quadsim.sim.loop import ClosedLoop
from quadsim.sim.navigation import Navigation
from quadsim.sim.plant import Plant
from quadsim.sim.sensing.sensor import SensorName
from quadsim.vehicle import Vehicle
from scenarios.parts.effects import build_changes, build_computation, check_changes, moving_air, winds_of
from scenarios.parts.events import neutral
from scenarios.parts.navigation import build_faults
from scenarios.schema.base import Spec
from scenarios.schema.controllers import AnyController, changed
from scenarios.schema.events import (
    MOST_EVENTS,
    ControllerEvent,
    Event,
    SensorFaultEvent,
    SetpointEvent,
)
from scenarios.schema.problems import ScenarioError, describe_all

if TYPE_CHECKING:
    from scenarios.courses.followed import FollowedCourse
    from scenarios.schema.scenario import Scenario

_DEPENDENT: Final = (ControllerEvent, PayloadDrop, PayloadPickup, SensorFaultEvent)
"""The events that depend on what else the scenario has."""


@dataclass(frozen=True, kw_only=True)
class Successor:
    """A controller that is ready to take over, and the table of a scenario file that it is made of."""

    spec: AnyController
    controller: Controller


class _Listed(Spec):
    """A table that has events, for messages to name them."""

    events: list[Event]


T = TypeVar("T", bound=Spec)


def validated(kind: type[T], data: Mapping[str, Any], name: str) -> T:
    """A table of this kind.

    Raises:
        ScenarioError: it is none; the message starts with `name`.
    """
    try:
        return kind.model_validate_json(json.dumps(data, default=lambda _: math.inf))
    except ValidationError as error:
        raise ScenarioError(name, describe_all(error, data, kind)) from error


class FlightEvents:
    """The events of a flight, those of its scenario and those that are applied, each put to what it acts on.

    Attributes:
        scenario: what is flown, with the events that were applied.
        unanswered: the first period whose QP had no answer, of the controllers before the one that flies now.
    """

    def __init__(
        self,
        scenario: Scenario,
        vehicle: Vehicle,
        *,
        plant: Plant,
        navigation: Navigation | None,
        reference: FollowedCourse,
        loop: ClosedLoop,
        build: Callable[[AnyController], Controller] | None,
    ) -> None:
        """Set up, before the first period; `build` makes a controller, None where the user's own one flies."""
        self.scenario, self._vehicle, self._spec = scenario, vehicle, scenario.controller
        self._plant, self._navigation, self._reference, self._loop = plant, navigation, reference, loop
        self._build = build
        self._recent: list[Event] = scenario.events  # those that the plant may still have to do with, and others
        self.unanswered: InfeasiblePeriod | None = None
        self._due: list[tuple[int, float, SetpointEvent | ControllerEvent, Successor | None]] = []
        for event in scenario.events:
            self._schedule(event)
        loop.before = self._begin

    def close(self) -> None:
        """Let go of what refers back here, so that nothing of the flight stays in a cycle."""
        self._loop.before = self._build = None

    def apply(self, event: Event | Mapping[str, Any], successor: Successor | None = None) -> Event:
        """See `scenarios.rollout.Rollout.apply`."""
        found = self._stamped(event)
        scenario = self._with(found)
        if isinstance(found, SetpointEvent):
            self._schedule(found)
        elif isinstance(found, ControllerEvent):
            self._succeed(found, scenario, successor)
        elif isinstance(found, Stall):
            self._loop.computation = self._computation(scenario)
        elif isinstance(found, SensorFaultEvent):
            if self._navigation is None or not self._navigation.watches(SensorName(found.sensor)):
                raise _not_started_for(found)
            self._navigation.reschedule(build_faults(scenario))
        elif isinstance(found, Gust | WindChange):
            moving_air(scenario, self._vehicle)
            if self._plant.wind is None:
                raise _not_started_for(found)
            self._plant.wind.reschedule(*winds_of(scenario))
        else:
            past = self._loop.time - scenario.control_period
            recent = [each for each in (*self._recent, found) if each.at + _lasting(each) >= past]
            changes = build_changes(scenario, recent)
            check_changes(scenario, self._vehicle, changes)
            if not self._plant.allows(changes):
                raise _not_started_for(found)
            self._plant.reschedule(changes)
            self._recent = recent
        self.scenario = scenario
        return found

    def successor(self, fields: Mapping[str, Any]) -> Successor:
        """See `scenarios.rollout.Rollout.successor`."""
        return self._built(changed(self._spec, fields))

    def flown(self) -> Scenario:
        """The scenario up to now, unless the flight has ended otherwise, or nothing has been flown."""
        scenario, k = self.scenario, self._loop.k
        if k in (0, scenario.periods) or self._loop.reason is not None:
            return scenario
        duration = round(k * scenario.control_period, 9)
        events = [event for event in scenario.events if event.at < duration]
        for event in scenario.events:
            substitute = None if event.at < duration else neutral(scenario, event)
            if substitute is not None and substitute not in events:
                events.insert(0, substitute)
        return scenario.model_copy(update={"duration": duration, "events": events})

    def _stamped(self, event: Event | Mapping[str, Any]) -> Event:
        """An event with the time at which it happens, to act from the first period on that is not observed yet."""
        step, first = self.scenario.plant.timestep, self._loop.k + self._loop.observed
        at = round(first * self.scenario.control_period, 9)
        if isinstance(event, Mapping):
            event = validated(_Listed, {"events": [{**event, "at": at}]}, "event").events[0]
        if isinstance(event, SensorFaultEvent):  # what is sensed at the period's begin has been sensed
            at = round(at + step, 9)
        if isinstance(event, Stall) and self._loop.answered >= at:  # a command that has come was not held up
            at = round(self._loop.answered + step, 9)
        return replace(event, at=at)

    def _with(self, event: Event) -> Scenario:
        """The scenario with one event more, and as long as that takes."""
        before, events = self.scenario, [*self.scenario.events, event]
        if len(events) > MOST_EVENTS:
            raise ParameterError("scenario", "events", len(events), f"of {MOST_EVENTS} or fewer entries")
        changes: dict[str, Any] = {"events": events}
        if event.at >= before.duration:
            changes["duration"] = round(
                (math.floor(event.at / before.control_period + 1e-6) + 1) * before.control_period, 9
            )
        scenario = before.model_copy(update=changes)
        if isinstance(event, _DEPENDENT):
            try:
                scenario.require_consistent()
            except ValueError as error:
                raise InputError(str(error)) from error
        return scenario

    def _schedule(self, event: Event, ready: Successor | None = None) -> None:
        """Note what happens when a period begins, the first one from its time on, and not within the plant."""
        if isinstance(event, SetpointEvent | ControllerEvent):
            first = math.ceil(event.at / self.scenario.control_period - 1e-6)
            insort(self._due, (first, event.at, event, ready), key=itemgetter(0, 1))

    def _begin(self, k: int) -> None:
        """Let happen what is due when a period begins."""
        while self._due and self._due[0][0] <= k:
            _, _, event, ready = self._due.pop(0)
            if isinstance(event, SetpointEvent):
                self._reference.set(k, event.values)
                self._loop.motion = None
            else:
                self._switch(changed(self._spec, event.fields), ready)

    def first_unanswered(self) -> InfeasiblePeriod | None:
        """Of all controllers so far: the first QP without an answer, or else the first SQP that did not converge."""
        found = [each for each in (self.unanswered, unanswered_by(self._loop.controller)) if each is not None]
        return min(found, key=lambda each: each.converges is not None, default=None)

    def _switch(self, spec: AnyController, ready: Successor | None) -> None:
        found = ready if ready is not None and ready.spec == spec else self._built(spec)
        self.unanswered = self.first_unanswered()
        self._loop.switch(found.controller)
        self._spec = spec
        self._loop.computation = self._computation(self.scenario)

    def _succeed(self, event: ControllerEvent, scenario: Scenario, ready: Successor | None) -> None:
        """Schedule a change of the controller, once it and later ones of the file are known to be possible."""
        specs = [spec for at, spec in scenario.controller_changes if at >= event.at]
        before = sum(at == event.at for at, _ in self.scenario.controller_changes)
        found, *later = specs[before:]
        if ready is None or ready.spec != found:
            ready = self._built(found)
        for spec in later:
            self._built(spec)
        self._schedule(event, ready)

    def _built(self, spec: AnyController) -> Successor:
        if self._build is None:
            raise ParameterError("event", "type", "controller", "another one where the controller is one's own")
        return Successor(spec=spec, controller=self._build(spec))

    def _computation(self, scenario: Scenario) -> Computation | None:
        """How long commands of the controller that flies now take."""
        return build_computation(scenario.model_copy(update={"controller": self._spec}))


def unanswered_by(controller: Controller) -> InfeasiblePeriod | None:
    """The first period whose QP had no answer; None where all had, or there is none."""
    found = getattr(controller, "unanswered", None)  # a controller of another kind has none
    return found if isinstance(found, InfeasiblePeriod) else None


def _lasting(event: Event) -> float:
    """For how long an event counts [s]."""
    duration: float | None = getattr(event, "duration", 0.0)
    return math.inf if duration is None else duration


def _not_started_for(event: Event) -> InputError:
    rule = "of a kind that the flight was started for, with live=True or by an event of its scenario"
    return ParameterError("event", "type", event.type, rule)
