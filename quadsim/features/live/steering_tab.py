"""The tab of a session's page that gives the set-point: by numbers, arrows, clicks, keys and sticks."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np

from quadsim.features.live import readout
from quadsim.features.live.stage import Stage
from quadsim.features.live.widgets import Widgets

_STEER: Final = {
    "W": ("+x", (1.0, 0.0, 0.0)),
    "S": ("-x", (-1.0, 0.0, 0.0)),
    "A": ("+y", (0.0, 1.0, 0.0)),
    "D": ("-y", (0.0, -1.0, 0.0)),
    "R": ("+z", (0.0, 0.0, 1.0)),
    "F": ("-z", (0.0, 0.0, -1.0)),
}
"""The keys that steer the set-point: where to, in a word and as a direction."""
_STEER_STEP: Final = 0.5  # [m/s] by which each of these keys changes the set-point's velocity
_STEER_MOST: Final = 5.0  # [m/s] largest velocity of the set-point along an axis


class Steering:
    """The set-point, by every way that there is to give one."""

    def __init__(self, widgets: Widgets, scene: Any, stage: Stage, use: Callable[[str], None]) -> None:
        """Fill the tab; `use` takes a hint away."""
        self._session = widgets.session
        self._stage = stage
        self._use = use
        self._velocity = np.zeros(3)
        gui = widgets.gui
        gui.add_html(readout.block(readout.STEER, "why"))
        x, y, z, heading = map(float, self._session.flights[0].loop.course.row(0)[:4])
        start = np.array([x, y, z])
        plain_arrows = {"disable_rotations": True, "disable_sliders": True}
        self._handle = scene.add_transform_controls("/target", scale=3.0 * stage.unit, position=start, **plain_arrows)
        self._handle.visible = False  # it would lie over the vehicle, and take its pulls
        arrows = gui.add_checkbox("Arrows to drag", False)
        widgets.on(arrows.on_update, lambda event: setattr(self._handle, "visible", event.target.value))
        widgets.on(self._handle.on_update, lambda event: self._set_point(event.target.position))
        place = gui.add_vector3("Set-point [m]", (x, y, z), step=0.1)
        self._place = widgets.value(place, self._set_point)
        widgets.on(scene.on_click(modifier="shift"), self.clicked)
        yaw = math.degrees(math.remainder(heading, 2.0 * math.pi))
        slider = gui.add_slider("Yaw [deg]", -180.0, 180.0, 5.0, round(yaw, 1))
        widgets.submits(slider, lambda value: {"type": "setpoint", "yaw": float(value)})
        self._steered = gui.add_text("Set-point velocity [m/s]", "0, 0, 0", disabled=True)
        self._add_keys(widgets)
        widgets.button("Stop set-point", lambda event: self.stop())

    def _add_keys(self, widgets: Widgets) -> None:
        """Add the commands that keys give."""
        for key, (name, direction) in _STEER.items():
            command = widgets.gui.add_command(f"Fly {name}", hotkey=key)
            widgets.on(command.on_trigger, partial(self._fly_on, _STEER_STEP * np.array(direction)))
        stop = widgets.gui.add_command("Stop the set-point", hotkey="X")
        widgets.on(stop.on_trigger, lambda event: self.stop())

    def clicked(self, event: Any) -> None:
        """Fly to the point of the ground that was clicked, at the set-point's height."""
        origin = np.array(event.ray_origin)
        direction = np.array(event.ray_direction)
        above = origin[2] - self._stage.ground
        if above * direction[2] >= 0.0:  # it does not meet the ground
            return
        x, y, _ = origin - above / direction[2] * direction
        last = self._session.flights[0].loop.last
        if last is None:
            height = self._place.value[2]
        else:
            height = last.observation.reference[2]
        self._set_point((x, y, height))
        self._use("waypoint")

    def _set_point(self, at: Any) -> None:
        self.stop()
        x, y, z = (round(float(number), 2) for number in at)
        self._handle.position = np.array([x, y, z])
        self._place.value = (x, y, z)
        self._stage.mark.position = (x, y, self._stage.ground)
        self._stage.mark.visible = True
        self._session.submit({"type": "setpoint", "x": x, "y": y, "z": z}, subject="setpoint")

    def stop(self) -> None:
        """Let the set-point stand."""
        self._fly(np.zeros(3))

    def reset(self) -> None:
        """Show what a new flight starts with, after the widgets have been reset."""
        self._handle.position = np.array(self._place.value)
        self._show(np.zeros(3))

    def _fly_on(self, change: Any, event: Any) -> None:
        self._fly(self._velocity + change)

    def _fly(self, velocity: Any) -> None:
        self._show(np.clip(velocity, -_STEER_MOST, _STEER_MOST))
        self._session.submit({"type": "steer", "velocity": self._velocity.tolist()}, subject="steer")

    def _show(self, velocity: Any) -> None:
        self._velocity = velocity
        self._steered.value = ", ".join(f"{speed:g}" for speed in velocity)
