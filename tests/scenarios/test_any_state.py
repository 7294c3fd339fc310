"""From any finite state with less than 45 deg of tilt, a guarded controller flies on or ends with a typed error."""

from __future__ import annotations

import math
import re
from unittest import mock

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from quadsim.sim.loop import fly
from quadsim.sim.plant import Plant
from quadsim.state import EULER, EULER_RATE, N_STATES, POSITION, VELOCITY, tilt
from scenarios.build import build_controller
from scenarios.courses.make import build_reference
from scenarios.loading import load_scenario
from scenarios.parts.vehicle import build_vehicle

PERIODS = 6
SCENARIO = load_scenario("robust", [f"duration={0.05 * PERIODS}", "controller.rotor_lag=0.03", "constraints=[]"])
VEHICLE = build_vehicle(SCENARIO)
CONTROLLER = build_controller(SCENARIO, VEHICLE)
REFERENCE = build_reference(SCENARIO, PERIODS + CONTROLLER.horizon)


def within(size: float, length: int) -> st.SearchStrategy[list[float]]:
    return st.lists(st.floats(-size, size), min_size=length, max_size=length)


FINITE = st.floats(allow_nan=False, allow_infinity=False)
STATES = st.tuples(
    within(1e3, 3) | st.lists(FINITE, min_size=3, max_size=3),
    within(50.0, 3) | st.lists(FINITE, min_size=3, max_size=3),
    st.tuples(within(math.radians(45.0), 2), st.floats(-100.0, 100.0)),
    within(30.0, 3) | st.lists(FINITE, min_size=3, max_size=3),
)


@settings(max_examples=40, derandomize=True, database=None, deadline=None)
@given(parts=STATES, speeds=within(250.0, 4).map(np.abs))
def test_any_start_flies_or_ends_with_its_reason(parts: tuple, speeds: np.ndarray) -> None:  # type: ignore[type-arg]
    position, velocity, (level, yaw), rates = parts
    state = np.zeros(N_STATES)
    for rows, values in ((POSITION, position), (VELOCITY, velocity), (EULER, [*level, yaw]), (EULER_RATE, rates)):
        state[list(rows)] = values
    assume(tilt(state[None])[0] < math.radians(45.0))
    with Plant(VEHICLE) as plant, mock.patch.object(plant, "advance", wraps=plant.advance) as advance:
        log = fly(
            plant,
            CONTROLLER,
            REFERENCE,
            initial_state=state,
            initial_speeds=speeds,
            periods=PERIODS,
            steps_per_period=50,
        )
    commands = np.reshape([np.array(call.args[0]) for call in advance.call_args_list], (-1, 4))
    assert len(commands) >= log.control.t.size
    assert ((commands >= -1e-6) & (commands <= 250.0 + 1e-6)).all()  # as NaN is not
    slews = np.diff(commands, axis=0, prepend=speeds[None])
    assert ((slews >= -10.0 - 1e-6) & (slews <= 5.0 + 1e-6)).all()
    if log.reason is None:
        assert log.control.t.size == PERIODS
    else:
        assert re.match(r"at t = \d+\.\d{3} s: \w", log.reason)
