"""The closed loop: plant -> controller -> command -> plant, once per control period."""

from __future__ import annotations

import time as clock
from collections.abc import Callable

import numpy as np

from quadsim.controller import Command, Controller
from quadsim.errors import FlightError, InterruptedFlightError
from quadsim.flightlog import ControlLog, FlightLog, PlantLog, TimingLog
from quadsim.plant import Plant, physics_to_state
from quadsim.state import INDEX, N_STATES, Array
from quadsim.vehicle import N_ROTORS


def fly(
    plant: Plant,
    controller: Controller,
    reference: Array,
    *,
    initial_state: Array,
    initial_speeds: Array,
    periods: int,
    steps_per_period: int,
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
        initial_speeds: (4,) u(-1) [rad/s].
        periods: K.
        steps_per_period: physics steps per control period.
        progress: called with the number of periods flown, after each.

    Returns:
        The flight, with plant rows at the physics rate.
    """
    plant.reset(initial_state)
    controller.reset(initial_speeds)
    period = steps_per_period * plant.timestep
    physics = np.empty((periods * steps_per_period + 1, plant.physics.size))
    physics[0] = plant.physics
    states = np.empty((periods, N_STATES))
    applied = np.empty((periods, N_ROTORS))
    commands: list[Command] = []
    step_s: list[float] = []
    ended: FlightError | None = None
    flown = 0
    try:
        for k in range(periods):
            states[k] = plant.state()
            started = clock.perf_counter()
            command = controller.step(k * period, states[k], reference[k + 1 : k + 1 + controller.horizon])
            step_s.append(clock.perf_counter() - started)
            commands.append(command)
            applied[k] = plant.applied(command.speeds)
            first = k * steps_per_period + 1
            physics[first : first + steps_per_period] = plant.advance(command.speeds, steps_per_period)
            flown = k + 1
            if progress is not None:
                progress(flown)
    except FlightError as error:
        ended = error
    except KeyboardInterrupt:
        ended = InterruptedFlightError(time=flown * period)
    commands, step_s = commands[:flown], step_s[:flown]
    control = _control_log(commands, states[:flown], reference[:flown], initial_speeds, period)
    return FlightLog(
        control=control,
        timing=TimingLog(
            t=control.t,
            solve_ms=np.array([1e3 * command.solve_s for command in commands]),
            step_ms=1e3 * np.array(step_s),
        ),
        plant=_plant_log(
            physics[: flown * steps_per_period + 1],
            applied[:flown],
            initial_speeds=initial_speeds,
            initial_yaw=float(initial_state[INDEX["yaw"]]),
            timestep=plant.timestep,
        ),
        predicted=_predict(controller, control.state, commands),
        reason=None if ended is None else str(ended),
        interrupted=isinstance(ended, InterruptedFlightError),
    )


def _control_log(
    commands: list[Command], states: Array, reference: Array, initial_speeds: Array, period: float
) -> ControlLog:
    def column(name: str, kind: type) -> np.ndarray:
        return np.array([getattr(command, name) for command in commands], dtype=kind)

    return ControlLog(
        t=_times(len(commands), period),
        state=states,
        reference=reference,
        speeds=column("speeds", float).reshape(-1, N_ROTORS),
        speeds_before=np.array(initial_speeds, float),
        status=tuple(command.status for command in commands),
        iterations=column("iterations", np.int64),
        active=column("active", np.int64),
        fallback=column("fallback", np.int64),
        slack=column("slack", float),
        primal_residual=column("primal_residual", float),
        dual_residual=column("dual_residual", float),
    )


def _plant_log(
    physics: Array, applied: Array, *, initial_speeds: Array, initial_yaw: float, timestep: float
) -> PlantLog:
    steps = (physics.shape[0] - 1) // max(len(applied), 1)
    last = applied[-1:] if len(applied) else initial_speeds[None, :]
    return PlantLog(
        t=_times(physics.shape[0], timestep),
        state=physics_to_state(physics, initial_yaw),
        speeds=np.concatenate([np.repeat(applied, steps, axis=0), last]),
    )


def _times(count: int, spacing: float) -> Array:
    """Instants k * spacing without the rounding that adding up or a binary fraction leaves."""
    return np.round(np.arange(count) * spacing, 9)


def _predict(controller: Controller, states: Array, commands: list[Command]) -> np.ndarray | None:
    if not commands:
        return None
    plans = np.stack([command.plan for command in commands])
    return np.ascontiguousarray(controller.predict(states, plans)[:, :, [0, 2, 4]], dtype=np.float32)
