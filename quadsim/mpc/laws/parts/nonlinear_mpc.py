"""Nonlinear MPC: sequential quadratic programming on the rigid body with a quaternion.

In each period, the model is linearised along the previous plan, at the nodes' stored states and inputs, and the QP

    min  sum |C_r (s_i - s_i^r)|^2_Q + |u_i - u_i^r|^2_R    s.t.  s_{i+1} = A_i s_i + B_i u_i + c_i,  s_0 measured

is solved: a full Gauss-Newton step, the real-time iteration (Diehl, Bock and Schloeder 2005).
"""

from __future__ import annotations

import ctypes
import math
import time as clock
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Final, NamedTuple, NoReturn

import numpy as np

from quadsim.controller import (
    ACCEPTED,
    CORE,
    GAIN,
    GROUNDED,
    NOT_CONVERGED,
    OPTIMAL,
    SOLVED,
    UNCONSTRAINED,
    Command,
    Phase,
    Statistics,
    StepInputs,
    stopped,
)
from quadsim.core.mirror import Struct, core_library, set_members, struct
from quadsim.errors import ParameterError
from quadsim.mpc.estimate.disturbance import RampObserver
from quadsim.mpc.estimate.observer import DisturbanceObserver, disturbance_of
from quadsim.mpc.forms.staged import Staged
from quadsim.mpc.guard.answer import INFEASIBLE, ActuatorBounds, AnswerCheck, command_of, refused, resized
from quadsim.mpc.guard.numbers import PLAUSIBLE
from quadsim.mpc.guard.structs import STATUSES
from quadsim.mpc.laws.nonlinear import MOST_LATE, Nonlinear
from quadsim.mpc.laws.parts.body import next_states, unpacked, width_of
from quadsim.mpc.laws.parts.delay import Bodies, adopt_sent, delay_numbers, make_bodies
from quadsim.mpc.laws.parts.nonlinear_law import WIDTH_OF_MOTION, put_motion
from quadsim.mpc.laws.parts.nonlinear_problem import (
    commands_to_inputs,
    inputs_to_commands,
    level_command,
    nonlinear_problem,
    prediction_model,
)
from quadsim.mpc.laws.parts.sqp import SQPStatus, core_view, multipliers, nonlinear_program, slack_groups
from quadsim.mpc.problem.constraints import Constraint
from quadsim.mpc.problem.equilibrium import LEAST_LIFT, Trim
from quadsim.mpc.problem.model import require_delay, split_delay
from quadsim.mpc.problem.ocp import Equilibrium, InfeasiblePeriod, Problem, Query
from quadsim.mpc.problem.qp import KKT_EVERY, QP, Solution
from quadsim.mpc.problem.rigidbody import N_BODY, P, Q, V, W
from quadsim.mpc.solvers import INVALID_DATA, Answer, Method
from quadsim.mpc.space import HALF_SPACE_ROUNDING, SETTLED, Space, distances
from quadsim.rotation import (
    body_to_euler_rates,
    euler_to_body_rates,
    euler_to_quaternion,
    quaternion_to_euler,
)
from quadsim.state import (
    ANGLE_RATES,
    ANGLES,
    N_STATES,
    POSITIONS,
    REFERENCE_STATES,
    VELOCITIES,
    Array,
    Indices,
)
from quadsim.vehicle import N_ROTORS, Vehicle

CONVERGED: Final = 0.1
"""Largest dynamics defect of a converged plan (`quadsim.controller.Statistics`). Library flights exceed it in at most 9
periods, after steps of the course and upside down; a tumbling vehicle exceeds it in all."""
STEP_TOLERANCE: Final = 1e-6  # largest change of a state or an input at which the SQP of a period stops
CORRECTIONS: Final = 2
"""Most further SQP steps in a period whose plan has not `CONVERGED`, where commands are targets; if it still has not,
the next period starts from the reference. A single step from far away may leave a plan with a full turn in it, which
further steps keep: that way a stiff soft bound on tilt and unfiltered steps of the reference turned a vehicle over."""
_OPTIMA: Final = {SQPStatus.FREE, SQPStatus.BOUNDED, SQPStatus.UNCONVERGED}
_NumbersStruct: Final = struct("quadsim_nonlinear_numbers")
_LawStruct: Final = struct("quadsim_nonlinear")
"""Numbers of a `quadsim_nmpc_world`: acceleration, angular acceleration, drag, quadratic drag, thrust scale."""


