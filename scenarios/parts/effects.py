"""From `[effects]`, `[computation]` and `[[events]]` to what acts on the flight."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from operator import itemgetter
from typing import TYPE_CHECKING, TypeVar

from mpc.bounded import FallbackSettings
from quadsim.errors import ParameterError
from quadsim.fields import filled
from quadsim.sim.computation import Computation, ComputationTime, Stall
from quadsim.sim.effects import LOADING, Change, Push, PushChange
from quadsim.sim.effects.rotors import LagChange, RotorChange, RotorDynamics, RotorLoss
from quadsim.sim.effects.wind import Air, Gust, WindChange, WindField
from quadsim.vehicle import Vehicle
from scenarios.parts.randomness import generator
from scenarios.parts.vehicle import actual_effects
from scenarios.schema.events import Event

if TYPE_CHECKING:
    from scenarios.schema.scenario import Scenario


def moving_air(scenario: Scenario, vehicle: Vehicle) -> Air | None:
    """The resolved air where it moves at some time of the flight, or None where it is still throughout.

    Raises:
        ParameterError: there is wind, and nothing that it could push.
    """
    air = actual_effects(scenario, vehicle).air or Air()
    blown = any(isinstance(event, Gust | WindChange) for event in scenario.events)
    if not (any(air.wind) or air.turbulence is not None or blown):
        return None
    if not air.drags:
        rule = f"positive, or body_drag given, for the wind to push: the vehicle {vehicle.name!r} states no drag"
        raise ParameterError("effects.air", "rotor_drag", air.rotor_drag or 0.0, rule)
    return air


def build_wind(scenario: Scenario, vehicle: Vehicle) -> WindField | None:
    """The motion of the air, or None where it is still throughout.

    Raises:
        ParameterError: there is wind, and nothing that it could push.
    """
    air = moving_air(scenario, vehicle)
    if air is None:
        return None
    gusts, changes = winds_of(scenario)
    return WindField(
        mean=air.wind,
        gusts=gusts,
        changes=changes,
        turbulence=air.turbulence,
        timestep=scenario.plant.timestep,
        rng=generator(scenario.seed, "wind"),
    )


def winds_of(scenario: Scenario) -> tuple[tuple[Gust, ...], tuple[WindChange, ...]]:
    """The gusts, and the steps of the mean wind."""
    events = scenario.events
    gusts = tuple(event for event in events if isinstance(event, Gust))
    return gusts, tuple(event for event in events if isinstance(event, WindChange))


def build_computation(scenario: Scenario) -> Computation | None:
    """How long commands take, or None where they take no time."""
    stalls = tuple(event for event in scenario.events if isinstance(event, Stall))
    spec = scenario.computation
    if spec is None and not stalls:
        return None
    fallback = getattr(scenario.controller, "fallback", None)
    guarded = isinstance(fallback, FallbackSettings) and fallback.enabled  # within the fallback contract
    return Computation(**vars(filled(spec or ComputationTime(), plan=guarded)), stalls=stalls)


def build_changes(scenario: Scenario, events: Sequence[Event] | None = None) -> tuple[Change, ...]:
    """What these events, or else all of the scenario, do to rotors, mass and payload, and what pushes, in any order."""
    events = scenario.events if events is None else events
    pushes = _in_force([event for event in events if isinstance(event, Push)])
    return (
        *_losses(scenario, [event for event in events if isinstance(event, RotorLoss)]),
        *(PushChange(at=time, pushes=tuple(in_force)) for time, in_force in pushes),
        *(event for event in events if isinstance(event, (*LOADING, LagChange))),
    )


def check_changes(scenario: Scenario, vehicle: Vehicle, changes: Iterable[Change]) -> None:
    """Refuse what the vehicle cannot have happen to it.

    Raises:
        ParameterError: rotors with inertia are to change their speed at once.
    """
    rotors = actual_effects(scenario, vehicle).rotors or RotorDynamics()
    for change in changes:
        if isinstance(change, LagChange):
            rotors.lagging(change)


def _losses(scenario: Scenario, losses: Sequence[RotorLoss]) -> Iterator[RotorChange]:
    """Each rotor's share whenever one of its losses begins or ends: the product of what all losses in force leave."""
    rotors = scenario.effects.rotors or RotorDynamics()
    for rotor, worn in enumerate(rotors.efficiency, start=1):
        for time, in_force in _in_force([loss for loss in losses if loss.rotor == rotor]):
            left = math.prod(1.0 - loss.loss for loss in in_force)
            yield RotorChange(at=time, rotor=rotor, efficiency=worn * left)


_Lasting = TypeVar("_Lasting", RotorLoss, Push)


def _in_force(events: Sequence[_Lasting]) -> Iterator[tuple[float, list[_Lasting]]]:
    """The instants [s] at which events begin or end, and those in force from then on, in their own order."""
    turns: dict[float, tuple[set[int], set[int]]] = {}
    for i, event in enumerate(events):
        turns.setdefault(event.at, (set(), set()))[0].add(i)
        if event.duration is not None:
            turns.setdefault(event.at + event.duration, (set(), set()))[1].add(i)
    in_force: set[int] = set()
    for time, (begun, ended) in sorted(turns.items(), key=itemgetter(0)):
        in_force = (in_force | begun) - ended
        yield time, [events[i] for i in sorted(in_force)]
