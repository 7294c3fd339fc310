"""What several test modules build."""

from __future__ import annotations

import copy
import gc
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
from numpy_preparation import NonlinearModel, next_state
from ocp_peer import Period
from scipy.linalg import block_diag

from quadsim.errors import described
from quadsim.flight.audit import Limit, audit
from quadsim.flight.log import RESIDUALS, ControlLog, FlightLog, PlantLog, TimingLog
from quadsim.mpc.laws.constrained import Constrained
from quadsim.mpc.laws.parts.body import body_of, linearise, next_states, world_of
from quadsim.mpc.laws.parts.linear import LinearMPC, NominalPreparation
from quadsim.mpc.laws.parts.preparation import RobustPreparation
from quadsim.mpc.laws.robust import Robust
from quadsim.mpc.problem.constraints import Bounds, Constraint, Penalty
from quadsim.mpc.problem.model import LinearModel
from quadsim.mpc.problem.ocp import Equilibrium, Objective, Problem, Query
from quadsim.mpc.problem.rigidbody import RigidBody
from quadsim.mpc.solvers import Solver
from quadsim.mpc.solvers.by_name import make_solver
from quadsim.rollout import many
from quadsim.rollout.flown import Flight
from quadsim.rollout.many import Row
from quadsim.rotation import conjugate, multiply
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.state import N_STATES, Array
from quadsim.vehicle import N_ROTORS, Vehicle

NO_PRODUCTS = {"video": False, "recording": False, "figures": False}
"""Of a flight that is saved."""


def fly_here(patch: pytest.MonkeyPatch) -> None:
    """Have this process fly many flights, in the place of workers: starting them takes time."""

    def fly_many(flights: Iterable[Any], fly: Callable[[Any], Any], **_: object) -> Iterator[tuple[int, Row]]:
        for place, flight in enumerate(flights):
            try:
                yield place, fly(flight)
            except Exception as error:
                yield place, {"verdict": many.ERROR, "reason": described(error)}

    for user in ("quadsim.rollout.many", "quadsim.features.campaign.plan"):
        patch.setattr(f"{user}.fly_many", fly_many)


def draw_nothing(patch: pytest.MonkeyPatch) -> None:
    """Leave the files of figures empty, for tests of all else."""
    patch.setattr("quadsim.report.to_matplotlib.to_png", lambda *_, **__: b"")


def renamed(flight: Flight, name: str) -> Flight:
    """A flight as if its scenario had another name."""
    return replace(flight, scenario=flight.scenario.altered(name=name))


def recording(flight: Flight, **entries: Any) -> Flight:
    """A flight as if it had been recorded with other entries of its summary."""
    return replace(flight, recorded={**copy.deepcopy(dict(flight.summary)), **entries})


def judged_by(flight: Flight, *limits: Limit) -> Flight:
    """A flight that is audited against these limits alone."""
    return replace(flight, findings=audit(flight.log, limits))


def constrained_mpc(problem: Problem, solver: Solver | None = None) -> LinearMPC:
    """The paper's controller for a problem, by default with PIQP."""
    solver = solver or make_solver("piqp", problem)
    return LinearMPC(NominalPreparation(problem), solver, name="constrained", holds=True)


def robust_table(**fields: Any) -> Robust:
    """The robust controller's table with the paper's weights and bounds, and other fields."""
    paper = load_scenario("paper-constrained").controller
    assert isinstance(paper, Constrained)
    names = ("horizon", "output_weights", "input_weights", "output_bounds", "input_bounds")
    return Robust(**{name: getattr(paper, name) for name in names} | fields)


def robust_mpc(vehicle: Vehicle, table: Robust, problem: Problem | None = None, solver: str = "piqp") -> LinearMPC:
    """The robust controller of a table, with another problem where one is given; its period is the paper's."""
    if problem is None:
        problem = table.problem(vehicle, 0.05)
    return LinearMPC(RobustPreparation(vehicle, problem, table), make_solver(solver, problem), name="robust")


def paper_problem(name: str = "paper-constrained", *settings: str) -> Problem:
    """The optimisation of one of the paper's scenarios."""
    scenario = load_scenario(name, settings)
    return Assembly(scenario).problem()


def paper_reference(samples: int) -> Array:
    """The paper's filtered reference."""
    return Assembly(load_scenario("paper-constrained")).reference(samples)


