"""From a scenario to its flight: the one loop for batches, live sessions, learning environments and scripts.

`Rollout` takes the parts from `quadsim.scenarios.assembly`, starts a `quadsim.sim.loop.ClosedLoop`, carries out events,
and makes a `quadsim.rollout.flown.Flight` of the log and its audit.  Flights that need nothing from Python in between
are flown by the core in one call (`quadsim.sim.core_loop`), with the same bits.
"""

from __future__ import annotations

import contextlib
import math
import os
import time as clock
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from threadpoolctl import threadpool_limits

from quadsim.border import numbers_of
from quadsim.console.progress import Progress, silent
from quadsim.controller import Command, Controller, CoreController, takes_targets
from quadsim.errors import InputError, ParameterError
from quadsim.flight.audit import audit, smallest_margins
from quadsim.flight.log import FlightLog
from quadsim.input_limits import MOST_STEPS
from quadsim.mpc.pilot.pilot import Pilot
from quadsim.rollout.flight_events import FlightEvents, Successor, prepared
from quadsim.rollout.flown import Flight
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.schema.events import ControllerEvent, Event, SetpointEvent
from quadsim.scenarios.schema.scenario import LONGEST_FLIGHT, Scenario
from quadsim.sim.computation import check_measured
from quadsim.sim.core_loop import fly_in_core
from quadsim.sim.effects import Force
from quadsim.sim.estimator import Tally
from quadsim.sim.loop import ClosedLoop, Reference, complete
from quadsim.sim.navigation import Navigation
from quadsim.sim.physics import Observation, Period, one_period
from quadsim.sim.plant import Plant
from quadsim.sim.sensing import SensorName
from quadsim.state import Array

_ROUNDING: Final = 1e-6  # [periods] by which a quotient of times may miss a whole number


def closed_loop(
    assembly: Assembly,
    plant: Plant,
    controller: Controller,
    reference: Array | Reference,
    *,
    navigation: Navigation | None,
    recorded: bool = True,
) -> ClosedLoop:
    """Return the loop of a scenario, at t = 0.

    The reference is (K + N, 4) x, y, z [m], yaw [rad], or an object that gives its rows (see `Assembly.followed`).
    """
    scenario = assembly.scenario
    return ClosedLoop(
        plant,
        controller,
        reference,
        initial_state=assembly.initial_state(assembly.motion),
        initial_speeds=assembly.initial_speeds,
        steps_per_period=scenario.steps_per_period,
        navigation=navigation,
        computation=assembly.computation(),
        rng=assembly.generator("computation"),
        ground=assembly.ground(),
        loss=scenario.lost.limits,
        motion=assembly.motion,
        quaternions=needs_quaternions(scenario),
        recorded=recorded,
    )


def needs_quaternions(scenario: Scenario) -> bool:
    """Return whether one of a scenario's controllers flies at any attitude, where Euler angles may be singular."""
    changed = [spec for _, spec in scenario.controller_changes]
    return any(spec.any_attitude for spec in (scenario.controller, *changed))


def _checked_controller(assembly: Assembly, user_controller: Controller | None) -> Controller:
    """Return the controller that flies, the scenario's or `user_controller`.

    Raises:
        InputError: it cannot be built, or does not fit the scenario.
    """
    scenario = assembly.scenario
    if user_controller is not None and any(isinstance(event, ControllerEvent) for event in scenario.events):
        raise ParameterError(
            "", "controller", user_controller, "absent where an event changes the scenario's controller"
        )
    controller = user_controller
    if controller is None:
        controller = assembly.controller()
    check_measured(scenario.computation, controller)
    return controller


def _check_parts(assembly: Assembly, controller: Controller) -> None:
    """Refuse an autopilot without a controller that commands it, and events with a controller that cannot be built.

    Raises:
        InputError: it names the part.
    """
    if assembly.user_autopilot is not None and not takes_targets(controller):
        rule = 'given with a controller that commands thrust and body rates, e.g. commands = "rates"'
        raise ParameterError("", "autopilot", type(assembly.user_autopilot).__name__, rule)
    for _, spec in assembly.scenario.controller_changes:
        assembly.controller(spec)  # one by one, as each may take megabytes


