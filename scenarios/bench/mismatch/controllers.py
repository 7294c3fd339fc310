"""The controllers that `quadsim bench ladder` flies, as `[controller]` tables made from a constrained one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, NamedTuple

from mpc.observer import ObserverSettings
from mpc.robust.tightening import TighteningSettings
from quadsim.errors import InputError
from scenarios.bench.mismatch.conditions import Condition
from scenarios.schema.baselines import GeometricSpec, LQRSpec, PIDSpec
from scenarios.schema.controller import ConstrainedSpec, ControllerSpec, shared_tilt_bound
from scenarios.schema.optimisation import InputBoundsSpec, InputWeightsSpec, SoftSpec
from scenarios.schema.robust import RobustSpec
from scenarios.schema.scenario import Scenario

INPUT_WEIGHT: Final = 0.1
"""Of the robust controllers, ten times the paper's: with its 0.01, rotor lag that the model misjudges is amplified."""
MOVE_WEIGHT: Final = 20.0
OBSERVER: Final = ObserverSettings(torque_walk=0.2, force_walk=0.1)
BASELINE_TILT: Final = 20.0
"""Largest tilt that LQR, PID and geometric controller command [deg].  They have no bounds on states, so this limit does
for one; at the paper's 5 deg the geometric controller circles its goal, 8 m off after 60 s."""
_NO_STEPS: Final = 1e6  # a bound on steps [rad/s] that bounds nothing


class ControllerVariant(NamedTuple):
    """A controller of the benchmark."""

    about: str  # what it is, in a line
    # its table, from a constrained one and what a condition lets it know
    spec: Callable[[ConstrainedSpec, Condition, float], ControllerSpec]


def equip(scenario: Scenario, controller: str, condition: Condition) -> Scenario:
    """The scenario flown by another controller of `VARIANTS`, with the parameters that the condition lets it know.

    Raises:
        InputError: the scenario's own controller is no constrained one with the same bounds on roll and pitch.
    """
    tilt_bound(scenario)
    assert isinstance(scenario.controller, ConstrainedSpec)
    spec = VARIANTS[controller].spec(scenario.controller, condition, scenario.control_period)
    return scenario.model_copy(update={"controller": spec})


def tilt_bound(scenario: Scenario) -> float:
    """The bound on roll and pitch alike [deg].

    Raises:
        InputError: the scenario's controller has none.
    """
    spec = scenario.controller
    bound = shared_tilt_bound(spec) if isinstance(spec, ConstrainedSpec) else None
    if bound is None:
        raise InputError(
            f"{scenario.name}: the mismatch benchmark needs a constrained controller whose output_bounds of roll and "
            "pitch are the same, as paper-constrained has"
        )
    return bound


def _robust(*, modelled: bool = True, **parts: Any) -> Callable[[ConstrainedSpec, Condition, float], RobustSpec]:
    """The robust controller with soft bounds, with or without a model of lag, delay and heading, and other parts."""

    def make(spec: ConstrainedSpec, condition: Condition, period: float) -> RobustSpec:
        known: dict[str, Any] = {}
        if modelled:
            known = {"rotor_lag": condition.rotor_lag, "delay": condition.delay, "heading": True}
        return RobustSpec(
            type="robust",
            horizon=spec.horizon,
            output_weights=spec.output_weights,
            input_weights=InputWeightsSpec(speed=INPUT_WEIGHT),
            output_bounds=spec.output_bounds,
            input_bounds=spec.input_bounds,
            soft=SoftSpec(),
            move_weight=MOVE_WEIGHT,
            **known,
            **parts,
        )

    return make


def _lqr(spec: ConstrainedSpec, condition: Condition, period: float) -> LQRSpec:
    return LQRSpec(type="lqr", tilt=BASELINE_TILT, input_bounds=_speeds_alone(spec))


def _pid(spec: ConstrainedSpec, condition: Condition, period: float) -> PIDSpec:
    lag = _known_lag(condition, period)
    return PIDSpec(type="pid", lag=lag, tilt=BASELINE_TILT, input_bounds=_speeds_alone(spec))


def _geometric(spec: ConstrainedSpec, condition: Condition, period: float) -> GeometricSpec:
    lag, bounds = _known_lag(condition, period), _speeds_alone(spec)
    return GeometricSpec(type="geometric", lag=lag, tilt=BASELINE_TILT, integral=True, input_bounds=bounds)


def _known_lag(condition: Condition, period: float) -> float | None:
    """Lag that gains allow for [s], half a period at least; None where neither lag nor delay is known."""
    if not condition.rotor_lag and not condition.delay:
        return None
    return max(0.5 * period, condition.rotor_lag) + condition.delay


def _speeds_alone(spec: ConstrainedSpec) -> InputBoundsSpec:
    return InputBoundsSpec(speed=spec.input_bounds.speed, slew=[-_NO_STEPS, _NO_STEPS])


VARIANTS: Final = {
    "paper": ControllerVariant(
        "the paper's constrained MPC, hard bounds, no fallback", lambda spec, condition, period: spec
    ),
    "soft": ControllerVariant(
        f"soft bounds on tilt, input weight {INPUT_WEIGHT:g}, move weight {MOVE_WEIGHT:g}; guarded, as are all "
        "variants that build on it",
        _robust(modelled=False),
    ),
    "+ model": ControllerVariant("and a prediction that knows rotor lag, delay and heading", _robust()),
    "+ offset-free": ControllerVariant("and disturbances estimated", _robust(offset_free=OBSERVER)),
    "+ tightening": ControllerVariant(
        "and output bounds tightened for disturbances and for the motion between samples",
        _robust(offset_free=OBSERVER, tightening=TighteningSettings()),
    ),
    "LQR": ControllerVariant(
        "infinite horizon, weights by Bryson's rule, in the heading frame; as the next two, it has no bounds but those "
        f"on speeds, and commands no more than {BASELINE_TILT:g} deg of tilt",
        _lqr,
    ),
    "PID": ControllerVariant("cascaded, as autopilots fly it; gains from the lag it is given", _pid),
    "geometric": ControllerVariant(
        "on SE(3) with integrals (Goodarzi, Lee, Lee, 2013); gains from the lag it is given", _geometric
    ),
}
"""By their names in tables, in order.  The last three keep the bounds on speeds and no others: held to the paper's
bounds on steps, which it knows nothing of, the LQR overturns on the nominal course."""
FULL: Final = "+ tightening"  # the one with all differences from the paper's
QUICK_VARIANTS: Final = ("paper", "+ offset-free", "PID")
