"""A vehicle: mass, inertia, four rotors and their limits, read from one TOML file.

Thrust U and torques follow from the rotors' speeds (Sec. 2.2) by the allocation M that `Vehicle` computes from the
layout,

    [U, tau_x, tau_y, tau_z] = M [w_1^2, ..., w_4^2],    f_i = b w_i^2,    hover: U = m g, tau = 0.

The plant flies these equations; the controllers' models are linearised from them.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Final, NoReturn, get_type_hints

import numpy as np
from annotated_types import DocInfo, Len, doc

from quadsim.assets import read_toml
from quadsim.errors import FileError, ParameterError, UnknownNameError
from quadsim.fields import FLOORS, Number, Pair, Positive, Vector, floor_of
from quadsim.state import Array, read_only

N_ROTORS: Final = 4
AUTOPILOT: Final = "autopilot"  # table of a vehicle file; see `quadsim.sim.autopilot.AutopilotSettings`
VEHICLE_DISTURBANCE: Final = "disturbance"  # as AUTOPILOT: what its flights met; see `quadsim.sim.effects.Disturbance`
OfRotors = Annotated[tuple[Number, ...], Len(N_ROTORS, N_ROTORS)]
Positions = Annotated[tuple[Vector, ...], Len(N_ROTORS, N_ROTORS)]
ARMS: Final = ("arm_length", "rotor_azimuths")
"""The parameters that `rotor_positions` replaces."""
THRUST: Final = ("thrust_coefficient", "thrust_of_speed", "thrust_of_throttle")
"""The parameters of which one states a rotor's thrust."""
AIR_MOMENT: Final = ("rotor_moment", "inflow_moment", "rate_damping", "inflow")
"""The parameters that a controller or an estimator models where its field `moment` is true."""
LARGEST: Final = 1e6
"""Largest magnitude of a vehicle's numbers: larger ones overflow."""
LEAST_SHARE: Final = 1e-3
"""Least share of the weight that a rotor carries in hover."""
BALANCED: Final = 1e-9
"""Largest torque of four unit thrusts, per longest arm or per drag_to_thrust, that counts as none."""
_LEAST_OFFSET: Final = -1.0
"""Least `throttle_offset`: without throttle the rotors turn at half their largest speed."""
_MOST_OFFSET: Final = 0.9
"""Largest `throttle_offset`: below nine tenths of the throttle the rotors stand still."""
_ROUNDING: Final = 1e-12
"""Share by which the moments of inertia of a flat body may exceed their limit."""
_SINGULAR: Final = 1e-9
"""Determinant of the effects of four unit thrusts, see `Vehicle._effect_of_thrusts`, that counts as 0."""
SLOWEST_ROTOR: Final = 1.0
"""Longest time constant of a rotor [s]; propellers of 30 inch have some 0.3 s."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Vehicle:
    """A rigid body carried by four fixed rotors, thrust along body +z; validated on construction.

    Body frame: x forward, y left, z up, origin at the centre of mass.  Rotor i gives the thrust
    f_i = b w_i^2 [N] and the reaction torque spin_i d w_i^2 [N m] about body +z (Sec. 2.2), with a b of its own where
    `thrust_coefficient` has four numbers.  The rotors are placed by arms, or by `rotor_positions`.  They turn at
    `hover_speeds` in hover, which are equal only where their torques then cancel.

    A map of thrust may replace `thrust_coefficient`.

    `thrust_of_throttle`, T(u) = a_1 u + a_2 u^2 of the throttle u, gives b = T(1) / speed_max^2.  Identification starts
    from the speeds sqrt(T(u) / b) that the map gives for the logged throttle.  With a `throttle_offset` u_0,
    v = (u - u_0) / (1 - u_0) takes the place of u, and a rotor stands still while v < 0; without a map of the throttle
    the speed is v speed_max.

    `thrust_of_speed`, f(w) = a_1 w + a_2 w^2, is what the plant flies.  Reaction torque and power are in proportion to
    f, and a rotor so slow that f is negative gives no thrust.  The autopilot and the allocation of a wrench invert f.
    MPC and estimator model b w^2; they take for b of each rotor that of hover, f(w_i) / w_i^2, so that their trim is
    exact.  The linear model has the slope of f itself, a_1 + 2 a_2 w_i.

    Linear drag is a force -rotor_drag w v_perp on a rotor, v_perp its velocity through the air in the rotor's plane
    (Martin and Salaun, 2010; Furrer et al., 2016).  The same velocity v turns the vehicle, by (rotor_moment[0] w v_y,
    -rotor_moment[1] w v_x, 0) for each rotor: its disc flaps, and its drag acts above the centre of mass.  Flow along
    body z adds (-inflow_moment[0] v_y v_z, inflow_moment[1] v_x v_z, 0), of rotors and body together: blades flap less
    in a climb (Bramwell's Helicopter Dynamics, 2nd ed., Ch. 3).  Turning is damped by -rate_damping times the body
    rates.

    Flow along its axis takes inflow w v_axial from a rotor's thrust, v_axial its hub's velocity through the air along
    body z: climbing blades meet the air at a smaller angle (Leishman, Principles of Helicopter Aerodynamics, 2nd ed.,
    Ch. 3).  It is a slope at small v_axial, and holds for a loss that is small beside the thrust.

    What is in `OPTIONAL_PARAMETERS` is None where its file does not give it.

    Raises:
        ParameterError: a value is not finite or impossible, or the vehicle cannot hover within its rotors' range.

    Examples:
        >>> from dataclasses import replace
        >>> import quadsim
        >>> heavier = replace(quadsim.load_vehicle("hummingbird"), mass=0.8)  # [kg]
        >>> round(heavier.hover_speed)  # [rad/s]
        479
    """

    name: Annotated[str, doc("short name")]
    description: Annotated[str, doc("one line for `quadsim list`")] = ""
    mass: Annotated[float, doc("[kg] at take-off")]
    gravity: Annotated[float, doc("[m/s^2] where it flies")]
    inertia: Annotated[Vector, doc("[kg m^2] Ixx, Iyy, Izz, body axes")]
    products_of_inertia: Annotated[
        Vector | None,
        doc("[kg m^2] Ixy, Ixz, Iyz, body axes: entries of the inertia matrix, Ixy = -integral of x y dm"),
    ] = None
    arm_length: Annotated[float | None, doc("[m] L, centre of mass to rotor axis")] = None
    rotor_azimuths: Annotated[
        OfRotors | None, doc("[deg] direction of each arm from body +x, counter-clockwise seen from above")
    ] = None
    rotor_positions: Annotated[
        Positions | None, doc("[m] x, y, z of each rotor's hub, body axes, in place of arm_length and rotor_azimuths")
    ] = None
    rotor_spins: Annotated[
        tuple[int, ...],
        Len(N_ROTORS, N_ROTORS),
        doc("[-] 1 or -1, sign of each rotor's reaction torque about body +z"),
    ]
    thrust_coefficient: Annotated[
        Positive | OfRotors | None, doc("[N s^2/rad^2] b, thrust b w^2; one number, or one for each rotor")
    ] = None
    thrust_of_speed: Annotated[
        Pair | None,
        doc("[N s/rad, N s^2/rad^2] a1 and a2, thrust a1 w + a2 w^2 of a rotor, in place of thrust_coefficient"),
    ] = None
    thrust_of_throttle: Annotated[
        Pair | None,
        doc("[N] a1 and a2, thrust a1 u + a2 u^2 of a rotor at throttle u, 0 to 1, in place of thrust_coefficient"),
    ] = None
    throttle_offset: Annotated[
        float | None,
        doc(
            "[-] u0, throttle at which a rotor begins to turn, below 0 where it turns without any; (u - u0) / (1 - u0) "
            "takes the place of the throttle u"
        ),
    ] = None
    drag_to_thrust: Annotated[float, doc("[m] d / b, reaction torque d w^2")]
    speed_min: Annotated[float, doc("[rad/s] lowest speed that a rotor holds")]
    speed_max: Annotated[float, doc("[rad/s] highest speed that a rotor holds")]
    rotor_rise: Annotated[float | None, doc("[s] time constant of a rotor's speed when it rises")] = None
    rotor_fall: Annotated[float | None, doc("[s] time constant of a rotor's speed when it falls")] = None
    rotor_inertia: Annotated[float | None, doc("[kg m^2] of one rotor about its axis")] = None
    rotor_radius: Annotated[float | None, doc("[m] R, of a propeller")] = None
    rotor_drag: Annotated[float | None, doc("[N s^2/(m rad)] linear drag of one rotor")] = None
    inflow: Annotated[
        float | None, doc("[N s^2/(m rad)] thrust that one rotor loses per speed and air speed along its axis")
    ] = None
    rotor_moment: Annotated[
        Pair | None, doc("[N m s^2/(m rad)] of one rotor about its hub's x and y, per speed and air speed across it")
    ] = None
    inflow_moment: Annotated[
        Pair | None, doc("[N m s^2/m^2] of the whole vehicle about body x and y, per air speed along z and across it")
    ] = None
    rate_damping: Annotated[Vector | None, doc("[N m s/rad] of the whole vehicle about body x, y, z")] = None
    body_drag: Annotated[Vector | None, doc("[m^2] C_d A along body x, y, z")] = None
    extent: Annotated[float | None, doc("[m] radius of the ball about the centre of mass that holds all of it")] = None

    def __post_init__(self) -> None:
        for name in VEHICLE_UNITS:
            value = getattr(self, name)
            if value is None and name in OPTIONAL_PARAMETERS:
                continue
            object.__setattr__(self, name, _checked_parameter(name, value))
        self._check_ranges()
        self._check_inertia()
        self._check_layout()
        self._check_thrust()
        self._check_hover()

    def _check_ranges(self) -> None:
        """Refuse numbers outside the limits that their parameters have of their own."""
        if self.rate_damping is not None and min(self.rate_damping) < 0.0:
            self._refuse("rate_damping", ">= 0 N m s/rad about each axis")
        if self.inflow is not None and self.inflow < 0.0:
            self._refuse("inflow", ">= 0 N s^2/(m rad)")
        if self.throttle_offset is not None and not _LEAST_OFFSET <= self.throttle_offset <= _MOST_OFFSET:
            self._refuse("throttle_offset", f"between {_LEAST_OFFSET:g} and {_MOST_OFFSET:g}, a share of full throttle")
        if self.speed_min < 0.0:
            self._refuse("speed_min", ">= 0 rad/s")
        if self.speed_min >= self.speed_max:
            self._refuse("speed_min", f"below speed_max = {self.speed_max}")
        for name in ("rotor_rise", "rotor_fall"):
            time_constant = getattr(self, name)
            if time_constant is not None and time_constant > SLOWEST_ROTOR:
                self._refuse(name, f"above 0 and at most {SLOWEST_ROTOR:g} s, usually 0.01 to 0.3 s")
        if any(abs(spin) != 1 for spin in self.rotor_spins):
            self._refuse("rotor_spins", "four values, each 1 or -1")

    def _check_inertia(self) -> None:
        """Refuse moments of inertia that no rigid body has."""
        if 2.0 * max(self.inertia) > sum(self.inertia) * (1.0 + _ROUNDING):
            self._refuse("inertia", "such that no moment exceeds the sum of the other two")
        if self.products_of_inertia is not None:
            moments = np.linalg.eigvalsh(self.inertia_matrix)
            if not moments[2] <= (moments[0] + moments[1]) * (1.0 + _ROUNDING):
                self._refuse("products_of_inertia", "such that no principal moment exceeds the sum of the other two")

    def __repr__(self) -> str:
        lift = self.level_thrust(self.speed_max) / (self.mass * self.gravity)
        parts = [
            f"{self.mass:.3g} kg",
            f"arms of {1e3 * self.longest_arm:.3g} mm",
            f"hover at {self.hover_speed:.4g} of {self.speed_max:.4g} rad/s",
            f"thrust {lift:.3g} times the weight",
        ]
        about = ""
        if self.description:
            about = f"\n {self.description}"
        return f"<Vehicle {self.name}: {', '.join(parts)}{about}>"

    def _refuse(self, name: str, rule: str) -> NoReturn:
        """Raise the error of a parameter that must follow a rule."""
        raise ParameterError("vehicle", name, getattr(self, name), rule)

    def _check_layout(self) -> None:
        """Refuse rotors that are not placed, or placed or turning such that the vehicle cannot be controlled."""
        self._check_places()
        rule = self._layout_problem(self.rotor_spins)
        if rule is None:
            return
        alternating = self._alternating_spins()
        if self._layout_problem(alternating) is None:
            expected = tuple(alternating.tolist())
            self._refuse("rotor_spins", f"alternating around the airframe, so that yaw is controlled: {expected}")
        if self.rotor_positions is None:
            self._refuse("rotor_azimuths", rule)
        self._refuse("rotor_positions", rule)

    def _check_places(self) -> None:
        """Refuse rotors that are placed in two forms or in none, and rotors at the centre of mass."""
        stated = [name for name in ARMS if getattr(self, name) is not None]
        if self.rotor_positions is not None and stated:
            self._refuse("rotor_positions", f"left out where {' and '.join(stated)} is given: one or the other")
        if self.rotor_azimuths is not None and max(map(abs, self.rotor_azimuths)) > 360.0:
            self._refuse("rotor_azimuths", "within -360 and 360 deg")
        if self.rotor_positions is None:
            length, azimuths = ARMS
            if self.arm_length is None:
                self._refuse(length, f"given with {azimuths}, or rotor_positions in place of both")
            if self.rotor_azimuths is None:
                self._refuse(azimuths, f"given with {length}, or rotor_positions in place of both")
        if not self.longest_arm >= FLOORS["m"]:
            self._refuse("rotor_positions", "away from the centre of mass")

    def _alternating_spins(self) -> Array:
        """(4,) spins that alternate around the airframe, the first rotor's as it is."""
        counter_clockwise = np.argsort(np.mod(self.azimuths, math.tau), kind="stable")
        spins = np.empty(N_ROTORS, int)
        spins[counter_clockwise] = (1, -1, 1, -1)
        return np.asarray(spins * spins[0] * int(self.rotor_spins[0]))

    def _layout_problem(self, spins: Sequence[float] | Array) -> str | None:
        """Return the missing property of the layout with these spins; None if it is complete."""
        effect = self._effect_of_thrusts(spins)
        if abs(np.linalg.det(effect)) < _SINGULAR:
            return "a layout that controls roll, pitch, yaw and thrust"
        if _hover_shares(effect).min() < LEAST_SHARE:
            return "a layout in which every rotor lifts while the torques cancel, so that it can hover"
        return None

    def _effect_of_thrusts(self, spins: Sequence[float] | Array) -> Array:
        """(4, 4): thrust, and torques per length of the longest arm or per drag_to_thrust, of unit thrusts."""
        x, y, _ = self.hubs.T / self.longest_arm
        return np.stack([np.ones(N_ROTORS), y, -x, np.array(spins, float)])

    def _check_thrust(self) -> None:
        """Refuse a thrust that is stated in several forms or in none, and a map that cannot be."""
        stated = [name for name in THRUST if getattr(self, name) is not None]
        if not stated:
            self._refuse(THRUST[0], f"given, or {' or '.join(THRUST[1:])} in place of it")
        if len(stated) > 1:
            self._refuse(stated[1], f"left out where {stated[0]} is given: one or the other")
        if stated[0] != THRUST[0]:
            self._check_map(stated[0])

    def _check_map(self, name: str) -> None:
        """Refuse a map by which thrust is negative, or falls, in the range of its argument, or does not lift."""
        a1, a2 = getattr(self, name)
        u, low, top, unit = self._map_argument(name)
        thrust_over_low = a1 + a2 * low
        slope_at_low = a1 + 2.0 * a2 * low
        slope_at_top = a1 + 2.0 * a2 * top
        if thrust_over_low < 0.0 or slope_at_low < 0.0 or slope_at_top <= 0.0:
            rule = f"such that a1 {u} + a2 {u}^2 is not negative and rises from {u} = {low:g} to {top:g}{unit}"
            self._refuse(name, rule)
        largest = a1 * top + a2 * top**2
        carried = float(self.thrust_shares.max()) * self.mass * self.gravity
        if largest < carried:
            rule = f"such that a rotor lifts {carried:.4g} N or more, or it cannot hover: it lifts {largest:.4g} N at"
            self._refuse(name, f"{rule} {u} = {top:g}{unit}")

    def _map_argument(self, name: str) -> tuple[str, float, float, str]:
        """Return the argument of a map of thrust: its symbol, its least and its largest value, and their unit."""
        if name == "thrust_of_speed":
            return "w", self.speed_min, self.speed_max, " rad/s"
        if self.throttle_offset:
            without_throttle = float(self.effective_throttle(np.zeros(1))[0])
            return "v", without_throttle, 1.0, ""
        return "u", 0.0, 1.0, ""

    def _check_hover(self) -> None:
        """Refuse rotors that cannot turn at the speeds of hover."""
        slowest = float(self.hover_speeds.min())
        fastest = float(self.hover_speeds.max())
        if fastest > self.speed_max:
            self._refuse_hover("speed_max", f"no lower than its hover speed, {fastest:.6g} rad/s")
        if slowest < self.speed_min:
            self._refuse_hover("speed_min", f"no higher than its hover speed, {slowest:.6g} rad/s")

    def _refuse_hover(self, name: str, rule: str) -> NoReturn:
        """Refuse a limit of the speeds, and say what the rotors lift at it."""
        speed = getattr(self, name)
        held = f"rotors hold {self.speed_min:g} to {self.speed_max:g} rad/s"
        weight = f"{self.mass:g} kg weigh {self.mass * self.gravity:.4g} N"
        lift = f"the rotors lift {self.level_thrust(speed):.4g} N at {speed:g} rad/s"
        self._refuse(name, f"{rule}, or it cannot hover ({held}; {weight}, {lift})")

    @property
    def coefficients(self) -> Array:
        """(4,) thrust coefficient b of each rotor [N s^2/rad^2]; with `thrust_of_speed` that of hover."""
        if self.thrust_of_speed is not None:
            hover = self.mass * self.gravity * self.thrust_shares
            return np.asarray(hover / np.square(self.speeds(hover)))
        if self.thrust_of_throttle is not None:
            return np.full(N_ROTORS, sum(self.thrust_of_throttle) / self.speed_max**2)
        return np.broadcast_to(np.asarray(self.thrust_coefficient, np.float64), N_ROTORS).copy()

    @property
    def thrust_law(self) -> tuple[float, Array]:
        """a_1 [N s/rad] and a_2 (4,) [N s^2/rad^2] of the thrust a_1 w + a_2 w^2; 0 and b without `thrust_of_speed`."""
        if self.thrust_of_speed is None:
            return 0.0, self.coefficients
        return self.thrust_of_speed[0], np.full(N_ROTORS, self.thrust_of_speed[1])

    @property
    def square_law(self) -> tuple[Array, Array]:
        """(4,) r_i [rad/s] and (4,) q_i [-] of the thrust f_i = b_i (r_i w + q_i w^2); 0 and 1 where it is b_i w^2."""
        linear, quadratic = self.thrust_law
        return linear / self.coefficients, quadratic / self.coefficients

    @property
    def mean_coefficient(self) -> float:
        """The mean of the rotors' thrust coefficients [N s^2/rad^2]."""
        return math.fsum(self.coefficients) / N_ROTORS

    @cached_property
    def thrust_shares(self) -> Array:
        """(4,) share of the weight that each rotor carries in hover, where the torques cancel; a quarter if alike."""
        effect = self._effect_of_thrusts(self.rotor_spins)
        if np.abs(effect[1:].sum(axis=1)).max() <= BALANCED:
            return read_only(np.full(N_ROTORS, 1.0 / N_ROTORS))
        return read_only(_hover_shares(effect))

    @property
    def hover_speeds(self) -> Array:
        """(4,) the rotor speeds of hover, the trim [rad/s]: b_i w_i^2 = share_i m g."""
        return np.sqrt(self.mass * self.gravity * self.thrust_shares / self.coefficients)

    @property
    def hover_speed(self) -> float:
        """omega_bar [rad/s]: the common speed at which four rotors carry the weight, sum b_i omega_bar^2 = m g.

        The unit of speeds; where the layout needs another trim, see `hover_speeds`.
        """
        return math.sqrt(self.mass * self.gravity / (N_ROTORS * self.mean_coefficient))

    def thrusts(self, speeds: Array) -> Array:
        """Return the thrusts b_i w_i^2, or `thrust_of_speed`, (..., 4) [N] of rotor speeds (..., 4) [rad/s]."""
        linear, quadratic = self.thrust_law
        return np.maximum(quadratic * np.square(speeds) + linear * np.asarray(speeds), 0.0)

    def speeds(self, thrusts: Array) -> Array:
        """Return the rotor speeds (..., 4) [rad/s] of thrusts (..., 4), 0 or more [N]: the inverse of `thrusts`."""
        if self.thrust_of_speed is None:
            return np.sqrt(thrusts / self.coefficients)
        a1, a2 = self.thrust_of_speed
        # The root of a_1 w + a_2 w^2 = f; beyond the largest thrust of a map with a_2 < 0, that of the largest.
        root = np.sqrt(np.maximum(a1**2 + 4.0 * a2 * thrusts, 0.0))
        if a1 > 0.0:  # this form also holds for a_2 = 0, and subtracts no numbers that are nearly equal
            return np.asarray(2.0 * thrusts / (a1 + root))
        return np.asarray((root - a1) / (2.0 * a2))

    def level_thrust(self, speed: float) -> float:
        """Return the collective thrust [N], without torque, at which the fastest rotor has a speed [rad/s]."""
        thrusts = self.thrusts(np.full(N_ROTORS, speed))
        return float((thrusts / self.thrust_shares).min())

    @property
    def throttle_share(self) -> float:
        """Share a of the square in (w / speed_max)^2 = (1 - a) v + a v^2, with v of `effective_throttle`.

        It is 1 without `thrust_of_throttle`: the speed is then proportional to v.
        """
        if self.thrust_of_throttle is None:
            return 1.0
        return self.thrust_of_throttle[1] / sum(self.thrust_of_throttle)

    def effective_throttle(self, throttle: Array) -> Array:
        """Return v = (u - u_0) / (1 - u_0) of throttles u of any shape, 0 to 1, with u_0 the `throttle_offset`."""
        offset = self.throttle_offset or 0.0
        return np.clip((throttle - offset) / (1.0 - offset), 0.0, 1.0)

    @property
    def inertia_matrix(self) -> Array:
        """(3, 3) J, body axes [kg m^2]."""
        xx, yy, zz = self.inertia
        xy, xz, yz = self.products_of_inertia or (0.0, 0.0, 0.0)
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    def momentum(self, rates: Array) -> Array:
        """Return the angular momentum J omega (..., 3) [N m s] of body rates (..., 3) [rad/s]."""
        if self.products_of_inertia is None:
            return np.asarray(np.array(self.inertia) * rates)
        return np.asarray(rates @ self.inertia_matrix)

    def angular_acceleration(self, torque: Array) -> Array:
        """Return the angular acceleration J^-1 tau (..., 3) [rad/s^2] of a torque (..., 3) [N m]."""
        if self.products_of_inertia is None:
            return np.asarray(torque / np.array(self.inertia))
        return np.asarray(torque @ np.linalg.inv(self.inertia_matrix))

    def accelerations(self, wrench: Array) -> Array:
        """Return U / m [m/s^2] and J^-1 tau [rad/s^2] (4, ...) of wrenches [U, tau] (4, ...) [N, N m]."""
        collective = wrench[:1] / self.mass
        angular = self.angular_acceleration(wrench[1:].T).T
        return np.concatenate([collective, angular])

    def air_moment(self, turning: float, velocity: Array, rates: Array) -> Array:
        """Return the torque (3,) [N m] of `rotor_moment`, `inflow_moment` and `rate_damping`.

        It is ((m_x W - k_x v_z) v_y, -(m_y W - k_y v_z) v_x, 0) - D omega.

        Args:
            turning: W, sum of the rotors' speeds [rad/s].
            velocity: (3,) v through the air, body axes [m/s].
            rates: (3,) omega, body axes [rad/s].
        """
        m_x, m_y = self.rotor_moment or (0.0, 0.0)
        k_x, k_y = self.inflow_moment or (0.0, 0.0)
        v_x, v_y, v_z = velocity
        across = np.array([(m_x * turning - k_x * v_z) * v_y, -(m_y * turning - k_y * v_z) * v_x, 0.0])
        damping = np.array(self.rate_damping or (0.0, 0.0, 0.0)) * rates
        return np.asarray(across - damping)

    def lost_to_inflow(self, speeds: Array, velocity: Array, rates: Array) -> Array:
        """Return what `inflow` takes of the rotors' thrust and of its torques, (4,) [N, N m].

        Of rotor i it takes inflow w_i v_i, with v_i = v_z + p y_i - q x_i at its hub.

        Args:
            speeds: (4,) w [rad/s].
            velocity: (3,) v through the air, body axes [m/s].
            rates: (3,) p, q, r, body axes [rad/s].
        """
        x, y, _ = self.hubs.T
        axial = velocity[2] + rates[0] * y - rates[1] * x
        lost = (self.inflow or 0.0) * speeds * axial
        wrench_of_thrusts = self.allocation / self.coefficients
        return np.asarray(wrench_of_thrusts @ lost)

    def air_accelerations(self, velocity: Array, rates: Array) -> Array:
        """Return (4,) what the air adds in hover to U / m [m/s^2] and J^-1 tau [rad/s^2].

        That is by `rotor_moment`, `inflow_moment`, `rate_damping` and `inflow`; arguments as of `air_moment`.
        """
        wrench = -self.lost_to_inflow(self.hover_speeds, velocity, rates)
        wrench[1:] += self.air_moment(float(self.hover_speeds.sum()), velocity, rates)
        return self.accelerations(wrench)

    @property
    def turn_damping(self) -> Array:
        """(3,) torque that opposes each body rate [N m s/rad]: `rate_damping`, and that of `inflow` in hover."""
        still = np.zeros(3)
        torques = []
        for unit_rate in np.eye(3):
            wrench = self.lost_to_inflow(self.hover_speeds, still, unit_rate)
            torques.append(wrench[1:])
        about_its_own_axis = np.diagonal(torques)
        damping = np.array(self.rate_damping or (0.0, 0.0, 0.0))
        return np.asarray(damping + about_its_own_axis)

    @property
    def turned_by_air(self) -> float:
        """Angular acceleration by `rotor_moment` at hover, per air speed across the rotors [rad/(m s)]."""
        moment = max(map(abs, self.rotor_moment or (0.0,)))
        return float(self.hover_speeds.sum()) * moment / min(self.inertia[:2])

    def require_moment(self, owner: str) -> None:
        """Refuse a model of the air's moment where nothing is known of it.

        Raises:
            ParameterError: the vehicle states none of `AIR_MOMENT`.
        """
        if all(getattr(self, name) is None for name in AIR_MOMENT):
            listed = f"{', '.join(AIR_MOMENT[:-1])} or {AIR_MOMENT[-1]}"
            rule = f"false, or {self.name} with {listed}, of which its file states none"
            raise ParameterError(owner, "moment", True, rule)

    @property
    def hubs(self) -> Array:
        """(4, 3) rotor hubs in the body frame [m]."""
        if self.rotor_positions is not None:
            return np.array(self.rotor_positions)
        directions = np.stack([np.cos(self.azimuths), np.sin(self.azimuths), np.zeros(N_ROTORS)], axis=1)
        return self.longest_arm * directions.round(15)  # an arm along an axis lies on it exactly

    @property
    def azimuths(self) -> Array:
        """(4,) direction of each rotor from body x [rad]."""
        if self.rotor_positions is None:
            return np.radians(np.array(self.rotor_azimuths, float))
        return np.arctan2(self.hubs[:, 1], self.hubs[:, 0])

    @property
    def longest_arm(self) -> float:
        """Largest distance of a rotor's axis from the centre of mass [m]: arm_length, where it is stated."""
        if self.rotor_positions is None:
            assert self.arm_length is not None
            return self.arm_length
        return max(math.hypot(x, y) for x, y, _ in self.rotor_positions)

    @property
    def enclosing_radius(self) -> float:
        """Radius of the vehicle's bounding ball [m]: its extent, or the distance to the propellers' tips.

        An extent within the propellers' tips does not count.  Without either, the propellers are assumed as large as
        possible: neighbours almost touch.
        """
        if self.extent is not None:
            return max(self.extent, self._reach + (self.rotor_radius or 0.0))
        if self.rotor_radius is None:
            return self._reach + 0.5 * self.closest_rotors
        return self._reach + self.rotor_radius

    @property
    def _reach(self) -> float:
        """Largest distance of a hub from the centre of mass [m]."""
        if self.rotor_positions is None:
            return self.longest_arm
        return max(math.hypot(*hub) for hub in self.rotor_positions)

    @property
    def closest_rotors(self) -> float:
        """Smallest distance between two hubs [m]."""
        distances = np.linalg.norm(self.hubs[:, None] - self.hubs[None], axis=2)
        are_two_hubs = ~np.eye(N_ROTORS, dtype=bool)
        return float(distances[are_two_hubs].min())

    @property
    def allocation(self) -> Array:
        """(4, 4) matrix that maps squared rotor speeds to [U, tau_x, tau_y, tau_z], in N and N m (Sec. 2.2)."""
        b = self.coefficients
        x, y, _ = self.hubs.T
        return np.stack([b, b * y, -b * x, self.drag_to_thrust * b * np.array(self.rotor_spins, float)])


def span(speeds: Array) -> str:
    """Return speeds as text: from the least to the largest, or the one that all have."""
    low = f"{speeds.min():.4g}"
    high = f"{speeds.max():.4g}"
    if low == high:
        return low
    return f"{low} to {high}"


def _hover_shares(effect: Array) -> Array:
    """(4,) thrusts that add up to 1 while their torques cancel."""
    return np.linalg.solve(effect, np.array([1.0, 0.0, 0.0, 0.0]))


def _checked_parameter(name: str, value: Any) -> Any:
    """Return a parameter, its lists as tuples.

    Raises:
        ParameterError: it is not the number, or not the numbers, that it should be.
    """
    if name == "rotor_positions":
        return _checked_positions(name, value)
    length = _LENGTHS.get(name)
    if name == "thrust_coefficient" and isinstance(value, (tuple, list)):  # one for each rotor
        length = N_ROTORS
    if length is None:
        _check_number(name, value)
        return value
    return _checked_numbers(name, value, length, f"a list of {length} numbers")


def _checked_positions(name: str, value: Any) -> tuple[tuple[float, ...], ...]:
    """Return one position for each rotor, as tuples."""
    rule = f"a list of {N_ROTORS} lists of 3 numbers"
    _check_length(name, value, N_ROTORS, rule)
    positions = []
    for position in value:
        positions.append(_checked_numbers(name, position, 3, rule))
    return tuple(positions)


def _checked_numbers(name: str, value: Any, length: int, rule: str) -> tuple[float, ...]:
    """Return a list of numbers as a tuple."""
    _check_length(name, value, length, rule)
    for number in value:
        _check_number(name, number)
    return tuple(value)


def _check_length(name: str, value: Any, length: int, rule: str) -> None:
    """Refuse what is no list of this length."""
    if not isinstance(value, (tuple, list)) or len(value) != length:
        raise ParameterError("vehicle", name, value, rule)


def _check_number(name: str, value: object) -> None:
    """Refuse what is no number, or none that the parameter can have."""
    positive = name not in _ANY_SIGN
    if isinstance(value, int) and abs(value) > LARGEST:
        # It may have too many digits for a float, and for a message, which then shows an infinity.
        if value > 0:
            value = math.inf
        else:
            value = -math.inf
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ParameterError("vehicle", name, value, "a finite number")
    if positive and value <= 0.0:
        raise ParameterError("vehicle", name, value, "positive")
    unit = VEHICLE_UNITS[name]
    least = floor_of(unit)
    if abs(value) > LARGEST or (positive and value < least):
        raise ParameterError("vehicle", name, value, f"between {least:g} and {LARGEST:g} {unit}")


def load_vehicle(path: Path, overrides: Mapping[str, Any] | None = None) -> Vehicle:
    """Read a vehicle file: `name`, `description` and one table `{value, unit, source}` per parameter.

    `overrides` are parameter values that replace the file's.

    Raises:
        FileError: the file is missing, is not TOML, lacks a parameter, or has an impossible value.
        ParameterError: it is impossible with these overrides.
        UnknownNameError: the file or an override names an unknown parameter.
    """
    with _naming(path):
        texts, entries = _read_entries(path)
    for key in overrides or {}:
        _require_parameter(key)
    stated: dict[str, Any] = dict(texts)
    for key, entry in entries.items():
        stated[key] = entry["value"]
    values = overridden(stated, overrides or {})
    missing = missing_parameters(values)
    if "name" not in values:
        missing.insert(0, "name")
    if missing:
        raise FileError(path, f"lacks {', '.join(missing)}")
    if overrides:
        return Vehicle(**values)
    with _naming(path):
        return Vehicle(**values)


def overridden(values: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return parameters with some replaced.

    Where the overrides place the rotors, or state their thrust, the parameters of any other form of it become None.
    """
    replaced: list[str] = []
    if "rotor_positions" in overrides:
        replaced += ARMS
    elif {*ARMS} <= {*overrides}:
        replaced.append("rotor_positions")
    if {*THRUST} & {*overrides}:
        replaced += THRUST
    changed: dict[str, Any] = dict(values)
    for name in replaced:
        if name in values:
            changed[name] = None
    return {**changed, **overrides}


def altered(vehicle: Vehicle, overrides: Mapping[str, Any]) -> Vehicle:
    """Return a vehicle with some parameters replaced, as `overridden`; errors as `Vehicle`."""
    values = {field.name: getattr(vehicle, field.name) for field in fields(vehicle)}
    return Vehicle(**overridden(values, overrides))


def missing_parameters(values: Mapping[str, Any]) -> list[str]:
    """Return the parameters that these lack to make a vehicle."""
    stated = {name for name, value in values.items() if value is not None}
    needed = {*VEHICLE_UNITS} - {*OPTIONAL_PARAMETERS}
    if "rotor_positions" not in stated:
        needed |= {*ARMS}
    if not stated & {*THRUST}:
        needed.add(THRUST[0])
    missing = needed - {*values}  # a needed one that is None is not missing: `Vehicle` refuses it
    return [name for name in VEHICLE_UNITS if name in missing]


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Name the file whose number is refused."""
    try:
        yield
    except ParameterError as error:
        raise FileError(path, str(error)) from None


def vehicle_sources(path: Path) -> dict[str, str]:
    """Return the source of each parameter, in the vehicle file's order; arguments and errors as `load_vehicle`."""
    _, entries = _read_entries(path)
    return {key: entry["source"] for key, entry in entries.items()}


EXAMPLE_SOURCE: Final = "example"
"""The source of each number of `quadsim vehicle --template`."""
EXAMPLE_DESCRIPTION: Final = "An example: "
"""How its description begins."""


def example_notes(path: Path, replaced: Collection[str] = ()) -> tuple[str, ...]:
    """Return what a vehicle file still has of the template's example; errors as `load_vehicle`.

    Args:
        path: the vehicle file.
        replaced: names of parameters whose values in the file are not used.
    """
    texts, entries = _read_entries(path)
    left = []
    for name, entry in entries.items():
        if entry["source"] == EXAMPLE_SOURCE and name not in replaced:
            left.append(name)
    notes = []
    if left:
        count = f"{len(left)} of {len(entries)} values"
        listed = ", ".join(left)
        notes.append(f'{path.name}: {count} are of an example (source = "{EXAMPLE_SOURCE}"), not yours: {listed}')
    if texts.get("description", "").startswith(EXAMPLE_DESCRIPTION):
        notes.append(f"{path.name}: the description is of an example, not yours: {texts['description']!r}")
    return tuple(notes)


def vehicle_table(path: Path, name: str) -> dict[str, Any]:
    """Return the fields of a vehicle file's `[autopilot]` or `[disturbance]` but its `source`; empty without the table.

    Raises:
        FileError: as `load_vehicle`.
        ParameterError: it is not a table, or does not say where its numbers are from.
    """
    tables = read_toml(path)
    if name not in tables:
        return {}
    table = tables[name]
    if not isinstance(table, dict) or not _is_source(table.get("source")):
        raise ParameterError("vehicle", name, table, "a table with a source, a text saying where it is from")
    return {name: value for name, value in table.items() if name != "source"}


def _read_entries(path: Path) -> tuple[dict[str, str], dict[str, dict[str, Any]]]:
    """Return a vehicle file's description and parameters, each with value, unit and source."""
    texts: dict[str, str] = {}
    entries: dict[str, dict[str, Any]] = {}
    for key, entry in read_toml(path).items():
        if key in (AUTOPILOT, VEHICLE_DISTURBANCE):
            continue
        if key in ("name", "description"):
            if not isinstance(entry, str):
                raise ParameterError("vehicle", key, entry, "a text")
            texts[key] = entry
            continue
        _require_parameter(key, hint=f"in {path}")
        _check_entry(key, entry)
        entries[key] = entry
    return texts, entries


def _require_parameter(key: str, hint: str = "") -> None:
    """Refuse a name that no parameter has; `hint` says where it stands."""
    if key not in VEHICLE_UNITS:
        raise UnknownNameError("vehicle parameter", key, VEHICLE_UNITS, hint=hint, meant=MEANT.get(key, ()))


def _check_entry(key: str, entry: object) -> None:
    """Refuse an entry that is not a value in the parameter's unit, with its source."""
    if not isinstance(entry, dict) or set(entry) != {"value", "unit", "source"}:
        raise ParameterError("vehicle", key, entry, "a table with exactly value, unit and source")
    if entry["unit"] != VEHICLE_UNITS[key]:
        raise ParameterError("vehicle", f"{key}.unit", entry["unit"], f"{VEHICLE_UNITS[key]!r}")
    if not _is_source(entry["source"]):
        raise ParameterError("vehicle", f"{key}.source", entry["source"], "a text saying where the number is from")


def _is_source(text: object) -> bool:
    """Return whether it can say where a number is from: a text that is not blank."""
    return isinstance(text, str) and bool(text.strip())


def _stated_units() -> dict[str, str]:
    """Return the units in brackets that begin the documentation of a vehicle's fields."""
    units = {}
    for name, hint in get_type_hints(Vehicle, include_extras=True).items():
        for note in hint.__metadata__:
            if isinstance(note, DocInfo) and note.documentation.startswith("["):
                unit, _, _ = note.documentation.removeprefix("[").partition("]")
                units[name] = unit
    return units


VEHICLE_UNITS: Final[dict[str, str]] = _stated_units()
"""The parameters of a vehicle file and their units."""
MEANT: Final[dict[str, tuple[str, ...]]] = {"rotor_lag": ("rotor_rise", "rotor_fall")}
"""Parameters by other common names, where a spelling guess would name the wrong one."""
OPTIONAL_PARAMETERS: Final = tuple(field.name for field in fields(Vehicle) if field.default is None)
"""Parameters that a vehicle file may leave out."""
_LENGTHS: Final = {
    "thrust_of_speed": 2,
    "thrust_of_throttle": 2,
    "inertia": 3,
    "products_of_inertia": 3,
    "body_drag": 3,
    "rotor_moment": 2,
    "inflow_moment": 2,
    "rate_damping": 3,
    "rotor_azimuths": N_ROTORS,
    "rotor_spins": N_ROTORS,
}
"""How many numbers a parameter has that is a list of them; those of `rotor_positions` are lists themselves."""
_ANY_SIGN: Final = (
    "rotor_azimuths",
    "rotor_positions",
    "rotor_spins",
    "speed_min",
    "products_of_inertia",
    "rotor_moment",
    "inflow_moment",
    "rate_damping",
    "inflow",
    "thrust_of_speed",
    "thrust_of_throttle",
    "throttle_offset",
)
"""Parameters that may be 0 or negative; `Vehicle` restricts some of them further."""
