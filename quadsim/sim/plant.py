"""The plant: the only owner of the MuJoCo model and its data.

It advances the true vehicle at the physics rate under held commands,

    m dv/dt = R sum f_i e_z - m g e_z + forces,    I domega/dt = torques - omega x I omega,    f_i = b w_i^2,

with the rotors' lag, air, battery, load and events of `quadsim.sim.effects`.  The steps themselves are taken in C
(`quadsim/core/quadsim_plant.c`); `quadsim.sim.loop` calls `hold` in every period.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final, Protocol, assert_never

import mujoco
import numpy as np

from quadsim.border import numbers_of, user_code
from quadsim.controller import LARGEST_SPEED, check_command
from quadsim.core.mirror import Struct, core_library, fill
from quadsim.core.stepping import addresses, step_address
from quadsim.core.structs import (
    End,
    StepsStruct,
    VehicleStruct,
)
from quadsim.errors import CommandError, DivergenceError, ForceError, ParameterError, RaisedError
from quadsim.rotation import euler_to_body_rates, euler_to_quaternion
from quadsim.sim.airframe import BODY, compile_model, munk_moment, obstacle_body, outline
from quadsim.sim.effects import LOADING, Change, Effects, Force, PushChange
from quadsim.sim.effects.battery import Battery
from quadsim.sim.effects.load import Load, MassChange, Payload, PayloadDrop, apply_mass, mass_properties
from quadsim.sim.effects.rotors import LagChange, RotorChange, RotorDynamics
from quadsim.sim.effects.wind import Air, WindField
from quadsim.sim.physics import Integrator, PhysicsSteps, physics_to_state, steps_type
from quadsim.space import Obstacle
from quadsim.state import ANGLE_RATES, ANGLES, EULER, N_STATES, POSITIONS, VELOCITIES, Array, YawUnwrapper
from quadsim.vehicle import N_ROTORS, Vehicle

_FULL: Final = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
_POSE: Final = 7  # numbers of a pose: position and quaternion
_MOTION: Final = 13  # numbers of a motion: pose, velocity and body rates
_PHYSICS: Final = 14  # numbers of MuJoCo's state: time and motion
_QUATERNION: Final = slice(3, 7)  # of a pose
_BODY_RATES: Final = slice(3, 6)  # of a velocity (6,)
_PLAUSIBLE: Final = 1e6
"""Largest magnitude of time [s], position [m], speed [m/s] or rate [rad/s] that is not divergence."""
_NUMERICAL_WARNINGS: Final = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
    mujoco.mjtWarning.mjWARN_BADCTRL,
)
_BLOCK: Final = 2048  # normal numbers that are drawn at a time
_NO_EFFECTS: Final = Effects()
_NO_LOAD: Final = Load()
_CARRYING: Final = (Payload, PayloadDrop)
"""Changes that move the centre of mass."""


def _has_callbacks() -> bool:
    """Return whether somebody has set a callback of MuJoCo, such as one for the control."""
    getters = [name for name in dir(mujoco) if name.startswith("get_mjcb_")]
    return any(getattr(mujoco, name)() is not None for name in getters)


if not _has_callbacks():
    # MuJoCo's Python bindings set a timer callback, which takes two fifths of a step's time; this removes it.
    mujoco.mj_resetCallbacks()


class Answers(Protocol):
    """Answers for an inner loop in Python."""

    def __call__(self) -> Array:
        """Return the rotor speeds (4,) to hold until the next call [rad/s]."""
        ...


class Plant:
    """A vehicle in MuJoCo: fourth-order Runge-Kutta at a fixed step, commands held in between.

    The steps of a hold are taken by the compiled core (`quadsim/core/quadsim_plant.h`), which calls MuJoCo's own.
    With `integrator="rk4"`, the core integrates a free rigid body itself, with forces evaluated at each stage.

    Without effects, rotors have their commanded speed at once.  Forces that depend on the motion are evaluated at
    mid-step (second order).  A step depends on the state at its start alone: results have the same bits however time is
    cut into holds.

    Attributes:
        vehicle: the vehicle flown, as in its file.
        timestep: physics step [s].
        effects: the active effects, resolved; see `quadsim.sim.effects.Effects.resolved`.
        model: the compiled model, None with `rk4`; do not change it.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        *,
        timestep: float = 1e-3,
        limit_speeds: bool = False,
        effects: Effects = _NO_EFFECTS,
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
        self._integrator = integrator
        self._wind = wind
        self._user_forces = tuple(forces)
        self._moving = [obstacle for obstacle in obstacles if obstacle.moves]
        self._load = effects.load or _NO_LOAD
        loading = any(isinstance(change, LOADING) for change in changes)
        self._sets_mass = self._load != _NO_LOAD or loading  # mass properties are not always those of the file
        if limit_speeds:
            self._speed_range = (vehicle.speed_min, vehicle.speed_max)
        else:
            self._speed_range = (0.0, math.inf)
        self._yaw = YawUnwrapper(0.0)
        self.model: Any = None
        self._data: Any = None
        if integrator == "rk4":
            check_free(effects, changes, obstacles)
            self._motion: Array = np.zeros(_MOTION)
            self._velocity = self._motion[_POSE:]
        else:
            self._compile(obstacles, limit_speeds=limit_speeds)
        self._has_forces = self._can_have_forces(changes)
        self._computes_forces = self._has_forces  # in the core, in every step; a push needs them while it acts
        if integrator == "rk4":  # it adds disturbances and the user's forces without computing others
            self._computes_forces = replace(effects, disturbance=None).follows_state
        self._steps_type = steps_type(
            wrench=self._has_forces, wind=wind is not None, battery=effects.battery is not None
        )
        self._changes = self._scheduled(changes)
        if rng is None:
            rng = np.random.default_rng(0)
        self._last_reset = b""  # the bytes of the state (12,) of the last reset, and the same as a motion (13,)
        self._last_motion = np.zeros(_MOTION)
        self._seed(rng)
        self._struct = self._make_struct()
        self.reset(np.zeros(N_STATES))

    def _compile(self, obstacles: Sequence[Obstacle], *, limit_speeds: bool) -> None:
        """Compile MuJoCo's model of the vehicle and its surroundings."""
        effects = self.effects
        air = effects.air or Air()
        self.model = compile_model(
            self.vehicle,
            timestep=self.timestep,
            limit_speeds=limit_speeds,
            contact=effects.ground is not None and effects.ground.contact,
            reweighed=self._sets_mass,
            body_drag=air.body_drag,
            air_density=air.density,
            obstacles=obstacles,
        )
        if self._moving:
            bodies = [self.model.body(obstacle_body(obstacle)).id for obstacle in self._moving]
            in_order = list(range(len(bodies)))
            assert self.model.body_mocapid[bodies].tolist() == in_order  # the core writes their positions in this order
        self._data = mujoco.MjData(self.model)
        self._motion = self._data.qpos
        self._velocity = self._data.qvel
        mujoco.set_mju_user_warning(_discard)

    def _can_have_forces(self, changes: Sequence[Change]) -> bool:
        """Return whether forces other than the rotors' thrust may act, so that physics steps have a wrench."""
        if self._integrator == "rk4" or self._wind is not None or self._user_forces or self._moving:
            return True
        if any(isinstance(change, PushChange) for change in changes):
            return True
        return self.effects.follows_state

    def __enter__(self) -> Plant:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free native memory, with all arrays that refer to it; the plant cannot fly on."""
        for name in ("_struct", "_data", "model", "_motion", "_velocity"):
            self.__dict__.pop(name, None)

    @property
    def wind(self) -> WindField | None:
        """The wind field; None if the air never moves."""
        return self._wind

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return float(self._struct.time)

    @property
    def physics(self) -> Array:
        """(14,) copy of MuJoCo's state; see `physics_to_state`."""
        physics = np.empty(_PHYSICS)
        physics[0] = self._struct.time
        physics[1 : 1 + _POSE] = self._motion[:_POSE]
        physics[1 + _POSE :] = self._velocity
        return physics

    @property
    def speeds(self) -> Array:
        """(4,) rotor speeds now [rad/s]."""
        return np.array(self._struct.speeds)

    @property
    def _step(self) -> int:
        """The physics step that comes next."""
        return int(self._struct.now)

    def _seed(self, rng: np.random.Generator) -> None:
        """Draw from a generator from now on."""
        # Noise and disturbances have a generator each: neither draw changes the other's, however time is cut.
        self._generators = (rng, rng.spawn(1)[0])
        disturbance = self.effects.disturbance
        if disturbance is None:
            self._coloured_noise = None
        else:
            self._coloured_noise = disturbance.lasting(self.timestep, rng)
        self._initial_states = [generator.bit_generator.state for generator in self._generators]
        self._draw_anew()

    def _draw_anew(self) -> None:
        """Forget the numbers that are drawn ahead."""
        for_noise, for_disturbance = self._generators
        self._noise = NormalsAhead(for_noise)
        self._disturbance = NormalsAhead(for_disturbance)

    def redraw(self, rng: np.random.Generator, wind: WindField | None) -> None:
        """Take other draws from the next reset on: of noise and disturbances, and of the wind if there is one."""
        self._seed(rng)
        self._wind = wind

    def reset(self, state: Array, speeds: Array | None = None) -> None:
        """Put the vehicle at a state (12,) at time zero, with rotor speeds (4,) or hover [rad/s]; reset all else.

        Raises:
            ParameterError: the state is not 12 finite numbers.
        """
        state = np.asarray(state, float)
        if state.shape != (N_STATES,) or not np.all(np.isfinite(state)):
            raise ParameterError("plant", "state", state.tolist(), f"{N_STATES} finite numbers")
        self._reset_vehicle(state, speeds)
        if self._sets_mass:
            self._set_load(self._load.payloads, self._load.mass_factor)
        for generator, initial in zip(self._generators, self._initial_states, strict=True):
            generator.bit_generator.state = initial
        self._draw_anew()
        if self._wind is not None:
            self._wind.reset()
        if self._coloured_noise is not None:
            self._coloured_noise.reset()
        for force in self._user_forces:
            if hasattr(force, "reset"):
                force.reset()

    def _reset_vehicle(self, state: Array, speeds: Array | None) -> None:
        """Put the vehicle at a state (12,) at time zero, with the properties that it has before any change."""
        self._yaw = YawUnwrapper(float(state[EULER[2]]))
        self._pending = deque(self._changes)
        self._rotors = self.effects.rotors or RotorDynamics()
        self._efficiency = np.array(self._rotors.efficiency)
        self._pushes: Array = np.empty((0, 6))
        motion = self._motion_of(state)
        if self._integrator == "mujoco":
            mujoco.mj_resetData(self.model, self._data)
            mujoco.mj_setState(self.model, self._data, np.append(0.0, motion), _FULL)
        else:
            self._motion[:] = motion
        struct = self._struct
        struct.now = 0
        struct.time = 0.0
        struct.before[:] = motion[_POSE:]
        if speeds is None:
            struct.speeds[:] = self.vehicle.hover_speeds
        else:
            struct.speeds[:] = np.array(speeds, float)
        struct.charge = 0.0
        if self.effects.battery is not None:
            struct.charge = self.effects.battery.charge
        self._write_changes()

    def _motion_of(self, state: Array) -> Array:
        """Return the motion (13,) of a state, kept for the next reset to the same one."""
        text = state.tobytes()
        if text != self._last_reset:
            euler = state[ANGLES]
            rates = euler_to_body_rates(euler, state[ANGLE_RATES])
            parts = [state[POSITIONS], euler_to_quaternion(euler), state[VELOCITIES], rates]
            self._last_motion = np.concatenate(parts)
            self._last_reset = text
        return self._last_motion

    def _make_struct(self) -> Struct:
        """Return the core's vehicle, with all that does not change."""
        vehicle = self.vehicle
        effects = self.effects
        v = VehicleStruct()
        v.timestep = self.timestep
        v.plausible = _PLAUSIBLE
        v.fastest_valid = LARGEST_SPEED
        v.gravity = vehicle.gravity
        v.slowest, v.fastest = self._speed_range
        v.motion = self._motion.ctypes.data
        v.velocity = self._velocity.ctypes.data
        _set_mass(v, vehicle.mass, vehicle.inertia_matrix)
        _set_rotors(v, vehicle)
        if effects.rotors is not None:
            v.rotor_inertia = effects.rotors.inertia or 0.0
        if effects.air is not None:
            _set_air(v, effects.air)
        ground = effects.ground
        if ground is not None and ground.effect:
            shape = outline(vehicle)
            v.floor = shape.floor
            v.disc = shape.disc
            v.radius = ground.rotor_radius
        noise = effects.thrust_noise
        if noise is not None:
            v.loss = noise.loss
            v.deviation = noise.deviation
            v.largest[:] = vehicle.thrusts(np.full(N_ROTORS, vehicle.speed_max))
        if effects.battery is not None:
            self._curve = np.array(effects.battery.curve)  # kept, as the core reads it by its address
            _set_battery(v, effects.battery, self._curve)
        if self._integrator == "mujoco":
            self._connect_mujoco(v)
        return v

    def _connect_mujoco(self, v: Struct) -> None:
        """Give the core the addresses of MuJoCo's step, and of what it reads and writes there."""
        data = self._data
        v.step = step_address()
        v.model, v.data = addresses(self.model, data)
        v.applied = data.qfrc_applied.ctypes.data
        v.control = data.ctrl.ctypes.data
        air = self.effects.air
        if air is not None and air.body_drag is not None:
            v.fluid = data.qfrc_fluid.ctypes.data
            if self._wind is not None:
                v.wind = self.model.opt.wind.ctypes.data
        if self._moving:
            v.obstacles = data.mocap_pos.ctypes.data
            v.mocaps = len(self._moving)

    def _write_changes(self) -> None:
        """Write to the core's vehicle what changes in flight: rotors and pushes."""
        v = self._struct
        rotors = self._rotors
        v.rise = rotors.rise or 0.0
        v.fall = rotors.fall or 0.0
        v.acceleration = rotors.acceleration or 0.0
        v.at_once = rotors.at_once
        v.efficiency[:] = self._efficiency
        v.pushes = self._pushes.ctypes.data
        v.pushing = len(self._pushes)
        v.follows_motion = self._computes_forces or len(self._pushes) > 0

    def state(self) -> Array:
        """(12,) the true state now, yaw unwrapped since the last reset."""
        state: Array = physics_to_state(self.physics[None])[0]
        state[EULER[2]] = self._yaw.unwrapped(state[ANGLES])
        return state

    @property
    def attitude(self) -> tuple[Array, Array]:
        """The true attitude now (4,), wxyz, body to world, sign continuous, and the body rates (3,) [rad/s]."""
        return self._motion[_QUATERNION].copy(), self._velocity[_BODY_RATES].copy()

    def advance(self, speeds: Array, steps: int) -> PhysicsSteps:
        """Hold commanded rotor speeds (4,) [rad/s] for M physics steps, at least 1; return these (M,).

        Raises:
            CommandError: the command is not four finite numbers; nothing moved.
            DivergenceError: the state is no longer finite or plausible.
        """
        self.begin(steps)
        self.hold(speeds, steps)
        return self.flown

    def begin(self, steps: int) -> None:
        """Begin a period of M physics steps, whose rows `hold` fills.

        The core receives the address of each column of the rows in their first row, and the width of a row.
        """
        flown = np.empty(steps, self._steps_type)
        rows = StepsStruct()
        start = flown.ctypes.data
        assert flown.dtype.fields is not None
        for name, (_, offset, *_) in flown.dtype.fields.items():
            setattr(rows, name, start + offset)
        rows.width = flown.itemsize // np.dtype(np.float64).itemsize
        drawn: dict[str, Array] = {}
        if self.effects.thrust_noise is not None:
            drawn["noise"] = np.empty((steps, N_ROTORS))
        if self.effects.disturbance is not None or self._user_forces:
            drawn["disturbance"] = np.zeros((steps, 6))
        if self._moving:
            drawn["obstacles"] = np.empty((steps, 3 * len(self._moving)))
        for name, array in drawn.items():
            setattr(rows, name, array.ctypes.data)
        self.flown = flown
        self._rows = rows
        self._drawn = drawn

    def hold(
        self,
        command: Array,
        steps: int,
        *,
        loop: Struct | None = None,
        sensing: Struct | None = None,
        ask: Answers | None = None,
    ) -> None:
        """Fly some steps of the period that `begin` began.

        Args:
            command: (4,) rotor speeds [rad/s]; not used if there is an inner loop.
            steps: their number.
            loop: the inner loop that flies a command.
            sensing: the sensors that take samples after each step.
            ask: answers for an inner loop that is not in the core.

        Raises:
            CommandError: a command is not four finite numbers.
            DivergenceError: the state is no longer finite or plausible.
            FlightError: `ask`, or a force of the user, raised.
        """
        if loop is None:
            self._require_valid(command)
        command = np.ascontiguousarray(command, dtype=np.float64)
        end = self._step + steps
        while self._step < end:
            staged = self.stage(end - self._step)
            self._fly(self._step + staged, command, loop, sensing, ask)

    def _fly(
        self,
        end: int,
        command: Array,
        loop: Struct | None,
        sensing: Struct | None,
        ask: Answers | None,
    ) -> None:
        """Fly to a physics step in the core, up to which nothing is left to apply or to draw."""
        v = self._struct
        rows = self._rows
        fly = core_library().quadsim_fly
        while self._step < end:
            why = fly(v, loop, sensing, rows, command.ctypes.data, end)
            complaint = b""
            if why == End.FAILED:
                complaint = core_library().quadsim_complaint()
            self.check(why, loop, complaint)
            if why == End.DUE:
                assert loop is not None
                assert ask is not None
                answer = np.asarray(ask())
                self._require_valid(answer)
                loop.answer[:] = answer
                loop.until = loop.stride

    def _require_valid(self, speeds: Array) -> None:
        """Refuse rotor speeds that are no valid command.

        Raises:
            CommandError: they are not four finite numbers.
        """
        problem = check_command(speeds)
        if problem is not None:
            raise CommandError(problem, time=self.time)

    def check(self, why: int, loop: Struct | None, complaint: bytes) -> None:
        """Raise the error for which the core stopped, if it is one.

        Args:
            why: what the core returned, one of `End`.
            loop: the inner loop that flies, if there is one.
            complaint: MuJoCo's message if it failed.

        Raises:
            CommandError: the inner loop's answer is not four finite numbers.
            DivergenceError: the state is no longer finite or plausible.
        """
        if why == End.FAILED:
            text = complaint.decode(errors="replace")
            raise DivergenceError(f"the plant diverged: MuJoCo reports {text}", time=self.time)
        if why == End.DIVERGED:
            raise DivergenceError("the plant diverged: its state is not finite or not plausible", time=self.time)
        self._check_warnings()
        if why == End.INVALID:
            assert loop is not None
            problem = check_command(np.array(loop.answer))
            raise CommandError(str(problem), time=self.time)

    @property
    def unattended(self) -> bool:
        """Whether the core can fly all periods to come by itself: nothing changes, and nothing is drawn."""
        effects = self.effects
        changing = bool(self._pending or self._user_forces or self._moving)
        drawn = effects.thrust_noise is not None or effects.disturbance is not None or self._wind is not None
        return not changing and not drawn

    def stage(self, steps: int) -> int:
        """Apply the changes that are due, and draw; return how many of the next physics steps may be flown at once.

        Raises:
            FlightError: a force of the user raised.
        """
        self._apply_due_changes()
        if self._user_forces:
            steps = 1
        elif self._pending:
            next_change, _ = self._pending[0]
            steps = min(steps, next_change - self._step)
        self._draw(steps)
        if self._user_forces:
            self._drawn["disturbance"][self._rows.row] += self._user_wrench()
        return steps

    @property
    def watched(self) -> bool:
        """Whether MuJoCo's warnings are to be read after each call of the core, by `check`."""
        return self._data is not None

    @property
    def structs(self) -> tuple[Struct, Struct]:
        """The core's vehicle, and the rows of the period that `begin` began."""
        return self._struct, self._rows

    def _draw(self, steps: int) -> None:
        """Draw for the next steps of the period."""
        rows = slice(self._rows.row, self._rows.row + steps)
        drawn = self._drawn
        if self._wind is not None:
            self.flown["wind"][rows] = self._wind.advance(steps)
        if "noise" in drawn:
            drawn["noise"][rows] = self._noise.standard_normal((steps, N_ROTORS))
        if self.effects.disturbance is not None:
            drawn["disturbance"][rows] = self.effects.disturbance.draw(steps, self.timestep, self._disturbance)
        elif self._user_forces:
            drawn["disturbance"][rows] = 0.0
        if self._coloured_noise is not None:
            drawn["disturbance"][rows] += self._coloured_noise.advance(steps)
        if self._moving:
            times = self.timestep * np.arange(self._step, self._step + steps, dtype=np.float64)
            positions = [obstacle.positions(times) for obstacle in self._moving]
            drawn["obstacles"][rows] = np.stack(positions, axis=1).reshape(steps, -1)

    def allows(self, changes: Sequence[Change]) -> bool:
        """Return whether it was built for changes of these kinds."""
        for change in changes:
            if isinstance(change, LOADING) and not self._sets_mass:
                return False
            if isinstance(change, _CARRYING) and self._integrator == "rk4":
                return False
            if isinstance(change, PushChange) and not self._has_forces:
                return False
        return True

    def reschedule(self, changes: Sequence[Change]) -> None:
        """Schedule these changes, of kinds that it `allows`; past ones are ignored."""
        self._pending = deque()
        for step, change in self._scheduled(changes):
            if step >= self._step:
                self._pending.append((step, change))

    def _scheduled(self, changes: Sequence[Change]) -> list[tuple[int, Change]]:
        """Return the changes in order of time, each with the physics step before which it happens."""
        scheduled = []
        for change in sorted(changes, key=lambda change: change.at):
            step = math.ceil(change.at / self.timestep - 1e-6)
            scheduled.append((step, change))
        return scheduled

    def _apply_due_changes(self) -> None:
        """Apply the changes that are due before the next step."""
        applied = False
        while self._pending and self._pending[0][0] <= self._step:
            _, change = self._pending.popleft()
            self._apply(change)
            applied = True
        if applied:
            self._write_changes()

    def _apply(self, change: Change) -> None:
        """Apply a change; `_write_changes` then tells the core."""
        if isinstance(change, RotorChange):
            self._efficiency[change.rotor - 1] = change.efficiency
        elif isinstance(change, LagChange):
            self._rotors = self._rotors.lagging(change)
        elif isinstance(change, PushChange):
            pushes = []
            for push in change.pushes:
                if any(push.force):
                    pushes.append((*push.force, *push.point))
            self._pushes = np.array(pushes, float).reshape(-1, 6)
        elif isinstance(change, MassChange):
            self._set_load(self._payloads, change.factor)
        elif isinstance(change, Payload):
            self._set_load((*self._payloads, change), self._mass_factor)
        elif isinstance(change, PayloadDrop):
            self._set_load((), self._mass_factor)
        else:
            assert_never(change)

    def _set_load(self, payloads: tuple[Payload, ...], mass_factor: float) -> None:
        """Give the vehicle the mass properties with these payloads, and with its own mass times a factor."""
        self._payloads = payloads
        self._mass_factor = mass_factor
        load = replace(self._load, mass_factor=mass_factor)
        properties = mass_properties(self.vehicle, load, payloads)
        if self._integrator == "rk4":
            _set_mass(self._struct, properties.mass, properties.inertia)
        else:
            apply_mass(self.model, BODY, properties)

    def _user_wrench(self) -> Array:
        """Return the sum (6,) of the user-defined forces now, world [N] and body frame [N m].

        Raises:
            ForceError: a force is not six finite numbers.
            RaisedError: a force raised an exception.
        """
        total = np.zeros(6)
        state = physics_to_state(self.physics[None])[0]
        for force in self._user_forces:
            total += _wrench_of(force, self.time, state.copy())
        return total

    def _check_warnings(self) -> None:
        if self._data is None:
            return
        counts = self._data.warning.number
        if not counts.any():
            return
        raised = [kind.name for kind in _NUMERICAL_WARNINGS if counts[int(kind)]]
        if raised:
            raise DivergenceError(f"the plant diverged: MuJoCo reports {', '.join(raised)}", time=self.time)


