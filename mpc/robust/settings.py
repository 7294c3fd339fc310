"""`[controller] type = "robust"`: the MPC for vehicles as they are, each part a field of its own."""

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

TURNED: Final = frozenset({"x", "vx", "y", "vy", "yaw"})  # states that have other values in axes turned by the yaw

LONGEST_SPAN: Final = 0.25
"""Longest time between two measured states [s] for their difference to show a disturbance; a sensor of 4 Hz."""


@dataclass(frozen=True, kw_only=True)
class RobustSettings:
    """The parts of the robust controller; each absent or off unless given."""

    penalty: Penalty | None = None  # what leaving an output bound costs; None for hard output bounds
    rotor_lag: float = 0.0  # time constant of the rotor speeds that the prediction knows [s]; 0 for none
    delay: float = 0.0  # time from measurement to command that the prediction bridges [s]
    observer: ObserverSettings | None = None  # of the disturbance observer; None for no offset-free tracking
    heading: bool = False
    """Whether the hover model is turned by the yaw.  The weights of x and y are then those forward and to the left;
    where these differ, flights to different headings do."""
    largest_turn: float = 0.5
    """How far the prediction may turn at once [rad], from the present yaw or from one period to the next; it goes on
    from there.  Of no effect on the hover model without `heading`."""
    move_weight: Array | None = None  # Q_d (4, 4), of a command's change from one period to the next; None for none
    margins: Array | None = None  # (N, n_c) by which the output bounds are tightened; None for none
    terminal: bool = False  # whether the last state has the weight of the hover model's LQR


@dataclass(frozen=True, kw_only=True)
class Robust(Bounded):
    """The robust MPC: soft bounds, lag, delay, disturbances, heading and more, each switched on alone."""

    type: Annotated[Literal["robust"], doc("the control law, by its name in `quadsim list`")] = "robust"
    soft: Soft | None = None
    rotor_lag: Annotated[
        Lag,
        doc(
            "[s] time constant of the rotor speeds that is predicted, 0 for none; "
            '"vehicle": the rotor_rise of the vehicle'
        ),
    ] = 0.0
    delay: Annotated[Seconds, doc("[s] known time from measurement to command that is predicted through")] = 0.0
    offset_free: ObserverSettings | None = None
    tightening: TighteningSettings | None = None
    heading: Annotated[bool, doc("whether the hover model is turned by the present yaw")] = False
    largest_turn: Annotated[
        float,
        Gt(0.0),
        Le(180.0),
        doc("[deg] largest step of the yaw reference, from the present yaw or from one period to the next"),
    ] = 30.0
    move_weight: Annotated[
        Weight | None, doc("[1/(rad/s)^2] diagonal of Q_d, of a command's change from one period to the next")
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
        """The safety filter with these constraints, and the same within its fallback contract, which flies.

        Raises:
            InputError: it cannot be made from these numbers.
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
        """The same parts in SI units."""
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
        """By how much the output bounds are tightened at each predicted state, (N, n_c); None where they are not.

        Raises:
            ParameterError: they cannot be.
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
        """What tightened bounds follow from."""
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

        margins = None  # by which half-spaces are tightened along x, y, z at each predicted state, (N, 3) [m]
        if self.tightening is not None and self.avoidance is not None:
            margins = position_margins(**self._tightened(vehicle, period))
        space, settings = self.space(shapes, vehicle, period, margins), self.settings(vehicle, period)
        problem = self._robust_problem(vehicle, period, settings)
        solver = self.make_solver(problem, space)
        return RobustMPC(vehicle, problem, settings, solver, space=space, kkt_every=self.kkt_every)
