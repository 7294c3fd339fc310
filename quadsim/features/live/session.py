"""A live session: one queue of inputs, flown period by period, saved as a scenario that reproduces it bit for bit.

No clock, no view and no socket in here.  Inputs come from any thread; what happens to the vehicle depends on the
scenario and on the periods at which they act alone.
"""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np

from quadsim.console.progress import Progress, silent
from quadsim.controller import Predicting
from quadsim.errors import FlightError, InputError, ParameterError
from quadsim.features.live.inputs import HELD, HeldInput, Pull, Script, Steer, Wear, without_time
from quadsim.fields import Vector
from quadsim.flight.audit import COMMAND_SIGNALS, Limit
from quadsim.rollout.flight_events import Successor
from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.assembly import Assembly, preferring_core
from quadsim.scenarios.schema.controllers import AnyController
from quadsim.scenarios.schema.problems import parse_table
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.sim.effects.load import Load, MassChange
from quadsim.sim.effects.rotors import LagChange, RotorDynamics, RotorLoss
from quadsim.sim.effects.wind import Air, WindChange
from quadsim.sim.physics import Period
from quadsim.state import POSITION, REFERENCE_NAMES, Array
from quadsim.vehicle import Vehicle, span

STIFFNESS: Final = 0.4  # of the spring that a person pulls by, in weights of the vehicle per metre
STRONGEST: Final = 0.3  # largest pull in weights of the vehicle


@dataclass(frozen=True)
class Frame:
    """One flown control period, for a view; one entry per flight that has not ended."""

    k: int  # which period
    time: float  # when it began [s]
    samples: tuple[Period | None, ...]
    margins: tuple[Mapping[str, float], ...]  # see `Rollout.margins`
    horizons: tuple[Array | None, ...]  # (N, 3) predicted positions [m], from the period's end on
    pull: Array  # (3,) the force of the person's hand [N]; zero without one
    health: Array  # (4,) share of its thrust that each rotor of the first vehicle has left
    refused: tuple[str, ...]  # why inputs were refused


@dataclass(frozen=True, kw_only=True)
class Disturbances:
    """What acts on the first vehicle at the start of its next period, by its scenario's effects and events."""

    wind: Vector  # mean velocity of the air, world frame [m/s]
    mass_factor: float
    lag: tuple[float, float]  # time constants of the rotors, speeding up and slowing down [s]; 0 for none
    worn: Array  # (4,) share of its thrust that each rotor lacks by the scenario
    loss: Array  # (4,) the same with what `Wear` holds


class _Queued(NamedTuple):
    """An input that has not acted yet."""

    table: Mapping[str, Any]
    subject: str  # a later input of the same subject replaces it; empty for none
    successor: Successor | None  # the controller that it lets take over
    name: str  # how its refusal begins


@dataclass
class _HeldInputs:
    """Inputs in force until they are changed."""

    pull: Array | None = None  # (3,) to where [m]
    wear: dict[int, float] = field(default_factory=dict)
    steer: Array = field(default_factory=lambda: np.zeros(3))
    setpoint: Array | None = None  # (3,) the set-point as steering has moved it [m]


