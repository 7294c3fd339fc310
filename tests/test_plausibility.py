"""Numbers of a vehicle that contradict each other are named, with the unit that would explain them."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

import quadsim
from quadsim.assets import vehicle_names, vehicle_path
from quadsim.errors import ParameterError
from quadsim.features.design.plausible_vehicles import plausible_vehicles
from quadsim.plausibility import implausible
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.vehicle import VEHICLE_UNITS, Vehicle, load_vehicle

FACTORS = (1e3, 1e-3, math.degrees(1.0), 2.0 * math.pi)
SHIPPED = [load_vehicle(vehicle_path(name)) for name in vehicle_names()]
WITHOUT_EFFECT_IF_SMALL = ("rotor_drag", "body_drag", "rotor_inertia", "speed_min")
CLOSE = 0.02  # how far the flight of a mutated vehicle may be from the original's [m]


def template() -> Vehicle:
    """A vehicle whose file states all optional numbers but its extent."""
    return load_vehicle(vehicle_path("hummingbird"))


def test_what_ships_and_what_one_might_build_is_plausible() -> None:
    for vehicle in (*SHIPPED, *plausible_vehicles(200, seed=4)):
        assert implausible(vehicle) == [], vehicle.name


def scaled(vehicle: Vehicle, name: str, factor: float) -> Vehicle:
    value = getattr(vehicle, name)
    return replace(vehicle, **{name: tuple(factor * v for v in value) if isinstance(value, tuple) else factor * value})


@pytest.mark.parametrize(
    ("name", "factor", "unit"),
    [
        ("arm_length", 1e3, "mm"),
        ("rotor_radius", 1e3, "mm"),
        ("drag_to_thrust", 1e3, "mm"),
        ("inertia", 1e4, "kg cm^2"),
        ("inertia", 1e7, "g cm^2"),
        ("rotor_inertia", 1e7, "g cm^2"),
        ("body_drag", 1e4, "cm^2"),
        ("rotor_rise", 15.0, None),
    ],
)
def test_a_number_in_another_unit_is_named_with_that_unit(name: str, factor: float, unit: str | None) -> None:
    notes = " ".join(implausible(scaled(template(), name, factor)))
    assert name in notes
    assert unit is None or f"given in {unit}?" in notes


def test_no_unit_is_guessed_that_leaves_a_number_at_the_edge_of_what_is_usual() -> None:
    """A Crazyflie's d/b as some simulators have it is too large for its propellers, but it is not in centimetres."""
    crazyflie = load_vehicle(vehicle_path("crazyflie2"))
    (note,) = implausible(replace(crazyflie, drag_to_thrust=0.02513))
    assert "given in" not in note
    assert note.startswith("vehicle: drag_to_thrust over rotor_radius is 1.12")
    assert note.endswith("check drag_to_thrust, rotor_radius, arm_length")
    in_cm = 100.0 * crazyflie.drag_to_thrust
    assert "drag_to_thrust = 0.596" in " ".join(implausible(replace(crazyflie, drag_to_thrust=in_cm)))
    assert "given in cm?" in " ".join(implausible(replace(crazyflie, drag_to_thrust=in_cm)))


def test_an_extent_within_the_propellers_does_not_shrink_the_vehicle() -> None:
    vehicle = replace(template(), extent=0.001)
    assert vehicle.enclosing_radius == pytest.approx(vehicle.arm_length + (vehicle.rotor_radius or 0.0))
    assert any("extent" in note for note in implausible(vehicle))


def mutants() -> list[Any]:
    numbers = [name for name in VEHICLE_UNITS if name not in ("rotor_spins",)]
    return [
        pytest.param(vehicle, name, factor, id=f"{vehicle.name}-{name}-{factor:.3g}")
        for vehicle in SHIPPED
        for name in numbers
        if getattr(vehicle, name) is not None
        for factor in FACTORS
    ]


def scenario_of(vehicle: Vehicle) -> Scenario:
    """A step of 0.3 m with every effect that the vehicle's numbers allow."""
    numbers = {name: value for name in VEHICLE_UNITS if (value := getattr(vehicle, name)) is not None}
    table = {"file": "hummingbird", **{k: list(v) if isinstance(v, tuple) else v for k, v in numbers.items()}}
    effects: dict[str, Any] = {"rotors": {}} if vehicle.rotor_rise is not None else {}
    if vehicle.rotor_drag is not None or vehicle.body_drag is not None:
        effects["air"] = {}
    step = {"type": "steps", "response_time": 0.5, "x": [{"start": 0.0, "stop": 9.0, "value": 0.3}]}
    return quadsim.load("hover").replace(
        {
            "vehicle": table,
            "effects": effects,
            "duration": 2.0,
            "controller": {"type": "geometric"},
            "constraints": [{"name": "tilt", "signal": "tilt", "upper": 30.0}],
            "reference": step,
            "plant.limit_speeds": True,
        }
    )


@pytest.mark.parametrize(("vehicle", "name", "factor"), mutants())
def test_no_wrong_number_is_satisfied_in_silence(vehicle: Vehicle, name: str, factor: float) -> None:
    """It is refused or named; or it makes no difference to the flight; or the flight does not satisfy."""
    try:
        mutant = scaled(vehicle, name, factor)
    except ParameterError:
        return
    if mutant == vehicle or implausible(mutant):
        return
    if factor != FACTORS[-1]:
        assert factor < 1.0, "a thousand or a radian too large is always named"
        assert name in WITHOUT_EFFECT_IF_SMALL
    flight, original = (quadsim.fly(scenario_of(each)) for each in (mutant, vehicle))
    apart = max(np.abs(flight.state[axis] - original.state[axis]).max() for axis in "xyz")
    assert apart < CLOSE or flight.outcome != "satisfied", f"{apart:.3f} m apart and nothing said"


def test_every_number_of_a_vehicle_is_in_a_ratio_or_checked_by_its_construction() -> None:
    from quadsim.plausibility import RATIOS

    built = {"rotor_positions", "products_of_inertia", "speed_min", "thrust_of_speed", "thrust_of_throttle"}
    built |= {"throttle_offset"}
    covered = {name for ratio in RATIOS for name in ratio.of} | built
    assert {field.name for field in fields(Vehicle)} - {"name", "description"} == covered
