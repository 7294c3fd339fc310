"""The equations of `quadsim.sim.estimator` in NumPy, against which the compiled filter is tested.

They are written as matrices, from the equations, and are tested themselves: against MuJoCo, finite differences, Van
Loan and Joseph's form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from quadsim.rotation import conjugate, euler_to_quaternion, exponential, logarithm, multiply, normalise
from quadsim.sim.estimator import EstimatorSettings
from quadsim.sim.sensing import SensorName
from quadsim.state import Array, read_only
from quadsim.vehicle import Vehicle

POSITION_PART: Final = slice(0, 3)
VELOCITY_PART: Final = slice(3, 6)
ATTITUDE_PART: Final = slice(6, 9)
RATES_PART: Final = slice(9, 12)
GYRO_BIAS_PART: Final = slice(12, 15)
N_ERRORS: Final = 15

MEAN_QUATERNION: Final = slice(6, 10)
MEAN_RATES: Final = slice(10, 13)
MEAN_GYRO_BIAS: Final = slice(13, 16)


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """The estimated state of the vehicle."""

    mean: Array  # (16,) position [m], velocity [m/s] (world), quaternion wxyz, rates [rad/s] (body), gyro bias [rad/s]
    covariance: Array  # (15, 15) of the error


def retract(mean: Array, error: Array) -> Array:
    """Move the mean (16,) by an error (15,); Solà 2017, Eq. (283)."""
    moved = np.empty_like(mean)
    moved[:6] = mean[:6] + error[:6]
    w, x, y, z = mean[MEAN_QUATERNION].tolist()
    a, b, c = error[ATTITUDE_PART].tolist()
    moved[MEAN_QUATERNION] = normalise(multiply((w, x, y, z), exponential((a, b, c))))
    moved[10:] = mean[10:] + error[9:]
    return moved


def difference(mean: Array, other: Array) -> Array:
    """Return the error (15,) that moves `other` to `mean`; the inverse of `retract`."""
    error = np.empty(N_ERRORS)
    error[:6] = mean[:6] - other[:6]
    error[9:] = mean[10:] - other[10:]
    w, x, y, z = mean[MEAN_QUATERNION].tolist()
    a, b, c, d = other[MEAN_QUATERNION].tolist()
    error[ATTITUDE_PART] = logarithm(multiply(conjugate((a, b, c, d)), (w, x, y, z)))
    return error


_EYE = read_only(np.eye(N_ERRORS))
STILL_VELOCITY: Final = 0.1
"""Standard deviation of the velocity of a vehicle on the ground, per axis [m/s]; also of one that the ground effect
lifts before the modelled thrust could."""
STILL_RATE: Final = math.radians(0.5)
"""The same for its body rates [rad/s]: a MEMS gyro's noise, so that rest on the ground is worth one of its samples."""
STILL_TIME: Final = 0.01  # correlation time tau of these velocities and rates [s]


_CHAIN = np.zeros((N_ERRORS, N_ERRORS))  # the two double integrators, dp/dt = v and dtheta/dt = omega
_CHAIN[POSITION_PART, VELOCITY_PART] = _CHAIN[ATTITUDE_PART, RATES_PART] = np.eye(3)
read_only(_CHAIN)


@dataclass(frozen=True, kw_only=True)
class Drive:
    """The action of the rotors: U / m [m/s^2] along body z, and (tau_x, tau_y, tau_z) [N m], body."""

    acceleration: float
    torque: tuple[float, float, float]
    turning: float  # sum of the rotors' speeds [rad/s]
    speeds: Array  # (4,) and each of them