class Session:
    """A flight, and another one of the same vehicle by the controller `against` where that is given, and users' inputs.

    Attributes:
        flights: the one that inputs are about, then the other.
        reason: why the first has ended; None while it has not.
    """

    def __init__(self, scenario: Scenario, against: AnyController | None = None) -> None:
        self.scenario = looping(preferring_core(scenario))
        self._against = against
        self._effects = Assembly(self.scenario).effects
        self._round: int | None = None  # periods until the course starts again
        if self.scenario.reference.repeat is not None:
            self._round = round(self.scenario.reference.repeat / self.period)
        self._queue: deque[_Queued] = deque()
        self.flights: tuple[Rollout, ...] = ()
        self.reset()

    def reset(self) -> None:
        """Restart at t = 0; pending inputs are dropped."""
        self.close()
        self._queue.clear()
        flown = [self.scenario]
        if self._against is not None:
            flown.append(Assembly(self.scenario).with_bounds.altered(controller=self._against))
        self.flights = tuple(Rollout(scenario, live=True) for scenario in flown)
        self._held = _HeldInputs()
        self._steered = False  # whether an input has given a set-point
        self.reason: str | None = None

    def close(self) -> None:
        """Free the resources of the flights; their records remain."""
        for flight in self.flights:
            flight.close()

    @property
    def k(self) -> int:
        """Control periods flown."""
        return self.flights[0].k

    @property
    def period(self) -> float:
        """Length of a control period [s]."""
        return self.scenario.control_period

    @property
    def limits(self) -> tuple[Limit, ...]:
        """Audited constraints of the flight."""
        return tuple(self.flights[0].limits)

    @property
    def disturbances(self) -> Disturbances:
        """What acts now; after `reset`, what the scenario starts with."""
        flight = self.flights[0]
        wind = (self._effects.air or Air()).wind
        factor = (self._effects.load or Load()).mass_factor
        rotors = self._effects.rotors or RotorDynamics()
        lag = (rotors.rise or 0.0, rotors.fall or 0.0)
        changes = []
        for event in flight.scenario.events:
            if isinstance(event, WindChange | MassChange | LagChange) and event.at <= flight.loop.time + 1e-9:
                changes.append(event)
        for change in sorted(changes, key=lambda change: change.at):
            match change:
                case WindChange():
                    wind = change.velocity
                case MassChange():
                    factor = change.factor
                case LagChange():
                    fall = change.fall
                    if fall is None:
                        fall = change.rise
                    lag = (change.rise, fall)
        worn = 1.0 - self._thrust_left()
        loss = 1.0 - self._thrust_left(with_held=True)
        return Disturbances(wind=wind, mass_factor=factor, lag=lag, worn=worn, loss=loss)

    def submit(
        self, table: Mapping[str, Any], *, subject: str = "", successor: Successor | None = None, name: str = ""
    ) -> None:
        """Let a `Pull`, `Wear`, `Steer`, or an event without its time, happen from the next period on; from any thread.

        An earlier input of the same subject that has not acted yet is dropped.  A refusal begins with the name.
        """
        self._queue.append(_Queued(dict(table), subject, successor, name))

    def advance(self) -> Frame:
        """Fly one control period.

        Raises:
            InputError: the first flight has ended, or is as long as any may be.
        """
        if self.reason is not None:
            raise InputError(f"the flight has ended: {self.reason}")
        refused = self._apply_queued()
        if not self._steered and self.k == self._round:  # constraints on its arrival end with the first round
            for flight in self.flights:
                flight.leave_course()
        pull = self._apply_held(refused)
        samples: list[Period | None] = []
        margins: list[Mapping[str, float]] = []
        horizons: list[Array | None] = []
        for flight in self.flights:
            sample, margins_by_name, horizon = self._step(flight)
            samples.append(sample)
            margins.append(margins_by_name)
            horizons.append(horizon)
        return Frame(
            k=self.k - 1,
            time=round((self.k - 1) * self.period, 9),
            samples=tuple(samples),
            margins=tuple(margins),
            horizons=tuple(horizons),
            pull=pull,
            health=self._thrust_left(with_held=True),
            refused=tuple(refused),
        )

    def _apply_queued(self) -> list[str]:
        """Apply the inputs given since the last period, of each subject the last one; return why some were refused."""
        refused: list[str] = []
        taken = [self._queue.popleft() for _ in range(len(self._queue))]
        last_of_subject = {entry.subject: i for i, entry in enumerate(taken)}
        for i, entry in enumerate(taken):
            if entry.subject and last_of_subject[entry.subject] != i:
                continue
            try:
                self._apply(entry.table, entry.successor)
            except InputError as error:
                refused.append(f"{entry.name}{error}")
        return refused

    def _step(self, flight: Rollout) -> tuple[Period | None, Mapping[str, float], Array | None]:
        """Fly a period of a flight; return it with margins and prediction, nothing of a flight that has ended."""
        if flight.loop.reason is not None:
            return None, {}, None
        try:
            sample = flight.step()
            return sample, flight.margins(sample), _horizon(flight, sample)
        except FlightError as error:
            if flight is self.flights[0]:
                self.reason = str(error)
            return None, {}, None

    def successor(self, fields: Mapping[str, Any]) -> Successor:
        """Build a controller for the first flight with some fields changed; callable from any thread.

        Raises:
            InputError: it cannot be built, or its bounds exclude hover.
        """
        flight = self.flights[0]
        result = flight.successor(fields)
        for signal, (lower, upper) in result.spec.audited(flight.vehicle).items():
            if signal in REFERENCE_NAMES:
                continue
            hover = _in_hover(signal, flight.vehicle)
            if lower <= hover.min() and hover.max() <= upper:
                continue
            if signal in COMMAND_SIGNALS:
                table = "input_bounds"
            else:
                table = "output_bounds"
            rule = f"a range that contains {span(hover)}, as in hover"
            raise ParameterError(f"controller.{table}", signal, [lower, upper], rule)
        return result

    def refusals(self, tables: Iterable[Mapping[str, Any]]) -> list[str]:
        """Return for each event why this scenario cannot have it, empty if it can; they are tried on another flight."""
        result = []
        with Rollout(self.scenario, live=True) as trial:
            for table in tables:
                try:
                    trial.apply(table)
                    result.append("")
                except InputError as error:
                    result.append(str(error))
        return result

    def play(self, script: Script, progress: Progress = silent) -> list[str]:
        """Fly by a script, as fast as possible; return which inputs were refused, when, and why.

        An input is given when the first period begins that is not before its time.
        """
        refused: list[str] = []
        waiting = deque(sorted(enumerate(script.inputs), key=lambda entry: float(entry[1]["at"])))
        while self.reason is None:
            time = self.k * self.period
            if time >= script.duration - 1e-9:
                break
            progress("session", self.k, round(script.duration / self.period))
            while waiting and waiting[0][1]["at"] <= time + 1e-9:
                i, entry = waiting.popleft()
                self.submit(without_time(entry), name=f"inputs.{i} at t = {time:.3f} s: ")
            refused += self.advance().refused
        return refused

    def flight(self) -> Flight:
        """Return the first vehicle's flight so far, audited; its scenario reproduces it bit for bit.

        Raises:
            InputError: nothing has been flown.
        """
        if self.k == 0:
            raise InputError("nothing has been flown yet")
        return self.flights[0].flight()

    def _apply(self, table: Mapping[str, Any], successor: Successor | None) -> None:
        """Apply an input; a controller event only to the first flight."""
        kind = table.get("type")
        if kind in HELD:
            self._hold(parse_table(HeldInput, {"input": table}, "input").input)
        elif kind == "controller":
            self.flights[0].apply(table, successor)
        else:
            if kind == "setpoint":
                self._held.setpoint = None
            self._apply_event(table)

    def _hold(self, held: Pull | Wear | Steer) -> None:
        """Hold an input in force."""
        match held:
            case Pull(to=None):
                self._held.pull = None
            case Pull(to=to):
                self._held.pull = np.array(to)
            case Wear(rotor=rotor, loss=loss):
                self._held.wear[rotor] = loss
            case Steer(velocity=velocity):
                self._held.steer = np.array(velocity)

    def _apply_event(self, event: Mapping[str, Any]) -> None:
        """Apply an event to all flights that have not ended; with the first set-point they leave the course."""
        is_setpoint = event.get("type") == "setpoint"
        for flight in self.flights:
            if flight.loop.reason is None:
                flight.apply(event)
                if is_setpoint and not self._steered:
                    flight.leave_course()
        if is_setpoint:
            self._steered = True

    def _thrust_left(self, *, with_held: bool = False) -> Array:
        """Return the share of its thrust that each rotor has left (4,) by the scenario, or also by `Wear` in force."""
        now = self.flights[0].loop.time + 1e-9
        left = np.array((self._effects.rotors or RotorDynamics()).efficiency)
        for event in self.scenario.events:
            if isinstance(event, RotorLoss) and event.at <= now < event.at + (event.duration or math.inf):
                left[event.rotor - 1] *= 1.0 - event.loss
        if with_held:
            for rotor, loss in self._held.wear.items():
                left[rotor - 1] *= 1.0 - loss
        return left

    def _apply_held(self, refused: list[str]) -> Array:
        """Apply the inputs in force for one more period; return the force of the pull (3,) [N]."""
        last = self.flights[0].loop.last
        if last is None:  # its position is known once a period has been flown
            return np.zeros(3)
        force = self._pull_force(last)
        events: list[dict[str, Any]] = []
        if force.any():
            events.append({"type": "push", "duration": self.period, "force": force.tolist()})
        for rotor, loss in sorted(self._held.wear.items()):
            if loss > 0.0:
                events.append({"type": "rotor_loss", "duration": self.period, "rotor": rotor, "loss": loss})
        if self._held.steer.any():
            x, y, z = self._steered_setpoint(last).tolist()
            events.append({"type": "setpoint", "x": x, "y": y, "z": z})
        try:
            for event in events:
                self._apply_event(event)
        except InputError as error:  # such as too many events in the scenario
            refused.append(f"{error}; all inputs in force are released")
            self._held = _HeldInputs()
            return np.zeros(3)
        return force

    def _pull_force(self, last: Period) -> Array:
        """Return the force (3,) [N] of the spring that a person pulls by, after a period; zero without one."""
        if self._held.pull is None:
            return np.zeros(3)
        weight = self.flights[0].actual.mass * self.flights[0].actual.gravity
        force = STIFFNESS * weight * (self._held.pull - last.position[-1])
        force *= min(1.0, STRONGEST * weight / max(float(np.linalg.norm(force)), 1e-9))
        return np.round(force, 3)

    def _steered_setpoint(self, last: Period) -> Array:
        """Move the set-point (3,) [m] by a period of steering, from where it is after a period; return it."""
        start = self._held.setpoint
        if start is None:
            start = last.observation.reference[:3]
        setpoint = np.round(start + self.period * self._held.steer, 6)
        self._held.setpoint = setpoint
        return setpoint


