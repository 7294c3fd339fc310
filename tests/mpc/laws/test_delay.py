"""A known delay of nonlinear and geometric laws: what they predict, what they aim at, and how they fly."""

from __future__ import annotations

import itertools
import shutil
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import quadsim
from quadsim.assets import vehicle_path
from quadsim.controller import Phase, StepInputs
from quadsim.errors import ParameterError
from quadsim.features.export.in_the_loop import fly_exported
from quadsim.motion import Motion
from quadsim.mpc.estimate.disturbance import RampObserver, RampSettings
from quadsim.mpc.estimate.observer import ObserverSettings
from quadsim.mpc.laws.geometric import Geometric, GeometricController
from quadsim.mpc.laws.nonlinear import Nonlinear
from quadsim.mpc.laws.parts.body import body_of, next_states, world_of
from quadsim.mpc.laws.parts.nonlinear_mpc import NonlinearMPC
from quadsim.mpc.problem.rigidbody import N_BODY, Inputs, P, Q, RigidBody, V, W, rigid_body
from quadsim.rotation import exponential
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import N_STATES, POSITIONS, VELOCITIES, Array
from quadsim.vehicle import load_vehicle

VEHICLE = load_vehicle(vehicle_path("hummingbird"))
PERIOD = 0.02
LAG = 0.03
DELAYS = (0.007, 0.02, 0.033, 0.06)
"""A part of a period, a whole one, more, and three."""


def scenario(law: dict[str, Any], delay: float, **more: Any) -> Scenario:
    """The Hummingbird's figure eight with its rotors and drag, under commands that are late."""
    changes: dict[str, Any] = {"controller": law, "constraints": [], "duration": 3.0, **more}
    if delay:
        changes["computation.delay"] = delay
    return quadsim.load("hummingbird-real-rotors").replace(changes)


def errors(flown: Scenario) -> tuple[float, float]:
    """RMS distance from the course [m], and the largest tilt [rad]."""
    flight = quadsim.fly(flown, progress=False)
    log = flight.log.control
    away = log.state[:, POSITIONS] - log.reference[:, :3]
    cosine = np.cos(flight.state["roll"]) * np.cos(flight.state["pitch"])
    return float(np.sqrt(np.mean(np.sum(away**2, axis=1)))), float(np.arccos(cosine).max())


MANY: dict[str, dict[str, Any]] = {
    "nonlinear": {"type": "nonlinear", "rotor_lag": "vehicle"},
    "observing": {"type": "nonlinear", "rotor_lag": "vehicle", "offset_free": {}},
    "following a force": {"type": "nonlinear", "rotor_lag": "vehicle", "disturbance": {}},
    "geometric": {"type": "geometric", "feedforward": True, "disturbance": {"rotor_lag": 0.0125}},
}


@pytest.mark.parametrize("name", MANY)
def test_a_law_that_knows_the_delay_flies_as_without(name: str) -> None:
    """Otherwise all depart from the course at 60 ms, the nonlinear ones at 40 ms already."""
    law = MANY[name]
    at_once, tilt = errors(scenario(law, 0.0))
    for delay in (0.03, 0.04, 0.06):
        known, known_tilt = errors(scenario({**law, "delay": delay}, delay))
        assert known < 1.5 * at_once
        assert known_tilt == pytest.approx(tilt, abs=0.02)
    unknown, unknown_tilt = errors(scenario(law, 0.06, duration=6.0))
    assert unknown > 3.0 * at_once
    assert unknown_tilt > 2.0 * tilt


@pytest.mark.parametrize("name", ["nonlinear", "geometric"])
def test_the_exported_law_flies_as_the_law(name: str) -> None:
    if shutil.which("cc") is None:
        pytest.skip("cc is not installed: make firmware")
    law = {**MANY["following a force"], "delay": 0.03}
    more: dict[str, Any] = {"computation.delay": 0.03}
    base = scenario(law, 0.03)
    if name == "geometric":
        law = {"type": "geometric", "commands": "rates", "feedforward": True, "disturbance": {}, "delay": 0.013}
        more = {"computation.delay": 0.013}
        base = quadsim.load("autopilot").replace({"controller": law, "duration": 2.0, **more})
    exported = fly_exported(base, target="posix", progress=False)
    flown = quadsim.fly(base, progress=False)
    assert exported.log.control.status == flown.log.control.status
    np.testing.assert_allclose(exported.command, flown.command, atol=1e-9)


