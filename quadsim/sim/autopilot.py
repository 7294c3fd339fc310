"""An autopilot: the fast inner loop that flies a controller's thrust and body rates, or thrust and attitude.

At its own rate, from measured body rates omega, low-pass filtered to y, and attitude q,

    omega_c = omega_ff + k_a 2 vec(q* q_c)                    attitude mode only, with the error's scalar part >= 0
    alpha   = p (omega_c - y) + I - d dy/dt,     dI/dt = i (omega_c - y),  |I| <= i_max
    tau     = J alpha + y x J y

and the mixer turns thrust and torque into rotor speeds.  Roll and pitch come first, then as much yaw as fits into the
rotors' range beside them, then the collective thrust, which is shifted until no rotor saturates: airmode.  Without
airmode the thrust stays, and torques are cut.  An axis that was cut does not integrate.  This is the structure of
Betaflight and PX4, in SI units.

Gains that a file does not state follow from the vehicle (`AutopilotSettings.resolved`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Final

import numpy as np
from annotated_types import Len, doc

from quadsim.controller import AutopilotLoop
from quadsim.core.inner import CompiledLoop
from quadsim.core.mirror import fill
from quadsim.core.structs import InnerStruct, LoopKind
from quadsim.errors import InputError, ParameterError
from quadsim.fields import Fraction, Hertz, NonNegative, filled, require_floor
from quadsim.mpc.problem.rigidbody import inner_response
from quadsim.sim.effects import Effects
from quadsim.sim.effects.rotors import RotorDynamics
from quadsim.sim.physics import PHYSICS, inner_steps, whole
from quadsim.sim.plant import Plant
from quadsim.state import N_STATES, Array
from quadsim.vehicle import N_ROTORS, Vehicle

Gains = Annotated[tuple[NonNegative, ...], Len(3, 3)]

# [Hz]
RATE = 1000.0
GYRO_CUTOFF = 100.0
D_CUTOFF = 60.0
LARGEST_RATE: Final = (500.0, 500.0, 200.0)  # [deg/s]
RATE_LOOP_DAMPING: Final = 0.7
"""Damping of the rate loop that the default gains aim at."""
FASTEST_RATE_LOOP: Final = 40.0
"""Largest bandwidth of the default rate loop [rad/s]."""
LARGEST_D: Final = 2.0
"""Largest default of d: it multiplies the effect of gyro noise."""
INTEGRAL_TIME: Final = 1.0  # of the default rate loop, p / i [s]
AUTHORITY: Final = 0.25  # share of the angular acceleration available at hover that the default I may demand


@dataclass(frozen=True, kw_only=True)
class AutopilotSettings:
    """An autopilot's loops and mixer; what is absent follows from the vehicle file, or from inertia and rotor lag."""

    rate: Annotated[
        Hertz | None, doc("[Hz] of the loops; the period is a whole number of physics steps; absent: 1000")
    ] = None
    p: Annotated[Gains | None, doc("[1/s] gain of the rate error, about body x, y, z; absent: by rule")] = None
    i: Annotated[Gains | None, doc("[1/s^2] gain of its integral; absent: p per second")] = None
    d: Annotated[Gains | None, doc("[-] gain of the measured angular acceleration; absent: by rule")] = None
    i_max: Annotated[
        Gains | None, doc("[rad/s^2] largest integral part; absent: a quarter of what the rotors give at hover")
    ] = None
    gyro_cutoff: Annotated[
        NonNegative | None, doc("[Hz] of the low-pass filter on body rates, 0 for none; absent: 100")
    ] = None
    d_cutoff: Annotated[
        NonNegative | None, doc("[Hz] of a second one, on their derivative, 0 for none; absent: 60")
    ] = None
    delay: Annotated[
        NonNegative | None, doc("[s] from measured rates to rotor commands, whole periods of the loop; absent: one")
    ] = None
    attitude: Annotated[
        Gains | None, doc("[1/s] gain of the attitude error; absent: a quarter of the bandwidth that p has by rule")
    ] = None
    largest_rate: Annotated[
        Gains | None, doc("[deg/s] clips the body rates that hold an attitude; absent: 500, 500, 200")
    ] = None
    idle: Annotated[
        Fraction | None, doc("[-] slowest rotor, as a share of speed_max; absent: the vehicle's speed_min")
    ] = None
    airmode: Annotated[bool | None, doc("whether thrust yields to torques; absent: true")] = None

    def __post_init__(self) -> None:
        require_floor(self, "gyro_cutoff", "d_cutoff", unit="Hz")

    def resolved(self, vehicle: Vehicle) -> AutopilotSettings:
        """Fill in what is absent, by rule.

        With T the rotors' rise time plus filter and delay, the loop s^2 T + (1 + d) s + p has the bandwidth
        w = min(40 rad/s, (1 + 2) / (2 zeta T)), for d <= 2, and the damping zeta = 0.7: p = w^2 T, d = 2 zeta w T - 1;
        where T is so short that d would be negative, p = w / (2 zeta).  Yaw, whose reaction torque saturates first,
        has d = 0 and p = 1 / (2 T), at most half that of roll.
        """
        usual = filled(
            self, rate=RATE, gyro_cutoff=GYRO_CUTOFF, d_cutoff=D_CUTOFF, largest_rate=LARGEST_RATE, airmode=True
        )
        assert usual.rate is not None
        rate = usual.rate
        usual = filled(usual, delay=1.0 / rate)
        filtering = 0.0
        if usual.gyro_cutoff:
            filtering = 1.0 / (math.tau * usual.gyro_cutoff)
        lag = (vehicle.rotor_rise or 0.0) + filtering + (usual.delay or 0.0) + 0.5 / rate
        w = min(FASTEST_RATE_LOOP, (1.0 + LARGEST_D) / (2.0 * RATE_LOOP_DAMPING * lag))
        p = w * max(w * lag, 0.5 / RATE_LOOP_DAMPING)
        d = max(2.0 * RATE_LOOP_DAMPING * w * lag - 1.0, 0.0)
        gains = filled(usual, p=(p, p, min(0.5 * p, 0.5 / lag)), d=(d, d, 0.0))
        assert gains.p is not None
        effect = np.abs(vehicle.allocation[1:]).sum(axis=1) / np.array(vehicle.inertia)
        slowest = float(vehicle.hover_speeds.min())
        fastest = float(vehicle.hover_speeds.max())
        reserve = min(slowest**2 - vehicle.speed_min**2, vehicle.speed_max**2 - fastest**2)
        integral_gains = [gain / INTEGRAL_TIME for gain in gains.p]
        largest_integrals = AUTHORITY * effect * reserve
        return filled(
            gains,
            i=tuple(integral_gains),
            i_max=tuple(largest_integrals.tolist()),
            attitude=(0.25 * w, 0.25 * w, 0.25 * min(w, gains.p[2])),
            idle=vehicle.speed_min / vehicle.speed_max,
        )


