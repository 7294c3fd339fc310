"""The controller protocol: one command per control period.

`Controller.step(now, state, reference)` receives the measured state (12,) and the reference (N, 4) at t_{k+1} ..
t_{k+N}, and returns a `Command`: rotor speeds u(k) (4,) [rad/s], the plan and a status.  `quadsim.sim.loop` calls it.
Optional abilities (to predict, to adopt a predecessor's memory, ...) are protocols of their own, found by `isinstance`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol, runtime_checkable

import numpy as np

from quadsim.motion import Motion
from quadsim.state import Array
from quadsim.vehicle import LARGEST

if TYPE_CHECKING:
    from quadsim.core.mirror import Struct

# ---- statuses of a command -------------------------------------------------------------------------------------------

SOLVED: Final = "solved"
"""A QP solver or the core computed the optimum."""
UNCONSTRAINED: Final = "unconstrained"
"""The unconstrained optimum satisfies every constraint, so it is also the constrained optimum."""
COMMANDED: Final = "commanded"
"""The command is of a controller without a solver."""
NOT_CONVERGED: Final = "not_converged"
"""The QP was solved, but its plan does not satisfy the nonlinear dynamics that it linearises."""
MISSED: Final = "missed"
"""The command arrived after the start of the next period, so the one before stayed in force."""
OPTIMAL: Final = frozenset({SOLVED, UNCONSTRAINED, COMMANDED})
"""Statuses whose command is the controller's answer."""
ACCEPTED: Final = OPTIMAL | {NOT_CONVERGED}
"""Statuses whose command is applied unchanged."""

# ---- sources of a command, beside QP solvers by their names (`quadsim.mpc.solvers.find_solver`) ----------------------

GAIN: Final = "gain"
"""The unconstrained optimum, a product with constant gains."""
CORE: Final = "core"
"""The exact optimum of `quadsim.mpc.solvers.core`, compiled."""
LAW: Final = "law"
"""A controller without a solver."""
FALLBACK: Final = "fallback"
"""An earlier plan or command, or the fallback contract."""
STOPPED: Final = "stopped"
"""No source: the rotors are off."""
NO_OPTIMUM: Final = frozenset({LAW, FALLBACK, STOPPED})
"""Sources of a command without an optimum, for which no active constraints and no computing time are reported."""
NO_SOLVER: Final = frozenset({GAIN, CORE}) | NO_OPTIMUM
"""Sources of a command other than QP solvers."""

# ---- what a controller commands, its attribute or field `commands` ---------------------------------------------------

ROTORS: Final = "rotors"
"""Rotor speeds (4,) [rad/s]; the other commands are targets of an autopilot."""
RATES: Final = "rates"
"""Targets (4,): collective thrust T [N] and body rates p, q, r [rad/s]."""
ATTITUDE: Final = "attitude"
"""Targets (8,): collective thrust T [N], body rates p, q, r [rad/s] that are fed forward, and the attitude to hold, a
quaternion w, x, y, z, body to world."""
TARGET_SIZES: Final = {ROTORS: 4, RATES: 4, ATTITUDE: 8}
"""How many numbers a command has, by what is commanded."""
COMMANDED_NUMBERS: Final = {
    ROTORS: "four rotor speeds [rad/s]",
    RATES: "T, p, q, r: collective thrust [N] and body rates [rad/s]",
    ATTITUDE: (
        "T, p, q, r, w, x, y, z: collective thrust [N], body rates that are fed forward [rad/s], and the attitude, a "
        "unit quaternion from body to world"
    ),
}
"""The numbers of a command in words, by what is commanded."""
LARGEST_SPEED: Final = LARGEST
"""Largest magnitude of a valid rotor speed command [rad/s], as of any number of a vehicle; a larger one is a fault."""


class Signals(Protocol):
    """Records what a controller logs; see `quadsim.flight.log.LoggedSignals`."""

    def log(self, name: str, value: float, unit: str) -> None:
        """See `StepInputs.log`."""
        ...


class Phase(StrEnum):
    """Phase of a flight relative to the ground; without a ground always `flying`."""

    LANDED = "landed"  # on the ground, rotors off or spinning down
    ARMED = "armed"  # on the ground, rotors spinning up for take-off
    FLYING = "flying"
    CRASHED = "crashed"  # something other than the feet touched the ground; recorded from then on, no longer controlled