# --- prediction ------------------------------------------------------------------------------------------------------


def law(delay: float, **settings: Any) -> NonlinearMPC:
    made = Nonlinear(inputs="speed", rotor_lag=LAG, horizon=10, delay=delay, **settings)
    return NonlinearMPC(VEHICLE, period=PERIOD, settings=made)


def thrown() -> Array:
    """A state (13,) of a vehicle that is tilted, moves and turns."""
    x = np.zeros(N_BODY)
    x[Q] = exponential((0.2, -0.3, 0.5))
    x[V] = (0.5, -0.4, 0.2)
    x[W] = (1.0, -2.0, 0.5)
    return x


def moved(model: RigidBody, x: Array, command: Array, time: float) -> Array:
    """A state some time after, under a command."""
    body, _left = body_of(replace(model, step=time, substeps=20))
    return next_states(body, world_of(model), x, command / VEHICLE.speed_max)


def flown_late(model: RigidBody, x: Array, sent: list[Array], delay: float, k: int) -> Array:
    """The state at period k + 1 of one at period k, where command i takes over at i periods and the delay."""
    time = k * PERIOD
    end = (k + 1) * PERIOD
    switches = [i * PERIOD + delay for i in range(len(sent)) if time + 1e-9 < i * PERIOD + delay < end - 1e-9]
    for start, stop in itertools.pairwise([time, *switches, end]):
        acting = sum(i * PERIOD + delay <= start + 1e-9 for i in range(len(sent)))
        x = moved(model, x, sent[acting - 1] if acting else np.full(4, VEHICLE.hover_speed), stop - start)
    return x


def measured(x: Array, k: int, acting: Array) -> tuple[StepInputs, Array]:
    state = np.zeros(N_STATES)
    state[POSITIONS] = x[P]
    state[VELOCITIES] = x[V]
    moment = StepInputs(
        time=k * PERIOD, acting=acting, attitude=x[Q] / np.linalg.norm(x[Q]), body_rates=x[W], phase=Phase.FLYING
    )
    return moment, state


@pytest.mark.parametrize("delay", DELAYS)
def test_the_state_is_predicted_to_when_the_command_acts(delay: float) -> None:
    """Commands and measurements along a flight in which each command acts so late; the observer finds nothing."""
    controller = law(delay, substeps=4, offset_free=ObserverSettings())
    model = rigid_body(VEHICLE, PERIOD, inputs=Inputs.SPEED, rotor_lag=LAG)
    rng = np.random.default_rng(0)
    hover = np.full(4, VEHICLE.hover_speed)
    sent: list[Array] = []
    x = np.concatenate([thrown(), hover / VEHICLE.speed_max])
    controller.reset(hover)
    for k in range(8):
        before = sent[-1] if sent else hover
        controller.step(*measured(x, k, before), np.zeros((controller.horizon, 4)))
        sent.append(hover + rng.uniform(-40.0, 40.0, 4))
        asked = controller.asked[0]
        ahead = x
        late = delay
        for j in range(k, k + 10):
            step = min(late, PERIOD)
            if step > 1e-9:
                ahead = _part(model, ahead, sent[:-1], delay, j, step)
            late -= step
        sign = np.sign(asked[Q] @ ahead[Q])
        np.testing.assert_allclose(asked[Q] * sign, ahead[Q], atol=1e-5)
        others = [*range(3), *range(7, 17)]
        np.testing.assert_allclose(asked[others], ahead[others], atol=2e-4)
        x = flown_late(model, x, sent, delay, k)
    np.testing.assert_allclose(controller.disturbance, 0.0, atol=0.02)


