"""A fast figure eight by the robust controller, linearised at hover and along its last plan."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mpc.constraints import Penalty
from mpc.robust.controller import Linearisation, RobustMPC, RobustSettings
from quadsim.controller import ACCEPTED
from quadsim.state import INDEX
from scenarios.build import build_plant, build_problem
from scenarios.courses.make import build_reference
from scenarios.loading import load_scenario
from scenarios.parts.vehicle import build_vehicle
from scenarios.run import fly_once

SOFT = Penalty(l1=np.full(2, 2e5), l2=np.full(2, 1e4))


def eight(linearisation: Linearisation, *settings: str) -> tuple[float, float]:
    """RMSE of the position [m] and largest tilt [deg] of a Hummingbird on a figure eight, its heading frame on."""
    bounds = [f"controller.output_bounds.{name}=[-40.0,40.0]" for name in ("roll", "pitch")]
    scenario = load_scenario("hummingbird-figure-eight", [*bounds, "duration=8.0", "controller.horizon=20", *settings])
    vehicle = build_vehicle(scenario)
    problem = build_problem(scenario, vehicle)
    assert problem.bounds is not None
    controller = RobustMPC(
        vehicle,
        period=scenario.control_period,
        horizon=problem.horizon,
        objective=problem.objective,
        bounds=problem.bounds,
        settings=RobustSettings(penalty=SOFT, heading=True, linearisation=linearisation),
    )
    with build_plant(scenario, vehicle) as plant:
        log = fly_once(
            scenario, vehicle, plant, controller, build_reference(scenario, scenario.periods + 20), navigation=None
        )
    assert log.reason is None
    assert set(log.control.status) <= ACCEPTED
    errors = log.control.truth[:, [0, 2, 4]] - log.control.reference[:, :3]
    euler = log.plant.state[:, [INDEX["roll"], INDEX["pitch"]]]
    tilt = math.degrees(np.arccos(np.cos(euler).prod(axis=1)).max())
    return math.sqrt((errors**2).sum(axis=1).mean()), tilt


@pytest.mark.parametrize(
    "course",
    [
        ("reference.period=5.4", "controller.input_weights.speed=1e-6"),
        (
            "reference.length=8.0",
            "reference.period=7.7",
            "reference.yaw_along_path=true",
            "controller.output_weights.yaw=1.0",
            "controller.input_weights.speed=1e-5",
        ),
    ],
    ids=["yaw-held", "yaw-along"],
)
def test_a_figure_eight_at_30_deg_is_flown_three_times_as_well_as_by_the_hover_model(course: tuple[str, ...]) -> None:
    (linear, _), (iterated, tilt) = (eight(kind, *course) for kind in (Linearisation.HOVER, Linearisation.TRAJECTORY))
    assert 28.0 < tilt < 36.0
    assert iterated < linear / 3.0