class Autopilot(CompiledLoop):
    """The autopilot of a vehicle (`quadsim.controller.AutopilotLoop`), for a controller's targets.

    A target is a row: collective thrust [N] and body rates [rad/s], (4,); with an attitude (wxyz, body to world) after
    them, (8,), the attitude is held, and the rates are fed forward.  Its equations are computed by the core.

    Attributes:
        settings: resolved.
    """

    takes_targets: Final = True

    def __init__(
        self,
        vehicle: Vehicle,
        settings: AutopilotSettings | None = None,
        *,
        speeds: tuple[float, float] | None = None,
    ) -> None:
        """Set up at hover; `speeds` are the slowest and the fastest of a rotor, idle and speed_max by default."""
        self.settings = settings = (settings or AutopilotSettings()).resolved(vehicle)
        assert settings.rate is not None
        assert settings.delay is not None
        assert settings.largest_rate is not None
        assert settings.idle is not None
        self.rate = settings.rate
        step = 1.0 / settings.rate
        rule = f"a whole number of periods of {step:g} s"
        delay = whole("autopilot", "delay", settings.delay, settings.delay * settings.rate, rule, smallest=0)
        hover = float(vehicle.hover_speeds.min())
        if settings.idle * vehicle.speed_max >= hover:
            rule = f"below {hover / vehicle.speed_max:.3g}, at which it hovers"
            raise ParameterError("autopilot", "idle", settings.idle, rule)
        slowest, fastest = speeds or (settings.idle * vehicle.speed_max, vehicle.speed_max)
        a = InnerStruct(kind=LoopKind.AUTOPILOT, measures=1, step=step, airmode=bool(settings.airmode))
        a.p[:] = settings.p
        a.i[:] = settings.i
        a.d[:] = settings.d
        a.i_max[:] = settings.i_max
        a.attitude[:] = settings.attitude
        a.largest[:] = np.radians(settings.largest_rate)
        a.gyro_share = _filter_share(settings.gyro_cutoff, step)
        a.d_share = _filter_share(settings.d_cutoff, step)
        a.inertia[:] = vehicle.inertia
        a.products[:] = vehicle.products_of_inertia or (0.0, 0.0, 0.0)
        share = N_ROTORS * vehicle.thrust_shares
        fill(a.to_thrusts, np.linalg.inv(vehicle.allocation / vehicle.coefficients) / share[:, None])
        b = vehicle.coefficients / share
        linear, quadratic = vehicle.square_law
        a.coefficient[:] = b
        a.low[:] = b * (linear * slowest + quadratic * slowest**2)
        a.high[:] = b * (linear * fastest + quadratic * fastest**2)
        a.linear[:] = linear
        a.quadratic[:] = quadratic
        super().__init__(a, delay=delay)
        self._hover = vehicle.hover_speeds
        self.reset()

    def reset(self) -> None:
        """Start anew: no integral, filters at rest, rotors at hover."""
        fill(self._struct.integral, 0.0)
        self.settle(np.zeros(3), self._hover)

    def settle(self, rates: Array, rotors: Array) -> None:
        """Settle the filters at body rates (3,) [rad/s], and the commands under way at rotor speeds (4,) [rad/s]."""
        fill(self._struct.filtered, rates)
        fill(self._struct.slope, 0.0)
        self._queue[:] = rotors
        self._struct.oldest = 0


