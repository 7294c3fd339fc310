"""From `[controller]` to a law that flies: the MPCs and their fallback, the baselines, plug-ins.

Each law is imported where it is made, so that no command loads those it does not fly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mpc.answer import ActuatorBounds
from mpc.constraints import Bounds, Constraint, Penalty
from mpc.fallback.settings import USUAL_TILT, FallbackSettings
from mpc.model import hover_model
from mpc.ocp import Objective, Problem, lqr_terminal_weight
from mpc.robust.tightening import SHORTEST_LAG
from mpc.solvers import CORE_OR_PIQP, Solver, make_solver
from quadsim.controller import CORE, Controller
from quadsim.errors import ExportError, InputError, MissingCoreError, ParameterError
from quadsim.state import INDEX, N_STATES, POSITION, STATE_NAMES, Array
from quadsim.vehicle import N_ROTORS, Vehicle
from scenarios.parts.plugin import import_plugin, make_law
from scenarios.schema.baselines import GeometricSpec, LQRSpec, PIDSpec
from scenarios.schema.controller import ConstrainedSpec, ControllerSpec, NonlinearSpec, UnconstrainedSpec
from scenarios.schema.optimisation import ANGLES, BoundedSpec, InputWeightsSpec, SoftSpec, WeightedSpec
from scenarios.schema.plugin import PluginSpec
from scenarios.schema.robust import RobustSpec

if TYPE_CHECKING:
    from mpc.core.numbers import Exportable
    from mpc.obstacles import Shape, Space
    from mpc.robust.controller import RobustMPC
    from mpc.robust.filter import SafetyFilter

FALLBACK_SHARE: Final = 0.8
"""Tilt of the fallback over the tightest bound on it: the controller finds a vehicle that it can take over."""
SMALLEST_TILT: Final = 0.5  # with less the fallback cannot hold against anything, whatever the bounds are [deg]


def make_problem(spec: WeightedSpec, vehicle: Vehicle, period: float) -> Problem:
    """The optimisation of the paper's two controllers."""
    model, objective = hover_model(vehicle, period), make_objective(spec.output_weights, spec.input_weights)
    if spec.terminal == "lqr":
        objective = replace(objective, P=lqr_terminal_weight(model, objective))
    return Problem(
        model=model,
        horizon=spec.horizon,
        objective=objective,
        bounds=make_bounds(spec) if isinstance(spec, BoundedSpec) else None,
        constraints=make_polytopes(spec) if isinstance(spec, BoundedSpec) else (),
    )


def make_objective(output_weights: dict[str, float], input_weights: InputWeightsSpec) -> Objective:
    """C_r, Q_y and Q_u of weights by the states' names."""
    regulated = [name for name in STATE_NAMES if name in output_weights]
    return Objective(
        C_r=_selection(regulated),
        Q_y=np.diag([output_weights[name] for name in regulated]),
        Q_u=np.diag(np.broadcast_to(np.asarray(input_weights.speed, float), N_ROTORS)),
    )


def make_bounds(spec: BoundedSpec) -> Bounds:
    """The bounds in SI units."""
    constrained = [name for name in STATE_NAMES if name in spec.output_bounds]
    scale = np.array([math.radians(1.0) if name in ANGLES else 1.0 for name in constrained])
    lower, upper = scale * np.array([spec.output_bounds[name] for name in constrained], float).reshape(-1, 2).T
    u_min, u_max = (np.full(N_ROTORS, bound) for bound in spec.input_bounds.speed)
    delta_min, delta_max = (np.full(N_ROTORS, bound) for bound in spec.input_bounds.slew)
    C_c = _selection(constrained)
    return Bounds(C_c=C_c, y_min=lower, y_max=upper, delta_min=delta_min, delta_max=delta_max, u_min=u_min, u_max=u_max)


def _three(numbers: float | Sequence[float]) -> tuple[float, float, float]:
    """One number for three axes, or one each, as three."""
    x, y, z = np.broadcast_to(numbers, 3).tolist()
    return x, y, z


