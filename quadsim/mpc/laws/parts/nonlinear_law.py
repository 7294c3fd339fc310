"""The law around the kernel in C, `quadsim_nonlinear.c`: reference, disturbance, actuators, sides of the quaternion.

It turns a measurement and a reference into the query of a program, and the program's answer into commands; exported
controllers are the same file.
"""

from __future__ import annotations

import ctypes
import math
from typing import Final, NoReturn

import numpy as np

from quadsim.controller import StepInputs
from quadsim.core.mirror import Struct, core_library, struct
from quadsim.motion import Motion
from quadsim.mpc.estimate.disturbance import RampObserver
from quadsim.mpc.laws.parts.body import World
from quadsim.mpc.laws.parts.sqp import SQP, SQPStatus
from quadsim.mpc.problem.rigidbody import N_BODY
from quadsim.state import N_STATES, REFERENCE_STATES, Array
from quadsim.vehicle import N_ROTORS

WIDTH_OF_MOTION: Final = N_BODY + N_ROTORS
"""Numbers in a row of a motion: position, quaternion, velocity, body rates, thrusts."""


NumbersStruct: Final = struct("quadsim_nonlinear_numbers")
_LawStruct: Final = struct("quadsim_nonlinear")


class NonlinearLaw:
    """What the law remembers, in C, and its calls of every period: `begin`, then the program's step, then `end`.

    Args:
        numbers: the law's; addresses of `problem`, `period` and `unlagged` are set here.
        sqp: the program, which uses this law's memory from now on.
        period: the body over a control period.
        unlagged: the same without lag of thrusts.
        ramp: what follows changing forces: a `RampObserver` for the memory of its estimates; None for nothing.

    Attributes:
        plan: (N, 4) commands of the last optimum.
        world: what the model knows of its surroundings.
    """

    def __init__(
        self,
        numbers: Struct,
        sqp: SQP,
        period: Struct,
        unlagged: Struct,
        ramp: RampObserver | None,
    ) -> None:
        self._library, self.numbers, self.ramp = core_library(), numbers, ramp
        self._problems = sqp.struct, period, unlagged  # whose addresses the numbers have
        numbers.problem, numbers.period, numbers.unlagged = map(ctypes.addressof, self._problems)
        numbers.ramp = None if ramp is None else ctypes.addressof(ramp.numbers)
        reals, ints = memory_of(numbers, sqp.struct)
        self._memory = np.zeros(reals), np.zeros(ints, np.intc)
        self.struct = law = _LawStruct()
        self._library.quadsim_nonlinear_start(law, numbers, *(part.ctypes.data for part in self._memory))
        if ramp is not None:
            ramp.bind(law.ramp)
        N, n, self.horizon = sqp.horizon, N_BODY + sqp.struct.actuators, sqp.horizon * numbers.stride
        self.world = World(law.world)
        measured, before = np.ctypeslib.as_array(law.measured)[:n], np.ctypeslib.as_array(law.before)
        self._query = measured, before, _view(law.states, N + 1, N_BODY), _view(law.thrusts, N, N_ROTORS)
        self.plan = _view(law.plan, self.horizon, N_ROTORS)
        sqp.bind(law.work, self.world, self._query)
        self._state, self._attitude, self._rates, self._acting = (np.zeros(size) for size in (N_STATES, 4, 3, N_ROTORS))
        self._preview = np.zeros((self.horizon, len(REFERENCE_STATES)))
        self._motion = np.zeros((self.horizon + 1, WIDTH_OF_MOTION))
        given = [array.ctypes.data for array in (self._state, self._attitude, self._rates)]
        self._references = self._preview.ctypes.data, self._motion.ctypes.data
        self._given, self._command = given, self._acting.ctypes.data

    def __reduce__(self) -> NoReturn:
        """Refuse: addresses are useless in a copy or another process."""
        raise TypeError("a law in C cannot be copied or pickled: make another")

    def reset(self, command: Array) -> None:
        """Restart after a command (4,), which acts."""
        self._acting[:] = command
        self._library.quadsim_nonlinear_reset(self.struct, self._command)

    def learn(self, estimate: Array) -> None:
        """Start from an estimate (6,) of the disturbance; without an observer nothing changes."""
        estimate = np.array(estimate, float)
        self._library.quadsim_nonlinear_learn(self.struct, estimate.ctypes.data)

    def stand(self, periods: int, acting: Array) -> None:
        """Pass a period on the ground, so many periods after the last, with a command (4,) in force."""
        self._acting[:] = acting
        self._library.quadsim_nonlinear_stand(self.struct, periods, self._command)

    def begin(self, periods: int, flying: bool, now: StepInputs, state: Array, reference: Array, acting: Array) -> bool:
        """Make the query of a period from its inputs, so many periods after the last; False if they are implausible."""
        self._state[:], self._acting[:] = state, acting
        self._attitude[:] = math.nan if now.attitude is None else now.attitude
        self._rates[:] = math.nan if now.body_rates is None else now.body_rates
        if now.motion is None:
            self._preview[:] = reference
        else:
            put_motion(now.motion, self._motion)
        asked = (self.struct, periods, flying, now.motion is not None, *self._given)
        return bool(
            self._library.quadsim_nonlinear_begin(*asked, self._references[now.motion is not None], self._command)
        )

    @property
    def query(self) -> tuple[Array, ...]:
        """The query of the last `begin`, as of `quadsim.mpc.laws.parts.sqp.SQP.begin`."""
        return tuple(array.copy() for array in self._query)

    def ask(self, world: Array, query: tuple[Array, ...]) -> None:
        """Make a query that another law had, with what that knew of its surroundings."""
        self.world.numbers[:] = world
        for array, value in zip(self._query, query, strict=True):
            array[:] = value

    def end(self, answer: SQPStatus) -> int:
        """Return the period's status, of `quadsim.mpc.guard.structs.STATUSES`, and put its commands into `plan`."""
        return int(self._library.quadsim_nonlinear_end(self.struct, answer))

    def adopt(self, other: NonlinearLaw, rotors: tuple[Array, Array] | None) -> None:
        """Take over what another law knows; of actuators only where both command the same.

        Args:
            other: that law.
            rotors: the shares (4,) that its actuators have reached now and a period ago, as this law's; None where the
                two command other quantities.
        """
        mine, its = self.struct, other.struct
        mine.quaternion, mine.turned, mine.side = its.quaternion, its.turned, its.side
        mine.called = its.called
        if rotors is not None:
            mine.rotors[:], mine.rotors_before[:] = (shares.tolist() for shares in rotors)
            mine.learns, mine.last[:N_BODY] = its.learns, its.last[:N_BODY]


