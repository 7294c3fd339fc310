"""From samples to the state a controller is told: an error-state Kalman filter, attitude on the sphere."""

from quadsim.estimation.estimate import Estimate, difference, retract
from quadsim.estimation.filter import ErrorStateFilter, Tally
from quadsim.estimation.settings import EstimatorSettings

__all__ = ["ErrorStateFilter", "Estimate", "EstimatorSettings", "Tally", "difference", "retract"]