@dataclass(frozen=True, kw_only=True)
class StepInputs:
    """Time of a controller's call, and its inputs besides the measured state.

    Attributes:
        time: t_k [s].
        phase: phase relative to the ground.
        acting: (4,) the command before, u(k-1) [rad/s].  It is in force at t_k unless commands take longer than a
            period to act.  None: the controller takes its own last command for it.
        attitude: (4,) measured quaternion wxyz, body to world, sign continuous from period to period; None: derive it
            from the state.
        body_rates: (3,) measured body rates [rad/s]; None: derive them from the state.
        motion: the reference from t_k on, if the course defines more than x, y, z, yaw.
        unseen: (12,) periods since each entry of the state was measured: the fallback contract predicts entries that
            are missing.  None: all are measured now.
        signals: recorder for `log`; None if nothing is recorded.

    Examples:
        >>> import quadsim
        >>> quadsim.StepInputs(time=0.05).phase.value
        'flying'
        >>> def logs_height(now, state, reference):
        ...     now.log("height_error", reference[0, 2] - state.z, "m")
        ...     return [205.0] * 4
        >>> short = quadsim.load("hover").replace({"duration": 0.15})
        >>> quadsim.fly(short, controller=logs_height).logged["height_error"].shape
        (3,)
    """

    time: float = 0.0
    phase: Phase = Phase.FLYING
    acting: Array | None = None
    attitude: Array | None = None
    body_rates: Array | None = None
    motion: Motion | None = None
    unseen: Array | None = None
    signals: Signals | None = field(default=None, repr=False, compare=False)

    def log(self, name: str, value: float, unit: str = "-") -> None:
        """Record a number of this period: a column of flight.parquet, and `flight.logged[name]`.

        Args:
            name: an identifier that is not a column of flight.parquet.  Of several values in a period the last counts.
            value: a finite number, or NaN, which also stands in periods without a value.
            unit: stored with the column.

        Raises:
            ParameterError: the name or the value is not allowed; it ends the flight.
        """
        if self.signals is not None:
            self.signals.log(name, value, unit)


class InnerLoop(Protocol):
    """A faster loop inside the control period, from the command in force to the rotor speeds applied.

    An autopilot is one whose commands are targets instead of rotor speeds (`AutopilotLoop`).
    """

    @property
    def rate(self) -> float:
        """Rate of calls [Hz], of which the first is when the loop comes into force.

        The time between two calls is a whole number of physics steps.
        """
        ...

    def speeds(self, time: float, commanded: Array, rates: Array, rotors: Array, attitude: Array) -> Array:
        """Return the rotor speeds (4,) to hold until the next call [rad/s].

        Args:
            time: [s].
            commanded: the command in force: rotor speeds (4,) [rad/s], or a target.
            rates: (3,) body rates [rad/s]: the true ones, or for an autopilot with a sensor the measured ones.
            rotors: (4,) true rotor speeds [rad/s].
            attitude: (4,) quaternion wxyz, body to world: true or measured, as the rates.
        """
        ...


@runtime_checkable
class TargetLoop(Protocol):
    """An inner loop that says whether its commands are targets; see `quadsim.sim.autopilot`."""

    @property
    def takes_targets(self) -> bool:
        """Whether its commands are targets, not rotor speeds."""
        ...


def takes_targets(inner: object) -> bool:
    """Return whether an inner loop takes targets; one that does not say so takes rotor speeds."""
    return inner is not None and isinstance(inner, TargetLoop) and inner.takes_targets


class AutopilotLoop(InnerLoop, TargetLoop, Protocol):
    """An autopilot: an inner loop that takes targets; built in, or a firmware's."""

    def reset(self) -> None:
        """Start anew, as before a flight."""
        ...


@runtime_checkable
class Settling(Protocol):
    """An autopilot that can start on a vehicle that turns."""

    def settle(self, rates: Array, rotors: Array) -> None:
        """Start at body rates (3,) and rotor speeds (4,) [rad/s], after `reset`."""
        ...


@runtime_checkable
class Engaging(Protocol):
    """An inner loop that the compiled core may answer for."""

    def engage(self, command: Array, rotors: Array) -> Struct | None:
        """Put a command in force, at rotor speeds (4,) [rad/s].

        Returns:
            the struct with which the core computes the answers; None: they come from `speeds`.
        """
        ...


