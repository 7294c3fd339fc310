"""Flights through an autopilot: one contract for any law of any target; late commands, sensors, vehicle files."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

import quadsim
from quadsim.assets import vehicle_path
from quadsim.controller import StepInputs
from quadsim.errors import InputError
from quadsim.mpc.pilot.pilot import Pilot
from quadsim.rollout.reaudit import reaudit
from quadsim.rotation import conjugate, multiply
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.plugin import Plugin, make_law
from quadsim.sim.autopilot import Autopilot, AutopilotSettings
from quadsim.state import Array, State
from quadsim.vehicle import Vehicle

START = {
    "vehicle.file": "hummingbird",
    "duration": 3.0,
    "control_period": 0.02,
    "effects.rotors": {},
    "plant.limit_speeds": True,
    "initial.position": [0.5, -0.3, 0.2],
    "reference.response_time": 0.0,
    "constraints": [],
}
AUDITED = [
    {"name": "thrust", "signal": "thrust", "lower": 2.0, "upper": 15.0},
    {"name": "rate", "signal": "body_rate_x", "lower": -200.0, "upper": 200.0},
]


def home(t: float) -> list[float]:
    return [0.0, 0.0, 0.0, 0.0]


class Rates:
    """Position by PD, the thrust axis by proportional body rates."""

    commands = "rates"

    def __init__(self, vehicle: Vehicle, period: float, horizon: int) -> None:
        self.mass = vehicle.mass
        self.gravity = vehicle.gravity

    def force(self, state: State, reference: Array) -> Array:
        away = reference[0, :3] - [state.x, state.y, state.z]
        return np.asarray(4.0 * away - 3.0 * np.array([state.vx, state.vy, state.vz]) + [0.0, 0.0, self.gravity])

    def step(self, now: StepInputs, state: State, reference: Array) -> Any:
        assert now.attitude is not None
        force = self.force(state, reference)
        along = multiply(multiply(conjugate(now.attitude), np.append(0.0, force)), now.attitude)[1:]
        return [self.mass * along[2], -8.0 * along[1] / 9.8, 8.0 * along[0] / 9.8, -2.0 * state.yaw]


class Attitude(Rates):
    """The same force, its attitude held by the autopilot."""

    commands = "attitude"

    def step(self, now: StepInputs, state: State, reference: Array) -> Any:
        force = self.force(state, reference)
        size = float(np.linalg.norm(force))
        tilted = np.array([1.0 + force[2] / size, -force[1] / size, force[0] / size, 0.0])
        return [self.mass * size, 0.0, 0.0, 0.0, *(tilted / np.linalg.norm(tilted))]


THRUST = (3.5, 12.0)
BODY_RATES = (150.0, 140.0, 60.0)
TABLES: dict[str, dict[str, Any]] = {
    "nonlinear of rates": {"type": "nonlinear", "commands": "rates", "horizon": 20, "terminal": "lqr"},
    "geometric of rates": {"type": "geometric", "commands": "rates"},
    "geometric of attitudes": {"type": "geometric", "commands": "attitude"},
}
LAWS: dict[str, Any] = {**TABLES, "own of rates": Rates, "own of attitudes": Attitude}
OTHER_SPACE = {
    "indi": ({}, "indi must be absent where commands = "),
    "input_bounds": ({"speed": [0.0, 250.0], "slew": [-9.0, 9.0]}, "input_bounds@ must be absent where commands = "),
    "disturbance": ({"rotor_lag": 0.02}, "disturbance.rotor_lag must be absent where commands = "),
}
OF_TARGETS = {"inner_lag": [0.02, 0.035, 0.035, 0.1], "target_bounds": {"body_rate": 100.0}}


@pytest.fixture(scope="module")
def scenario() -> quadsim.Scenario:
    return quadsim.load("hover").replace(START)


@pytest.fixture(scope="module", params=LAWS)
def law(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def flight(scenario: quadsim.Scenario, law: str) -> quadsim.Flight:
    audited = scenario.replace({"constraints": AUDITED})
    if law not in TABLES:
        return quadsim.fly(audited, controller=LAWS[law], reference=home, progress=False)
    table = TABLES[law] | {"target_bounds": {"thrust": [*THRUST], "body_rate": [*BODY_RATES]}}
    return quadsim.fly(audited.replace({"controller": table}), reference=home, progress=False)


def test_it_comes_to_its_set_point_with_the_thrust_of_the_weight(law: str, flight: quadsim.Flight) -> None:
    target = flight.log.control.target
    attitude = flight.log.control.target_attitude
    assert flight.log.reason is None
    assert [abs(flight.state[axis][-1]) for axis in "xyz"] == pytest.approx([0.0] * 3, abs=0.03)
    assert target is not None
    assert target.shape == (150, 4)
    np.testing.assert_allclose(target[-1], [0.716 * 9.81, 0.0, 0.0, 0.0], atol=0.1)
    assert (attitude is not None) == law.endswith("attitudes")
    if attitude is not None:
        np.testing.assert_allclose(np.linalg.norm(attitude, axis=1), 1.0)


def test_its_targets_hold_the_bounds_that_it_has(law: str, flight: quadsim.Flight) -> None:
    if law not in TABLES:
        assert {finding.limit.name for finding in flight.findings} == {"thrust", "rate"}
        return
    target = flight.log.control.target
    assert target is not None
    assert np.all((target[:, 0] >= THRUST[0] - 1e-9) & (target[:, 0] <= THRUST[1] + 1e-9))
    assert np.all(np.abs(target[:, 1:]) <= np.radians(BODY_RATES) + 1e-9)
    assert {"body_rate_y", "body_rate_z"} <= {finding.limit.signal for finding in flight.findings}


def test_thrust_is_audited_as_commanded_and_as_flown(flight: quadsim.Flight) -> None:
    control = flight.log.control
    plant = flight.log.plant
    assert control.target is not None
    assert plant.thrust is not None
    mid = 0.5 * (plant.speeds[1:] + plant.speeds[:-1])  # flown thrust is that of the rotors between steps
    b = Assembly(flight.scenario).vehicle.thrust_coefficient
    np.testing.assert_allclose(plant.thrust[:-1], b * np.square(mid).sum(axis=1), rtol=2e-3)
    finding = {finding.limit.name: finding for finding in flight.findings}["thrust"]
    commanded, flown = (min((v - 2.0).min(), (15.0 - v).min()) for v in (control.target[:, 0], plant.thrust))
    assert finding.worst_margin_sampled == pytest.approx(commanded)
    assert finding.worst_margin == pytest.approx(flown)


def test_a_saved_flight_keeps_its_targets(flight: quadsim.Flight, tmp_path: Path) -> None:
    read = quadsim.read(flight.save(tmp_path / "run", video=False, recording=False, figures=False))
    for name in ("target", "target_attitude"):
        np.testing.assert_array_equal(getattr(read.log.control, name), getattr(flight.log.control, name))
    assert reaudit(tmp_path / "run").satisfied == flight.satisfied


@pytest.mark.slow("autopilot")
@pytest.mark.parametrize(
    "table",
    [
        pytest.param("geometric of attitudes", marks=pytest.mark.representative("autopilot")),
        "geometric of rates",
        "nonlinear of rates",
    ],
)
def test_what_it_asks_for_on_the_ground_reaches_nobody_and_is_not_bounded(table: str) -> None:
    take_off = quadsim.load("take-off-and-landing").replace({"controller": TABLES[table], "duration": 2.0})
    log = (flight := quadsim.fly(take_off, progress=False)).log
    assert log.control.target is not None
    assert log.plant.thrust is not None
    landed = np.array([phase == "landed" for phase in log.control.phase])
    assert landed.any()
    np.testing.assert_array_equal(np.isnan(log.control.target).all(axis=1), landed)
    assert np.isnan(log.plant.thrust).any()
    finding = {finding.limit.signal: finding for finding in flight.findings}["thrust"]
    assert finding.worst_margin > -5.0  # not the whole weight


@pytest.mark.parametrize("field", OTHER_SPACE)
@pytest.mark.parametrize("table", TABLES)
def test_fields_of_rotor_speeds_are_refused(table: str, field: str) -> None:
    value, rule = OTHER_SPACE[field]
    with pytest.raises(InputError, match=rule.replace("@", ".*")):
        quadsim.load("hover").replace({**START, "controller": {**TABLES[table], field: value}})


@pytest.mark.parametrize("field", OF_TARGETS)
@pytest.mark.parametrize("kind", sorted({table["type"] for table in TABLES.values()}))
def test_fields_of_targets_are_refused_where_it_commands_rotors(kind: str, field: str) -> None:
    with pytest.raises(InputError, match=field):
        quadsim.load("hover").replace({**START, "controller": {"type": kind, field: OF_TARGETS[field]}})


def test_thrust_has_no_bound_where_nothing_commands_it(scenario: quadsim.Scenario) -> None:
    entry = {"name": "thrust", "signal": "thrust", "lower": 0.0}
    flight = quadsim.fly(scenario.replace({"constraints": [entry], "duration": 0.1}), progress=False)
    assert flight.findings[0].verdict == "incomplete"


def test_a_late_target_leaves_the_one_in_force_to_the_autopilot(scenario: quadsim.Scenario) -> None:
    class Turning(Rates):
        def step(self, now: StepInputs, state: State, reference: Array) -> Any:
            return [7.0, 0.0, 0.0, 0.1 + 0.1 * round(now.time / 0.02)]

    late = scenario.replace({"computation.delay": 0.01, "duration": 0.2, "initial.position": [0.0, 0.0, 0.0]})
    log = quadsim.fly(late, controller=Turning, progress=False).log
    assert log.control.target is not None
    np.testing.assert_allclose(log.control.target[:, 3], 0.1 + 0.1 * np.arange(10), atol=1e-12)
    later = quadsim.fly(late.replace({"computation.delay": 0.03}), controller=Turning, progress=False).log
    assert later.control.target is not None
    np.testing.assert_allclose(later.control.target[:, 3], 0.1 + 0.1 * np.arange(10), atol=1e-12)
    held = later.plant.t < 0.03  # hover's rotor speeds stay in force until the first arrives
    np.testing.assert_allclose(later.plant.speeds[held], later.plant.speeds[0, 0], rtol=1e-12)
    assert (np.ptp(later.plant.speeds[~held], axis=1) > 0.0).any()


def test_a_law_is_told_the_target_in_force_which_is_hover_at_first(scenario: quadsim.Scenario) -> None:
    class Noting(Rates):
        told: ClassVar[list[Array]] = []

        def step(self, now: StepInputs, state: State, reference: Array) -> Any:
            assert now.acting is not None
            self.told.append(np.array(now.acting))
            return [7.0, 0.0, 0.1, 0.2]

    quadsim.fly(scenario.replace({"duration": 0.06}), controller=Noting, progress=False)
    np.testing.assert_allclose(Noting.told, [[0.716 * 9.81, 0.0, 0.0, 0.0], *2 * [[7.0, 0.0, 0.1, 0.2]]], rtol=1e-3)


def test_what_the_gyro_measures_reaches_the_autopilot(scenario: quadsim.Scenario) -> None:
    biased = scenario.replace({"sensors.rates": {"rate": 1000.0, "bias": [0.0, 0.0, 20.0]}, "duration": 1.0})

    class Still(Rates):
        def step(self, now: StepInputs, state: State, reference: Array) -> Any:
            return [self.mass * self.gravity, 0.0, 0.0, 0.0]

    flight = quadsim.fly(biased, controller=Still, progress=False)
    rates = flight.log.plant.body_rates
    spin = flight.log.plant.state[-1, 11] if rates is None else rates[-1, 2]
    assert np.degrees(spin) == pytest.approx(-20.0, abs=1.0)


def test_sensor_faults_leave_the_autopilot_its_last_finite_rates(scenario: quadsim.Scenario) -> None:
    fault = {"type": "sensor_fault", "sensor": "rates", "fault": "nan", "at": 1.0, "duration": 0.05}
    changes = {"sensors.rates": {"rate": 1000.0}, "events": [fault], "duration": 2.0}
    assert quadsim.fly(scenario.replace(changes), controller=Rates, progress=False).log.reason is None


def test_the_autopilot_of_a_vehicle_file_flies_unless_the_scenario_states_another(
    scenario: quadsim.Scenario, tmp_path: Path
) -> None:
    text = vehicle_path("hummingbird").read_text()
    file = tmp_path / "mine.toml"
    file.write_text(text + '\n[autopilot]\nsource = "step on the bench"\np = [11.0, 12.0, 13.0]\nrate = 500.0\n')
    settings = Assembly(scenario.replace({"vehicle.file": str(file)})).autopilot
    assert settings is not None
    assert (settings.p, settings.rate, settings.d) == ((11.0, 12.0, 13.0), 500.0, None)
    stated = scenario.replace({"vehicle.file": str(file), "autopilot.rate": 1000.0})
    assembly = Assembly(stated)
    assert assembly.autopilot is not None
    assert (assembly.autopilot.p, assembly.autopilot.rate) == ((11.0, 12.0, 13.0), 1000.0)
    assert Assembly(assembly.resolved.scenario.replace({"vehicle.file": "gone.toml"})).autopilot == assembly.autopilot
    assert quadsim.load_vehicle(str(file)).mass == quadsim.load_vehicle("hummingbird").mass


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("[autopilot]\np = [1.0, 1.0, 1.0]\n", "autopilot must be a table with a source"),
        ('[autopilot]\nsource = "x"\np = 3.0\n', "autopilot.p"),
        ('[autopilot]\nsource = "x"\nspeed = 3.0\n', "autopilot.speed is not a field of the vehicle file"),
    ],
)
def test_a_wrong_autopilot_of_a_vehicle_file_is_refused(table: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(vehicle_path("hummingbird").read_text() + "\n" + table)
    with pytest.raises(InputError, match=message):
        quadsim.vehicle_report(str(file))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"autopilot.rate": 300.0}, r"autopilot.rate must be such that 1 / rate is a whole multiple"),
        ({"autopilot.p": [1.0, 2.0]}, r"autopilot.p must be a list of 3"),
        ({"autopilot.idle": 1.5}, r"autopilot.idle"),
    ],
)
def test_a_wrong_autopilot_is_refused(scenario: quadsim.Scenario, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        scenario.replace(changes)


def test_tables_of_changes_stay_as_they_are(scenario: quadsim.Scenario) -> None:
    changes = {"effects": {"rotors": {"rise": 0.05}}, "effects.rotors.fall": 0.1}
    assert scenario.replace(changes).effects.rotors.fall == 0.1  # type: ignore[union-attr]
    assert changes["effects"] == {"rotors": {"rise": 0.05}}


@pytest.mark.parametrize("kind", ["velocity", ["rates"]])
def test_an_unknown_kind_of_command_is_refused(scenario: quadsim.Scenario, kind: object) -> None:
    class Odd(Rates):
        commands = kind  # type: ignore[assignment]

    with pytest.raises(InputError, match="commands"):
        quadsim.fly(scenario, controller=Odd, progress=False)


@pytest.mark.parametrize("attitude", [[0.0, 0.0, 0.0, 0.0], [3.0, 0.0, 0.0, 0.0]])
def test_an_attitude_is_a_unit_quaternion(scenario: quadsim.Scenario, attitude: list[float]) -> None:
    class Odd(Attitude):
        def step(self, now: StepInputs, state: State, reference: Array) -> Any:
            return [7.0, 0.0, 0.0, 0.0, *attitude]

    flight = quadsim.fly(scenario, controller=Odd, progress=False)
    assert flight.log.reason is not None
    assert "its attitude must be a unit quaternion" in flight.log.reason


class Counting(Autopilot):
    """The built-in autopilot, counting."""

    resets = calls = 0

    def reset(self) -> None:
        self.resets += 1
        super().reset()

    def speeds(self, time: float, commanded: Array, rates: Array, rotors: Array, attitude: Array) -> Array:
        self.calls += 1
        return super().speeds(time, commanded, rates, rotors, attitude)


MPC = TABLES["nonlinear of rates"]


def test_a_controller_that_takes_over_leaves_the_autopilot_flying(scenario: quadsim.Scenario) -> None:
    event = {"type": "controller", "at": 0.2, "fields": {"tilt": 30.0}}
    changes = {"controller": MPC, "duration": 0.4, "events": [event], "initial.position": [0.0, 0.0, 0.0]}
    autopilot = Counting(quadsim.load_vehicle("hummingbird"))
    flight = quadsim.fly(scenario.replace(changes), autopilot=autopilot, progress=False)
    assert flight.satisfied
    flown = flight.summary["controller"]["autopilot"]
    assert flown["name"] == "Counting"
    assert flown["inner_lag"] == pytest.approx([0.0137, 0.0333, 0.0333, 0.05], abs=0.005)
    identified = autopilot.calls - 400
    assert identified == 4 * 300  # once, before the flight
    assert autopilot.resets == 1 + 4 + 1  # built, identified, flown


def test_an_autopilot_starts_anew_when_it_takes_off() -> None:
    law = {"type": "geometric", "commands": "rates", "inner_lag": OF_TARGETS["inner_lag"]}
    take_off = quadsim.load("take-off-and-landing").replace({"controller": law, "autopilot": {}, "duration": 2.0})
    autopilot = Counting(Assembly(take_off).vehicle)
    before = autopilot.resets
    flight = quadsim.fly(take_off, autopilot=autopilot, progress=False)
    assert flight.log.control.phase[0] == "landed"
    assert autopilot.calls > 0
    assert autopilot.resets == before + 1


def test_a_law_of_targets_takes_over_from_the_law_and_not_from_its_autopilot(scenario: quadsim.Scenario) -> None:
    class Heir(Rates):
        seen: object = None

        def adopt(self, previous: object) -> None:
            Heir.seen = previous

    assembly = Assembly(scenario)
    spec = Plugin(type="tests:Heir")
    laws = [Rates(assembly.vehicle, 0.02, 50), Heir(assembly.vehicle, 0.02, 50)]
    first, second = (
        assembly.with_autopilot(Pilot(make_law(law, spec, assembly.vehicle, 0.02), assembly.vehicle)) for law in laws
    )
    assert first.takes_targets
    second.adopt(first)
    assert Heir.seen is laws[0]


def test_an_autopilot_of_ones_own_needs_a_controller_of_targets(scenario: quadsim.Scenario) -> None:
    with pytest.raises(InputError, match="autopilot"):
        quadsim.fly(scenario, autopilot=Counting(quadsim.load_vehicle("hummingbird")), progress=False)


def test_the_autopilot_is_called_at_its_rate_also_where_commands_are_late(scenario: quadsim.Scenario) -> None:
    autopilot = Counting(quadsim.load_vehicle("hummingbird"), AutopilotSettings(rate=500.0))
    late = {"controller": {**MPC, "inner_lag": [0.02, 0.04, 0.04, 0.05]}, "duration": 1.0, "computation.delay": 0.005}
    quadsim.fly(scenario.replace(late), autopilot=autopilot, progress=False)
    assert autopilot.calls == pytest.approx((1.0 - 0.005) * 500.0, abs=1.0)


@pytest.mark.parametrize("law", [{"type": "nonlinear", "horizon": 10, "node": 0.04}, {"type": "geometric"}])
def test_the_thrust_scale_that_is_logged_is_the_share_that_a_battery_leaves(
    scenario: quadsim.Scenario, law: dict[str, Any]
) -> None:
    """(V / V0)^2, which falls by a tenth; the estimate tracks it, and one that is not asked for is not logged."""
    battery = {"cells": 3, "capacity": 0.005, "resistance": 0.1, "charge": 0.9}
    controller = {**law, "commands": "rates", "disturbance": {}}
    changes = {"controller": controller, "effects.battery": battery, "duration": 1.5, "initial.position": [0.0] * 3}
    flight = quadsim.fly(scenario.replace(changes), progress=False)
    log = flight.log.plant
    settled = flight.time > 0.5
    assert log.battery is not None
    share = np.square(log.battery[np.searchsorted(log.t, flight.time - 1e-9), 0] / 12.6)[settled]
    assert share[-1] < share[0] - 0.05
    np.testing.assert_allclose(flight.logged["thrust_scale"][settled], share, rtol=0.02)
    force = scenario.replace(
        {**changes, "controller": {**controller, "disturbance": {"thrust_scale": False}}, "duration": 0.1}
    )
    assert "thrust_scale" not in quadsim.fly(force, progress=False).logged