@dataclass(frozen=True, kw_only=True)
class MotionModel:
    """The modelled vehicle."""

    mass: float  # m [kg]
    gravity: float  # g [m/s^2]
    inertia: Array  # (3, 3) J [kg m^2]
    moment: tuple[float, ...]  # m of the air [N m s^2/(m rad)]
    inflow: tuple[float, float]  # and per velocity along the body's z [N m s^2/m^2]
    damping: Array  # (3, 3) D [N m s/rad]
    lost: float  # c of the thrust lost to inflow [N s^2/(m rad)]
    allocation: Array  # (4, 4) from squared rotor speeds to thrust and torque
    noise: tuple[Array, Array, Array]
    """Three (15, 15) coefficients of h, h^2, h^3 in the noise accumulated over a time h; see `_gathered`."""


def motion_model(vehicle: Vehicle, settings: EstimatorSettings) -> MotionModel:
    """Return the model of a vehicle with the disturbances of the settings."""
    density = np.zeros(N_ERRORS)
    density[VELOCITY_PART] = settings.acceleration_noise**2
    density[RATES_PART] = settings.angular_acceleration_noise**2
    density[GYRO_BIAS_PART] = math.radians(settings.gyro_bias_walk) ** 2
    return MotionModel(
        mass=vehicle.mass,
        gravity=vehicle.gravity,
        inertia=vehicle.inertia_matrix,
        moment=(settings.moment and vehicle.rotor_moment) or (0.0, 0.0),
        inflow=(settings.moment and vehicle.inflow_moment) or (0.0, 0.0),
        damping=np.diag((settings.moment and vehicle.rate_damping) or (0.0, 0.0, 0.0)),
        lost=(settings.moment and vehicle.inflow) or 0.0,
        allocation=read_only(vehicle.allocation),
        noise=_gathered(np.diag(density)),
    )


def drive(model: MotionModel, speeds: Array) -> Drive:
    """Return the action of rotor speeds (4,) [rad/s]; rotors do not turn backwards."""
    thrust, x, y, z = (model.allocation @ np.square(np.maximum(speeds, 0.0))).tolist()
    turning = float(np.maximum(speeds, 0.0).sum())
    return Drive(acceleration=thrust / model.mass, torque=(x, y, z), turning=turning, speeds=np.maximum(speeds, 0.0))


def predict_estimate(model: MotionModel, estimate: Estimate, driven: Drive, duration: float) -> Estimate:
    """Predict the estimate a time h [s] later, short compared with the time in which the vehicle turns.

    The mean by the midpoint rule, the attitude on the sphere; the covariance as F P F' + Q(h), F to third order in h.
    """
    h = duration
    px, py, pz, vx, vy, vz, qw, qx, qy, qz, p, q, r, *bias = estimate.mean.tolist()
    attitude = (qw, qx, qy, qz)
    J = model.inertia
    J_inverse = np.linalg.inv(model.inertia)
    v_x, v_y, v_z = Rotation.from_quat(attitude, scalar_first=True).inv().apply([vx, vy, vz])
    m_x, m_y = driven.turning * np.array(model.moment) - v_z * np.array(model.inflow)
    across = np.array([m_x * v_y, -m_y * v_x, 0.0])
    arms = model.allocation / model.allocation[0]  # (4, 4): 1, y, -x, reaction of each rotor's thrust
    lost = arms @ (model.lost * driven.speeds * (v_z + p * arms[1] + q * arms[2]))
    a = driven.acceleration - lost[0] / model.mass
    across = across - lost[1:]

    def turned(rates: Array) -> Array:
        return J_inverse @ (driven.torque + across - model.damping @ rates - np.cross(rates, J @ rates))

    half = 0.5 * h
    rates = np.array([p, q, r])
    halfway = rates + half * turned(rates)
    p1, q1, r1 = halfway.tolist()
    quarter = 0.25 * h  # the mean rate of the first half, times its length
    w, x, y, z = multiply(attitude, exponential((quarter * (p + p1), quarter * (q + q1), quarter * (r + r1))))
    ax = 2.0 * a * (x * z + w * y)
    ay = 2.0 * a * (y * z - w * x)
    az = a * (1.0 - 2.0 * (x * x + y * y)) - model.gravity
    mean = np.array(
        [
            px + h * (vx + half * ax),
            py + h * (vy + half * ay),
            pz + h * (vz + half * az),
            vx + h * ax,
            vy + h * ay,
            vz + h * az,
            *normalise(multiply(attitude, exponential((h * p1, h * q1, h * r1)))),
            *(rates + h * turned(halfway)),
            *bias,
        ]
    )

    # -R [a]x = a [-r2, r1, 0] with r1, r2 the columns of R, all at mid-step.  The six columns of attitude and rates are
    # filled block by block: one assignment costs as much as 9.
    A = _CHAIN.copy()
    A[VELOCITY_PART.start : RATES_PART.stop, ATTITUDE_PART.start : RATES_PART.stop] = [
        [-2.0 * a * (x * y - w * z), a * (1.0 - 2.0 * (y * y + z * z)), 0.0, 0.0, 0.0, 0.0],
        [-a * (1.0 - 2.0 * (x * x + z * z)), 2.0 * a * (x * y + w * z), 0.0, 0.0, 0.0, 0.0],
        [-2.0 * a * (y * z + w * x), 2.0 * a * (x * z - w * y), 0.0, 0.0, 0.0, 0.0],
        [0.0, r1, -q1, 1.0, 0.0, 0.0],
        [-r1, 0.0, p1, 0.0, 1.0, 0.0],
        [q1, -p1, 0.0, 0.0, 0.0, 1.0],
        *np.zeros((3, 6)),
    ]
    A[RATES_PART, RATES_PART] = J_inverse @ (_hat(J @ halfway) - _hat(halfway) @ J - model.damping)
    A *= h
    F = _EYE + A @ (_EYE + 0.5 * A @ (_EYE + A / 3.0))
    once, twice, thrice = model.noise
    noise = h * (once + h * (twice + h * thrice))
    return Estimate(mean=mean, covariance=F @ estimate.covariance @ F.T + noise)