def looping(scenario: Scenario) -> Scenario:
    """Return a scenario whose course starts again when it has ended, but not before the scenario has.

    Courses that never end, do not move, or state velocities stay as they are.
    """
    course = Assembly(scenario).course
    if scenario.reference.repeat is not None or course.derivatives is not None:
        return scenario
    period = scenario.control_period
    references = course.sample(period * np.arange(scenario.periods + 1, dtype=np.float64))
    end = course.end
    if math.isinf(end):
        end = max((scenario.duration, *course.jumps, *course.kinks))
    if not np.ptp(references, axis=0).any() or math.isinf(end):
        return scenario
    length = round(period * math.ceil(max(scenario.duration, end) / period - 1e-6), 9)
    reference = copy.copy(scenario.reference)  # with the content that a table may have in memory
    vars(reference).update(repeat=length)
    return scenario.altered(reference=reference)


def _in_hover(signal: str, vehicle: Vehicle) -> Array:
    """Return the values of a signal in hover, in the unit of its bounds."""
    if signal == "speed":
        return vehicle.hover_speeds
    if signal == "thrust":
        return np.array([vehicle.mass * vehicle.gravity])
    return np.zeros(1)


def _horizon(flight: Rollout, sample: Period) -> Array | None:
    """Return the predicted positions (N, 3) [m] from a period's end on; None without a prediction."""
    controller = flight.loop.controller
    state = sample.observation.state
    if not isinstance(controller, Predicting) or len(sample.command.plan) < 1:
        return None
    predicted = controller.predict(state[None], sample.command.plan[None])
    if predicted is None:
        return None
    path = predicted[0][:, list(POSITION)]
    return np.concatenate([sample.position[-1:], path[1:]])  # the period that is shown is over
