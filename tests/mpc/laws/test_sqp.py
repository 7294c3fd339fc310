"""The programs of the nonlinear law, solved in C: KKT residuals, another solver, other starts, infeasible ones."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from ocp_peer import Period, dense_qp

from quadsim.assets import vehicle_path
from quadsim.controller import ACCEPTED, OPTIMAL, SOLVED, UNCONSTRAINED, Command, StepInputs
from quadsim.errors import ParameterError
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.guard.structs import STATUSES
from quadsim.mpc.laws.nonlinear import Nonlinear, Weights
from quadsim.mpc.laws.parts.nonlinear_mpc import NonlinearMPC
from quadsim.mpc.laws.parts.sqp import OWN_NAMES
from quadsim.mpc.problem.constraints import Constraint, Soft
from quadsim.mpc.problem.ocp import Query
from quadsim.mpc.problem.polytope import Polytope
from quadsim.mpc.problem.qp import kkt_residuals
from quadsim.mpc.problem.rigidbody import N_BODY, P, Q, V, W
from quadsim.mpc.solvers.daqp import DaqpDense
from quadsim.mpc.space import Avoidance, Space
from quadsim.space import Sphere
from quadsim.state import INDEX, N_STATES, POSITIONS, VELOCITIES, Array
from quadsim.vehicle import load_vehicle

VEHICLE = replace(
    load_vehicle(vehicle_path("hummingbird")),
    **{"rotor_moment": (2e-5, -3e-5), "inflow_moment": (3e-3, -4e-3), "rate_damping": (0.01, 0.02, 0.03)},
    inflow=4e-4,
)
PERIOD = 0.02
HOVER = np.full(4, VEHICLE.hover_speed)
RATES: dict[str, Any] = {"commands": "rates", "inner_lag": (0.03, 0.02, 0.02, 0.05), "tilt": 15.0, "body_rate": 40.0}
FENCE = Polytope(name="fence", of=("x", "vy", "z"), rows=((1.0, 0.5, 0.0), (0.0, 0.0, 1.0)), upper=(0.3, 0.2))
LIFT = Polytope(
    name="lift", of=("vz", *(f"speed_{i}" for i in range(1, 5))), rows=((40.0, 1.0, 1.0, 1.0, 1.0),), upper=(2100.0,)
)
BOX = {"vx": (-0.5, 0.5), "y": (-0.2, 0.1)}
MANY: dict[str, dict[str, Any]] = {
    "inputs": {},
    "speeds with lag": {"inputs": "speed", "rotor_lag": 0.03},
    "moves": {"inputs": "speed", "weights": Weights(move=0.5)},
    "moves and slews with lag": {"inputs": "speed", "rotor_lag": 0.02, "weights": Weights(move=0.5), "slew": 30.0},
    "slews": {"inputs": "speed", "slew": 30.0},
    "soft tilt": {"tilt": 10.0, "soft": Soft(linear=50.0, quadratic=10.0)},
    "soft tilt and rates": {"tilt": 10.0, "body_rate": 60.0, "soft": Soft(linear=20.0, quadratic=5.0)},
    "prices without curvature": {"tilt": 10.0, "body_rate": 60.0, "soft": Soft(linear=20.0, quadratic=0.0)},
    "soft outputs": {"output_bounds": BOX, "soft": Soft(linear=5.0, quadratic=1.0)},
    "polytopes": {"inputs": "speed", "polytopes": (FENCE, LIFT)},
    "targets": RATES | {"soft": Soft(linear=20.0, quadratic=5.0)},
    "targets and moves": RATES | {"soft": Soft(linear=20.0, quadratic=5.0), "weights": Weights(move=0.5)},
    "moment": {"moment": True},
    "moment and moves with lag": {"moment": True, "inputs": "speed", "rotor_lag": 0.02, "weights": Weights(move=0.5)},
    "drag": {"drag": (0.3, 0.3, 0.1), "quadratic_drag": (0.05, 0.05, 0.02), "terminal": "lqr", "tilt": 12.0},
}


def at_rest(q: Array | None = None) -> Array:
    x = np.zeros(N_BODY)
    x[3] = 1.0
    if q is not None:
        x[Q] = q / np.linalg.norm(q)
    return x


def call(controller: NonlinearMPC, x: Array, time: float = 0.0, reference: Array | None = None) -> Command:
    """The answer at a state (13,)."""
    state = np.zeros(N_STATES)
    state[POSITIONS] = x[P]
    state[VELOCITIES] = x[V]
    preview = np.zeros((controller.horizon, 4)) if reference is None else reference
    return controller.step(StepInputs(time=time, attitude=x[Q], body_rates=x[W]), state, preview)


def law(space: Space | None = None, *, slew: float = math.inf, horizon: int = 12, **settings: Any) -> NonlinearMPC:
    made = Nonlinear(horizon=horizon, **settings)
    bounds = made.actuators(VEHICLE)
    if math.isfinite(slew):
        bounds = ActuatorBounds.alike((0.0, VEHICLE.speed_max), (-slew, slew))
    return NonlinearMPC(
        VEHICLE, period=PERIOD, settings=made, bounds=bounds, constraints=made.constraints(), space=space
    )


def thrown(rng: np.random.Generator, size: float) -> Array:
    """A state (13,) about hover."""
    x = at_rest(np.array([1.0, 0.0, 0.0, 0.0]) + 0.3 * size * rng.normal(size=4))
    x[P], x[V], x[W] = size * rng.normal(size=(3, 3)) * np.array([[0.4], [0.8], [1.0]])
    return x


def checked(controller: NonlinearMPC, share: float = 1e-8) -> int:
    """Compare the last program's answer with its KKT conditions and with a dense active-set solver; the active rows."""
    qp, ours = controller._certificate()
    size = max(1.0, *(float(np.abs(part).max(initial=0.0)) for part in (ours.z, ours.z_box, ours.y)))
    assert kkt_residuals(qp, ours).worst < share * size
    if controller._space is not None:
        return controller.active  # the peer has the same rows at all steps
    dense = dense_qp(controller._rows(), _period(controller._query()))
    backend = DaqpDense()
    backend.setup(dense)
    peer = backend.solve(dense)
    plan = controller.inputs
    if peer.status == SOLVED:
        np.testing.assert_allclose(peer.x[: plan.size], plan.ravel(), atol=2e-5)
    return controller.active


