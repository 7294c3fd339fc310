"""`[controller] type = "robust"`: the MPC for imperfect vehicles, one field per part."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import numpy as np
from annotated_types import Gt, Le, doc

from mpc.bounded import (
    USUAL_FALLBACK,
    Bounded,
    FallbackSettings,
    Lag,
    Seconds,
    Soft,
    objective_of,
    require_lag,
    resolved_lag,
)
from mpc.constraints import Penalty
from mpc.observer import ObserverSettings
from mpc.robust.tightening import TighteningSettings, margins, position_margins
from quadsim.controller import Controller
from quadsim.errors import ParameterError
from quadsim.fields import Weight
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS, Vehicle

if TYPE_CHECKING:
    from mpc.core.numbers import Exportable
    from mpc.obstacles import Shape
    from mpc.ocp import Problem
    from mpc.robust.controller import RobustMPC
    from mpc.robust.filter import SafetyFilter

TURNED: Final = frozenset({"x", "vx", "y", "vy", "yaw"})  # states that depend on the yaw of the axes

LONGEST_SPAN: Final = 0.25
"""Longest time between two measured states [s] that the observer compares; a sensor of 4 Hz."""


@dataclass(frozen=True, kw_only=True)
class RobustSettings:
    """The parts of the robust controller; each is off by default."""

    penalty: Penalty | None = None  # penalty for violating an output bound; None for hard output bounds
    rotor_lag: float = 0.0  # rotor time constant in the prediction [s]; 0 for none
    delay: float = 0.0  # delay from measurement to command that the prediction bridges, see `split_delay` [s]
    observer: ObserverSettings | None = None  # settings of the disturbance observer; None for no offset-free tracking
    heading: bool = False
    """Whether the hover model is turned by the yaw.  The weights of x and y then apply forward and to the left; if they
    differ, so do flights at different headings."""
    largest_turn: float = 0.5
    """Largest predicted step of the yaw [rad], from the measured yaw or from one period to the next.  Without effect on
    the hover model unless `heading` is set."""
    move_weight: Array | None = None  # Q_d (4, 4), weight of command changes from period to period; None for none
    margins: Array | None = None  # (N, n_c) tightening of the output bounds; None for none
    terminal: bool = False  # whether the last state has the hover model's LQR weight


def split_delay(delay: float, period: float) -> tuple[int, float]:
    """Split a delay [s] into n whole periods and the rest, which is at most a period and zero only without delay.

    At t_k the commands u(k-n) .. u(k-1) are under way, and u(k-1-n) is in force for that rest.
    """
    whole = max(math.ceil(delay / period - 1e-9) - 1, 0)
    return whole, delay - whole * period


@dataclass(frozen=True, kw_only=True)
class Robust(Bounded):
    """The robust MPC: soft bounds, rotor lag, delay, disturbances, heading and more, each switched on separately."""

    type: Annotated[Literal["robust"], doc("the control law, by its name in `quadsim list`")] = "robust"
    soft: Soft | None = None
    rotor_lag: Annotated[
        Lag,
        doc('[s] rotor time constant in the prediction, 0 for none; "vehicle": the rotor_rise of the vehicle'),
    ] = 0.0
    delay: Annotated[
        Seconds,
        doc("[s] known delay from measurement to command, bridged by prediction; at most the horizon"),
    ] = 0.0
    offset_free: ObserverSettings | None = None
    tightening: TighteningSettings | None = None
    heading: Annotated[bool, doc("whether the hover model is turned by the measured yaw")] = False
    largest_turn: Annotated[
        float,
        Gt(0.0),
        Le(180.0),
        doc("[deg] largest step of the yaw reference, from the measured yaw or from one period to the next"),
    ] = 30.0
    move_weight: Annotated[
        Weight | None, doc("[1/(rad/s)^2] diagonal of Q_d, weight of command changes from period to period")
    ] = None
    fallback: FallbackSettings = USUAL_FALLBACK

    def __post_init__(self) -> None:
        super().__post_init__()
        require_lag(self.rotor_lag)
        if self.tightening is not None and not self.output_bounds:
            raise ValueError("tightening must be absent where there are no output_bounds to tighten")
        if self.heading:
            bounded = {
                "output_bounds": [*self.output_bounds],
                **{polytope.name: polytope.of for polytope in self.polytopes},
            }
            for name, states in bounded.items():
                turned = [state for state in states if state in TURNED]
                if turned:
                    raise ValueError(
                        f"{name} must not be of {', '.join(turned)} where heading turns the model: "
                        'heading = false, or type = "nonlinear"'
                    )

    def build(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Controller:
        """See `mpc.bounded.ControllerTable.build`."""
        law = self.in_c(vehicle, period, shapes) or self._mpc(vehicle, period, shapes)
        return self.guarded(law, self.fallback, vehicle, period)

    def safety_filter(self, vehicle: Vehicle, period: float) -> tuple[SafetyFilter, Controller]:
        """Return the safety filter with these constraints, and the same within its fallback contract, to fly.

        Raises:
            InputError: no filter can be built from these numbers.
        """
        from mpc.robust.filter import SafetyFilter

        if self.avoidance is not None:
            rule = "absent for a safety filter, which keeps no half-spaces"
            raise ParameterError("controller", "avoidance", "given", rule)
        law = SafetyFilter(replace(self, solver=SafetyFilter.solver)._mpc(vehicle, period))
        return law, self.guarded(law, self.fallback, vehicle, period)

    def problem(self, vehicle: Vehicle, period: float) -> Problem:
        """See `mpc.bounded.Weighted.problem`."""
        return self._robust_problem(vehicle, period, self.settings(vehicle, period))

    def exportable(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Exportable:
        """See `mpc.bounded.Weighted.exportable`."""
        return replace(super().exportable(vehicle, period, shapes), settings=self.settings(vehicle, period))

    def settings(self, vehicle: Vehicle, period: float) -> RobustSettings:
        """Return the same parts in SI units."""
        return RobustSettings(
            penalty=None if self.soft is None else self.soft.penalty(len(self.output_bounds)),
            rotor_lag=resolved_lag(self.rotor_lag, vehicle),
            delay=self.delay,
            observer=self.offset_free,
            heading=self.heading,
            largest_turn=math.radians(self.largest_turn),
            move_weight=None if self.move_weight is None else self.move_weight * np.eye(N_ROTORS),
            terminal=self.terminal == "lqr",
            margins=self.margins(vehicle, period),
        )

    def margins(self, vehicle: Vehicle, period: float) -> Array | None:
        """Return the tightening of the output bounds at each predicted state, (N, n_c); None without tightening.

        Raises:
            ParameterError: the bounds are too narrow for it.
        """
        if self.tightening is None:
            return None
        return margins(bounds=self.bounds(), **self._tightened(vehicle, period))

    def _robust_problem(self, vehicle: Vehicle, period: float, settings: RobustSettings) -> Problem:
        from mpc.robust.controller import robust_problem

        return robust_problem(
            vehicle,
            period=period,
            horizon=self.horizon,
            objective=objective_of(self.output_weights, self.input_weights),
            bounds=self.bounds(),
            settings=settings,
            constraints=self.constraints(),
        )

    def _tightened(self, vehicle: Vehicle, period: float) -> dict[str, Any]:
        """Return the inputs of the tightening."""
        return {
            "vehicle": vehicle,
            "period": period,
            "horizon": self.horizon,
            "settings": self.tightening,
            "rotor_lag": resolved_lag(self.rotor_lag, vehicle),
            "delay": self.delay,
            "estimated": self.offset_free is not None,
        }

    def _mpc(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> RobustMPC:
        from mpc.robust.controller import RobustMPC

        margins = None  # tightening of half-spaces along x, y, z at each predicted state, (N, 3) [m]
        if self.tightening is not None and self.avoidance is not None:
            margins = position_margins(**self._tightened(vehicle, period))
        space, settings = self.space(shapes, vehicle, period, margins), self.settings(vehicle, period)
        problem = self._robust_problem(vehicle, period, settings)
        solver = self.make_solver(problem, space)
        return RobustMPC(vehicle, problem, settings, solver, space=space, kkt_every=self.kkt_every)