def _filter_share(cutoff: float | None, step: float) -> float:
    """Return the share of a change that a first-order low-pass filter takes in a step [s]; all of it without one."""
    if not cutoff:
        return 1.0
    return 1.0 - math.exp(-math.tau * cutoff * step)


STEPS: Final = (0.1, 1.0, 1.0, 0.5)
"""Steps by which lags are identified: of the weight, and of body rates [rad/s]."""
FIT_WINDOW: Final = 0.3  # time of a step response that is fitted [s]
# [s]
SHORTEST_FITTED_LAG = 1e-4
LONGEST_FITTED_LAG = 0.6
ATTITUDE_STEP: Final = 0.1
"""Step by which lags of an attitude are identified [rad]."""
# [s]
SHORTEST_ATTITUDE_LAG = 0.01
LONGEST_ATTITUDE_LAG = 5.0


def identify_lags(vehicle: Vehicle, autopilot: AutopilotLoop, *, timestep: float = 1e-3) -> tuple[float, ...]:
    """Return the first-order lags of thrust, p, q and r [s] that fit the autopilot's step responses best.

    It steps each target from hover, on the plant with the vehicle's rotor lag and without other effects, and fits
    1 - exp(-t / lag) to the first 0.3 s by least squares.
    """
    from scipy.optimize import minimize_scalar  # slow to import

    times = np.arange(1, round(FIT_WINDOW / timestep) + 1) * timestep
    lags = []
    with _step_plant(vehicle, timestep) as plant:
        for axis in range(4):
            response = _step_response(plant, autopilot, axis)

            def misfit(lag: float, response: Array = response) -> float:
                return float(np.square(1.0 - np.exp(-times / lag) - response).sum())

            lag = float(minimize_scalar(misfit, bounds=(SHORTEST_FITTED_LAG, LONGEST_FITTED_LAG), method="bounded").x)
            if lag > 0.95 * LONGEST_FITTED_LAG:
                name = ("thrust", "p", "q", "r")[axis]
                raise InputError(f"autopilot: a step of {name} is not reached, so no lag fits it; state inner_lag")
            lags.append(lag)
    return tuple(lags)


def identify_attitude_lags(
    vehicle: Vehicle, autopilot: AutopilotLoop, rate_lags: Sequence[float], *, timestep: float = 1e-3
) -> tuple[float, ...]:
    """Return the lags of roll, pitch and yaw [s] behind a commanded attitude that fit its step responses best.

    It steps each angle from hover, as `identify_lags` steps body rates, whose lags p, q, r are given [s].  The model is
    `quadsim.mpc.problem.rigidbody.inner_response`: a lag is one over the gain from the attitude's error to a rate.
    """
    from scipy.optimize import minimize_scalar  # slow to import

    count = round(FIT_WINDOW / timestep)
    lags = []
    with _step_plant(vehicle, timestep) as plant:
        for axis, rate_lag in enumerate(rate_lags):
            response = _attitude_response(plant, autopilot, axis)

            def misfit(lag: float, response: Array = response, rate_lag: float = rate_lag) -> float:
                left, taken = inner_response(timestep, count + 1, rate_lag, lag)
                rates = (1.0 - left - taken)[1:] / lag
                return float(np.square(rates - response).sum())

            bounds = (SHORTEST_ATTITUDE_LAG, LONGEST_ATTITUDE_LAG)
            lag = float(minimize_scalar(misfit, bounds=bounds, method="bounded").x)
            if lag > 0.95 * LONGEST_ATTITUDE_LAG:
                name = ("roll", "pitch", "yaw")[axis]
                raise InputError(f"autopilot: a step of {name} is not reached, so no lag fits it; state attitude_lag")
            lags.append(lag)
    return tuple(lags)


