"""The closed loop: plant -> controller -> command -> plant, once per control period.

At t_k the loop measures the plant, through sensors and estimator where there are any, gives the controller the measured
state and the reference of the next N periods, and receives u(k).  The plant holds u(k) until t_{k+1}; a command that is
computed late leaves u(k-1) in force until it arrives (`quadsim.sim.computation`).  Every period is kept for the log.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import time as clock
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import numpy as np

from quadsim.border import user_code
from quadsim.controller import (
    GROUNDED,
    Adopting,
    Beginning,
    Command,
    Controller,
    Engaging,
    Foreseeing,
    InnerLoop,
    Phase,
    Predicting,
    StepInputs,
    takes_targets,
)
from quadsim.core.mirror import Struct
from quadsim.core.structs import InnerStruct
from quadsim.errors import FlightError, InputError, InterruptedFlightError, LostError, RaisedError, described
from quadsim.flight.log import FlightLog, LoggedSignals
from quadsim.flight.phase import check_loss
from quadsim.interrupts import current_hold
from quadsim.motion import Motion
from quadsim.sim.computation import Computation, physics_steps
from quadsim.sim.physics import Observation, Period, flight_log, inner_steps, physics_to_state
from quadsim.sim.plant import Plant
from quadsim.state import INDEX, N_STATES, POSITION, REFERENCE_NAMES, Array, ReferenceTurns

if TYPE_CHECKING:
    from quadsim.flight.phase import PhaseMonitor
    from quadsim.sim.navigation import Navigation

_log: Final = logging.getLogger("quadsim")
_HEIGHT: Final = REFERENCE_NAMES.index("z")
TAKEOFF_LEAD: Final = "takeoff_lead"
"""Name of the logged signal: by how much `quadsim.flight.phase.TakeoffLead` raises the reference in a period [m]."""


class Hold(NamedTuple):
    """A command that is in force for a number of physics steps."""

    inner: InnerLoop | None  # the inner loop that flies the command; None: the command is rotor speeds
    command: Array  # (4,) or (8,)
    steps: int


class Reference(Protocol):
    """A filtered reference x, y, z [m], yaw [rad], perhaps not known in advance."""

    def row(self, k: int) -> Array:
        """(4,) at t_k."""
        ...

    def preview(self, k: int, n: int) -> Array:
        """(n, 4) at t_{k+1} .. t_{k+n}, as known at t_k."""
        ...


@dataclass(frozen=True, kw_only=True)
class KnownReference:
    """A reference known from the start: `values` (K + N, 4), row k at t_k."""

    values: Array

    def row(self, k: int) -> Array:
        """See `Reference`."""
        return np.asarray(self.values[k])

    def preview(self, k: int, n: int) -> Array:
        """See `Reference`."""
        return np.asarray(self.values[k + 1 : k + 1 + n])


class ClosedLoop:
    """A flight, advanced period by period.

    Batch flights, live sessions, learning environments and scripts use the same loop.  It resets plant, controller and
    navigation at the start.

    Attributes:
        k: control periods flown so far.
        period: length of one [s].
        controller: the controller in command; see `switch`.
        course: the reference that is followed.  Observations have it with its yaw changed by whole turns to be near the
            measured yaw.
        answered: latest time at which a command has arrived so far [s].
        before: called with k at the start of a period, before any measurement.  What it changes acts in that period.
        last: the last period; None before the first.
        reason: why the flight ended early; None while it has not.
    """

    def __init__(
        self,
        plant: Plant,
        controller: Controller,
        reference: Array | Reference,
        *,
        initial_state: Array,
        initial_speeds: Array,
        steps_per_period: int,
        navigation: Navigation | None = None,
        computation: Computation | None = None,
        rng: np.random.Generator | None = None,
        ground: PhaseMonitor | None = None,
        loss: Mapping[str, float] | None = None,
        motion: Motion | None = None,
        quaternions: bool = False,
        recorded: bool = True,
    ) -> None:
        """Set up at t = 0.

        Args:
            plant: what is flown.
            controller: what flies it.
            reference: (K + N, 4) filtered x, y, z [m], yaw [rad], row k at t_k, K the periods to be flown and N the
                controller's preview; or an object with `row(k)` and `preview(k, n)`.
            initial_state: (12,).
            initial_speeds: (4,) u(-1), and the rotor speeds at the start [rad/s].
            steps_per_period: physics steps per control period.
            navigation: measured or estimated state for the controller; the true state where absent.
            computation: how long commands take, in simulated time; none where absent.
            rng: what `computation` draws from.
            ground: finds the phase of the flight from contact with ground and obstacles; absent: always flying.
            loss: limits by the names of `quadsim.flight.phase.CRITERIA`, checked once per control period until it has
                crashed; none where absent.
            motion: the reference with its derivatives from t_0 on, for controllers that use them; absent where only
                positions and yaw are known.
            quaternions: whether attitude and body rates are logged beside Euler angles and their rates.
            recorded: whether all periods are stored, for `log`: some 10 kB each.
        """
        plant.reset(initial_state, initial_speeds)
        self._yaw = float(initial_state[INDEX["yaw"]])
        controller.reset(initial_speeds)
        _tell_body_rates(controller, plant)
        if navigation is not None:
            navigation.reset(plant.physics, initial_speeds, yaw=self._yaw)
        if ground is not None:
            ground.reset()

        if isinstance(reference, np.ndarray):
            reference = KnownReference(values=reference)
        if rng is None:
            rng = np.random.default_rng(0)

        self.k = 0
        self.period = steps_per_period * plant.timestep
        self.controller = controller
        self.course: Reference = reference
        self.computation = computation
        self.motion = motion
        self.quaternions = quaternions
        self.answered = 0.0
        self.before: Callable[[int], None] | None = None
        self.last: Period | None = None
        self.reason: str | None = None
        self._loss_criterion: str | None = None
        self._interrupted = False
        self._traceback: tuple[str, ...] = ()

        self._plant = plant
        self._navigation = navigation
        self._ground = ground
        self._turns = ReferenceTurns()
        self._steps_per_period = steps_per_period
        self._loss_limits = loss
        self._rng = rng
        self._start = plant.physics
        self._initial_speeds = np.array(initial_speeds, float)
        self._last_speeds = self._initial_speeds  # the rotor speeds commanded last
        self._lowest_reference = float(initial_state[INDEX["z"]])  # [m]
        self._commands = _CommandsUnderWay(self._initial_speeds, computation, steps_per_period, plant.timestep)
        self._active_inner: _ActiveInnerLoop | None = None  # the inner loop called last
        self._observed: Observation | None = None
        self._samples: list[Period] | None = None
        if recorded:
            self._samples = []
        self._earlier_predictions: list[_Prediction] = []  # of the controllers before this one
        self._switched_at = 0  # the first period of this controller

    @property
    def beyond_core(self) -> bool:
        """Whether periods depend on computing time, on the ground or on obstacles, which `core_loop` leaves out."""
        return self.computation is not None or self._ground is not None

    @property
    def observed(self) -> bool:
        """Whether the period that starts now has been observed."""
        return self._observed is not None

    @property
    def time(self) -> float:
        """t_k, when the next period starts [s]."""
        return self.k * self.period

    def switch(self, controller: Controller) -> None:
        """Let another controller fly from the period that starts now on.

        It is reset.  If it is `Adopting`, it then takes over what the controller before it has learned: its observer,
        its plan and the state of its fallback.

        Raises:
            InputError: the period that starts now is already observed, with the preview of the controller before.
            RaisedError: its `reset` or `adopt` raised.
        """
        if self._observed is not None:
            raise InputError("a controller takes over before a period is observed, not after")
        with _ending_flight(self.time):
            controller.reset(self._last_speeds.copy())
            _tell_body_rates(controller, self._plant)
            if isinstance(controller, Adopting):
                controller.adopt(self.controller)
        if self.k > self._switched_at:
            self._earlier_predictions.append(self._predict())
        self.controller = controller
        self._switched_at = self.k

    @property
    def truth(self) -> Array:
        """(12,) the true state now."""
        return self._plant.state()

    @property
    def physics(self) -> Array:
        """(14,) MuJoCo's state now."""
        return self._plant.physics

    @property
    def rotors(self) -> Array:
        """(4,) rotor speeds now [rad/s]."""
        return self._plant.speeds

    def followed(self, yaw: float) -> Array:
        """Return the reference now and over the controller's preview (1 + N, 4), on the turn of a yaw [rad]."""
        now = self.course.row(self.k)
        preview = self.course.preview(self.k, self.controller.horizon)
        return self._turns.follow(np.concatenate([now[None], preview]), yaw)

    @property
    def observation(self) -> Observation:
        """The data at the start of the period that starts now; measured at the first call, then kept.

        Raises:
            FlightError: the vehicle is lost; the flight has ended.
        """
        if self._observed is None:
            self._require_not_ended()
            try:
                self._observed = self._observe()
            except FlightError as error:
                self._end(error)
                raise
        return self._observed

    def step(self, command: Command | None = None) -> Period:
        """Fly one control period; a command that is given here replaces the controller's answer.

        Raises:
            FlightError: the flight has ended in this period, which is not part of it.
            InputError: it had ended before.
        """
        self._require_not_ended()
        observation = self.observation
        try:
            sample = self._fly(observation, command)
        except FlightError as error:
            self._end(error)
            raise
        self.k += 1
        self._observed = None
        self.last = sample
        if self._samples is not None:
            self._samples.append(sample)
        return sample

    def interrupt(self) -> None:
        """End the flight here, as the person flying does by Ctrl-C."""
        self._interrupted = True
        self._end(InterruptedFlightError(time=self.time))

    def log(self) -> FlightLog:
        """All periods flown so far, with plant rows at the physics rate.

        Raises:
            InputError: they were not recorded.
        """
        if self._samples is None:
            raise InputError("no period of this flight was recorded: it was begun with recorded=False")
        log = flight_log(
            self._samples,
            self._start,
            self._initial_speeds,
            self._yaw,
            self.period,
            self._plant.timestep,
            quaternions=self.quaternions,
        )
        predictions = list(self._earlier_predictions)
        if self.k > self._switched_at:
            predictions.append(self._predict())
        return replace(
            log,
            predicted=_joined_positions(predictions),
            foreseen=_joined_next_states(predictions),
            reason=self.reason,
            interrupted=self._interrupted,
            traceback=self._traceback,
            lost=self._loss_criterion,
        )

    def _require_not_ended(self) -> None:
        if self.reason is not None:
            raise InputError(f"the flight has ended {self.reason}")

    def _end(self, error: FlightError) -> None:
        """Note why the flight ended.

        The error itself is not kept: its traceback refers to this loop, and this cycle would keep all of it in memory.
        """
        self.reason = str(error)
        self._loss_criterion = None
        self._traceback = ()
        if isinstance(error, LostError):
            self._loss_criterion = error.criterion
        if isinstance(error, RaisedError):
            self._traceback = error.traceback

    def _observe(self) -> Observation:
        """Measure at t_k, and check that the vehicle is not lost.

        Raises:
            LostError: it is.
        """
        k = self.k
        if self.before is not None:
            self.before(k)
        truth = self._plant.state()
        if self._navigation is None:
            state = truth.copy()
            attitude, body_rates = self._plant.attitude
        else:
            state = self._navigation.state()
            attitude, body_rates = self._navigation.attitude
        reference_rows = self.followed(float(state[INDEX["yaw"]]))
        reference = reference_rows[0]
        preview = reference_rows[1:]
        phase = self._current_phase(preview)
        self._lowest_reference = min(self._lowest_reference, float(reference[_HEIGHT]))
        if self._loss_limits is not None and phase is not Phase.CRASHED:
            check_loss(self._loss_limits, self.time, truth, reference, self._lowest_reference)
        motion = None
        if self.motion is not None:
            motion = self.motion.after(k)
        now = StepInputs(
            time=self.time,
            phase=phase,
            acting=self._last_speeds,
            attitude=attitude,
            body_rates=body_rates,
            motion=motion,
            signals=LoggedSignals(),
        )
        return Observation(k=k, state=state, truth=truth, reference=reference, preview=preview, moment=now)

    def _current_phase(self, preview: Array) -> Phase:
        """Return the phase of the flight after the physics steps since the last period began."""
        if self._ground is None:
            return Phase.FLYING
        if self.last is None:
            physics = self._start[None]
        else:
            physics = self.last.steps["physics"]
        times = physics[:, 0]
        return self._ground.advance(times, physics_to_state(physics), preview)

    def _predict(self) -> _Prediction:
        """Return what the controller predicts for the periods that it flew; nothing if it has no model, or raised."""
        controller = self.controller
        samples: list[Period] = []
        if self._samples is not None:
            samples = self._samples[self._switched_at :]
        nothing = _Prediction(len(samples), None, None)
        if not samples or not isinstance(controller, Predicting | Foreseeing):
            return nothing
        measured = [sample.observation.state for sample in samples]
        planned = [sample.command.plan for sample in samples]
        states = np.stack(measured)
        next_states = None
        predicted = None
        try:
            with user_code(lambda error: InputError(described(error))):
                plans = np.stack(planned)
                if isinstance(controller, Foreseeing):
                    next_states = controller.foresee(states, plans[:, 0])
                if isinstance(controller, Predicting):
                    predicted = controller.predict(states, plans)
                if predicted is None:
                    return _Prediction(len(samples), None, next_states)
                if next_states is None:
                    next_states = predicted[:, 0].copy()
                return _Prediction(len(samples), predicted[:, :, list(POSITION)], next_states)
        except InputError as error:  # the flight itself is over, and is kept
            _log.warning("no predictions are kept: predict raised %s", error)
            return nothing

    def _controller_inputs(self, observed: Observation) -> tuple[StepInputs, Array, Array]:
        """Return the arguments of the controller's `step`: its inputs, the measured state and the reference ahead.

        For a take-off, the reference is raised by the height that the vehicle needs to leave the ground.
        """
        now = observed.moment
        state = observed.state
        preview = observed.preview
        if self._ground is None or now.phase in GROUNDED:
            return now, state, preview
        squared_speeds = float(np.sum(np.square(self._plant.speeds)))  # proportional to the thrust
        lead = self._ground.lead(observed.truth, float(observed.reference[_HEIGHT]), squared_speeds)
        if lead == 0.0:
            return now, state, preview
        now.log(TAKEOFF_LEAD, lead, "m")
        raised = preview.copy()
        raised[:, _HEIGHT] += lead
        if now.motion is not None:
            now = replace(now, motion=now.motion.raised(lead))
        return now, state, raised

    def _fly(self, observed: Observation, command: Command | None) -> Period:
        """Fly the period that starts now: ask for its command, send it, and take the physics steps."""
        plant = self._plant
        now = observed.moment
        step_s = 0.0
        if command is None:
            started = clock.perf_counter()
            with _ending_flight(now.time):
                command = self.controller.step(*self._controller_inputs(observed))
            step_s = clock.perf_counter() - started
        delay = 0.0
        if self.computation is not None:
            delay = self.computation.taken(now.time, command, self._rng)
        self.answered = max(self.answered, now.time + delay)
        missed = self._commands.send(command, delay, self.computation)
        before = plant.physics
        self._take_physics_steps(self._commands.next_period(), now.phase)
        target = None
        self._last_speeds = self._commands.last
        if takes_targets(self._commands.inner):
            target = self._commands.last
            self._last_speeds = plant.flown["commands"][-1].copy()
        return Period(
            observation=observed,
            command=command,
            speeds=self._last_speeds,
            target=target,
            delay=delay,
            missed=missed,
            step_s=step_s,
            before=before,
            steps=plant.flown,
            rotors=plant.speeds,
        )

    def _take_physics_steps(self, holds: Sequence[Hold], phase: Phase) -> None:
        """Fly the physics steps of a period under the commands in force, and record the sensors' samples."""
        plant = self._plant
        navigation = self._navigation
        plant.begin(self._steps_per_period)
        sensing = None
        if navigation is not None:
            sensing = navigation.begin(self._steps_per_period)
        for hold in holds:
            if hold.steps > 0:
                self._hold(hold, sensing)
        if navigation is not None:
            navigation.record(plant.flown, on_ground=phase in (Phase.LANDED, Phase.ARMED))

    def _hold(self, hold: Hold, sensing: Struct | None) -> None:
        """Fly physics steps under a command, by an inner loop if there is one.

        Raises:
            RaisedError: the inner loop raised, or its period is not a whole number of physics steps.
        """
        plant = self._plant
        inner = hold.inner
        if inner is None:
            plant.hold(hold.command, hold.steps, sensing=sensing)
            return
        with _ending_flight(plant.time):
            active = self._active_inner
            if active is None or active.inner is not inner:
                active = _ActiveInnerLoop(inner, inner_steps(inner.rate, plant.timestep))
                self._active_inner = active
            struct = active.engage(hold.command, plant.speeds)
        measured = None
        if active.measures:
            measured = self._navigation

        def ask() -> Array:
            """Return the answer of an inner loop that is not in the core."""
            if measured is None:
                attitude, rates = plant.attitude
            else:
                attitude, rates = measured.sensed(plant.physics)
            with _ending_flight(plant.time):
                return np.array(inner.speeds(plant.time, hold.command.copy(), rates, plant.speeds, attitude))

        plant.hold(hold.command, hold.steps, loop=struct, sensing=sensing, ask=ask)


