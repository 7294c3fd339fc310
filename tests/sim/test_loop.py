"""The closed loop: what ends up in the log, whatever happens."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from quadsim.controller import Command, Controller, Phase, StepInputs
from quadsim.errors import PlanExhaustedError
from quadsim.flight.log import FlightLog
from quadsim.flight.phase import PhaseMonitor
from quadsim.sim.loop import fly
from quadsim.sim.plant import Plant
from quadsim.state import Array, make_state
from quadsim.vehicle import Vehicle

PERIODS = 10
STEPS = 50
HORIZON = 4


@dataclass
class Scripted:
    """A controller that commands what it is given, and may raise."""

    speeds: Array
    raises: dict[int, BaseException] = field(default_factory=dict)
    name: str = "scripted"
    solver: str = ""
    horizon: int = HORIZON
    seen: list[tuple[float, Array, Array]] = field(default_factory=list)

    def reset(self, speeds: Array) -> None:
        self.seen = []

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        k = len(self.seen)
        self.seen.append((now.time, state, reference))
        if k in self.raises:
            raise self.raises[k]
        return Command(speeds=self.speeds[k], plan=np.tile(self.speeds[k], (HORIZON, 1)))

    def predict(self, states: Array, plans: Array) -> Array:
        return np.repeat(states[:, None, :], plans.shape[1], axis=1)


def fly_scripted(vehicle: Vehicle, controller: Controller, *, yaw: float = 0.0) -> FlightLog:
    reference = np.arange((PERIODS + HORIZON) * 4.0).reshape(-1, 4)
    with Plant(vehicle) as plant:
        return fly(
            plant,
            controller,
            reference,
            initial_state=make_state(euler=(0.0, 0.0, yaw)),
            initial_speeds=plant.vehicle.hover_speeds,
            periods=PERIODS,
            steps_per_period=STEPS,
        )


@pytest.fixture
def speeds(vehicle: Vehicle) -> Array:
    return vehicle.hover_speed + np.random.default_rng(5).uniform(-3, 3, (PERIODS, 4))


def test_samples_plant_and_commands_line_up(vehicle: Vehicle, speeds: Array) -> None:
    controller = Scripted(speeds)
    log = fly_scripted(vehicle, controller)
    assert log.status == "completed"
    assert log.reason is None
    np.testing.assert_array_equal(log.control.speeds, speeds)
    np.testing.assert_allclose(log.plant.t, np.arange(PERIODS * STEPS + 1) * 1e-3, atol=1e-12)
    np.testing.assert_allclose(log.plant.state[:-1:STEPS], log.control.state, atol=1e-12)
    np.testing.assert_array_equal(log.plant.speeds[:-1], np.repeat(speeds, STEPS, axis=0))
    np.testing.assert_array_equal(log.control.slews[0], speeds[0] - vehicle.hover_speed)
    assert log.predicted is not None
    assert log.predicted.shape == (PERIODS, HORIZON, 3)


@pytest.mark.parametrize("yaw", [0.0, 3.5, -3.3, 7.0])
def test_samples_and_plant_agree_on_the_turn_of_yaw(vehicle: Vehicle, speeds: Array, yaw: float) -> None:
    log = fly_scripted(vehicle, Scripted(speeds), yaw=yaw)
    assert log.control.state[0, 10] == pytest.approx(yaw)
    np.testing.assert_allclose(log.plant.state[:-1:STEPS], log.control.state, atol=1e-12)


def test_preview_starts_one_period_ahead(vehicle: Vehicle, speeds: Array) -> None:
    controller = Scripted(speeds)
    log = fly_scripted(vehicle, controller)
    for k, (time, state, preview) in enumerate(controller.seen):
        assert time == pytest.approx(0.05 * k)
        np.testing.assert_array_equal(state, log.control.state[k])
        np.testing.assert_array_equal(preview[:, 0], 4.0 * (k + 1 + np.arange(HORIZON)))
        assert log.control.reference[k, 0] == 4.0 * k


def test_a_bad_command_ends_the_flight_and_never_reaches_the_plant(vehicle: Vehicle, speeds: Array) -> None:
    speeds[6, 2] = np.nan
    log = fly_scripted(vehicle, Scripted(speeds))
    assert log.status == "aborted"
    assert log.reason is not None
    assert log.reason.startswith("at t = 0.300 s: the command is not finite")
    assert log.control.t.size == 6
    assert log.plant.t.size == 6 * STEPS + 1
    assert np.all(np.isfinite(log.plant.state))


def test_a_controller_that_gives_up_ends_the_flight(vehicle: Vehicle, speeds: Array) -> None:
    log = fly_scripted(vehicle, Scripted(speeds, raises={3: PlanExhaustedError("no plan", time=0.15)}))
    assert (log.reason, log.control.t.size) == ("at t = 0.150 s: no plan", 3)


def test_a_flight_may_end_before_its_first_period(vehicle: Vehicle, speeds: Array) -> None:
    log = fly_scripted(vehicle, Scripted(speeds, raises={0: PlanExhaustedError("no plan", time=0.0)}))
    assert log.control.t.size == 0
    assert log.control.speeds.shape == (0, 4)
    assert log.plant.t.tolist() == [0.0]
    assert log.predicted is None


def test_ctrl_c_is_recorded(vehicle: Vehicle, speeds: Array) -> None:
    log = fly_scripted(vehicle, Scripted(speeds, raises={4: KeyboardInterrupt()}))
    assert log.interrupted
    assert log.reason == "at t = 0.200 s: interrupted (Ctrl-C)"
    assert log.control.t.size == 4


@pytest.mark.parametrize("error", [ZeroDivisionError("by 0"), SystemExit(0), MemoryError()], ids=repr)
def test_a_controller_that_raises_ends_the_flight_with_its_traceback(
    vehicle: Vehicle, speeds: Array, error: BaseException
) -> None:
    log = fly_scripted(vehicle, Scripted(speeds, raises={2: error}))
    assert str(log.reason).startswith(f"at t = 0.100 s: the controller raised {type(error).__name__}")
    assert (log.control.t.size, log.aborted, log.interrupted) == (2, True, False)
    assert log.traceback[-1].startswith(type(error).__name__)
    assert any("in step" in line for line in log.traceback)


# --- flights that are lost -----------------------------------------------------------------------------------------


def fall(
    vehicle: Vehicle, loss: dict[str, float], *, descent: float = 0.0, ground: PhaseMonitor | None = None
) -> FlightLog:
    """Fly without thrust along a reference that goes down by `descent` [m] per period."""
    reference = np.zeros((PERIODS + HORIZON, 4))
    reference[:, 2] = -descent * np.arange(PERIODS + HORIZON)
    with Plant(vehicle) as plant:
        return fly(
            plant,
            Scripted(np.zeros((PERIODS, 4))),
            reference,
            initial_state=make_state(),
            initial_speeds=plant.vehicle.hover_speeds,
            periods=PERIODS,
            steps_per_period=STEPS,
            ground=ground,
            loss=loss,
        )


def test_a_flight_that_is_lost_is_recorded_up_to_there(vehicle: Vehicle) -> None:
    """A free fall is 0.5 m deep between the samples at 0.3 and 0.35 s."""
    whole, cut = (fall(vehicle, {"depth": depth}) for depth in (math.inf, 0.5))
    assert (whole.reason, whole.lost, whole.control.t.size) == (None, None, PERIODS)
    assert (cut.status, cut.lost, cut.interrupted) == ("aborted", "depth", False)
    result = "the depth below the lowest of start and reference is 0.60086 m"
    assert cut.reason == f"at t = 0.350 s: lost: {result}, beyond lost.depth = 0.5 m"
    assert (cut.control.t.size, cut.plant.t[-1]) == (7, 0.35)
    np.testing.assert_array_equal(cut.plant.state, whole.plant.state[: cut.plant.t.size])
    np.testing.assert_array_equal(cut.control.speeds, whole.control.speeds[:7])


def test_a_course_that_goes_down_is_no_fall(vehicle: Vehicle) -> None:
    assert fall(vehicle, {"depth": 0.5}, descent=0.1).reason is None


def test_what_has_crashed_is_not_lost_as_well(vehicle: Vehicle) -> None:
    class Crashed(PhaseMonitor):
        def __init__(self) -> None:
            """Know no ground."""

        def reset(self) -> None:
            """Nothing is remembered."""

        def advance(self, t: Array, states: Array, preview: Array) -> Phase:
            return Phase.CRASHED

    assert fall(vehicle, {"depth": 0.5}, ground=Crashed()).reason is None