class Statistics(NamedTuple):
    """How an answer was computed, declared once for solvers, answers and commands; NaN: not available.

    Attributes:
        iterations: iterations of the solver, also if its answer was rejected; 0 for a closed form.
        active: number of constraints active at the optimum.
        slack: largest softening of an output bound [rad]; 0 while all bounds are hard.
        reported_primal: largest constraint violation that the QP solver reports [in its scaling].
        reported_dual: largest gradient of the Lagrangian that the QP solver reports [in its scaling].
        infeasibility: largest violation of the problem's normalised rows by the plan, soft rows less their slack.
        kkt_stationarity: largest entry of the Lagrangian's gradient, computed from the QP.
        kkt_complementarity: largest product of a multiplier and the distance to its bound, computed from the QP.
        kkt_dual: largest multiplier with the wrong sign, computed from the QP.
        sqp_defect: largest |x_{i+1} - f(x_i, u_i)| of a plan by sequential quadratic programming, over its nodes and
            the states' components [m, m/s, rad/s, shares]; a solved QP does not imply that it is small.
        sqp_step: largest change of a state or an input in the last iteration, in the same units.
        solve_s: wall time of the optimum alone, however it was found [s].

    Examples:
        >>> import quadsim
        >>> stats = quadsim.Statistics(iterations=3, active=2)
        >>> quadsim.Command(speeds=[200.0] * 4, plan=[[200.0] * 4], stats=stats).stats.active
        2
    """

    iterations: int = 0
    active: int = 0
    slack: float = 0.0
    reported_primal: float = math.nan
    reported_dual: float = math.nan
    infeasibility: float = math.nan
    kkt_stationarity: float = math.nan
    kkt_complementarity: float = math.nan
    kkt_dual: float = math.nan
    sqp_defect: float = math.nan
    sqp_step: float = math.nan
    solve_s: float = math.nan


NO_STATISTICS: Final = Statistics()


@dataclass(frozen=True, kw_only=True)
class Command:
    """A controller's command for one period, and how it was computed.

    Attributes:
        speeds: (4,) rotor speeds to hold for the period [rad/s]; where `inner` takes targets, collective thrust [N] and
            body rates [rad/s], (4,), perhaps followed by an attitude, (8,): see `quadsim.sim.autopilot.Autopilot`.
        plan: (N, 4) or (N, 8) planned speeds or targets, `plan[0]` being this period's.
        status: `solved`, `unconstrained`, `commanded` or `not_converged` (`ACCEPTED`), `landed` or `crashed` where
            rotors are stopped, or the solver's name for its failure.
        answered_by: source of `speeds`: `gain`, `core`, a QP solver by its name, `law`, `fallback` or `stopped`.
        fallback: 0 when `speeds` is this period's optimum.  1: the shifted previous plan, or the last command, which
            stays in force where one misses its deadline.  Higher levels: see the fallback contract.
        stats: how it was computed.
        inner: the inner loop that flies this command; None: the rotors hold `speeds`.
        iterations_by: whose iterations `stats` counts, also if that answer was rejected; empty: `answered_by`.

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> speeds = np.full(4, 200.0)
        >>> quadsim.Command(speeds=speeds, plan=np.tile(speeds, (10, 1))).status
        'commanded'
    """

    speeds: Array
    plan: Array
    status: str = COMMANDED
    answered_by: str = LAW
    fallback: int = 0
    stats: Statistics = NO_STATISTICS
    inner: InnerLoop | None = None
    iterations_by: str = ""


GROUNDED: Final = frozenset({Phase.LANDED, Phase.CRASHED})
"""Phases in which a controller stops the rotors."""


def stopped(speeds: Array, horizon: int, phase: Phase) -> Command:
    """Return the command of a controller with stopped or stopping rotors: `speeds` (4,), status `phase`."""
    return Command(speeds=speeds, plan=np.tile(speeds, (horizon, 1)), status=str(phase), answered_by=STOPPED)


@runtime_checkable
class Named(Protocol):
    """A controller with a name."""

    @property
    def name(self) -> str:
        """Short name of the controller."""
        ...


@runtime_checkable
class Solving(Protocol):
    """A controller that names its solver."""

    @property
    def solver(self) -> str:
        """Name of the QP solver; empty for a closed form."""
        ...


@runtime_checkable
class Iterating(Protocol):
    """A controller whose answers take iterations."""

    @property
    def iterates(self) -> frozenset[str]:
        """Names of the solvers that may count them, as in `Command.iterations_by`."""
        ...


@runtime_checkable
class Resetting(Protocol):
    """A controller with a state."""

    def reset(self, speeds: Array) -> None:
        """Restart: the next step is the first, after `speeds` u(-1) (4,) [rad/s]."""
        ...


@runtime_checkable
class Stepping(Protocol):
    """What a user's controller is at least."""

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """Return the command for the period that starts now, from the measured state xi(k) (12,).

        The reference (N, 4) is filtered x, y, z [m], yaw [rad] at t_{k+1} .. t_{k+N}; in a flight, the yaw is on the
        turn of the measured one, as by `quadsim.state.ReferenceTurns`.

        Raises:
            FlightError: the controller cannot return a command.
        """
        ...


class Controller(Named, Solving, Resetting, Stepping, Protocol):
    """What is asked for a command once per control period.

    These are the members that every controller has.  The protocols below are optional: a controller follows one by
    having its member.  A user's controller need only be `Stepping`; `quadsim.scenarios.plugin` adds the rest.
    """

    @property
    def horizon(self) -> int:
        """N, number of preview samples passed to `step`."""
        ...