class _CommandsUnderWay:
    """The commands between the controller and the plant: what is in force in this period and in those to come.

    Without computing time, a command is in force for the period that it was computed in.  A `Computation` lets it
    arrive later: after whole periods, and then some physics steps into a period.

    Attributes:
        last: (4,) or (8,) the command that is in force at the end of the period sent last.
        inner: the inner loop that flies it.
    """

    def __init__(
        self, initial_speeds: Array, computation: Computation | None, steps_per_period: int, timestep: float
    ) -> None:
        self.last = initial_speeds
        self.inner: InnerLoop | None = None
        self._steps_per_period = steps_per_period
        self._timestep = timestep
        self._plan = initial_speeds[None]  # the last plan that arrived in time,
        self._plan_age = 0  # and how many periods ago
        self._whole_periods = 0  # that each command spends under way before the period in which it arrives
        if computation is not None:
            self._whole_periods = computation.whole_periods(steps_per_period, timestep)
        initial = [Hold(None, initial_speeds, steps_per_period)]
        self._periods: deque[list[Hold]] = deque([initial] * self._whole_periods)

    def next_period(self) -> list[Hold]:
        """Return the holds of the next period, each once."""
        return self._periods.popleft()

    def send(self, command: Command, delay: float, computation: Computation | None) -> bool:
        """Send a command that arrives after a delay [s]; return whether it missed its deadline and is dropped.

        In the period of its arrival, the command before stays in force at first.  The last plan's next row follows it
        from the time at which the command was due, if plans continue.  From its arrival on, the command is in force.

        Args:
            command: the command.
            delay: simulated time from the measurement to its arrival [s].
            computation: says when a command is due, and whether plans continue; None: no computing time.
        """
        steps = self._steps_per_period
        arrival = self._steps_into_period(delay)
        missed = arrival > steps  # one that comes just in time is in force from the next period on
        end = min(arrival, steps)  # where what is in force before it ends
        plan_start = end
        if computation is not None and computation.plan:
            plan_start = min(end, self._steps_into_period(computation.delay))
        plan_row = min(self._plan_age + 1, len(self._plan) - 1)  # beyond the plan's end, its last row
        continued = Hold(self.inner, self._plan[plan_row], end - plan_start)
        holds = [Hold(self.inner, self.last, plan_start), continued]
        if missed:
            self._plan_age += 1
            if continued.steps:
                self.last = continued.command
        else:
            self._plan = command.plan
            self._plan_age = 0
            self.inner = command.inner
            self.last = command.speeds
            holds.append(Hold(self.inner, self.last, steps - arrival))
        self._periods.append(holds)
        return missed

    def _steps_into_period(self, delay: float) -> int:
        """Return the physics steps from the start of the period of arrival until a delay [s] has passed."""
        return physics_steps(delay, self._timestep) - self._whole_periods * self._steps_per_period