def random_problem(rng: np.random.Generator, *, horizon: int, n: int = 3, nu: int = 2, n_c: int = 1) -> Problem:
    """A stable system with random weights and bounds; its states have no meaning."""
    A = rng.normal(size=(n, n))
    A *= 0.95 / max(abs(np.linalg.eigvals(A)).max(), 1e-3)
    model = LinearModel(A=A, B=rng.normal(size=(n, nu)), u_bar=rng.normal(size=nu), period=0.1)
    objective = Objective(C_r=np.eye(n), Q_y=_random_definite(rng, n), Q_u=_random_definite(rng, nu))
    bounds = Bounds(
        C_c=rng.normal(size=(n_c, n)),
        y_min=-rng.uniform(0.5, 5.0, n_c),
        y_max=rng.uniform(0.5, 5.0, n_c),
        delta_min=-rng.uniform(0.1, 2.0, nu),
        delta_max=rng.uniform(0.1, 2.0, nu),
        u_min=model.u_bar - rng.uniform(0.1, 3.0, nu),
        u_max=model.u_bar + rng.uniform(0.1, 3.0, nu),
    )
    return Problem(model=model, horizon=horizon, objective=objective, bounds=bounds)


def random_axes(rng: np.random.Generator, *, horizon: int, wider: float) -> Problem:
    """Two random systems with bounded outputs and one without, in a random order of states and mixed by their inputs.

    Args:
        rng: random numbers.
        horizon: N.
        wider: by how much bounds on inputs and their steps are wider than those of `random_problem`.
    """
    parts = [random_problem(rng, horizon=horizon, n=n, nu=nu, n_c=nu) for n, nu in ((3, 1), (2, 2), (2, 1))]
    order = rng.permutation(7)
    mixing = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    u_bar = rng.normal(size=4)
    Q_u = mixing @ block_diag(*(part.objective.Q_u for part in parts)) @ mixing.T
    limits = [part.bounds for part in parts if part.bounds is not None]
    C_c = block_diag(*(bounds.C_c for bounds in limits[:2]), np.zeros((0, 2)))
    step = wider * rng.uniform(0.1, 2.0, 4)
    span = wider * rng.uniform(0.1, 3.0, 4)
    return Problem(
        model=LinearModel(
            A=block_diag(*(part.model.A for part in parts))[np.ix_(order, order)],
            B=(block_diag(*(part.model.B for part in parts)) @ mixing.T)[order],
            u_bar=u_bar,
            period=0.1,
        ),
        horizon=horizon,
        objective=Objective(
            C_r=np.eye(7),
            Q_y=block_diag(*(part.objective.Q_y for part in parts))[np.ix_(order, order)],
            Q_u=0.5 * (Q_u + Q_u.T),
        ),
        bounds=Bounds(
            C_c=C_c[:, order],
            y_min=np.concatenate([bounds.y_min for bounds in limits[:2]]),
            y_max=np.concatenate([bounds.y_max for bounds in limits[:2]]),
            delta_min=-step,
            delta_max=step,
            u_min=u_bar - span,
            u_max=u_bar + span,
        ),
    )


def with_terms(rng: np.random.Generator, problem: Problem, terms: Collection[str]) -> Problem:
    """A random problem with some of what the paper's does not have.

    Args:
        rng: random numbers.
        problem: with bounds on two outputs.
        terms: of soft, margins, Q_d, P, constraints.
    """
    bounds = problem.bounds
    objective = problem.objective
    N = problem.horizon
    n = problem.model.n
    nu = problem.model.nu
    assert bounds is not None
    m = len(bounds.C_c)
    if "soft" in terms:
        penalty = Penalty(l1=rng.uniform(0.0, 30.0, m), l2=rng.uniform(0.1, 3.0, m))
        bounds = replace(bounds, penalty=penalty)
    if "margins" in terms:
        bounds = replace(bounds, margins=0.3 * rng.uniform(size=(N, m)) * np.minimum(-bounds.y_min, bounds.y_max))
    if "Q_d" in terms:
        factor = rng.normal(size=(nu, rng.integers(1, nu + 1)))
        objective = replace(objective, Q_d=_symmetric(3.0 * factor @ factor.T))
    if "P" in terms:
        factor = rng.normal(size=(n, rng.integers(1, n + 1)))
        objective = replace(objective, P=_symmetric(factor @ factor.T))
    added: tuple[Constraint, ...] = ()
    if "constraints" in terms:
        added = (random_rows(rng, problem, soft=False), random_rows(rng, problem, soft=True))
    return replace(problem, objective=objective, bounds=bounds, constraints=(*problem.constraints, *added))


