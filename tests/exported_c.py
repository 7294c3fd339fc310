"""An exported controller, compiled for this machine, queried period by period."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np

from quadsim.state import Array
from scenarios.export.exporter import controller_files
from scenarios.export.record import Recording
from scenarios.parts.compiler import compiled
from scenarios.schema.scenario import Scenario


@dataclass(frozen=True)
class Reply:
    """What the C answered."""

    status: int
    changes: int
    command: Array  # (4,)
    plan: Array  # (N, 4)


class Host:
    """One controller struct of a compiled library."""

    def __init__(self, scenario: Scenario, precision: str = "double", room: int | None = None) -> None:
        self.library = ctypes.CDLL(str(compiled(controller_files(scenario, precision), room)))
        self.library.quadsim_shim_size.restype = ctypes.c_size_t
        self.library.quadsim_shim_step.restype = None
        self.horizon = scenario.controller.horizon
        self.memory = ctypes.create_string_buffer(self.library.quadsim_shim_size())
        self.inputs, self.answers = np.zeros(18 + 4 * self.horizon), np.zeros(18 + 4 * self.horizon)
        self.inputs[-2:] = 1.0

    def reset(self, speeds: Array) -> None:
        start = np.array(speeds, float)
        self.library.quadsim_shim_reset(self.memory, ctypes.c_void_p(start.ctypes.data))

    def step(self, state: Array, reference: Array, acting: Array) -> Reply:
        self.inputs[:12], self.inputs[12:16], self.inputs[16:-2] = state, acting, reference.ravel()
        pointers = (ctypes.c_void_p(array.ctypes.data) for array in (self.inputs, self.answers))
        self.library.quadsim_shim_step(self.memory, *pointers)
        found = self.answers.copy()
        return Reply(int(found[0]), int(found[1]), found[4:8], found[8 : 8 + 4 * self.horizon].reshape(-1, 4))


def replay(host: Host, recording: Recording) -> list[Reply]:
    """The answers to all recorded periods, from reset on."""
    host.reset(recording.speeds)
    N = host.horizon
    return [
        host.step(state, recording.path[k : k + N], acting)
        for k, (state, acting) in enumerate(zip(recording.state, recording.acting, strict=True))
    ]