def _step_plant(vehicle: Vehicle, timestep: float) -> Plant:
    """Return a plant with the vehicle's rotor lag and without other effects, on which an autopilot is stepped."""
    rise = vehicle.rotor_rise or 0.0
    fall = vehicle.rotor_fall or rise
    inertia = None
    if not rise:  # rotors with inertia cannot change their speed at once
        inertia = 0.0
    rotors = RotorDynamics(rise=rise or None, fall=fall or None, inertia=inertia).resolved(vehicle)
    return Plant(vehicle, timestep=timestep, effects=Effects(rotors=rotors), limit_speeds=True)


def _step_response(plant: Plant, autopilot: AutopilotLoop, axis: int) -> Array:
    """(WINDOW / timestep,) the share of a step of a target, 0 thrust, 1 to 3 body rates, that is reached."""
    vehicle = plant.vehicle
    weight = vehicle.mass * vehicle.gravity
    target = np.array([weight, 0.0, 0.0, 0.0])
    size = STEPS[axis]
    if axis == 0:
        size *= weight
    target[axis] += size
    _fly_target(plant, autopilot, target)
    if axis:
        reached: Array = plant.flown["physics"][:, PHYSICS["body_rates"]][:, axis - 1] / size
        return reached
    ends = np.concatenate([plant.flown["speeds"][1:], plant.speeds[None]])
    squares = np.square(ends) * (vehicle.coefficients / vehicle.mean_coefficient)
    return np.asarray((vehicle.mean_coefficient * squares.sum(axis=1) - weight) / size)


def _attitude_response(plant: Plant, autopilot: AutopilotLoop, axis: int) -> Array:
    """(WINDOW / timestep,) the body rate about an axis, 0 to 2, after a step of the attitude, over its error [1/s]."""
    half = 0.5 * ATTITUDE_STEP
    target = np.zeros(8)
    target[0] = plant.vehicle.mass * plant.vehicle.gravity
    target[4] = math.cos(half)
    target[5 + axis] = math.sin(half)
    _fly_target(plant, autopilot, target)
    response: Array = plant.flown["physics"][:, PHYSICS["body_rates"]][:, axis] / (2.0 * math.sin(half))
    return response


def _fly_target(plant: Plant, autopilot: AutopilotLoop, target: Array) -> None:
    """Fly the window of a fit from hover under a target, which the autopilot holds."""
    count = round(FIT_WINDOW / plant.timestep)
    stride = inner_steps(autopilot.rate, plant.timestep, "autopilot")
    plant.reset(np.zeros(N_STATES))
    autopilot.reset()

    def answer() -> Array:
        attitude, rates = plant.attitude
        return autopilot.speeds(plant.time, target, rates, plant.speeds, attitude)

    loop = InnerStruct(kind=LoopKind.OUTSIDE)
    if isinstance(autopilot, CompiledLoop):
        loop = autopilot.engage(target, plant.speeds) or loop
    loop.until = 0
    loop.stride = stride
    plant.begin(count)
    plant.hold(target, count, loop=loop, ask=answer)


@cache
def built_in_lags(vehicle: Vehicle, settings: AutopilotSettings, timestep: float) -> tuple[float, ...]:
    """`identify_lags` of the built-in autopilot, kept: a campaign asks for the same one in every flight."""
    return identify_lags(vehicle, Autopilot(vehicle, settings), timestep=timestep)


@cache
def built_in_attitude_lags(
    vehicle: Vehicle, settings: AutopilotSettings, rate_lags: tuple[float, ...], timestep: float
) -> tuple[float, ...]:
    """`identify_attitude_lags` of the built-in autopilot, kept likewise."""
    return identify_attitude_lags(vehicle, Autopilot(vehicle, settings), rate_lags, timestep=timestep)
