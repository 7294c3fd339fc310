"""Inner loops that the compiled core answers for: an autopilot, or incremental nonlinear dynamic inversion."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

from quadsim.core.mirror import Struct, core_library
from quadsim.core.structs import InnerStruct
from quadsim.state import Array


class CompiledLoop:
    """An inner loop whose constants and state are a struct of the core; `quadsim.controller.InnerLoop`.

    Attributes:
        rate: of its calls [Hz].
    """

    rate: float

    def __init__(self, struct: Struct, *, delay: int = 0) -> None:
        """Take over a struct whose constants are filled in; `delay` calls pass before an answer comes out."""
        self._struct = struct
        self._queue = np.zeros((max(delay, 1), 4))
        struct.delay = delay

    def engage(self, command: Array, rotors: Array) -> Struct | None:
        """Let a command fly from now on, at rotor speeds (4,) [rad/s].

        Returns:
            the struct that answers in the core; None where a subclass has `speeds` of its own, which is to be asked.
        """
        if type(self).speeds is CompiledLoop.speeds:
            return self._engaged(command)
        return None

    def speeds(self, time: float, commanded: Array, rates: Array, rotors: Array, attitude: Array) -> Array:
        """See `quadsim.controller.InnerLoop`."""
        struct = self._engaged(commanded)
        rates = np.ascontiguousarray(rates, np.float64)
        rotors = np.ascontiguousarray(rotors, np.float64)
        attitude = np.ascontiguousarray(attitude, np.float64)
        core_library().quadsim_answer(struct, time, rates.ctypes.data, rotors.ctypes.data, attitude.ctypes.data)
        return np.array(struct.answer)

    def _engaged(self, command: Array) -> Struct:
        """Return the struct with a command to fly."""
        struct = self._struct
        struct.command[: command.size] = command
        struct.holds_attitude = command.size > len(struct.answer)
        struct.queue = self._queue.ctypes.data
        return struct

    def __getstate__(self) -> dict[str, Any]:
        """The struct as bytes: one with pointers cannot be copied; `engage` points it to the queue."""
        content = ctypes.string_at(ctypes.byref(self._struct), ctypes.sizeof(InnerStruct))
        return {**self.__dict__, "_struct": content}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _struct=InnerStruct.from_buffer_copy(state["_struct"]))