def _part(model: RigidBody, x: Array, sent: list[Array], delay: float, k: int, step: float) -> Array:
    """The state a step after the start of period k; none of the commands takes over later than that."""
    start = k * PERIOD
    switches = [i * PERIOD + delay for i in range(len(sent))]
    inside = [at for at in switches if start + 1e-9 < at < start + step - 1e-9]
    for begin, end in itertools.pairwise([start, *inside, start + step]):
        acting = sum(at <= begin + 1e-9 for at in switches)
        x = moved(model, x, sent[acting - 1] if acting else np.full(4, VEHICLE.hover_speed), end - begin)
    return x


@pytest.mark.parametrize("delay", DELAYS)
def test_the_reference_is_that_of_when_the_command_acts(delay: float) -> None:
    """A preview along a straight line, and a motion along a cubic that turns evenly."""
    controller = law(delay)
    rows = PERIOD * np.arange(1, 11)[:, None] * [1.0, -0.5, 0.25, 3.0]
    now, state = measured(np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], np.zeros(6)]), 0, np.full(4, 400.0))
    controller.step(now, state, rows)
    nodes = controller.asked[2]
    after = delay + PERIOD * np.arange(11)
    held = 10 - int(np.ceil(delay / PERIOD - 1e-9))  # from where on the last row is
    expected = after[1:held, None] * [1.0, -0.5, 0.25]
    np.testing.assert_allclose(nodes[1:held, P], expected, atol=1e-12)
    np.testing.assert_allclose(2.0 * np.arctan2(nodes[1:held, 6], nodes[1:held, 3]), 3.0 * after[1:held], atol=1e-12)

    def position(t: Array) -> Array:
        return t[:, None] ** 3 * [20.0, -10.0, 5.0] + t[:, None] * [1.0, 2.0, 0.0]

    def velocity(t: Array) -> Array:
        return 3.0 * t[:, None] ** 2 * [20.0, -10.0, 5.0] + [1.0, 2.0, 0.0]

    t = PERIOD * np.arange(30)
    still = np.zeros((30, 3))
    yaw = np.column_stack([np.cos(t), 0.0 * t, 0.0 * t, np.sin(t)])
    yaw[1::2] *= -1.0  # the same attitudes
    motion = Motion(
        position=position(t),
        velocity=velocity(t),
        acceleration=still,
        attitude=yaw,
        body_rates=np.tile([0.0, 0.0, 2.0], (30, 1)),
        thrusts=np.ones((30, 4)) * t[:, None],
    )
    controller.step(replace(now, motion=motion, time=PERIOD), state, rows)
    _, _, nodes, thrusts = controller.asked
    np.testing.assert_allclose(nodes[:, P], position(after), atol=1e-12)
    turned = np.abs(nodes[:, 3] * np.cos(after) + nodes[:, 6] * np.sin(after))
    np.testing.assert_allclose(turned, 1.0, atol=1e-9)
    np.testing.assert_allclose(thrusts[:, 0], after[:10], atol=1e-12)


@pytest.mark.parametrize("delay", [0.0, *DELAYS])
def test_a_geometric_law_aims_at_where_the_course_is_when_the_command_acts(delay: float) -> None:
    controller = GeometricController(VEHICLE, PERIOD, Geometric(delay=delay))
    t = PERIOD * np.arange(1, 11)
    preview = np.column_stack([t**2, 2.0 * t, -(t**2), 0.5 * t])
    target = controller.target(preview)
    np.testing.assert_allclose(target.position, [delay**2, 2.0 * delay, -(delay**2)], atol=1e-12)
    np.testing.assert_allclose(target.velocity, [2.0 * delay, 2.0, -2.0 * delay], atol=1e-10)
    assert target.yaw == pytest.approx(0.5 * delay, abs=1e-12)


