"""Forces that follow from how the vehicle moves, evaluated once per physics step.

Written with plain numbers: it runs a thousand times per simulated second, where small arrays would cost more than all
of MuJoCo's step.  What follows from the rotors alone is computed for many steps at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from quadsim.sim.effects import Effects, Push
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS, Vehicle

Wrench = tuple[float, float, float, float, float, float]
LOWEST_RATIO: Final = 0.5
"""Lowest height of a rotor, in rotor radii, for which `thrust_ratio` is used: below, the thrust grows no further."""


class StepForces:
    """The forces of a vehicle's effects on it.

    - Rotor drag, F_i = -k w_i (v_air,i - (v_air,i . z_b) z_b): blade flapping and induced drag hold each rotor back in
      its own plane in proportion to its speed and to the air's (Martin & Salaun 2010, "The true role of accelerometer
      feedback in quadrotor control"; RotorS, Furrer et al. 2016).  MuJoCo's fluid forces know neither rotors nor forces
      linear in the air speed at these Reynolds numbers, so it is computed here.
    - Gyroscopic and spin-up torque of rotors with inertia, -(d/dt + rates x) h z_b, with the angular momentum
      h = -sum_i spin_i J_r w_i of rotors that turn against their reaction torque.
    - Ground effect: what each rotor's thrust gains, by the height of its own disc; its torque gains nothing, as the
      ratio is that of thrusts at the same power.  See `thrust_ratio`.
    - Drag of the body along its axes, F_i = -(l_i + k_i |v_i|) v_i, v its velocity through the air in the body frame,
      as simplified simulations have it (Torrente et al. 2021, "Data-Driven MPC for Quadrotors").
    - Pushes: each a force F in the world frame, and the torque r x R' F of its point r of the body.

    The quadratic drag of `Air.body_drag` is MuJoCo's own; see `quadsim.sim.airframe.compile_model`.
    """

    def __init__(self, vehicle: Vehicle, effects: Effects, *, timestep: float, floor: float, disc: float) -> None:
        """Set up, for a physics step [s] and heights of the ground, world [m], and of the discs, body frame [m]."""
        rotors, air, ground = effects.rotors, effects.air, effects.ground
        self._inertia = (rotors and rotors.inertia) or 0.0
        self._drag = (air and air.rotor_drag) or 0.0
        self._along_axes = list(zip(air.linear_drag, air.quadratic_drag, strict=True)) if air and air.axis_drag else []
        self._radius = ground.rotor_radius if ground is not None and ground.effect else None
        self._always_of_pose = bool(self._drag or self._along_axes or self._radius is not None)
        self.push(())
        self._timestep, self._floor, self._disc = timestep, floor, disc
        self._places: list[tuple[float, float]] = [(x, y) for x, y, _ in vehicle.rotor_positions.tolist()]
        k, spins = self._drag, np.array(vehicle.rotor_spins, float)
        x, y = vehicle.rotor_positions[:, 0], vehicle.rotor_positions[:, 1]
        share = [np.full(N_ROTORS, k), k * x, k * y, k * (x * x + y * y), -self._inertia * spins]
        self._of_speed = np.stack(share, axis=1)  # (4, 5) what each rotor adds to a row of `of_rotors`, per rad/s
        self._of_slope = self._inertia * spins  # (4,) per rad/s^2

    def push(self, pushes: Sequence[Push]) -> None:
        """Let these act from now on, and no others."""
        self._pushes = [(push.force, push.point) for push in pushes if any(push.force)]
        self._of_pose = self._always_of_pose or bool(self._pushes)

    def of_rotors(self, speeds: Array, accelerations: Array) -> Array:
        """What the forces take from rotor speeds (M, 4) [rad/s] and their accelerations [rad/s^2], whatever the motion.

        Returns:
            (M, 6) drag coefficients D = sum_i k w_i [kg/s] and their moments sum_i x_i k w_i, sum_i y_i k w_i [kg m/s]
            and sum_i (x_i^2 + y_i^2) k w_i [kg m^2/s]; angular momentum h [N m s]; spin-up torque -dh/dt [N m].
        """
        rows = np.zeros((len(speeds), 6))
        of_speeds = rows[:, :5]
        for shares in np.moveaxis(speeds[:, :, None] * self._of_speed, 1, 0):
            of_speeds += shares
        if self._inertia:
            for shares in (accelerations * self._of_slope).T:
                rows[:, 5] += shares
        return rows

    def midway(
        self,
        qpos: Sequence[float],
        qvel: Sequence[float],
        qvel_before: Sequence[float],
        thrusts: Sequence[float],
        of_rotors: Sequence[float],
        wind: Sequence[float],
    ) -> Wrench:
        """Force in the world frame [N] and torque in the body frame about its origin [N m], half a step ahead.

        The motion there follows from this step's and the last one's.  A force that is evaluated there and held for the
        step acts as the changing one would, up to the third power of the step.

        Args:
            qpos: MuJoCo's position (3), world [m], and quaternion wxyz (4) now.
            qvel: velocity of the body frame's origin, world (3) [m/s], and body rates (3) [rad/s] now.
            qvel_before: the same a step ago.
            thrusts: (4,) that the rotors would have far from the ground [N].
            of_rotors: (6,) a row of `of_rotors`.
            wind: (3,) velocity of the air, world frame [m/s].
        """
        vx, vy, vz, p, q, r = qvel
        ux, uy, uz, a, b, c = qvel_before
        vx, vy, vz = vx + 0.5 * (vx - ux), vy + 0.5 * (vy - uy), vz + 0.5 * (vz - uz)
        p, q, r = p + 0.5 * (p - a), q + 0.5 * (q - b), r + 0.5 * (r - c)
        x, y, height, w, i, j, k = qpos
        half = 0.5 * self._timestep
        if self._of_pose:
            quarter = 0.5 * half  # dq/dt = q * (0, rates) / 2
            w, i, j, k = (
                w - quarter * (i * p + j * q + k * r),
                i + quarter * (w * p + j * r - k * q),
                j + quarter * (w * q + k * p - i * r),
                k + quarter * (w * r + i * q - j * p),
            )
        pose = (x, y, height + half * vz, w, i, j, k)
        return self.at(pose, (vx, vy, vz, p, q, r), thrusts, of_rotors, wind)

    def at(
        self,
        qpos: Sequence[float],
        qvel: Sequence[float],
        thrusts: Sequence[float],
        of_rotors: Sequence[float],
        wind: Sequence[float],
    ) -> Wrench:
        """The same as `midway`, now."""
        vx, vy, vz, p, q, r = qvel
        drag, drag_x, drag_y, drag_xy, momentum, tz = of_rotors
        fx = fy = fz = tx = ty = 0.0
        if not self._of_pose:
            return (fx, fy, fz, -q * momentum, p * momentum, tz) if self._inertia else (fx, fy, fz, tx, ty, tz)

        _, _, height, w, x, y, z = qpos
        # Body to world, of a quaternion that need not be of unit length.
        xx, yy, zz = x * x, y * y, z * z
        wx, wy, xz, yz = w * x, w * y, x * z, y * z
        s = 2.0 / (w * w + xx + yy + zz)
        r20, r21 = s * (xz - wy), s * (yz + wx)
        if self._drag:
            wz, xy = w * z, x * y
            r00, r01, r10, r11 = 1.0 - s * (yy + zz), s * (xy - wz), s * (xy + wz), 1.0 - s * (xx + zz)
            air_x, air_y, air_z = wind
            ax, ay, az = vx - air_x, vy - air_y, vz - air_z
            along_x = r00 * ax + r10 * ay + r20 * az
            along_y = r01 * ax + r11 * ay + r21 * az
            bx, by = drag_y * r - drag * along_x, -drag_x * r - drag * along_y
            tz = tz + drag_y * along_x - drag_x * along_y - drag_xy * r
            fx, fy, fz = r00 * bx + r01 * by, r10 * bx + r11 * by, r20 * bx + r21 * by
        if self._along_axes:
            wz, xy = w * z, x * y
            columns = (
                (1.0 - s * (yy + zz), s * (xy + wz), r20),
                (s * (xy - wz), 1.0 - s * (xx + zz), r21),
                (s * (xz + wy), s * (yz - wx), 1.0 - s * (xx + yy)),
            )
            ax, ay, az = vx - wind[0], vy - wind[1], vz - wind[2]
            for (cx, cy, cz), (linear, quadratic) in zip(columns, self._along_axes, strict=True):
                along = cx * ax + cy * ay + cz * az
                pull = -(linear + quadratic * abs(along)) * along
                fx, fy, fz = fx + pull * cx, fy + pull * cy, fz + pull * cz
        if self._inertia:
            tx, ty = -q * momentum, p * momentum
        if self._pushes:
            wz, xy = w * z, x * y
            for (px, py, pz), (rx, ry, rz) in self._pushes:
                fx, fy, fz = fx + px, fy + py, fz + pz
                bx = (1.0 - s * (yy + zz)) * px + s * (xy + wz) * py + r20 * pz
                by = s * (xy - wz) * px + (1.0 - s * (xx + zz)) * py + r21 * pz
                bz = s * (xz + wy) * px + s * (yz - wx) * py + (1.0 - s * (xx + yy)) * pz
                tx, ty, tz = tx + ry * bz - rz * by, ty + rz * bx - rx * bz, tz + rx * by - ry * bx
        if self._radius is not None:
            r22 = 1.0 - s * (xx + yy)
            above = height - self._floor + r22 * self._disc
            lift = 0.0
            for (x, y), thrust in zip(self._places, thrusts, strict=True):
                gain = thrust * (thrust_ratio(above + r20 * x + r21 * y, self._radius) - 1.0)
                lift += gain
                tx += y * gain
                ty -= x * gain
            fx, fy, fz = fx + s * (xz + wy) * lift, fy + s * (yz - wx) * lift, fz + r22 * lift
        return fx, fy, fz, tx, ty, tz


def thrust_ratio(height: float, radius: float) -> float:
    """Thrust of a hovering rotor near the ground over its thrust far from it, at the same power.

        T / T_inf = 1 / (1 - (R / (4 z))^2)

    The ground acts as an image of the rotor below it, whose outflow slows the inflow: I. C. Cheeseman, W. E. Bennett,
    "The Effect of the Ground on a Helicopter Rotor in Forward Flight", ARC R&M 3021, 1955.  Singular at z = R/4 and
    good for z > R/2 alone (J. G. Leishman, "Principles of Helicopter Aerodynamics", Sec. 5.8): lower heights are taken
    for z = R/2, where the ratio is 4/3.  Left out are forward speed, which weakens the effect, and what neighbouring
    rotors add to it; the ratio is applied at equal rotor speeds, as simulators commonly do.

    Args:
        height: z, of the rotor above the ground [m]; may be negative in a crash.
        radius: R, of the rotor [m]; positive.
    """
    image = 0.25 * radius / max(height, LOWEST_RATIO * radius)
    return 1.0 / (1.0 - image * image)
