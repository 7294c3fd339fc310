"""A live session: one queue of inputs, flown period by period, saved as a scenario that flies to the same bits.

No clock, no view and no socket in here.  Inputs come from any thread; what happens to the vehicle depends on the
scenario and on the periods at which they act alone.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np

from quadsim.errors import FlightError, InputError, ParameterError
from quadsim.flight.audit import Limit
from quadsim.sim.loop import Sample
from quadsim.state import POSITION, REFERENCE_NAMES, Array
from quadsim.vehicle import N_ROTORS
from scenarios.flight import Flight
from scenarios.limits import with_bounds_stated
from scenarios.parts.live import Successor
from scenarios.run import StartedFlight, start
from scenarios.schema.controller import ControllerSpec
from scenarios.schema.scenario import Scenario

STIFFNESS: Final = 0.4  # of the spring that a person pulls by, in weights of the vehicle per metre
STRONGEST: Final = 0.3  # largest pull in weights of the vehicle
FORCE_STEP: Final = 1e-3  # to which pulls are rounded [N]


_ENTRIES: Final = {"pull": {"type", "to"}, "wear": {"type", "rotor", "loss"}, "steer": {"type", "velocity"}}
"""Of inputs that are no events of a scenario file."""


class Pull(NamedTuple):
    """A spring from a point of the body to a point of the world, held until it is let go."""

    to: tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Input:
    """Something that a person did."""

    table: Mapping[str, Any]
    """An event of a scenario file without its time; or of type `pull` (`to` [m] world, absent to let go), `wear`
    (`rotor` 1 to 4, `loss` 0 to 1, held), `steer` (`velocity` of the set-point [m/s], held)."""
    subject: str | None = None  # an earlier input of the same subject that has not acted yet is dropped
    successor: Successor | None = None  # of an event `controller`, the controller that was built for it


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One control period as it was flown, for a view."""

    k: int  # which period
    time: float  # when it began [s]
    samples: tuple[Sample | None, ...]  # of each flight; None where it has ended
    margins: tuple[Mapping[str, float], ...]
    """Of each constraint at its worst within the period; see `StartedFlight.margins`."""
    horizons: tuple[Array | None, ...]
    """(N + 1, 3) predicted positions [m] of each flight, from the present one on; None without a model."""
    pull: Array  # (3,) the force of the person's hand [N]; zero without one
    refused: tuple[str, ...]  # why inputs were refused


@dataclass
class _Held:
    """What goes on until it is changed."""

    pull: Pull | None = None
    wear: dict[int, float] = field(default_factory=dict)
    steer: Array = field(default_factory=lambda: np.zeros(3))
    setpoint: Array | None = None