class _ActiveInnerLoop:
    """An inner loop that is in force.

    Attributes:
        inner: the inner loop.
        measures: whether it receives sensors' samples, as an autopilot does; else the true attitude and rates.
    """

    def __init__(self, inner: InnerLoop, stride: int) -> None:
        self.inner = inner
        self.measures = takes_targets(inner)
        self._stride = stride  # physics steps between answers
        self._is_engaged = False
        self._outside = InnerStruct()  # for the core where `inner` answers in Python
        self._engage: Callable[[Array, Array], Struct | None] | None = None
        if isinstance(inner, Engaging):
            self._engage = inner.engage

    def engage(self, command: Array, rotors: Array) -> Struct:
        """Put a command in force at rotor speeds (4,) [rad/s]; return the struct by which the core flies it."""
        struct = None
        if self._engage is not None:
            struct = self._engage(command, rotors)
        if struct is None:
            struct = self._outside
        struct.stride = self._stride
        if not self._is_engaged:
            struct.until = 0  # the first answer is due at once
            self._is_engaged = True
        return struct


def fly(
    plant: Plant,
    controller: Controller,
    reference: Array | Reference,
    *,
    periods: int,
    progress: Callable[[int], None] | None = None,
    **settings: Any,
) -> FlightLog:
    """Fly a number of control periods; arguments as of `ClosedLoop` and `complete`."""
    loop = ClosedLoop(plant, controller, reference, **settings)
    complete(loop, periods=periods, progress=progress)
    return loop.log()


