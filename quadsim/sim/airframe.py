"""Compile a vehicle into a MuJoCo model: `models/quadrotor.xml` gives the shape, the vehicle file the numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import mujoco
import numpy as np

from quadsim.assets import models_dir
from quadsim.flight.phase import Outline
from quadsim.palette import COLOUR, rgba
from quadsim.rotation import euler_to_quaternion
from quadsim.space import Obstacle
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS, Vehicle

BODY: Final = "quadrotor"
FLOOR: Final = "floor"
IMU: Final = "imu"


def _names_of(part: str) -> tuple[str, ...]:
    """Return the names in the model of a part that each rotor has."""
    return tuple(f"{part}{i}" for i in range(1, N_ROTORS + 1))


ROTOR_NAMES: Final = _names_of("rotor")
ARM_NAMES: Final = _names_of("arm")
FOOT_NAMES: Final = _names_of("foot")
DISC_NAMES: Final = _names_of("disc")
PROPELLER_NAMES: Final = _names_of("propeller")

DRAWN_ARM: Final = 0.3  # arm length [m] for which `quadrotor.xml` is drawn
_WIDEST_DISC: Final = 0.48  # largest disc radius, in distances between rotors, so that discs never overlap
_IDLE: Final = (mujoco.mjtDisableBit.mjDSBL_SPRING, mujoco.mjtDisableBit.mjDSBL_DAMPER)
"""Stages of MuJoCo's step that do nothing for a free body; with contact they take a sixth of its time."""
_CONTACT: Final = (mujoco.mjtDisableBit.mjDSBL_CONSTRAINT, mujoco.mjtDisableBit.mjDSBL_CONTACT)
"""Stages needed only by a body that may touch the ground."""
_STIFFNESS: Final = (0.005, 1.0)
"""Time constant [s] and damping ratio of a contact (MuJoCo's solref); five steps, where MuJoCo requires two or more."""
_FRICTION: Final = (0.8, 0.005, 0.0001)
"""Sliding [-], torsional and rolling [m] friction between rubber feet and a hard floor: a textbook value, and MuJoCo's
defaults."""
_MEETS: Final = 1  # bit of contype and conaffinity for contact of floor and airframe
_MEETS_OBSTACLES: Final = 2
"""Bit of contype and conaffinity for contact of obstacles and the vehicle's bounding ball."""
_RIM: Final = 32
"""Points on the rim of a rotor disc; they miss its lowest point by at most half a percent of its radius."""
_LEG: Final = 0.35  # where a leg meets its arm in the drawing, as a share of the arm
DRAG: Final = "drag"
_BLUNT: Final = (0.5, 0.0, 0.0, 0.0, 0.0)
"""Fluid coefficients that turn MuJoCo's ellipsoid drag -rho C_blunt A |v| v into -rho A |v| v / 2; added mass stays."""


def outline(vehicle: Vehicle) -> Outline:
    """Return the parts of the airframe that touch the ground first."""
    model = compile_model(vehicle, visuals=True)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    feet = [data.geom(name).xpos for name in FOOT_NAMES]
    around = np.linspace(0.0, 2.0 * np.pi, _RIM, endpoint=False)
    rim = np.stack([np.cos(around), np.sin(around), np.zeros(_RIM)], axis=1)
    hull = []
    for name in DISC_NAMES:
        radius = model.geom(name).size[0]
        hull.append(data.geom(name).xpos + radius * rim)
    battery = data.geom("battery").xpos - [0.0, 0.0, model.geom("battery").size[2]]
    hull.append(battery[None, :])
    return Outline(
        feet=np.array(feet),
        foot_radius=float(model.geom(FOOT_NAMES[0]).size[0]),
        hull=np.concatenate(hull),
        floor=float(model.geom(FLOOR).pos[2]),
        disc=float(data.geom(DISC_NAMES[0]).xpos[2]) - float(vehicle.hubs[0, 2]),
    )