def _hat(vector: Array) -> Array:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _gathered(density: Array) -> tuple[Array, Array, Array]:
    """Coefficients of the noise covariance after a time h, int e^(N s) Q e^(N' s) ds = Q h + ... h^2 + ... h^3.

    N holds the two double integrators, dp/dt = v and dtheta/dt = omega; N^2 = 0, so the series ends.  The rotation of
    the axes has no effect, since the noise is isotropic.
    """
    N = _CHAIN
    return read_only(density), read_only(0.5 * (N @ density + density @ N.T)), read_only(N @ density @ N.T / 3.0)


_RETAINED = np.ones(N_ERRORS)
_VARIANCE = np.zeros(N_ERRORS)
_WALK = np.zeros(N_ERRORS)
"""1 for entries without velocity or rates, else 0; the variance of velocity and rates; the growth of the rest."""
_RETAINED[VELOCITY_PART] = _RETAINED[RATES_PART] = 0.0
_VARIANCE[VELOCITY_PART] = STILL_VELOCITY**2
_VARIANCE[RATES_PART] = STILL_RATE**2
_WALK[POSITION_PART] = STILL_TIME * STILL_VELOCITY**2
_WALK[ATTITUDE_PART] = STILL_TIME * STILL_RATE**2


def lifts(model: MotionModel, driven: Drive) -> bool:
    """Return whether rotors lift a vehicle off the ground: their thrust exceeds its weight, U > m g."""
    return driven.acceleration > model.gravity


def stand(model: MotionModel, estimate: Estimate, duration: float) -> Estimate:
    """Predict the estimate of a vehicle on the ground a time h [s] later, without its velocity and rates."""
    mean = estimate.mean.copy()
    mean[VELOCITY_PART] = mean[MEAN_RATES] = 0.0
    covariance = np.outer(_RETAINED, _RETAINED) * estimate.covariance + np.diag(_VARIANCE + duration * _WALK)
    covariance[GYRO_BIAS_PART, GYRO_BIAS_PART] += duration * model.noise[0][GYRO_BIAS_PART, GYRO_BIAS_PART]
    return Estimate(mean=mean, covariance=covariance)