@runtime_checkable
class Predicting(Protocol):
    """A controller with a model; without one, the run has no `horizon.parquet`."""

    def predict(self, states: Array, plans: Array) -> Array | None:
        """Return the states (K, N, 12) predicted from measured states (K, 12) and plans (K, N, 4), for figures.

        None: there is no model.  So a wrapper answers whose controller has none.
        """
        ...


@runtime_checkable
class Foreseeing(Protocol):
    """A controller with a model of one period, though it predicts no plan."""

    def foresee(self, states: Array, commands: Array) -> Array | None:
        """Return the states (K, 12) a period after states (K, 12) under commands (K, 4); None without a model."""
        ...


@runtime_checkable
class Adopting(Protocol):
    """A controller that can take over in flight."""

    def adopt(self, previous: object) -> None:
        """Copy estimates, plan and the like from the controller in command before; called after `reset`."""
        ...


@runtime_checkable
class Beginning(Protocol):
    """A controller that needs the body rates at its start."""

    def begin(self, rates: Array) -> None:
        """Begin at body rates (3,) [rad/s]; called after `reset`."""
        ...


@runtime_checkable
class Diagnosable(Protocol):
    """A controller that keeps the first problem for which it found no answer."""

    @property
    def infeasible_period(self) -> object:
        """The `quadsim.mpc.InfeasiblePeriod` of the first such period since `reset`; None if there is none."""
        ...


class CoreController(Protocol):
    """A controller and its fallback contract in the core, which answers each period in one call.

    It flies as long as every period has an optimum.  For any other flight, use the controller that it was made of.
    """

    @property
    def commands(self) -> Array:
        """(K + 1, 4) u(-1), then the command of each period so far [rad/s]."""
        ...

    @property
    def status(self) -> tuple[str, ...]:
        """Status of each period so far, as of `Command`."""
        ...

    @property
    def answered_by(self) -> tuple[str, ...]:
        """Source of each command so far, as of `Command`."""
        ...

    @property
    def statistics(self) -> Mapping[str, Array]:
        """Columns (K,) of the periods so far, by the names of `Statistics`; the core has not all of them."""
        ...

    @property
    def accepted(self) -> bool:
        """Whether every plan so far satisfies the problem's constraints."""
        ...

    def start(self, periods: int, speeds: Array) -> None:
        """Restart after the command u(-1) (4,) [rad/s], with room for K periods."""
        ...

    def step(self, state: int, reference: int) -> bool:
        """Answer the next period, in which the vehicle flies; return whether there is an optimum.

        Args:
            state: address of the measured state (12,).
            reference: address of x, y, z [m], yaw [rad] (N, 4) at t_{k+1} .. t_{k+N}.
        """
        ...


@runtime_checkable
class InCore(Protocol):
    """A controller that the core can fly alone."""

    def in_core(self, fallback: Struct) -> CoreController | None:
        """Return the controller for the core, with the settings of its fallback contract, a `quadsim_fallback`.

        None: the core cannot fly it.
        """
        ...


@runtime_checkable
class Commanding(Protocol):
    """A controller that says what it commands; one that does not commands rotor speeds."""

    @property
    def commands(self) -> str:
        """One of `TARGET_SIZES`."""
        ...


def check_command(speeds: Array) -> str | None:
    """Return why rotor speeds are not a valid command; None if they are."""
    if np.iscomplexobj(speeds):
        return f"the command has complex numbers: {np.asarray(speeds).tolist()}"
    if np.shape(speeds) != (4,):
        return f"the command has shape {np.shape(speeds)}, not (4,)"
    if np.abs(speeds).max() <= LARGEST_SPEED:  # False if one is NaN
        return None
    if not np.all(np.isfinite(speeds)):
        return f"the command is not finite: {np.asarray(speeds).tolist()}"
    return f"the command is beyond any rotor's speed: {np.asarray(speeds).tolist()}"


def counts(answered_by: Mapping[str, int]) -> str:
    """Describe the number of periods per source of the command, largest first.

    For example `607 periods at the unconstrained optimum, no QP; 593 by piqp-multistage`, or `280 periods commanded`.
    """
    texts = {GAIN: "at the unconstrained optimum, no QP", LAW: COMMANDED}
    ranked = sorted(answered_by.items(), key=lambda entry: -entry[1])
    parts: list[str] = []
    for source, count in ranked:
        periods = f"{count}"
        if not parts:
            periods = f"{count} periods"
        text = texts.get(source, f"by {source}")
        parts.append(f"{periods} {text}")
    return "; ".join(parts)
