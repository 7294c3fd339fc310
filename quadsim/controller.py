"""What a controller is to the testbed: one protocol, one answer per control period."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final, NamedTuple, Protocol

import numpy as np

from quadsim.motion import Motion
from quadsim.state import Array

SOLVED: Final = "solved"  # status of a period whose optimum a QP solver or the core found
UNCONSTRAINED: Final = "unconstrained"
"""Status of a period whose unconstrained optimum satisfies every constraint, and so is the constrained one too."""
COMMANDED: Final = "commanded"  # status of a period in which a law without a solver commanded
NOT_CONVERGED: Final = "not_converged"
"""Status of a period whose QP was solved, but whose plan does not follow the nonlinear dynamics that it linearises."""
OPTIMAL: Final = frozenset({SOLVED, UNCONSTRAINED, COMMANDED})  # the statuses whose command is the law's own answer
ACCEPTED: Final = OPTIMAL | {NOT_CONVERGED}  # the statuses whose command is flown as answered
MISSED: Final = "missed"
"""Status of a period whose command came after the next period's begin: the one before it went on acting."""
GAIN: Final = "gain"  # who answered a period: the unconstrained optimum, a product with constant gains
CORE: Final = "core"  # the exact optimum of `mpc.core`, compiled
LAW: Final = "law"  # a law without a solver
FALLBACK: Final = "fallback"  # an earlier plan or command, or the fallback contract
STOPPED: Final = "stopped"  # nobody: rotors are off
NO_SOLVER: Final = frozenset({GAIN, CORE, LAW, FALLBACK, STOPPED})
"""Who may answer besides QP solvers, which go by their names (`mpc.solvers.find_solver`)."""
LAW_NAMES: Final = {
    "unconstrained": "unconstrained MPC",
    "constrained": "constrained MPC",
    "robust": "robust MPC",
    "nonlinear": "nonlinear MPC",
    "lqr": "LQR",
    "pid": "PID",
    "geometric": "geometric control",
}
"""What controllers are called where people read, by the names that they record; others go by their own."""
LARGEST_SPEED: Final = 1e5
"""Largest magnitude of a rotor speed command [rad/s] that is taken for a command rather than for a fault."""


class Signals(Protocol):
    """Records what a controller logs; see `quadsim.flight.log.LoggedSignals`."""

    def log(self, name: str, value: float, unit: str) -> None:
        """See `StepInputs.log`."""
        ...


class Phase(StrEnum):
    """Where a flight stands with the ground; without a ground it is `flying` throughout."""

    LANDED = "landed"  # on the ground, rotors off or on their way there
    ARMED = "armed"  # on the ground, rotors spinning up for take-off
    FLYING = "flying"
    CRASHED = "crashed"  # something other than the feet touched the ground; what follows is recorded, not controlled