class Session:
    """A flight, or two of the same vehicle by different controllers, and the users' inputs.

    Args:
        scenario: what is flown.
        against: a controller that flies a second vehicle, through the same events; absent for none.

    Raises:
        InputError: it cannot be flown.

    Attributes:
        scenario: as given.
        flights: the one that inputs are about, then the other.
        reason: why the first has ended; None while it has not.
    """

    def __init__(self, scenario: Scenario, against: ControllerSpec | None = None) -> None:
        self.scenario, self._against = scenario, against
        self._queue: deque[Input] = deque()
        self.flights: tuple[StartedFlight, ...] = ()
        self.reset()

    def reset(self) -> None:
        """Start anew at t = 0; inputs that have not acted are dropped."""
        self.close()
        self._queue.clear()
        scenarios = [self.scenario]
        if self._against is not None:
            scenarios.append(with_bounds_stated(self.scenario).model_copy(update={"controller": self._against}))
        self.flights = tuple(start(each, live=True) for each in scenarios)
        self._held = _Held()
        self.reason: str | None = None
        weight = self.flights[0].actual.mass * self.flights[0].actual.gravity
        self._stiffness, self._strongest = STIFFNESS * weight, STRONGEST * weight

    def close(self) -> None:
        """Give back what the flights hold; what was flown stays."""
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
        """What the flight is audited against."""
        return tuple(self.flights[0].limits)

    def submit(
        self, table: Mapping[str, Any], *, subject: str | None = None, successor: Successor | None = None
    ) -> None:
        """Let something happen from the next period on; from any thread."""
        self._queue.append(Input(table=dict(table), subject=subject, successor=successor))

    def advance(self) -> Frame:
        """Fly one control period.

        Raises:
            InputError: the first flight has ended, or is as long as any may be.
        """
        if self.reason is not None:
            raise InputError(f"the flight has ended: {self.reason}")
        refused = [reason for each in self._taken() if (reason := self._apply(each)) is not None]
        pull = self._hold(refused)
        samples: list[Sample | None] = []
        for flight in self.flights:
            if flight.loop.reason is not None:
                samples.append(None)
                continue
            try:
                samples.append(flight.step())
            except FlightError as error:
                samples.append(None)
                if flight is self.flights[0]:
                    self.reason = str(error)
        margins = tuple(
            {} if sample is None else flight.margins(sample)
            for flight, sample in zip(self.flights, samples, strict=True)
        )
        horizons = tuple(
            None if sample is None else _horizon(flight, sample)
            for flight, sample in zip(self.flights, samples, strict=True)
        )
        return Frame(
            k=self.k - 1,
            time=round((self.k - 1) * self.period, 9),
            samples=tuple(samples),
            margins=margins,
            horizons=horizons,
            pull=pull,
            refused=tuple(refused),
        )

    def flight(self, which: int = 0) -> Flight:
        """What has been flown so far, audited; its scenario flies to the same bits.

        Raises:
            InputError: nothing has been flown.
        """
        if self.k == 0:
            raise InputError("nothing has been flown yet")
        return self.flights[which].flight()

    def _taken(self) -> list[Input]:
        """The inputs up to now, of each subject the last one."""
        taken: list[Input] = []
        while self._queue:
            taken.append(self._queue.popleft())
        last = {each.subject: i for i, each in enumerate(taken)}
        return [each for i, each in enumerate(taken) if each.subject is None or last[each.subject] == i]

    def _apply(self, given: Input) -> str | None:
        """Let an input act; why it is refused, or None."""
        table = given.table
        try:
            kind = str(table.get("type"))
            if unknown := sorted(set(table) - _ENTRIES.get(kind, set(table))):
                raise InputError(f"{kind}: unknown: {', '.join(unknown)}; it has {', '.join(sorted(_ENTRIES[kind]))}")
            if kind == "pull":
                to = table.get("to")
                self._held.pull = None if to is None else Pull(_vector(to, "pull", "to"))
            elif kind == "wear":
                self._wear(table)
            elif kind == "steer":
                self._held.steer = np.array(_vector(table.get("velocity"), "steer", "velocity"))
            else:
                self._happen(table, given.successor)
        except InputError as error:
            return str(error)
        return None

    def _wear(self, table: Mapping[str, Any]) -> None:
        rotor, loss = table.get("rotor"), table.get("loss")
        if not isinstance(rotor, int) or isinstance(rotor, bool) or rotor not in range(1, N_ROTORS + 1):
            raise ParameterError("wear", "rotor", rotor, f"1 to {N_ROTORS}")
        if not isinstance(loss, int | float) or isinstance(loss, bool) or not 0.0 <= loss <= 1.0:
            raise ParameterError("wear", "loss", loss, "from 0 to 1")
        self._held.wear[rotor] = float(loss)

    def _happen(self, event: Mapping[str, Any], successor: Successor | None = None) -> None:
        """Apply an event to every flight, to none of them if one refuses.

        A controller's event is the first flight's alone.
        """
        if event.get("type") == "controller":
            self.flights[0].apply(event, successor)
            return
        if event.get("type") == "setpoint":
            self._held.setpoint = None
        for flight in self.flights:
            if flight.loop.reason is None:
                flight.apply(event)

    def _hold(self, refused: list[str]) -> Array:
        """Let what is held act for one period more; the force of the hand (3,) [N]."""
        held, force, last = self._held, np.zeros(3), self.flights[0].loop.last
        if last is None:  # where the vehicle is shows once a period has been flown
            return force
        if held.pull is not None:
            reach = np.array(held.pull.to) - last.segment.physics[-1, 1:4]
            force = self._stiffness * reach
            size = float(np.linalg.norm(force))
            force *= min(1.0, self._strongest / size) if size > 0.0 else 0.0
            force = np.round(force / FORCE_STEP) * FORCE_STEP
        events: list[dict[str, Any]] = []
        if force.any():
            events.append(
                {"type": "push", "duration": self.period, "force": [round(each, 6) for each in force.tolist()]}
            )
        for rotor, loss in sorted(held.wear.items()):
            if loss > 0.0:
                events.append({"type": "rotor_loss", "rotor": rotor, "loss": loss, "duration": self.period})
        if held.steer.any():
            at = last.observation.reference[:3] if held.setpoint is None else held.setpoint
            held.setpoint = np.round(at + self.period * held.steer, 6)
            events.append({"type": "setpoint", **dict(zip(REFERENCE_NAMES, held.setpoint.tolist(), strict=False))})
        for event in events:
            try:
                for flight in self.flights:
                    if flight.loop.reason is None:
                        flight.apply(event)
            except InputError as error:  # as where a scenario is full of events
                refused.append(f"{error}; all is let go")
                self._held = _Held()
                return np.zeros(3)
        return force


def _vector(value: object, name: str, entry: str) -> tuple[float, float, float]:
    """Three finite numbers."""
    if not isinstance(value, list | tuple) or len(value) != 3 or not all(map(_is_finite, value)):
        raise ParameterError(name, entry, value, "three finite numbers")
    x, y, z = map(float, value)
    return x, y, z


def _is_finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _horizon(flight: StartedFlight, sample: Sample) -> Array | None:
    predict = getattr(flight.loop.controller, "predict", None)
    if predict is None or len(sample.command.plan) < 1:
        return None
    state = sample.observation.state
    path: Array = predict(state[None], sample.command.plan[None])[0][:, list(POSITION)]
    return np.concatenate([state[None, list(POSITION)], path])
