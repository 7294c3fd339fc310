"""The structs of `quadsim/core/quadsim_plant.h`, and its functions: what happens at the physics rate, in C."""

from __future__ import annotations

import ctypes
from ctypes import POINTER, Structure, c_char_p, c_double, c_int64, c_void_p
from enum import IntEnum
from functools import cache
from typing import Any, Final

import numpy as np

from quadsim.core.library import check_sizes, load_library


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


class Fate:
    """What befalls a sensor's sample: a sum of these, as arrays of NumPy take them."""

    LOST: Final = 1
    FROZEN: Final = 2
    NO_NUMBER: Final = 4  # shifted left by the axis


def _members(text: str) -> list[tuple[str, Any]]:
    """Return the members of a struct, as `x n:3 M:2x3 *p #i`: doubles, a pointer after `*`, an integer after `#`."""
    members = []
    for word in text.split():
        name, _, shape = word.partition(":")
        kind: Any = c_void_p if name.startswith("*") else c_int64 if name.startswith("#") else c_double
        for size in reversed([int(size) for size in shape.split("x")] if shape else []):
            kind = kind * size
        members.append((name.lstrip("*#"), kind))
    return members


class VehicleStruct(Structure):
    """A `quadsim_vehicle`, its members in the same order: no check but that of the size would find two exchanged."""

    _fields_ = _members(
        "*step *model *data *motion *velocity *applied *control *wind *obstacles *fluid #mocaps timestep plausible "
        "fastest_valid mass gravity inertia:3 products:3 inverse:3x3 torque_of_thrust:3x4 linear "
        "coefficient:4 hover demand:4 linear_demand slowest fastest place:4x3 spin:4 rotor_drag rotor_inertia "
        "rotor_moment:2 inflow_moment:2 rate_damping:3 linear_drag:3 quadratic_drag:3 floor disc radius loss deviation "
        "largest:4 cells capacity resistance hover_current idle_current reference_voltage exponent *curve #points "
        "#follows_motion rise fall acceleration efficiency:4 #at_once *pushes #pushing #now time speeds:4 target:4 "
        "before:6 charge"
    )


class InnerStruct(Structure):
    """A `quadsim_inner`."""

    _fields_ = _members(
        "#kind #stride #until #measures command:8 answer:4 #holds_attitude step inertia:3 products:3 integral:3 "
        "filtered:3 slope:3 p:3 i:3 d:3 i_max:3 attitude:3 largest:3 gyro_share d_share to_thrusts:4x4 coefficient:4 "
        "low:4 high:4 linear:4 quadratic:4 #airmode #delay #oldest *queue effect:4x4 inverse:4x4 scale:4 omega least:4 "
        "most:4 last_time last_rates:3 #started"
    )


class SensorStruct(Structure):
    """A `quadsim_sensor`."""

    _fields_ = _members("#kind #stride #latency #first #heard *values *fate held:3 through:3 #passed")


class SensingStruct(Structure):
    """A `quadsim_sensing`."""

    _fields_ = _members("*sensors #count bias:3 attitude:4 rates:3")


class StepsStruct(Structure):
    """A `quadsim_steps`."""

    _fields_ = _members(
        "*noise *disturbance *obstacles *wind *physics *speeds *commands *thrust *wrench *battery #width #row"
    )


class FilterStruct(Structure):
    """A `quadsim_filter`."""

    _fields_ = _members(
        "timestep mass gravity inertia:3 products:3 inverse:3x3 allocation:4x4 rotor_moment:2 inflow_moment:2 "
        "rate_damping:3 density:5 variance:4x3 initial:15 gate patience #stride"
    )


class TrackStruct(Structure):
    """A `quadsim_track`."""

    _fields_ = _members("#step mean:16 P:15x15 #refused:4 #accepted:4 #rejected:4 nis:4")


class SampleStruct(Structure):
    """A `quadsim_sample`."""

    _fields_ = _members("#taken #kind value:3")


SAMPLE: Final = np.dtype(SampleStruct)
"""The type of an array of samples."""


def fill(member: Any, values: Any) -> None:
    """Copy numbers into an array of a struct."""
    np.ctypeslib.as_array(member)[...] = values


@cache
def plant_library() -> ctypes.CDLL:
    """Return the compiled core, with the functions of `quadsim_plant.h` declared."""
    core = load_library()
    check_sizes(quadsim_vehicle=VehicleStruct, quadsim_inner=InnerStruct, quadsim_sensor=SensorStruct)
    check_sizes(quadsim_steps=StepsStruct, quadsim_sensing=SensingStruct)
    check_sizes(quadsim_filter=FilterStruct, quadsim_track=TrackStruct, quadsim_sample=SampleStruct)
    sensing, inner = POINTER(SensingStruct), POINTER(InnerStruct)
    core.quadsim_fly.restype = c_int64
    core.quadsim_fly.argtypes = [POINTER(VehicleStruct), inner, sensing, POINTER(StepsStruct), c_void_p, c_int64]
    core.quadsim_sense.argtypes = core.quadsim_hear.argtypes = [sensing, c_int64, c_void_p]
    core.quadsim_answer.argtypes = [inner, c_double, c_void_p, c_void_p, c_void_p]
    core.quadsim_states.argtypes = [c_void_p, c_int64, c_int64, c_double, c_void_p]
    core.quadsim_allocate.argtypes = [inner, c_void_p, c_void_p]
    core.quadsim_filter_run.argtypes = [
        *(POINTER(FilterStruct), POINTER(TrackStruct)),
        *(c_void_p, c_int64, c_void_p, c_void_p, c_int64, c_int64),
    ]
    core.quadsim_complaint.restype = c_char_p
    return core
