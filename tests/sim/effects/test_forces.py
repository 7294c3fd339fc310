"""Drag, disturbance and ground effect in flight against closed forms; their order; what they leave alone."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy_laws import (
    LOWEST_RATIO,
    axis_drag,
    ground_effect,
    inflow,
    inflow_moment,
    pushed,
    respond,
    rotor_drag,
    rotor_moment,
    thrust_ratio,
)
from scipy.spatial.transform import Rotation
from uneven import uneven

from quadsim.sim.airframe import added_mass, compile_model, munk_moment, outline, semi_axes
from quadsim.sim.effects import Disturbance, Effects, Ground, Push, PushChange
from quadsim.sim.effects.rotors import RotorDynamics
from quadsim.sim.effects.wind import Air, Gust, WindField
from quadsim.sim.physics import Integrator
from quadsim.sim.plant import Plant
from quadsim.state import Array, make_state
from quadsim.vehicle import Vehicle

HIGH = make_state(position=(0.0, 0.0, 500.0))


def moving(**rates: float) -> Array:
    state = HIGH.copy()
    for name, value in rates.items():
        state[{"vx": 1, "vy": 3, "vz": 5, "yaw_rate": 11}[name]] = value
    return state


def still_air(velocity: tuple[float, float, float], *gusts: Gust) -> WindField:
    return WindField(mean=velocity, gusts=gusts, timestep=1e-3, rng=np.random.default_rng(0))


def test_rotor_drag_slows_a_level_glide_exponentially(vehicle: Vehicle) -> None:
    """Exponentially: m dv/dt = -k (sum w) v while level; along z no rotor is held back."""
    drag = 2e-3
    hover = vehicle.hover_speed
    rate = 4.0 * drag * hover / vehicle.mass
    with Plant(vehicle, effects=Effects(air=Air(rotor_drag=drag))) as plant:
        plant.reset(moving(vx=3.0, vy=-1.0))
        plant.advance(plant.vehicle.hover_speeds, 2000)
        state = plant.state()
    np.testing.assert_allclose(state[[1, 3]], np.array([3.0, -1.0]) * math.exp(-2.0 * rate), rtol=1e-6)
    np.testing.assert_allclose(state[[4, 5]], [500.0, 0.0], atol=1e-9)


def test_rotor_drag_slows_a_turn(vehicle: Vehicle) -> None:
    """Each rotor moves at r L across its arm: tau_z = -k (sum w) L^2 r."""
    drag = 2e-3
    rate = 4.0 * drag * vehicle.hover_speed * vehicle.arm_length**2 / vehicle.inertia[2]
    with Plant(vehicle, effects=Effects(air=Air(rotor_drag=drag))) as plant:
        plant.reset(moving(yaw_rate=2.0))
        plant.advance(plant.vehicle.hover_speeds, 500)
        assert plant.state()[11] == pytest.approx(2.0 * math.exp(-0.5 * rate), rel=1e-6)


def test_a_rotor_moment_lifts_the_side_that_meets_the_air(vehicle: Vehicle) -> None:
    """Flying along x, the nose goes up, and the harder the faster: J_y dq/dt = -m_y (sum w) v."""
    moment = 1e-5
    rates = []
    for speed in (0.0, 2.0, 4.0):
        with Plant(vehicle, effects=Effects(air=Air(rotor_moment=(moment, moment)))) as plant:
            plant.reset(moving(vx=speed))
            rates.append(plant.advance(plant.vehicle.hover_speeds, 50)["physics"][-1, 12])
    expected = -moment * 4.0 * vehicle.hover_speed / vehicle.inertia[1] * 0.05
    np.testing.assert_allclose(rates, [0.0, 2.0 * expected, 4.0 * expected], rtol=1e-3, atol=1e-12)


def test_a_climb_takes_from_the_rotor_moment(vehicle: Vehicle) -> None:
    """J_y dq/dt = -(m_y (sum w) - k_y v_z) v_x: at v_z = m_y (sum w) / k_y nothing turns."""
    moment = 1e-5
    inflow = 0.01
    gone = moment * 4.0 * vehicle.hover_speed / inflow
    rates = []
    for climb in (0.0, gone, -gone):
        with Plant(vehicle, effects=Effects(air=Air(rotor_moment=(0.0, moment), inflow_moment=(0.0, inflow)))) as plant:
            plant.reset(moving(vx=2.0, vz=climb))
            rates.append(plant.advance(plant.vehicle.hover_speeds, 50)["physics"][-1, 12])
    expected = -moment * 4.0 * vehicle.hover_speed / vehicle.inertia[1] * 0.05 * 2.0
    np.testing.assert_allclose(rates, [expected, 0.0, 2.0 * expected], rtol=5e-3, atol=1e-3 * abs(expected))


@pytest.mark.parametrize("stated", [None, (0.0, 0.0), (0.01, 0.02)])
def test_a_stated_inflow_moment_is_that_of_rotors_and_body(
    vehicle: Vehicle, stated: tuple[float, float] | None
) -> None:
    """Without it, the ellipsoid that drags has Munk's."""
    drag = (0.02, 0.03, 0.06)
    seconds = 0.02
    with Plant(vehicle, effects=Effects(air=Air(body_drag=drag, inflow_moment=stated))) as plant:
        plant.reset(moving(vx=2.0, vy=1.0, vz=1.0))
        rates = plant.advance(plant.vehicle.hover_speeds, 20)["physics"][-1, 11:14]
    about_x, about_y = munk_moment(drag, 1.225) if stated is None else stated
    expected = np.array([-about_x, 2.0 * about_y]) / vehicle.inertia[:2] * seconds
    np.testing.assert_allclose(rates[:2], expected, rtol=0.02, atol=1e-4)