def random_rows(rng: np.random.Generator, problem: Problem, *, soft: bool, rows: int = 2) -> Constraint:
    """C x + D u + E (u - u_before), one- and two-sided, with bounds on both sides of hover."""
    n = problem.model.n
    nu = problem.model.nu
    D = rng.normal(size=(rows, nu))
    lower = D @ problem.model.u_bar - rng.uniform(0.5, 1.5, rows)
    upper = D @ problem.model.u_bar + rng.uniform(0.5, 1.5, rows)
    lower[0] = -np.inf
    C = rng.normal(size=(rows, n))
    E = 0.5 * rng.normal(size=(rows, nu))
    penalty = None
    if soft:
        penalty = Penalty(l1=rng.uniform(0.0, 3.0, rows), l2=rng.uniform(0.1, 3.0, rows))
    return Constraint(name="coupled", C=C, D=D, E=E, lower=lower, upper=upper, penalty=penalty)


def changing_period(rng: np.random.Generator, problem: Problem) -> Period:
    """Systems that differ from step to step, around the problem's own."""
    model = problem.model
    N = problem.horizon
    return Period(
        A=model.A + 0.1 * rng.normal(size=(N, model.n, model.n)),
        B=model.B + 0.3 * rng.normal(size=(N, model.n, model.nu)),
        c=0.2 * rng.normal(size=(N, model.n)),
        state=0.2 * rng.normal(size=model.n),
        desired=rng.normal(size=(N, len(problem.objective.C_r))),
        u_before=model.u_bar,
        equilibrium=Equilibrium(np.zeros(model.n), model.u_bar + 0.1 * rng.normal(size=model.nu)),
    )


def advance_nodes(model: RigidBody, x: Array, u: Array) -> Array:
    """(..., n) the states one step after states x (..., n) under inputs u (..., 4)."""
    body, _left = body_of(model)
    return next_states(body, world_of(model), x, u)


def linearise_nodes(model: RigidBody, x: Array, u: Array, frames: Array | None = None) -> tuple[Array, Array, Array]:
    """See `quadsim.mpc.laws.parts.body.linearise`."""
    return linearise(model, x, u, frames)


def frame(q_r: Array) -> Array:
    """(4, 4) maps q to q_r* q."""
    return np.stack([multiply(conjugate(q_r), unit) for unit in np.eye(4)], axis=1)


def linearised(model: NonlinearModel, x: Array, u: Array) -> tuple[Array, Array, Array]:
    """A, B, c of x(k+1) ~ A x(k) + B u(k) + c about a state x (n,) and inputs u (4,), by central differences."""
    joint = np.concatenate([x, u])
    h = 1e-4

    def after(joint: Array) -> Array:
        return next_state(model, joint[: model.n], joint[model.n :])

    differences = [after(joint + step) - after(joint - step) for step in h * np.eye(joint.size)]
    slopes = np.array(differences).T / (2.0 * h)
    A = slopes[:, : model.n]
    B = slopes[:, model.n :]
    return A, B, after(joint) - A @ x - B @ u


def derivative(model: NonlinearModel, x: Array, u: Array) -> Array:
    """dx/dt (..., n) of states x (..., n) under inputs u (..., 4), by central differences over short periods."""
    h = 1e-5
    forward = replace(model, period=h)
    backward = replace(model, period=-h)
    slopes = []
    for state, inputs in zip(x.reshape(-1, x.shape[-1]), u.reshape(-1, 4), strict=True):
        slopes.append((next_state(forward, state, inputs) - next_state(backward, state, inputs)) / (2.0 * h))
    return np.array(slopes).reshape(x.shape)


def flight_queries(flight: Flight, problem: Problem, stride: int) -> list[Query]:
    """xi(k), y_d, u(k-1) of every `stride`-th period of a flight."""
    log = flight.log.control
    N = problem.horizon
    reference = paper_reference(log.t.size + N)
    before = np.vstack([log.speeds_before, log.speeds[:-1]])
    return [
        Query(log.state[k], problem.desired(reference[k + 1 : k + 1 + N]), before[k])
        for k in range(0, log.t.size, stride)
    ]


