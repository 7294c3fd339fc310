"""From `[effects]`, `[computation]` and `[[events]]` to what acts on the flight."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from mpc.fallback.settings import FallbackSettings
from quadsim.errors import ParameterError
from quadsim.fields import filled
from quadsim.sim.computation import Computation, ComputationTime, Stall
from quadsim.sim.effects import Air, PayloadChange, RotorChange, RotorDynamics
from quadsim.sim.effects.gust import Gust
from quadsim.sim.effects.wind import WindChange, WindField
from quadsim.vehicle import Vehicle
from scenarios.parts.randomness import generator
from scenarios.schema.events import (
    PayloadDropEvent,
    PayloadPickupEvent,
    RotorLossEvent,
)

if TYPE_CHECKING:
    from scenarios.schema.scenario import Scenario


def moving_air(scenario: Scenario, vehicle: Vehicle) -> Air | None:
    """The resolved air where it moves at some time of the flight, or None where it stands still throughout.

    Raises:
        ParameterError: there is wind, and nothing that it could push.
    """
    air = scenario.effects.resolved(vehicle).air or Air()
    blown = any(isinstance(event, Gust | WindChange) for event in scenario.events)
    if not (any(air.wind) or air.turbulence is not None or blown):
        return None
    if not air.drags:
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
    return WindField(
        mean=air.wind,
        gusts=tuple(event for event in scenario.events if isinstance(event, Gust)),
        changes=tuple(event for event in scenario.events if isinstance(event, WindChange)),
        turbulence=air.turbulence,
        timestep=scenario.plant.timestep,
        rng=generator(scenario.seed, "wind"),
    )


def build_computation(scenario: Scenario) -> Computation | None:
    """How long commands take, or None where they take no time."""
    stalls = tuple(event for event in scenario.events if isinstance(event, Stall))
    spec = scenario.computation
    if spec is None and not stalls:
        return None
    return Computation(**vars(filled(spec or ComputationTime(), plan=_has_fallback(scenario))), stalls=stalls)


def _has_fallback(scenario: Scenario) -> bool:
    """Whether the controller is within the fallback contract."""
    fallback = getattr(scenario.controller, "fallback", None)
    return isinstance(fallback, FallbackSettings) and fallback.enabled


def build_changes(scenario: Scenario) -> tuple[RotorChange | PayloadChange, ...]:
    """What happens to rotors and payload on the way, in any order."""
    found: list[RotorChange | PayloadChange] = [*_losses(scenario)]
    for event in scenario.events:
        if isinstance(event, PayloadPickupEvent):
            found.append(PayloadChange(time=event.at, payload=event))
        elif isinstance(event, PayloadDropEvent):
            found.append(PayloadChange(time=event.at, payload=None))
    return tuple(found)


def _losses(scenario: Scenario) -> Iterator[RotorChange]:
    """Each rotor's share whenever one of its losses begins or ends: the product of what all losses in force leave."""
    losses = [event for event in scenario.events if isinstance(event, RotorLossEvent)]
    rotors = scenario.effects.rotors or RotorDynamics()
    for rotor, worn in enumerate(rotors.efficiency, start=1):
        spans = [
            (loss.at, math.inf if loss.duration is None else loss.at + loss.duration, 1.0 - loss.loss)
            for loss in losses
            if loss.rotor == rotor
        ]
        for time in sorted({time for start, stop, _ in spans for time in (start, stop) if time < math.inf}):
            left = math.prod(share for start, stop, share in spans if start <= time < stop)
            yield RotorChange(time=time, rotor=rotor, efficiency=worn * left)