def _outputs(spec: NonlinearSpec) -> tuple[Constraint, ...]:
    """`output_bounds` and `polytopes` as rows over the 12 states and four rotor speeds."""
    if not spec.output_bounds:
        return make_polytopes(spec)
    lower, upper = np.array([*spec.output_bounds.values()], float).T
    penalty = None if spec.soft is None else make_penalty(spec.soft, lower.size)
    rows = _selection([*spec.output_bounds])
    return Constraint(name="outputs", lower=lower, upper=upper, C=rows, penalty=penalty), *make_polytopes(spec)


def make_polytopes(spec: BoundedSpec | NonlinearSpec) -> tuple[Constraint, ...]:
    """`[[controller.polytopes]]` as rows over the 12 states and four rotor speeds, each in its own unit."""
    found = []
    for polytope in spec.polytopes:
        rows, count = np.array(polytope.rows, float), len(polytope.rows)
        C, D = np.zeros((count, N_STATES)), np.zeros((count, N_ROTORS))
        for name, column in zip(polytope.of, rows.T, strict=True):
            if name in INDEX:
                C[:, INDEX[name]] = column * (math.degrees(1.0) if name in ANGLES else 1.0)
            else:
                D[:, int(name.removeprefix("speed_")) - 1] = column
        soft = polytope.soft
        found.append(
            Constraint(
                name=polytope.name,
                lower=np.full(count, -math.inf) if polytope.lower is None else np.array(polytope.lower, float),
                upper=np.full(count, math.inf) if polytope.upper is None else np.array(polytope.upper, float),
                C=C,
                D=D,
                penalty=None if soft is None else make_penalty(soft, count),
            )
        )
    return tuple(found)


def make_penalty(soft: SoftSpec, rows: int) -> Penalty:
    """The price of violating each of this many rows."""
    return Penalty(l1=np.full(rows, float(soft.linear)), l2=np.full(rows, float(soft.quadratic)))


