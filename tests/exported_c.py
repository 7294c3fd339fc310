"""An exported controller, compiled for this machine, queried period by period."""

from __future__ import annotations

import ctypes
import functools
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from quadsim.controller import Phase
from quadsim.features.export.exporter import c_controller
from quadsim.features.export.record import Recording
from quadsim.mpc.export.ctext import Precision
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import Array

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
    plan: Array  # (N, 4) the law's
    flown_plan: Array  # (N, 4) the guard's, from the command on


@functools.cache
def library(files: tuple[tuple[str, str], ...], defines: str) -> ctypes.CDLL:
    """A controller's files, compiled."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in files:
            (folder / file).write_text(text)
        sources = [HOST, *sorted(folder.glob("*.c"))]
        subprocess.run(["cc", *FLAGS, *defines.split(), "-I", folder, "-o", folder / "host.so", *sources], check=True)
        return ctypes.CDLL(str(folder / "host.so"))


class Host:
    """One controller of a compiled library."""

    def __init__(self, scenario: Scenario, precision: Precision = "double", rows: int | None = None) -> None:
        source = c_controller(scenario, precision, rows)
        right = ctypes.c_int()
        self.library = library(tuple(source.files.items()), source.defines)
        self.library.host_size.restype = ctypes.c_size_t
        self.memory = np.zeros(self.library.host_size(ctypes.byref(right)) // 8 + 1)
        assert right.value, "the memory that the export states is not what the controller needs"
        self.rows, width, _ = source.reference
        self.horizon = source.horizon
        self.state = source.state
        self.inputs = np.zeros(self.state + 5 + self.rows * width)
        self.answers = np.zeros(7 + 8 * self.horizon)

    def reset(self, before: Array) -> None:
        self._call(self.library.host_reset, np.array(before, float))

    def step(self, state: Array, reference: Array, acting: Array, phase: Phase = Phase.FLYING) -> Reply:
        """Of a state (12,) that is to be longer, the rest is not measured."""
        at = self.state
        self.inputs[:at] = np.nan
        self.inputs[: len(state)] = state
        self.inputs[at : at + 4] = acting
        self.inputs[at + 5 :] = reference.ravel()
        self.inputs[at + 4] = PHASES.index(phase)
        self._call(self.library.host_step, self.inputs, self.answers)
        result = self.answers.copy()
        plans = result[7:].reshape(2, -1, 4)
        return Reply(*(int(number) for number in result[:3]), result[3:7], plans[0], plans[1])

    def _call(self, function: object, *arrays: Array) -> None:
        function(*(ctypes.c_void_p(array.ctypes.data) for array in (self.memory, *arrays)))  # type: ignore[operator]


def replay(host: Host, recording: Recording) -> list[Reply]:
    """The answers to all recorded periods, from reset on."""
    host.reset(recording.before)
    return [
        host.step(state, recording.path[k : k + host.rows], acting)
        for k, (state, acting) in enumerate(zip(recording.state, recording.acting, strict=True))
    ]
