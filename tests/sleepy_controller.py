"""A controller that hovers, and takes its time without taking the processor's: flights long enough to be killed.

It stands alone: the processes of a campaign import it by the place of this file.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np


class Sleepy:
    """The rotor speeds that hover, after 30 ms.

    Args:
        vehicle: its hover speed is answered.
        period: not used.
        horizon: not used.
    """

    def __init__(self, vehicle: Any, *, period: float, horizon: int) -> None:
        self._speeds = np.full(4, vehicle.hover_speed)

    def step(self, now: Any, state: Any, reference: Any) -> Any:
        """See `quadsim.controller.Controller`."""
        time.sleep(0.03)
        return self._speeds
