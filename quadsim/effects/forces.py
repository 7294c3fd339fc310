"""Forces that follow from how the vehicle moves, evaluated once per physics step.

Written with plain numbers: it runs a thousand times per simulated second, where small arrays would cost more than all
of MuJoCo's step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from quadsim.effects import Effects
from quadsim.effects.ground_effect import thrust_ratio
from quadsim.vehicle import Vehicle

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]


@dataclass(frozen=True, slots=True)
class Motion:
    """The vehicle at an instant.

    Attributes:
        position: of the body frame's origin, world [m].
        rotation: body to world, by rows.
        velocity: of that origin, world [m/s].
        rates: body rates [rad/s].
    """

    position: Vector
    rotation: Matrix
    velocity: Vector
    rates: Vector


def midway(qpos: Sequence[float], qvel: Sequence[float], qvel_before: Sequence[float], timestep: float) -> Motion:
    """The motion half a step ahead, from this step's and the last one's.

    A force that is evaluated there and held for the step acts as the changing one would, up to the third power of the
    step.

    Args:
        qpos: MuJoCo's position (3) and quaternion wxyz (4) now.
        qvel: velocity, world (3), and body rates (3) now.
        qvel_before: the same a step ago.
        timestep: [s].
    """
    vx, vy, vz, p, q, r = (now + 0.5 * (now - before) for now, before in zip(qvel, qvel_before, strict=True))
    half = 0.5 * timestep
    position = (qpos[0] + half * vx, qpos[1] + half * vy, qpos[2] + half * vz)
    w, x, y, z = qpos[3:]
    quarter = 0.5 * half  # dq/dt = q * (0, rates) / 2
    turned = (
        w - quarter * (x * p + y * q + z * r),
        x + quarter * (w * p + y * r - z * q),
        y + quarter * (w * q + z * p - x * r),
        z + quarter * (w * r + x * q - y * p),
    )
    return Motion(position, _rotation(*turned), (vx, vy, vz), (p, q, r))


class StepForces:
    """The forces of a vehicle's effects on it.

    - Rotor drag, F_i = -k w_i (v_air,i - (v_air,i . z_b) z_b): blade flapping and induced drag hold each rotor back in
      its own plane in proportion to its speed and to the air's (Martin & Salaun 2010, "The true role of accelerometer
      feedback in quadrotor control"; RotorS, Furrer et al. 2016).  MuJoCo's fluid forces know neither rotors nor forces
      linear in the air speed at these Reynolds numbers, so it is computed here.
    - Gyroscopic and spin-up torque of rotors with inertia, -(d/dt + rates x) h z_b, with the angular momentum
      h = -sum_i spin_i J_r w_i of rotors that turn against their reaction torque.
    - Ground effect: what each rotor's thrust gains, by the height of its own disc; its torque gains nothing, as the
      ratio is that of thrusts at the same power.  See `quadsim.effects.ground_effect`.

    The quadratic drag of the body is MuJoCo's own; see `quadsim.airframe.build_spec`.
    """

    def __init__(self, vehicle: Vehicle, effects: Effects, *, floor: float, disc: float) -> None:
        """Set up.

        Args:
            vehicle: whose rotors they are.
            effects: what acts on it.
            floor: height of the ground, world [m].
            disc: height of the rotor discs, body frame [m].
        """
        self._drag = effects.rotor_drag
        self._inertia = effects.rotors.inertia if effects.rotors is not None else 0.0
        self._radius = effects.rotor_radius
        self._floor, self._disc = floor, disc
        self._places: list[tuple[float, float]] = [(x, y) for x, y, _ in vehicle.rotor_positions.tolist()]
        self._spins = vehicle.rotor_spins

    def wrench(
        self,
        motion: Motion,
        thrusts: Sequence[float],
        speeds: Sequence[float],
        accelerations: Sequence[float],
        wind: Sequence[float],
    ) -> tuple[float, float, float, float, float, float]:
        """Force in the world frame [N] and torque in the body frame about its origin [N m].

        Args:
            motion: of the vehicle.
            thrusts: (4,) that the rotors would have far from the ground [N].
            speeds: (4,) rotor speeds [rad/s].
            accelerations: (4,) of the rotors [rad/s^2].
            wind: (3,) velocity of the air, world frame [m/s].
        """
        (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = motion.rotation
        p, q, r = motion.rates
        fx = fy = fz = tx = ty = tz = 0.0
        if self._drag:
            ax, ay, az = (v - w for v, w in zip(motion.velocity, wind, strict=True))
            along_x = r00 * ax + r10 * ay + r20 * az
            along_y = r01 * ax + r11 * ay + r21 * az
            bx = by = 0.0
            for (x, y), speed in zip(self._places, speeds, strict=True):
                hold = self._drag * speed
                fxi, fyi = -hold * (along_x - r * y), -hold * (along_y + r * x)
                bx += fxi
                by += fyi
                tz += x * fyi - y * fxi
            fx, fy, fz = r00 * bx + r01 * by, r10 * bx + r11 * by, r20 * bx + r21 * by
        if self._inertia:
            momentum = -self._inertia * sum(spin * speed for spin, speed in zip(self._spins, speeds, strict=True))
            tx -= q * momentum
            ty += p * momentum
            tz += self._inertia * sum(spin * slope for spin, slope in zip(self._spins, accelerations, strict=True))
        if self._radius is not None:
            above = motion.position[2] - self._floor + r22 * self._disc
            lift = 0.0
            for (x, y), thrust in zip(self._places, thrusts, strict=True):
                gain = thrust * (thrust_ratio(above + r20 * x + r21 * y, self._radius) - 1.0)
                lift += gain
                tx += y * gain
                ty -= x * gain
            fx, fy, fz = fx + r02 * lift, fy + r12 * lift, fz + r22 * lift
        return fx, fy, fz, tx, ty, tz


def _rotation(w: float, x: float, y: float, z: float) -> Matrix:
    """Body to world, of a quaternion that need not be of unit length."""
    s = 2.0 / (w * w + x * x + y * y + z * z)
    return (
        (1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)),
        (s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)),
        (s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)),
    )
