"""The closed loop: plant -> controller -> command -> plant, once per control period."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from quadsim.controller import MISSED, Command, Controller, InnerLoop, Moment, Phase
from quadsim.errors import FlightError, InterruptedFlightError, LostError
from quadsim.flight.log import ControlLog, FlightLog, PlantLog, TimingLog
from quadsim.flight.lost import check_loss
from quadsim.motion import Motion
from quadsim.sim.computation import Computation
from quadsim.sim.physics import Segment, inner_steps, physics_to_state
from quadsim.sim.plant import Plant
from quadsim.state import INDEX, N_STATES, REFERENCE_NAMES, Array
from quadsim.vehicle import N_ROTORS

if TYPE_CHECKING:
    from quadsim.sim.navigation import Navigation
    from quadsim.sim.phase import PhaseMonitor

_BODY_RATES: Final = slice(11, 14)  # in the plant's own state; see `quadsim.sim.physics.physics_to_state`


def fly(
    plant: Plant,
    controller: Controller,
    reference: Array,
    *,
    initial_state: Array,
    initial_speeds: Array,
    periods: int,
    steps_per_period: int,
    navigation: Navigation | None = None,
    computation: Computation | None = None,
    rng: np.random.Generator | None = None,
    ground: PhaseMonitor | None = None,
    loss: Mapping[str, float] | None = None,
    motion: Motion | None = None,
    quaternions: bool = False,
    progress: Callable[[int], None] | None = None,
) -> FlightLog:
    """Fly a number of control periods.

    Whatever happens in flight ends up in the log: a typed flight error or Ctrl-C ends it early, with its reason and
    everything up to it.

    Args:
        plant: what is flown; it is reset first.
        controller: what flies it; it is reset first.
        reference: (periods + N, 4) filtered x, y, z [m], yaw [rad], row k at t_k, N the controller's preview.
        initial_state: (12,).
        initial_speeds: (4,) u(-1), and the rotor speeds at the start [rad/s].
        periods: K.
        steps_per_period: physics steps per control period.
        navigation: measured or estimated state for the controller; the true state where absent.
        computation: how long commands take, in simulated time; none where absent.
        rng: what `computation` draws from.
        ground: what knows where the flight stands with ground and obstacles; it is flying throughout where absent.
        loss: limits by the names of `quadsim.flight.lost.CRITERIA`, checked once per control period until it has
            crashed; none where absent.
        motion: of the reference from t_0 on, for controllers that use it; absent where only positions are known.
        quaternions: whether attitude and body rates are logged beside Euler angles and their rates.
        progress: called with the number of periods flown, after each.

    Returns:
        The flight, with plant rows at the physics rate.
    """
    plant.reset(initial_state, initial_speeds)
    controller.reset(initial_speeds)
    period = steps_per_period * plant.timestep
    if navigation is not None:
        navigation.reset(plant.physics, initial_speeds, yaw=float(initial_state[INDEX["yaw"]]))
    if ground is not None:
        ground.reset()
    truth = np.empty((periods, N_STATES))
    states = np.empty((periods, N_STATES))
    attitudes, rates = np.empty((periods, 4)), np.empty((periods, 3))
    start = plant.physics
    heights = np.minimum(reference[:, REFERENCE_NAMES.index("z")], initial_state[INDEX["z"]])
    lowest = np.minimum.accumulate(heights).tolist()
    samples: list[Sample] = []
    acting = np.array(initial_speeds, float)
    plan, age = acting[None], 0  # the last plan that came in time, and how many periods ago
    draws = rng if rng is not None else np.random.default_rng(0)
    ended: FlightError | None = None
    try:
        for k in range(periods):
            truth[k] = plant.state()
            states[k] = truth[k] if navigation is None else navigation.state()
            attitude, body_rates = plant.attitude if navigation is None else navigation.attitude
            attitudes[k], rates[k] = attitude, body_rates
            preview = reference[k + 1 : k + 1 + controller.horizon]
            phase = Phase.FLYING
            if ground is not None:
                since = samples[-1].segment.physics if samples else start[None]
                phase = ground.advance(since[:, 0], physics_to_state(since), preview)
            if loss is not None and phase is not Phase.CRASHED:
                check_loss(loss, k * period, truth[k], reference[k], lowest[k])
            now = Moment(
                time=k * period,
                phase=phase,
                acting=acting,
                attitude=attitude,
                body_rates=body_rates,
                motion=None if motion is None else motion.after(k),
            )
            started = clock.perf_counter()
            command = controller.step(now, states[k], preview)
            step_s = clock.perf_counter() - started
            delay = 0.0 if computation is None else computation.taken(now.time, command, draws)
            wait = math.ceil(delay / plant.timestep - 1e-6)
            missed = wait > steps_per_period  # one that comes just in time acts from the next period on
            due = min(wait, steps_per_period)
            if computation is not None and computation.plan:
                due = min(due, math.ceil(computation.delay / plant.timestep - 1e-6))
            planned = plan[min(age + 1, len(plan) - 1)]  # its last row beyond its end
            holds = [(acting, due), (planned, min(wait, steps_per_period) - due)]
            if missed:
                age += 1
                acting = holds[1][0] if holds[1][1] else acting
            else:
                acting, plan, age = command.speeds, command.plan, 0
                holds.append((acting, steps_per_period - wait))
            holds = [(speeds, steps) for speeds, steps in holds if steps > 0]
            flown = [part for speeds, steps in holds for part in _hold(plant, command.inner, speeds, steps)]
            if navigation is not None:
                for segment, speeds in flown:
                    held = np.broadcast_to(speeds, (len(segment.physics), N_ROTORS))
                    navigation.advance(segment.physics, held, standing=phase in (Phase.LANDED, Phase.ARMED))
            samples.append(
                Sample(
                    command=command,
                    speeds=acting,
                    phase=phase,
                    delay=delay,
                    missed=missed,
                    step_s=step_s,
                    segment=Segment.join([segment for segment, _ in flown]),
                    rotors=plant.speeds,
                )
            )
            if progress is not None:
                progress(k + 1)
    except FlightError as error:
        ended = error.with_traceback(None)  # which would hold this frame, and all that was flown, in a cycle
    except KeyboardInterrupt:
        ended = InterruptedFlightError(time=len(samples) * period)
    count = len(samples)
    control = _control_log(samples, states[:count], truth[:count], reference[:count], initial_speeds, period)
    plant_log = _plant_log(samples, start, initial_speeds, float(initial_state[INDEX["yaw"]]), plant.timestep)
    if quaternions:
        control = replace(control, attitude=attitudes[:count], body_rates=rates[:count])
        physics = np.concatenate([start[None], *(sample.segment.physics for sample in samples)])
        plant_log = replace(plant_log, attitude=physics[:, 4:8], body_rates=physics[:, 11:14])
    commands = [sample.command for sample in samples]
    return FlightLog(
        control=control,
        timing=TimingLog(
            t=control.t,
            solve_ms=np.array([1e3 * command.solve_s for command in commands]),
            step_ms=np.array([1e3 * sample.step_s for sample in samples]),
        ),
        plant=plant_log,
        predicted=_predict(controller, control.state, commands),
        reason=None if ended is None else str(ended),
        interrupted=isinstance(ended, InterruptedFlightError),
        lost=ended.criterion if isinstance(ended, LostError) else None,
    )


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One control period as it was flown.

    `speeds` (4,) [rad/s] are the command in force at its end, an earlier one if `command` was missed, and `rotors` (4,)
    how fast the rotors turned then; `delay` [s] is simulated, `step_s` [s] the wall time of the controller's step.
    """

    command: Command
    speeds: Array
    phase: Phase
    delay: float
    missed: bool
    step_s: float
    segment: Segment
    rotors: Array


