"""A controller in thirty lines: PD on position and on attitude, with the course's motion and the weight fed forward."""

import numpy as np
from numpy.typing import NDArray

from quadsim.controller import StepInputs
from quadsim.state import POSITION, VELOCITY
from quadsim.vehicle import Vehicle

Array = NDArray[np.float64]


class MyController:
    """Errors give an acceleration, that gives roll and pitch, and these give torques; gains are per unit mass."""

    def __init__(self, vehicle: Vehicle, period: float, horizon: int, stiffness: float = 1.5, lead: int = 8) -> None:
        self.vehicle = vehicle
        self.period = period
        self.stiffness = stiffness
        self.lead = min(lead, horizon - 3)
        self.inertia = np.array([vehicle.mass, *vehicle.inertia])
        self.to_squares = np.linalg.inv(vehicle.allocation)  # from thrust and torques to squared rotor speeds

    def step(self, now: StepInputs, state: Array, reference: Array) -> Array:
        """Four rotor speeds [rad/s] for a state (12,) and the next N samples of the course (N, 4)."""
        g = self.vehicle.gravity
        roll, pitch, yaw = state[[6, 8, 10]]
        rates = state[[7, 9, 11]]
        velocity = np.diff(reference[:, :3], axis=0) / self.period
        a = (velocity[self.lead + 1] - velocity[self.lead]) / self.period  # the tilt that gives it takes a while
        a += self.stiffness * (reference[0, :3] - state[list(POSITION)] - self.period * velocity[0])
        a += 2.0 * np.sqrt(self.stiffness) * (velocity[0] - state[list(VELOCITY)])
        forward = a[0] * np.cos(yaw) + a[1] * np.sin(yaw)
        left = a[1] * np.cos(yaw) - a[0] * np.sin(yaw)
        roll_error = np.clip(-left / g, -0.3, 0.3) - roll
        pitch_error = np.clip(forward / g, -0.3, 0.3) - pitch
        yaw_error = 0.1 * (reference[0, 3] - yaw)
        errors = np.array([roll_error, pitch_error, yaw_error])
        up = (g + a[2]) / (np.cos(roll) * np.cos(pitch))
        wrench = self.inertia * [up, *(20.0 * errors - 8.0 * rates)]
        return np.sqrt(np.clip(self.to_squares @ wrench, 0.0, 500.0**2))