@pytest.mark.parametrize("integrator", ["mujoco", "rk4"])
def test_inflow_slows_a_climb_exponentially(vehicle: Vehicle, integrator: Integrator) -> None:
    """In hover m dv/dt = -4 c w v, v the velocity of climb; and without inflow the climb goes on."""
    c = 4e-4
    seconds = 1.5
    rate = 4.0 * c * vehicle.hover_speed / vehicle.mass
    for coefficient, left in ((c, math.exp(-rate * seconds)), (0.0, 1.0)):
        effects = Effects(air=Air(inflow=coefficient))
        with Plant(vehicle, effects=effects, integrator=integrator) as plant:
            state = make_state(position=(0.0, 0.0, 5.0))
            state[5] = 1.0
            plant.reset(state)
            plant.advance(vehicle.hover_speeds, 1500)
            assert plant.state()[5] == pytest.approx(left, rel=1e-5)


def test_rate_damping_slows_a_turn_exponentially(vehicle: Vehicle) -> None:
    damping = 0.1
    with Plant(vehicle, effects=Effects(air=Air(rate_damping=(0.0, 0.0, damping)))) as plant:
        plant.reset(moving(yaw_rate=2.0))
        plant.advance(plant.vehicle.hover_speeds, 500)
        assert plant.state()[11] == pytest.approx(2.0 * math.exp(-0.5 * damping / vehicle.inertia[2]), rel=1e-6)


def test_rotor_drag_carries_a_tilted_vehicle_to_its_terminal_speed(vehicle: Vehicle) -> None:
    """With attitude held, along body x: m dv/dt = m g sin(tilt) - k (sum w) v."""
    drag = 4e-3
    tilt = 0.2
    speed = vehicle.hover_speed / math.sqrt(math.cos(tilt))
    state = make_state(position=(0.0, 0.0, 500.0), euler=(0.0, tilt, 0.0))
    with Plant(vehicle, effects=Effects(air=Air(rotor_drag=drag))) as plant:
        plant.reset(state)
        plant.advance(np.full(4, speed), 6000)
        settled = plant.state()
    hold = 4.0 * drag * speed
    along = settled[1] * math.cos(tilt) - settled[5] * math.sin(tilt)
    reached = 1.0 - math.exp(-hold / vehicle.mass * 6.0)
    assert along == pytest.approx(reached * vehicle.mass * vehicle.gravity * math.sin(tilt) / hold, rel=1e-5)


@pytest.mark.parametrize(("axis", "name"), [(0, "vx"), (1, "vy"), (2, "vz")])
def test_body_drag_is_half_rho_area_speed_squared(vehicle: Vehicle, axis: int, name: str) -> None:
    areas = (0.02, 0.03, 0.06)
    with Plant(vehicle, effects=Effects(air=Air(body_drag=areas, density=1.2))) as plant:
        plant.reset(moving(**{name: 8.0}))
        wrench = plant.advance(plant.vehicle.hover_speeds, 2000)["wrench"]
        speed = plant.state()[[1, 3, 5]][axis]
    decay = 0.5 * 1.2 * areas[axis] / vehicle.mass  # dv/dt = -decay v^2
    assert speed == pytest.approx(8.0 / (1.0 + 8.0 * decay * 2.0), rel=1e-9)
    assert wrench[0, axis] == pytest.approx(-decay * vehicle.mass * 64.0, rel=1e-2)


