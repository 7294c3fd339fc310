"""The effects on the plant beyond the paper's model; each is off unless a scenario sizes it.

The compiled core evaluates the forces that follow from how the vehicle moves (`quadsim/core/quadsim_plant.c`):

- Rotor drag, F_i = -k w_i (v_air,i - (v_air,i . z_b) z_b): blade flapping and induced drag hold each rotor back in its
  own plane in proportion to its speed and to the air's (Martin & Salaun 2010, "The true role of accelerometer feedback
  in quadrotor control"; RotorS, Furrer et al. 2016).  It acts at the hub, and turns the vehicle if that is above or
  below the centre of mass.  MuJoCo's fluid forces know neither rotors nor forces linear in the air speed at these
  Reynolds numbers.
- Inflow, -c w_i (v_air,i . z_b) of each rotor's thrust, with the torques that this thrust has: blades that climb meet
  the air at a smaller angle (J. G. Leishman, "Principles of Helicopter Aerodynamics", 2nd ed., Ch. 3: C_T falls as the
  inflow ratio grows), which damps climbing, and turning about x and y.
- Rotor moment, (m_x w_i v_y, -m_y w_i v_x, 0) about the hub, v rotor i's velocity through the air, body frame:
  blade flapping tilts its disc, and its drag acts above the centre of mass (Martin & Salaun 2010; Mahony, Kumar and
  Corke 2012, "Multirotor Aerial Vehicles", Eqs. (5)-(7)): the part that the hubs' heights do not give.
  Inflow moment, v_z (-k_x v_y, k_y v_x, 0), v the body's velocity through the air: blades flap less where the flow
  along the axis is more (Bramwell, Done and Balmford, "Bramwell's Helicopter Dynamics", 2nd ed., Ch. 3, a_1 =
  2 mu (4 theta_0 / 3 + lambda) / (1 - mu^2 / 2)).  Munk's moment of the ellipsoid that drags, which MuJoCo has, is of
  the same form; where k is stated, it is that of both.
  Rate damping, -d_i times the body rate about axis i, is what the same effects leave of a rotation.
- Gyroscopic and spin-up torque of rotors with inertia, -(d/dt + rates x) h z_b, with the angular momentum
  h = -sum_i spin_i J_r w_i of rotors that turn against their reaction torque.
- Ground effect: what each rotor's thrust gains, by the height z of its own disc above the ground,

      T / T_inf = 1 / (1 - (R / (4 z))^2)

  at the same power, so its torque gains nothing.  The ground acts as an image of the rotor below it, whose outflow
  slows the inflow: I. C. Cheeseman, W. E. Bennett, "The Effect of the Ground on a Helicopter Rotor in Forward Flight",
  ARC R&M 3021, 1955.  Singular at z = R / 4 and good for z > R / 2 alone (J. G. Leishman, "Principles of Helicopter
  Aerodynamics", Sec. 5.8): lower heights are taken for z = R / 2, where the ratio is 4/3.  Left out are forward speed,
  which weakens the effect, and what neighbouring rotors add to it; the ratio is applied at equal rotor speeds, as
  simulators commonly do.
- Drag of the body along its axes, F_i = -(l_i + k_i |v_i|) v_i, v its velocity through the air in the body frame, as
  simplified simulations have it (Torrente et al. 2021, "Data-Driven MPC for Quadrotors").
- Pushes: each a force F in the world frame, and the torque r x R' F of its point r of the body.

They are evaluated half a step ahead, where the motion follows from this step's and the last one's, and held for the
step: that acts as the changing force would, up to the third power of the step.  With `rk4` they are evaluated at each
stage.  The quadratic drag of `Air.body_drag` is MuJoCo's own; see `quadsim.sim.airframe.compile_model`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Final, Literal, Protocol

import numpy as np
from annotated_types import Len, doc

from quadsim.errors import InputError, ParameterError
from quadsim.fields import Instant, Metres, NonNegative, Seconds, Vector, filled
from quadsim.sim.effects.battery import Battery
from quadsim.sim.effects.coloured import ColouredNoise
from quadsim.sim.effects.lasting import in_force
from quadsim.sim.effects.load import Load, MassChange, PayloadDrop, PayloadPickup
from quadsim.sim.effects.rotors import LagChange, RotorChange, RotorDynamics
from quadsim.sim.effects.wind import Air
from quadsim.state import Array
from quadsim.vehicle import Vehicle


@dataclass(frozen=True, kw_only=True)
class Push:
    """A push on the vehicle: a constant force at a point of the body, with its torque r x R' F."""

    at: Instant
    type: Annotated[Literal["push"], doc("kind of event: push")] = "push"
    duration: Annotated[Seconds, doc("[s] length of the push")]
    force: Annotated[Vector, doc("[N] world frame")]
    point: Annotated[Vector, doc("[m] point of application, body frame")] = (0.0, 0.0, 0.0)

    def text(self) -> str:
        """Describe the event."""
        return f"a push of {math.hypot(*self.force):.3g} N"


