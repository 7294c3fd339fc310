"""The growth of a pair of flights against the eigenvalues of the sampled loop, and where there are none."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm, logm

import quadsim
from quadsim.errors import InputError
from quadsim.mpc.problem.ocp import Problem
from quadsim.rollout import stability
from quadsim.rollout.growth import Growth
from quadsim.rollout.stability import instability_notes, measure_growth
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.mismatch import unmodelled
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import INDEX, Array

WITHIN = 0.02
"""How far from a margin a pair of flights tells on which side it is, as a share: that of the bisection."""


@cache
def scenario_of(law: str) -> Scenario:
    """The paper's vehicle under a law; LQR without its turn of the errors, so that it has a margin of heading."""
    if law != "lqr":
        return load_scenario(law)
    return load_scenario("paper-unconstrained").replace({"controller": {"type": "lqr", "heading": False}})


def gain_over_horizon(problem: Problem) -> Array:
    """K (4, 12) of the first input of the unconstrained optimum, by the Riccati recursion."""
    A = problem.model.A
    B = problem.model.B
    objective = problem.objective
    Q = objective.C_r.T @ objective.Q_y @ objective.C_r
    P = Q.copy() if objective.P is None else objective.P
    for _ in range(problem.horizon):
        K = np.linalg.solve(objective.Q_u + B.T @ P @ B, B.T @ P @ A)
        P = Q + A.T @ P @ (A - B @ K)
    return np.asarray(K)


@cache
def loop_of(law: str) -> tuple[Array, Array, Array, float]:
    """A (12, 12), B (12, 4) and K (4, 12) of the sampled loop x+ = A x + B u, u = -K x, and its period [s]."""
    problem = Assembly(load_scenario("paper-unconstrained" if law == "lqr" else law)).problem()
    model = problem.model
    if law == "lqr":
        return model.A, model.B, np.asarray(Assembly(scenario_of(law)).controller().law.gain), model.period
    return model.A, model.B, gain_over_horizon(problem), model.period


def continuous(A: Array, B: Array, period: float) -> tuple[Array, Array]:
    """The model before it was sampled."""
    n, m = B.shape
    sampled = np.block([[A, B], [np.zeros((m, n)), np.eye(m)]])
    rates = np.real(logm(sampled)) / period
    return rates[:n, :n], rates[:n, n:]


def held(A: Array, B: Array, time: float) -> tuple[Array, Array]:
    """The continuous model after a time with its input held."""
    n, m = B.shape
    block = expm(time * np.block([[A, B], [np.zeros((m, n + m))]]))
    return block[:n, :n], block[:n, n:]


def exponent(loop: Array, period: float) -> float:
    """The largest real part of the loop's exponents [1/s]."""
    return math.log(np.abs(np.linalg.eigvals(loop)).max()) / period


def turned(law: str, heading: float) -> float:
    """The exponent with a plant turned by a heading [deg], which the gain does not know."""
    A, B, K, period = loop_of(law)
    c = math.cos(math.radians(heading))
    s = math.sin(math.radians(heading))
    T = np.eye(len(A))
    for a, b in ((INDEX["x"], INDEX["y"]), (INDEX["vx"], INDEX["vy"])):
        T[a, a] = T[b, b] = c
        T[a, b] = -s
        T[b, a] = s
    return exponent(T @ A @ T.T - T @ B @ K, period)


def delayed(law: str, delay: float) -> float:
    """The exponent with commands that act a delay [ms] after their measurement, beside those on their way."""
    A, B, K, period = loop_of(law)
    n, m = B.shape
    Ac, Bc = continuous(A, B, period)
    whole, rest = divmod(1e-3 * delay, period)
    count = int(whole) + 1  # commands on their way
    A_late, B_late = held(Ac, Bc, period - rest)
    B_early = A_late @ held(Ac, Bc, rest)[1]
    loop = np.zeros((n + count * m, n + count * m))
    loop[:n, :n] = A
    for age, block in ((count - 1, B_late), (count, B_early)):
        if age == 0:
            loop[:n, :n] -= block @ K
        else:
            loop[:n, n + (age - 1) * m : n + age * m] += block
    loop[n : n + m, :n] = -K
    for i in range(1, count):
        loop[n + i * m : n + (i + 1) * m, n + (i - 1) * m : n + i * m] = np.eye(m)
    return exponent(loop, period)


