"""From `[effects]`, `[computation]` and `[[events]]` to what acts on the flight."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, TypeVar

from quadsim.errors import ParameterError
from quadsim.sim.computation import Computation, Stall
from quadsim.sim.effects import Disturbance, Effects, PayloadChange, RotorChange
from quadsim.sim.effects.gust import Gust, Velocity
from quadsim.sim.effects.load import Load, Payload
from quadsim.sim.effects.rotors import RotorDynamics
from quadsim.sim.effects.turbulence import Dryden
from quadsim.sim.effects.wind import WindChange, WindField
from quadsim.vehicle import N_ROTORS, Vehicle
from scenarios.parts.randomness import generator
from scenarios.schema.base import Spec
from scenarios.schema.effects import (
    AirSpec,
    ComputationSpec,
    EffectsSpec,
    GroundSpec,
    LoadSpec,
    PayloadSpec,
    RotorsSpec,
)
from scenarios.schema.events import (
    GustEvent,
    PayloadDropEvent,
    PayloadPickupEvent,
    RotorLossEvent,
    StallEvent,
    WindEvent,
)
from scenarios.schema.fallback import FallbackSpec

if TYPE_CHECKING:
    from scenarios.schema.scenario import Scenario


Table = TypeVar("Table", bound=Spec)


def resolve_effects(spec: EffectsSpec, vehicle: Vehicle) -> EffectsSpec:
    """The effects with every size that is left to the vehicle written out.

    Raises:
        ParameterError: a size is needed that neither the scenario nor the vehicle gives.
    """
    changes: dict[str, Any] = {}
    if spec.rotors is not None:
        changes["rotors"] = _filled(
            spec.rotors, rise=vehicle.rotor_rise, fall=vehicle.rotor_fall, inertia=vehicle.rotor_inertia or 0.0
        )
    if spec.air is not None:
        body = None if vehicle.body_drag is None else list(vehicle.body_drag)
        air = _filled(spec.air, rotor_drag=vehicle.rotor_drag or 0.0, body_drag=body)
        if air.turbulence is not None:
            carried = _filled(air.turbulence, airspeed=math.hypot(*air.wind))
            air = air.model_copy(update={"turbulence": carried})
        changes["air"] = air
    if spec.ground is not None and spec.ground.effect:
        ground = _filled(spec.ground, rotor_radius=vehicle.rotor_radius)
        if ground.rotor_radius is None:
            rule = f"given for the ground effect, as the vehicle {vehicle.name!r} states none"
            raise ParameterError("effects.ground", "rotor_radius", None, rule)
        changes["ground"] = ground
    return spec.model_copy(update=changes)


def build_effects(scenario: Scenario, vehicle: Vehicle) -> Effects:
    """What acts on the plant, but for the wind.

    Raises:
        ParameterError: a combination is not possible.
    """
    spec = resolve_effects(scenario.effects, vehicle)
    air = spec.air or AirSpec()
    ground = spec.ground or GroundSpec(contact=False)
    rotors = spec.rotors or RotorsSpec()
    efficiency = _quadruple(rotors.efficiency)
    return Effects(
        rotors=_rotor_dynamics(rotors),
        efficiency=efficiency,
        rotor_drag=air.rotor_drag or 0.0,
        body_drag=None if air.body_drag is None else _triple(air.body_drag),
        air_density=air.density,
        rotor_radius=ground.rotor_radius if ground.effect else None,
        contact=ground.contact,
        load=_load(spec.load or LoadSpec()),
        disturbance=_disturbance(spec),
        changes=_changes(scenario, efficiency),
    )


def moving_air(scenario: Scenario, vehicle: Vehicle) -> AirSpec | None:
    """The resolved air where it moves at some time of the flight, or None where it stands still throughout.

    Raises:
        ParameterError: there is wind, and nothing that it could push.
    """
    air = resolve_effects(scenario.effects, vehicle).air or AirSpec()
    blown = any(isinstance(event, GustEvent | WindEvent) for event in scenario.events)
    if not (any(air.wind) or air.turbulence is not None or blown):
        return None
    if not air.rotor_drag and air.body_drag is None:
        rule = f"positive, or body_drag given, for the wind to push: the vehicle {vehicle.name!r} states no drag"
        raise ParameterError("effects.air", "rotor_drag", air.rotor_drag or 0.0, rule)
    return air


def build_wind(scenario: Scenario, vehicle: Vehicle) -> WindField | None:
    """The motion of the air, or None where it stands still throughout.

    Raises:
        ParameterError: there is wind, and nothing that it could push.
    """
    air = moving_air(scenario, vehicle)
    if air is None:
        return None
    gusts = tuple(
        Gust(start=event.at, duration=event.duration, velocity=_triple(event.velocity))
        for event in scenario.events
        if isinstance(event, GustEvent)
    )
    changes = tuple(
        WindChange(time=event.at, velocity=_triple(event.velocity))
        for event in scenario.events
        if isinstance(event, WindEvent)
    )
    turbulence = None
    if air.turbulence is not None and air.turbulence.airspeed is not None:
        turbulence = Dryden(
            altitude=air.turbulence.altitude,
            wind_speed_20ft=air.turbulence.wind_speed_20ft,
            airspeed=air.turbulence.airspeed,
        )
    return WindField(
        mean=_triple(air.wind),
        gusts=gusts,
        changes=changes,
        turbulence=turbulence,
        timestep=scenario.plant.timestep,
        rng=generator(scenario.seed, "wind"),
    )


def build_computation(scenario: Scenario) -> Computation | None:
    """How long commands take, or None where they take no time."""
    stalls = tuple(
        Stall(start=event.at, duration=event.duration) for event in scenario.events if isinstance(event, StallEvent)
    )
    spec = scenario.computation
    if spec is None and not stalls:
        return None
    spec = spec or ComputationSpec()
    return Computation(
        fixed=spec.delay,
        per_iteration=spec.per_iteration,
        jitter=spec.jitter,
        stalls=stalls,
        plan=_has_fallback(scenario) if spec.plan is None else spec.plan,
    )


def _has_fallback(scenario: Scenario) -> bool:
    """Whether the controller is within the fallback contract."""
    fallback = getattr(scenario.controller, "fallback", None)
    return isinstance(fallback, FallbackSpec) and fallback.enabled


def _filled(table: Table, **values: Any) -> Table:
    """A table with the fields that are absent taken from elsewhere."""
    return table.model_copy(update={name: value for name, value in values.items() if getattr(table, name) is None})


def _rotor_dynamics(spec: RotorsSpec) -> RotorDynamics | None:
    dynamics = RotorDynamics(
        rise=spec.rise or 0.0,
        fall=spec.fall or 0.0,
        acceleration=math.inf if spec.acceleration is None else spec.acceleration,
        inertia=spec.inertia or 0.0,
    )
    return None if dynamics == RotorDynamics() else dynamics


def _load(spec: LoadSpec) -> Load:
    return Load(
        mass_factor=spec.mass_factor,
        inertia_factor=_triple(spec.inertia_factor),
        centre_of_mass=_triple(spec.centre_of_mass),
        payloads=tuple(_payload(payload) for payload in spec.payloads),
    )


def _payload(spec: PayloadSpec | PayloadPickupEvent) -> Payload:
    return Payload(mass=spec.mass, position=_triple(spec.position))


def _disturbance(spec: EffectsSpec) -> Disturbance | None:
    if spec.disturbance is None:
        return None
    return Disturbance(
        force=_triple(spec.disturbance.force),
        torque=_triple(spec.disturbance.torque),
        force_noise=spec.disturbance.force_noise,
        torque_noise=spec.disturbance.torque_noise,
    )


def _changes(
    scenario: Scenario, efficiency: tuple[float, float, float, float]
) -> tuple[RotorChange | PayloadChange, ...]:
    found: list[RotorChange | PayloadChange] = [*_losses(scenario, efficiency)]
    for event in scenario.events:
        if isinstance(event, PayloadPickupEvent):
            found.append(PayloadChange(time=event.at, payload=_payload(event)))
        elif isinstance(event, PayloadDropEvent):
            found.append(PayloadChange(time=event.at, payload=None))
    return tuple(found)


def _losses(scenario: Scenario, efficiency: tuple[float, float, float, float]) -> Iterator[RotorChange]:
    """Each rotor's share whenever one of its losses begins or ends: the product of what all losses in force leave."""
    losses = [event for event in scenario.events if isinstance(event, RotorLossEvent)]
    for rotor, worn in enumerate(efficiency, start=1):
        spans = [
            (loss.at, math.inf if loss.duration is None else loss.at + loss.duration, 1.0 - loss.loss)
            for loss in losses
            if loss.rotor == rotor
        ]
        for time in sorted({time for start, stop, _ in spans for time in (start, stop) if time < math.inf}):
            left = math.prod(share for start, stop, share in spans if start <= time < stop)
            yield RotorChange(time=time, rotor=rotor, efficiency=worn * left)


def _triple(values: list[float]) -> Velocity:
    x, y, z = values
    return x, y, z


def _quadruple(values: list[float]) -> tuple[float, float, float, float]:
    a, b, c, d = values
    assert N_ROTORS == 4
    return a, b, c, d