@contextlib.contextmanager
def _restoring_working_directory() -> Iterator[None]:
    """Return to the working directory at the end, even if it has been removed in between.

    User code may change it.  The folder is kept open, because a path does not lead back to one that has been removed.
    """
    flags = getattr(os, "O_PATH", os.O_RDONLY)  # O_PATH, where it exists, needs no permission to read the folder
    directory = os.open(os.curdir, flags)
    try:
        yield
    finally:
        os.fchdir(directory)
        os.close(directory)


class Rollout:
    """A scenario's flight, period by period; everything is built and checked before the first.

    Events come from the scenario and from `apply`. A period depends on these and on the seed, never on a clock: flying
    the scenario of `flight` gives the same bits.  Linear algebra is limited to one thread in the whole process from
    then on.  Use it in one thread at a time, except for `successor`. It owns native memory: `close` it, or use it as a
    context manager.

    Attributes:
        vehicle: the modelled vehicle.
        actual: the actual vehicle, which flies.
        limits: the limits of the audit.
        loop: the closed loop; its `controller` is the one in command.

    Examples:
        >>> import quadsim
        >>> with quadsim.start("hover", live=True) as started:
        ...     while started.k < 40:
        ...         sample = started.step()
        ...         if started.k == 20:
        ...             event = started.apply({"type": "push", "duration": 0.5, "force": [2.0, 0.0, 0.0]})
        ...     flight = started.flight()
        >>> event.at, flight.time.size, bool(flight.state["x"][-1] > 0.01)
        (1.0, 40, True)
        >>> bool((quadsim.fly(flight.scenario).command == flight.command).all())
        True
    """

    @_restoring_working_directory()
    def __init__(
        self,
        scenario: Scenario | Assembly,
        user_controller: Controller | None = None,
        forces: Sequence[Force] | None = None,
        *,
        live: bool = False,
        recorded: bool = True,
    ) -> None:
        """Set up at t = 0.

        Args:
            scenario: the scenario to fly, or its assembly.
            user_controller: replaces the scenario's controller.
            forces: replace the scenario's forces.
            live: see `quadsim.commands.app.start`.
            recorded: see `quadsim.commands.app.start`.

        Raises:
            InputError: something cannot be built.
        """
        threadpool_limits(limits=1)  # the matrices are small, and results must not depend on the number of cores
        if isinstance(scenario, Assembly):
            assembly = scenario
        else:
            assembly = Assembly(scenario)
        if live:
            assembly = assembly.of(prepared(assembly))  # so that `apply` takes every kind of event
        controller = _checked_controller(assembly, user_controller)
        assembly = assembly.with_user_bounds(controller)
        _check_parts(assembly, controller)
        self.vehicle = assembly.vehicle
        self.actual = assembly.actual
        self.limits = assembly.limits
        self._controller_name = controller.name
        self._solver_name = controller.solver
        self._longest_horizon = controller.horizon
        self._has_user_code = user_controller is not None or forces is not None or assembly.user_autopilot is not None
        self._plant = assembly.plant(forces)
        self._navigation = assembly.navigation()
        began = clock.perf_counter()
        self._reference = assembly.followed()
        self.loop = closed_loop(
            assembly, self._plant, controller, self._reference, navigation=self._navigation, recorded=recorded
        )
        self._simulate_s = clock.perf_counter() - began
        build = None
        if user_controller is None:
            build = assembly.controller
        self._events = FlightEvents(
            assembly,
            plant=self._plant,
            navigation=self._navigation,
            reference=self._reference,
            loop=self.loop,
            build=build,
        )

    def __repr__(self) -> str:
        scenario = self.scenario
        flown = f"{self.k * scenario.control_period:.2f} of {scenario.duration:g} s flown by {self._controller_name}"
        if self.loop.reason is not None:
            flown += f", {self.loop.reason}"
        return f"<Rollout {scenario.name}: {flown}>"

    def __enter__(self) -> Rollout:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the plant's resources; the recorded flight is kept, and no further steps are possible."""
        self._events.close()
        self._plant.close()

    @property
    def scenario(self) -> Scenario:
        """The scenario flown, with the events applied."""
        return self._events.scenario

    @property
    def k(self) -> int:
        """Control periods flown so far."""
        return self.loop.k

    @property
    def done(self) -> bool:
        """Whether the flight has reached its scenario's end, where it may still be continued, or has ended early."""
        return self.loop.reason is not None or self.k >= self.scenario.periods

    @property
    def observation(self) -> Observation:
        """The data at the start of this period, measured once; events applied after that act from the next period on.

        Raises:
            FlightError: the vehicle is lost; the flight has ended.
        """
        if self.loop.before is None:
            raise InputError("the flight is closed")
        return self.loop.observation

    def step(self, command: Command | Array | None = None) -> Period:
        """Fly one control period.

        Args:
            command: replaces the controller's answer: a command, or (4,) rotor speeds [rad/s].  The scenario does not
                record it: flying `scenario` again is a flight without it.

        Raises:
            FlightError: the flight has ended in this period, which is not part of it.
            InputError: it had ended before, is closed, or has the largest number of periods.
        """
        if self.loop.before is None:
            raise InputError("the flight is closed")
        self._longest_horizon = max(self._longest_horizon, self.loop.controller.horizon)
        if self.k >= self._most_periods:
            raise InputError(f"a flight has at most {self.k} control periods of {self.scenario.control_period} s")
        if isinstance(command, Command):
            command = replace(command, speeds=np.array(command.speeds), plan=np.array(command.plan))
        elif command is not None:
            speeds = numbers_of(command)
            command = Command(speeds=speeds, plan=np.tile(speeds, (self.loop.controller.horizon, 1)))
        began = clock.perf_counter()
        try:
            return self.loop.step(command)
        finally:
            self._simulate_s += clock.perf_counter() - began

    @property
    def _most_periods(self) -> int:
        """The largest number of control periods: within a day, and within the rows that the tables of a log may have.

        The physics steps of a period take a row each, and so do the predicted samples of a period.
        """
        scenario = self.scenario
        most_by_rows = MOST_STEPS // max(scenario.steps_per_period, self._longest_horizon)
        most_by_time = math.floor(LONGEST_FLIGHT / scenario.control_period + _ROUNDING)
        return min(most_by_rows, most_by_time)

    @_restoring_working_directory()
    def fly(self, progress: Progress = silent, *, until: float = math.inf) -> Flight:
        """Fly to the scenario's end, audit the flight and close.

        A flight error or Ctrl-C ends the flight early; the periods before are audited and returned all the same.

        A change of the working directory by a controller lasts only for the flight.

        Args:
            progress: called with (activity, done, total).
            until: [s] ends it earlier, rounded up to whole control periods.
        """
        with self:
            began = clock.perf_counter()
            periods_until = math.ceil(min(until, LONGEST_FLIGHT) / self.scenario.control_period - _ROUNDING)
            periods = min(self.scenario.periods, periods_until)
            progress("flight", self.k, periods)
            complete(self.loop, periods=periods, progress=lambda done: progress("flight", done, periods))
            self._simulate_s += clock.perf_counter() - began
            return self.flight()

    @property
    def core_law(self) -> CoreController | None:
        """The compiled controller that can fly this scenario in the core alone (`fly_in_core`).

        None where the flight needs Python in between: for events of controller or set-point, for code of the user, for
        computing time, ground or obstacles, for a controller at any attitude, or for one that the core does not have.
        """
        scenario = self.scenario
        controller = self.loop.controller
        if self._has_user_code or scenario.forces or self.loop.beyond_core or needs_quaternions(scenario):
            return None
        if any(isinstance(event, SetpointEvent | ControllerEvent) for event in scenario.events):
            return None
        if not isinstance(controller, Pilot):
            return None
        return controller.in_core()

    def fly_in_core(self, law: CoreController) -> Flight | None:
        """Fly all periods in the core by `core_law`, audit the flight and close; none of them has been flown yet.

        The flight lacks predictions and KKT residuals; all other numbers are those of `fly`.

        Returns:
            the flight; None where a period needs more than the core has, so that only `fly` of a new rollout gives it.
        """
        scenario = self.scenario
        began = clock.perf_counter()
        with self:
            log = fly_in_core(
                law,
                self._plant,
                self._reference.first(scenario.periods + self.loop.controller.horizon),
                speeds=self._plant.speeds,
                periods=scenario.periods,
                steps_per_period=scenario.steps_per_period,
                navigation=self._navigation,
                loss=scenario.lost.limits,
            )
            self._simulate_s += clock.perf_counter() - began
            if log is None:
                return None
            return self._flight_of(log, scenario)

    def apply(self, event: Event | Mapping[str, Any], successor: Successor | None = None) -> Event:
        """Apply an event, like one of the file, from the first period on that is not yet observed.

        Args:
            event: an entry of `events`; `at` is set here.
            successor: for an event `controller`, what `successor` returned for its fields; by default it is built
                here, which takes time.

        Returns:
            The event with its time, as the scenario now has it.

        Raises:
            InputError: it is not allowed, or the flight was not started for events of its kind; nothing has changed.
        """
        return self._events.apply(event, successor)

    def successor(self, fields: Mapping[str, Any]) -> Successor:
        """Build a controller with some fields of `[controller]` changed; callable from any thread.

        Args:
            fields: as in an event `controller`.

        Raises:
            InputError: it cannot be built.
        """
        return self._events.successor(fields)

    def leave_course(self) -> None:
        """End the constraints on the tracking error: from now on a person steers, and no course is followed."""
        self._events.leave_course()
        self.limits = self._events.assembly.limits

    def margins(self, sample: Period | None = None) -> dict[str, float]:
        """Return the smallest signed margin of each constraint within one period; negative = beyond the bound.

        A margin is in the constraint's unit, over the states before and after each physics step.  Outside the
        constraint's time window it is NaN.

        Args:
            sample: the period; by default the last one.
        """
        if sample is None:
            sample = self.loop.last
        if sample is None:
            raise InputError("no period has been flown yet")
        return smallest_margins(one_period(sample, self._plant.timestep), self.limits)

    def violations(self, sample: Period | None = None) -> dict[str, float]:
        """Return how far each constraint is exceeded beyond its tolerance within one period: g <= 0 if it holds.

        The largest g of the period counts, in the constraint's unit; outside its time window, g is minus infinity.

        Args:
            sample: the period; by default the last one.
        """
        margins = self.margins(sample)
        violations = {}
        for limit in self.limits:
            excess = float(limit.excess(margins[limit.name]))
            if math.isnan(excess):
                excess = -math.inf
            violations[limit.name] = excess
        return violations

    def flight(self) -> Flight:
        """Return the flight so far, audited; its scenario has the same length and reproduces it bit for bit."""
        scenario = self._events.flown()
        self.loop.quaternions = needs_quaternions(scenario)
        return self._flight_of(self.loop.log(), scenario)

    def _flight_of(self, log: FlightLog, scenario: Scenario) -> Flight:
        """Audit a log, and return it as a flight of a scenario."""
        assembly = self._events.assembly.of(scenario)
        tallies: Mapping[SensorName, Tally] = {}
        if self._navigation is not None:
            tallies = self._navigation.tallies
        return Flight(
            scenario=assembly.recording,
            assembly=assembly,
            log=log,
            findings=audit(log, self.limits),
            controller=self._controller_name,
            solver=self._solver_name,
            simulate_s=self._simulate_s,
            tallies=tallies,
            infeasible_period=self._events.first_infeasible_period(),
            own_code=self._has_user_code,
            try_remedies=_try_remedies,
        )