def lagging(law: str, lag: float) -> float:
    """The exponent with rotors of a time constant [ms], which the gain does not know."""
    A, B, K, period = loop_of(law)
    n, m = B.shape
    Ac, Bc = continuous(A, B, period)
    rates = np.block([[Ac, Bc], [np.zeros((m, n)), -np.eye(m) / (1e-3 * lag)]])
    inputs = np.vstack([np.zeros((n, m)), np.eye(m) / (1e-3 * lag)])
    A_lag, B_lag = held(rates, inputs, period)
    return exponent(A_lag - B_lag @ np.hstack([K, np.zeros((m, m))]), period)


def scaled(law: str, thrust: float) -> float:
    """The exponent with rotors of another thrust at a speed, as a factor: d(b w^2)/dw grows by its root in hover."""
    A, B, K, period = loop_of(law)
    return exponent(A - math.sqrt(thrust) * B @ K, period)


def first_crossing(exponent_at: Callable[[float], float], low: float, high: float) -> float | None:
    """The first value between two at which an exponent becomes positive, to 1e-4 of the interval; None without one."""
    values = np.linspace(low, high, 400)
    signs = [exponent_at(value) > 0.0 for value in values.tolist()]
    if not any(signs):
        return None
    i = signs.index(True)
    inner = float(values[i - 1])
    outer = float(values[i])
    while outer - inner > 1e-4 * (high - low):
        middle = 0.5 * (inner + outer)
        inner, outer = (inner, middle) if exponent_at(middle) > 0.0 else (middle, outer)
    return 0.5 * (inner + outer)


def flown(law: str, quantity: str, value: float) -> Growth:
    scenario = scenario_of(law)
    thrust = Assembly(scenario).vehicle.thrust_coefficient
    changes: dict[str, dict[str, Any]] = {
        "heading": {},
        "delay": {"computation.delay": 1e-3 * value},
        "lag": {"effects.rotors": {"rise": 1e-3 * value, "fall": 1e-3 * value}},
        "thrust": {"actual.thrust_coefficient": value * thrust if isinstance(thrust, float) else None},
    }
    return measure_growth(scenario, heading=value if quantity == "heading" else 0.0, changes=changes[quantity])


THEORY: dict[str, tuple[Callable[[str, float], float], float, float]] = {
    "heading": (turned, 0.0, 179.0),
    "delay": (delayed, 0.1, 150.0),
    "lag": (lagging, 2.0, 200.0),
    "thrust": (scaled, 1.0, 6.0),
}
MARGINS = [
    ("lqr", "heading"),
    ("lqr", "delay"),
    ("lqr", "lag"),
    ("paper-unconstrained", "thrust"),
]
SLOW_MARGINS = [
    pytest.param(law, quantity, marks=pytest.mark.slow("stability"))
    for law in ("paper-unconstrained", "paper-constrained")
    for quantity in ("heading", "delay", "lag")
]


@pytest.mark.parametrize(("law", "quantity"), [*MARGINS, *SLOW_MARGINS])
def test_the_loop_loses_its_stability_where_the_eigenvalues_say(law: str, quantity: str) -> None:
    exponent_of, low, high = THEORY[quantity]
    margin = first_crossing(lambda value: exponent_of(law, value), low, high)
    assert margin is not None
    below = (1.0 - WITHIN) * margin
    above = (1.0 + WITHIN) * margin
    if quantity == "delay":  # of whole physics steps of 1 ms
        below = math.floor(below)
        above = math.ceil(above)
    assert flown(law, quantity, below).verdict == "stable"
    assert flown(law, quantity, above).verdict == "unstable"


def test_the_rate_is_the_exponent_of_the_loop() -> None:
    slow = flown("paper-unconstrained", "heading", 30.0)
    fast = flown("paper-unconstrained", "delay", 48.0)
    assert slow.rate == pytest.approx(turned("paper-unconstrained", 30.0), abs=0.03)
    assert fast.rate == pytest.approx(delayed("paper-unconstrained", 48.0), rel=0.1)


def test_noise_is_the_same_in_both_flights() -> None:
    noisy = load_scenario("turbulence")
    calm = noisy.replace({"effects.air.turbulence": None})
    assert measure_growth(noisy).rate == pytest.approx(measure_growth(calm).rate, abs=0.25)


def test_a_pair_gives_the_same_numbers_again() -> None:
    scenario = load_scenario("motion-capture")
    assert measure_growth(scenario) == measure_growth(scenario)


