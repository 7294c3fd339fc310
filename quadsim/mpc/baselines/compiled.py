"""The structs and functions of the geometric law in C, `quadsim_geometric.h`."""

from __future__ import annotations

import ctypes
from functools import cache

from quadsim.core.library import AT, INT, REAL, check_sizes, load_library, struct_members
from quadsim.mpc.disturbance import RampState
from quadsim.mpc.fallback.structs import GuardStruct


class GeometricNumbersStruct(ctypes.Structure):
    """A `quadsim_geometric_numbers`."""

    _fields_ = [
        *struct_members(INT, "commands feedforward moment exact motion horizon orders"),
        *struct_members(REAL, "period mass gravity k_x k_v k_R:3 k_Omega:3 k_attitude:3 k_i k_I c_1 c_2 sigma sigma_R"),
        *struct_members(
            REAL, "least_lift slope ahead lead:3 drag:3 inertia:9 across:2 inflow:2 damping:3 turning least:4 most:4"
        ),
        *struct_members(AT, "preview course ramp fallback"),
    ]


class MotionStruct(ctypes.Structure):
    """A `quadsim_geometric_motion`."""

    _fields_ = struct_members(REAL, "position:3 velocity:3 attitude:9 rates:3 yaw")


class TargetStruct(ctypes.Structure):
    """A `quadsim_geometric_target`."""

    _fields_ = [
        *struct_members(REAL, "path:15 yaw:3"),
        *struct_members(INT, "headed"),
        *struct_members(REAL, "heading:9"),
    ]


class DisturbanceStruct(ctypes.Structure):
    """A `quadsim_geometric_disturbance`."""

    _fields_ = struct_members(REAL, "force:3 change:3 torque:3")


class AttitudeStruct(ctypes.Structure):
    """A `quadsim_geometric_attitude`."""

    _fields_ = struct_members(REAL, "attitude:9 rates:3 acceleration:3")


class GeometricStruct(ctypes.Structure):
    """A `quadsim_geometric`."""

    _fields_ = [
        *struct_members(AT, "numbers"),
        *struct_members(REAL, "translation:3 rotation:3 command:8 thrust_scale"),
        ("desired", AttitudeStruct),
        ("ramp", RampState),
        *struct_members(AT, "plan"),
        *struct_members(INT, "learns"),
        ("guard", GuardStruct),
    ]


@cache
def geometric_library() -> ctypes.CDLL:
    """Return the library with the law's functions declared."""
    library = load_library()
    check_sizes(
        quadsim_geometric_numbers=GeometricNumbersStruct,
        quadsim_geometric_motion=MotionStruct,
        quadsim_geometric_target=TargetStruct,
        quadsim_geometric_disturbance=DisturbanceStruct,
        quadsim_geometric_attitude=AttitudeStruct,
        quadsim_geometric=GeometricStruct,
    )
    for name, arguments in {
        "start": [AT, AT, AT],
        "reset": [AT, AT],
        "measure": [AT, AT, AT, AT],
        "preview": [AT, AT, AT],
        "course": [AT, INT, INT, AT, AT],
        "limit": [AT, REAL, REAL, AT],
        "wrench": [AT] * 5,
        "targets": [AT] * 5,
        "integrate": [AT, AT, AT],
        "solve": [AT, INT, INT, AT, AT, AT],
    }.items():
        function = getattr(library, f"quadsim_geometric_{name}")
        function.restype, function.argtypes = None, arguments
    return library