class NormalsAhead:
    """Standard normal numbers of a generator, in its order, drawn in blocks: many small calls are slow."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._block = np.empty(0)
        self._used = 0

    def standard_normal(self, size: tuple[int, int]) -> Array:
        """As of `numpy.random.Generator`."""
        count = size[0] * size[1]
        if self._used + count > self._block.size:
            fresh = self._rng.standard_normal(max(_BLOCK, count))
            self._block = np.concatenate([self._block[self._used :], fresh])
            self._used = 0
        numbers = self._block[self._used : self._used + count]
        self._used += count
        return numbers.reshape(size)


def check_free(effects: Effects, changes: Sequence[Change], obstacles: Sequence[Obstacle] = ()) -> None:
    """Refuse features that the integrator `rk4` lacks.

    Raises:
        ParameterError: there is a floor or an obstacle to touch, a load beside the origin, or MuJoCo's drag.
    """
    load = effects.load or Load()
    unknown = []
    if effects.ground is not None and effects.ground.contact:
        unknown.append("contact with the ground")
    if obstacles:
        unknown.append("obstacles")
    if any(load.centre_of_mass):
        unknown.append("effects.load.centre_of_mass")
    if load.payloads or any(isinstance(change, _CARRYING) for change in changes):
        unknown.append("a payload")
    if effects.air is not None and effects.air.body_drag is not None:
        unknown.append("effects.air.body_drag")
    if unknown:
        raise ParameterError("plant", "integrator", "rk4", f"mujoco with {' and '.join(unknown)}")


def _wrench_of(force: Force, time: float, state: Array) -> Array:
    """Return the wrench (6,) of a user-defined force at a time [s] and a state (12,).

    Raises:
        ForceError: it is not six finite numbers.
        RaisedError: the force raised an exception.
    """
    name = getattr(force, "__name__", type(force).__name__)
    with user_code(lambda error: RaisedError(f"the force {name}", error, time=time)):
        wrench = numbers_of(force(time, state))
    if wrench.shape != (6,) or not np.all(np.isfinite(wrench)):
        shown = f"{wrench.tolist()!r:.80}"
        raise ForceError(f"the force {name} must give six finite numbers [N, N m]; got {shown}", time=time)
    return wrench


def _set_mass(v: Struct, mass: float, inertia: Array) -> None:
    """Give the core's own method a mass [kg] and an inertia (3, 3) [kg m^2] about the body's origin."""
    v.mass = mass
    v.inertia[:] = np.diagonal(inertia)
    v.products[:] = inertia[0, 1], inertia[0, 2], inertia[1, 2]
    fill(v.inverse, np.linalg.inv(inertia))


def _set_rotors(v: Struct, vehicle: Vehicle) -> None:
    """Give the core the rotors: their places, their thrust a_1 w + a_2 w^2, and the power that they take.

    A rotor's power is its torque times its speed, proportional to (a_1 w + a_2 w^2) w.  The core computes it with w in
    units of the hover speed, and relative to the mean rotor's power in hover.
    """
    v.linear, quadratic = vehicle.thrust_law
    v.coefficient[:] = quadratic
    v.spin[:] = np.array(vehicle.rotor_spins, float)
    fill(v.place, vehicle.hubs)
    fill(v.torque_of_thrust, vehicle.allocation[1:] / vehicle.coefficients)
    v.hover = vehicle.hover_speed
    ratios = vehicle.hover_speeds / vehicle.hover_speed
    mean = vehicle.mean_coefficient
    power = quadratic / mean
    linear_power = v.linear / (mean * vehicle.hover_speed)
    total = float(power @ ratios**3) + linear_power * float((ratios**2).sum())
    v.demand[:] = N_ROTORS * power / total
    v.linear_demand = N_ROTORS * linear_power / total


def _set_air(v: Struct, air: Air) -> None:
    """Give the core the coefficients of drag and of the moments of the air."""
    v.rotor_drag = air.rotor_drag or 0.0
    v.rotor_moment[:] = air.rotor_moment or (0.0, 0.0)
    v.rate_damping[:] = air.rate_damping or (0.0, 0.0, 0.0)
    v.inflow = air.inflow or 0.0
    v.linear_drag[:] = air.linear_drag
    v.quadratic_drag[:] = air.quadratic_drag
    if air.inflow_moment is not None:
        by_mujoco = (0.0, 0.0)
        if air.body_drag is not None:  # MuJoCo's ellipsoid already gives a part of the moment
            by_mujoco = munk_moment(air.body_drag, air.density)
        v.inflow_moment[:] = np.subtract(air.inflow_moment, by_mujoco)


def _set_battery(v: Struct, battery: Battery, curve: Array) -> None:
    """Give the core a battery, with its curve (P, 2) of charge [-] and cell voltage [V]."""
    v.curve = curve.ctypes.data
    v.points = len(curve)
    v.cells = battery.cells
    v.capacity = battery.capacity
    v.resistance = battery.resistance
    v.hover_current = battery.hover_current
    v.idle_current = battery.idle_current
    v.reference_voltage = battery.reference_voltage
    v.exponent = battery.exponent


def _discard(message: str) -> None:
    """Swallow MuJoCo's warnings, which `Plant` reads as counts; else they go to the terminal and a log file."""
