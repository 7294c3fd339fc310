"""An exported controller, compiled for this machine, queried period by period."""

from __future__ import annotations

import ctypes
import functools
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mpc.codegen.ctext import Precision
from quadsim.controller import Phase
from quadsim.state import Array
from scenarios.export.exporter import c_controller
from scenarios.export.record import Recording
from scenarios.schema.scenario import Scenario

HOST = Path(__file__).parent / "firmware" / "host.c"
PHASES = (Phase.FLYING, Phase.ARMED, Phase.LANDED)  # by `enum quadsim_phase`
FLAGS = ("-std=c99", "-O3", "-ffp-contract=off", "-fPIC", "-shared")


@dataclass(frozen=True)
class Reply:
    """What the C answered."""

    status: int
    fallback: int
    changes: int
    command: Array  # (4,)
    plan: Array  # (N, 4)


@functools.cache
def library(files: tuple[tuple[str, str], ...], precision: Precision) -> ctypes.CDLL:
    """A controller's files, compiled."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in files:
            (folder / file).write_text(text)
        define = ["-DQUADSIM_FLOAT"] if precision == "float" else []
        sources = [HOST, *sorted(folder.glob("*.c"))]
        subprocess.run(["cc", *FLAGS, *define, "-I", folder, "-o", folder / "host.so", *sources], check=True)
        return ctypes.CDLL(str(folder / "host.so"))


class Host:
    """One controller of a compiled library."""

    def __init__(self, scenario: Scenario, precision: Precision = "double", rows: int | None = None) -> None:
        files, right = c_controller(scenario, precision, rows).files, ctypes.c_int()
        self.library = library(tuple(files.items()), precision)
        self.library.host_size.restype = ctypes.c_size_t
        self.memory = np.zeros(self.library.host_size(ctypes.byref(right)) // 8 + 1)
        assert right.value, "the memory that the export states is not what the controller needs"
        self.horizon = scenario.controller.horizon
        self.inputs, self.answers = np.zeros(17 + 4 * self.horizon), np.zeros(7 + 4 * self.horizon)

    def reset(self, speeds: Array) -> None:
        self._call(self.library.host_reset, np.array(speeds, float))

    def step(self, state: Array, reference: Array, acting: Array, phase: Phase = Phase.FLYING) -> Reply:
        self.inputs[:12], self.inputs[12:16], self.inputs[17:] = state, acting, reference.ravel()
        self.inputs[16] = PHASES.index(phase)
        self._call(self.library.host_step, self.inputs, self.answers)
        result = self.answers.copy()
        return Reply(*(int(number) for number in result[:3]), result[3:7], result[7:].reshape(-1, 4))

    def _call(self, function: object, *arrays: Array) -> None:
        function(*(ctypes.c_void_p(array.ctypes.data) for array in (self.memory, *arrays)))  # type: ignore[operator]


def replay(host: Host, recording: Recording) -> list[Reply]:
    """The answers to all recorded periods, from reset on."""
    host.reset(recording.speeds)
    N = host.horizon
    return [
        host.step(state, recording.path[k : k + N], acting)
        for k, (state, acting) in enumerate(zip(recording.state, recording.acting, strict=True))
    ]