def test_added_mass_is_that_of_a_sphere_and_that_of_the_compiled_model(vehicle: Vehicle) -> None:
    """A sphere takes half of the air in its place along."""
    radius = 0.2
    areas = (0.02, 0.03, 0.06)
    sphere = added_mass([math.pi * radius**2] * 3, 1.2)
    np.testing.assert_allclose(sphere, 0.5 * 1.2 * 4.0 / 3.0 * math.pi * radius**3)
    model = compile_model(vehicle, body_drag=areas, air_density=1.2)
    drag = model.geom("drag")
    np.testing.assert_allclose(semi_axes(areas), drag.size)
    virtual_mass = model.geom_fluid[drag.id][6:9]  # MuJoCo's integral is a quadrature
    np.testing.assert_allclose(added_mass(areas, 1.2), 1.2 * virtual_mass, rtol=1e-3)


def test_a_falling_vehicle_reaches_its_terminal_speed(vehicle: Vehicle) -> None:
    with Plant(vehicle, effects=Effects(air=Air(body_drag=(0.1, 0.1, 0.4), density=1.2))) as plant:
        plant.reset(HIGH)
        plant.advance(np.zeros(4), 20_000)
        terminal = math.sqrt(vehicle.mass * vehicle.gravity / (0.5 * 1.2 * 0.4))
        assert plant.state()[5] == pytest.approx(-terminal * math.tanh(vehicle.gravity * 20.0 / terminal), rel=1e-6)


@pytest.mark.parametrize("effects", [Effects(air=Air(rotor_drag=2e-3)), Effects(air=Air(body_drag=(0.05, 0.05, 0.05)))])
def test_only_the_air_speed_counts(vehicle: Vehicle, effects: Effects) -> None:
    """Moving with the wind is as standing in still air."""
    with Plant(vehicle, effects=effects, wind=still_air((4.0, -2.0, 0.0))) as plant:
        plant.reset(moving(vx=4.0, vy=-2.0))
        flown = plant.advance(plant.vehicle.hover_speeds, 100)
    np.testing.assert_allclose(flown["wrench"], 0.0, atol=1e-12)
    np.testing.assert_array_equal(flown["wind"], np.tile([4.0, -2.0, 0.0], (100, 1)))


def test_a_gust_pushes_by_its_integral(vehicle: Vehicle) -> None:
    """While the vehicle hardly moves, m v = k (sum w) v_peak T / 2."""
    drag = 1e-6
    gust = Gust(at=0.1, duration=1.0, velocity=(10.0, 0.0, 0.0))
    with Plant(vehicle, effects=Effects(air=Air(rotor_drag=drag)), wind=still_air((0.0, 0.0, 0.0), gust)) as plant:
        plant.reset(HIGH)
        plant.advance(plant.vehicle.hover_speeds, 1300)
        push = 4.0 * drag * vehicle.hover_speed * 10.0 * 0.5
        assert plant.state()[1] == pytest.approx(push / vehicle.mass, rel=1e-3)


def test_constant_force_and_torque_accelerate(vehicle: Vehicle) -> None:
    disturbance = Disturbance(force=(0.4, -0.2, 0.1), torque=(0.0, 0.0, 1e-3))
    with Plant(vehicle, effects=Effects(disturbance=disturbance)) as plant:
        plant.reset(HIGH)
        plant.advance(plant.vehicle.hover_speeds, 1000)
        state = plant.state()
    np.testing.assert_allclose(state[[1, 3, 5]], np.array([0.4, -0.2, 0.1]) / vehicle.mass, rtol=1e-9)
    assert state[11] == pytest.approx(1e-3 / vehicle.inertia[2], rel=1e-9)


def test_white_noise_walks_as_a_random_walk(vehicle: Vehicle) -> None:
    """The variance of velocity grows as (density / m)^2 t on each axis; the same seed gives the same flight."""
    density = 0.05
    ends = []
    for seed in [*range(60), 0]:
        disturbance = Effects(disturbance=Disturbance(force_noise=density))
        with Plant(vehicle, effects=disturbance, rng=np.random.default_rng(seed)) as plant:
            plant.reset(HIGH)
            plant.advance(plant.vehicle.hover_speeds, 100)
            ends.append(plant.state()[[1, 3, 5]])
            plant.reset(HIGH)
            plant.advance(plant.vehicle.hover_speeds, 60)
            plant.advance(plant.vehicle.hover_speeds, 40)
            np.testing.assert_array_equal(plant.state()[[1, 3, 5]], ends[-1])
    np.testing.assert_array_equal(ends[-1], ends[0])
    ratio = np.mean(np.square(ends[:-1])) / ((density / vehicle.mass) ** 2 * 0.1)
    assert ratio == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / 180.0))  # 180 draws, four standard deviations