_BLOCKS: Final = {
    SensorName.POSITION: (POSITION_PART,),
    SensorName.VELOCITY: (VELOCITY_PART,),
    SensorName.ATTITUDE: (ATTITUDE_PART,),
    SensorName.RATES: (RATES_PART, GYRO_BIAS_PART),
}
"""The error components whose sum a sensor measures."""
_LEADS: Final = {
    SensorName.POSITION: (VELOCITY_PART,),
    SensorName.VELOCITY: (),
    SensorName.ATTITUDE: (RATES_PART, GYRO_BIAS_PART),
    SensorName.RATES: (),
}
"""The components whose errors accumulate in it; the gyro's bias does so through the rates, which follow the gyro."""


def _observation(name: SensorName) -> Array:
    H = np.zeros((3, N_ERRORS))
    for block in _BLOCKS[name]:
        H[:, block] = np.eye(3)
    return read_only(H)


OBSERVATION: Final = {name: _observation(name) for name in SensorName}  # (3, 15) H of each sensor


def innovation(name: SensorName, mean: Array, value: Array) -> Array:
    """(3,) a sample (3,) less its prediction from the mean (16,), in the sensor's unit."""
    if name is SensorName.ATTITUDE:
        w, x, y, z = mean[MEAN_QUATERNION].tolist()
        a, b, c, d = euler_to_quaternion(value).tolist()
        return np.array(logarithm(multiply(conjugate((w, x, y, z)), (a, b, c, d))))
    if name is SensorName.RATES:
        return value - mean[MEAN_RATES] - mean[MEAN_GYRO_BIAS]
    return value - mean[_BLOCKS[name][0]]


def update(estimate: Estimate, name: SensorName, value: Array, variance: Array, gate: float) -> tuple[Estimate, float]:
    """Return the estimate after a sample (3,), and the sample's normalised innovation squared.

    A sample outside the gate, or not a number, changes nothing.  The error is reset to zero without G = I - [dtheta /
    2]x of Solà 2017, Eq.  (287), which would rotate the covariance by half the correction and is neglected there, too.
    `variance` (3, 3) is R, of the sensor's noise.
    """
    H = OBSERVATION[name]
    P = estimate.covariance
    residual = innovation(name, estimate.mean, value)
    rows = H @ P
    weight = _inverse(rows @ H.T + variance)
    distance = float(residual @ weight @ residual)
    if not distance <= gate:
        return estimate, distance
    gain = rows.T @ weight
    P = P - gain @ rows
    return Estimate(mean=retract(estimate.mean, gain @ residual), covariance=0.5 * (P + P.T)), distance


def inflate(estimate: Estimate, name: SensorName, value: Array, refused: float) -> Estimate:
    """Inflate the covariance of an estimate by its disagreement with a sample (3,), so that the sample passes the gate.

    It recovers a diverged filter: the innovation squared is added to the variance of all components that the sensor
    measures, and (innovation / time)^2 to that of their rates of change, with the time in which all samples were
    rejected [s].
    """
    covariance = estimate.covariance.copy()
    squares = np.diag(np.square(innovation(name, estimate.mean, value)))
    for block in _BLOCKS[name]:
        covariance[block, block] += squares
    for block in _LEADS[name]:
        covariance[block, block] += squares / refused**2
    return Estimate(mean=estimate.mean, covariance=covariance)


def _inverse(S: Array) -> Array:
    """The inverse of a symmetric positive definite (3, 3) matrix by its cofactors: faster than a call of LAPACK."""
    (a, b, c), (_, d, e), (_, _, f) = S.tolist()
    A = d * f - e * e
    B = c * e - b * f
    C = b * e - c * d
    scale = 1.0 / (a * A + b * B + c * C)
    D = a * f - c * c
    E = b * c - a * e
    F = a * d - b * b
    return scale * np.array([[A, B, C], [B, D, E], [C, E, F]])