def _symmetric(matrix: Array) -> Array:
    return np.asarray(0.5 * (matrix + matrix.T))


def _random_definite(rng: np.random.Generator, size: int) -> Array:
    factor = rng.normal(size=(size, size))
    matrix = factor @ factor.T + 0.1 * np.eye(size)
    return 0.5 * (matrix + matrix.T)


def scenario_table() -> dict[str, Any]:
    """A small, right scenario file as nested tables, with an entry of every kind; defaults are left out."""
    return {
        "name": "small",
        "description": "one second of everything",
        "duration": 1.0,
        "control_period": 0.05,
        "vehicle": {"file": "lopes2011", "mass": 4.5},
        "reference": {"response_time": 1.0, "x": [{"start": 0.0, "stop": 0.5, "value": 1.0}]},
        "controller": {
            "type": "constrained",
            "horizon": 10,
            "output_weights": {"x": 1.0, "y": 1.0, "z": 1.0, "yaw": 1.0},
            "input_weights": {"speed": [0.01, 0.01, 0.01, 0.01]},
            "output_bounds": {"roll": [-5.0, 5.0]},
            "input_bounds": {"speed": [0.0, 250.0], "slew": [-10.0, 5.0]},
        },
        "constraints": [{"name": "roll", "signal": "roll", "lower": -5.0, "upper": 5.0, "tolerance": 0.1}],
    }


def small_log(periods: int = 4, *, steps: int = 5, seed: int = 0, reason: str | None = None) -> FlightLog:
    """A made-up flight of 0.1 s periods with `steps` physics steps each, every array filled with its own numbers."""
    rng = np.random.default_rng(seed)
    t = np.round(0.1 * np.arange(periods), 9)
    rows = periods * steps + 1
    return FlightLog(
        control=ControlLog(
            t=t,
            state=rng.normal(size=(periods, N_STATES)),
            truth=rng.normal(size=(periods, N_STATES)),
            reference=rng.normal(size=(periods, 4)),
            speeds=rng.uniform(100.0, 250.0, (periods, N_ROTORS)),
            speeds_before=np.array([192.8, 192.9, 193.0, 193.1]),
            status=tuple("solved" if k % 2 == 0 else "max_iterations" for k in range(periods)),
            answered_by=tuple("piqp-multistage" if k % 2 == 0 else "fallback" for k in range(periods)),
            phase=tuple("flying" if k else "armed" for k in range(periods)),
            iterations=rng.integers(1, 30, periods),
            active=rng.integers(0, 30, periods),
            fallback=rng.integers(0, 2, periods),
            slack=rng.uniform(size=periods),
            **{name: np.where(np.arange(periods) % 3 == 0, rng.uniform(size=periods), np.nan) for name in RESIDUALS},
            delay=rng.uniform(0.0, 0.05, periods),
        ),
        timing=TimingLog(t=t, solve_ms=rng.uniform(size=periods), step_ms=rng.uniform(1.0, 2.0, periods)),
        plant=PlantLog(
            t=np.round(0.1 / steps * np.arange(rows), 9),
            state=rng.normal(size=(rows, N_STATES)),
            speeds=rng.uniform(100.0, 250.0, (rows, N_ROTORS)),
            wrench=rng.normal(size=(rows, 6)),
            wind=rng.normal(size=(rows, 3)),
            battery=np.linspace((16.0, 1.0), (14.0, 0.5), rows),
        ),
        predicted=rng.normal(size=(periods, 6, 3)).astype(np.float32) if periods else None,
        reason=reason,
    )


def decode(path: Path) -> tuple[np.ndarray, dict[str, Any]]:
    """All frames of an MP4, and its metadata by ffmpeg."""
    gc.freeze()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)  # imageio leaves ffmpeg's pipes in cycles
            reader = imageio_ffmpeg.read_frames(path)
            meta: dict[str, Any] = next(reader)
            reader.close()
            del reader
            frames = iio.imread(path, plugin="FFMPEG")
            gc.collect()
    finally:
        gc.unfreeze()
    return frames, meta