def test_a_loop_that_oscillates_within_its_bounds_is_unstable() -> None:
    """Its difference ends at the size of the oscillation, where it no longer grows."""
    late = load_scenario("hummingbird-figure-eight").replace({"controller": {"type": "nonlinear"}})
    oscillating = measure_growth(late, changes={"computation.delay": 0.05})
    assert oscillating.verdict == "unstable"
    assert oscillating.rate > 0.1


def test_a_flight_that_is_lost_is_unstable_and_says_why() -> None:
    lost = flown("paper-unconstrained", "delay", 90.0)
    assert lost.verdict == "unstable"
    assert "lost" in lost.ended
    assert lost.rate > 1.0


def test_parts_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match="hover"):
        measure_growth(load_scenario("paper-constrained"), changes={"actual.mass": 40.0})


# --- before a flight -------------------------------------------------------------------------------------------------

TURNED = {
    "reference": {"type": "yaw_turns", "turns": [{"start": 0.0, "yaw": 60.0, "rate": 30.0}]},
    "initial.euler": [0.0, 0.0, 60.0],
    "duration": 10.0,
    "constraints": [],
}
YAW_90 = {
    "reference": {"type": "steps", "response_time": 1.5, "yaw": [{"start": 1.0, "stop": 20.0, "value": 90.0}]},
    "constraints": [],
}
LATE = {
    "controller": {"type": "nonlinear", "rotor_lag": "vehicle"},
    "computation": {"delay": 0.03},
    "constraints": [],
}


def notes_on(name: str, changes: dict[str, Any]) -> tuple[str, ...]:
    return instability_notes(Assembly(load_scenario(name).replace(changes)))


@pytest.mark.parametrize(
    ("name", "changes", "parts"),
    [
        (
            "paper-constrained",
            TURNED,
            [
                "unstable: a push grows 3.6",
                "the model of constrained lacks: a heading of 60 deg",
                'controller.type = "robust", controller.heading = true',
                "quadsim stability ... --heading 0 --over heading",
            ],
        ),
        ("hummingbird-figure-eight", YAW_90, ["a heading of 90 deg", "controller.heading = true"]),
        ("hummingbird-real-rotors", LATE, ["nonlinear lacks", "commands 30 ms late", "controller.delay = 0.03"]),
        (
            "hummingbird-figure-eight",
            {"actual.rotor_spins": [-1, 1, -1, 1]},
            ["actual.rotor_spins", "vehicle.rotor_spins"],
        ),
        ("crazyflie-real-rotors", {}, ["rotors that lag by 72 ms", 'controller.rotor_lag = "vehicle"']),
    ],
)
def test_an_unstable_loop_is_named_before_its_flight(name: str, changes: dict[str, Any], parts: list[str]) -> None:
    (note,) = notes_on(name, changes)
    assert [part for part in parts if part not in note] == []


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("paper-constrained-lag20", {}),
        ("yaw-turns", {}),
        ("slow-solver", {}),
        ("hummingbird-figure-eight", {"actual.mass": 0.75}),
    ],
)
def test_a_loop_that_is_stable_with_what_its_model_lacks_has_no_note(name: str, changes: dict[str, Any]) -> None:
    scenario = load_scenario(name).replace(changes)
    assert unmodelled(Assembly(scenario)) != ()
    assert instability_notes(Assembly(scenario)) == ()


@pytest.mark.parametrize("name", ["paper-constrained", "hover", "robust", "playground", "nonlinear"])
def test_nothing_is_flown_where_the_model_lacks_nothing(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The paper's course starts at a heading of 30 deg, and is to turn away from it at once."""

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a pair was flown")

    monkeypatch.setattr(stability, "measure_growth", refuse)
    assert notes_on(name, {}) == ()


def test_the_field_that_is_named_makes_the_loop_stable() -> None:
    table = load_scenario("robust").tables["controller"] | {"heading": True}
    assert notes_on("paper-constrained", TURNED | {"controller": table}) == ()


def test_run_check_and_feasibility_say_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scenario = load_scenario("paper-constrained").replace(TURNED | {"duration": 0.5})
    assert "a heading of 60 deg" in quadsim.feasibility(scenario).notes[-1]
    with caplog.at_level(logging.INFO, logger="quadsim"):
        quadsim.check(scenario, progress=False)
        quadsim.run(scenario, out=tmp_path / "run", video=False, recording=False, figures=False, progress=False)
    assert sum("a heading of 60 deg" in record.getMessage() for record in caplog.records) == 2
