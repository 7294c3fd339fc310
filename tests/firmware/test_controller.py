"""The exported C on this machine: recorded periods, drawn states, and input that is none."""

from __future__ import annotations

import functools
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import quadprog
from exported_c import HOST, Host, Reply, replay

from mpc.condensing import Condensed
from mpc.export.ctext import Precision
from mpc.ocp import Query
from mpc.solvers import QPSolver
from quadsim.controller import SOLVED
from quadsim.state import Array
from scenarios.assembly import Assembly
from scenarios.export.exporter import c_controller
from scenarios.export.record import REFUSED, Recording, record
from scenarios.loading import load_scenario

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")

FLIGHTS = (
    "paper-constrained",
    "paper-constrained-lag20",
    "paper-unconstrained",
    "crazyflie-steps",
    "robust",
    "yaw-180",
)
OTHERS = (
    "hummingbird-figure-eight",
    "paper-constrained-heavy",
    "robust-lag50",
    "robust-worn-rotor",
    "polytopes",
    "waypoints",
)
TOLERANCE = {"double": 1e-8, "float": 2e-2}  # [rad/s]
STRICT = (
    *("-std=c99", "-O3", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Wshadow", "-Wcast-qual"),
    *("-pedantic", "-Werror", "-ffp-contract=off", "-fsyntax-only"),
)


@functools.cache
def recording(name: str) -> Recording:
    return record(load_scenario(name))


@functools.cache
def replies(name: str, precision: Precision) -> list[Reply]:
    return replay(Host(load_scenario(name), precision), recording(name))


@pytest.mark.parametrize("precision", TOLERANCE)
@pytest.mark.parametrize("name", FLIGHTS)
def test_all_recorded_periods_have_the_same_status_and_the_exact_command(name: str, precision: Precision) -> None:
    wanted, found = recording(name), replies(name, precision)
    status = np.array([min(reply.status, REFUSED) for reply in found])
    np.testing.assert_array_equal(status, wanted.status)
    optimal = wanted.status < REFUSED
    commands = np.array([reply.command for reply in found])
    assert np.abs(commands - wanted.command)[optimal].max() <= TOLERANCE[precision]


@pytest.mark.parametrize("precision", TOLERANCE)
@pytest.mark.parametrize("name", OTHERS)
def test_other_flights_too(name: str, precision: Precision) -> None:
    """In float rounding may make a bound active, which changes the status; the rows of `polytopes` are hard on it."""
    wanted, found = recording(name), replies(name, precision)
    status, optimal = np.array([min(reply.status, REFUSED) for reply in found]), wanted.status < REFUSED
    np.testing.assert_array_equal(status < REFUSED, optimal)
    if precision == "double":
        np.testing.assert_array_equal(status, wanted.status)
    allowed = 6e-2 if (name, precision) == ("polytopes", "float") else TOLERANCE[precision]
    assert np.abs(np.array([reply.command for reply in found]) - wanted.command)[optimal].max() <= allowed


def test_recorded_flights_have_every_way() -> None:
    assert set(recording("paper-constrained").status) == {0, 1, 2}
    assert REFUSED in recording("paper-constrained-lag20").status


def test_shifted_sets_are_nearly_right() -> None:
    changes = [reply.changes for reply in replies("paper-constrained", "double")[1:]]
    assert np.max(changes) <= 80
    assert np.percentile(changes, 99) <= 50


@pytest.mark.parametrize("precision", TOLERANCE)
@pytest.mark.parametrize("name", ["paper-constrained", "paper-unconstrained", "robust-lag50", "polytopes"])
def test_no_compiler_warns(name: str, precision: Precision, tmp_path: Path) -> None:
    for file, text in c_controller(load_scenario(name), precision).files.items():
        (tmp_path / file).write_text(text)
    define = ["-DQUADSIM_FLOAT"] if precision == "float" else []
    subprocess.run(["cc", *STRICT, *define, "-I", tmp_path, HOST], check=True)


@functools.cache
def drawn(name: str = "paper-constrained") -> list[tuple[Array, Array, Array]]:
    """1 000 states around a flight, with references and commands in force; some have no answer."""
    rng = np.random.default_rng(3)
    flight, N = recording(name), load_scenario(name).controller.horizon
    spread = 0.75 * np.array([0.3, 0.5, 0.3, 0.5, 0.3, 0.5, 0.02, 0.15, 0.02, 0.15, 0.2, 0.3])
    found = []
    for k in rng.integers(0, len(flight.state), 1000):
        state = flight.state[k] + spread * rng.normal(size=12)
        acting = np.clip(flight.acting[k] + 10.0 * rng.normal(size=4), 0.0, 250.0)
        found.append((state, flight.path[k : k + N], acting))
    return found


@functools.cache
def peers() -> list[tuple[Array | None, Array | None]]:
    """First commands of DAQP and of quadprog; None where they find none."""
    scenario = load_scenario("paper-constrained")
    problem = Assembly(scenario).problem()
    daqp, form = QPSolver("daqp", problem), Condensed(problem)
    found: list[tuple[Array | None, Array | None]] = []
    for state, reference, acting in drawn():
        query = Query(state, problem.objective.desired(reference), acting)
        answer = daqp.solve(Query(query.state, query.desired, query.u_before))
        first = answer.plan[0] if answer.status == SOLVED else None
        qp = form.pose(Query(query.state, query.desired, query.u_before)).qp
        rows = np.vstack([np.eye(qp.c.size), qp.G])
        lower, upper = np.concatenate([qp.x_l, qp.h_l]), np.concatenate([qp.x_u, qp.h_u])
        try:
            x = quadprog.solve_qp(np.array(qp.P), -qp.c, np.vstack([rows, -rows]).T, np.concatenate([lower, -upper]))[0]
            second = form.inputs(x)[0]
        except ValueError:
            second = None
        found.append((first, second))
    return found


@pytest.mark.parametrize("warm", [False, True], ids=["cold", "warm"])
@pytest.mark.parametrize("precision", TOLERANCE)
def test_drawn_states_have_the_verdict_and_the_optimum_of_two_solvers(precision: Precision, warm: bool) -> None:
    host, hover = Host(load_scenario("paper-constrained"), precision, rows=160), np.full(4, 188.0)
    host.reset(hover)
    infeasible = 0
    for (state, reference, acting), (first, second) in zip(drawn(), peers(), strict=True):
        if not warm:
            host.reset(hover)
        reply = host.step(state, reference, acting)
        assert (reply.status >= REFUSED) == (first is None) == (second is None)
        infeasible += first is None
        if first is not None and second is not None:
            nearest = min(np.abs(reply.command - first).max(), np.abs(reply.command - second).max())
            assert nearest <= (1e-7 if precision == "double" else 5e-2)
    assert 20 <= infeasible <= 500


PRECISIONS: tuple[Precision, ...] = ("double", "float")
FLOATS = {
    "paper-constrained": (0.1, 0.0),
    "robust": (0.01, 0.0),
    "robust-lag50": (0.01, 0.0),
    "yaw-180": (1.5, 0.02),
    "polytopes": (0.05, 0.1),
}
"""How far floats may be from doubles [rad/s], and of how many states, as a share, the verdicts may differ."""


@pytest.mark.parametrize("warm", [False, True], ids=["cold", "warm"])
@pytest.mark.parametrize("name", FLOATS)
def test_floats_are_near_doubles_in_drawn_states(name: str, warm: bool) -> None:
    """Rows that nearly depend on each other are where floats are far off, or give up."""
    hosts = [Host(load_scenario(name), precision, rows=200) for precision in PRECISIONS]
    distances, differ, hover = list[float](), 0, np.full(4, 188.0)
    for k, query in enumerate(drawn(name)):
        if k == 0 or not warm:
            for host in hosts:
                host.reset(hover)
        double, single = (host.step(*query) for host in hosts)
        if double.status < REFUSED and single.status < REFUSED:
            distances.append(float(np.abs(double.command - single.command).max()))
        differ += (double.status < REFUSED) != (single.status < REFUSED)
    p99, most = np.percentile(distances, [99, 100])
    print(f"{name}: of {len(distances)} states p99 {p99:.1e}, most {most:.1e} rad/s; of {differ} no verdict in common")
    largest, share = FLOATS[name]
    assert most <= largest
    assert differ <= share * len(drawn(name))


def test_more_active_rows_than_there_is_room_for_end_as_defined() -> None:
    scenario = load_scenario("paper-constrained")
    usual, small = Host(scenario, rows=160), Host(scenario, rows=20)
    flight = recording("paper-constrained")
    for host in (usual, small):
        host.reset(flight.speeds)
    arguments = flight.state[0], flight.path[: usual.horizon], flight.acting[0]
    assert usual.step(*arguments).status == 2
    reply = small.step(*arguments)
    assert reply.status == 3
    assert ((reply.command - flight.acting[0] <= 5.0) & (reply.command - flight.acting[0] >= -10.0)).all()


BROKEN = (np.nan, np.inf, -np.inf, 1e300)


@pytest.mark.parametrize("name", ["paper-constrained", "robust"])
@pytest.mark.parametrize("value", BROKEN)
@pytest.mark.parametrize("what", ["state", "reference", "acting"])
def test_input_that_is_none_leads_to_the_command_before(name: str, what: str, value: float) -> None:
    flight, host = recording(name), Host(load_scenario(name))
    arguments = {
        "state": flight.state[0].copy(),
        "reference": flight.path[: host.horizon].copy(),
        "acting": flight.acting[0].copy(),
    }
    host.reset(flight.speeds)
    first = host.step(**arguments)
    broken = {**arguments, what: arguments[what].copy()}
    broken[what].flat[1] = value
    reply = host.step(**broken)
    assert reply.status == 5 if not np.isfinite(value) or name == "robust" else reply.status >= REFUSED
    assert np.isfinite(reply.command).all()
    assert (reply.command >= 0.0).all()
    assert (reply.command <= 250.0).all()
    if what == "acting" and not np.isfinite(value):
        np.testing.assert_array_equal(reply.command, first.command)
    assert host.step(**arguments).status == first.status  # and the next one is answered again


def test_a_plan_is_held_shifted_where_there_is_no_optimum() -> None:
    flight, host = recording("paper-constrained-lag20"), Host(load_scenario("paper-constrained-lag20"))
    found = replay(host, flight)
    refused = [reply.status for reply in found if reply.status >= REFUSED]
    assert refused
    assert set(refused) <= {3, 4}
    for before, reply in zip(flight.acting, found, strict=True):
        step = reply.command - before
        assert (step >= -10.0 - 1e-9).all()
        assert (step <= 5.0 + 1e-9).all()


def test_two_controllers_do_not_know_of_one_another() -> None:
    flight, scenario = recording("paper-constrained"), load_scenario("paper-constrained")
    alone, other = Host(scenario), Host(scenario)
    other.reset(np.full(4, 100.0))
    alone.reset(flight.speeds)
    for k in range(40):
        window = flight.path[k : k + alone.horizon]
        other.step(flight.state[-1 - k], window, flight.acting[k])
        reply = alone.step(flight.state[k], window, flight.acting[k])
        np.testing.assert_array_equal(reply.command, replies("paper-constrained", "double")[k].command)


def test_a_reset_in_flight_forgets_the_active_set() -> None:
    flight, host = recording("paper-constrained"), Host(load_scenario("paper-constrained"))
    host.reset(flight.speeds)
    first = host.step(flight.state[0], flight.path[: host.horizon], flight.acting[0])
    for k in range(1, 30):
        host.step(flight.state[k], flight.path[k : k + host.horizon], flight.acting[k])
    host.reset(flight.speeds)
    again = host.step(flight.state[0], flight.path[: host.horizon], flight.acting[0])
    assert again.changes == first.changes > 10  # from the ground, without an active set
    np.testing.assert_array_equal(again.plan, first.plan)
