"""The compiled airframe carries the vehicle's numbers, and its drawing follows the vehicle's arms."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from uneven import uneven

from quadsim.assets import models_dir, vehicle_path
from quadsim.sim.airframe import ARM_NAMES, BODY, PROPELLER_NAMES, ROTOR_NAMES, compile_model
from quadsim.vehicle import Vehicle, load_vehicle

LOPES = load_vehicle(vehicle_path("lopes2011"))
SMALL_X = Vehicle(
    name="small-x",
    mass=0.027,
    gravity=3.71,
    inertia=(1.4e-5, 1.5e-5, 2.2e-5),
    arm_length=0.046,
    rotor_azimuths=(-45.0, -135.0, 135.0, 45.0),
    rotor_spins=(-1, 1, -1, 1),
    thrust_coefficient=2.1e-8,
    drag_to_thrust=0.006,
    speed_min=100.0,
    speed_max=2600.0,
)
LONG_ARMS = replace(LOPES, arm_length=0.5)
VEHICLES = pytest.mark.parametrize(
    "vehicle", [LOPES, SMALL_X, LONG_ARMS, uneven()], ids=["lopes2011", "small-x", "long-arms", "uneven"]
)


def test_the_shipped_vehicle_compiles_to_its_toml_file():
    data = tomllib.loads(vehicle_path("lopes2011").read_text(encoding="utf-8"))
    value = {key: entry["value"] for key, entry in data.items() if isinstance(entry, dict)}
    model = compile_model(LOPES)
    body = model.body(BODY)
    assert body.mass[0] == value["mass"]
    assert np.array_equal(body.inertia, value["inertia"])
    assert np.array_equal(model.opt.gravity, [0.0, 0.0, -value["gravity"]])
    top = value["thrust_coefficient"] * value["speed_max"] ** 2
    for name, azimuth, spin in zip(ROTOR_NAMES, value["rotor_azimuths"], value["rotor_spins"], strict=True):
        arm = value["arm_length"] * np.array([np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth)), 0.0])
        assert model.site(name).pos == pytest.approx(arm, abs=1e-15)
        assert model.actuator(name).gear == pytest.approx([0, 0, 1, 0, 0, spin * value["drag_to_thrust"]])
        assert model.actuator(name).ctrlrange == pytest.approx([0.0, top])


@VEHICLES
@pytest.mark.parametrize("visuals", [False, True])
def test_any_vehicle_compiles_to_its_own_numbers(vehicle: Vehicle, visuals: bool):
    model = compile_model(vehicle, timestep=5e-4, limit_speeds=True, visuals=visuals)
    assert model.body_subtreemass[0] == pytest.approx(vehicle.mass, rel=1e-12)
    axes = Rotation.from_quat(model.body(BODY).iquat, scalar_first=True).as_matrix()
    inertia = axes @ np.diag(model.body(BODY).inertia) @ axes.T
    np.testing.assert_allclose(inertia, vehicle.inertia_matrix, atol=1e-14)
    assert model.body(BODY).ipos == pytest.approx([0.0, 0.0, 0.0])
    assert model.opt.timestep == 5e-4
    assert model.actuator_ctrllimited.all()
    for i, name in enumerate(ROTOR_NAMES):
        assert model.site(name).pos == pytest.approx(vehicle.hubs[i])
        assert model.actuator(name).gear[5] == vehicle.rotor_spins[i] * vehicle.drag_to_thrust
        expected = vehicle.coefficients[i] * np.square([vehicle.speed_min, vehicle.speed_max])
        assert model.actuator(name).ctrlrange == pytest.approx(expected)


@VEHICLES
def test_forces_and_torques_are_the_allocation_matrix(vehicle: Vehicle):
    model = compile_model(vehicle)
    data = mujoco.MjData(model)
    speeds = vehicle.hover_speed * np.array([0.9, 1.0, 1.2, 1.05])
    data.ctrl[:] = vehicle.thrusts(speeds)
    mujoco.mj_forward(model, data)
    assert data.qfrc_actuator[[2, 3, 4, 5]] == pytest.approx(vehicle.allocation @ speeds**2, rel=1e-12, abs=1e-15)
    assert data.qfrc_actuator[[0, 1]] == pytest.approx([0.0, 0.0], abs=1e-15)


@VEHICLES
def test_the_drawing_follows_the_arms(vehicle: Vehicle):
    model = compile_model(vehicle, visuals=True)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    positions = np.array([data.body(name).xpos for name in PROPELLER_NAMES])
    height = model.body(PROPELLER_NAMES[0]).pos[2] - vehicle.hubs[0, 2]  # of the discs above their hubs
    np.testing.assert_allclose(positions, vehicle.hubs + np.array([0.0, 0.0, height]), atol=1e-12)
    radii = np.array([model.geom(f"disc{i}").size[0] for i in range(1, 5)])
    gaps = np.linalg.norm(positions[:, None] - positions[None], axis=2) + 1e9 * np.eye(4)
    assert 0.2 * vehicle.longest_arm < radii.min()
    assert radii.max() < 0.5 * gaps.min()
    forward = vehicle.hubs[:, 0] > 1e-9
    front = model.material("front").id
    assert [model.geom(name).matid[0] == front for name in ARM_NAMES] == forward.tolist()
    assert model.geom("foot1").pos[2] - model.geom("foot1").size[0] == pytest.approx(model.geom("floor").pos[2])


def test_what_is_seen_weighs_nothing_and_meets_nothing():
    model = compile_model(LOPES, visuals=True)
    assert not model.geom_contype.any()
    assert not model.geom_conaffinity.any()
    assert [model.body(i).name for i in np.flatnonzero(model.body_mass)] == [BODY]


def test_the_physics_model_has_nothing_to_look_at_and_flies_the_same():
    bare = compile_model(LOPES)
    drawn = compile_model(LOPES, visuals=True)
    assert (bare.ngeom, bare.nbody, bare.ntex, bare.ncam, bare.nlight, bare.nsensor) == (0, 2, 0, 0, 0, 0)
    states = []
    for model in (bare, drawn):
        data = mujoco.MjData(model)
        data.ctrl[:] = LOPES.thrusts(LOPES.hover_speed * np.array([1.0, 0.98, 1.01, 1.02]))
        mujoco.mj_step(model, data, nstep=500)
        states.append(np.concatenate([data.qpos, data.qvel]))
    assert states[0] == pytest.approx(states[1], abs=1e-12)


def test_sensors_agree_with_the_state():
    model = compile_model(LOPES, visuals=True)
    data = mujoco.MjData(model)
    data.qpos[:] = [1.0, -2.0, 3.0, *np.array([0.9, 0.1, -0.3, 0.2]) / np.linalg.norm([0.9, 0.1, -0.3, 0.2])]
    data.qvel[:] = [0.5, 0.6, -0.7, 0.3, -0.2, 0.1]
    data.ctrl[:] = LOPES.thrusts(np.full(4, LOPES.hover_speed))
    mujoco.mj_forward(model, data)
    rotation = data.body(BODY).xmat.reshape(3, 3)
    assert data.sensor("position").data == pytest.approx(data.qpos[:3])
    assert data.sensor("attitude").data == pytest.approx(data.qpos[3:])
    assert data.sensor("velocity").data == pytest.approx(data.qvel[:3])
    assert data.sensor("gyro").data == pytest.approx(data.qvel[3:])
    assert data.sensor("angular_velocity").data == pytest.approx(rotation @ data.qvel[3:])
    assert data.sensor("accelerometer").data == pytest.approx([0.0, 0.0, LOPES.gravity])  # thrust over mass


def test_every_element_has_a_name():
    spec = mujoco.MjSpec.from_file(str(models_dir() / "quadrotor.xml"))
    elements = (
        *spec.bodies, *spec.geoms, *spec.sites, *spec.joints, *spec.cameras, *spec.lights, *spec.actuators,
        *spec.sensors, *spec.materials, *spec.textures,
    )  # fmt: skip
    assert [element for element in elements if not element.name] == []
    assert {camera.name for camera in spec.cameras} == {"follow", "fixed"}
    assert not compile_model(LOPES).actuator_ctrllimited.any()


def test_the_model_file_opens_as_it_is_and_can_be_filmed():
    model = mujoco.MjModel.from_xml_path(str(models_dir() / "quadrotor.xml"))
    assert (model.vis.global_.offwidth, model.vis.global_.offheight) == (1280, 720)
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET
