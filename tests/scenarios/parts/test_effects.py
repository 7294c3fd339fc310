"""From the scenario file to what acts: every field arrives where it belongs, and events add up."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from quadsim.errors import InputError, ParameterError
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.sim.computation import Computation
from quadsim.sim.effects import Disturbance, Effects, Ground
from quadsim.sim.effects.battery import Battery
from quadsim.sim.effects.load import Load, Payload, PayloadDrop, PayloadPickup
from quadsim.sim.effects.rotors import RotorChange, RotorDynamics
from quadsim.sim.effects.wind import Air
from quadsim.vehicle import Vehicle


def scenario(*settings: str, vehicle: str = "lopes2011") -> tuple[Scenario, Vehicle]:
    loaded = load_scenario("hover", [f"vehicle.file={vehicle}", *settings])
    return loaded, Assembly(loaded).vehicle


def effects(*settings: str, vehicle: str = "lopes2011") -> Effects:
    loaded, modelled = scenario(*settings, vehicle=vehicle)
    return loaded.effects.resolved(modelled)


def event(**fields: Any) -> str:
    return "{" + ", ".join(f"{name} = {value!r}" for name, value in fields.items()) + "}"


def events(*entries: str) -> str:
    return f"events=[{', '.join(entries)}]"


def test_without_effects_nothing_acts() -> None:
    loaded, vehicle = scenario()
    assert loaded.effects.resolved(vehicle) == Effects()
    assert Assembly(loaded).changes() == ()
    assert Assembly(loaded).wind() is None
    assert Assembly(loaded).computation() is None


def test_every_field_arrives() -> None:
    result = effects(
        "effects.rotors={rise=0.01, fall=0.02, acceleration=900.0, inertia=1e-4, efficiency=[1.0, 0.9, 0.8, 0.7]}",
        "effects.air={density=1.1, rotor_drag=2e-4, inflow=2e-4, rotor_moment=[1e-5, 2e-5], "
        "inflow_moment=[3e-3, 4e-3], rate_damping=[1e-3, 2e-3, 3e-3], body_drag=[0.01, 0.02, 0.03]}",
        "effects.ground={effect=true, rotor_radius=0.1}",
        "effects.load={mass_factor=1.1, inertia_factor=[1.2, 1.1, 1.05], centre_of_mass=[0.01, 0.02, 0.03], "
        "payloads=[{mass=0.3, position=[0.0, 0.0, -0.1]}]}",
        "effects.disturbance={force=[1.0, 2.0, 3.0], torque=[0.1, 0.2, 0.3], force_noise=0.4, torque_noise=0.5, "
        "force_deviation=[0.1, 0.2, 0.3], force_time=[1.0, 2.0, 3.0], torque_deviation=[0.4, 0.5, 0.6], "
        "torque_time=[4.0, 5.0, 6.0]}",
        "effects.battery={cells=2, capacity=1.5, resistance=0.1, charge=0.8, curve=[[0.0, 3.0], [1.0, 4.0]], "
        "hover_current=9.0, idle_current=0.5, reference_voltage=7.5, exponent=1.5}",
    )
    assert result == Effects(
        rotors=RotorDynamics(rise=0.01, fall=0.02, acceleration=900.0, inertia=1e-4, efficiency=(1.0, 0.9, 0.8, 0.7)),
        air=Air(
            density=1.1,
            rotor_drag=2e-4,
            inflow=2e-4,
            rotor_moment=(1e-5, 2e-5),
            inflow_moment=(3e-3, 4e-3),
            rate_damping=(1e-3, 2e-3, 3e-3),
            body_drag=(0.01, 0.02, 0.03),
        ),
        ground=Ground(effect=True, rotor_radius=0.1),
        load=Load(
            mass_factor=1.1,
            inertia_factor=(1.2, 1.1, 1.05),
            centre_of_mass=(0.01, 0.02, 0.03),
            payloads=(Payload(mass=0.3, position=(0.0, 0.0, -0.1)),),
        ),
        disturbance=Disturbance(
            force=(1.0, 2.0, 3.0),
            torque=(0.1, 0.2, 0.3),
            force_noise=0.4,
            torque_noise=0.5,
            force_deviation=(0.1, 0.2, 0.3),
            force_time=(1.0, 2.0, 3.0),
            torque_deviation=(0.4, 0.5, 0.6),
            torque_time=(4.0, 5.0, 6.0),
        ),
        battery=Battery(
            cells=2,
            capacity=1.5,
            resistance=0.1,
            charge=0.8,
            curve=((0.0, 3.0), (1.0, 4.0)),
            hover_current=9.0,
            idle_current=0.5,
            reference_voltage=7.5,
            exponent=1.5,
        ),
    )


def test_sizes_left_out_are_the_vehicle_s() -> None:
    loaded, vehicle = scenario(
        "effects={rotors={}, air={}, ground={effect=true}, battery={cells=3, capacity=2.1}}", vehicle="hummingbird"
    )
    result = loaded.effects.resolved(vehicle)
    assert result.rotors is not None
    assert result.air is not None
    assert result.ground is not None
    assert (result.rotors.rise, result.rotors.fall) == (vehicle.rotor_rise, vehicle.rotor_fall)
    assert result.rotors.inertia == vehicle.rotor_inertia
    assert (result.air.rotor_drag, result.air.body_drag) == (vehicle.rotor_drag, vehicle.body_drag)
    assert result.ground.rotor_radius == vehicle.rotor_radius
    assert result.battery is not None
    assert result.battery.reference_voltage == pytest.approx(12.6)
    assert result.battery.hover_current is not None
    assert result.resolved(vehicle) == result


LOSS = {"type": "rotor_loss", "rotor": 2}


@pytest.mark.parametrize("order", [1, -1])
def test_losses_of_a_rotor_multiply_while_they_last(order: int) -> None:
    entries = [
        event(**LOSS, at=1.0, loss=0.2),
        event(**LOSS, at=2.0, loss=0.5, duration=2.0),
        event(**LOSS, at=3.0, loss=0.1, duration=3.0),
        event(**LOSS, at=3.0, loss=0.3),
        event(type="rotor_loss", rotor=4, at=2.0, loss=1.0),
    ][::order]
    result = Assembly(scenario("effects.rotors.efficiency=[1.0, 0.9, 1.0, 1.0]", events(*entries))[0]).changes()
    shares = {
        change.at: change.efficiency for change in result if isinstance(change, RotorChange) and change.rotor == 2
    }
    expected = {1.0: 0.8, 2.0: 0.4, 3.0: 0.4 * 0.9 * 0.7, 4.0: 0.8 * 0.9 * 0.7, 6.0: 0.8 * 0.7}
    assert shares == pytest.approx({time: 0.9 * share for time, share in expected.items()})
    assert RotorChange(at=2.0, rotor=4, efficiency=0.0) in result
    assert len(result) == 6


def test_payloads_come_and_go() -> None:
    entries = (
        event(type="payload_pickup", at=1.0, mass=0.5, position=[0.1, 0.0, 0.0]),
        event(type="payload_drop", at=2.0),
    )
    result = Assembly(scenario(events(*entries))[0]).changes()
    assert result == (PayloadPickup(at=1.0, mass=0.5, position=(0.1, 0.0, 0.0)), PayloadDrop(at=2.0))


def test_wind_is_mean_gusts_and_changes() -> None:
    loaded, _ = scenario(
        "effects.air={rotor_drag=1e-4, wind=[1.0, 0.0, 0.0]}",
        events(
            event(type="gust", at=1.0, duration=2.0, velocity=[0.0, 3.0, 0.0]),
            event(type="wind", at=4.0, velocity=[0.0, 0.0, -2.0]),
        ),
    )
    field = Assembly(loaded).wind()
    assert field is not None
    wind = field.advance(6000)
    np.testing.assert_allclose(wind[[500, 1999, 3999, 4000]], [[1, 0, 0], [1, 3, 0], [1, 0, 0], [0, 0, -2]], atol=1e-5)


def test_turbulence_passes_at_the_mean_wind_s_speed() -> None:
    air = "effects.air={rotor_drag=1e-4, wind=[3.0, 4.0, 0.0], turbulence={wind_speed_20ft=8.0}}"
    loaded, vehicle = scenario(air)
    resolved = loaded.effects.resolved(vehicle)
    assert resolved.air is not None
    assert resolved.air.turbulence is not None
    assert resolved.air.turbulence.airspeed == 5.0


def test_computation_takes_its_times_and_stalls() -> None:
    stall = events(event(type="stall", at=1.0, duration=0.2))
    result = Assembly(scenario(stall)[0]).computation()
    assert result is not None
    assert [(each.at, each.duration) for each in result.stalls] == [(1.0, 0.2)]
    assert replace(result, stalls=()) == Computation(plan=False)
    loaded, _ = scenario("computation={delay=0.01, per_iteration={piqp=1e-4}, jitter=0.002}")
    expected = Computation(delay=0.01, per_iteration={"piqp-multistage": 1e-4}, plan=False, jitter=0.002)
    assert Assembly(loaded).computation() == expected


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("robust", ["computation.per_iteration.piqp=1e-3"], "also for core"),
        ("robust", ["computation.per_iteration.core=1e-5"], "also for piqp-multistage"),
        ("robust", ["computation.per_iteration={core=1e-5, piqp=1e-3}"], None),
        ("robust", ["controller.solver=piqp", "computation.per_iteration.piqp=1e-3"], None),
        ("robust", ["controller.solver=daqp", "computation.per_iteration.core=1e-5"], "also for daqp"),
        ("robust", ["controller.solver=daqp", "computation.per_iteration.daqp=1e-5"], None),
        ("paper-constrained", ["computation.per_iteration.core=1e-5"], "also for piqp-multistage"),
        (
            "paper-constrained",
            ["controller.solver=clarabel", "computation.per_iteration.clarabel=1e-5"],
            "no iterations",
        ),
        ("paper-unconstrained", ["computation.per_iteration.piqp=1e-3"], "no iterations"),
        ("nonlinear", ["computation.per_iteration.core=1e-5"], "also for nonlinear"),
        ("nonlinear", ["computation.per_iteration.nonlinear=1e-5"], None),
        ("robust", ["computation.per_iteration={core=1e-5, piqp=1e-3, piqqp=1e-3}"], "piqqp must be absent, or one of"),
        ("robust", ["computation.per_iteration={piqp-multistage-1=1e-3}"], "was removed: use 'piqp-multistage'"),
        (
            "robust",
            ["computation.per_iteration={core=1e-5, piqp=1e-3, piqp-multistage=2e-3}"],
            "given once: piqp-multistage is another name",
        ),
    ],
)
def test_times_of_iterations_are_those_of_the_solver_that_answers(
    name: str, settings: list[str], message: str | None
) -> None:
    assembly = Assembly(load_scenario(name, settings))
    if message is None:
        assembly.controller()
        return
    with pytest.raises(ParameterError, match=message):
        assembly.controller()


def test_a_time_of_iterations_without_a_solver_is_refused() -> None:
    with pytest.raises(InputError, match=r"computation\.per_iteration"):
        load_scenario("robust", ["computation.per_iteration=1e-3"])


@pytest.mark.parametrize(
    ("name", "settings", "expected"),
    [
        ("robust", [], True),
        ("robust", ["controller.fallback.enabled=false"], False),
        ("robust", ["computation={plan=false}"], False),
        ("paper-constrained", [], False),
        ("paper-constrained", ["controller.fallback={}"], True),
        ("paper-constrained", ["computation={plan=true}"], True),
        ("paper-unconstrained", [], False),
    ],
)
def test_within_the_fallback_contract_a_missed_deadline_applies_the_plan(
    name: str, settings: list[str], expected: bool
) -> None:
    loaded = load_scenario(name, [events(event(type="stall", at=1.0, duration=0.2)), *settings])
    computation = Assembly(loaded).computation()
    assert computation is not None
    assert computation.plan is expected
