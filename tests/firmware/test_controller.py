"""The exported C on this machine: recorded periods, drawn states, and input that is none."""

from __future__ import annotations

import functools
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from exported_c import HOST, Host, Reply, replay

from quadsim.features.export.exporter import c_controller
from quadsim.features.export.record import REFUSED, Recording, record
from quadsim.mpc.export.ctext import Precision
from quadsim.mpc.guard.structs import STATUSES
from quadsim.scenarios.loading import load_scenario
from quadsim.state import Array

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
    desired = recording(name)
    result = replies(name, precision)
    status = np.array([min(reply.status, REFUSED) for reply in result])
    np.testing.assert_array_equal(status, desired.status)
    optimal = desired.status < REFUSED
    commands = np.array([reply.command for reply in result])
    assert np.abs(commands - desired.command)[optimal].max() <= TOLERANCE[precision]


@pytest.mark.parametrize("precision", TOLERANCE)
@pytest.mark.parametrize("name", OTHERS)
def test_other_flights_too(name: str, precision: Precision) -> None:
    """In float rounding may make a bound active, which changes the status; the rows of `polytopes` are hard on it."""
    desired = recording(name)
    result = replies(name, precision)
    status = np.array([min(reply.status, REFUSED) for reply in result])
    optimal = desired.status < REFUSED
    np.testing.assert_array_equal(status < REFUSED, optimal)
    if precision == "double":
        np.testing.assert_array_equal(status, desired.status)
    allowed = 6e-2 if (name, precision) == ("polytopes", "float") else TOLERANCE[precision]
    assert np.abs(np.array([reply.command for reply in result]) - desired.command)[optimal].max() <= allowed


AIR = {
    **{"controller.moment": True, "controller.tightening": None, "constraints": [], "duration": 4.0, "effects.air": {}},
    **{"vehicle.rotor_moment": [2e-4, 3e-4], "vehicle.inflow_moment": [0.02, 0.03], "vehicle.inflow": 4e-4},
    "vehicle.rate_damping": [0.02, 0.03, 0.01],
}
"""A vehicle that the air turns and slows, and a law that knows it."""


@pytest.mark.parametrize("precision", TOLERANCE)
def test_a_law_that_knows_the_air_flies_as_recorded(precision: Precision) -> None:
    scenario = load_scenario("robust-lag50").replace(AIR)
    desired = record(scenario)
    commands = [reply.command for reply in replay(Host(scenario, precision), desired)]
    assert np.abs(np.array(commands) - desired.command).max() <= TOLERANCE[precision]


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
    flight = recording(name)
    N = load_scenario(name).controller.horizon
    spread = 0.75 * np.array([0.3, 0.5, 0.3, 0.5, 0.3, 0.5, 0.02, 0.15, 0.02, 0.15, 0.2, 0.3])
    result = []
    for k in rng.integers(0, len(flight.state), 1000):
        state = flight.state[k] + spread * rng.normal(size=12)
        acting = np.clip(flight.acting[k] + 10.0 * rng.normal(size=4), 0.0, 250.0)
        result.append((state, flight.path[k : k + N], acting))
    return result


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
    distances = list[float]()
    differ = 0
    hover = np.full(4, 188.0)
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
    usual = Host(scenario, rows=160)
    small = Host(scenario, rows=20)
    flight = recording("paper-constrained")
    for host in (usual, small):
        host.reset(flight.before)
    arguments = flight.state[0], flight.path[: usual.horizon], flight.acting[0]
    assert usual.step(*arguments).status == 2
    reply = small.step(*arguments)
    assert (STATUSES[reply.status], reply.fallback) == ("no_room", 2)  # level hover: there is no plan yet
    assert ((reply.command - flight.acting[0] <= 5.0) & (reply.command - flight.acting[0] >= -10.0)).all()
