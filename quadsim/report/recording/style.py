"""How a recording looks: the timeline, which signals share a plot, and the colours."""

from __future__ import annotations

from typing import Final

import rerun as rr

from quadsim.flight.audit import SIGNALS
from quadsim.flight.log import FlightLog
from quadsim.report.figure import line_colour
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS

TIMELINE: Final = "sim_time"

PANELS: Final[dict[str, tuple[str, ...]]] = {
    "Position": ("x", "y", "z"),
    "Roll and pitch": ("roll", "pitch"),
    "Rotor speeds": ("speed",),
    "Steps of the rotor speeds, per period": ("slew",),
    "Velocity": ("vx", "vy", "vz"),
    "Position errors": ("x_error", "y_error", "z_error"),
    "Attitude rates": ("roll_rate", "pitch_rate", "yaw_rate"),
    "Body rates": ("body_rate_x", "body_rate_y", "body_rate_z"),
    "Yaw and tilt": ("yaw", "tilt", "yaw_error"),
    "Position as measured, less the true one": ("x_estimate_error", "y_estimate_error", "z_estimate_error"),
    "Attitude as measured, less the true one": ("roll_estimate_error", "pitch_estimate_error", "yaw_estimate_error"),
}
"""Title of each plot, and its signals; every signal is in one, so that every limit is drawn."""
assert sorted(name for names in PANELS.values() for name in names) == sorted(SIGNALS)
_ANY_ATTITUDE: Final = {
    "Roll and pitch": ("Tilt", ("tilt",)),
    "Yaw and tilt": ("Roll, pitch and yaw", ("roll", "pitch", "yaw", "yaw_error")),
}
"""What takes a plot's place where the vehicle may turn upside down: Euler angles jump there."""
FRONT_PANELS: Final = 4  # how many of the plots are seen first

Colour = tuple[int, int, int, int]


def panels(log: FlightLog) -> dict[str, tuple[str, ...]]:
    """The plots of a flight, `FRONT_PANELS` of them first."""
    if log.plant.attitude is None:
        return PANELS
    return dict(_ANY_ATTITUDE.get(title, (title, names)) for title, names in PANELS.items())


def on_screen(colour: str) -> Colour:
    """A colour made for paper, lightened: the viewer's background may be black or white."""
    red, green, blue = (round(0.7 * int(colour[i : i + 2], 16) + 0.3 * 255) for i in (1, 3, 5))
    return red, green, blue, 255


SERIES: Final = tuple(on_screen(line_colour(i)) for i in range(N_ROTORS))
FLOWN: Final = (70, 160, 255, 255)
WHOLE_PATH: Final = (70, 160, 255, 60)
REFERENCE: Final = (165, 170, 178, 255)
PREDICTED: Final = (255, 160, 40, 255)
BOUND: Final = (255, 70, 70, 255)
FORCE: Final = (225, 90, 200, 255)
WIND: Final = (110, 220, 225, 255)
OBSTACLE: Final = (184, 92, 72, 255)
REGION: Final = (215, 205, 90, 255)
AXES: Final = ((230, 90, 90, 255), (90, 200, 110, 255), (90, 140, 250, 255))

VERDICTS: Final = {
    "holds": (46, 125, 80, 255),
    "active": (214, 150, 30, 255),
    "violated": (220, 50, 50, 255),
    "not in force": (0, 0, 0, 0),
}


def time_column(t: Array) -> rr.TimeColumn:
    """Instants [s] on the recording's one timeline."""
    return rr.TimeColumn(TIMELINE, duration=t)