@dataclass(frozen=True, kw_only=True)
class Ground:
    """A floor at the height at which the vehicle at z = 0 rests on its feet."""

    contact: Annotated[bool, doc("whether feet and hull meet the floor")] = True
    effect: Annotated[bool, doc("whether thrust grows near the floor (Cheeseman and Bennett)")] = False
    rotor_radius: Annotated[Metres | None, doc("[m] for the ground effect; absent: the vehicle's rotor_radius")] = None

    def resolved(self, vehicle: Vehicle) -> Ground:
        """Fill in the vehicle's rotor radius, if the ground effect needs it.

        Raises:
            ParameterError: neither states it.
        """
        if not self.effect:
            return self
        ground = filled(self, rotor_radius=vehicle.rotor_radius)
        if ground.rotor_radius is None:
            rule = f"given for the ground effect, as the vehicle {vehicle.name!r} states none"
            raise ParameterError("effects.ground", "rotor_radius", None, rule)
        return ground


@dataclass(frozen=True, kw_only=True)
class ThrustNoise:
    """Each rotor gives clip(u - n, 0, 1) of its largest thrust instead of u, n normal, independent.

    The mean of n is `loss` u^2 and its standard deviation is `deviation` sqrt(u), as in the simplified simulation of
    Torrente et al. 2021, "Data-Driven MPC for Quadrotors".  The reaction torque changes with the thrust.
    """

    loss: Annotated[NonNegative, doc("[-] mean of the share of thrust lost at full thrust; grows as u^2")] = 0.0
    deviation: Annotated[
        NonNegative, doc("[-] standard deviation per physics step at full thrust; proportional to sqrt(u)")
    ] = 0.0


_Deviations = Annotated[tuple[NonNegative, ...], Len(3, 3)]
_Times = Annotated[tuple[Seconds, ...], Len(3, 3)]
_NONE: Final = (0.0, 0.0, 0.0)


