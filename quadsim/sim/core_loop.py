"""A flight whose controller is the core's: the loop of `quadsim.sim.loop` where nothing else has to be attended to.

Tables of many flights need a flight's verdict, margins and metrics, not its record.  Where no user code, no events of
the reference or the controller, no ground and no computing time are involved, a period is then what the sensors give,
one call of the controller with its contract, and one hold of the plant.  What it flies has the bits of the loop that is
asked period by period.  It flies only what goes as usual: where a period has no optimum, or the vehicle is lost, it
gives up, and that flight is the loop's.
"""

from __future__ import annotations

import time as clock
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from quadsim.controller import CoreController, Phase
from quadsim.errors import FlightError
from quadsim.flight.log import RESIDUALS, ControlLog, FlightLog, TimingLog
from quadsim.flight.phase import check_loss
from quadsim.sim.loop import uncollected
from quadsim.sim.navigation import Navigation
from quadsim.sim.physics import instants, plant_log
from quadsim.sim.plant import Plant
from quadsim.state import INDEX, KEPT, N_STATES, REFERENCE_NAMES, Array, whole_turns

_HEIGHT: Final = REFERENCE_NAMES.index("z")
_YAW: Final = REFERENCE_NAMES.index("yaw")


def fly_in_core(
    law: CoreController,
    plant: Plant,
    reference: Array,
    *,
    speeds: Array,
    periods: int,
    steps_per_period: int,
    navigation: Navigation | None,
    loss: Mapping[str, float],
) -> FlightLog | None:
    """Fly a number of control periods of a plant and navigation that have just been reset.

    Args:
        law: what flies; it is restarted.
        plant: what is flown.
        reference: (K + N, 4) filtered x, y, z [m], yaw [rad], row k at t_k.
        speeds: (4,) u(-1) [rad/s].
        periods: K.
        steps_per_period: M, physics steps per control period.
        navigation: what measures; the true state where absent.
        loss: limits by the names of `quadsim.flight.phase.CRITERIA`.

    Returns:
        the log, without predictions and KKT residuals; None where the flight is the loop's.
    """
    flight = _Flight(law, plant, reference, navigation, periods, steps_per_period)
    if not flight.keeps_turn:
        return None
    law.start(periods, speeds)
    plant.begin(periods * steps_per_period)
    try:
        with uncollected():
            for k in range(periods):
                if not flight.step(k, loss):
                    return None
    except FlightError:
        return None
    if law.accepted:
        return flight.log()
    return None


class _Flight:
    """What is flown, and what is kept of it."""

    def __init__(
        self,
        law: CoreController,
        plant: Plant,
        reference: Array,
        navigation: Navigation | None,
        periods: int,
        steps: int,
    ) -> None:
        self._law = law
        self._plant = plant
        self._navigation = navigation
        self._steps = steps
        self._reference = np.ascontiguousarray(reference)
        self._start = plant.physics
        self._rotors = plant.speeds
        self._truth = np.empty((periods, N_STATES))
        if navigation is None:
            self._state = self._truth
        else:
            self._state = np.empty_like(self._truth)
        self._step_s = np.zeros(periods)
        self._yaw = float(plant.state()[INDEX["yaw"]])
        self._lowest = float(self._start[3])
        self._yaws = self._reference[:, _YAW].tolist()

    @property
    def keeps_turn(self) -> bool:
        """Whether the reference is on the vehicle's turn, with no step of its yaw by half a turn or more.

        Then `quadsim.state.ReferenceTurns` changes nothing while the vehicle is near.
        """
        yaws = self._reference[:, _YAW]
        steps = np.append(np.diff(yaws), self._yaw - yaws[0])
        return not np.count_nonzero(whole_turns(steps))

    def step(self, k: int, loss: Mapping[str, float]) -> bool:
        """Fly a control period; return whether it was as usual."""
        plant = self._plant
        navigation = self._navigation
        reference = self._reference
        truth = plant.state()
        if navigation is None:
            state = truth
        else:
            state = navigation.state()
        self._truth[k] = truth
        self._state[k] = state
        self._lowest = min(self._lowest, float(reference[k, _HEIGHT]))
        check_loss(loss, plant.time, truth, reference[k], self._lowest)
        if not abs(state[INDEX["yaw"]] - self._yaws[k]) <= KEPT:
            return False
        started = clock.perf_counter()
        answered = self._law.step(
            self._state.ctypes.data + k * self._state.strides[0],
            reference.ctypes.data + (k + 1) * reference.strides[0],
        )
        self._step_s[k] = clock.perf_counter() - started
        if not answered:
            return False
        if navigation is None:
            sensing = None
        else:
            sensing = navigation.begin(self._steps)
        plant.hold(self._law.commands[k + 1], self._steps, sensing=sensing)
        if navigation is not None:
            navigation.record(plant.flown[k * self._steps : (k + 1) * self._steps])
        return True

    def log(self) -> FlightLog:
        """Return the log of all periods."""
        law = self._law
        plant = self._plant
        count = len(self._truth)
        t = instants(count, self._steps * plant.timestep)
        statistics: dict[str, Any] = {}
        for name in RESIDUALS:
            statistics[name] = np.full(count, np.nan)
        statistics |= law.statistics
        control = ControlLog(
            t=t,
            state=self._state,
            reference=self._reference[:count],
            speeds=law.commands[1:],
            speeds_before=law.commands[0],
            status=law.status,
            answered_by=law.answered_by,
            phase=(str(Phase.FLYING),) * count,
            iterations=statistics.pop("iterations").astype(np.int64),
            active=statistics.pop("active").astype(np.int64),
            fallback=np.zeros(count, np.int64),
            **statistics,
            delay=np.zeros(count),
            truth=self._truth,
        )
        timing = TimingLog(t=t, solve_ms=np.full(count, np.nan), step_ms=1e3 * self._step_s)
        flown = plant_log(plant.flown, plant.speeds, self._start, self._yaw, plant.timestep)
        return FlightLog(control=control, timing=timing, plant=flown)
