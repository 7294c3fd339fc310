"""The error-state extended Kalman filter: it uses samples in the order they were taken, however late.

An estimate is a mean on the manifold of poses and rates, and the covariance of its small error e = [dp dv dtheta domega
db], 15 numbers: position and velocity in the world frame, attitude as a rotation vector in the body frame (q_true = q *
exp(dtheta)), body rates and gyro bias.  Solà 2017, Secs.  5.1.1 and 5.3.1; multiplicative in the sense of Markley,
"Attitude error representations for Kalman filtering", JGCD 26 (2003).

Prediction, the modelled vehicle as a rigid body driven by its rotor speeds, and the growth of the error with time:

    dp/dt = v            dv/dt = R(q) [0, 0, U/m] - [0, 0, g] + w_a      dq/dt = q * [0, omega] / 2
    domega/dt = I^-1 (tau - D omega - omega x I omega) + w_alpha         db/dt = w_b

with white w_a, w_alpha, w_b, and to first order in the error, F(t) of de/dt = F e + w (Solà 2017, Eqs. (238)-(240), the
vehicle's model in place of an accelerometer):

    dv: -R [a]x dtheta      dtheta: -[omega]x dtheta + domega      domega: I^-1 ([I omega]x - [omega]x I - D) domega

On the ground, rotor speeds alone would let the vehicle fall.  The ground carries the rest of the weight, so nothing
moves: p, q and the gyro's bias stay, v = 0 and omega = 0, a zero-velocity update (Groves, "Principles of GNSS,
Inertial, and Multisensor Integrated Navigation Systems", 2nd ed.  2013, Sec.  15.3) at every step.  Legs that yield and
slide a little keep v and omega as white noise: sigma at any instant, forgotten after tau, so that position and attitude
walk randomly with densities sigma sqrt(tau).

The update of an estimate by a sample, and the test for outliers:

    r = z - h(x)    S = H P H' + R    K = P H' S^-1    e = K r    P <- P - K H P

The innovation of an attitude is the rotation vector from the estimate to the sample, so it is as good upside down as
level (Trawny and Roumeliotis, "Indirect Kalman filter for 3D attitude estimation", 2005, Sec. 3).  The normalised
innovation squared, r' S^-1 r, is chi-square with three degrees of freedom where model and noise are as stated.

The filter runs at the fusion horizon, now less the largest delay: every sample taken before it has arrived and has been
used, in the order of time stamps.  Later samples wait; a copy of the filter uses them and runs up to now, so a late
sample corrects the past it belongs to.  Rotor speeds, and contact with the ground, are stored for each step since the
horizon as well.  A vehicle on the ground leaves it once the modelled thrust exceeds its weight.

With `moment`, tau includes the moment of the rotors in the air, (m_x W v_y, -m_y W v_x, 0) with W the sum of their
speeds and v the mean velocity in body axes, as if there were no wind, and D is the vehicle's rate damping, otherwise 0.
Rotor i then gives b w_i^2 - inflow w_i v_i, v_i its hub's velocity along body z.
The error of the velocity is not passed on through this moment: w_alpha stands for it.

A single prediction is at most 10 ms long, while rotor speeds do not change.  A mean or sample above 1e6 in its SI unit,
or not a number, carries no information; an estimate beyond that, or with a variance of 1e15 in all, is lost: the mean
of before is kept with the initial covariance, for the sensors to correct.  The equations are computed by the core
(`quadsim/core/quadsim_filter.c`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from annotated_types import Gt, Lt, doc
from numpy.typing import NDArray

from quadsim.core.mirror import Struct, core_library, fill
from quadsim.core.structs import SAMPLE, SAMPLES, FilterStruct, TrackStruct
from quadsim.errors import ParameterError
from quadsim.fields import NonNegative
from quadsim.rotation import exponential, multiply, normalise
from quadsim.sim.sensing import KINDS, Sensor, SensorName, in_si
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS, Vehicle

N_ERRORS: Final = 15
MEAN_QUATERNION: Final = slice(6, 10)
MEAN_RATES: Final = slice(10, 13)
MEAN_GYRO_BIAS: Final = slice(13, 16)
LONGEST_STEP: Final = 0.01  # longest single prediction [s]
NEEDED: Final = (SensorName.POSITION, SensorName.ATTITUDE)
"""Sensors without which position or heading would drift without bound."""


@dataclass(frozen=True, kw_only=True)
class EstimatorSettings:
    """Tuning of the error-state filter.

    Densities are those of white noise, equal on all three axes: integrated for a time t they give the standard
    deviation density sqrt(t). The gate is the chi-square test of a sample's innovation.
    """

    moment: Annotated[
        bool,
        doc(
            "whether the model has the vehicle's rotor_moment, inflow_moment and inflow, at velocity over ground, and "
            "rate_damping"
        ),
    ] = False
    acceleration_noise: Annotated[NonNegative, doc("[m/s^2/sqrt(Hz)] unmodelled white acceleration")] = 0.3
    angular_acceleration_noise: Annotated[
        NonNegative, doc("[rad/s^2/sqrt(Hz)] unmodelled white angular acceleration")
    ] = 1.0
    gyro_bias_walk: Annotated[NonNegative, doc("[deg/s/sqrt(s)] random walk of the gyro's bias")] = 0.002
    initial_position: Annotated[NonNegative, doc("[m] standard deviation of the first estimate's error, per axis")] = (
        0.05
    )
    initial_velocity: Annotated[NonNegative, doc("[m/s] same")] = 0.05
    initial_attitude: Annotated[NonNegative, doc("[deg] same, about each body axis")] = 1.0
    initial_rates: Annotated[NonNegative, doc("[deg/s] same")] = 1.0
    initial_gyro_bias: Annotated[NonNegative, doc("[deg/s] same, for a bias initialised to zero")] = 0.5
    gate: Annotated[float, Gt(0.0), Lt(1.0), doc("[-] probability that a valid sample passes the innovation test")] = (
        0.9999
    )
    patience: Annotated[
        NonNegative, doc("[s] time of uninterrupted rejection after which a sensor is accepted again; 0 for never")
    ] = 1.0


@dataclass(frozen=True, kw_only=True)
class Tally:
    """Counts of one sensor's samples."""

    accepted: int = 0  # used
    rejected: int = 0  # rejected: outside the gate, or not numbers
    nis: float = 0.0
    """Sum of the normalised innovations squared of those used; on average three per sample with a correct model."""


