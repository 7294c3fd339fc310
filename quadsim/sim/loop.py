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
"""What is logged of `quadsim.flight.phase.TakeoffLead` in the periods that have one [m]."""


Hold = tuple[InnerLoop | None, Array, int]
"""A command (4,) or (8,) in force for a number of physics steps, and the inner loop that flies it."""


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
        course: the reference that is followed; observations have its yaw on the turn of the measured one.
        answered: latest time at which a command has arrived so far [s].
        before: called with k at the start of a period, before any measurement; its changes act in that period.
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
            ground: what knows where the flight stands with ground and obstacles; it is flying throughout where absent.
            loss: limits by the names of `quadsim.flight.phase.CRITERIA`, checked once per control period until it has
                crashed; none where absent.
            motion: of the reference from t_0 on, for controllers that use it; absent where only positions are known.
            quaternions: whether attitude and body rates are logged beside Euler angles and their rates.
            recorded: whether all periods are stored, for `log`: some 10 kB each.
        """
        plant.reset(initial_state, initial_speeds)
        controller.reset(initial_speeds)
        _tell_attitude(controller, plant)
        self.k = 0
        self.period = steps_per_period * plant.timestep
        self.controller = controller
        self.computation = computation
        self.motion = motion
        self.answered = 0.0
        self.before: Callable[[int], None] | None = None
        self.reason: str | None = None
        self._criterion: str | None = None
        self._interrupted = False
        self._traceback: tuple[str, ...] = ()
        self._yaw = float(initial_state[INDEX["yaw"]])
        if navigation is not None:
            navigation.reset(plant.physics, initial_speeds, yaw=self._yaw)
        if ground is not None:
            ground.reset()
        self._plant = plant
        self._navigation = navigation
        self._ground = ground
        self._turns = ReferenceTurns()
        if isinstance(reference, np.ndarray):
            reference = KnownReference(values=reference)
        self.course: Reference = reference
        self._steps = steps_per_period
        self._loss = loss
        self.quaternions = quaternions
        if rng is None:
            rng = np.random.default_rng(0)
        self._draws = rng
        self._start = plant.physics
        self._initial_speeds = np.array(initial_speeds, float)
        self._lowest = float(initial_state[INDEX["z"]])
        self._acting = self._initial_speeds  # the command sent last: rotor speeds, or the target of an autopilot
        self._inner: InnerLoop | None = None  # flies it
        # What acts in the coming periods: those that commands spend under way, and the one in which the next arrives.
        self._under_way = 0
        if computation is not None:
            self._under_way = computation.whole_periods(steps_per_period, plant.timestep)
        held: list[Hold] = [(self._inner, self._acting, steps_per_period)]
        self._schedule: deque[list[Hold]] = deque([held] * self._under_way)
        self._speeds = self._initial_speeds  # the rotor speeds commanded last
        self._flying: _Flying | None = None  # the inner loop called last
        # the last plan that came in time, and how many periods ago
        self._plan = self._acting[None]
        self._age = 0
        self._observed: Observation | None = None
        self._samples: list[Period] | None = None
        if recorded:
            self._samples = []
        self.last: Period | None = None
        self._predicted: list[_Prediction] = []  # of the controllers before this one, and how many periods they flew
        self._switched = 0

    @property
    def attends(self) -> bool:
        """Whether its periods depend on computing time, on the ground or on obstacles."""
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

        It is reset, and then given the one before it where it is `Adopting`: an observer, a plan and the state of a
        fallback go on by it.

        Raises:
            InputError: the period that starts now is observed already, by the preview of the one before.
            RaisedError: its `reset` or `adopt` raised.
        """
        if self._observed is not None:
            raise InputError("a controller takes over before a period is observed, not after")
        with _ending_flight(self.time):
            controller.reset(self._speeds.copy())
            _tell_attitude(controller, self._plant)
            if isinstance(controller, Adopting):
                controller.adopt(self.controller)
        if self.k > self._switched:
            self._predicted.append(self._predict())
        self.controller = controller
        self._switched = self.k

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
        """Return the reference now and as far ahead as the controller looks (1 + N, 4), on the turn of a yaw [rad]."""
        ahead = [self.course.row(self.k)[None], self.course.preview(self.k, self.controller.horizon)]
        return self._turns.follow(np.concatenate(ahead), yaw)

    @property
    def observation(self) -> Observation:
        """What the period that starts now begins with, made once.

        Raises:
            FlightError: the vehicle is lost; the flight has ended.
        """
        if self._observed is None:
            self._require_going_on()
            try:
                self._observed = self._observe()
            except FlightError as error:
                self._end(error)
                raise
        return self._observed

    def step(self, command: Command | None = None) -> Period:
        """Fly one control period, with a command that is held instead of asking the controller, where one is given.

        Raises:
            FlightError: the flight has ended in this period, which is not part of it.
            InputError: it had ended before.
        """
        self._require_going_on()
        observation = self.observation
        try:
            sample = self._fly(observation, command)
        except FlightError as error:
            self._end(error)
            raise
        self.k = self.k + 1
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
        predictions = list(self._predicted)
        if self.k > self._switched:
            predictions.append(self._predict())
        return replace(
            log,
            predicted=_joined_positions(predictions),
            foreseen=_joined_next_states(predictions),
            reason=self.reason,
            interrupted=self._interrupted,
            traceback=self._traceback,
            lost=self._criterion,
        )

    def _require_going_on(self) -> None:
        if self.reason is not None:
            raise InputError(f"the flight has ended {self.reason}")

    def _end(self, error: FlightError) -> None:
        """Note why the flight ended; not the error itself, which would hold all that was flown in a cycle."""
        self.reason = str(error)
        self._criterion = None
        self._traceback = ()
        if isinstance(error, LostError):
            self._criterion = error.criterion
        if isinstance(error, RaisedError):
            self._traceback = error.traceback

    def _observe(self) -> Observation:
        k = self.k
        plant = self._plant
        navigation = self._navigation
        if self.before is not None:
            self.before(k)
        truth = plant.state()
        if navigation is None:
            state = truth.copy()
            attitude, body_rates = plant.attitude
        else:
            state = navigation.state()
            attitude, body_rates = navigation.attitude
        rows = self.followed(float(state[INDEX["yaw"]]))
        row = rows[0]
        preview = rows[1:]
        phase = Phase.FLYING
        if self._ground is not None:
            if self.last is None:
                since = self._start[None]
            else:
                since = self.last.steps["physics"]
            phase = self._ground.advance(since[:, 0], physics_to_state(since), preview)
        self._lowest = min(self._lowest, float(row[_HEIGHT]))
        if self._loss is not None and phase is not Phase.CRASHED:
            check_loss(self._loss, self.time, truth, row, self._lowest)
        motion = None
        if self.motion is not None:
            motion = self.motion.after(k)
        now = StepInputs(
            time=self.time,
            phase=phase,
            acting=self._speeds,
            attitude=attitude,
            body_rates=body_rates,
            motion=motion,
            signals=LoggedSignals(),
        )
        return Observation(k=k, state=state, truth=truth, reference=row, preview=preview, moment=now)

    def _predict(self) -> _Prediction:
        """Predict the controller's periods; nothing where it has no model, or raised."""
        controller = self.controller
        samples = (self._samples or [])[self._switched :]
        nothing = _Prediction(len(samples), None, None)
        if not samples or not isinstance(controller, Predicting | Foreseeing):
            return nothing
        measured = [sample.observation.state for sample in samples]
        planned = [sample.command.plan for sample in samples]
        states = np.stack(measured)
        foreseen = None
        predicted = None
        try:
            with user_code(lambda error: InputError(described(error))):
                plans = np.stack(planned)
                if isinstance(controller, Foreseeing):
                    foreseen = controller.foresee(states, plans[:, 0])
                if isinstance(controller, Predicting):
                    predicted = controller.predict(states, plans)
                if predicted is None:
                    return _Prediction(len(samples), None, foreseen)
                if foreseen is None:
                    foreseen = predicted[:, 0].copy()
                return _Prediction(len(samples), predicted[:, :, list(POSITION)], foreseen)
        except InputError as error:  # after the flight, which is not to be lost by it
            _log.warning("no predictions are kept: predict raised %s", error)
            return nothing

    def _asked(self, observed: Observation) -> tuple[StepInputs, Array, Array]:
        """Return a controller's inputs; the reference is raised where it has to be for the vehicle to take off."""
        now = observed.moment
        state = observed.state
        preview = observed.preview
        if self._ground is None or now.phase in GROUNDED:
            return now, state, preview
        thrust = float(np.sum(np.square(self._plant.speeds)))
        lead = self._ground.lead(observed.truth, float(observed.reference[_HEIGHT]), thrust)
        if lead == 0.0:
            return now, state, preview
        now.log(TAKEOFF_LEAD, lead, "m")
        raised = preview.copy()
        raised[:, _HEIGHT] += lead
        if now.motion is not None:
            now = replace(now, motion=now.motion.raised(lead))
        return now, state, raised

    def _fly(self, observed: Observation, command: Command | None) -> Period:
        plant = self._plant
        computation = self.computation
        steps = self._steps
        now = observed.moment
        step_s = 0.0
        if command is None:
            started = clock.perf_counter()
            with _ending_flight(now.time):
                command = self.controller.step(*self._asked(observed))
            step_s = clock.perf_counter() - started
        if computation is None:
            delay = 0.0
        else:
            delay = computation.taken(now.time, command, self._draws)
        self.answered = max(self.answered, now.time + delay)
        # From the start of the period in which it arrives, this one where none spends a whole period under way.
        wait = physics_steps(delay, plant.timestep) - self._under_way * steps
        missed = wait > steps  # one that comes just in time acts from the next period on
        due = min(wait, steps)
        if computation is not None and computation.plan:
            due = min(due, physics_steps(computation.delay, plant.timestep) - self._under_way * steps)
        planned = self._plan[min(self._age + 1, len(self._plan) - 1)]  # its last row beyond its end
        inner = self._inner
        continued = min(wait, steps) - due  # physics steps under the last plan's next row
        holds: list[Hold] = [(inner, self._acting, due), (inner, planned, continued)]
        if missed:
            self._age += 1
            acting = self._acting
            if continued:
                acting = planned
        else:
            acting = command.speeds
            self._plan = command.plan
            self._age = 0
            self._inner = command.inner
            holds.append((self._inner, acting, steps - wait))
        self._schedule.append(holds)
        before = plant.physics
        on_ground = now.phase in (Phase.LANDED, Phase.ARMED)
        plant.begin(steps)
        if self._navigation is None:
            sensing = None
        else:
            sensing = self._navigation.begin(steps)
        for loop, row, count in self._schedule.popleft():
            if count > 0:
                self._hold(loop, row, count, sensing)
        if self._navigation is not None:
            self._navigation.record(plant.flown, on_ground=on_ground)
        self._acting = acting
        target = None
        self._speeds = acting
        if takes_targets(self._inner):
            target = acting
            self._speeds = plant.flown["commands"][-1].copy()
        return Period(
            observation=observed,
            command=command,
            speeds=self._speeds,
            target=target,
            delay=delay,
            missed=missed,
            step_s=step_s,
            before=before,
            steps=plant.flown,
            rotors=plant.speeds,
        )

    def _hold(self, inner: InnerLoop | None, row: Array, steps: int, sensing: Struct | None) -> None:
        """Fly physics steps under a command, by an inner loop if there is one.

        Raises:
            RaisedError: the inner loop raised, or its period is not a whole number of physics steps.
        """
        plant = self._plant
        if inner is None:
            plant.hold(row, steps, sensing=sensing)
            return
        with _ending_flight(plant.time):
            flying = self._flying
            fresh = self._flying is None or self._flying.inner is not inner
            if fresh:
                self._flying = flying = _Flying(inner, inner_steps(inner.rate, plant.timestep))
            assert flying is not None
            if flying.engage is None:
                struct = flying.struct
            else:
                struct = flying.engage(row, plant.speeds) or flying.struct
        measured = None
        if flying.measures:
            measured = self._navigation

        def ask() -> Array:
            if measured is None:
                attitude, rates = plant.attitude
            else:
                attitude, rates = measured.sensed(plant.physics)
            with _ending_flight(plant.time):
                return np.array(inner.speeds(plant.time, row.copy(), rates, plant.speeds, attitude))

        struct.stride = flying.stride
        if fresh:
            struct.until = 0
        plant.hold(row, steps, loop=struct, sensing=sensing, ask=ask)


