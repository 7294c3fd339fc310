"""The paper's controllers, which fly in Python: their exported C answers alike."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest

import quadsim
from quadsim.core.mirror import core_library, set_members, struct
from quadsim.features.export.exporter import exported_law
from quadsim.features.export.record import record
from quadsim.mpc.laws.parts.numbers import Exportable, controller_numbers
from quadsim.mpc.solvers import Method
from quadsim.mpc.solvers.core import core_problem
from quadsim.state import Array


class InC:
    """A law of C without the fallback contract, query and optimum by query and optimum."""

    def __init__(self, law: Exportable) -> None:
        self._library = core_library()
        self._problem = core_problem(law.problem)
        self.controller = struct("quadsim_controller")(problem=ctypes.addressof(self._problem.struct))
        set_members(self.controller, **controller_numbers(law.problem))
        self.memory = np.zeros(self._library.quadsim_mpc_reals(self.controller))
        self.mpc = struct("quadsim_mpc")()
        self._library.quadsim_mpc_start(self.mpc, self.controller, self.memory.ctypes.data)

    def solve(self, state: Array, reference: Array, acting: Array) -> tuple[int, Array]:
        """Status of a period, and its first command (4,)."""
        inputs = [np.array(part, float) for part in (state, reference, acting)]
        status = self._library.quadsim_mpc_prepare(self.mpc, 1, 1, *(part.ctypes.data for part in inputs))
        status = status or self._library.quadsim_mpc_optimise(self.mpc)
        return status, np.ctypeslib.as_array((ctypes.c_double * 4).from_address(self.mpc.work.plan)).copy()


PAPERS = (
    *("paper-constrained", "paper-unconstrained", "crazyflie-steps", "figure-eight", "take-off-and-landing"),
    "motion-capture",
)


@pytest.mark.slow("core")
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.representative("core") if name == PAPERS[0] else ()) for name in PAPERS],
)
def test_the_exported_c_answers_as_flights_in_python(name: str) -> None:
    scenario = quadsim.load(name)
    recording = record(scenario)
    law = exported_law(scenario)
    c = InC(law)
    horizon = law.problem.horizon
    apart = 0.0
    for k, (state, acting) in enumerate(zip(recording.state, recording.acting, strict=True)):
        status, command = c.solve(state, recording.path[k : k + horizon], acting)
        assert status == recording.status[k]
        apart = max(apart, float(np.abs(command - recording.command[k]).max())) if status < len(Method) else apart
    assert len(recording.state) > 100
    assert np.ptp(recording.command) > 0.2
    assert apart < 1e-8
