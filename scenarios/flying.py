"""A scenario's parts put together and flown once."""

from __future__ import annotations

from collections.abc import Callable

from quadsim.controller import Controller
from quadsim.flightlog import FlightLog
from quadsim.loop import fly
from quadsim.navigation import Navigation
from quadsim.plant import Plant
from quadsim.state import Array
from quadsim.vehicle import Vehicle
from scenarios.build import build_ground, build_initial_speeds, build_initial_state, build_loss
from scenarios.effects import build_computation
from scenarios.gc_tuning import frozen
from scenarios.randomness import generator
from scenarios.spec import Scenario


def fly_once(
    scenario: Scenario,
    vehicle: Vehicle,
    plant: Plant,
    controller: Controller,
    reference: Array,
    *,
    navigation: Navigation | None,
    progress: Callable[[int], None] | None = None,
) -> FlightLog:
    """Fly a scenario with a plant and a controller that were built for it, undisturbed by Python's cycle collector.

    Args:
        scenario: what is flown.
        vehicle: what is believed to fly.
        plant: see `scenarios.build.build_plant`.
        controller: see `scenarios.build.build_controller`.
        reference: (K + N, 4); see `scenarios.courses.build_reference`.
        navigation: see `scenarios.navigation.build_navigation`.
        progress: called with the number of periods flown, after each.
    """
    with frozen():
        return fly(
            plant,
            controller,
            reference,
            initial_state=build_initial_state(scenario),
            initial_speeds=build_initial_speeds(scenario, vehicle),
            periods=scenario.periods,
            steps_per_period=scenario.steps_per_period,
            navigation=navigation,
            computation=build_computation(scenario),
            rng=generator(scenario.seed, "computation"),
            ground=build_ground(scenario, vehicle),
            loss=build_loss(scenario),
            progress=progress,
        )