def measured_state(now: StepInputs, state: Array) -> Array:
    """(19,) a state, quaternion and body rates as an exported controller takes them; NaN for what is not measured."""
    measured = np.full(N_STATES + 7, math.nan)
    measured[:N_STATES] = state
    if now.attitude is not None:
        measured[N_STATES : N_STATES + 4] = now.attitude
    if now.body_rates is not None:
        measured[N_STATES + 4 :] = now.body_rates
    return measured


def reference_rows(now: StepInputs, reference: Array, rows: int) -> Array:
    """(M, 17) so many samples of a period's motion, of 0 its reference (N, 4), as an exported controller takes them."""
    if rows == 0 or now.motion is None:
        return reference
    samples = np.zeros((rows, WIDTH_OF_MOTION))
    put_motion(now.motion, samples)
    return samples


def memory_of(numbers: Struct, problem: Struct) -> tuple[int, int]:
    """Return the reals and integers of memory that a law with another program needs."""
    library, other = core_library(), NumbersStruct.from_buffer_copy(numbers)
    other.problem = ctypes.addressof(problem)
    return library.quadsim_nonlinear_reals(other), library.quadsim_nonlinear_ints(other)


def put_motion(motion: Motion, rows: Array) -> None:
    """Write the samples of a motion from now on into rows (M, 17); past the end the last."""
    count = min(len(motion), len(rows))
    parts = (motion.position, motion.attitude, motion.velocity, motion.body_rates)
    first = 0
    for part in parts:
        rows[:count, first : first + part.shape[1]] = part[:count]
        first += part.shape[1]
    rows[:count, first:] = motion.thrusts[:count]
    rows[count:] = rows[count - 1]


def _view(address: int, *shape: int) -> Array:
    return np.ctypeslib.as_array((ctypes.c_double * math.prod(shape)).from_address(address)).reshape(shape)