@pytest.mark.parametrize("case", MANY)
def test_answers_are_optima(case: str) -> None:
    """Thrown states from small to far off, from a cold start and along a flight's warm ones."""
    active = 0
    answered = 0
    for seed, size in itertools.product(range(3), (0.1, 0.5, 1.0)):
        rng = np.random.default_rng(seed)
        controller = law(**MANY[case])
        controller.reset(HOVER if controller.commands == "rotors" else np.array(controller.numbers.level))
        for k in range(3):
            command = call(controller, thrown(rng, size), k * PERIOD)
            if command.status in ACCEPTED:
                answered += 1
                active += checked(controller)
            else:
                assert command.status in STATUSES[3:7]
    assert answered > 10
    assert active > 10


@pytest.mark.parametrize("case", MANY)
def test_answers_of_two_nodes_are_optima(case: str) -> None:
    """Where few rows fit into the responses' memory, which the other methods use as well."""
    rng = np.random.default_rng(0)
    controller = law(horizon=2, **MANY[case])
    answered = 0
    controller.reset(HOVER if controller.commands == "rotors" else np.array(controller.numbers.level))
    for k in range(8):
        if call(controller, thrown(rng, 1.0 if k % 2 else 0.1), k * PERIOD).status in ACCEPTED:
            checked(controller)
            answered += 1
    assert answered > 3


MANY_ACTIVE: dict[str, dict[str, Any]] = {
    "soft": {"tilt": 20.0, "soft": Soft(linear=50.0, quadratic=10.0)},
    "hard": {"tilt": 20.0},
    "soft tilt and rates": {"tilt": 10.0, "body_rate": 60.0, "soft": Soft(linear=50.0, quadratic=0.0)},
    "soft outputs": {"output_bounds": BOX, "tilt": 20.0, "soft": Soft(linear=50.0, quadratic=1.0)},
}


@pytest.mark.parametrize("case", MANY_ACTIVE)
def test_many_active_rows_are_found_by_the_interior_point_method(case: str) -> None:
    """Metres off, the dual search alone would exchange rows hundreds of times, and give up at times."""
    rng = np.random.default_rng(0)
    controller = law(horizon=40, **MANY_ACTIVE[case])
    work = controller.struct.work
    found = 0
    for k in range(12):
        x = at_rest()
        x[P] = 4.0 * rng.normal(size=3)
        if k % 3 == 0:
            controller.reset(HOVER)
        command = call(controller, x, k * PERIOD)
        assert command.status in ACCEPTED
        assert work.changes < 1000
        if work.changes > 5 * 40:  # from where on it takes over
            checked(controller, share=1e-7)
            found += 1
    assert found > 2