class ErrorStateFilter:
    """Turns samples and rotor speeds into an estimate.  It never raises in flight and never returns NaN.

    An estimate's mean (16,) is position [m] and velocity [m/s], world, quaternion wxyz, body rates and the gyro's bias
    [rad/s].

    Attributes:
        settings: its tuning.
        struct: the core's filter.
        track: the core's filter at the fusion horizon.
    """

    def __init__(
        self, vehicle: Vehicle, sensors: Mapping[SensorName, Sensor], settings: EstimatorSettings, *, timestep: float
    ) -> None:
        """Prepare for the modelled vehicle, sensors and a physics step [s]; call `reset` before use.

        Raises:
            ParameterError: a sensor is missing, or has a noise of zero, or a moment is not stated.
        """
        from scipy.special import chdtri  # whose package takes a while to load, and few flights have an estimator

        for name in NEEDED:
            if name not in sensors:
                raise ParameterError("estimator", "sensors", [*map(str, sensors)], f"such that {name} is among them")
        noises = {}
        for name, sensor in sensors.items():
            noises[name] = in_si(name, sensor.noise)
            if min(noises[name]) <= 0.0:
                rule = "positive on every axis, for the estimator to weigh it"
                raise ParameterError(f"sensors.{name}", "noise", sensor.noise, rule)
        self.settings = settings
        self._names = tuple(sensors)
        self._horizon = max(sensor.latency(name, timestep) for name, sensor in sensors.items())
        f = self.struct = FilterStruct(timestep=timestep, mass=vehicle.mass, gravity=vehicle.gravity)
        f.inertia[:] = vehicle.inertia
        f.products[:] = vehicle.products_of_inertia or (0.0, 0.0, 0.0)
        fill(f.inverse, np.linalg.inv(vehicle.inertia_matrix))
        if settings.moment:
            vehicle.require_moment("estimator")
            f.rotor_moment[:] = vehicle.rotor_moment or (0.0, 0.0)
            f.inflow_moment[:] = vehicle.inflow_moment or (0.0, 0.0)
            f.rate_damping[:] = vehicle.rate_damping or (0.0, 0.0, 0.0)
            f.inflow = vehicle.inflow or 0.0
        fill(f.allocation, vehicle.allocation)
        f.density[1] = settings.acceleration_noise**2
        f.density[3] = settings.angular_acceleration_noise**2
        f.density[4] = math.radians(settings.gyro_bias_walk) ** 2
        for name, noise in noises.items():
            f.variance[KINDS[name]][:] = np.square(noise)
        turned = map(math.radians, (settings.initial_attitude, settings.initial_rates, settings.initial_gyro_bias))
        self._initial = np.repeat([settings.initial_position, settings.initial_velocity, *turned], 3)
        f.initial[:] = self._initial
        f.gate = float(chdtri(3, 1.0 - settings.gate))
        f.patience = settings.patience / timestep
        f.stride = max(1, int(LONGEST_STEP / timestep + 1e-9))

    def reset(self, mean: Array, speeds: Array, rng: np.random.Generator) -> None:
        """Start at step 0, with rotor speeds (4,) in force [rad/s].

        The first estimate differs from the truth, a mean (16,) with zero gyro bias, by an error drawn from the initial
        covariance; its bias by the true bias.
        """
        error = self._initial * rng.standard_normal(N_ERRORS)
        t = self.track = TrackStruct()
        t.refused[:] = [-1] * len(KINDS)
        fill(t.P, np.diag(np.square(self._initial)))
        moved = np.concatenate([mean[:10], mean[10:13] + error[9:12], mean[13:]])
        moved[:6] += error[:6]
        w, x, y, z = mean[MEAN_QUATERNION].tolist()
        a, b, c = error[6:9].tolist()
        moved[MEAN_QUATERNION] = normalise(multiply((w, x, y, z), exponential((a, b, c))))
        t.mean[:] = moved
        self._step = 0
        self._base = 0
        self._commands = np.empty((0, N_ROTORS))
        self._grounded = np.empty(0, np.uint8)
        self._waiting = np.empty(0, SAMPLE)

    @property
    def tallies(self) -> dict[SensorName, Tally]:
        """Counts of each sensor's samples; those after the fusion horizon are not yet included."""
        track = self.track
        tallies = {}
        for name in self._names:
            k = KINDS[name]
            tallies[name] = Tally(accepted=track.accepted[k], rejected=track.rejected[k], nis=track.nis[k])
        return tallies

    def advance(self, commands: Array, samples: Sequence[NDArray[np.void]], *, on_ground: bool = False) -> None:
        """Record a segment of flight and run the filter up to the fusion horizon.

        Args:
            commands: (M, 4) rotor speeds in force during each physics step [rad/s].
            samples: what has arrived meanwhile, arrays of `SAMPLE`, in any order.
            on_ground: whether a land detector saw the vehicle on the ground at the start of the segment.
        """
        self._step += len(commands)
        self._commands = np.concatenate([self._commands, commands])
        self._grounded = np.concatenate([self._grounded, np.full(len(commands), on_ground, np.uint8)])
        waiting = np.concatenate([self._waiting, *samples])
        waiting = waiting[np.lexsort((waiting["kind"], waiting["taken"]))]
        ripe = int(np.searchsorted(waiting["taken"], self._step - self._horizon, side="right"))
        self._run(self.track, waiting[:ripe], until=-1)
        self._waiting = waiting[ripe:]
        used = self.track.step - self._base
        self._commands = self._commands[used:]
        self._grounded = self._grounded[used:]
        self._base = self.track.step

    def estimate(self) -> tuple[Array, Array]:
        """Return mean (16,) and covariance (15, 15) now."""
        ahead = TrackStruct.from_buffer_copy(self.track)
        self._run(ahead, self._waiting, until=self._step)
        return np.array(ahead.mean), np.array(ahead.P)

    def _run(self, track: Struct, samples: NDArray[np.void], *, until: int) -> None:
        """Use samples, then predict to a step, unless that is past."""
        flown = self._commands.ctypes.data, self._grounded.ctypes.data
        used = self.struct, track, samples.ctypes.data_as(SAMPLES), len(samples)
        core_library().quadsim_filter_run(*used, *flown, self._base, until)
