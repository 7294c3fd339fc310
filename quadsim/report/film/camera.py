"""Pictures of single states while they are flown, rendered in a child process that stays."""

from __future__ import annotations

import contextlib
import pickle
import subprocess
from collections.abc import Sequence
from struct import Struct
from typing import Any, Final

import numpy as np

from quadsim.errors import ParameterError, RenderingUnavailableError
from quadsim.report.film.video import rendering_backend, worker_process
from quadsim.rotation import euler_to_quaternion
from quadsim.space import Obstacle
from quadsim.state import EULER, POSITION, Array
from quadsim.vehicle import Vehicle

REQUEST: Final = Struct("15d")
"""Time [s], position [m] and quaternion wxyz of the vehicle, position of the reference [m], rotors' angles [rad]."""
_FRAME_TIME: Final = 1.0 / 30.0  # for how long the rotors turn from one picture to the next [s]


class Camera:
    """Follows a vehicle among obstacles; pictures of width by height [pixels].  Close it, or use it in a `with` block.

    Raises:
        RenderingUnavailableError: this machine cannot render.
        ParameterError: a size that cannot be.
    """

    def __init__(self, vehicle: Vehicle, obstacles: Sequence[Obstacle], *, width: int, height: int) -> None:
        for name, value in (("width", width), ("height", height)):
            if not 16 <= value <= 4096:
                raise ParameterError("", name, value, "from 16 to 4096 pixels")
        self._shape = (height, width, 3)
        self._turned = np.zeros(4)
        self._backend = rendering_backend()
        self._process: subprocess.Popen[bytes] = worker_process("serve", self._backend)
        self._send(pickle.dumps((vehicle, tuple(obstacles), width, height)))

    def __enter__(self) -> Camera:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def picture(
        self, state: Array, rotors: Array, reference: Array, time: float
    ) -> np.ndarray[Any, np.dtype[np.uint8]]:
        """One picture (height, width, 3) of a state (12,), rotor speeds (4,) [rad/s] and x, y, z [m] of a reference.

        Obstacles are where they are at `time` [s].

        Raises:
            RenderingUnavailableError: the renderer has ended.
        """
        self._turned = self._turned + _FRAME_TIME * rotors
        pose = [*state[list(POSITION)], *euler_to_quaternion(state[list(EULER)])]
        self._send(REQUEST.pack(time, *pose, *reference[:3], *self._turned))
        assert self._process.stdout is not None
        size = int(np.prod(self._shape))
        data = self._process.stdout.read(size)
        if len(data) < size:
            raise RenderingUnavailableError({self._backend: "the renderer has ended"})
        return np.frombuffer(data, np.uint8).reshape(self._shape).copy()

    def close(self) -> None:
        """End the child process."""
        process = self._process
        if process.poll() is None:
            process.kill()
        for pipe in (process.stdin, process.stdout):
            assert pipe is not None
            pipe.close()
        process.wait()

    def _send(self, request: bytes) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # then no picture comes either
            self._process.stdin.write(request)
            self._process.stdin.flush()