def test_half_spaces_are_rows_of_the_program() -> None:
    pillar = Sphere(name="pillar", position=(0.6, 0.05, 0.0), radius=0.2)
    for penalty in (None, (50.0, 10.0)):
        space = Space(
            [pillar], radius=0.1, period=PERIOD, horizon=12, settings=Avoidance(), penalty=penalty,
            positions=(0, 1, 2), largest=True,
        )  # fmt: skip
        controller = law(space, tilt=20.0, soft=Soft(linear=1e3))
        reference = np.zeros((12, 4))
        reference[:, 0] = 0.2
        start = at_rest()
        start[V] = 1.2, 0.0, 0.0
        command = call(controller, start, reference=reference)
        assert command.status in ACCEPTED
        assert checked(controller) > 0
        normals, bounds = controller.half_spaces
        inside = (normals * controller.positions).sum(axis=2) - bounds
        assert inside.min() == pytest.approx(0.0, abs=1e-7) or penalty is not None
        assert (command.stats.slack > 0.0) == (penalty is not None and inside.min() < -1e-9)


def ceiling(upper: Array, **parts: Any) -> Constraint:
    """A bound (N, 1) on height."""
    C = np.zeros((1, N_STATES))
    C[0, INDEX["z"]] = 1.0
    return Constraint(name="ceiling", lower=np.full_like(upper, -math.inf), upper=upper, **({"C": C} | parts))


def below(row: Constraint) -> NonlinearMPC:
    return NonlinearMPC(VEHICLE, period=0.05, settings=Nonlinear(horizon=20), constraints=(row,), kkt_every=1)


@pytest.mark.parametrize("case", ["tighter in the middle", "at all steps but the last", "at the first steps", "alike"])
def test_bounds_that_differ_from_step_to_step_hold(case: str) -> None:
    upper = np.full((20, 1), 0.2)
    if case == "tighter in the middle":
        upper[:5] = upper[15:] = 10.0
    elif case == "at all steps but the last":
        upper[-1] = math.inf
    elif case == "at the first steps":
        upper[3:] = math.inf
    controller = below(ceiling(upper))
    reference = np.zeros((20, 4))
    reference[:, 2] = 1.0
    for k in range(6):
        command = call(controller, at_rest(), 0.05 * k, reference)
        assert command.status == SOLVED
        heights = controller.positions[:, 2]
        assert (heights <= upper[:, 0] + 1e-8).all()
        assert command.stats.infeasibility < 1e-8
        assert command.stats.kkt_stationarity < 1e-6
    assert (heights.max() > 0.3) == (case in ("at the first steps", "tighter in the middle"))


def test_rows_that_differ_from_step_to_step_are_refused() -> None:
    with pytest.raises(ParameterError, match=r"controller\.ceiling"):
        below(ceiling(np.full((20, 1), 0.2), C=np.ones((20, 1, N_STATES)) * (np.arange(N_STATES) == INDEX["z"])))


@pytest.mark.parametrize("name", OWN_NAMES)
def test_a_row_with_the_name_of_a_bound_of_the_law_is_refused(name: str) -> None:
    """It would be taken for that bound, and not kept."""
    with pytest.raises(ParameterError, match=rf"controller\.{name}"):
        below(replace(ceiling(np.full((20, 1), 0.2)), name=name))


def test_steps_of_rotor_speeds_are_refused_beside_the_slew() -> None:
    row = Constraint(name="steps", lower=np.full(4, -1.0), upper=np.ones(4), E=np.eye(4))
    with pytest.raises(ParameterError, match=r"controller\.steps"):
        below(row)


