"""The structs of `quadsim/core/quadsim_plant.h`: what happens at the physics rate, in C."""

from __future__ import annotations

import ctypes
from enum import IntEnum
from typing import Final

import numpy as np

from quadsim.core.mirror import struct


class End(IntEnum):
    """Why `quadsim_fly` returned."""

    DONE = 0  # it has come to the step that was asked for
    DUE = 1  # the inner loop is the caller's to answer
    INVALID = 2  # the inner loop's answer is not four speeds
    DIVERGED = 3  # the last step's state is not finite, or not plausible
    FAILED = 4  # MuJoCo gave up


class LoopKind(IntEnum):
    """Who answers for an inner loop."""

    OUTSIDE = 0  # the caller
    AUTOPILOT = 1
    INDI = 2


class SampleFault:
    """What is wrong with a sensor's sample: a sum of these, of type int as arrays of NumPy need it."""

    LOST: Final = 1
    FROZEN: Final = 2
    NO_NUMBER: Final = 4  # shifted left by the axis


VehicleStruct: Final = struct("quadsim_vehicle")
InnerStruct: Final = struct("quadsim_inner")
SensorStruct: Final = struct("quadsim_sensor")
SensingStruct: Final = struct("quadsim_sensing")
StepsStruct: Final = struct("quadsim_steps")
FilterStruct: Final = struct("quadsim_filter")
TrackStruct: Final = struct("quadsim_track")
SampleStruct: Final = struct("quadsim_sample")

BoundStruct: Final = struct("quadsim_bound")
PeriodStruct: Final = struct("quadsim_period")
FlightStruct: Final = struct("quadsim_flight")

SAMPLE: Final = np.dtype(SampleStruct)
"""The type of an array of samples."""
SAMPLES: Final = ctypes.POINTER(SampleStruct)
"""The type of its address, as `samples.ctypes.data_as(SAMPLES)`."""