def make_controller(spec: ControllerSpec, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Controller:
    """The law, set up and ready to be flown among obstacles and regions.

    Raises:
        InputError: it cannot be made from these numbers, or its code cannot be found or called.
    """
    match spec:
        case UnconstrainedSpec():
            return _compiled(spec, vehicle, period) or _unconstrained(make_problem(spec, vehicle, period))
        case ConstrainedSpec():
            law = _compiled(spec, vehicle, period, shapes) or _constrained(spec, vehicle, period, shapes)
            return law if spec.fallback is None else _bounded(law, spec, spec.fallback, vehicle, period)
        case RobustSpec():
            law = _compiled(spec, vehicle, period, shapes) or _robust(spec, vehicle, period, shapes)
            return _bounded(law, spec, spec.fallback, vehicle, period)
        case NonlinearSpec():
            return _nonlinear(spec, vehicle, period, shapes)
        case LQRSpec() | PIDSpec() | GeometricSpec():
            return _baseline(spec, vehicle, period)
        case PluginSpec():
            return make_law(import_plugin(spec), spec, vehicle, period)


def make_filter(spec: RobustSpec, vehicle: Vehicle, period: float) -> tuple[SafetyFilter, Controller]:
    """The safety filter with a robust MPC's constraints, and the same within its fallback contract, which flies.

    Raises:
        InputError: it cannot be made from these numbers.
    """
    from mpc.robust.filter import SafetyFilter

    if spec.avoidance is not None:
        raise ParameterError(
            "controller", "avoidance", "given", "absent for a safety filter, which keeps no half-spaces"
        )
    found = SafetyFilter(_robust(spec.model_copy(update={"solver": SafetyFilter.solver}), vehicle, period))
    return found, _bounded(found, spec, spec.fallback, vehicle, period)


def posed_problem(spec: BoundedSpec, vehicle: Vehicle, period: float) -> Problem:
    """The optimisation that a law with bounds solves in each period.

    Raises:
        InputError: it cannot be made from these numbers.
    """
    if not isinstance(spec, RobustSpec):
        return make_problem(spec, vehicle, period)
    from mpc.robust.controller import robust_problem

    return robust_problem(**_robust_parts(spec, vehicle, period))


def exportable(spec: ControllerSpec, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Exportable:
    """What a controller that can be exported as C is made from.

    Raises:
        ExportError: it cannot be exported.
        InputError: it cannot be made from these numbers.
    """
    from mpc.core.numbers import Exportable
    from mpc.robust.controller import robust_problem

    if not isinstance(spec, UnconstrainedSpec | ConstrainedSpec | RobustSpec):
        raise ExportError(f"it is {spec.type!r}; exported are unconstrained, constrained and robust")
    if isinstance(spec, BoundedSpec) and spec.avoidance is not None and shapes:
        raise ExportError("its half-spaces around obstacles are others in each period: leave out controller.avoidance")
    if not isinstance(spec, RobustSpec):
        return Exportable(name=spec.type, problem=make_problem(spec, vehicle, period), vehicle=vehicle, settings=None)
    parts = _robust_parts(spec, vehicle, period)
    return Exportable(name=spec.type, problem=robust_problem(**parts), vehicle=vehicle, settings=parts["settings"])


def _compiled(
    spec: UnconstrainedSpec | ConstrainedSpec | RobustSpec,
    vehicle: Vehicle,
    period: float,
    shapes: Sequence[Shape] = (),
) -> Controller | None:
    """The law in C; None where it is to be flown in Python.

    Raises:
        MissingCoreError: there is no library.
        ExportError: this law is not there in C.
    """
    if not spec.compiled:
        return None
    from mpc.core.law import CompiledMPC
    from mpc.core.library import why_missing

    reason = why_missing()
    if reason is not None:
        raise MissingCoreError(reason, instead="leave out controller.compiled")
    return CompiledMPC(exportable(spec, vehicle, period, shapes))


def _bounded(
    law: Controller, spec: BoundedSpec, fallback: FallbackSettings, vehicle: Vehicle, period: float
) -> Controller:
    settings = replace(fallback, tilt=_fallback_tilt(spec, fallback))
    return guarded(law, ActuatorBounds.of(make_bounds(spec)), settings, vehicle, period)


def guarded(
    law: Controller, bounds: ActuatorBounds, fallback: FallbackSettings, vehicle: Vehicle, period: float
) -> Controller:
    """The law within the fallback contract; the law itself where that is switched off."""
    from mpc.fallback.contract import Guarded

    if not fallback.enabled:
        return law
    return Guarded(law, hover_model(vehicle, period), bounds=bounds, settings=fallback)


def _nonlinear(spec: NonlinearSpec, vehicle: Vehicle, period: float, shapes: Sequence[Shape]) -> Controller:
    from mpc.indi import Incremental
    from mpc.nonlinear.controller import NonlinearMPC
    from mpc.nonlinear.rigidbody import Inputs
    from mpc.nonlinear.settings import AttitudeError, NonlinearSettings

    stride = 1 if spec.node is None else round(spec.node / period)
    if spec.node is not None and (stride < 1 or not math.isclose(stride * period, spec.node, rel_tol=1e-9)):
        raise ParameterError("controller", "node", spec.node, f"a whole multiple of the control period of {period} s")
    if spec.horizon % stride:
        raise ParameterError("controller", "horizon", spec.horizon, f"a whole number of nodes, {stride} periods each")
    held = spec.input_bounds
    bounds = ActuatorBounds.alike(
        (vehicle.speed_min, vehicle.speed_max) if held.speed is None else _pair(held.speed),
        (-math.inf, math.inf) if held.slew is None else _pair(held.slew),
    )
    settings = NonlinearSettings(
        horizon=spec.horizon // stride,
        stride=stride,
        iterations=spec.iterations,
        shift=spec.shift,
        substeps=spec.substeps,
        inputs=Inputs(spec.inputs),
        rotor_lag=_rotor_lag(spec, vehicle),
        drag=_three(spec.drag),
        quadratic_drag=_three(spec.quadratic_drag),
        attitude_error=AttitudeError(spec.attitude_error),
        weights=spec.weights,
        terminal=0.0 if spec.terminal == "none" else spec.terminal,
        tilt=None if spec.tilt is None else math.radians(spec.tilt),
        largest_rates=_three(math.inf if spec.body_rate is None else np.radians(spec.body_rate).tolist()),
        soft=None if spec.soft is None else (spec.soft.linear, spec.soft.quadratic),
        observer=spec.offset_free,
        ramp=spec.disturbance,
        solver=spec.solver,
    )
    mpc = NonlinearMPC(
        vehicle,
        period=period,
        settings=settings,
        bounds=bounds,
        constraints=_outputs(spec),
        space=make_space(spec, vehicle, period, shapes, stride=stride),
        kkt_every=spec.kkt_every,
    )
    law = guarded(mpc, bounds, spec.fallback, vehicle, period)
    return law if spec.indi is None else Incremental(law, vehicle, spec.indi, bounds)


def make_space(
    spec: BoundedSpec | NonlinearSpec,
    vehicle: Vehicle,
    period: float,
    shapes: Sequence[Shape],
    margins: Array | None = None,
    stride: int = 1,
) -> Space | None:
    """The half-spaces of obstacles and regions, with further margins (N, 3) [m], at every `stride`-th period's end.

    None where they are not recorded.
    """
    if spec.avoidance is None or not shapes:
        return None
    from mpc.obstacles import Space

    soft = spec.avoidance.soft
    return Space(
        shapes,
        radius=vehicle.enclosing_radius,
        period=stride * period,
        horizon=spec.horizon // stride,
        settings=spec.avoidance,
        margins=margins,
        penalty=None if soft is None else (soft.linear, soft.quadratic),
        positions=(0, 1, 2) if isinstance(spec, NonlinearSpec) else POSITION,
        largest=isinstance(spec, NonlinearSpec),
    )


def _constrained(spec: ConstrainedSpec, vehicle: Vehicle, period: float, shapes: Sequence[Shape]) -> Controller:
    from mpc.constrained import ConstrainedMPC

    problem, space = make_problem(spec, vehicle, period), make_space(spec, vehicle, period, shapes)
    return ConstrainedMPC(problem, _solver(spec, problem, space), space=space, kkt_every=spec.kkt_every)


def _solver(spec: BoundedSpec, problem: Problem, space: Space | None) -> Solver:
    if space is not None and spec.solver == CORE:
        rule = "a QP solver such as 'piqp' with controller.avoidance: half-spaces differ from step to step"
        raise ParameterError("controller", "solver", CORE, rule)
    return make_solver("piqp" if space is not None and spec.solver == CORE_OR_PIQP else spec.solver, problem)


def _unconstrained(problem: Problem) -> Controller:
    from mpc.unconstrained import UnconstrainedMPC

    try:
        return UnconstrainedMPC(problem)
    except np.linalg.LinAlgError as error:
        raise InputError(
            "the controller's gain cannot be computed: its weights and the vehicle's numbers are too many orders of "
            f"magnitude apart ({error})"
        ) from error


def _robust_parts(spec: RobustSpec, vehicle: Vehicle, period: float) -> dict[str, Any]:
    """What the robust MPC and its problem are made of."""
    from mpc.robust.settings import RobustSettings

    settings = RobustSettings(
        penalty=None if spec.soft is None else make_penalty(spec.soft, len(spec.output_bounds)),
        rotor_lag=_rotor_lag(spec, vehicle),
        delay=spec.delay,
        observer=spec.offset_free,
        heading=spec.heading,
        largest_turn=math.radians(spec.largest_turn),
        move_weight=None if spec.move_weight is None else spec.move_weight * np.eye(N_ROTORS),
        terminal=spec.terminal == "lqr",
        margins=tightening_margins(spec, vehicle, period),
    )

    return {
        "vehicle": vehicle,
        "period": period,
        "horizon": spec.horizon,
        "objective": make_objective(spec.output_weights, spec.input_weights),
        "bounds": make_bounds(spec),
        "settings": settings,
        "constraints": make_polytopes(spec),
    }


def _robust(spec: RobustSpec, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> RobustMPC:
    from mpc.robust.controller import RobustMPC, robust_problem
    from mpc.robust.tightening import position_margins

    margins = None  # by which half-spaces are tightened along x, y, z at each predicted state, (N, 3) [m]
    if spec.tightening is not None and spec.avoidance is not None:
        margins = position_margins(**_tightened(spec, vehicle, period))
    space, parts = make_space(spec, vehicle, period, shapes, margins), _robust_parts(spec, vehicle, period)
    problem = robust_problem(**parts)
    solver = _solver(spec, problem, space)
    return RobustMPC(vehicle, problem, parts["settings"], solver, space=space, kkt_every=spec.kkt_every)


def tightening_margins(spec: RobustSpec, vehicle: Vehicle, period: float) -> Array | None:
    """By how much the output bounds are tightened at each predicted state, (N, n_c); None where they are not.

    Raises:
        ParameterError: they cannot be.
    """
    if spec.tightening is None:
        return None
    from mpc.robust.tightening import margins

    return margins(bounds=make_bounds(spec), **_tightened(spec, vehicle, period))


def _tightened(spec: RobustSpec, vehicle: Vehicle, period: float) -> dict[str, Any]:
    """What tightened bounds follow from."""
    return {
        "vehicle": vehicle,
        "period": period,
        "horizon": spec.horizon,
        "settings": spec.tightening,
        "rotor_lag": _rotor_lag(spec, vehicle),
        "delay": spec.delay,
        "estimated": spec.offset_free is not None,
    }


def _baseline(spec: LQRSpec | PIDSpec | GeometricSpec, vehicle: Vehicle, period: float) -> Controller:
    from mpc.baselines.geometric import GeometricController, geometric_settings
    from mpc.baselines.lqr import LQR, LQRSettings, bryson_objective
    from mpc.baselines.pid import CascadedPID, pid_settings
    from mpc.indi import Incremental

    held = spec.input_bounds
    bounds = None if held is None else ActuatorBounds.alike(_pair(held.speed), _pair(held.slew))
    shared: dict[str, Any] = {"period": period, "horizon": spec.horizon, "tilt_max": spec.tilt, "bounds": bounds}
    if isinstance(spec, LQRSpec):
        objective = bryson_objective(vehicle, period)
        if spec.output_weights is not None and spec.input_weights is not None:
            objective = make_objective(spec.output_weights, spec.input_weights)
        return LQR(vehicle, LQRSettings(objective=objective, heading_frame=spec.heading, **shared))
    shared["lag"] = spec.lag
    if isinstance(spec, PIDSpec):
        return CascadedPID(vehicle, pid_settings(vehicle, velocity_max=spec.velocity, **shared))
    settings = geometric_settings(
        vehicle,
        integral=spec.integral,
        feedforward=spec.feedforward,
        drag=tuple(spec.drag),
        disturbance=spec.disturbance,
        **shared,
    )
    geometric = GeometricController(vehicle, settings)
    return geometric if spec.indi is None else Incremental(geometric, vehicle, spec.indi, geometric.bounds)


def _rotor_lag(spec: RobustSpec | NonlinearSpec, vehicle: Vehicle) -> float:
    if spec.rotor_lag != "vehicle":
        return spec.rotor_lag
    if vehicle.rotor_rise is None:
        rule = f"a number of seconds where the vehicle has no rotor_rise, and {vehicle.name} has none"
        raise ParameterError("controller", "rotor_lag", spec.rotor_lag, rule)
    if 0.0 < vehicle.rotor_rise < SHORTEST_LAG:
        rule = f"a number of seconds where the vehicle's rotor_rise is below {SHORTEST_LAG:g} s, as {vehicle.name}'s is"
        raise ParameterError("controller", "rotor_lag", spec.rotor_lag, rule)
    return vehicle.rotor_rise


def _fallback_tilt(spec: BoundedSpec, fallback: FallbackSettings) -> float:
    """The fallback's largest tilt [deg]."""
    if fallback.tilt is not None:
        return fallback.tilt
    pairs = (spec.output_bounds[name] for name in ("roll", "pitch") if name in spec.output_bounds)
    tightest = min((FALLBACK_SHARE * min(-lower, upper) for lower, upper in pairs), default=USUAL_TILT)
    return min(max(tightest, SMALLEST_TILT), USUAL_TILT)


def _pair(bounds: Sequence[float]) -> tuple[float, float]:
    lower, upper = bounds
    return lower, upper


def _selection(names: Sequence[str]) -> Array:
    """Rows of the identity that pick states by name."""
    return np.eye(N_STATES)[[INDEX[name] for name in names]]
