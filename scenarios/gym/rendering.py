"""What an environment shows: pictures of a child process, or a window."""

from __future__ import annotations

import os
import sys
import threading
import time as clock
from typing import Any, Final, Protocol

import mujoco
import numpy as np

from quadsim.report.film.camera import Camera
from quadsim.rotation import euler_to_quaternion
from quadsim.sim.airframe import compile_model
from quadsim.state import EULER, POSITION, Array
from quadsim.vehicle import Vehicle
from scenarios.schema.scenario import Scenario

Picture = np.ndarray[Any, np.dtype[np.uint8]]
DISPLAYS: Final = ("DISPLAY", "WAYLAND_DISPLAY")
_CLOSING: Final = 5.0  # [s] that a window may take to close


def has_display() -> bool:
    """Whether windows can be opened here."""
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in DISPLAYS)


class Screen(Protocol):
    """Shows a state after each step."""

    def show(self, state: Array, rotors: Array, reference: Array, time: float) -> Picture | None:
        """Show a state (12,), rotor speeds (4,) [rad/s] and the reference (4,) at a time [s]; the picture, if any."""
        ...

    def close(self) -> None:
        """Give the renderer or the window back."""
        ...


class _Pictures:
    def __init__(self, scenario: Scenario, vehicle: Vehicle, width: int, height: int) -> None:
        self._camera = Camera(vehicle, scenario.obstacles, width=width, height=height)

    def show(self, state: Array, rotors: Array, reference: Array, time: float) -> Picture | None:
        return self._camera.picture(state, rotors, reference, time)

    def close(self) -> None:
        self._camera.close()


class _Window:
    """MuJoCo's own viewer, with the vehicle where it is, no quicker than real time."""

    def __init__(self, scenario: Scenario, vehicle: Vehicle) -> None:
        import mujoco.viewer as viewer  # which loads GLFW

        self._model = compile_model(vehicle, visuals=True, obstacles=scenario.obstacles)
        self._data = mujoco.MjData(self._model)
        others = set(threading.enumerate())
        self._viewer = viewer.launch_passive(self._model, self._data, show_left_ui=False, show_right_ui=False)
        self._threads = [thread for thread in threading.enumerate() if thread not in others]
        self._period, self._due = scenario.control_period, clock.monotonic()
        self._viewer.cam.distance = 8.0 * vehicle.arm_length

    def show(self, state: Array, rotors: Array, reference: Array, time: float) -> Picture | None:
        if self._viewer.is_running():
            with self._viewer.lock():
                position = state[list(POSITION)]
                self._data.qpos[:3], self._data.qpos[3:7] = position, euler_to_quaternion(state[list(EULER)])
                mujoco.mj_forward(self._model, self._data)
                self._viewer.cam.lookat[:] = position
            self._viewer.sync()
            self._due = max(self._due + self._period, clock.monotonic() - self._period)
            clock.sleep(max(0.0, self._due - clock.monotonic()))
        return None

    def close(self) -> None:
        self._viewer.close()
        for thread in self._threads:  # a window that still closes while Python ends takes the process with it
            thread.join(_CLOSING)


def make_screen(mode: str | None, scenario: Scenario, vehicle: Vehicle, width: int, height: int) -> Screen:
    """What shows a scenario in a mode, `rgb_array` or `human`.

    Raises:
        RenderingUnavailableError: nothing can here.
    """
    return _Window(scenario, vehicle) if mode == "human" else _Pictures(scenario, vehicle, width, height)
