"""The plant: the only owner of the MuJoCo model and its data."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from operator import add
from typing import Final, assert_never

import mujoco
import numpy as np
from mujoco.rollout import Rollout

from quadsim.border import numbers_of, user_code
from quadsim.controller import check_command
from quadsim.errors import CommandError, DivergenceError, ForceError, ParameterError, RaisedError
from quadsim.rotation import euler_to_body_rates, euler_to_quaternion
from quadsim.sim.airframe import BODY, compile_model, obstacle_body, outline
from quadsim.sim.effects import LOADING, Change, Effects, Force, PushChange
from quadsim.sim.effects.forces import StepForces
from quadsim.sim.effects.load import Load, MassChange, Payload, PayloadDrop, apply_mass, mass_properties
from quadsim.sim.effects.rotors import LagChange, RotorChange, RotorDynamics
from quadsim.sim.effects.wind import Air, WindField
from quadsim.sim.physics import PHYSICS, Integrator, PhysicsSteps, physics_to_state, steps_type
from quadsim.sim.rigid_body import FreeBody, check_free
from quadsim.space import Obstacle
from quadsim.state import ANGLE_RATES, ANGLES, EULER, N_STATES, POSITIONS, VELOCITIES, Array, YawTurns
from quadsim.vehicle import N_ROTORS, Vehicle

_FULL: Final = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
_CONTROL: Final = int(mujoco.mjtState.mjSTATE_CTRL)
_PLAUSIBLE: Final = 1e6
"""Largest magnitude of time [s], position [m], speed [m/s] or rate [rad/s] that is not divergence."""
_NUMERICAL_WARNINGS: Final = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
    mujoco.mjtWarning.mjWARN_BADCTRL,
)
_CALM: Final = Effects()
_AS_IN_THE_FILE: Final = Load()

if all(getattr(mujoco, name)() is None for name in dir(mujoco) if name.startswith("get_mjcb_")):
    # Its Python bindings time each part of each step, which takes two fifths of a step's time.
    mujoco.mj_resetCallbacks()


class Plant:
    """A vehicle in MuJoCo: fourth-order Runge-Kutta at a fixed step, commands held in between.

    With `integrator="rk4"`, `quadsim.sim.rigid_body` takes the steps instead.

    Without effects, rotors have their commanded speed at once, and a whole hold is one call of MuJoCo.  With effects
    that depend on the motion, steps are taken one by one, with forces evaluated at mid-step (second order). Use it as a
    context manager; it owns native memory.

    Attributes:
        vehicle: the vehicle flown, as in its file.
        timestep: physics step [s].
        effects: the active effects, resolved; see `quadsim.sim.effects.Effects.resolved`.
        model: the compiled model; do not change it.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        *,
        timestep: float = 1e-3,
        limit_speeds: bool = False,
        effects: Effects = _CALM,
        changes: Sequence[Change] = (),
        wind: WindField | None = None,
        forces: Sequence[Force] = (),
        obstacles: Sequence[Obstacle] = (),
        rng: np.random.Generator | None = None,
        integrator: Integrator = "mujoco",
    ) -> None:
        self.vehicle = vehicle
        self.timestep = timestep
        self.effects = effects
        self._load, air = effects.load or _AS_IN_THE_FILE, effects.air or Air()
        self._reweighed = self._load != _AS_IN_THE_FILE or any(isinstance(change, LOADING) for change in changes)
        self.model = compile_model(
            vehicle,
            timestep=timestep,
            limit_speeds=limit_speeds,
            contact=effects.ground is not None and effects.ground.contact,
            reweighed=self._reweighed,
            body_drag=air.body_drag,
            air_density=air.density,
            obstacles=obstacles,
        )
        self._moving = [obstacle for obstacle in obstacles if obstacle.moves]
        self._speed_range = (vehicle.speed_min, vehicle.speed_max) if limit_speeds else (0.0, math.inf)
        self._data = mujoco.MjData(self.model)
        mujoco.set_mju_user_warning(_discard)
        self._rollout = Rollout(nthread=0)
        self._physics = np.zeros((1, mujoco.mj_stateSize(self.model, _FULL)))
        self._yaw = YawTurns(0.0)
        self._wind, self._own = wind, tuple(forces)
        if integrator == "rk4":
            check_free(effects, changes, obstacles)
        self._integrator = integrator
        self._by_step = effects.follows_state or wind is not None or bool(self._own)
        self._by_step = self._by_step or bool(self._moving) or integrator == "rk4"
        self._by_step = self._by_step or any(isinstance(change, PushChange) for change in changes)
        self._steps_type = steps_type(wrench=self._by_step, wind=wind is not None, battery=effects.battery is not None)
        bodies = [self.model.body(obstacle_body(obstacle)).id for obstacle in self._moving]
        self._mocaps = self.model.body_mocapid[bodies]
        self._changes = self._scheduled(changes)
        self._rng = rng if rng is not None else np.random.default_rng(0)
        self._rng_start = self._rng.bit_generator.state
        self.reset(np.zeros(N_STATES))

    def __enter__(self) -> Plant:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free native memory."""
        self._rollout.close()

    @property
    def wind(self) -> WindField | None:
        """The wind field; None if the air never moves."""
        return self._wind

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return float(self._physics[0, 0])

    @property
    def hover_speeds(self) -> Array:
        """(4,) omega_bar on all rotors [rad/s], u(-1) of a flight that starts at rest in the air."""
        return np.full(N_ROTORS, self.vehicle.hover_speed)

    @property
    def physics(self) -> Array:
        """(14,) copy of MuJoCo's state; see `physics_to_state`."""
        return self._physics[0].copy()

    @property
    def speeds(self) -> Array:
        """(4,) rotor speeds now [rad/s]."""
        return self._speeds.copy()

    def reset(self, state: Array, speeds: Array | None = None) -> None:
        """Put the vehicle at a state (12,) at time zero, with rotor speeds (4,) or hover [rad/s]; reset all else.

        Raises:
            ParameterError: the state is not 12 finite numbers.
        """
        state = np.asarray(state, float)
        if state.shape != (N_STATES,) or not np.all(np.isfinite(state)):
            raise ParameterError("plant", "state", state.tolist(), f"{N_STATES} finite numbers")
        mujoco.mj_resetData(self.model, self._data)
        euler = state[ANGLES]
        rates = euler_to_body_rates(euler, state[ANGLE_RATES])
        self._physics[0] = np.concatenate(
            [[0.0], state[POSITIONS], euler_to_quaternion(euler), state[VELOCITIES], rates]
        )
        self._yaw = YawTurns(float(euler[2]))
        self._step = 0
        self._pending = deque(self._changes)
        self._rotors = self.effects.rotors or RotorDynamics()
        self._speeds = self.hover_speeds if speeds is None else np.array(speeds, float)
        self._efficiency = np.array(self._rotors.efficiency)
        self._charge = 0.0 if self.effects.battery is None else self.effects.battery.charge
        self._velocity_before = self._physics[0, 8:].tolist()
        if self._reweighed:
            self._carry(self._load.payloads, self._load.mass_factor)
        if self._by_step:
            self._forces.push(())
        self._rng.bit_generator.state = self._rng_start
        if self._wind is not None:
            self._wind.reset()
        for force in self._own:
            getattr(force, "reset", lambda: None)()

    @cached_property
    def _forces(self) -> StepForces:
        """The forces of each step, if steps are taken one by one."""
        shape = outline(self.vehicle)
        return StepForces(self.vehicle, self.effects, timestep=self.timestep, floor=shape.floor, disc=shape.disc)

    @cached_property
    def _body(self) -> FreeBody:
        return FreeBody(self.vehicle, self._forces, self.timestep)

    def state(self) -> Array:
        """(12,) the true state now, yaw unwrapped since the last reset."""
        state = physics_to_state(self._physics)[0]
        state[EULER[2]] = self._yaw.unwrapped(state[ANGLES])
        return state

    @property
    def attitude(self) -> tuple[Array, Array]:
        """The true attitude now (4,), wxyz, body to world, sign continuous, and the body rates (3,) [rad/s]."""
        physics = self._physics[0]
        return physics[PHYSICS["attitude"]].copy(), physics[PHYSICS["body_rates"]].copy()

    def applied(self, speeds: Array) -> Array:
        """Return the command (4,) [rad/s], saturated at the rotors' limits and at zero."""
        return np.clip(speeds, *self._speed_range)

    def advance(self, speeds: Array, steps: int) -> PhysicsSteps:
        """Hold commanded rotor speeds (4,) [rad/s] for M physics steps, at least 1; return these (M,).

        Raises:
            CommandError: the command is not four finite numbers; nothing moved.
            DivergenceError: the state is no longer finite or plausible.
        """
        problem = check_command(speeds)
        if problem is not None:
            raise CommandError(problem, time=self.time)
        target = self.applied(speeds)
        parts, end = [], self._step + steps
        while self._step < end:
            self._change()
            until = min(end, self._pending[0][0]) if self._pending else end
            parts.append(self._hold(target, until - self._step))
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def allows(self, changes: Sequence[Change]) -> bool:
        """Return whether it was built for changes of these kinds."""
        weighing = not self._reweighed and any(isinstance(change, LOADING) for change in changes)
        return not (weighing or (not self._by_step and any(isinstance(change, PushChange) for change in changes)))

    def reschedule(self, changes: Sequence[Change]) -> None:
        """Schedule these changes, of kinds that it `allows`; past ones are ignored."""
        self._pending = deque(entry for entry in self._scheduled(changes) if entry[0] >= self._step)

    def _scheduled(self, changes: Sequence[Change]) -> list[tuple[int, Change]]:
        """Return the changes in order of time, each with the physics step before which it happens."""
        ordered = sorted(changes, key=lambda change: change.at)
        return [(math.ceil(change.at / self.timestep - 1e-6), change) for change in ordered]

    def _change(self) -> None:
        """Apply the changes due before the next step."""
        while self._pending and self._pending[0][0] <= self._step:
            _, change = self._pending.popleft()
            if isinstance(change, RotorChange):
                self._efficiency[change.rotor - 1] = change.efficiency
            elif isinstance(change, MassChange):
                self._carry(self._payloads, change.factor)
            elif isinstance(change, LagChange):
                self._rotors = self._rotors.lagging(change)
            elif isinstance(change, PushChange):
                self._forces.push(change.pushes)
            elif isinstance(change, Payload):
                self._carry((*self._payloads, change), self._mass_factor)
            elif isinstance(change, PayloadDrop):
                self._carry((), self._mass_factor)
            else:
                assert_never(change)

    def _carry(self, payloads: tuple[Payload, ...], mass_factor: float) -> None:
        self._payloads, self._mass_factor = payloads, mass_factor
        load = replace(self._load, mass_factor=mass_factor)
        apply_mass(self.model, BODY, mass_properties(self.vehicle, load, payloads))

    def _hold(self, target: Array, steps: int) -> PhysicsSteps:
        """Advance while only vehicle and air change."""
        rotors, timestep = self._rotors, self.timestep
        if rotors.at_once:
            before = middle = np.broadcast_to(target, (steps, N_ROTORS))
            slopes = np.zeros((steps, N_ROTORS))
            self._speeds = target
        else:
            edges = timestep * np.arange(steps + 1, dtype=np.float64)
            times = np.concatenate([edges, edges[:-1] + 0.5 * timestep])
            speeds, slopes = rotors.respond(self._speeds, target, times)
            before, self._speeds = speeds[:steps].copy(), speeds[steps].copy()
            middle, slopes = speeds[steps + 1 :], slopes[steps + 1 :]
        thrusts = self._efficiency * self.vehicle.thrust_coefficient * np.square(middle)
        battery = None
        if self.effects.battery is not None:
            ratio = middle / self.vehicle.hover_speed
            demands = (self._efficiency * ratio * np.square(ratio)).mean(axis=1).tolist()
            rows, self._charge = self.effects.battery.discharge(self._charge, demands, timestep)
            battery = np.array(rows)
            thrusts = thrusts * np.array([[self.effects.battery.factor(voltage)] for voltage, _ in rows])
        if self.effects.thrust_noise is not None:
            largest = self.vehicle.thrust_coefficient * self.vehicle.speed_max**2
            thrusts = self.effects.thrust_noise.applied(thrusts, largest, self._rng)
        wrench = wind = None
        if self._by_step:
            wind = None if self._wind is None else self._wind.advance(steps)
            take = self._take_steps if self._integrator == "mujoco" else self._integrate
            trajectory, wrench = take(thrusts, middle, slopes, wind)
        else:
            trajectory = self._run(thrusts)
        self._check(trajectory)
        self._physics[0] = trajectory[-1]
        self._step += steps
        flown = np.empty(steps, self._steps_type)
        flown["physics"], flown["speeds"], flown["thrust"] = trajectory, before, thrusts.sum(axis=1)
        for name, part in (("wrench", wrench), ("wind", wind), ("battery", battery)):
            if part is not None:
                flown[name] = part
        return flown

    def _run(self, thrusts: Array) -> Array:
        """Take all steps in one call: thrusts (M, 4) [N] -> states (M, 14)."""
        steps = len(thrusts)
        states = np.empty((1, steps, self._physics.shape[1]))
        self._rollout.rollout(
            [self.model],
            [self._data],
            self._physics,
            np.ascontiguousarray(thrusts[None]),
            control_spec=_CONTROL,
            skip_checks=True,
            nstep=steps,
            state=states,
            sensordata=np.empty((1, steps, self.model.nsensordata)),
        )
        return states[0]

    def _take_steps(self, thrusts: Array, speeds: Array, slopes: Array, wind: Array | None) -> tuple[Array, Array]:
        """Take steps one by one, each with the forces of its middle: states (M, 14) and wrenches (M, 6)."""
        model, data, steps = self.model, self._data, len(thrusts)
        mujoco.mj_setState(model, data, self._physics[0], _FULL)
        trajectory, wrench = np.empty((steps, self._physics.shape[1])), np.empty((steps, 6))
        noises = self._noises(steps)
        air = np.zeros((steps, 3)) if wind is None else wind
        drags = self.effects.air is not None and self.effects.air.body_drag is not None
        moving_air = wind is not None and drags
        of_rotors = self._of_rotors(speeds, slopes)
        forces, step, velocity_before = self._forces.midway, mujoco.mj_step, self._velocity_before
        qpos, qvel, applied, control = data.qpos, data.qvel, data.qfrc_applied, data.ctrl  # looked up once
        if self._moving:
            times = self.time + self.timestep * np.arange(steps, dtype=np.float64)
            positions = np.stack([obstacle.positions(times) for obstacle in self._moving], axis=1)
        for i, (thrust, rotors, breeze) in enumerate(zip(thrusts.tolist(), of_rotors, air.tolist(), strict=True)):
            velocity = qvel.tolist()
            acting: Sequence[float] = forces(qpos.tolist(), velocity, velocity_before, thrust, rotors, breeze)
            velocity_before = velocity
            if noises is not None:
                acting = list(map(add, acting, noises[i]))
            if self._own:
                acting = list(map(add, acting, self._own_wrench(i * self.timestep, [*qpos, *qvel])))
            applied[:] = wrench[i] = acting
            control[:] = thrust
            if moving_air:
                model.opt.wind[:] = breeze
            if self._moving:
                data.mocap_pos[self._mocaps] = positions[i]
            step(model, data)
            trajectory[i, 1:8], trajectory[i, 8:] = qpos, qvel
            if drags:
                wrench[i] += data.qfrc_fluid
        self._velocity_before = velocity_before
        trajectory[:, 0] = self._clock(steps)
        return trajectory, wrench

    def _integrate(self, thrusts: Array, speeds: Array, slopes: Array, wind: Array | None) -> tuple[Array, Array]:
        """Do the same as `_take_steps` without MuJoCo, with forces evaluated at each stage of the step."""
        steps = len(thrusts)
        noises, of_rotors = self._noises(steps) or [[0.0] * 6] * steps, self._of_rotors(speeds, slopes)
        air = [[0.0] * 3] * steps if wind is None else wind.tolist()
        state, states, wrenches = self._physics[0, 1:].tolist(), [], []
        for i, (thrust, rotors, breeze, held) in enumerate(zip(thrusts.tolist(), of_rotors, air, noises, strict=True)):
            if self._own:
                held = list(map(add, held, self._own_wrench(i * self.timestep, state)))
            state, acted = self._body.advance(state, thrust, rotors, breeze, held)
            states.append(state)
            wrenches.append(acted)
        return np.column_stack([self._clock(steps), states]), np.array(wrenches)

    def _clock(self, steps: int) -> Array:
        """(M,) times after each of the next steps [s], added up as MuJoCo does."""
        times: Array = np.add.accumulate(np.concatenate([self._physics[0, :1], np.full(steps, self.timestep)]))[1:]
        return times

    def _noises(self, steps: int) -> list[list[float]] | None:
        disturbance = self.effects.disturbance
        return None if disturbance is None else disturbance.draw(steps, self.timestep, self._rng).tolist()

    def _of_rotors(self, speeds: Array, slopes: Array) -> list[list[float]]:
        there = self._efficiency > 0.0  # a lost propeller has neither drag nor momentum
        return self._forces.of_rotors(speeds * there, slopes * there).tolist()

    def _own_wrench(self, since: float, motion: Sequence[float]) -> list[float]:
        """Return the sum of the user-defined forces, world [N] and body frame [N m], a time [s] after the hold's start.

        `motion` (13,) is MuJoCo's state then, without the time.

        Raises:
            ForceError: a force is not six finite numbers.
            RaisedError: a force raised an exception.
        """
        physics, time = np.array([0.0, *motion]), self.time + since
        state, total = physics_to_state(physics[None])[0], np.zeros(6)
        for force in self._own:
            name = getattr(force, "__name__", type(force).__name__)
            with user_code(lambda error, name=name: RaisedError(f"the force {name}", error, time=time)):  # type: ignore[misc]
                wrench = numbers_of(force(time, state.copy()))
            if wrench.shape != (6,) or not np.all(np.isfinite(wrench)):
                shown = f"{wrench.tolist()!r:.80}"
                raise ForceError(f"the force {name} must give six finite numbers [N, N m]; got {shown}", time=time)
            total += wrench
        return total.tolist()

    def _check(self, trajectory: Array) -> None:
        if not np.abs(trajectory).max() < _PLAUSIBLE:  # false for NaN
            plausible = (np.abs(trajectory) < _PLAUSIBLE).all(axis=1)
            time = self.time + self.timestep * (1 + int(np.argmin(plausible)))
            raise DivergenceError("the plant diverged: its state is not finite or not plausible", time=time)
        counts = self._data.warning.number
        if counts.any() and (raised := [kind.name for kind in _NUMERICAL_WARNINGS if counts[int(kind)]]):
            raise DivergenceError(f"the plant diverged: MuJoCo reports {', '.join(raised)}", time=self.time)


def _discard(message: str) -> None:
    """Swallow MuJoCo's warnings, which `Plant._check` reads as counts; else they go to the terminal and a log file."""