@dataclass(frozen=True, kw_only=True)
class StepInputs:
    """When a controller is called, and what it may use besides the measured state.

    Attributes:
        time: t_k [s].
        phase: where the flight stands with the ground.
        acting: (4,) command in force at t_k, u(k-1) [rad/s]; None where it is the controller's own last one.
        attitude: (4,) measured quaternion wxyz, body to world, sign continuous from period to period; None where it is
            to be derived from the state.
        body_rates: (3,) measured body rates [rad/s]; None as before.
        motion: the reference from t_k on, where the course knows more than x, y, z, yaw.
        signals: where `log` writes; None where nothing records.

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
    signals: Signals | None = field(default=None, repr=False, compare=False)

    def log(self, name: str, value: float, unit: str = "-") -> None:
        """Record a number of this period: a column of flight.parquet, and `flight.logged[name]`.

        Args:
            name: an identifier that is no column of flight.parquet; logged twice in a period, the last value counts.
            value: finite, or NaN, which periods without a value have.
            unit: stored with the column.

        Raises:
            ParameterError: the name or the value is not allowed; it ends the flight.
        """
        if self.signals is not None:
            self.signals.log(name, value, unit)


class InnerLoop(Protocol):
    """A loop inside the control period, faster than it: from commanded rotor speeds to those that rotors are given."""

    @property
    def rate(self) -> float:
        """How often it is called [Hz]; a whole number of physics steps apart, the first time when a hold begins."""
        ...

    def speeds(self, time: float, commanded: Array, rates: Array, rotors: Array) -> Array:
        """The rotor speeds (4,) to hold until the next call; all speeds in rad/s, `rates` (3,) the true body rates."""
        ...


class SQP(NamedTuple):
    """How far sequential quadratic programming is from convergence, in the model's own units: m, m/s, rad/s and shares.

    A solved QP says nothing about either.
    """

    defect: float  # largest |x_{i+1} - f(x_i, u_i)| of the plan, over its nodes and the states' components
    step: float  # largest change of a state or an input in the last iteration


@dataclass(frozen=True, kw_only=True)
class Command:
    """A controller's answer for one period, and how it was found.

    Attributes:
        speeds: (4,) rotor speeds to hold for the period [rad/s].
        plan: (N, 4) planned speeds, `plan[0]` being this period's [rad/s].
        status: `solved`, `unconstrained`, `commanded` or `not_converged` (`ACCEPTED`), `landed` or `crashed` where
            rotors are stopped, or what the back end calls what went wrong.
        answered_by: who found `speeds`: `gain`, `core`, a QP solver by its name, `law`, `fallback` or `stopped`.
        iterations: those of whoever answered; of the refused answer in a fallback; 0 for a closed form.
        active: number of constraints active at the optimum.
        fallback: 0 when `speeds` is this period's optimum, higher = deeper; 1 = the shifted previous plan, or
            the last command, where that goes on for one that missed its deadline.
        slack: largest softening of an output bound [rad]; 0 while all bounds are hard.
        reported_primal: largest constraint violation that the QP solver reports [its own scaling]; of this and all
            below: NaN where there is none.
        reported_dual: largest gradient of the Lagrangian that the QP solver reports [its own scaling].
        infeasibility: largest violation of the problem's rows by the plan, soft rows less their slack [row's unit].
        kkt_stationarity: largest entry of the Lagrangian's gradient, computed from the QP.
        kkt_complementarity: largest product of a multiplier and the distance to its bound, likewise.
        kkt_dual: largest multiplier whose sign belongs to no bound, likewise.
        solve_s: wall time inside the solver [s].
        sqp: residual of sequential quadratic programming; None for laws without.
        inner: the inner loop that carries out commands from now on; None for rotors that hold `speeds`.

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
    iterations: int = 0
    active: int = 0
    fallback: int = 0
    slack: float = 0.0
    reported_primal: float = math.nan
    reported_dual: float = math.nan
    infeasibility: float = math.nan
    kkt_stationarity: float = math.nan
    kkt_complementarity: float = math.nan
    kkt_dual: float = math.nan
    solve_s: float = 0.0
    sqp: SQP | None = None
    inner: InnerLoop | None = None


GROUNDED: Final = frozenset({Phase.LANDED, Phase.CRASHED})
"""The phases in which a controller stops the rotors instead of flying."""


def stopped(speeds: Array, horizon: int, phase: Phase) -> Command:
    """The command of a controller whose rotors stand still, or are about to: `speeds` (4,), status `phase`."""
    return Command(speeds=speeds, plan=np.tile(speeds, (horizon, 1)), status=str(phase), answered_by=STOPPED)


class Controller(Protocol):
    """A feedback law run once per control period.

    One that takes over in flight may have a method `adopt(previous)`, called after `reset` with the controller before
    it, from which it may copy what it has learnt and planned.
    """

    @property
    def name(self) -> str:
        """Short name of the law."""
        ...

    @property
    def solver(self) -> str:
        """Name of the QP solver; empty for a closed form."""
        ...

    @property
    def horizon(self) -> int:
        """N, how many samples of preview `step` is given."""
        ...

    def reset(self, speeds: Array) -> None:
        """Forget the past: the next step is the first, after `speeds` u(-1) (4,) [rad/s]."""
        ...

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """The command for the period that starts now, of a measured state xi(k) (12,).

        The reference (N, 4) is filtered x, y, z [m], yaw [rad] at t_{k+1} .. t_{k+N}.

        Raises:
            FlightError: no command can be given.
        """
        ...

    def predict(self, states: Array, plans: Array) -> Array:
        """Predicted states (K, N, 12) for K measured states (K, 12) and plans (K, N, 4), as the controller saw them.

        For pictures alone.  A controller without a model may lack it, and then flies without `horizon.parquet`.
        """
        ...


def check_command(speeds: Array) -> str | None:
    """What is wrong with rotor speeds that are about to reach the plant, or None."""
    if np.shape(speeds) != (4,):
        return f"the command has shape {np.shape(speeds)}, not (4,)"
    if np.abs(speeds).max() <= LARGEST_SPEED:  # which no NaN is
        return None
    if not np.all(np.isfinite(speeds)):
        return f"the command is not finite: {np.asarray(speeds).tolist()}"
    return f"the command is beyond any rotor's speed: {np.asarray(speeds).tolist()}"


def law_name(recorded: str) -> str:
    """What a controller is called where people read, by the name in a run's summary."""
    return LAW_NAMES.get(recorded, recorded)


def counts(answered_by: Mapping[str, int]) -> str:
    """Periods by who answered them, most first: `607 gain, 593 piqp-multistage`; `280 commanded`."""
    ranked = sorted(answered_by.items(), key=lambda entry: -entry[1])
    return ", ".join(f"{count} {COMMANDED if by == LAW else by}" for by, count in ranked)