@pytest.mark.parametrize("lag", [None, 0.03])
@pytest.mark.parametrize("late", [0.005, 0.02])
def test_the_observer_of_forces_knows_which_command_was_in_force(late: float, lag: float | None) -> None:
    """Level, climbing and falling by thrusts that take over late in each period, of a model that is right."""
    m = VEHICLE.mass
    g = VEHICLE.gravity
    observer = RampObserver(RampSettings(rotor_lag=lag), VEHICLE, PERIOD, late=late)
    speeds = [VEHICLE.hover_speed * factor for factor in (1.0, 1.1, 0.9, 1.2, 0.8)]
    observer.reset(np.full(4, speeds[0]))
    velocity = 0.0
    rotor = speeds[0]
    before = speeds[0]
    level = np.eye(3)
    still = np.zeros(3)
    observer.update(PERIOD, np.array([0.0, 0.0, velocity]), level, still, np.full(4, before))
    steps = 2000
    for k, speed in enumerate(speeds * 2, start=2):
        for i in range(steps):
            command = before if (i + 0.5) / steps * PERIOD < late else speed
            decay = 0.0 if lag is None else np.exp(-0.5 * PERIOD / steps / lag)
            middle = command + decay * (rotor - command)
            rotor = command + decay * (middle - command)
            velocity += PERIOD / steps * (4.0 * VEHICLE.mean_coefficient * middle**2 / m - g)
        before = speed
        observer.update(k * PERIOD, np.array([0.0, 0.0, velocity]), level, still, np.full(4, speed))
        force, _, _ = observer.foreseen(0.0)
        np.testing.assert_allclose(force, 0.0, atol=0.02)


# --- refusals and changes of law ---


@pytest.mark.parametrize(
    ("changes", "allowed"),
    [
        ({"type": "nonlinear", "delay": 0.5}, "16 control periods"),
        ({"type": "nonlinear", "horizon": 4, "delay": 0.1}, "4 control periods"),
        ({"type": "geometric", "delay": 0.2}, "6 control periods"),
        ({"type": "geometric", "horizon": 3, "delay": 0.07}, "3 control periods"),
    ],
)
def test_a_delay_of_too_many_periods_is_refused(changes: dict[str, Any], allowed: str) -> None:
    table = Nonlinear if changes.pop("type") == "nonlinear" else Geometric
    made: Any = NonlinearMPC if table is Nonlinear else GeometricController
    with pytest.raises(ParameterError, match=rf"controller\.delay must be at most {allowed}"):
        made(VEHICLE, period=PERIOD, settings=table(**changes))


def test_targets_of_an_autopilot_are_less_than_a_period_late() -> None:
    lags = (0.03, 0.02, 0.02, 0.05)
    for table, made in ((Nonlinear, NonlinearMPC), (Geometric, GeometricController)):
        settings: Any = table(commands="rates", inner_lag=lags, delay=PERIOD)  # type: ignore[operator]
        with pytest.raises(ParameterError, match=r"controller\.delay must be below the control period"):
            made(VEHICLE, period=PERIOD, settings=settings)  # type: ignore[operator]
    with pytest.raises(ParameterError, match="zero where commands"):
        Geometric(commands="attitude", inner_lag=lags, delay=0.01)


@pytest.mark.parametrize(("mine", "its"), [(0.033, 0.033), (0.007, 0.06), (0.06, 0.007)])
def test_commands_under_way_are_taken_over(mine: float, its: float) -> None:
    previous = law(its)
    successor = law(mine)
    hover = np.full(4, VEHICLE.hover_speed)
    previous.reset(hover)
    sent = [hover + 10.0 * i for i in range(1, 7)]
    x = np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], np.zeros(6)])
    for k, command in enumerate(sent[:-1]):
        previous.step(*measured(x, k, command), np.zeros((10, 4)))
    successor.reset(sent[-2])
    successor.adopt(previous)
    successor.step(*measured(x, 5, sent[-1]), np.zeros((10, 4)))
    under_way = int(np.ceil(mine / PERIOD - 1e-9)) - 1
    known = min(under_way + 1, int(np.ceil(its / PERIOD - 1e-9)) + 1)
    kept = np.array(successor.struct.delay.sent)[: under_way + 1]
    np.testing.assert_array_equal(kept[-known:], sent[-known:])