def compile_model(
    vehicle: Vehicle,
    *,
    timestep: float = 1e-3,
    limit_speeds: bool = False,
    visuals: bool = False,
    contact: bool = False,
    reweighed: bool = False,
    body_drag: tuple[float, ...] | None = None,
    air_density: float = 0.0,
    obstacles: Sequence[Obstacle] = (),
) -> mujoco.MjModel:
    """Compile the airframe with all physical numbers from the vehicle.

    Actuator i takes the thrust f_i = b w_i^2 [N] as its control and acts on site i along the site's z axis; the sixth
    entry of its gear converts thrust to reaction torque, spin_i d / b [m].

    Args:
        vehicle: the numbers.
        timestep: physics step [s].
        limit_speeds: whether thrusts saturate at the vehicle's rotor speed range; else any thrust >= 0 acts.
        visuals: whether to keep parts that only display or measure (geoms, lights, cameras, sensors), fitted to the
            vehicle's arms.  They do not affect the motion: without them every state is equal to the last bit, in half
            the time.
        contact: whether feet and hull touch the floor.
        reweighed: whether the body's mass may change after compilation; see `quadsim.sim.effects.load.apply_mass`.
        body_drag: drag areas C_d A along the body axes [m^2], or None.  The drag is MuJoCo's own, on the ellipsoid
            with these projected areas: -rho A |v| v / 2 against the air that `option.wind` moves.  It includes the
            ellipsoid's added-mass terms: a few grams of air, and a torque in oblique flow, `munk_moment`, which a
            vehicle of some 200 g feels at 5 m/s.
        air_density: rho [kg/m^3].
        obstacles: objects that the vehicle's bounding ball touches; moving ones are mocap bodies with their names.
    """
    spec = mujoco.MjSpec.from_file(str(models_dir() / "quadrotor.xml"))
    spec.option.timestep = timestep
    spec.option.gravity = [0.0, 0.0, -vehicle.gravity]
    body = spec.body(BODY)
    body.mass = vehicle.mass
    body.inertia = list(vehicle.inertia)
    if vehicle.products_of_inertia is not None:
        body.inertia = np.zeros(3)
        body.fullinertia = [*vehicle.inertia, *vehicle.products_of_inertia]
    if reweighed:
        body.simple = 0
    ranges = vehicle.thrusts(np.array([[vehicle.speed_min], [vehicle.speed_max]])).T
    rotors = zip(ROTOR_NAMES, vehicle.hubs, vehicle.rotor_spins, ranges, strict=True)
    for name, position, spin, thrust_range in rotors:
        spec.site(name).pos = position
        actuator = spec.actuator(name)
        actuator.gear = [0.0, 0.0, 1.0, 0.0, 0.0, spin * vehicle.drag_to_thrust]
        actuator.ctrlrange = thrust_range
        actuator.ctrllimited = int(limit_speeds)
    _fit_drawing(spec, vehicle)
    if contact:
        _ground(spec)
    if not visuals:
        _strip(spec, contact=contact)
    if body_drag is not None:
        _add_drag(spec, body_drag, air_density)
    if obstacles:
        _add_obstacles(spec, obstacles, vehicle.enclosing_radius)
    return spec.compile()


def _fit_drawing(spec: mujoco.MjSpec, vehicle: Vehicle) -> None:
    """Scale the drawing to the arms, lead each to its rotor, size the discs as the rotors, colour what is in front."""
    scale = vehicle.longest_arm / DRAWN_ARM
    propellers = [spec.body(name) for name in PROPELLER_NAMES]
    for element in (*spec.geoms, *spec.cameras, *propellers):
        element.pos *= scale
        if isinstance(element, mujoco.MjsGeom):
            element.size *= scale
            element.fromto *= scale
    spec.geom(FLOOR).size = [0.0, 0.0, 1.0]  # endless whatever the scale
    spec.stat.extent *= scale
    radius = min(vehicle.rotor_radius or spec.geom("disc1").size[0], _WIDEST_DISC * vehicle.closest_rotors)
    for i, (x, y, z) in enumerate(vehicle.hubs.tolist(), start=1):
        spec.body(f"arm{i}").quat = euler_to_quaternion(np.array([0.0, 0.0, vehicle.azimuths[i - 1]]))
        share = math.hypot(x, y) / vehicle.longest_arm
        for part in ("arm", "motor", "cap", "leg", "foot"):
            geom = spec.geom(f"{part}{i}")
            geom.pos[0] *= share
            geom.fromto[[0, 3]] *= share
            geom.fromto[[2, 5]] += {"arm": (0.0, z), "motor": (z, z), "leg": (_LEG * z, 0.0)}.get(part, (0.0, 0.0))
        spec.geom(f"cap{i}").pos[2] += z
        spec.body(f"propeller{i}").pos[0] *= share
        spec.body(f"propeller{i}").pos[2] += z
        disc = spec.geom(f"disc{i}")
        blades = spec.geom(f"blades{i}")
        disc.size[0] = blades.size[0] = radius
        if x > 0.1 * vehicle.longest_arm:
            spec.geom(f"arm{i}").material = "front"
            disc.material = "disc_front"


def _ground(spec: mujoco.MjSpec) -> None:
    """Let feet, underside and rotor discs meet the floor."""
    for flag in _CONTACT:
        spec.option.disableflags &= ~int(flag)
    for name in (FLOOR, "battery", *FOOT_NAMES, *DISC_NAMES):
        geom = spec.geom(name)
        geom.contype = 0
        geom.conaffinity = 0
        if name == FLOOR:
            geom.contype = _MEETS
        else:
            geom.conaffinity = _MEETS
        geom.solref[: len(_STIFFNESS)] = _STIFFNESS
        geom.friction = _FRICTION


