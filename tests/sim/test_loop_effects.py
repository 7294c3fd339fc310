"""The closed loop with late commands, sensors and a ground: who receives what, and when."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from quadsim.controller import GROUNDED, MISSED, Command, Phase, Statistics, StepInputs, stopped
from quadsim.errors import ParameterError
from quadsim.flight.log import FlightLog
from quadsim.flight.metrics import computation, estimation, ground
from quadsim.flight.phase import PhaseMonitor
from quadsim.motion import Motion
from quadsim.sim.airframe import outline
from quadsim.sim.computation import Computation, Stall
from quadsim.sim.effects import Effects, Ground
from quadsim.sim.effects.rotors import RotorDynamics
from quadsim.sim.loop import TAKEOFF_LEAD, ClosedLoop, fly
from quadsim.sim.navigation import Navigation
from quadsim.sim.physics import PhysicsSteps
from quadsim.sim.plant import Plant
from quadsim.sim.sensing import FaultKind, Sensor, SensorFault, SensorName
from quadsim.state import Array, make_state
from quadsim.vehicle import Vehicle

PERIOD = 0.05
STEPS = 50


@dataclass
class Scripted:
    """Commands what it is given, stops when grounded, and records its calls."""

    speeds: Array
    name: str = "scripted"
    solver: str = ""
    horizon: int = 2
    moments: list[StepInputs] = field(default_factory=list)
    states: list[Array] = field(default_factory=list)

    def reset(self, speeds: Array) -> None:
        self.moments = []
        self.states = []

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        k = len(self.moments)
        self.moments.append(now)
        self.states.append(state.copy())
        if now.phase in GROUNDED:
            return stopped(np.zeros(4), self.horizon, now.phase)
        return Command(
            speeds=self.speeds[k], plan=np.tile(self.speeds[k], (self.horizon, 1)), stats=Statistics(iterations=k)
        )

    def predict(self, states: Array, plans: Array) -> Array:
        return np.repeat(states[:, None, :], plans.shape[1], axis=1)


def fly_scripted(plant: Plant, controller: Scripted, **options: Any) -> FlightLog:
    periods = len(controller.speeds)
    values: dict[str, Any] = {
        "reference": np.zeros((periods + controller.horizon, 4)),
        "initial_state": make_state(position=(0.0, 0.0, 10.0)),
        "initial_speeds": plant.vehicle.hover_speeds,
    }
    return fly(plant, controller, periods=periods, steps_per_period=STEPS, **{**values, **options})


@pytest.fixture
def speeds(vehicle: Vehicle) -> Array:
    return vehicle.hover_speed + np.random.default_rng(5).uniform(-3, 3, (8, 4))


def test_a_late_command_acts_from_its_time_on(vehicle: Vehicle, speeds: Array) -> None:
    controller = Scripted(speeds)
    with Plant(vehicle) as plant:
        log = fly_scripted(plant, controller, computation=Computation(delay=0.0105))
        hover = plant.vehicle.hover_speeds
    acting = log.plant.speeds[:-1].reshape(-1, STEPS, 4)
    before = np.concatenate([hover[None], speeds[:-1]])
    np.testing.assert_array_equal(acting[:, :11], np.repeat(before[:, None], 11, axis=1))  # the next whole step
    np.testing.assert_array_equal(acting[:, 11:], np.repeat(speeds[:, None], 39, axis=1))
    np.testing.assert_array_equal(log.control.speeds, speeds)
    np.testing.assert_allclose(log.control.delay, 0.0105)
    for k, moment in enumerate(controller.moments):
        np.testing.assert_array_equal(moment.acting, before[k])
    assert computation(log.control)["missed"] == 0


def test_a_missed_deadline_leaves_the_last_command_acting(vehicle: Vehicle, speeds: Array) -> None:
    controller = Scripted(speeds)
    stall = Stall(at=0.1, duration=0.12)  # catches periods 2, 3 and 4; the last of them is 20 ms late
    with Plant(vehicle) as plant:
        log = fly_scripted(plant, controller, computation=Computation(stalls=(stall,)))
    assert [status == MISSED for status in log.control.status] == [k in (2, 3) for k in range(8)]
    np.testing.assert_array_equal(log.control.speeds[1:5], speeds[[1, 1, 1, 4]])
    np.testing.assert_array_equal(log.control.fallback, [0, 0, 1, 1, 0, 0, 0, 0])
    np.testing.assert_allclose(log.control.delay, [0, 0, 0.12, 0.07, 0.02, 0, 0, 0], atol=1e-12)
    np.testing.assert_array_equal(controller.moments[4].acting, speeds[1])
    np.testing.assert_array_equal(log.plant.speeds[STEPS * 4 + 19], speeds[1])
    np.testing.assert_array_equal(log.plant.speeds[STEPS * 4 + 20], speeds[4])
    numbers = computation(log.control)
    assert numbers["missed"] == 2
    assert numbers["delay_ms"]["max"] == pytest.approx(120.0)


def test_a_late_command_leaves_the_plan_going_on(vehicle: Vehicle, speeds: Array) -> None:
    """Due after 10 ms, stalled over periods 2 to 4: the plan of period 1 goes on from when each command was due."""

    class Planner(Scripted):
        def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
            command = super().step(now, state, reference)
            plan = command.speeds + np.arange(4.0)[:, None]
            return Command(speeds=command.speeds, plan=plan)

    computation = Computation(delay=0.01, stalls=(Stall(at=0.1, duration=0.125),), plan=True)
    with Plant(vehicle) as plant:
        log = fly_scripted(plant, Planner(speeds, horizon=4), computation=computation)
    acting = log.plant.speeds[:-1].reshape(-1, STEPS, 4)
    for k, before, late in ((2, 0.0, 1.0), (3, 1.0, 2.0)):
        np.testing.assert_array_equal(acting[k, :10], np.tile(speeds[1] + before, (10, 1)))
        np.testing.assert_array_equal(acting[k, 10:], np.tile(speeds[1] + late, (40, 1)))
    np.testing.assert_array_equal(acting[4, :10], np.tile(speeds[1] + 2.0, (10, 1)))
    np.testing.assert_array_equal(acting[4, 10:25], np.tile(speeds[1] + 3.0, (15, 1)))
    np.testing.assert_array_equal(acting[4, 25:], np.tile(speeds[4], (25, 1)))
    assert [status == MISSED for status in log.control.status[:6]] == [False, False, True, True, False, False]
    np.testing.assert_array_equal(log.control.speeds[2:5], [speeds[1] + 1.0, speeds[1] + 2.0, speeds[4]])


@pytest.mark.parametrize("delay", [0.0, 0.031, PERIOD, 0.0505, 0.12, 3 * PERIOD])
def test_commands_act_shifted_by_the_delay(vehicle: Vehicle, speeds: Array, delay: float) -> None:
    """As from a queue of (arrival, command), in which several may wait; each u(k) keeps its own row of the log."""
    controller = Scripted(speeds)
    with Plant(vehicle) as plant:
        log = fly_scripted(plant, controller, computation=Computation(delay=delay))
        acting = plant.vehicle.hover_speeds
    queue = [(STEPS * k + int(np.ceil(1e3 * delay - 1e-6)), command) for k, command in enumerate(speeds)]
    for step, turning in enumerate(log.plant.speeds[:-1]):
        while queue and queue[0][0] <= step:
            acting = queue.pop(0)[1]
        np.testing.assert_array_equal(turning, acting)
    np.testing.assert_array_equal(log.control.speeds, speeds)
    before = [vehicle.hover_speed * np.ones(4), *speeds[:-1]]
    np.testing.assert_array_equal([moment.acting for moment in controller.moments], before)
    assert computation(log.control)["missed"] == 0


@pytest.mark.parametrize("plan", [False, True])
def test_a_deadline_follows_the_commands_under_way(vehicle: Vehicle, speeds: Array, plan: bool) -> None:
    """Due after 120 ms and dropped after 150: period 3 misses by its iterations, and the last plan goes on."""

    class Planner(Scripted):
        def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
            command = super().step(now, state, reference)
            slow = {2: 2, 3: 4}.get(command.stats.iterations, 0)
            return Command(
                speeds=command.speeds, plan=command.speeds + np.arange(4.0)[:, None], stats=Statistics(iterations=slow)
            )

    late = Computation(delay=0.12, per_iteration={"law": 0.01}, plan=plan)
    with Plant(vehicle) as plant:
        log = fly_scripted(plant, Planner(speeds, horizon=4), computation=late)
    assert [status == MISSED for status in log.control.status] == [k == 3 for k in range(8)]
    acting = log.plant.speeds[:-1].reshape(-1, STEPS, 4)
    held, later = (speeds[1], speeds[1] + 1.0) if plan else (speeds[1], speeds[1])
    np.testing.assert_array_equal(acting[4], np.repeat([held, later, speeds[2]], [20, 20, 10], axis=0))
    missed = speeds[2] + 1.0 if plan else speeds[2]
    np.testing.assert_array_equal(acting[5], np.repeat([speeds[2], missed], [20, 30], axis=0))
    np.testing.assert_array_equal(acting[6], np.repeat([missed, speeds[4]], [20, 30], axis=0))
    np.testing.assert_array_equal(log.control.speeds[2:5], [speeds[2], missed, speeds[4]])


def test_iterations_cost_simulated_time(vehicle: Vehicle, speeds: Array) -> None:
    with Plant(vehicle) as plant:
        log = fly_scripted(plant, Scripted(speeds), computation=Computation(per_iteration={"law": 0.004}))
    np.testing.assert_allclose(log.control.delay, 0.004 * np.arange(8))


def test_drawn_delays_are_the_seed_s(vehicle: Vehicle, speeds: Array) -> None:
    def delays(seed: int) -> Array:
        with Plant(vehicle) as plant:
            rng = np.random.default_rng(seed)
            return fly_scripted(plant, Scripted(speeds), computation=Computation(jitter=0.02), rng=rng).control.delay

    np.testing.assert_array_equal(delays(3), delays(3))
    assert np.any(delays(3) != delays(4))


def test_the_controller_receives_the_sensors_samples(vehicle: Vehicle, speeds: Array) -> None:
    sensors = {SensorName.POSITION: Sensor(rate=20.0, noise=0.1)}
    navigation = Navigation(vehicle, timestep=1e-3, sensors=sensors, rng=np.random.default_rng(0))
    controller = Scripted(speeds)
    with Plant(vehicle) as plant:
        log = fly_scripted(plant, controller, navigation=navigation)
    np.testing.assert_array_equal(controller.states, log.control.state)
    np.testing.assert_allclose(log.control.truth, log.plant.state[:-1:STEPS], atol=1e-12)
    deviation = log.control.state - log.control.truth
    assert 0.02 < np.abs(deviation[:, [0, 2, 4]]).max() < 0.5
    np.testing.assert_allclose(np.delete(deviation, [0, 2, 4], axis=1), 0.0, atol=1e-12)
    numbers = estimation(log.control)
    assert numbers["rmse"]["x"] == pytest.approx(np.sqrt(np.mean(deviation[:, 0] ** 2)))
    assert numbers["max_error"]["vx"] < 1e-12
    assert numbers["not_finite"] == 0


def test_the_estimator_receives_the_saturated_command(vehicle: Vehicle) -> None:
    received: list[Array] = []

    class Recording(Navigation):
        def record(self, flown: PhysicsSteps, *, on_ground: bool = False) -> None:
            received.append(flown["commands"][0].copy())
            super().record(flown, on_ground=on_ground)

    navigation = Recording(vehicle, timestep=1e-3, sensors={}, rng=np.random.default_rng(0))
    with Plant(vehicle, limit_speeds=True) as plant:
        fly_scripted(plant, Scripted(np.full((2, 4), 300.0)), navigation=navigation)
    np.testing.assert_array_equal(received, np.full((2, 4), vehicle.speed_max))


def test_a_sample_that_is_not_a_number_is_counted(vehicle: Vehicle, speeds: Array) -> None:
    fault = SensorFault(sensor=SensorName.RATES, kind=FaultKind.NAN, start=0.1, stop=0.2)
    navigation = Navigation(vehicle, timestep=1e-3, sensors={}, rng=np.random.default_rng(0), faults=[fault])
    with Plant(vehicle) as plant:
        log = fly_scripted(plant, Scripted(speeds), navigation=navigation)
    assert estimation(log.control)["not_finite"] == 2
    assert estimation(log.control)["rmse"]["roll_rate"] == pytest.approx(0.0, abs=1e-12)


def test_take_off_and_landing(vehicle: Vehicle) -> None:
    """Rotors spin up on the ground, lift, and go down again by script; the phases follow, and the metrics."""
    periods = 80
    script = np.full((periods, 4), vehicle.hover_speed)
    script[:12] *= np.linspace(0.3, 1.0, 12)[:, None]
    script[12:16] *= 1.15
    script[16:24] *= 0.93
    script[24:28] *= 0.93
    script[28:] *= 0.98
    reference = np.zeros((periods + 2, 4))
    reference[8:30, 2] = 1.0
    reference[30:, 2] = -0.1
    controller = Scripted(script)
    shape = outline(vehicle)
    with Plant(vehicle, effects=Effects(ground=Ground(), rotors=RotorDynamics(rise=0.02, fall=0.02))) as plant:
        log = fly_scripted(
            plant,
            controller,
            reference=reference,
            initial_state=make_state(),
            initial_speeds=np.zeros(4),
            ground=PhaseMonitor(shape, period=PERIOD),
        )
    phases = list(dict.fromkeys(log.control.phase))
    assert phases == ["landed", "armed", "flying"]  # the last of them comes twice
    assert log.control.phase[-1] == "landed"
    assert [moment.phase for moment in controller.moments] == [Phase(phase) for phase in log.control.phase]
    assert log.control.status[-1] == "landed"
    assert np.abs(log.plant.state[:400, [1, 3, 5]]).max() < 1e-2  # it stood still while the rotors were too slow
    numbers = ground(log, shape)
    assert 0.6 < numbers["takeoff_time"] < 1.2
    touch = numbers["touchdown"]
    row = int(np.searchsorted(log.plant.t, touch["time"]))
    assert touch["speed"] == pytest.approx(-log.plant.state[row, 5])
    assert touch["speed"] > 0.05
    assert log.plant.state[row, 4] == pytest.approx(0.0, abs=5e-3)  # the origin at rest is at z = 0
    assert touch["tilt"] < 0.1
    assert not numbers["crashed"]
    assert np.abs(log.plant.state[-1, [1, 3, 5]]).max() < 1e-6
    assert log.plant.state[-1, 4] == pytest.approx(0.0, abs=1e-4)
    assert log.plant.speeds[-1].max() < 1.0


def test_the_controller_alone_sees_a_reference_raised_for_take_off(vehicle: Vehicle) -> None:
    """With its motion: commands rise by 2 % of the thrust per period, after 0.6 s without more."""

    @dataclass
    class Seeing(Scripted):
        seen: list[Array] = field(default_factory=list)

        def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
            self.seen.append(reference.copy())
            return super().step(now, state, reference)

    script = 0.7 * vehicle.hover_speed * np.ones((30, 4))
    script[12:] *= 1.01 ** np.arange(18)[:, None]
    reference = np.zeros((32, 4))
    motion = np.zeros((32, 3))
    reference[:, 2] = motion[:, 2] = 0.5
    controller = Seeing(script)
    rest = {"velocity": motion * 0.0, "acceleration": motion * 0.0, "body_rates": motion * 0.0}
    course = Motion(position=motion, attitude=np.tile([1.0, 0, 0, 0], (32, 1)), thrusts=np.zeros((32, 4)), **rest)
    with Plant(vehicle, effects=Effects(ground=Ground())) as plant:
        log = fly_scripted(
            plant,
            controller,
            reference=reference,
            motion=course,
            initial_state=make_state(),
            initial_speeds=np.zeros(4),
            ground=PhaseMonitor(outline(vehicle), period=PERIOD),
        )
    lead = np.nan_to_num(log.control.logged[TAKEOFF_LEAD][1])
    assert lead[:12].max() == 0.0
    assert lead[-1] > 0.5
    np.testing.assert_allclose([rows[:, 2] - 0.5 for rows in controller.seen], np.repeat(lead[:, None], 2, axis=1))
    for moment, raised in zip(controller.moments, lead, strict=True):
        assert moment.motion is not None
        np.testing.assert_allclose(moment.motion.position[:, 2], 0.5 + raised)
    assert (log.control.reference[:, 2] == 0.5).all()
    assert (course.position[:, 2] == 0.5).all()


def test_a_capsized_vehicle_lies_on_the_ground_and_has_crashed(vehicle: Vehicle) -> None:
    controller = Scripted(np.zeros((40, 4)))
    with Plant(vehicle, effects=Effects(ground=Ground())) as plant:
        log = fly_scripted(
            plant,
            controller,
            initial_state=make_state(position=(0.0, 0.0, 0.4), euler=(1.2, 0.0, 0.0)),
            ground=PhaseMonitor(outline(vehicle), period=PERIOD),
        )
    assert log.control.phase[-1] == "crashed"
    assert log.control.status[-1] == "crashed"
    assert log.plant.state[-1, 4] > -0.14
    numbers = ground(log, outline(vehicle))
    assert numbers["crashed"]
    assert numbers["started"] == "flying"
    assert numbers["takeoff_time"] is None
    assert numbers["touchdown"]["tilt"] > 60.0
    assert numbers["touchdown"]["speed"] > 0.5


def test_a_sliding_vehicle_is_stopped_by_friction(vehicle: Vehicle) -> None:
    """v^2 = 2 mu g s: feet at rest, friction 0.8."""
    start = make_state()
    start[1] = 1.0
    with Plant(vehicle, effects=Effects(ground=Ground())) as plant:
        plant.reset(start, np.zeros(4))
        plant.advance(np.zeros(4), 1000)
        state = plant.state()
    assert state[0] == pytest.approx(1.0 / (2.0 * 0.8 * vehicle.gravity), rel=0.1)
    assert abs(state[1]) < 1e-3


COMMAND = Command(speeds=np.zeros(4), plan=np.zeros((1, 4)), stats=Statistics(iterations=12))


def delay(computation: Computation, time: float = 0.0) -> float:
    return computation.taken(time, COMMAND, np.random.default_rng(0))


def test_fixed_part_and_iterations_add_up() -> None:
    assert delay(Computation()) == 0.0
    assert delay(Computation(delay=0.01, per_iteration={"law": 0.002})) == pytest.approx(0.034)


def test_iterations_take_the_time_of_whoever_counted_them() -> None:
    computation = Computation(per_iteration={"core": 1e-3, "piqp-multistage": 0.01})
    for answered_by, iterations_by, expected in (
        ("core", "", 0.002),
        ("piqp-multistage", "piqp-multistage", 0.02),
        ("fallback", "core", 0.002),
    ):
        stats = Statistics(iterations=2)
        command = replace(COMMAND, answered_by=answered_by, iterations_by=iterations_by, stats=stats)
        assert computation.taken(0.0, command, np.random.default_rng(0)) == pytest.approx(expected)
    with pytest.raises(ParameterError, match="per_iteration"):
        computation.taken(0.0, replace(COMMAND, iterations_by="daqp"), np.random.default_rng(0))


def test_jitter_is_exponential() -> None:
    rng = np.random.default_rng(0)
    computation = Computation(delay=0.005, jitter=0.01)
    waits = np.array([computation.taken(0.0, COMMAND, rng) for _ in range(20_000)]) - 0.005
    assert waits.min() >= 0.0
    assert waits.mean() == pytest.approx(0.01, rel=0.03)
    assert np.mean(waits > 0.03) == pytest.approx(np.exp(-3.0), rel=0.1)


@pytest.mark.parametrize(
    ("time", "expected"),
    [
        (0.95, 0.01),  # done before the stall
        (0.995, 0.105),  # caught by it
        (1.05, 0.05),  # begun in it
        (1.095, 0.01),  # it ends before the computation would
        (1.1, 0.01),  # over
    ],
)
def test_a_stall_holds_back_what_it_meets(time: float, expected: float) -> None:
    assert delay(Computation(delay=0.01, stalls=(Stall(at=1.0, duration=0.1),)), time) == pytest.approx(expected)


def test_stalls_follow_one_another_whatever_their_order() -> None:
    stalls = (Stall(at=0.02, duration=0.03), Stall(at=0.0, duration=0.02))
    assert delay(Computation(stalls=stalls)) == delay(Computation(stalls=stalls[::-1])) == pytest.approx(0.05)


@pytest.mark.parametrize(("delay", "periods"), [(0.0, 0), (0.02, 0), (0.05, 0), (0.051, 1), (0.1, 1), (0.101, 2)])
def test_a_command_spends_the_periods_before_its_own_under_way(delay: float, periods: int) -> None:
    """One that takes a whole period arrives at its end: none before that."""
    assert Computation(delay=delay).whole_periods(50, 1e-3) == periods


def test_the_latest_arrival_of_a_command_is_not_forgotten_with_an_earlier_one(vehicle: Vehicle, speeds: Array) -> None:
    """The first takes 120 ms, those after it 40: they arrive before it."""

    class Slowly(Scripted):
        def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
            iterations = 12 if not self.moments else 4
            return replace(super().step(now, state, reference), stats=Statistics(iterations=iterations))

    with Plant(vehicle) as plant:
        loop = ClosedLoop(
            plant,
            Slowly(speeds),
            np.zeros((20, 4)),
            initial_state=make_state(position=(0.0, 0.0, 10.0)),
            initial_speeds=plant.vehicle.hover_speeds,
            steps_per_period=STEPS,
            computation=Computation(per_iteration={"law": 0.01}),
        )
        answered = [(loop.step(), loop.answered)[1] for _ in range(3)]
    assert answered == pytest.approx([0.12, 0.12, 0.14])


def test_depth_is_below_the_lowest_height_so_far(vehicle: Vehicle, speeds: Array) -> None:
    """A course that climbs faster than the vehicle makes it no deeper; one that was lower allows as much."""
    for course, limit, lost in (([50.0], 5.0, False), ([-20.0, *7 * [50.0]], 5.0, False), ([10.0], -0.5, True)):
        reference = np.zeros((20, 4))
        reference[:, 2] = np.pad(course, (0, 20 - len(course)), mode="edge")
        with Plant(vehicle) as plant:
            log = fly_scripted(plant, Scripted(speeds), reference=reference, loss={"depth": limit})
        assert (log.lost == "depth") == lost