class NonlinearMPC:
    """One step of sequential quadratic programming per period, or more; see the module.

    The states s contain the quaternion q_r* q instead of q, with the node's reference q_r: a rotation of four numbers
    that makes both kinds of `Nonlinear.attitude_error` linear with constant weights.  A measured state enters only as
    s_0; node 0 is linearised at the stored state.

    The controller is in C, `quadsim_nonlinear.c`, around the program of `quadsim_nmpc.h`; exported controllers are the
    same files.  Here it gets its numbers, its half-spaces and its clock, and its answers are checked.

    Attributes:
        settings: its table.
        commands: what it commands.
        model: the rigid body from node to node.
        problem: what it solves in each step, at hover.
        program: the same for the core.
        numbers: the controller's own, for the core.
        bodies: the numbers of the body over a control period, `period`, and of the same without lag of thrusts,
            `unlagged`, each with the array that it points to.
        delay: how late commands act, for the core; None for at once.
        delay_bodies: the bodies that it points to.
        ramp: what follows changing forces; None for nothing.
        struct: what the controller remembers, in C.
        plan: (N, 4) its view of the commands of the last optimum.
        clock: returns the time [s].
        infeasible_period: the first period whose QP had no answer or, if there is none, whose SQP did not converge.

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> from quadsim import mpc
        >>> vehicle = quadsim.load_vehicle("hummingbird")
        >>> controller = mpc.NonlinearMPC(vehicle, period=0.05, settings=mpc.Nonlinear())
        >>> command = controller.step(quadsim.StepInputs(), np.zeros(12), np.zeros((20, 4)))
        >>> command.status, bool(np.allclose(command.speeds, vehicle.hover_speeds, atol=1e-3))
        ('unconstrained', True)
    """

    name: Final = "nonlinear"
    iterates: Final = frozenset({name})
    solver: Final = CORE

    def __init__(
        self,
        vehicle: Vehicle,
        *,
        period: float,
        settings: Nonlinear,
        bounds: ActuatorBounds | None = None,
        constraints: tuple[Constraint, ...] = (),
        space: Space | None = None,
        kkt_every: int = KKT_EVERY,
        tolerance: float = STEP_TOLERANCE,
    ) -> None:
        self.settings = settings
        self._vehicle = vehicle
        self._period = period
        self._again = partial(NonlinearMPC, vehicle, period=period, bounds=bounds, constraints=constraints, space=space)
        self.commands: str = settings.commands
        self.horizon = settings.horizon
        if bounds is None:
            bounds = settings.actuators(vehicle)
        self._bounds = bounds
        self.model = prediction_model(settings, vehicle, period)
        self.problem = nonlinear_problem(settings, vehicle, period, self.model, self._bounds, constraints)
        self._nodes = self.problem.horizon
        self._check = AnswerCheck(self.problem, kkt_every)
        self._form = Staged(self.problem)
        self._space = space
        self._groups = slack_groups(self.problem, faces=space is not None and space.penalty is not None)
        stride = settings.stride(period)
        shift = settings.shift
        if shift is None:
            shift = stride == 1
        corrections = 0
        if self.model.targets:
            corrections = CORRECTIONS
        faces = 0
        price = None
        if space is not None:
            faces = space.count
            price = space.penalty
        self.program = nonlinear_program(
            self.model,
            self.problem,
            inputs=np.stack([self._shares(self._bounds.u_min), self._shares(self._bounds.u_max)]),
            difference=settings.attitude_error == "difference",
            shift=shift,
            iterations=settings.iterations,
            corrections=corrections,
            tolerance=tolerance,
            converged=CONVERGED,
            faces=faces,
            price=price,
        )
        self.delay = None
        self.delay_bodies = Bodies()
        if settings.delay:
            require_delay(settings.delay, period, min(settings.horizon, MOST_LATE))
            if self.model.targets and settings.delay >= period:
                rule = f"below the control period of {period:g} s where an autopilot flies the commands"
                raise ParameterError("controller", "delay", settings.delay, rule)
            self.delay, self.delay_bodies = delay_numbers(settings.delay, self.model, vehicle, period)
        self.clock: Callable[[], float] = clock.perf_counter
        # The same body over a control period: from measurement to measurement, and for other plans, without rotor lag.
        body = replace(self.model, step=period)
        without_lag = replace(body, rotor_lag=None, lag=(0.0, *self.model.lag[1:]), substeps=1)
        self.bodies = make_bodies(period=body, unlagged=without_lag)
        self._lag = self.model.lags[0]  # of actuator states [s]
        self._observer: DisturbanceObserver | None = None
        if settings.offset_free is not None:
            self._observer = DisturbanceObserver(settings.offset_free, period)
        self.ramp = self._make_ramp()
        self.numbers = self._make_numbers(stride)
        self._library = core_library()
        self._start()
        self.reset(level_command(self.model, vehicle))

    def __reduce__(self) -> NoReturn:
        """Refuse: addresses are useless in a copy or another process."""
        raise TypeError("a controller in C cannot be copied or pickled: make another")

    def _make_ramp(self) -> RampObserver | None:
        settings = self.settings
        model = self.model
        if settings.disturbance is None:
            return None
        lag = settings.disturbance.rotor_lag
        if lag is None:
            lag = self._lag
        thrust_lag = None
        if model.targets:
            thrust_lag = self._lag
        _, late = split_delay(settings.delay, self._period)
        return RampObserver(
            replace(settings.disturbance, rotor_lag=lag),
            self._vehicle,
            self._period,
            drag=model.drag / model.mass,
            quadratic_drag=model.quadratic_drag / model.mass,
            moment=settings.moment,
            thrust_lag=thrust_lag,
            late=late,
        )

    def _make_numbers(self, stride: int) -> Struct:
        vehicle = self._vehicle
        model = self.model
        observer = self._observer
        left = 0.0  # of actuators' distance from their command after a period
        if self._lag:
            left = math.exp(-self._period / self._lag)
        numbers = _NumbersStruct(
            problem=ctypes.addressof(self.program.struct),
            stride=stride,
            observes=observer is not None,
            control_period=self._period,
            mass=vehicle.mass,
            coefficient=vehicle.mean_coefficient,
            left=left,
            least_lift=LEAST_LIFT,
            plausible=PLAUSIBLE.max(),
            infeasible=INFEASIBLE,
        )
        for name, (body, _) in self.bodies.items():
            setattr(numbers, name, ctypes.addressof(body))
        if self.delay is not None:
            numbers.delay = ctypes.addressof(self.delay)
        if self.ramp is not None:
            numbers.ramp = ctypes.addressof(self.ramp.numbers)
        lifts = vehicle.mass * vehicle.gravity * vehicle.thrust_shares
        set_members(
            numbers,
            scale=model.scale,
            level=level_command(model, vehicle),
            lifts=lifts * (vehicle.mean_coefficient / vehicle.coefficients),  # of rotors with the mean coefficient
            inverse=np.linalg.inv(model.effectiveness),
            drag=model.drag / vehicle.mass,
            square_drag=model.quadratic_drag / vehicle.mass,
        )
        if observer is not None:
            set_members(numbers, gain=observer.gain, largest=observer.largest)
        return numbers

    def _start(self) -> None:
        """Start a controller in new memory, with views of what Python reads and writes there."""
        p = self.program.struct
        N = self._nodes
        reals, ints = self.memory()
        real_memory = np.zeros(reals)
        int_memory = np.zeros(ints, np.intc)
        self._memory = real_memory, int_memory
        self.struct = law = _LawStruct()
        self._library.quadsim_nonlinear_start(law, self.numbers, real_memory.ctypes.data, int_memory.ctypes.data)
        if self.ramp is not None:
            self.ramp.bind(law.ramp)
        self._work = work = law.work
        self._world = np.ctypeslib.as_array((ctypes.c_double * (ctypes.sizeof(law.world) // 8)).from_buffer(law.world))
        self.plan = core_view(law.plan, self.horizon, N_ROTORS)
        measured = np.ctypeslib.as_array(law.measured)[: self.model.n]
        before = np.ctypeslib.as_array(law.before)
        self._asked = measured, before, core_view(law.states, N + 1, N_BODY), core_view(law.thrusts, N, N_ROTORS)
        addresses = [array.ctypes.data for array in self._asked]
        self._arguments = work, law.world, *addresses
        size = self.model.n + N_ROTORS * bool(p.moves)
        self._x = core_view(work.x, N + 1, size)
        self._u = core_view(work.u, N, N_ROTORS)
        self._s = core_view(work.s, N + 1, size)
        self._v = core_view(work.v, N, N_ROTORS)
        self._goal = core_view(work.goal, N + 1, size)[:, : self.model.n]
        self._aim = core_view(work.aim, N, N_ROTORS)
        self._face = core_view(work.face, N, p.faces, 3)
        self._beyond = core_view(work.beyond, N, p.faces)
        self._map = core_view(work.map, N, N_BODY, width_of(size))
        self._offset = core_view(work.offset, N, size)
        self._axis = core_view(work.axis, N * p.tilts, 2, 4)
        self._known = core_view(work.known, N * p.tilts, 2)
        self._trim = np.ctypeslib.as_array(law.trim.commands), np.ctypeslib.as_array(law.trim.lift)
        self._start_state = np.ctypeslib.as_array(work.start)[: self.model.n]
        A, B = unpacked(np.zeros_like(self._map), self.model.n, size - self.model.n, self.program.pointed["left"][-1])
        shape = N, self.problem.model.n
        self._constant_steps = np.zeros((*shape, shape[1])), np.zeros((*shape, N_ROTORS)), np.zeros(shape)
        self._constant_steps[0][:, : self.model.n, : self.model.n] = A
        self._constant_steps[1][:, : self.model.n] = B
        self._origin = core_view(work.origin, N, p.slacks)
        self._price = core_view(work.price, N, p.slacks)
        self._free = core_view(work.free, N, p.slacks, kind=ctypes.c_int)
        self._held = core_view(work.held, N, N_ROTORS, kind=ctypes.c_int)
        self._state = np.zeros(N_STATES)
        self._attitude = np.zeros(4)
        self._rates = np.zeros(3)
        self._acting = np.zeros(N_ROTORS)
        self._preview = np.zeros((self.horizon, len(REFERENCE_STATES)))
        self._motion = np.zeros((self.motion_rows, WIDTH_OF_MOTION))
        self._given = [self._state.ctypes.data, self._attitude.ctypes.data, self._rates.ctypes.data]
        self._references = self._preview.ctypes.data, self._motion.ctypes.data
        self._command = self._acting.ctypes.data

    def memory(self, capacity: int | None = None) -> tuple[int, int]:
        """Return the reals and integers of memory that it needs, with a capacity for active rows."""
        numbers = _NumbersStruct.from_buffer_copy(self.numbers)
        program = type(self.program.struct).from_buffer_copy(self.program.struct)
        if capacity is not None:
            program.capacity = capacity
        numbers.problem = ctypes.addressof(program)
        return self._library.quadsim_nonlinear_reals(numbers), self._library.quadsim_nonlinear_ints(numbers)

    def resize(self, capacity: int, changes: int) -> None:
        """Set the capacity for active rows and the limit of changes of the active set, in new memory."""
        self.program.struct.capacity = capacity
        self.program.struct.changes = changes
        self._start()

    @property
    def motion_rows(self) -> int:
        """Samples that it takes of a course's motion: one more than there are until the last node's instant."""
        if self.delay is None:
            return self.horizon + 1
        return self.horizon + 1 + self.delay.under_way + 1

    def _shares(self, commands: Array) -> Array:
        """Return the inputs for commands (..., 4): rotor speeds [rad/s] or targets [N], [rad/s]."""
        return commands_to_inputs(self.model, self._vehicle, commands)

    def reset(self, speeds: Array) -> None:
        """Restart after the command u(-1) (4,) [rad/s], with rotors at that speed; or after a target that acts."""
        self._acting[:] = speeds
        self._called_at = math.nan
        self._library.quadsim_nonlinear_reset(self.struct, self._command)
        self._check.reset()
        self.infeasible_period: InfeasiblePeriod | None = None

    def adopt(self, previous: object) -> None:
        """Take over the previous controller's disturbance, and from one with like commands rotor speeds and plan."""
        estimate = disturbance_of(previous)
        if isinstance(previous, NonlinearMPC):
            self._adopt_memory(previous)
            if previous._observer is not None:
                estimate = np.array(previous.struct.estimate)
        if estimate is not None:
            self.learn(estimate)

    def _adopt_memory(self, law: NonlinearMPC) -> None:
        mine = self.struct
        its = law.struct
        alike = self.model.inputs is law.model.inputs
        self._called_at = law._called_at
        mine.quaternion = its.quaternion
        mine.turned = its.turned
        mine.side = its.side
        mine.called = its.called
        if self.model.targets is law.model.targets:
            for name in ("rotors", "rotors_before"):
                rotors = np.array(getattr(its, name))
                if not alike:
                    rotors = self._shares(inputs_to_commands(law.model, law._vehicle, rotors))
                set_members(mine, **{name: rotors})
            mine.learns = its.learns
            mine.last[:N_BODY] = its.last[:N_BODY]
            adopt_sent(mine.delay, self.delay, its.delay, law.delay)
            if self.delay is not None:
                set_members(mine.delay, rotors=mine.rotors, rotors_before=mine.rotors_before)
        plan = law.stored_plan
        if plan is not None and alike and self.model.n == law.model.n and self.model.step == law.model.step:
            self.stored_plan = resized(plan[0], self._nodes + 1), resized(plan[1], self._nodes)
        if self.ramp is not None and law.ramp is not None:
            self.ramp.adopt(law.ramp)

    def learn(self, estimate: Array) -> None:
        """Start from an estimate (6,) of the disturbance; without an observer nothing changes."""
        estimate = np.array(estimate, float)
        self._library.quadsim_nonlinear_learn(self.struct, estimate.ctypes.data)

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """See `quadsim.controller.Controller.step`; numbers out of range give the status `invalid_data`."""
        if now.acting is not None:
            self._acting[:] = now.acting
        elapsed = now.time - self._called_at
        self._called_at = now.time
        periods = 0
        if math.isfinite(elapsed):
            periods = round(elapsed / self._period)
        if now.phase in GROUNDED:
            self._library.quadsim_nonlinear_stand(self.struct, periods, self._command)
            self._acting[:] = self._bounds.lowest(self._acting)
            return stopped(self._acting.copy(), self.horizon, now.phase)
        if not self._begin(periods, now, state, reference):
            return refused(self._acting, self.horizon, INVALID_DATA)
        if self.ramp is not None and now.phase is Phase.FLYING:
            self.ramp.log(now)
        first = self.infeasible_period
        last_plan = None
        if first is None:
            last_plan = self.stored_plan
        answer, code = self._iterate(now.time + self.settings.delay)
        status = STATUSES[code]
        refusal = None
        if status not in ACCEPTED:
            refusal = status
        answer, reason = self._checked(answer, refusal)
        if reason is not None:
            if reason != INVALID_DATA and (first is None or first.converges is not None):
                self.infeasible_period = self._kept_period(now.time, reason)
            return replace(refused(self._acting, self.horizon, reason, answer), iterations_by=self.name)
        if status == NOT_CONVERGED and first is None:
            start = _Start(last_plan, self._world.copy(), now.time + self.settings.delay, self.asked)
            converges = partial(_converges, self._again, self.settings, start)
            self.infeasible_period = replace(self._kept_period(now.time, status), converges=converges)
        speeds = self.plan.copy()
        speeds[0] = self._bounds.clip(speeds[0], self._acting)
        self._acting[:] = speeds[0]
        return replace(command_of(speeds[0], speeds, status, answer), iterations_by=self.name)

    def _begin(self, periods: int, now: StepInputs, state: Array, reference: Array) -> bool:
        """Make the query of a period, so many after the last, from its inputs; False if they are implausible."""
        self._state[:] = state
        if now.attitude is None:
            self._attitude[:] = math.nan
        else:
            self._attitude[:] = now.attitude
        if now.body_rates is None:
            self._rates[:] = math.nan
        else:
            self._rates[:] = now.body_rates
        moves = now.motion is not None
        if now.motion is None:
            self._preview[:] = reference
        else:
            put_motion(now.motion, self._motion)
        flying = now.phase is Phase.FLYING
        return bool(
            self._library.quadsim_nonlinear_begin(
                self.struct, periods, flying, moves, *self._given, self._references[moves], self._command
            )
        )

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`; with the latest disturbance estimate, without rotor lag."""
        body, _ = self.bodies["unlagged"]
        x = np.zeros((len(states), N_BODY + body.actuators))
        x[:, :N_BODY] = _body(states)
        predicted = np.empty((*plans.shape[:2], N_STATES))
        for i in range(plans.shape[1]):
            x = next_states(body, self.struct.world, x, self._shares(plans[:, i]))
            x[:, Q] /= np.linalg.norm(x[:, Q], axis=1, keepdims=True)
            euler = quaternion_to_euler(x[:, Q])
            predicted[:, i, POSITIONS] = x[:, P]
            predicted[:, i, VELOCITIES] = x[:, V]
            predicted[:, i, ANGLES] = euler
            predicted[:, i, ANGLE_RATES] = body_to_euler_rates(euler, x[:, W])
        return predicted

    @property
    def disturbance(self) -> Array:
        """(6,) estimated acceleration now, world [m/s^2], and angular acceleration, body [rad/s^2]."""
        return self._world[:6].copy()

    @property
    def trim(self) -> Trim | None:
        """The target at rest under the estimated force and thrust scale, for the fallback; None for rotor speeds."""
        if not self.model.targets:
            return None
        commands, lift = self._trim
        return Trim(speeds=commands.copy(), lift=lift.copy())

    @property
    def asked(self) -> tuple[Array, ...]:
        """The last query: the state (n,) from which the command acts, and the inputs before (4,); then the reference.

        The reference is states (N + 1, 13) and the rotors' thrusts (N, 4) [N] that hold them.  States are position,
        quaternion, velocity, body rates and, of the measured one, actuators.
        """
        return tuple(array.copy() for array in self._asked)

    @property
    def stored_plan(self) -> tuple[Array, Array] | None:
        """States (N + 1, n) and inputs (N, 4) of the plan from which the next step starts; None without one."""
        if not self._work.planned:
            return None
        return self._x[:, : self.model.n].copy(), self._u.copy()

    @stored_plan.setter
    def stored_plan(self, plan: tuple[Array, Array] | None) -> None:
        self._work.planned = int(plan is not None)
        if plan is None:
            self._library.quadsim_nmpc_reset(self._work)
            return
        n = self.model.n
        before = self._asked[1]
        self._x[:, :n], self._u[:] = plan
        if self._x.shape[1] > n:
            self._x[0, n:], self._x[1:, n:] = before, self._u

    @property
    def half_spaces(self) -> tuple[Array, Array]:
        """Normals (S, N, 3) and bounds (S, N) of normal . p >= bound, for positions, of the present program."""
        return np.asarray(-self._face.transpose(1, 0, 2)), np.asarray(-self._beyond.T)

    @property
    def inputs(self) -> Array:
        """(N, 4) inputs of the last optimum."""
        return self._v.copy()

    @property
    def positions(self) -> Array:
        """(N, 3) positions of the last optimum [m]."""
        return self._s[1:, P].copy()

    @property
    def active(self) -> int:
        """Number of active rows at the last optimum."""
        return int(self._work.count + np.count_nonzero(self._held))

    @property
    def changes(self) -> int:
        """Changes of the active set and recursions of the last program."""
        return int(self._work.changes + self._work.rounds + self._work.inner)

    def solve(self, *asked: Array) -> SQPStatus:
        """Take a period's SQP steps for a query like `asked`, by default the present one, without half-spaces."""
        for array, value in zip(self._asked, asked, strict=False):
            array[:] = value
        if self.settings.time_limit is None:
            return SQPStatus(self._library.quadsim_nmpc_step(*self._arguments))
        deadline = self.clock() + self.settings.time_limit
        if not self._library.quadsim_nmpc_begin(*self._arguments):
            return SQPStatus.NOT_FINITE
        goes_on = True
        while goes_on:
            self._library.quadsim_nmpc_linearise(self._work, self.struct.world)
            status = SQPStatus(self._library.quadsim_nmpc_solve(self._work))
            status, goes_on = self._keep(status, deadline)
        return status

    def _keep(self, status: SQPStatus, deadline: float) -> tuple[SQPStatus, bool]:
        """Keep the optimum as the plan; return the plan's status, and whether another step should follow."""
        of_plan = ctypes.c_int(status)
        self._work.ends = math.isfinite(deadline) and self.clock() >= deadline
        goes_on = self._library.quadsim_nmpc_keep(self._work, self.struct.world, ctypes.byref(of_plan))
        return SQPStatus(of_plan.value), bool(goes_on)

    def _among(self, space: Space, time: float) -> SQPStatus:
        """Take SQP steps among half-spaces: those of a program follow its optimum, a few times at most."""
        t = time + space.period * np.arange(1.0, self._nodes + 1.0)
        limit = self.settings.time_limit
        if limit is None:
            deadline = math.inf
        else:
            deadline = self.clock() + limit
        if not self._library.quadsim_nmpc_begin(*self._arguments):
            return SQPStatus.NOT_FINITE
        goes_on = True
        while goes_on:
            self._library.quadsim_nmpc_linearise(self._work, self.struct.world)
            along = self._x[1:, P].copy()
            for i in range(space.settings.iterations):
                normals, bounds = space.half_spaces(t, along)
                if i and (distances(normals, bounds, along) >= -HALF_SPACE_ROUNDING).all():
                    break
                self._face[:] = -normals.transpose(1, 0, 2)
                self._beyond[:] = -bounds.T
                status = SQPStatus(self._library.quadsim_nmpc_solve(self._work))
                if status not in _OPTIMA:
                    break
                before = along
                along = self.positions
                if np.abs(along - before).max() < SETTLED:
                    break
            status, goes_on = self._keep(status, deadline)
        return status

    def _iterate(self, time: float) -> tuple[Answer, int]:
        """Take SQP steps from the stored plan; return the last program's optimum and the plan's status in the core."""
        work = self._work
        started = clock.perf_counter()
        if self._space is None:
            found = self.solve()
        else:
            found = self._among(self._space, time)
        code: int = self._library.quadsim_nonlinear_end(self.struct, found)
        spent_s = clock.perf_counter() - started
        if found not in _OPTIMA:
            no_plan = np.full((self._nodes, N_ROTORS), math.nan)
            stats = Statistics(iterations=self.changes, solve_s=spent_s)
            return Answer(no_plan, np.zeros((self._nodes, 0)), STATUSES[code], CORE, stats=stats), code
        stats = Statistics(
            iterations=self.changes,
            active=self.active,
            sqp_defect=work.defect,
            sqp_step=work.moved,
            solve_s=spent_s,
        )
        if found is SQPStatus.FREE:
            status = UNCONSTRAINED
            answered_by = GAIN
            method = Method.FREE
        else:
            status = SOLVED
            answered_by = CORE
            method = Method.WHOLE
        answer = Answer(
            self.inputs,
            self._slacks(self._groups),
            status,
            answered_by,
            method=method,
            stats=stats,
            certificate=self._certificate,
        )
        return answer, code

    def _checked(self, answer: Answer, refused: str | None) -> tuple[Answer, str | None]:
        """Check the last program's optimum; see `quadsim.mpc.guard.answer.AnswerCheck`."""
        if answer.certificate is None:
            return answer, refused
        return self._check(self._rows(), self._query(), answer, refused)

    def _slacks(self, groups: Indices) -> Array:
        """(N, m) slacks of the last optimum, of chosen groups, in the constraints' units."""
        program = self.program
        if not groups.size:
            return np.zeros((self._nodes, 0))
        normalised = self._free * (self._origin + (self._price - program.linear) / program.quadratic)
        return np.array((normalised / program.slack_scale)[:, groups])

    def _rows(self) -> Problem:
        """The program of the last step, with the half-spaces that it had."""
        if self._space is None:
            return self.problem
        added = self._space.constraint(*self.half_spaces, self.problem.model.n)
        return replace(self.problem, constraints=(*self.problem.constraints, added))

    def _query(self) -> Query:
        """The data of the last step's program."""
        n = self.model.n
        goal = np.zeros((self._nodes + 1, self.problem.model.n))
        goal[:, :n] = self._goal
        state = np.empty(self.problem.model.n)
        state[:n] = self._start_state
        if self.program.struct.tilts:
            w, x, y, z = self._asked[0][Q].tolist()
            state[n:] = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x)  # R(q) e_z along world x and y
        desired = goal[1:] @ self.problem.objective.C_r.T
        equilibrium = Equilibrium(goal[-1], self._aim.copy())
        return Query(state, desired, self._asked[1].copy(), equilibrium, self._steps())

    def _steps(self) -> tuple[Array, Array, Array]:
        """A (N, n, n), B (N, n, 4), c (N, n) of the program; under `tilt`, the thrust axis is two further states."""
        n = self.model.n
        inputs = self._offset.shape[1] - 3
        constant_A, constant_B, constant_c = self._constant_steps
        A = constant_A.copy()
        B = constant_B.copy()
        c = constant_c.copy()
        A[:, :N_BODY, 3:n] = self._map[:, :, : n - 3]
        B[:, :N_BODY] = self._map[:, :, inputs : inputs + N_ROTORS]
        c[:, :n] = self._offset[:, :n]
        if self.program.struct.tilts:
            np.matmul(self._axis, A[:, Q, :n], out=A[:, n:, :n])
            np.matmul(self._axis, B[:, Q], out=B[:, n:])
            c[:, n:] = (self._axis @ c[:, Q, None])[:, :, 0] + self._known
        return A, B, c

    def _certificate(self) -> tuple[QP, Solution]:
        """Return the last step's program, and its optimum with multipliers."""
        problem = self._rows()
        query = self._query()
        if problem is self.problem:
            form = self._form
            groups = self._groups
        else:
            form = Staged(problem)
            groups = slack_groups(problem)
        qp = form.assemble(query)
        of_rows = multipliers(self.program, self._work, len(problem.rows.names), len(self.problem.rows.names))
        return qp, form.solution(query, qp, self.inputs, self._slacks(groups), of_rows)

    def _kept_period(self, time: float, status: str) -> InfeasiblePeriod:
        """Return the last program as the data of a period without an answer."""
        delay = self.settings.delay
        return InfeasiblePeriod(problem=self._named(), query=self._query(), status=status, time=time, delay=delay)

    def _named(self) -> Problem:
        """The last program with the half-spaces of each obstacle by its name."""
        if self._space is None:
            return self.problem
        named = self._space.constraints(*self.half_spaces, self.problem.model.n)
        return replace(self.problem, constraints=(*self.problem.constraints, *named))


def _body(states: Array) -> Array:
    """(..., 13) states of the rigid body from states (..., 12)."""
    x = np.empty((*states.shape[:-1], N_BODY))
    x[..., P] = states[..., POSITIONS]
    x[..., V] = states[..., VELOCITIES]
    x[..., Q] = euler_to_quaternion(states[..., ANGLES])
    x[..., W] = euler_to_body_rates(states[..., ANGLES], states[..., ANGLE_RATES])
    return x


class _Start(NamedTuple):
    """What a period's plan starts from: data alone, so that a flight can be pickled."""

    plan: tuple[Array, Array] | None
    world: Array  # (13,) what the model knows of its surroundings
    time: float
    asked: tuple[Array, ...]  # see `NonlinearMPC.asked`


def _converges(make: Callable[..., NonlinearMPC], settings: Nonlinear, start: _Start, iterations: int) -> bool:
    """Return whether a period's plan converges within `iterations`."""
    law = make(settings=replace(settings, iterations=iterations, time_limit=None))
    law._world[:] = start.world
    for array, value in zip(law._asked, start.asked, strict=True):
        array[:] = value
    law.stored_plan = start.plan
    _, code = law._iterate(start.time)
    return STATUSES[code] in OPTIMAL