class _Flying:
    """An inner loop in force: its stride, whether it measures, and its place in the core where that does not answer."""

    def __init__(self, inner: InnerLoop, stride: int) -> None:
        self.inner = inner
        self.stride = stride
        self.struct = InnerStruct()
        self.measures = takes_targets(inner)
        self.engage: Callable[[Array, Array], Struct | None] | None = None
        if isinstance(inner, Engaging):
            self.engage = inner.engage


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

    Whatever happens in flight ends up in its log: a typed flight error or Ctrl-C ends it early, with its reason and
    everything up to it.  `progress` is called with the number of periods flown, after each.
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
            hold.flown = True  # before any call, in which the next signal would come
            loop.interrupt()
        finally:
            hold.flown = True


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """Keep the garbage collector from all that is there already.

    A pass over all imported modules takes up to 30 ms, as long as a control period.
    """
    if gc.get_freeze_count():
        yield
        return
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def _tell_attitude(controller: Controller, plant: Plant) -> None:
    """Tell a controller that wants to know how the vehicle turns now."""
    if isinstance(controller, Beginning):
        controller.begin(plant.attitude[1])


def _ending_flight(time: float) -> AbstractContextManager[None]:
    """Make whatever a controller's code raises the flight's end, not its loss."""
    return user_code(lambda error: RaisedError("the controller", error, time=time), passing=(FlightError,))


class _Prediction(NamedTuple):
    """What a controller predicted in the periods that it flew."""

    periods: int
    positions: Array | None  # (K, N, 3) [m]
    next_states: Array | None  # (K, 12) for the period after each


def _joined_next_states(predictions: Sequence[_Prediction]) -> Array | None:
    """The states (K, 12) that each controller predicted for the next period, NaN of those that did not."""
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
    """The positions that each controller predicted, as far ahead as all of them did; None where one did not."""
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