def _hold(plant: Plant, inner: InnerLoop | None, speeds: Array, steps: int) -> Iterator[tuple[Segment, Array]]:
    """Advance under a command: segments of flight, each with the rotor speeds (4,) asked for during it [rad/s].

    Raises:
        ParameterError: the inner loop's period is not a whole number of physics steps.
    """
    if inner is None:
        yield plant.advance(speeds, steps), plant.applied(speeds)
        return
    each = inner_steps(inner.rate, plant.timestep)
    for first in range(0, steps, each):
        asked = inner.speeds(plant.time, speeds, plant.physics[_BODY_RATES], plant.speeds)
        yield plant.advance(asked, min(each, steps - first)), plant.applied(asked)


def _control_log(
    samples: list[Sample], states: Array, truth: Array, reference: Array, initial_speeds: Array, period: float
) -> ControlLog:
    def column(name: str, kind: type) -> np.ndarray[Any, np.dtype[Any]]:
        return np.array([getattr(sample.command, name) for sample in samples], dtype=kind)

    fallback = column("fallback", np.int64)
    late = np.array([sample.missed for sample in samples], dtype=bool)
    return ControlLog(
        t=_times(len(samples), period),
        state=states,
        truth=truth,
        reference=reference,
        speeds=np.array([sample.speeds for sample in samples], float).reshape(-1, N_ROTORS),
        speeds_before=np.array(initial_speeds, float),
        status=tuple(MISSED if sample.missed else sample.command.status for sample in samples),
        phase=tuple(str(sample.phase) for sample in samples),
        iterations=column("iterations", np.int64),
        active=column("active", np.int64),
        fallback=np.where(late, np.maximum(fallback, 1), fallback),
        slack=column("slack", float),
        primal_residual=column("primal_residual", float),
        dual_residual=column("dual_residual", float),
        delay=np.array([sample.delay for sample in samples], float),
    )


def _plant_log(samples: list[Sample], start: Array, initial_speeds: Array, yaw: float, timestep: float) -> PlantLog:
    if not samples:
        return PlantLog(t=_times(1, timestep), state=physics_to_state(start[None], yaw), speeds=initial_speeds[None])
    flown = Segment.join([sample.segment for sample in samples])
    physics = np.concatenate([start[None], flown.physics])
    return PlantLog(
        t=_times(len(physics), timestep),
        state=physics_to_state(physics, yaw),
        speeds=np.concatenate([flown.speeds, samples[-1].rotors[None]]),
        wrench=None if flown.wrench is None else np.concatenate([flown.wrench, flown.wrench[-1:]]),
        wind=None if flown.wind is None else np.concatenate([flown.wind, flown.wind[-1:]]),
    )


def _times(count: int, spacing: float) -> Array:
    """Instants k * spacing without the rounding that adding up or a binary fraction leaves."""
    return np.round(np.arange(count) * spacing, 9)


def _predict(controller: Controller, states: Array, commands: list[Command]) -> np.ndarray | None:
    predict = getattr(controller, "predict", None)  # a controller without a model has none
    if not commands or predict is None:
        return None
    plans = np.stack([command.plan for command in commands])
    return np.ascontiguousarray(predict(states, plans)[:, :, [0, 2, 4]], dtype=np.float32)
