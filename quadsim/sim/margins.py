"""Margins of a control period at the physics rate, computed by the core beside the flight.

They are those of `quadsim.flight.audit`, which defines them; here a limit becomes a `quadsim_bound` of
`quadsim/core/quadsim_batch.h`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from quadsim.core.mirror import Struct, constant, core_library
from quadsim.core.structs import BoundStruct, PeriodStruct
from quadsim.flight.audit import SIGNALS, SUM, Limit
from quadsim.flight.log import PeriodLog, PlantLog
from quadsim.sim.physics import Period, one_period, physics_to_state
from quadsim.state import INDEX, N_STATES, REFERENCE_NAMES, STATE_UNITS, Array, shown_unit
from quadsim.vehicle import N_ROTORS

_DEGREE: Final = math.degrees(1.0)
_LAST_STEP: Final = 1 << 62  # a physics step that no flight reaches
_SPEEDS: Final = {f"speed_{i + 1}": N_STATES + i for i in range(N_ROTORS)}
"""Numbers in the core of the rotor speeds that a sum may have."""


class Margins:
    """The smallest margins of limits within control periods, and those at their ends.

    Attributes:
        limits: the limits, in the order of all results.
        bounds: the core's, an array of structs.
        compiled: whether the core computes all of them; Python computes clearances from obstacles and regions.
        tolerances: (2, m) violations accepted at the physics rate and at the control samples.
        required: (m,) whether a violation counts.
    """

    def __init__(self, limits: Sequence[Limit], timestep: float) -> None:
        """Translate the limits, for a physics step [s]."""
        self.limits = tuple(limits)
        self._timestep = timestep
        self._others: list[int] = []
        self.bounds = (BoundStruct * max(len(self.limits), 1))()
        for i, limit in enumerate(self.limits):
            bound = self.bounds[i]
            if not _translate(limit, bound):
                self._others.append(i)
                bound.first = 0
                bound.last = -1
                continue
            bound.lower = limit.lower
            bound.upper = limit.upper
            bound.first = _step_at(limit.start, timestep, after=True)
            bound.last = _step_at(limit.stop, timestep, after=False)
        self.compiled = not self._others
        tolerances = [limit.tolerances for limit in self.limits]
        required = [limit.required for limit in self.limits]
        self.tolerances = np.array(tolerances, float).reshape(-1, 2).T
        self.required = np.array(required, bool)

    def __reduce__(self) -> tuple[type[Margins], tuple[tuple[Limit, ...], float]]:
        """Pickle the arguments: structs with pointers cannot be copied."""
        return Margins, (self.limits, self._timestep)

    def of_start(self, physics: Array, rotors: Array) -> tuple[Array, Array]:
        """(m,) margins at MuJoCo's state (14,) and rotor speeds (4,) [rad/s] at t = 0, twice; inf where there are none.

        Those of signals that exist only at the samples of a period are among the latter.
        """
        start = PeriodStruct()
        physics = np.ascontiguousarray(physics, np.float64)
        rotors = np.ascontiguousarray(rotors, np.float64)
        truth = physics_to_state(physics[None])[0]
        start.before = physics.ctypes.data
        start.rotors = rotors.ctypes.data
        start.truth = truth.ctypes.data
        smallest, at_end = self._compute(start)
        if self._others:
            plant = PlantLog(t=np.zeros(1), state=truth[None], speeds=rotors[None])
            for i in self._others:
                self._by_log(i, PeriodLog(control=None, plant=plant), 0, smallest, at_end)  # type: ignore[arg-type]
        return smallest, at_end

    def of_period(self, period: Period) -> tuple[Array, Array]:
        """(m,) smallest margins within a control period, its start left out, and at its end; inf where none applies."""
        observed = period.observation
        moment = period.observation.moment
        steps = period.steps
        assert moment.acting is not None
        assert steps.dtype.fields is not None
        flown = PeriodStruct()
        inputs: dict[str, Array] = {
            "before": period.before,
            "rotors": period.rotors,
            "truth": observed.truth,
            "measured": observed.state,
            "reference": observed.reference,
            "commanded": period.speeds,
            "earlier": moment.acting,
        }
        kept = {name: np.ascontiguousarray(numbers, np.float64) for name, numbers in inputs.items()}
        for name, numbers in kept.items():
            setattr(flown, name, numbers.ctypes.data)
        at = steps.ctypes.data
        for name in ("physics", "speeds", "thrust"):
            setattr(flown, name, at + steps.dtype.fields[name][1])
        flown.width = steps.itemsize // 8
        flown.count = len(steps)
        flown.start = round(moment.time / self._timestep)
        flown.targeted = period.target is not None
        smallest, at_end = self._compute(flown)
        if self._others:
            log = one_period(period, self._timestep)
            for i in self._others:
                self._by_log(i, log, 1, smallest, at_end)
        return smallest, at_end

    def _compute(self, period: Struct) -> tuple[Array, Array]:
        smallest, at_end = np.empty((2, len(self.limits)))
        core_library().quadsim_margins(self.bounds, len(self.limits), period, smallest.ctypes.data, at_end.ctypes.data)
        return smallest, at_end

    def _by_log(self, i: int, log: PeriodLog, first: int, smallest: Array, at_end: Array) -> None:
        """Fill in the margins of a limit that the core does not know, from this row of the plant on."""
        limit = self.limits[i]
        source = limit.source
        if source.plant is None and first == 0:  # there is no sample yet
            return
        t, values = source.finest(log)
        margins = np.where(limit.holds_at(t), limit.margin(values), np.inf)
        if source.gaps:  # of each step, at its start: there is none yet at the end
            margins = margins[np.isfinite(values)]
        elif source.plant is not None:
            margins = margins[first:]
        if not margins.size:
            return
        smallest[i] = margins.min()
        at_end[i] = margins[-1]


def violated(tolerances: Array, required: NDArray[np.bool_], smallest: Array, at_end: Array) -> NDArray[np.bool_]:
    """(..., m) which required limits are violated by margins (..., m) within a period, or by those at its end.

    Tolerances (2, ..., m) and required (..., m) are those of `Margins`.
    """
    beyond: NDArray[np.bool_] = (-tolerances[0] - smallest > 0.0) | (-tolerances[1] - at_end > 0.0)  # `Limit.excess`
    return beyond & required


def _step_at(time: float, timestep: float, *, after: bool) -> int:
    """Return the first physics step of a window that starts at a time [s], or the last of one that stops there."""
    if math.isinf(time):
        if time > 0.0:
            return _LAST_STEP
        return -_LAST_STEP
    near = max(round(time / timestep), -_LAST_STEP)
    steps = np.arange(near - 2, near + 3)
    times = np.round(steps * timestep, 9)
    if after:  # as `Limit.holds_at`
        return int(steps[times >= time - 1e-9][0])
    return int(steps[times <= time + 1e-9][-1])


def _translate(limit: Limit, bound: Any) -> bool:
    """Fill in the signal of a bound; False where the core does not have it."""
    name = limit.signal
    known = limit.source is SIGNALS.get(name) or name == SUM
    bound.factor[0] = 1.0
    if not known:
        return False
    if name == SUM:
        for k, (term, factor) in enumerate((limit.terms or {}).items()):
            if term in _SPEEDS:
                bound.index[k] = _SPEEDS[term]
                bound.factor[k] = factor
            else:
                bound.index[k] = INDEX[term]
                bound.factor[k] = factor * _unit_factor(INDEX[term])
            bound.terms = k + 1
        bound.signal = constant("SIGNAL_SUM")
    elif name in INDEX:
        bound.signal = constant("SIGNAL_SUM")
        bound.terms = 1
        bound.index[0] = INDEX[name]
        bound.factor[0] = _unit_factor(INDEX[name])
    elif name in ("tilt", "thrust", "speed", "slew"):
        bound.signal = constant(f"SIGNAL_{name.upper()}")
        if name == "tilt":
            bound.factor[0] = _DEGREE
    elif name.startswith("body_rate_"):
        bound.signal = constant("SIGNAL_BODY_RATE")
        bound.axis = "xyz".index(name[-1])
        bound.factor[0] = _DEGREE
    elif name.endswith("_estimate_error"):
        state = INDEX[name.removesuffix("_estimate_error")]
        bound.signal = constant("SIGNAL_ESTIMATE")
        bound.axis = state
        bound.factor[0] = _unit_factor(state)
    elif name.endswith("_error"):
        tracked = name.removesuffix("_error")
        bound.signal = constant("SIGNAL_ERROR")
        bound.axis = REFERENCE_NAMES.index(tracked)
        bound.factor[0] = _unit_factor(INDEX[tracked])
    else:
        return False
    return True


def _unit_factor(state: int) -> float:
    """Return the factor from a state's SI unit to that of its limits."""
    return shown_unit(STATE_UNITS[state])[1]
