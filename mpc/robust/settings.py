"""The parts of the robust controller, each with a setting of its own."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from mpc.constraints import Penalty
from mpc.observer import ObserverSettings
from quadsim.errors import ParameterError
from quadsim.state import Array

LONGEST_SPAN: Final = 0.25
"""Longest time between two measured states [s] for their difference to show a disturbance; a sensor of 4 Hz."""


@dataclass(frozen=True, kw_only=True)
class RobustSettings:
    """The parts of the robust controller; each absent or off unless given."""

    penalty: Penalty | None = None  # what leaving an output bound costs; None for hard output bounds
    rotor_lag: float = 0.0  # time constant of the rotor speeds that the prediction knows [s]; 0 for none
    delay: float = 0.0  # time from measurement to command that the prediction bridges [s]
    observer: ObserverSettings | None = None  # of the disturbance observer; None for no offset-free tracking
    heading: bool = False
    """Whether the hover model is turned by the yaw.  The weights of x and y are then those forward and to the left;
    where these differ, flights to different headings do."""
    largest_turn: float = 0.5
    """How far the prediction may turn at once [rad], from the present yaw or from one period to the next; it goes on
    from there.  Of no effect on the hover model without `heading`."""
    move_weight: Array | None = None  # Q_d (4, 4), of a command's change from one period to the next; None for none
    margins: Array | None = None  # (N, n_c) by which the output bounds are tightened; None for none
    terminal: bool = False  # whether the last state has the weight of the hover model's LQR

    def __post_init__(self) -> None:
        for name in ("rotor_lag", "delay"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ParameterError("controller", name, getattr(self, name), "at least 0 s and finite")
        if not 0.0 < self.largest_turn < math.inf:
            raise ParameterError("controller", "largest_turn", self.largest_turn, "positive and finite")