def test_ground_effect_lifts_by_cheeseman_and_bennett(vehicle: Vehicle) -> None:
    """Each rotor by the height of its own disc; torques about z stay those of the rotors alone."""
    radius = 0.2
    height = 0.15
    roll = 0.3
    speeds = vehicle.hover_speed * np.array([1.05, 0.95, 1.05, 0.95])
    with Plant(vehicle, effects=Effects(ground=Ground(effect=True, rotor_radius=radius))) as plant:
        plant.reset(make_state(position=(0.0, 0.0, height), euler=(roll, 0.0, 0.0)), speeds)
        flown = plant.advance(speeds, 1)
    # where the drawing has them
    floor = -0.132
    disc = 0.034
    above = height - floor + disc * math.cos(roll) + vehicle.hubs[:, 1] * math.sin(roll)
    gains = vehicle.thrust_coefficient * speeds**2 * (1.0 / (1.0 - (radius / (4.0 * above)) ** 2) - 1.0)
    up = np.array([0.0, -math.sin(roll), math.cos(roll)])
    np.testing.assert_allclose(flown["wrench"][0, :3], gains.sum() * up, rtol=1e-9, atol=1e-12)
    torque = [gains @ vehicle.hubs[:, 1], -gains @ vehicle.hubs[:, 0], 0.0]
    np.testing.assert_allclose(flown["wrench"][0, 3:], torque, rtol=1e-9, atol=1e-12)
    yaw_torque = (vehicle.drag_to_thrust * vehicle.thrust_coefficient) * (np.array(vehicle.rotor_spins) @ speeds**2)
    assert flown["physics"][0, 13] == pytest.approx(1e-3 * yaw_torque / vehicle.inertia[2], rel=1e-3)


def test_a_lost_propeller_neither_drags_nor_carries_momentum(vehicle: Vehicle) -> None:
    effects = Effects(
        air=Air(rotor_drag=3e-4), rotors=RotorDynamics(rise=0.05, fall=0.05, inertia=1e-3, efficiency=(0.0,) * 4)
    )
    start = moving(vx=5.0, yaw_rate=1.0)
    start[7] = 0.5
    with Plant(vehicle, effects=effects) as plant:
        plant.reset(start)
        wrench = plant.advance(1.1 * plant.vehicle.hover_speeds, 10)["wrench"]
    np.testing.assert_array_equal(wrench, np.zeros((10, 6)))


def test_a_second_flight_meets_the_same_wind(vehicle: Vehicle) -> None:
    gust = Gust(at=0.02, duration=0.1, velocity=(0.0, 5.0, 0.0))
    with Plant(vehicle, effects=Effects(air=Air(rotor_drag=1e-3)), wind=still_air((1.0, 0.0, 0.0), gust)) as plant:
        winds = []
        for _ in range(2):
            plant.reset(HIGH)
            winds.append(plant.advance(plant.vehicle.hover_speeds, 80)["wind"])
    np.testing.assert_array_equal(winds[0], winds[1])
    assert np.ptp(winds[0]) > 1.0