class Normals(Protocol):
    """A generator of standard normal numbers."""

    def standard_normal(self, size: tuple[int, int]) -> Array:
        """As of `numpy.random.Generator`."""
        ...


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """An unmodelled force and torque: constant, white, and lasting parts; see `quadsim.sim.effects.coloured`.

    Raises:
        InputError: a deviation is given without its time constants.
    """

    force: Annotated[Vector, doc("[N] world frame")] = (0.0, 0.0, 0.0)
    torque: Annotated[Vector, doc("[N m] body frame")] = (0.0, 0.0, 0.0)
    force_noise: Annotated[
        NonNegative, doc("[N s^0.5] root of the two-sided spectral density of white noise, each axis")
    ] = 0.0
    torque_noise: Annotated[NonNegative, doc("[N m s^0.5] as force_noise, for the torque")] = 0.0
    force_deviation: Annotated[
        _Deviations, doc("[N] standard deviation of a random force that lasts, along world x, y, z")
    ] = _NONE
    force_time: Annotated[_Times | None, doc("[s] time constants with which that force decays")] = None
    torque_deviation: Annotated[_Deviations, doc("[N m] as force_deviation, of a torque about body x, y, z")] = _NONE
    torque_time: Annotated[_Times | None, doc("[s] as force_time, for the torque")] = None

    def __post_init__(self) -> None:
        for name, deviation, time in (
            ("force", self.force_deviation, self.force_time),
            ("torque", self.torque_deviation, self.torque_time),
        ):
            if any(deviation) and time is None:
                raise InputError(f"{name}_time must be three time constants [s] where {name}_deviation is given")

    def draw(self, steps: int, timestep: float, rng: Normals) -> Array:
        """(steps, 6) constant and white force, world [N], and torque, body [N m], over steps of `timestep` [s]."""
        constant, density = self._constant_and_density
        if not density.any():
            return np.tile(constant, (steps, 1))
        drawn: Array = constant + density / math.sqrt(timestep) * rng.standard_normal((steps, 6))
        return drawn

    @cached_property
    def _constant_and_density(self) -> tuple[Array, Array]:
        return np.array([*self.force, *self.torque]), np.repeat([self.force_noise, self.torque_noise], 3)

    def lasting(self, timestep: float, rng: np.random.Generator) -> ColouredNoise | None:
        """Return the part that lasts, force and torque (6,) as in `draw`; None where there is none."""
        deviations = np.array([*self.force_deviation, *self.torque_deviation])
        if not deviations.any():
            return None
        absent = (1.0, 1.0, 1.0)  # of what has no deviation
        times = np.array([*(self.force_time or absent), *(self.torque_time or absent)])
        return ColouredNoise(deviations, times, timestep=timestep, rng=rng)


@dataclass(frozen=True, kw_only=True)
class PushChange:
    """From `at` [s] on, exactly these pushes act."""

    at: float
    pushes: tuple[Push, ...]


def push_changes(pushes: Sequence[Push]) -> Iterator[PushChange]:
    """Yield the pushes that act, whenever one starts or ends."""
    for time, pushes_in_force in in_force(pushes):
        yield PushChange(at=time, pushes=tuple(pushes_in_force))


Change = RotorChange | PayloadPickup | PayloadDrop | MassChange | LagChange | PushChange
"""The changes of a vehicle in flight."""
LOADING = (PayloadPickup, PayloadDrop, MassChange)
"""The changes of mass, for which the model is compiled differently."""


@dataclass(frozen=True, kw_only=True)
class Effects:
    """The effects on the plant beyond the paper's model; an absent table means that the effect is off."""

    rotors: Annotated[RotorDynamics | None, doc("rotor lag, limits, inertia, wear")] = None
    air: Annotated[Air | None, doc("drag and wind")] = None
    ground: Annotated[Ground | None, doc("a floor")] = None
    load: Annotated[Load | None, doc("errors of mass and inertia, payload")] = None
    disturbance: Annotated[Disturbance | None, doc("unmodelled force and torque")] = None
    thrust_noise: Annotated[ThrustNoise | None, doc("loss and fluctuation of thrust")] = None
    battery: Annotated[Battery | None, doc("voltage, on which thrust depends")] = None

    def resolved(self, vehicle: Vehicle) -> Effects:
        """Fill in every size left to the vehicle.

        Raises:
            ParameterError: a required size is missing in both, or a combination is impossible.
        """
        return replace(
            self,
            rotors=self.rotors and self.rotors.resolved(vehicle),
            air=self.air and self.air.resolved(vehicle),
            ground=self.ground and self.ground.resolved(vehicle),
            battery=self.battery and self.battery.resolved(vehicle),
        )

    @property
    def follows_state(self) -> bool:
        """Whether a force depends on the motion, so that physics steps are taken one by one."""
        spinning = self.rotors is not None and bool(self.rotors.inertia)
        dragged = self.air is not None and (self.air.drags or any(self.air.rate_damping or ()))
        lifted = self.ground is not None and self.ground.effect
        return spinning or dragged or lifted or self.disturbance is not None


class Force(Protocol):
    """A user-defined force on the vehicle: called once per physics step, at its start.

    An object with state may have a method `reset()`, called before a flight.
    """

    def __call__(self, time: float, state: Array) -> Array:
        """Force x, y, z in the world frame [N] and torque in the body frame [N m], (6,), at a time [s] and state (12,).

        The yaw of the state is within +-pi.
        """
        ...
