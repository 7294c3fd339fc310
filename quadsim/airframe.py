"""From a vehicle to a compiled MuJoCo model: `models/quadrotor.xml` gives the shape, the vehicle gives the numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import mujoco
import numpy as np

from quadsim.assets import models_dir
from quadsim.state import Array, euler_to_quaternion
from quadsim.vehicle import N_ROTORS, Vehicle

BODY: Final = "quadrotor"
FLOOR: Final = "floor"
IMU: Final = "imu"
ROTOR_NAMES: Final = tuple(f"rotor{i}" for i in range(1, N_ROTORS + 1))
ARM_NAMES: Final = tuple(f"arm{i}" for i in range(1, N_ROTORS + 1))
PROPELLER_NAMES: Final = tuple(f"propeller{i}" for i in range(1, N_ROTORS + 1))

DRAWN_ARM: Final = 0.3
"""Arm length [m] for which `quadrotor.xml` is drawn."""
_WIDEST_DISC: Final = 0.48
"""Largest radius of a rotor disc, in distances between neighbouring rotors: discs never meet."""
_IDLE: Final = (
    mujoco.mjtDisableBit.mjDSBL_CONSTRAINT,
    mujoco.mjtDisableBit.mjDSBL_SPRING,
    mujoco.mjtDisableBit.mjDSBL_DAMPER,
)
"""Stages of MuJoCo's step with nothing to do for a free body that meets nothing: a sixth of its time."""


def build_spec(vehicle: Vehicle, *, visuals: bool = True) -> mujoco.MjSpec:
    """The airframe's specification with every physical number taken from the vehicle.

    Actuator i takes the thrust f_i = b w_i^2 [N] as its control and acts on site i along the site's z axis; the
    sixth entry of its gear turns thrust into reaction torque, spin_i d / b [m].

    Args:
        vehicle: the numbers.
        visuals: whether to keep what is there to be looked at and read (geoms, lights, cameras, sensors), fitted to the
            vehicle's arms.  None of it moves the vehicle: without it every state is the same to the last bit, in half
            the time.
    """
    spec = mujoco.MjSpec.from_file(str(models_dir() / "quadrotor.xml"))
    spec.option.gravity = [0.0, 0.0, -vehicle.gravity]
    body = spec.body(BODY)
    body.mass, body.inertia = vehicle.mass, list(vehicle.inertia)
    thrust_range = rotor_thrusts(vehicle, np.array([vehicle.speed_min, vehicle.speed_max]))
    for name, position, spin in zip(ROTOR_NAMES, vehicle.rotor_positions, vehicle.rotor_spins, strict=True):
        spec.site(name).pos = position
        actuator = spec.actuator(name)
        actuator.gear = [0.0, 0.0, 1.0, 0.0, 0.0, spin * vehicle.drag_to_thrust]
        actuator.ctrlrange = thrust_range
    if visuals:
        _fit_drawing(spec, vehicle)
    else:
        _strip(spec)
    return spec


def compile_model(
    vehicle: Vehicle, *, timestep: float = 1e-3, limit_speeds: bool = False, visuals: bool = False
) -> mujoco.MjModel:
    """Compile the airframe.

    Args:
        vehicle: the numbers.
        timestep: physics step [s].
        limit_speeds: whether thrusts saturate at the vehicle's rotor speed range; else any thrust >= 0 acts.
        visuals: whether the model can be looked at; see `build_spec`.
    """
    spec = build_spec(vehicle, visuals=visuals)
    spec.option.timestep = timestep
    for name in ROTOR_NAMES:
        spec.actuator(name).ctrllimited = int(limit_speeds)
    return spec.compile()


def rotor_thrusts(vehicle: Vehicle, speeds: Array) -> Array:
    """Thrusts b w^2 [N] of rotor speeds [rad/s], any shape."""
    return vehicle.thrust_coefficient * np.square(speeds)


def _fit_drawing(spec: mujoco.MjSpec, vehicle: Vehicle) -> None:
    """Scale the drawing to the arm length, turn each arm to its rotor, and colour those that point forward."""
    scale = vehicle.arm_length / DRAWN_ARM
    _scale([*spec.geoms, *spec.cameras, *(spec.body(name) for name in PROPELLER_NAMES)], scale)
    spec.geom(FLOOR).size = [0.0, 0.0, 1.0]  # endless whatever the scale
    spec.stat.extent *= scale
    positions = vehicle.rotor_positions
    gaps = np.linalg.norm(positions[:, None] - positions[None], axis=2)[~np.eye(N_ROTORS, dtype=bool)]
    radius = min(spec.geom("disc1").size[0], _WIDEST_DISC * float(gaps.min()))
    for i, azimuth in enumerate(np.radians(vehicle.rotor_azimuths), start=1):
        spec.body(f"arm{i}").quat = euler_to_quaternion(np.array([0.0, 0.0, azimuth]))
        disc, blades = spec.geom(f"disc{i}"), spec.geom(f"blades{i}")
        disc.size[0] = blades.size[0] = radius
        if positions[i - 1, 0] > 0.1 * vehicle.arm_length:
            spec.geom(f"arm{i}").material = "front"
            disc.material = "disc_front"


def _scale(elements: Sequence[mujoco.MjsGeom | mujoco.MjsCamera | mujoco.MjsBody], scale: float) -> None:
    for element in elements:
        element.pos *= scale
        if isinstance(element, mujoco.MjsGeom):
            element.size *= scale
            element.fromto *= scale


def _strip(spec: mujoco.MjSpec) -> None:
    """Leave what moves: one free body, its rotors, and of each step only what acts on it."""
    arms = [spec.body(name) for name in ARM_NAMES]  # with what hangs on them
    rest = [*spec.worldbody.geoms, *spec.body(BODY).geoms, *spec.cameras, *spec.lights, *spec.sensors]
    for element in [*arms, *rest, spec.site(IMU), *spec.materials, *spec.textures]:
        spec.delete(element)
    for idle in _IDLE:
        spec.option.disableflags |= int(idle)
