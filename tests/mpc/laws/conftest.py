"""What the baselines' tests build: three vehicles, three laws, short flights."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from support import paper_reference

from quadsim.assets import vehicle_path
from quadsim.controller import Controller
from quadsim.flight.log import FlightLog
from quadsim.mpc.laws.geometric import Geometric
from quadsim.mpc.laws.lqr import LQRTable
from quadsim.mpc.laws.pid import PID
from quadsim.sim.effects import Effects
from quadsim.sim.loop import fly
from quadsim.sim.plant import Plant
from quadsim.state import Array
from quadsim.vehicle import Vehicle, load_vehicle

PERIOD = 0.05
TABLES: dict[str, Any] = {"lqr": LQRTable, "pid": PID, "geometric": Geometric}
LAWS = tuple(TABLES)

Build = Callable[..., Any]
Fly = Callable[..., FlightLog]


@pytest.fixture(params=["lopes2011", "hummingbird", "crazyflie2"])
def craft(request: pytest.FixtureRequest) -> Vehicle:
    return load_vehicle(vehicle_path(request.param))


@pytest.fixture(params=LAWS)
def law(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def build() -> Build:
    """A law by name for a vehicle, with the defaults of its table but for some fields."""

    def build_law(law: str, vehicle: Vehicle, **others: Any) -> Any:
        return TABLES[law](**others).law(vehicle, PERIOD)

    return build_law


@pytest.fixture
def fly_from() -> Fly:
    """A flight from a state; by default along the paper's course, whose height steps by 10 m at once."""

    def fly_law(
        controller: Controller,
        vehicle: Vehicle,
        state: Array,
        *,
        periods: int,
        course: Array | None = None,
        effects: Effects | None = None,
    ) -> FlightLog:
        samples = periods + controller.horizon
        reference = paper_reference(samples) if course is None else np.tile(course, (samples, 1))
        with Plant(vehicle, effects=effects or Effects(), limit_speeds=True) as plant:
            return fly(
                plant,
                controller,
                reference,
                initial_state=state,
                initial_speeds=plant.vehicle.hover_speeds,
                periods=periods,
                steps_per_period=50,
            )

    return fly_law