def complete(loop: ClosedLoop, *, periods: int, progress: Callable[[int], None] | None = None) -> None:
    """Fly on until a number of control periods have been flown in all.

    A flight error or Ctrl-C ends the flight early; its log then has the reason, and all periods before.  `progress` is
    called after each period with the number of periods flown.
    """
    hold = current_hold()
    with uncollected():
        try:
            while loop.k < periods:
                loop.step()
                if progress is not None:
                    progress(loop.k)
        except FlightError:
            pass  # the loop has noted it
        except KeyboardInterrupt:
            hold.flown = True  # before the call below: the next signal could come within it
            loop.interrupt()
        finally:
            hold.flown = True


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """Exempt the objects that exist now from garbage collection within a block.

    A collection that visits all imported modules takes up to 30 ms, as long as a control period.
    """
    if gc.get_freeze_count():  # an outer block has exempted them
        yield
        return
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def _tell_body_rates(controller: Controller, plant: Plant) -> None:
    """Tell a controller that is `Beginning` the body rates now."""
    if isinstance(controller, Beginning):
        _, body_rates = plant.attitude
        controller.begin(body_rates)


def _ending_flight(time: float) -> AbstractContextManager[None]:
    """Turn whatever a controller's code raises into a flight error, so that the flight ends and is kept."""
    return user_code(lambda error: RaisedError("the controller", error, time=time), passing=(FlightError,))


class _Prediction(NamedTuple):
    """What a controller predicted in the periods that it flew."""

    periods: int
    positions: Array | None  # (K, N, 3) [m]
    next_states: Array | None  # (K, 12) at the start of the period after each


def _joined_next_states(predictions: Sequence[_Prediction]) -> Array | None:
    """Return the predicted states (K, 12) of the next periods: NaN for controllers without a model, None for all."""
    if all(prediction.next_states is None for prediction in predictions):
        return None
    parts = []
    for prediction in predictions:
        if prediction.next_states is None:
            parts.append(np.full((prediction.periods, N_STATES), np.nan))
        else:
            parts.append(prediction.next_states)
    return np.concatenate(parts)


def _joined_positions(predictions: Sequence[_Prediction]) -> np.ndarray[Any, np.dtype[np.float32]] | None:
    """Return the predicted positions, cut to the shortest of the horizons; None if a controller predicted none."""
    parts = []
    for prediction in predictions:
        if prediction.positions is None:
            return None
        parts.append(prediction.positions)
    if not parts:
        return None
    shortest = min(part.shape[1] for part in parts)
    positions = [part[:, :shortest] for part in parts]
    return np.ascontiguousarray(np.concatenate(positions), dtype=np.float32)