def _add_drag(spec: mujoco.MjSpec, areas: tuple[float, ...], density: float) -> None:
    """Hang an ellipsoid on the body that nothing but the air meets, with pi r_y r_z = A_x and so on."""
    spec.option.density = density
    for flag in _IDLE:  # with both, MuJoCo leaves out all passive forces
        spec.option.disableflags &= ~int(flag)
    spec.body(BODY).add_geom(
        name=DRAG,
        type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
        size=semi_axes(areas).tolist(),
        mass=0.0,
        contype=0,
        conaffinity=0,
        group=4,
        fluid_ellipsoid=1,
        fluid_coefs=list(_BLUNT),
    )


def _add_obstacles(spec: mujoco.MjSpec, obstacles: Sequence[Obstacle], radius: float) -> None:
    """Put obstacles into the scene, and around the vehicle the ball that meets them and nothing else."""
    for flag in _CONTACT:
        spec.option.disableflags &= ~int(flag)
    ball = spec.body(BODY).add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0.0, 0.0], group=4)
    meeting = [(ball, 0, _MEETS_OBSTACLES)]
    for obstacle in obstacles:
        body = spec.worldbody.add_body(name=obstacle_body(obstacle), pos=obstacle.position, mocap=obstacle.moves)
        for solid in obstacle.solids:
            kind = getattr(mujoco.mjtGeom, f"mjGEOM_{solid.kind.upper()}")
            geom = body.add_geom(type=kind, size=list(solid.size), pos=solid.centre, quat=solid.quaternion)
            geom.rgba = rgba(COLOUR.obstacle)
            meeting.append((geom, _MEETS_OBSTACLES, 0))
    for geom, contype, conaffinity in meeting:
        geom.mass = 0.0
        geom.contype = contype
        geom.conaffinity = conaffinity
        geom.solref[: len(_STIFFNESS)] = _STIFFNESS
        geom.friction = _FRICTION


def obstacle_body(obstacle: Obstacle) -> str:
    """What its body in the model is called."""
    return f"obstacle {obstacle.name}"


def _strip(spec: mujoco.MjSpec, *, contact: bool) -> None:
    """Leave what moves: one free body, its rotors, what it stands on, and of each step only what acts on it."""
    keep: set[str] = set()
    arms = []
    idle = [*_IDLE]
    if contact:
        keep = {FLOOR, "battery", *FOOT_NAMES, *DISC_NAMES}
    else:
        arms = [spec.body(name) for name in ARM_NAMES]  # with what hangs on them
        idle += _CONTACT
    for element in [*arms, *spec.cameras, *spec.lights, *spec.sensors, spec.site(IMU)]:
        spec.delete(element)
    for geom in list(spec.geoms):
        if geom.name not in keep:
            spec.delete(geom)
        else:
            geom.material = ""
    for element in [*spec.materials, *spec.textures]:
        spec.delete(element)
    for stage in idle:
        spec.option.disableflags |= int(stage)


def semi_axes(areas: Sequence[float]) -> Array:
    """(3,) semi-axes r [m] of the ellipsoid whose projected areas (3,) [m^2] are given: pi r_y r_z = A_x and so on."""
    ax, ay, az = areas
    return np.sqrt(np.array([ay * az / (np.pi * ax), ax * az / (np.pi * ay), ax * ay / (np.pi * az)]))


def added_mass(areas: Sequence[float], density: float) -> Array:
    """(3,) mass of air [kg] that moves along with the ellipsoid in each of its axes.

    m_i = rho V alpha_i / (2 - alpha_i), alpha_i = r_x r_y r_z times the integral from 0 to infinity of
    dl / ((r_i^2 + l) sqrt((r_x^2 + l)(r_y^2 + l)(r_z^2 + l))), 2/3 of Carlson's R_D (Lamb, "Hydrodynamics", 1932,
    Secs. 114 and 121).

    Args:
        areas: projected ones along its axes [m^2].
        density: of the air [kg/m^3].
    """
    from scipy.special import elliprd  # whose package takes a while to load, and what draws the vehicle needs none

    r = semi_axes(areas)
    squares = np.square(r)
    product = float(np.prod(r))
    alpha = 2.0 / 3.0 * product * elliprd(np.roll(squares, -1), np.roll(squares, -2), squares)
    return np.asarray(density * 4.0 / 3.0 * np.pi * product * alpha / (2.0 - alpha))


def munk_moment(areas: Sequence[float], density: float) -> tuple[float, float]:
    """The `inflow_moment` [N m s^2/m^2] of the ellipsoid's added mass: (m_z - m_y, m_z - m_x).

    Munk, "The Aerodynamic Forces on Airship Hulls", NACA report 184, 1924; arguments as of `added_mass`.
    """
    x, y, z = added_mass(areas, density).tolist()
    return z - y, z - x