def _try_remedies(explanation: Mapping[str, Any], flight: Flight) -> dict[str, Any]:
    """Fly the changes that a flight's diagnosis suggests; see `quadsim.rollout.remedies.tried`."""
    from quadsim.rollout import growth, remedies  # imported here because few flights need them

    def fly(assembly: Assembly, until: float) -> Flight:
        return Rollout(assembly).fly(until=until)

    def measure(scenario: Scenario, heading: float) -> growth.Growth:
        return growth.grown(scenario, started_plain, heading=heading, longest=growth.SHORT_PAIR)

    return remedies.tried(explanation, flight, fly, measure)


def fly_for_table(scenario: Scenario) -> Flight:
    """Fly a scenario for its verdict, margins and metrics; in the core, which is faster, wherever it can.

    The flight may lack predictions and KKT residuals (`Rollout.fly_in_core`); all other numbers are those of
    `Rollout.fly`.

    Raises:
        InputError: something cannot be built.
    """
    rollout = Rollout(scenario)
    law = rollout.core_law
    if law is None:
        return rollout.fly()
    flight = rollout.fly_in_core(law)
    if flight is None:
        return Rollout(scenario).fly()  # from the start again: the core left it in the middle
    return flight


def started_plain(assembly: Assembly) -> Rollout:
    """Start a flight that is not recorded."""
    return Rollout(assembly, recorded=False)