def test_a_wrong_answer_of_the_core_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The check takes no word of what made the answer."""
    reference = np.zeros((20, 4))
    reference[:, 2] = 1.0
    controller = below(ceiling(np.full((20, 1), 0.2)))
    assert call(controller, at_rest(), 0.0, reference).status == SOLVED
    right = NonlinearMPC.inputs.fget
    assert right is not None
    monkeypatch.setattr(NonlinearMPC, "inputs", property(lambda law: right(law) + 0.05))
    command = call(controller, at_rest(), 0.05, reference)
    assert command.status == "infeasible_answer"
    assert command.stats.infeasibility > 1e-2


def test_an_infeasible_program_is_refused_and_stated() -> None:
    """A hard bound on body rates, broken beyond what the rotors can do in a node."""
    controller = law(body_rate=30.0)
    spinning = at_rest()
    spinning[W] = 50.0, 0.0, 0.0
    command = call(controller, spinning)
    assert command.status == "primal_infeasible"
    kept = controller.infeasible_period
    assert kept is not None
    qp = dense_qp(kept.problem, _period(kept.query))
    backend = DaqpDense()
    backend.setup(qp)
    assert backend.solve(qp).status != SOLVED
    assert call(controller, at_rest(), PERIOD).status in OPTIMAL


def test_bounds_of_inputs_alone_are_never_infeasible() -> None:
    """Far off, a plan may diverge so that its program is lost in rounding: then the search is given up."""
    rng = np.random.default_rng(0)
    statuses = Counter[str]()
    controller = NonlinearMPC(VEHICLE, period=0.1, settings=Nonlinear(horizon=10))
    for k in range(100):
        statuses[call(controller, thrown(rng, 10.0), 0.1 * k).status] += 1
    assert statuses.keys() <= {*ACCEPTED, "max_iterations", "invalid_data"}
    assert statuses["not_converged"] > 50


def test_infeasible_programs_have_no_solution_for_another_solver() -> None:
    """Beyond hard bounds, near and far: rows that only seem to exclude each other are no reason."""
    backend = DaqpDense()
    refused = 0
    for settings in (MANY["polytopes"], MANY["drag"]):
        rng = np.random.default_rng(0)
        controller = law(**settings)
        for k in range(40):
            if call(controller, thrown(rng, 1.0 + k % 3), k * PERIOD).status != "primal_infeasible":
                continue
            kept = controller.infeasible_period
            assert kept is not None
            qp = dense_qp(kept.problem, _period(kept.query))
            backend.setup(qp)
            assert backend.solve(qp).status != SOLVED
            refused += 1
    assert refused > 10


def _period(query: Query) -> Period:
    assert query.steps is not None
    assert query.equilibrium is not None
    A, B, c = query.steps
    return Period(
        A=A, B=B, c=c, state=query.state, desired=query.desired, u_before=query.u_before, equilibrium=query.equilibrium
    )


def test_the_start_makes_no_difference() -> None:
    """A plan and active set of another state lead to the same optimum of the same program."""
    rng = np.random.default_rng(5)
    settings = MANY["soft tilt and rates"]
    for _ in range(10):
        cold = law(**settings)
        warm = law(**settings)
        x = thrown(rng, 1.0)
        for _ in range(2):
            call(warm, thrown(rng, 1.0))
        first = call(cold, x)
        warm.stored_plan = None  # the program is that of the reference, too, but the active set stays
        work = warm.struct.work
        work.planned = 0
        np.testing.assert_allclose(call(warm, x, PERIOD).plan, first.plan, atol=1e-6)


@pytest.mark.slow("nonlinear")
@pytest.mark.parametrize("settings", [{}, RATES | {"soft": Soft(linear=20.0, quadratic=5.0)}])
def test_steps_end_with_the_time_and_keep_the_plan(settings: dict[str, Any]) -> None:
    """By a clock that is a second later whenever it is asked: the plan is that of as many steps without a limit."""
    x = thrown(np.random.default_rng(4), 1.0)
    whole, three, limited = (
        law(**settings, iterations=iterations, time_limit=limit)
        for iterations, limit in ((8, None), (3, None), (8, 2.5))
    )
    limited.clock = partial(next, itertools.count(1.0))
    plans = [call(controller, x).plan for controller in (whole, three, limited)]
    assert [controller.struct.work.iterations for controller in (whole, three, limited)] == [8, 3, 3]
    np.testing.assert_array_equal(plans[1], plans[2])
    assert np.abs(plans[0] - plans[2]).max() > 0.0
    again = limited.stored_plan
    same = three.stored_plan
    assert again is not None
    assert same is not None
    np.testing.assert_array_equal(again[0], same[0])


@pytest.mark.slow("nonlinear")
@pytest.mark.parametrize("count", [pytest.param(80, marks=pytest.mark.representative("nonlinear")), 800])
def test_ten_thousand_thrown_states_have_typed_answers(count: int) -> None:
    """From near to absurd: no hang, no number that is none, no status without a name."""
    rng = np.random.default_rng(1)
    for case, settings in MANY.items():
        controller = law(**settings)
        for k in range(count):
            size = 10.0 ** rng.uniform(-2.0, 2.0)
            command = call(controller, thrown(rng, size), k * PERIOD)
            assert np.isfinite(command.speeds).all(), case
            assert np.isfinite(command.plan).all(), case
            assert command.status in {*ACCEPTED, *STATUSES}, case
            if command.status in {SOLVED, UNCONSTRAINED}:
                assert command.stats.infeasibility < 1e-6, case