def test_forces_are_of_second_order_in_the_step(vehicle: Vehicle) -> None:
    effects = Effects(air=Air(rotor_drag=6e-3), rotors=RotorDynamics(rise=0.05, fall=0.05, inertia=5e-4))
    commands = vehicle.hover_speed + np.random.default_rng(1).uniform(-25.0, 25.0, (8, 4))
    start = moving(vx=5.0, yaw_rate=1.0)

    def after(timestep: float) -> Array:
        with Plant(vehicle, timestep=timestep, effects=effects) as plant:
            plant.reset(start)
            for command in commands:
                plant.advance(command, round(0.05 / timestep))
            return plant.physics[1:]

    finest = after(0.05 / 800)
    errors = [np.abs(after(0.05 / steps) - finest).max() for steps in (12, 25, 50)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(orders > 1.7), (orders, errors)
    assert errors[-1] < 3e-5


@pytest.mark.parametrize("layout", ["even", "uneven"])
@pytest.mark.parametrize("integrator", ["mujoco", "rk4"])
def test_the_wrench_is_that_of_the_laws_together(vehicle: Vehicle, integrator: Integrator, layout: str) -> None:
    """From random motions, at the middle of the step: drag of two kinds, spinning rotors, pushes, ground effect."""
    vehicle = uneven() if layout == "uneven" else vehicle
    rng = np.random.default_rng(6)
    radius = 0.15
    drag = 3e-3
    inertia = 2e-4
    step = 1e-6
    linear = (0.3, 0.2, 0.05)
    quadratic = (0.08, 0.1, 0.12)
    moment = (2e-4, -3e-4)
    climbing = (0.1, -0.2)
    damping = (0.02, 0.03, 0.01)
    lost = 2e-3
    dynamics = RotorDynamics(rise=0.03, fall=0.05, inertia=inertia)
    effects = Effects(
        air=Air(
            **{"rotor_drag": drag, "linear_drag": linear, "quadratic_drag": quadratic},
            **{"rotor_moment": moment, "inflow_moment": climbing, "rate_damping": damping, "inflow": lost},
        ),
        ground=Ground(contact=False, effect=True, rotor_radius=radius),
        rotors=dynamics,
    )
    push = Push(at=0.0, duration=1.0, force=(0.5, -0.3, 0.2), point=(0.1, -0.05, 0.02))
    wind = (2.0, -1.0, 0.5)
    shape = outline(vehicle)
    changes = (PushChange(at=0.0, pushes=(push,)),)
    with Plant(
        vehicle, timestep=step, effects=effects, changes=changes, wind=still_air(wind), integrator=integrator
    ) as plant:
        for _ in range(20):
            state = make_state(position=(0.0, 0.0, rng.uniform(-0.1, 0.6)), euler=tuple(rng.uniform(-0.8, 0.8, 3)))
            state[[1, 3, 5, 7, 9, 11]] = rng.normal(size=6)
            speeds, target = vehicle.hover_speed * rng.uniform(0.7, 1.3, (2, 4))
            plant.reset(state, speeds)
            before = plant.physics
            wrench = plant.advance(target, 1)["wrench"][0]
            turn = Rotation.from_quat(before[4:8], scalar_first=True)
            rates = before[11:14]
            (middle,), (slopes,) = respond(dynamics, speeds, target, np.array([0.5 * step]))
            air = before[8:11] - wind
            expected = rotor_drag(vehicle, drag, middle, turn, air, rates) + pushed(push, turn)
            expected[:3] += axis_drag(linear, quadratic, turn, air)
            expected[3:] += rotor_moment(vehicle, moment, middle, turn, air, rates) - np.array(damping) * rates
            expected[3:] += inflow_moment(climbing, turn, air)
            expected += inflow(vehicle, lost, middle, turn, air, rates)
            momentum = -inertia * np.array(vehicle.rotor_spins) @ middle
            expected[3:] += [
                -rates[1] * momentum,
                rates[0] * momentum,
                inertia * slopes @ np.array(vehicle.rotor_spins),
            ]
            thrusts = vehicle.coefficients * middle**2
            expected += ground_effect(vehicle, radius, thrusts, turn, before[3], shape.floor, shape.disc)
            np.testing.assert_allclose(wrench, expected, atol=1e-4)  # what changes in half a step


@pytest.mark.parametrize(("ratio", "expected"), [(0.5, 4.0 / 3.0), (1.0, 16.0 / 15.0), (2.0, 64.0 / 63.0)])
@pytest.mark.parametrize("radius", [0.02, 0.125])
def test_the_ratio_depends_on_heights_in_radii(ratio: float, expected: float, radius: float) -> None:
    assert thrust_ratio(ratio * radius, radius) == pytest.approx(expected, rel=1e-12)


def test_far_from_the_ground_there_is_no_effect() -> None:
    """The excess falls with the square of the height."""
    assert thrust_ratio(100.0, 0.125) - 1.0 == pytest.approx((0.125 / 400.0) ** 2, rel=1e-5)
    assert thrust_ratio(10.0, 0.125) - 1.0 == pytest.approx(100.0 * (thrust_ratio(100.0, 0.125) - 1.0), rel=1e-3)


@pytest.mark.parametrize("height", [0.9 * LOWEST_RATIO, 0.25, 0.1, 0.0, -1.0])
def test_below_where_the_formula_holds_the_ratio_stays(height: float) -> None:
    """At a quarter of the radius the formula is singular, and negative below."""
    assert thrust_ratio(height, 1.0) == thrust_ratio(LOWEST_RATIO, 1.0)
